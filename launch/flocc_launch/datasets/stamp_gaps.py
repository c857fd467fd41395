"""Messages that come late, as threads and networks swap them, told from a clock that was set back.

A late one fills a gap that those before it left. After a clock was set back all fall among stamps that are there.
"""

from bisect import bisect_left, insort
from collections import deque
from itertools import pairwise
from statistics import quantiles

KEPT = 64
GAP_STEPS_MIN, NEAR_STEPS_MIN = 1.5, 0.4
"""How long a gap is, and how far from both of its ends what fills it, in usual steps from message to message."""


class StampGaps:
    """The last stamps of a topic, and the usual step between two."""

    def __init__(self) -> None:
        self._came: deque[int] = deque(maxlen=KEPT)
        self._taken: list[int] = []

    def fits(self, stamp_ns: int) -> bool:
        """Take in a stamp; whether it is the latest one so far, or fills a gap of those before it."""
        self._came.append(stamp_ns)
        fits = not self._taken or stamp_ns > self._taken[-1] or self._fills_gap(stamp_ns)
        if fits:
            insort(self._taken, stamp_ns)
            del self._taken[:-KEPT]
        return fits

    def _fills_gap(self, stamp_ns: int) -> bool:
        after = bisect_left(self._taken, stamp_ns)
        if after == 0 or len(self._came) < 3:
            return False
        step_ns = quantiles((abs(b - a) for a, b in pairwise(self._came)), n=4)[0]
        before_ns, after_ns = self._taken[after - 1], self._taken[after]
        near_ns = min(stamp_ns - before_ns, after_ns - stamp_ns)
        return after_ns - before_ns >= GAP_STEPS_MIN * step_ns and near_ns >= max(NEAR_STEPS_MIN * step_ns, 1)
