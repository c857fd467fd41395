"""Small field codecs that turn values into msgpack objects and back, checking everything both ways.

A codec is a pair of functions. `struct` lists a dataclass's fields once; nothing is decoded that it does not name.
The checks on the way out are those on the way in: a robot cannot send what every other robot would refuse.
"""

import inspect
import math
import operator
import struct as binary
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Generic, TypeVar

import msgpack

from flocc_protocol.arrays import Array
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import INDEX_MAX, TERM_COUNTER_MAX, KeyframeId, LogId, Term

T = TypeVar("T")

Pose7 = tuple[float, float, float, float, float, float, float]
"""A pose as seven numbers: translation x y z, quaternion w x y z."""

QUATERNION_NORM_TOLERANCE = 1e-3
COORDINATE_MAX = 1e7
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
    unpack: Callable[[Any], T]


Kinds = dict[str, tuple[type[Any], Codec[Any]]]
"""Kinds of messages: the name on the wire, the class, and how its fields are packed."""


def integer(low: int, high: int) -> Codec[int]:
    """An integer in [low, high]."""

    def check(value: Any) -> int:
        if type(value) is not int or not low <= value <= high:
            raise DecodeError(f"expected an integer in [{low}, {high}]")
        return value

    return Codec(lambda value: check(operator.index(value)), check)


def real(low: float = -math.inf, high: float = math.inf) -> Codec[float]:
    """A finite float in [low, high]."""

    def check(value: Any) -> float:
        if type(value) is not float or not math.isfinite(value) or not low <= value <= high:
            raise DecodeError(f"expected a finite number in [{low}, {high}]")
        return value

    return Codec(lambda value: check(float(value)), check)


def text(length_max: int) -> Codec[str]:
    """A string of at most `length_max` characters; longer ones are cut before they are sent."""

    def check(value: Any) -> str:
        if type(value) is not str or len(value) > length_max:
            raise DecodeError(f"expected text of at most {length_max} characters")
        return value

    return Codec(lambda value: check(value[:length_max]), check)


def blob(bytes_max: int) -> Codec[bytes]:
    """Bytes, at most `bytes_max`."""

    def check(value: Any) -> bytes:
        if type(value) is not bytes or len(value) > bytes_max:
            raise DecodeError(f"expected at most {bytes_max} bytes")
        return value

    return Codec(check, check)


def boolean() -> Codec[bool]:
    """True or false."""

    def check(value: Any) -> bool:
        if type(value) is not bool:
            raise DecodeError("expected true or false")
        return value

    return Codec(check, check)


def optional(inner: Codec[T]) -> Codec[T | None]:
    """The inner value or nil."""
    return Codec(
        lambda value: None if value is None else inner.pack(value),
        lambda value: None if value is None else inner.unpack(value),
    )


def sequence(inner: Codec[T], items_max: int) -> Codec[tuple[T, ...]]:
    """At most `items_max` inner values."""
    assert items_max <= ITEMS_MAX

    def pack(values: tuple[T, ...]) -> list[Any]:
        if len(values) > items_max:
            raise DecodeError(f"expected a list of at most {items_max}, not {len(values)}")
        return [inner.pack(value) for value in values]

    def unpack(value: Any) -> tuple[T, ...]:
        if type(value) is not list or len(value) > items_max:
            raise DecodeError(f"expected a list of at most {items_max}")
        return tuple([inner.unpack(item) for item in value])

    return Codec(pack, unpack)


def struct(build: Callable[..., T], **fields: Codec[Any]) -> Codec[T]:
    """A dataclass as a list of its fields, in its own order; `build` raises ValueError for what cannot be."""
    assert tuple(fields) == tuple(inspect.signature(build).parameters)
    names = tuple(fields)
    packs = tuple(codec.pack for codec in fields.values())
    unpacks = tuple(codec.unpack for codec in fields.values())

    def pack(value: T) -> list[Any]:
        return [pack_field(getattr(value, name)) for name, pack_field in zip(names, packs, strict=True)]

    def unpack(value: Any) -> T:
        if type(value) is not list or len(value) != len(unpacks):
            raise DecodeError(f"expected {len(unpacks)} fields")
        values = [unpack_field(item) for unpack_field, item in zip(unpacks, value, strict=True)]
        try:
            return build(*values)
        except ValueError as error:
            raise DecodeError(str(error)) from error

    return Codec(pack, unpack)


@lru_cache(maxsize=4096)
def _log_id(robot: str, incarnation: int) -> LogId:
    """The same few logs are named in every message; each is checked once."""
    try:
        return LogId(robot, incarnation)
    except ValueError as error:
        raise DecodeError("expected a robot name and an incarnation") from error


def _unpack_log_id(value: Any) -> LogId:
    if type(value) is not list or len(value) != 2 or type(value[0]) is not str or type(value[1]) is not int:
        raise DecodeError("expected a robot name and an incarnation")
    return _log_id(value[0], value[1])


def _as_it_is(value: Any) -> Any:
    """Identifiers are checked tuples, which msgpack writes as lists."""
    return value


_POSE = binary.Struct("<7d")


def _pack_pose(value: Pose7) -> bytes:
    return _POSE.pack(*_checked_pose(value))


def _unpack_pose(value: Any) -> Pose7:
    if type(value) is not bytes or len(value) != _POSE.size:
        raise DecodeError("expected a pose of seven doubles")
    return _checked_pose(_POSE.unpack(value))


def _checked_pose(numbers: Pose7) -> Pose7:
    if not all(math.isfinite(number) for number in numbers) or max(map(abs, numbers[:3])) > COORDINATE_MAX:
        raise DecodeError("a pose must be finite and within the map")
    if abs(math.sqrt(sum(q * q for q in numbers[3:])) - 1.0) > QUATERNION_NORM_TOLERANCE:
        raise DecodeError("a pose must have a unit quaternion")
    return numbers


def _unpack_array(value: Any) -> Array:
    if type(value) is not list or len(value) != 4:
        raise DecodeError("expected an array of dtype, shape, bytes and scale")
    dtype, shape, data, scale = value
    sizes_ok = type(shape) is list and all(type(size) is int for size in shape)
    if type(dtype) is not str or not sizes_ok or type(data) is not bytes or type(scale) is not float:
        raise DecodeError("expected an array of dtype, shape, bytes and scale")
    try:
        return Array(dtype, tuple(shape), data, scale)
    except ValueError as error:
        raise DecodeError(str(error)) from error


POSE: Codec[Pose7] = Codec(_pack_pose, _unpack_pose)
ARRAY: Codec[Array] = Codec(lambda a: [a.dtype, list(a.shape), a.data, float(a.scale)], _unpack_array)
COUNT = integer(0, INDEX_MAX)
LOG_ID: Codec[LogId] = Codec(_as_it_is, _unpack_log_id)
KEYFRAME_ID = Codec(_as_it_is, struct(KeyframeId, log=LOG_ID, index=COUNT).unpack)
TERM = Codec(_as_it_is, struct(Term, counter=integer(0, TERM_COUNTER_MAX), leader=LOG_ID).unpack)


def to_bytes(value: Any) -> bytes:
    """Serialise a msgpack object."""
    packed: bytes = msgpack.packb(value, use_bin_type=True)
    return packed


def from_bytes(data: bytes, bytes_max: int) -> Any:
    """Parse exactly one msgpack object.

    Raises:
        DecodeError: Too long, not msgpack, or bytes left over.
    """
    if len(data) > bytes_max:
        raise DecodeError(f"{len(data)} bytes are more than {bytes_max}")
    try:
        return msgpack.unpackb(data, raw=False, max_map_len=0, max_ext_len=0, max_array_len=ITEMS_MAX)
    except (ValueError, TypeError, RecursionError, OverflowError, msgpack.exceptions.UnpackException) as error:
        raise DecodeError(f"not msgpack: {type(error).__name__}") from error
