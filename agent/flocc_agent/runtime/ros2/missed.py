"""Messages that were published and never came: lost by the network, or before this node fetched them.

Only the middleware tells it: by its numbers of messages, and by what it says was lost on the way. Best effort, and a
queue that is not deep enough, lose without a word.
"""

PUBLISHERS_MAX = 64


class Missing:
    """Counts what is missing of one topic, each message once. Called on one thread.

    The numbers show what is missing between two messages that came, also what a short queue let go. What the middleware
    says was lost on the way includes what was before the first message and behind the last, where numbers say nothing,
    but not what the queue let go. Neither includes the other, so the larger count stands, which is never too much.
    """

    def __init__(self) -> None:
        self._last: dict[bytes, int] = {}
        self._gaps = 0
        """Missing between messages, and, as far as the middleware says it, before the first."""
        self._said = 0
        self._told = 0

    def heard(self, publisher: bytes | None, number: int | None) -> int:
        """Take in the number of a message that came; returns how many more are missing now.

        What a publisher sent before its first message came is no gap, and an older number says nothing. Where the
        middleware gives no numbers there are no gaps.
        """
        if publisher is None or number is None:
            return 0
        last = self._last.get(publisher)
        if last is None:
            if not self._last:
                self._gaps = min(self._said, max(0, number - 1))
            if len(self._last) < PUBLISHERS_MAX:
                self._last[publisher] = number
            return 0
        self._last[publisher] = max(last, number)
        self._gaps += max(0, number - last - 1)
        return self._more()

    def lost(self, total: int) -> int:
        """Take in how many messages the middleware says were lost so far; returns how many more are missing now."""
        self._said = max(self._said, total)
        return self._more()

    def _more(self) -> int:
        told, self._told = self._told, max(self._gaps, self._said)
        return self._told - told
