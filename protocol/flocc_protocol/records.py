"""Log records: what a robot appends to its replicated log, and nothing else ever changes.

A record's number in its log is its position, counted from 0 without gaps. Each replica chains the records' bytes
into a checksum, so that a fork (two writers of one log) is noticed and refused.
"""

import zlib
from dataclasses import dataclass

import numpy as np

from flocc_protocol.arrays import Array
from flocc_protocol.codec import (
    ARRAY,
    COORDINATE_MAX,
    COUNT,
    KEYFRAME_ID,
    POSE,
    Codec,
    Pose7,
    from_bytes,
    integer,
    optional,
    real,
    struct,
    text,
    to_bytes,
)
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import KeyframeId

RECORD_BYTES_MAX = 8 * 1024
SIGNATURE_BYTES = 64
SEALED_RECORD_BYTES_MAX = RECORD_BYTES_MAX + SIGNATURE_BYTES
DESCRIPTOR_DIMENSION_MAX = 2048
REASON_LENGTH_MAX = 80
UPPER_TRIANGLE = 21
SCALE_INITIAL_MIN, SCALE_INITIAL_MAX = 1e-9, 1e9


@dataclass(frozen=True, slots=True)
class KeyframeRecord:
    """A keyframe: its number, stamp, odometry and place descriptor.

    Attributes:
        index: Number of the keyframe in this log, counted from 0 without gaps.
        stamp_s: Time of the image on the robot's own clock, seconds.
        T_odom_camera: Camera pose in the robot's odom frame, metric.
        descriptor: Place descriptor, or None where describing failed.
    """

    index: int
    stamp_s: float
    T_odom_camera: Pose7
    descriptor: Array | None

    def __post_init__(self) -> None:
        shape = (1,) if self.descriptor is None else self.descriptor.shape
        if len(shape) != 1 or not 1 <= shape[0] <= DESCRIPTOR_DIMENSION_MAX:
            raise ValueError(f"a descriptor is a vector of 1 to {DESCRIPTOR_DIMENSION_MAX}, not {shape}")


@dataclass(frozen=True, slots=True)
class ClosureRecord:
    """An accepted loop closure.

    Attributes:
        query: Keyframe i of robot alpha.
        match: Keyframe j of robot beta.
        T_query_match_unscaled: Pose of the match camera in the query camera, translation in network units.
        correspondences: Of the loop pair, Eq. (1).
        odometry_correspondences: Of the odometry pair, Eq. (1).
        match_ratio: Eq. (1).
        scale_initial: Metres per network unit, Eq. (6), or None.
        covariance: Upper triangle (21) of the 6x6 covariance in float32, or None.
    """

    query: KeyframeId
    match: KeyframeId
    T_query_match_unscaled: Pose7
    correspondences: int
    odometry_correspondences: int
    match_ratio: float
    scale_initial: float | None = None
    covariance: Array | None = None

    def __post_init__(self) -> None:
        if self.query == self.match:
            raise ValueError(f"a closure joins two different keyframes, not {self.query} with itself")
        if self.covariance is not None and self.covariance.shape != (UPPER_TRIANGLE,):
            raise ValueError(f"a covariance is an upper triangle of {UPPER_TRIANGLE}")


@dataclass(frozen=True, slots=True)
class RejectionRecord:
    """A candidate that was registered and refused, with the reason; nobody registers it again."""

    query: KeyframeId
    match: KeyframeId
    reason: str
    correspondences: int
    odometry_correspondences: int

    def __post_init__(self) -> None:
        if self.query == self.match:
            raise ValueError(f"a rejection joins two different keyframes, not {self.query} with itself")


@dataclass(frozen=True, slots=True)
class FixRecord:
    """An absolute position of a keyframe's camera in a world frame, with its covariance (9 values, m^2)."""

    index: int
    position_m: Array
    covariance_m2: Array

    def __post_init__(self) -> None:
        if self.position_m.shape != (3,) or self.covariance_m2.shape != (9,):
            raise ValueError("a fix has a position of 3 and a covariance of 9")
        if np.max(np.abs(self.position_m.numpy())) > COORDINATE_MAX:
            raise ValueError("a fix must be within the map")


Record = KeyframeRecord | ClosureRecord | RejectionRecord | FixRecord


_STAMP = real(-1e12, 1e12)
_BY_CODE: dict[int, Codec[Record]] = {
    1: struct(KeyframeRecord, index=COUNT, stamp_s=_STAMP, T_odom_camera=POSE, descriptor=optional(ARRAY)),
    2: struct(
        ClosureRecord,
        query=KEYFRAME_ID,
        match=KEYFRAME_ID,
        T_query_match_unscaled=POSE,
        correspondences=COUNT,
        odometry_correspondences=COUNT,
        match_ratio=real(0.0, 1e6),
        scale_initial=optional(real(SCALE_INITIAL_MIN, SCALE_INITIAL_MAX)),
        covariance=optional(ARRAY),
    ),
    3: struct(
        RejectionRecord,
        query=KEYFRAME_ID,
        match=KEYFRAME_ID,
        reason=text(REASON_LENGTH_MAX),
        correspondences=COUNT,
        odometry_correspondences=COUNT,
    ),
    4: struct(FixRecord, index=COUNT, position_m=ARRAY, covariance_m2=ARRAY),
}
_CODES: dict[type[Record], int] = {KeyframeRecord: 1, ClosureRecord: 2, RejectionRecord: 3, FixRecord: 4}
_CODE = integer(1, max(_BY_CODE))


def encode_record(record: Record) -> bytes:
    """Serialise a record; the same record gives the same bytes on every robot.

    Raises:
        ValueError: The other robots would refuse it; a log must never hold such a record.
    """
    code = _CODES[type(record)]
    try:
        data = to_bytes([code, _BY_CODE[code].pack(record)])
    except DecodeError as error:
        raise ValueError(f"{type(record).__name__}: {error}") from error
    if len(data) > RECORD_BYTES_MAX:
        raise ValueError(f"{type(record).__name__} of {len(data)} bytes is larger than {RECORD_BYTES_MAX}")
    return data


def decode_record(data: bytes) -> Record:
    """Parse and check a record.

    Raises:
        DecodeError: The bytes are anything else.
    """
    value = from_bytes(data, RECORD_BYTES_MAX)
    if type(value) is not list or len(value) != 2:
        raise DecodeError("a record is a code and its fields")
    return _BY_CODE[_CODE.unpack(value[0])].unpack(value[1])


def chain(before: int, record_bytes: bytes) -> int:
    """Checksum (32 bit) of a log after one more record; 0 is the checksum of an empty log."""
    return zlib.crc32(record_bytes, before)
