"""Corrections: a leader's solution of one log, which anyone may pass on."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flocc_protocol.arrays import Array
from flocc_protocol.codec import (
    ARRAY,
    COORDINATE_MAX,
    COUNT,
    LOG_ID,
    LOGS_MAX,
    MESSAGE_BYTES_MAX,
    POSE,
    QUATERNION_NORM_TOLERANCE,
    REPEATED_MAX,
    TERM,
    Codec,
    Kinds,
    Pose7,
    Reader,
    integer,
    optional,
    packed,
    sequence,
    struct,
)
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import INDEX_MAX, LogId, Term
from flocc_protocol.records import SIGNATURE_BYTES, UPPER_TRIANGLE

CORRECTION_KEYFRAMES_MAX = 1500
CORRECTIONS_MAX = 16
CORRECTIONS_KEPT_MAX = 256


"""Corrections whose bytes are kept, because most are heard from several neighbours and passed on."""


class CorrectionVersion(NamedTuple):
    """Which correction of one log the sender holds."""

    log: LogId
    term: Term
    round: int


@dataclass(frozen=True, slots=True)
class LogCorrection:
    """A leader's correction of one log, which anyone may pass on.

    Attributes:
        log: Whose trajectory is corrected.
        term: Term of the leader that made it.
        round: Number of its optimisation round; (term, round) only grows.
        anchor: The component's anchor, after which the map frame is named.
        T_map_odom: Where the log's odom frame lies in the map.
        covariance: Upper triangle (21) of T_map_odom's covariance, or None.
        first: Number of the first corrected keyframe.
        step: Every `step`-th keyframe is listed; those between are interpolated.
        T_map_camera: (N, 7) float32 poses, translation and quaternion w x y z.
        signature: The leader's, over `encode_correction`; empty where the swarm has no keys.
    """

    log: LogId
    term: Term
    round: int
    anchor: LogId
    T_map_odom: Pose7
    covariance: Array | None
    first: int
    step: int
    T_map_camera: Array
    signature: bytes = b""

    def __post_init__(self) -> None:
        shape = self.T_map_camera.shape
        if self.T_map_camera.dtype != "f4" or len(shape) != 2 or shape[1] != 7 or shape[0] > CORRECTION_KEYFRAMES_MAX:
            raise ValueError(f"a correction has (N, 7) float32 poses, N at most {CORRECTION_KEYFRAMES_MAX}")
        if self.first + self.step * (shape[0] - 1) > INDEX_MAX:
            raise ValueError("a correction ends within its log")
        if self.covariance is not None and self.covariance.shape != (UPPER_TRIANGLE,):
            raise ValueError(f"a covariance is an upper triangle of {UPPER_TRIANGLE}")
        if len(self.signature) not in (0, SIGNATURE_BYTES):
            raise ValueError(f"a signature has {SIGNATURE_BYTES} bytes")
        _check_poses(self.T_map_camera.numpy())


@dataclass(frozen=True, slots=True)
class CorrectionBatch:
    """Corrections of several logs; all together list no more keyframes than one may."""

    corrections: tuple[LogCorrection, ...]

    def __post_init__(self) -> None:
        keyframes = sum(correction.T_map_camera.shape[0] for correction in self.corrections)
        if len(self.corrections) > CORRECTIONS_MAX or keyframes > CORRECTION_KEYFRAMES_MAX:
            raise ValueError(f"{len(self.corrections)} corrections of {keyframes} keyframes do not fit one message")

    @classmethod
    def batched(cls, corrections: Iterable[LogCorrection]) -> "list[CorrectionBatch]":
        """Put any number of corrections, in their order, into messages."""
        batches: list[list[LogCorrection]] = [[]]
        room = CORRECTION_KEYFRAMES_MAX
        for correction in corrections:
            keyframes = correction.T_map_camera.shape[0]
            if keyframes > room or len(batches[-1]) == CORRECTIONS_MAX:
                batches.append([])
                room = CORRECTION_KEYFRAMES_MAX
            batches[-1].append(correction)
            room -= keyframes
        return [cls(tuple(each)) for each in batches if each]


@dataclass(frozen=True, slots=True)
class CorrectionRequest:
    """Please send your corrections of these logs."""

    logs: tuple[LogId, ...]


def _check_poses(poses: NDArray[np.float64]) -> None:
    """Refuse (N, 7) poses that leave the map or whose quaternions are not of unit length."""
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    if np.any(np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE) or np.any(np.abs(poses[:, :3]) > COORDINATE_MAX):
        raise ValueError("a correction's poses lie within the map and have unit quaternions")


_ANY_VERSION = struct(CorrectionVersion, log=LOG_ID, term=TERM, round=COUNT)


@lru_cache(maxsize=REPEATED_MAX)
def _version(raw: Any) -> CorrectionVersion:
    assert _ANY_VERSION.build is not None
    return _ANY_VERSION.build(raw)


def _pack_version(value: CorrectionVersion) -> CorrectionVersion:
    if not 0 <= value.round <= INDEX_MAX:
        raise DecodeError(f"version of the correction of {value.log} is out of range")
    return value


VERSION = Codec(_pack_version, _ANY_VERSION.wire, _version)


def _unsigned(
    log: LogId,
    term: Term,
    round: int,
    anchor: LogId,
    T_map_odom: Pose7,
    covariance: Array | None,
    first: int,
    step: int,
    T_map_camera: Array,
) -> LogCorrection:
    return LogCorrection(log, term, round, anchor, T_map_odom, covariance, first, step, T_map_camera)


_UNSIGNED = struct(
    _unsigned,
    log=LOG_ID,
    term=TERM,
    round=COUNT,
    anchor=LOG_ID,
    T_map_odom=POSE,
    covariance=optional(ARRAY),
    first=COUNT,
    step=integer(1, 2**31 - 1),
    T_map_camera=ARRAY,
)


_read_unsigned = Reader(_UNSIGNED, MESSAGE_BYTES_MAX)


@lru_cache(maxsize=CORRECTIONS_KEPT_MAX)
def encode_correction(correction: LogCorrection) -> bytes:
    """A correction without its signature, as it is on the wire; every relay passes on the same bytes."""
    return packed(_UNSIGNED.pack(correction))


@lru_cache(maxsize=CORRECTIONS_KEPT_MAX)
def _read_correction(data: bytes, signature: bytes) -> LogCorrection:
    unsigned = _read_unsigned(data)
    return replace(unsigned, signature=signature) if signature else unsigned


def _build_correction(raw: tuple[bytes, bytes]) -> LogCorrection:
    try:
        return _read_correction(*raw)
    except ValueError as error:
        raise DecodeError(str(error)) from error


_CORRECTION = Codec(
    lambda correction: [encode_correction(correction), correction.signature],
    tuple[bytes, bytes],
    _build_correction,
)


CODECS: Kinds = {
    "correction": (CorrectionBatch, struct(CorrectionBatch, corrections=sequence(_CORRECTION, CORRECTIONS_MAX))),
    "want-correction": (CorrectionRequest, struct(CorrectionRequest, logs=sequence(LOG_ID, LOGS_MAX))),
}
