"""Small field codecs that turn values into MessagePack and back, checking everything both ways.

A codec says three things: of what type and within which limits its value is on the wire (`wire`, checked by msgspec
while it reads the bytes), what is made of that (`build`, None where it is the value), and how a value is packed.
`struct` lists a dataclass's fields once; nothing is decoded that it does not name. The checks on the way out are those
on the way in: a robot cannot send what every other robot would refuse.
"""

import inspect
import math
import operator
import struct as binary
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from types import GenericAlias
from typing import Annotated, Any, Generic, TypeVar

import msgpack
import msgspec
from msgspec import Meta

from flocc_protocol.arrays import DIMENSIONS_MAX, Array
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import INDEX_MAX, TERM_COUNTER_MAX, KeyframeId, LogId, Term

T = TypeVar("T")

Pose7 = tuple[float, float, float, float, float, float, float]
"""A pose as seven numbers: translation x y z, quaternion w x y z."""

QUATERNION_NORM_TOLERANCE = 1e-3
COORDINATE_MAX = 1e7
ORIGIN_MAX = 4e7
MESSAGE_BYTES_MAX = 64 * 1024
LOGS_MAX = 256
"""Logs that one message may speak of."""
REPEATED_MAX = 8192
"""Small values of heartbeats that are kept as objects, because most of a heartbeat repeats the last."""
ITEMS_MAX = 256
"""No list on the wire is longer; msgpack reserves memory for what a list's header announces."""


@dataclass(frozen=True, slots=True)
class Codec(Generic[T]):
    """How one kind of value is packed and unpacked; both raise DecodeError for anything else."""

    pack: Callable[[T], Any]
    wire: Any
    build: Callable[[Any], T] | None = None

    def unpack(self, value: Any) -> T:
        """Build the value of what plain MessagePack decoded."""
        try:
            raw = msgspec.convert(value, self.wire, builtin_types=(bytes,))
        except _REFUSALS as error:
            raise DecodeError(_told(error)) from error
        return raw if self.build is None else self.build(raw)


Kinds = dict[str, tuple[type[Any], Codec[Any]]]
"""Kinds of messages: the name on the wire, the class, and how its fields are packed."""

_REFUSALS = (msgspec.MsgspecError, ValueError, RecursionError, OverflowError)


def _told(error: Exception) -> str:
    """What was wrong, in so many words: it may be an author's of garbage."""
    return (str(error) or type(error).__name__)[:150]


class Reader(Generic[T]):
    """Reads the bytes of one kind of value."""

    def __init__(self, codec: Codec[T], bytes_max: int) -> None:
        self._decode = msgspec.msgpack.Decoder(codec.wire).decode
        self._build = codec.build
        self._bytes_max = bytes_max

    def __call__(self, data: bytes | msgspec.Raw) -> T:
        """Parse exactly one value.

        Raises:
            DecodeError: Too long, something else, or bytes left over.
        """
        size = len(data if type(data) is bytes else memoryview(data))
        if size > self._bytes_max:
            raise DecodeError(f"{size} bytes are more than {self._bytes_max}")
        try:
            raw = self._decode(data)
        except _REFUSALS as error:
            raise DecodeError(_told(error)) from error
        return raw if self._build is None else self._build(raw)


def listed(*wires: Any) -> Any:
    """Type of a list of just these values on the wire."""
    return GenericAlias(tuple, wires)


def integer(low: int, high: int) -> Codec[int]:
    """An integer in [low, high]."""

    def pack(value: Any) -> int:
        number = value if type(value) is int else operator.index(value)
        if not low <= number <= high:
            raise DecodeError(f"expected an integer in [{low}, {high}]")
        return number

    return Codec(pack, Annotated[int, Meta(ge=low, le=high)])


def real(low: float = -math.inf, high: float = math.inf) -> Codec[float]:
    """A finite float in [low, high]; an integer is none, and msgspec tells them apart only where it may be either."""

    def check(value: Any) -> float:
        if type(value) is not float or not math.isfinite(value) or not low <= value <= high:
            raise DecodeError(f"expected a finite number in [{low}, {high}]")
        return value

    return Codec(lambda value: check(float(value)), int | float, check)


def text(length_max: int) -> Codec[str]:
    """A string of at most `length_max` characters; longer ones are cut before they are sent."""
    return Codec(lambda value: value[:length_max], Annotated[str, Meta(max_length=length_max)])


def blob(bytes_max: int) -> Codec[bytes]:
    """Bytes, at most `bytes_max`."""

    def pack(value: Any) -> bytes:
        if type(value) is not bytes or len(value) > bytes_max:
            raise DecodeError(f"expected at most {bytes_max} bytes")
        return value

    return Codec(pack, Annotated[bytes, Meta(max_length=bytes_max)])


def boolean() -> Codec[bool]:
    """True or false."""

    def pack(value: Any) -> bool:
        if type(value) is not bool:
            raise DecodeError("expected true or false")
        return value

    return Codec(pack, bool)


def optional(inner: Codec[T]) -> Codec[T | None]:
    """The inner value or nil."""
    build = inner.build
    return Codec(
        lambda value: None if value is None else inner.pack(value),
        inner.wire | None,
        None if build is None else lambda raw: None if raw is None else build(raw),
    )


def sequence(inner: Codec[T], items_max: int) -> Codec[tuple[T, ...]]:
    """At most `items_max` inner values."""
    assert items_max <= ITEMS_MAX
    build = inner.build

    def pack(values: tuple[T, ...]) -> list[Any]:
        if len(values) > items_max:
            raise DecodeError(f"expected a list of at most {items_max}, not {len(values)}")
        return [inner.pack(value) for value in values]

    return Codec(
        pack,
        Annotated[GenericAlias(list, (inner.wire,)), Meta(max_length=items_max)],
        tuple if build is None else lambda items: tuple([build(item) for item in items]),
    )


def struct(make: Callable[..., T], **fields: Codec[Any]) -> Codec[T]:
    """A dataclass as a list of its fields, in its own order; `make` raises ValueError for what cannot be."""
    assert tuple(fields) == tuple(inspect.signature(make).parameters)
    get = operator.attrgetter(*fields)
    packs = tuple((k, codec.pack) for k, codec in enumerate(fields.values()) if codec.pack is not _as_it_is)
    builds = tuple((k, codec.build) for k, codec in enumerate(fields.values()) if codec.build is not None)

    def pack(value: T) -> list[Any]:
        values = list(get(value)) if len(fields) > 1 else [get(value)]
        for k, pack_field in packs:
            values[k] = pack_field(values[k])
        return values

    def build(raw: Any) -> T:
        values = list(raw)
        for k, build_field in builds:
            values[k] = build_field(values[k])
        try:
            return make(*values)
        except ValueError as error:
            raise DecodeError(_told(error)) from error

    return Codec(pack, listed(*(codec.wire for codec in fields.values())), build)


@lru_cache(maxsize=4096)
def _log_id(robot: str, incarnation: int) -> LogId:
    """The same few logs are named in every message; each is checked once."""
    try:
        return LogId(robot, incarnation)
    except ValueError as error:
        raise DecodeError("expected a robot name and an incarnation") from error


def _build_log_id(raw: tuple[str, int]) -> LogId:
    return _log_id(*raw)


def _as_it_is(value: Any) -> Any:
    """Identifiers are checked tuples, which are written as lists."""
    return value


_POSE = binary.Struct("<7d")


def _pack_pose(value: Pose7) -> bytes:
    return _POSE.pack(*_checked_pose(value))


def _build_pose(raw: bytes) -> Pose7:
    return _checked_pose(_POSE.unpack(raw))


def _checked_pose(numbers: Pose7, coordinate_max: float = COORDINATE_MAX) -> Pose7:
    x, y, z, qw, qx, qy, qz = numbers
    if not (abs(x) <= coordinate_max and abs(y) <= coordinate_max and abs(z) <= coordinate_max):
        raise DecodeError("a pose must be finite and within the map")
    if not abs(math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz) - 1.0) <= QUATERNION_NORM_TOLERANCE:
        raise DecodeError("a pose must have a unit quaternion")
    return numbers


def _build_array(raw: tuple[str, list[int], bytes, float]) -> Array:
    dtype, shape, data, scale = raw
    if type(scale) is not float:
        raise DecodeError("the scale of an array is a float")
    try:
        return Array(dtype, tuple(shape), data, scale)
    except ValueError as error:
        raise DecodeError(_told(error)) from error


_SHAPE = Annotated[list[int], Meta(max_length=DIMENSIONS_MAX)]
_POSE_BYTES = Annotated[bytes, Meta(min_length=_POSE.size, max_length=_POSE.size)]
POSE: Codec[Pose7] = Codec(_pack_pose, _POSE_BYTES, _build_pose)
FRAME: Codec[Pose7] = Codec(
    lambda value: _POSE.pack(*_checked_pose(value, ORIGIN_MAX)),
    _POSE_BYTES,
    lambda raw: _checked_pose(_POSE.unpack(raw), ORIGIN_MAX),
)
"""Where the origin of a frame is: two frames within the map may have theirs as far apart as both are wide."""
ARRAY: Codec[Array] = Codec(
    lambda a: [a.dtype, list(a.shape), a.data, float(a.scale)], tuple[str, _SHAPE, bytes, int | float], _build_array
)
COUNT = integer(0, INDEX_MAX)
LOG_ID: Codec[LogId] = Codec(_as_it_is, tuple[str, int], _build_log_id)
KEYFRAME_ID: Codec[KeyframeId] = Codec(
    _as_it_is, listed(LOG_ID.wire, COUNT.wire), lambda raw: KeyframeId(_log_id(*raw[0]), raw[1])
)
TERM: Codec[Term] = Codec(
    _as_it_is, listed(integer(0, TERM_COUNTER_MAX).wire, LOG_ID.wire), lambda raw: Term(raw[0], _log_id(*raw[1]))
)

_encode = msgspec.msgpack.Encoder().encode


def packed(value: Any) -> bytes:
    """Serialise what codecs packed."""
    return _encode(value)


def to_bytes(value: Any) -> bytes:
    """Serialise any MessagePack object, for what is not hot: what a store keeps, tools, tests."""
    data: bytes = msgpack.packb(value, use_bin_type=True)
    return data


def from_bytes(data: bytes, bytes_max: int) -> Any:
    """Parse exactly one MessagePack object of any form, for what is not hot.

    Raises:
        DecodeError: Too long, not msgpack, or bytes left over.
    """
    if len(data) > bytes_max:
        raise DecodeError(f"{len(data)} bytes are more than {bytes_max}")
    try:
        return msgpack.unpackb(data, raw=False, max_map_len=0, max_ext_len=0, max_array_len=ITEMS_MAX)
    except (ValueError, TypeError, RecursionError, OverflowError, msgpack.exceptions.UnpackException) as error:
        raise DecodeError(f"not msgpack: {type(error).__name__}") from error
