"""Separators: what robots tell each other in RBCD."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_protocol.arrays import Array
from flocc_protocol.candidate_pairs import OFFERS_MAX, PAIR, CandidatePair
from flocc_protocol.codec import (
    ARRAY,
    COORDINATE_MAX,
    COUNT,
    LOG_ID,
    MESSAGE_BYTES_MAX,
    QUATERNION_NORM_TOLERANCE,
    from_bytes,
    packed,
    sequence,
    struct,
)
from flocc_protocol.ids import LogId
from flocc_protocol.messages import PROTOCOL_VERSION

SEPARATORS_MAX = 200
RANK_MIN, RANK_MAX = 3, 5


@dataclass(frozen=True, slots=True)
class Separators:
    """The sender's present estimate of keyframes that closures join to other robots' (distributed optimisation).

    Attributes:
        anchor: Log after which the frame of the poses is named; poses of two frames are not compared.
        iteration: Counts the sender's block iterations; it only grows.
        epoch: Counts graduations of robust weights; who hears of a later one begins it, too.
        origin: (4, r) float64: where the map frame lies among the poses, as the sender last heard from the anchor.
        origin_iteration: Iteration of the anchor from which that is.
        keyframes: Numbers of the keyframes in the sender's log.
        poses: (N, 4, r) float64: three rows of a 3-frame in r dimensions (a relaxed rotation, transposed), then the
            position, metres.
        pairs: Closures between two robots whose robust weight is the sender's to decide.
        weights: (M,) float32 in [0, 1], one per pair.
    """

    anchor: LogId
    iteration: int
    epoch: int
    origin: Array
    origin_iteration: int
    keyframes: tuple[int, ...]
    poses: Array
    pairs: tuple[CandidatePair, ...]
    weights: Array

    def __post_init__(self) -> None:
        shape = self.poses.shape
        if self.poses.dtype != "f8" or len(shape) != 3 or shape[:2] != (len(self.keyframes), 4):
            raise ValueError("separators have (N, 4, r) float64 poses, one per keyframe")
        if self.origin.dtype != "f8" or self.origin.shape != shape[1:]:
            raise ValueError("the origin is a float64 pose like the separators")
        if not RANK_MIN <= shape[2] <= RANK_MAX or len(self.keyframes) > SEPARATORS_MAX:
            raise ValueError(f"separators have rank {RANK_MIN} to {RANK_MAX} and at most {SEPARATORS_MAX} keyframes")
        if self.weights.dtype != "f4" or self.weights.shape != (len(self.pairs),) or len(self.pairs) > OFFERS_MAX:
            raise ValueError(f"separators have one float32 weight per pair, at most {OFFERS_MAX}")
        _check_lifted(self.poses.numpy())
        _check_lifted(self.origin.numpy()[None])
        if np.any((self.weights.numpy() < 0.0) | (self.weights.numpy() > 1.0)):
            raise ValueError("a robust weight lies in [0, 1]")


def _check_lifted(poses: NDArray[np.float64]) -> None:
    """Refuse (N, 4, r) poses that leave the map or whose frames are not orthonormal."""
    frames = np.clip(poses[:, :3], -2.0, 2.0)
    gram = frames @ np.swapaxes(frames, 1, 2)
    if np.any(np.abs(gram - np.eye(3)) > QUATERNION_NORM_TOLERANCE) or np.any(np.abs(poses[:, 3]) > COORDINATE_MAX):
        raise ValueError("separators lie within the map and have orthonormal frames")


FIELDS = struct(
    Separators,
    anchor=LOG_ID,
    iteration=COUNT,
    epoch=COUNT,
    origin=ARRAY,
    origin_iteration=COUNT,
    keyframes=sequence(COUNT, SEPARATORS_MAX),
    poses=ARRAY,
    pairs=sequence(PAIR, OFFERS_MAX),
    weights=ARRAY,
)


def encoded(sender: LogId, message: Separators) -> bytes:
    """As it would travel: what a message of the wire has around it, too."""
    return packed([PROTOCOL_VERSION, "separators", LOG_ID.pack(sender), FIELDS.pack(message)])


def decoded(data: bytes) -> Separators:
    """What `encoded` wrote."""
    _, _, _, fields = from_bytes(data, MESSAGE_BYTES_MAX)
    return FIELDS.unpack(fields)
