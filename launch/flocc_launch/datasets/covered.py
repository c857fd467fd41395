"""Which images of a bag no pose covers: those outside of odometry's time, and in gaps of it that are not bridged."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flocc_agent.runtime.text_tables import text_lines
from flocc_agent.runtime.trajectory import GAP_MAX_S, NEAR_S

PARTS_MAX = 10_000
"""Parts of odometry that are remembered; what comes after so many gaps is taken as covered to its end."""


@dataclass(slots=True, eq=False)
class Covered:
    """Counts images without a pose, in memory that does not grow with the bag.

    Attributes:
        images: Of all journeys so far.
        without: Of them, those without a pose.
    """

    images: int = 0
    without: int = 0
    _parts_s: list[tuple[float, float]] = field(default_factory=list)

    def posed(self, stamp_s: float) -> None:
        """A pose came; one after a gap that is not bridged begins a part of its own."""
        goes_on = self._parts_s and (stamp_s - self._parts_s[-1][1] <= GAP_MAX_S or len(self._parts_s) == PARTS_MAX)
        if goes_on:
            first_s, last_s = self._parts_s[-1]
            self._parts_s[-1] = (first_s, max(last_s, stamp_s))
        else:
            self._parts_s.append((stamp_s, stamp_s))

    def count(self, listing: Path) -> None:
        """A journey ended, whose images stand in a list in order of time."""
        lines = text_lines(listing) if listing.exists() else ()
        stamps_s = np.array([float(text.split(maxsplit=1)[0]) for _, text in lines])
        parts_s = np.array(self._parts_s or [(np.inf, np.inf)])
        part = np.searchsorted(parts_s[:, 0], stamps_s + NEAR_S, side="right") - 1
        has_pose = (part >= 0) & (stamps_s <= parts_s[np.maximum(part, 0), 1] + NEAR_S)
        self.images += len(stamps_s)
        self.without += int(np.count_nonzero(~has_pose))
        self._parts_s.clear()

    def told(self, of_what: str) -> list[str]:
        """A sentence where images have no pose."""
        lie = f"{self.without} of {self.images} images lie outside of the time of {of_what}, or in a gap of it"
        return [f"{lie}: no robot uses them"] if self.without else []
