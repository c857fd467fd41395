"""Shared poses: what two robots tell each other in distributed optimisation."""

from dataclasses import dataclass

import numpy as np

from flocc_protocol.arrays import Array
from flocc_protocol.codec import (
    ARRAY,
    COORDINATE_MAX,
    COUNT,
    LOG_ID,
    POSE,
    QUATERNION_NORM_TOLERANCE,
    Kinds,
    Pose7,
    sequence,
    struct,
)
from flocc_protocol.ids import LogId

SHARED_MAX = 200
"""Poses that one pair of robots shares at most."""
KNOTS_MAX = 16
"""Of these, whose stiffness is told as a whole."""
_ROW = 13


def stiffness_numbers(count: int) -> int:
    """Numbers in which the stiffness of so many shared poses is told."""
    knots = min(count, KNOTS_MAX)
    return 3 * knots * (6 * knots + 1) + 28 * (count - knots)


@dataclass(frozen=True, slots=True)
class SharedPoses:
    """Where the sender has the poses that it shares with the receiver, and how it is pulled there by all others.

    The poses are those of the higher robot of the pair at the ends of the closures that the lower one uses.

    Attributes:
        anchor: Log after which the frame of the poses is named; poses of two frames are not compared.
        step: Counts the sender's steps; it only grows.
        origin: Where the map frame lies among the poses, as the sender last heard from the anchor.
        origin_step: Step of the anchor from which that is.
        edition: Of the list of shared poses, which the lower robot makes: rising numbers; 0 where the sender has none.
        keyframes: That list, numbers in the higher robot's log, rising; empty where the receiver has it.
        information: (S, 2) float32 of the closures there, of rotation (1/rad^2) and translation (1/m^2), with the list.
        base_m: (3,) float64, from which positions are told.
        rows: (S, 13) float32 of each pose position (m), quaternion w x y z, and force: the gradient, rotation first, in
            the pose's own tangent, of all that the sender knows but by the receiver.
        known: `stiffness_number` of the receiver that the sender has, of this list; 0 for none.
        stiffness_number: From the lower robot: of the penalty by which this is said. From the higher one: of how stiff
            it holds the poses. The step after which its sender made it; 0 for none.
        stiffness: (N,) float32 as `backend/shared_stiffness.py` packs it; empty where the receiver has it.
    """

    anchor: LogId
    step: int
    origin: Pose7
    origin_step: int
    edition: int
    keyframes: tuple[int, ...]
    information: Array
    base_m: Array
    rows: Array
    known: int
    stiffness_number: int
    stiffness: Array

    def __post_init__(self) -> None:
        count = self.rows.shape[0] if self.rows.shape else 0
        if (self.rows.dtype, self.rows.shape) != ("f4", (count, _ROW)) or count > SHARED_MAX:
            raise ValueError(f"shared poses have (S, {_ROW}) float32 rows, at most {SHARED_MAX}")
        if (self.base_m.dtype, self.base_m.shape) != ("f8", (3,)):
            raise ValueError("shared poses are told from a float64 position")
        listed = len(self.keyframes)
        if any(a >= b for a, b in zip(self.keyframes, self.keyframes[1:], strict=False)):
            raise ValueError("the keyframes of shared poses rise")
        if (self.information.dtype, self.information.shape) != ("f4", (listed, 2)) or listed not in (0, count):
            raise ValueError("a list of shared poses has two float32 informations for each of them")
        if np.any(self.information.numpy() <= 0.0):
            raise ValueError("information of closures is positive")
        told = stiffness_numbers(count) if self.stiffness_number else 0
        if self.stiffness.dtype != "f4" or self.stiffness.shape not in ((0,), (told,)):
            raise ValueError(f"the stiffness of {count} poses has {told} float32 numbers")
        rows = self.rows.numpy()
        norms = np.linalg.norm(rows[:, 3:7], axis=1)
        within = np.abs(rows[:, :3] + self.base_m.numpy()) <= COORDINATE_MAX
        if np.any(np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE) or not np.all(within):
            raise ValueError("shared poses lie within the map and have unit quaternions")

    def __len__(self) -> int:
        return self.rows.shape[0]


CODECS: Kinds = {
    "shared-poses": (
        SharedPoses,
        struct(
            SharedPoses,
            anchor=LOG_ID,
            step=COUNT,
            origin=POSE,
            origin_step=COUNT,
            edition=COUNT,
            keyframes=sequence(COUNT, SHARED_MAX),
            information=ARRAY,
            base_m=ARRAY,
            rows=ARRAY,
            known=COUNT,
            stiffness_number=COUNT,
            stiffness=ARRAY,
        ),
    )
}
