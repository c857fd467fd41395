"""A saved map as the core knows it: logs that nobody writes any more, and where their keyframes are.

The logs themselves are held, served and passed on like any other. What differs: their robots register nothing, their
poses start where they were saved, and the frame that they had keeps its name when a team joins it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SavedClosure:
    """What the saved solution made of a closure that it used: metres per network unit, None where it is metric."""

    scale: float | None
    weight: float


@dataclass(frozen=True, slots=True, eq=False)
class SavedMap:
    """The logs of an opened map.

    Attributes:
        logs: Those with poses; the first is the anchor, whose name the frame keeps.
        closed: All of them: their robots are no longer there.
        T_map_camera: (N, 4, 4) saved camera poses of each log with poses.
        closures: The closures that its solution used, by (query, match).
        is_fixed: Its poses do not move, whatever a team measures.
        weights: Of keyframes that several logs contradict, how much of a closure to one counts, below 1.
    """

    logs: tuple[LogId, ...]
    closed: frozenset[LogId]
    T_map_camera: Mapping[LogId, Float]
    closures: Mapping[tuple[KeyframeId, KeyframeId], SavedClosure] = field(default_factory=dict)
    is_fixed: bool = False
    weights: Mapping[KeyframeId, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.logs:
            raise ValueError("a map has at least one log with poses")

    @property
    def anchor(self) -> LogId:
        """The log that names the frame."""
        return self.logs[0]

    @property
    def keyframes(self) -> int:
        """How many have a pose."""
        return sum(len(poses) for poses in self.T_map_camera.values())
