"""When this robot says that it is here, and with which number."""

GREETING_RATIO = 0.2
"""Least pause between heartbeats that greet new neighbours, against the usual one."""


class OwnHeartbeat:
    """The beat of one robot; a late tick does not make up for heartbeats it missed."""

    def __init__(self, now: float) -> None:
        self.due_s = now
        self.sequence = 0
        self._last_s = float("-inf")

    def beat(self, period_s: float, now: float) -> None:
        """A heartbeat goes out; the next is due a period after this one was."""
        self.due_s += period_s
        if self.due_s <= now:
            self.due_s = now + period_s
        self._last_s = now
        self.sequence += 1

    def greet(self, period_s: float, now: float) -> None:
        """A new neighbour is greeted at once, but for a pause after the last heartbeat."""
        self.due_s = min(self.due_s, max(now, self._last_s + GREETING_RATIO * period_s))
