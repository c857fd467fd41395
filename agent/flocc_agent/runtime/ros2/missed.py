"""Messages that a publisher numbered and that never came: lost by the network, or before this node fetched them.

Only the middleware's numbers tell it: best effort, and a queue that is not deep enough, lose without a word.
"""

PUBLISHERS_MAX = 64


class SequenceGaps:
    """Counts what is missing in the numbers of each publisher of one topic. Called on one thread."""

    def __init__(self) -> None:
        self._last: dict[bytes, int] = {}

    def missing_before(self, publisher: bytes | None, number: int | None) -> int:
        """How many messages of a publisher are missing between its last one and this one.

        What a publisher sent before its first message came is not missing, and an older number says nothing. Where
        the middleware gives no numbers nothing is known to be missing.
        """
        if publisher is None or number is None:
            return 0
        last = self._last.get(publisher)
        if last is None:
            if len(self._last) < PUBLISHERS_MAX:
                self._last[publisher] = number
            return 0
        self._last[publisher] = max(last, number)
        return max(0, number - last - 1)
