"""A set of pairs of keyframes that grows with the mission: some 90 to 140 bytes a pair instead of 300."""

from flocc_protocol.ids import INDEX_MAX, LogId
from flocc_protocol.messages import CandidatePair


class PairSet:
    """Pairs, by their two logs, as whole numbers made of their two indices."""

    def __init__(self) -> None:
        self._of_logs: dict[tuple[LogId, LogId], set[int]] = {}

    def __contains__(self, pair: CandidatePair) -> bool:
        return _number(pair) in self._of_logs.get((pair.low.log, pair.high.log), ())

    def add(self, pair: CandidatePair) -> None:
        """Take a pair in."""
        self._of_logs.setdefault((pair.low.log, pair.high.log), set()).add(_number(pair))

    def discard(self, pair: CandidatePair) -> None:
        """Leave a pair out, where it is there."""
        self._of_logs.get((pair.low.log, pair.high.log), set()).discard(_number(pair))


def _number(pair: CandidatePair) -> int:
    return pair.low.index * (INDEX_MAX + 1) + pair.high.index
