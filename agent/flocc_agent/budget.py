"""What a robot lets itself use of the network. Pure: now and what was used are passed in.

Messages always pass and count, sent and received, so that logs stay ahead of latents; a piece of a latent is asked for
only while the robot is within its budget. A single piece may overdraw it, and the next one waits until that is made up.
"""

BURST_S = 1.0
"""Unused budget is kept for so long."""
OVERDRAWN_MIN_BYTES = 1.0
"""Less is nothing, so that rounding never makes a pause too short for any clock to show."""


class Budget:
    """A token bucket that reads what was used off the robot's own counters."""

    def __init__(self, bytes_s: float, now_s: float = 0.0) -> None:
        self._bytes_s = bytes_s
        self._left = bytes_s * BURST_S
        self._used = 0
        self._at_s = now_s

    def pause_s(self, used_bytes: int, now_s: float) -> float:
        """How long the next piece has to wait.

        Args:
            used_bytes: All that was used since the start; never decreases.
            now_s: Never decreases.
        """
        filled = self._left + self._bytes_s * (now_s - self._at_s)
        self._left = min(filled, self._bytes_s * BURST_S) - (used_bytes - self._used)
        self._used, self._at_s = used_bytes, now_s
        return 0.0 if self._left > -OVERDRAWN_MIN_BYTES else -self._left / self._bytes_s
