"""Log records: what a robot appends to its replicated log, and nothing else ever changes.

A record's number in its log is its position, counted from 0 without gaps. Each replica chains the records' bytes
into a checksum, so that a fork (two writers of one log) is noticed and refused.

Records outlive versions (docs/compatibility.md): a record of a code that this version does not know, or with more
fields than it knows, is an `UnknownRecord`. It is kept and passed on byte for byte, and nothing is derived from it.
"""

import zlib
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from flocc_protocol.arrays import Array
from flocc_protocol.codec import (
    ARRAY,
    COORDINATE_MAX,
    COUNT,
    KEYFRAME_ID,
    LOG_ID,
    POSE,
    Codec,
    Pose7,
    Reader,
    blob,
    boolean,
    from_bytes,
    listed,
    optional,
    packed,
    real,
    struct,
    text,
)
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import KeyframeId, LogId, checked_name

RECORD_BYTES_MAX = 8 * 1024
SIGNATURE_BYTES = 64
SHA256_BYTES = 32
SEALED_RECORD_BYTES_MAX = RECORD_BYTES_MAX + SIGNATURE_BYTES
DESCRIPTOR_DIMENSION_MAX = 2048
REASON_LENGTH_MAX = 80
UPPER_TRIANGLE = 21
TAG_LENGTH_MAX = 64
NAME_LENGTH_MAX = 32
WITHDRAWN_MAX = 1024
"""Keyframes that one record takes back."""
ALTITUDE_MAX_M = 1e5
SCALE_INITIAL_MIN, SCALE_INITIAL_MAX = 1e-9, 1e9


def checked_descriptor(descriptor: Array) -> Array:
    """The same.

    Raises:
        ValueError: No record holds it.
    """
    if len(descriptor.shape) != 1 or not 1 <= descriptor.shape[0] <= DESCRIPTOR_DIMENSION_MAX:
        raise ValueError(f"a descriptor is a vector of 1 to {DESCRIPTOR_DIMENSION_MAX}, not {descriptor.shape}")
    return descriptor


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
        if self.descriptor is not None:
            checked_descriptor(self.descriptor)


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
    """A candidate that was refused, with the reason: registered, or unseen where no counts are given."""

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
        _check_position(self.position_m)


@dataclass(frozen=True, slots=True)
class GeodeticFixRecord:
    """Where a keyframe's camera was on the WGS 84 ellipsoid, with its covariance east, north, up (9 values, m^2)."""

    index: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    covariance_m2: Array

    def __post_init__(self) -> None:
        _check_covariance(self.covariance_m2, 9)


@dataclass(frozen=True, slots=True)
class PoseFixRecord:
    """The whole pose of a keyframe's camera in a world frame, such as a known start."""

    index: int
    T_world_camera: Pose7
    covariance: Array

    def __post_init__(self) -> None:
        _check_covariance(self.covariance, UPPER_TRIANGLE)


@dataclass(frozen=True, slots=True)
class TagSightingRecord:
    """A tag seen by a keyframe's camera; its name is the same for all robots."""

    index: int
    tag: str
    T_camera_tag: Pose7
    covariance: Array

    def __post_init__(self) -> None:
        _check_covariance(self.covariance, UPPER_TRIANGLE)


@dataclass(frozen=True, slots=True)
class RobotSightingRecord:
    """Another robot seen from a keyframe: the whole pose of its camera at the keyframe's stamp."""

    index: int
    robot: str
    T_camera_seen: Pose7
    covariance: Array

    def __post_init__(self) -> None:
        checked_name(self.robot)
        _check_covariance(self.covariance, UPPER_TRIANGLE)


@dataclass(frozen=True, slots=True)
class RobotBearingRecord:
    """Another robot seen from a keyframe, by bearing and range: the position (3) of its camera, covariance (9, m^2)."""

    index: int
    robot: str
    position_m: Array
    covariance_m2: Array

    def __post_init__(self) -> None:
        checked_name(self.robot)
        _check_covariance(self.covariance_m2, 9)
        _check_position(self.position_m)


@dataclass(frozen=True, slots=True)
class MetricClosureRecord:
    """A registration of a user's own between two keyframes, in metres."""

    query: KeyframeId
    match: KeyframeId
    T_query_match: Pose7
    covariance: Array

    def __post_init__(self) -> None:
        if self.query == self.match:
            raise ValueError(f"a closure joins two different keyframes, not {self.query} with itself")
        _check_covariance(self.covariance, UPPER_TRIANGLE)


@dataclass(frozen=True, slots=True)
class OdometryCovarianceRecord:
    """How exact the odometry is from the keyframe before to this one, in the tangent of this one's camera."""

    index: int
    covariance: Array

    def __post_init__(self) -> None:
        _check_covariance(self.covariance, UPPER_TRIANGLE)


@dataclass(frozen=True, slots=True)
class LatentRecord:
    """What a keyframe's latent is, in swarms with keys: SHA-256 (32 bytes) of it as it is sent, in one or two forms."""

    index: int
    sha256: bytes

    def __post_init__(self) -> None:
        if len(self.sha256) not in (SHA256_BYTES, 2 * SHA256_BYTES):
            raise ValueError(f"a latent has one or two hashes of {SHA256_BYTES} bytes, not {len(self.sha256)} bytes")

    def names(self, sha256: bytes) -> bool:
        """Whether bytes of this hash are the latent."""
        return sha256 in (self.sha256[:SHA256_BYTES], self.sha256[SHA256_BYTES:])


@dataclass(frozen=True, slots=True)
class WithdrawalRecord:
    """Keyframes whose latents showed what is not the scene: what was judged of these before does not count.

    In the log that it names, its robot takes them back. In another one, that robot says that what it judges from here
    on is of the latents that were made anew.

    Attributes:
        log: Of the keyframes.
        first: The first of them.
        end: The first one after them.
        is_final: No latent will be better, so that nothing of them counts.
    """

    log: LogId
    first: int
    end: int
    is_final: bool

    def __post_init__(self) -> None:
        if not 0 < self.end - self.first <= WITHDRAWN_MAX:
            raise ValueError(f"a withdrawal is of 1 to {WITHDRAWN_MAX} keyframes, not of {self.first} to {self.end}")


@dataclass(frozen=True, slots=True)
class UnknownRecord:
    """A record of a later version: its code and all its bytes, the code among them.

    Attributes:
        code: Number of its kind; a known one where it has more fields than this version knows.
        data: The record, byte for byte as its writer encoded it.
    """

    code: int
    data: bytes


MeasurementRecord = (
    FixRecord
    | GeodeticFixRecord
    | PoseFixRecord
    | TagSightingRecord
    | RobotSightingRecord
    | RobotBearingRecord
    | MetricClosureRecord
    | OdometryCovarianceRecord
)
Record = (
    KeyframeRecord
    | ClosureRecord
    | RejectionRecord
    | MeasurementRecord
    | LatentRecord
    | WithdrawalRecord
    | UnknownRecord
)
KEYFRAME_CODE = 1
JUDGEMENT_CODES = (2, 3)
"""Of closures and rejections."""
CODE_MAX = 127
"""A code is one byte of msgpack, the second one of a record."""
PAIR_HEADER = 0x92
"""First byte of every record: a msgpack array of two, its code and its fields."""
_SHORT_LIST = 0x90
_LIST_SIZE_BYTES = {0xDC: 2, 0xDD: 4}
_INT8_VECTOR = b"\x94\xa2i1\x91"
"""How an array of int8 in one dimension begins: a list of four, the code, a list of one."""
_UINT_BYTES = {0xCC: 1, 0xCD: 2, 0xCE: 4}
_BIN_BYTES = {0xC4: 1, 0xC5: 2, 0xC6: 4}


_STAMP = real(-1e12, 1e12)
_BY_CODE: dict[int, Codec[Any]] = {
    KEYFRAME_CODE: struct(KeyframeRecord, index=COUNT, stamp_s=_STAMP, T_odom_camera=POSE, descriptor=optional(ARRAY)),
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
    5: struct(
        GeodeticFixRecord,
        index=COUNT,
        latitude_deg=real(-90.0, 90.0),
        longitude_deg=real(-180.0, 180.0),
        altitude_m=real(-ALTITUDE_MAX_M, ALTITUDE_MAX_M),
        covariance_m2=ARRAY,
    ),
    6: struct(PoseFixRecord, index=COUNT, T_world_camera=POSE, covariance=ARRAY),
    7: struct(TagSightingRecord, index=COUNT, tag=text(TAG_LENGTH_MAX), T_camera_tag=POSE, covariance=ARRAY),
    8: struct(RobotSightingRecord, index=COUNT, robot=text(NAME_LENGTH_MAX), T_camera_seen=POSE, covariance=ARRAY),
    9: struct(RobotBearingRecord, index=COUNT, robot=text(NAME_LENGTH_MAX), position_m=ARRAY, covariance_m2=ARRAY),
    10: struct(MetricClosureRecord, query=KEYFRAME_ID, match=KEYFRAME_ID, T_query_match=POSE, covariance=ARRAY),
    11: struct(OdometryCovarianceRecord, index=COUNT, covariance=ARRAY),
    12: struct(LatentRecord, index=COUNT, sha256=blob(2 * SHA256_BYTES)),
    13: struct(WithdrawalRecord, log=LOG_ID, first=COUNT, end=COUNT, is_final=boolean()),
}
_CODES: dict[type[Record], int] = {
    KeyframeRecord: 1,
    ClosureRecord: 2,
    RejectionRecord: 3,
    FixRecord: 4,
    GeodeticFixRecord: 5,
    PoseFixRecord: 6,
    TagSightingRecord: 7,
    RobotSightingRecord: 8,
    RobotBearingRecord: 9,
    MetricClosureRecord: 10,
    OdometryCovarianceRecord: 11,
    LatentRecord: 12,
    WithdrawalRecord: 13,
}
_FIELDS = {_CODES[kind]: len(fields(kind)) for kind in _CODES}


def _reader(codec: Codec[Any]) -> Reader[Record]:
    build = codec.build
    assert build is not None
    return Reader(Codec(packed, listed(int, codec.wire), lambda raw: build(raw[1])), RECORD_BYTES_MAX)


_READERS = {code: _reader(codec) for code, codec in _BY_CODE.items()}


def _check_covariance(covariance: Array, size: int) -> None:
    if covariance.shape != (size,):
        raise ValueError(f"a covariance has {size} numbers here, not {covariance.shape}")


def _check_position(position_m: Array) -> None:
    if position_m.shape != (3,) or not np.max(np.abs(position_m.numpy())) <= COORDINATE_MAX:
        raise ValueError("a position has three numbers and must be within the map")


def encode_record(record: Record) -> bytes:
    """Serialise a record; the same record gives the same bytes on every robot.

    Raises:
        ValueError: The other robots would refuse it; a log must never hold such a record.
    """
    if isinstance(record, UnknownRecord):
        return record.data
    code = _CODES[type(record)]
    try:
        data = packed([code, _BY_CODE[code].pack(record)])
    except DecodeError as error:
        raise ValueError(f"{type(record).__name__}: {error}") from error
    if len(data) > RECORD_BYTES_MAX:
        raise ValueError(f"{type(record).__name__} of {len(data)} bytes is larger than {RECORD_BYTES_MAX}")
    return data


def decode_record(data: bytes) -> Record:
    """Parse and check a record; one of a later version is not looked into.

    Raises:
        DecodeError: The bytes are no record of any version.
    """
    code = code_of(data)
    if code not in _BY_CODE:
        return UnknownRecord(code, data)
    if _is_longer(data, _FIELDS[code]):
        from_bytes(data, RECORD_BYTES_MAX)
        return UnknownRecord(code, data)
    return _READERS[code](data)


def _is_longer(data: bytes, fields_known: int) -> bool:
    """Whether a record announces more fields than this version knows."""
    size_bytes = _LIST_SIZE_BYTES.get(data[2])
    if size_bytes is not None:
        return int.from_bytes(data[3 : 3 + size_bytes], "big") > fields_known
    return data[2] & 0xF0 == _SHORT_LIST and data[2] & 0x0F > fields_known


def code_of(data: bytes) -> int:
    """Read the code of a record of any version.

    Raises:
        DecodeError: The bytes are too many, or do not start as a record does.
    """
    if len(data) > RECORD_BYTES_MAX:
        raise DecodeError(f"{len(data)} bytes are more than {RECORD_BYTES_MAX}")
    if len(data) < 3 or data[0] != PAIR_HEADER or not 1 <= data[1] <= CODE_MAX:
        raise DecodeError("a record is a code and its fields")
    return data[1]


def int8_descriptor(data: bytes) -> slice | None:
    """Where an encoded keyframe record has its descriptor of int8, whatever follows the record; None without one."""
    at = data.find(_INT8_VECTOR) if data[1] == KEYFRAME_CODE else -1
    if at < 0:
        return None
    size, at = _unsigned(data, at + len(_INT8_VECTOR), _UINT_BYTES)
    length, first = _unsigned(data, at, _BIN_BYTES)
    return slice(first, first + length) if 0 < size == length and first + length <= len(data) else None


def _unsigned(data: bytes, at: int, sizes_bytes: dict[int, int]) -> tuple[int, int]:
    """A number of MessagePack's and where it ends: one of so many bytes after its first, or its first alone."""
    head = data[at] if at < len(data) else 0
    end = at + 1 + sizes_bytes.get(head, 0)
    return (head if end == at + 1 else int.from_bytes(data[at + 1 : end], "big")), end


def chain(before: int, record_bytes: bytes) -> int:
    """Checksum (32 bit) of a log after one more record; 0 is the checksum of an empty log."""
    return zlib.crc32(record_bytes, before)
