"""How late heartbeats were: the longest time between two, of this robot's own and of each neighbour's."""

PEERS_MAX = 256
LATELY_S = 10.0


class LongestGap:
    """The longest time between two marks of one name, lately: over the last one to two `LATELY_S`."""

    def __init__(self) -> None:
        self._marked_s: dict[str, float] = {}
        self._longest_s = self._before_s = 0.0
        self._turn_s = float("-inf")

    def mark(self, name: str, now_s: float) -> None:
        """Something of this name happened now."""
        self._turn(now_s)
        before_s = self._marked_s.get(name)
        if before_s is not None:
            self._longest_s = max(self._longest_s, now_s - before_s)
        if before_s is not None or len(self._marked_s) < PEERS_MAX:
            self._marked_s[name] = now_s

    def forget(self, name: str) -> None:
        """Nothing more is expected of this name."""
        self._marked_s.pop(name, None)

    def longest_s(self, now_s: float) -> float:
        """The longest gap that ended lately, 0 where there was none."""
        self._turn(now_s)
        return max(self._longest_s, self._before_s)

    def _turn(self, now_s: float) -> None:
        if now_s >= self._turn_s:
            self._before_s = self._longest_s if now_s < self._turn_s + LATELY_S else 0.0
            self._longest_s, self._turn_s = 0.0, now_s + LATELY_S
