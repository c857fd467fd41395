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
    FRAME,
    LOG_ID,
    LOGS_MAX,
    MESSAGE_BYTES_MAX,
    REPEATED_MAX,
    TERM,
    Codec,
    Kinds,
    Pose7,
    Reader,
    optional,
    packed,
    sequence,
    struct,
)
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import INDEX_MAX, LogId, Term
from flocc_protocol.records import SIGNATURE_BYTES, UPPER_TRIANGLE

KNOTS_MAX = 1500
SHORT_WEIGHT = 6
"""A correction without knots has as many bytes as so many knots."""
TURN_MAX_RAD = 4.0
TWIST_MAX_M = 1e8
CORRECTIONS_MAX = 64
KNOT_REQUESTS_MAX = 64
CORRECTIONS_KEPT_MAX = 1024
"""Corrections whose bytes are kept, because most are heard from several neighbours and passed on."""


class CorrectionVersion(NamedTuple):
    """Which correction of one log the sender holds."""

    log: LogId
    term: Term
    round: int


@dataclass(frozen=True, slots=True)
class Knots:
    """How a log's odometry was corrected at some of its keyframes; between two the twist is interpolated.

    With p the point `about_odom_m`, a keyframe's camera is at
    `T_map_odom @ translation(p) @ exp(twist) @ translation(-p) @ T_odom_camera`, so that numbers stay small wherever
    the frames have their origins.

    Attributes:
        covariance: Upper triangle (21) of T_map_odom's covariance, or None.
        about_odom_m: (3,) float64: the point about which twists turn.
        keyframes: (K,) uint32: numbers of the keyframes, growing.
        twists: (K, 6) float32: rotation (rad), then translation (m).
    """

    covariance: Array | None
    about_odom_m: Array
    keyframes: Array
    twists: Array

    def __post_init__(self) -> None:
        count = self.keyframes.shape[0] if len(self.keyframes.shape) == 1 else 0
        if self.keyframes.dtype != "u4" or not 1 <= count <= KNOTS_MAX:
            raise ValueError(f"a correction has 1 to {KNOTS_MAX} knots")
        if self.twists.dtype != "f4" or self.twists.shape != (count, 6):
            raise ValueError("a correction has a twist of six float32 for each knot")
        if self.about_odom_m.dtype != "f8" or self.about_odom_m.shape != (3,):
            raise ValueError("twists turn about a point of three float64")
        if self.covariance is not None and self.covariance.shape != (UPPER_TRIANGLE,):
            raise ValueError(f"a covariance is an upper triangle of {UPPER_TRIANGLE}")
        _check_numbers(self.keyframes.numpy(), self.about_odom_m.numpy(), self.twists.numpy())

    def __len__(self) -> int:
        return self.keyframes.shape[0]


def _check_numbers(keyframes: NDArray[np.float64], about: NDArray[np.float64], twists: NDArray[np.float64]) -> None:
    if np.any(np.diff(keyframes) <= 0) or keyframes[-1] > INDEX_MAX:
        raise ValueError("a correction's knots are in the order of their keyframes")
    if np.any(np.abs(about) > COORDINATE_MAX) or np.any(np.abs(twists[:, 3:]) > TWIST_MAX_M):
        raise ValueError("a correction's knots lie within the map")
    if np.any(np.abs(twists[:, :3]) > TURN_MAX_RAD):
        raise ValueError(f"a knot turns by at most {TURN_MAX_RAD} rad")


@dataclass(frozen=True, slots=True)
class LogCorrection:
    """A leader's correction of one log, which anyone may pass on: in short for everybody, with its knots for its owner.

    Attributes:
        log: Whose trajectory is corrected.
        term: Term of the leader that made it.
        round: Number of its optimisation round; (term, round) only grows.
        anchor: The component's anchor, after which the map frame is named.
        T_map_odom: Where the log's odom frame lies in the map, at the last keyframe that was corrected.
        knots: How earlier keyframes were corrected; None in short.
        signature: The leader's, over `encode_correction`; empty where the swarm has no keys.
    """

    log: LogId
    term: Term
    round: int
    anchor: LogId
    T_map_odom: Pose7
    knots: Knots | None = None
    signature: bytes = b""

    def __post_init__(self) -> None:
        if len(self.signature) not in (0, SIGNATURE_BYTES):
            raise ValueError(f"a signature has {SIGNATURE_BYTES} bytes")

    @property
    def version(self) -> "CorrectionVersion":
        """Which one it is."""
        return CorrectionVersion(self.log, self.term, self.round)

    @property
    def weight(self) -> int:
        """Knots of which a message may hold `KNOTS_MAX`; one in short counts as some of them."""
        return SHORT_WEIGHT + (0 if self.knots is None else len(self.knots))


@dataclass(frozen=True, slots=True)
class CorrectionBatch:
    """Corrections of several logs; all together have no more knots than one may."""

    corrections: tuple[LogCorrection, ...]

    def __post_init__(self) -> None:
        weight = sum(correction.weight for correction in self.corrections)
        if len(self.corrections) > CORRECTIONS_MAX or weight > KNOTS_MAX + SHORT_WEIGHT:
            raise ValueError(f"{len(self.corrections)} corrections of {weight} knots do not fit one message")

    @classmethod
    def batched(cls, corrections: Iterable[LogCorrection]) -> "list[CorrectionBatch]":
        """Put any number of corrections, in their order, into messages."""
        batches: list[list[LogCorrection]] = [[]]
        room = KNOTS_MAX + SHORT_WEIGHT
        for correction in corrections:
            if correction.weight > room or len(batches[-1]) == CORRECTIONS_MAX:
                batches.append([])
                room = KNOTS_MAX + SHORT_WEIGHT
            batches[-1].append(correction)
            room -= correction.weight
        return [cls(tuple(each)) for each in batches if each]


@dataclass(frozen=True, slots=True)
class CorrectionRequest:
    """Please send your corrections of these logs, in short."""

    logs: tuple[LogId, ...]


@dataclass(frozen=True, slots=True)
class KnotRequest:
    """Please send the knots of these corrections, or of later ones of the same logs, or ask who has them."""

    versions: tuple[CorrectionVersion, ...]


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


KNOTS = struct(Knots, covariance=optional(ARRAY), about_odom_m=ARRAY, keyframes=ARRAY, twists=ARRAY)


def _unsigned(
    log: LogId, term: Term, round: int, anchor: LogId, T_map_odom: Pose7, knots: Knots | None
) -> LogCorrection:
    return LogCorrection(log, term, round, anchor, T_map_odom, knots)


_UNSIGNED = struct(
    _unsigned, log=LOG_ID, term=TERM, round=COUNT, anchor=LOG_ID, T_map_odom=FRAME, knots=optional(KNOTS)
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
    "want-knots": (KnotRequest, struct(KnotRequest, versions=sequence(VERSION, KNOT_REQUESTS_MAX))),
}
