"""Protocol buffers, decoded by the descriptors that a file carries, without generated code.

Only what is needed to read messages: scalars, strings, bytes, nested messages, repeated and packed fields.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

DEPTH_MAX = 20

_DOUBLE, _FLOAT, _BOOL, _STRING, _MESSAGE, _BYTES = 1, 2, 8, 9, 11, 12
_FIXED32, _SFIXED32, _FIXED64, _SFIXED64 = 7, 15, 6, 16
_FORMATS = {_DOUBLE: "<d", _FLOAT: "<f", _FIXED32: "<I", _SFIXED32: "<i", _FIXED64: "<Q", _SFIXED64: "<q"}
_REPEATED = 3


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message type."""

    name: str
    kind: int
    is_repeated: bool
    type_name: str


@dataclass(slots=True)
class Types:
    """Message types by full name, each with its fields by number."""

    fields: dict[str, dict[int, Field]] = field(default_factory=dict)

    @classmethod
    def of(cls, descriptor_set: bytes) -> "Types":
        """Types of a serialised FileDescriptorSet.

        Raises:
            ValueError: It is none.
        """
        types = cls()
        for number, file in _fields(descriptor_set):
            if number == 1 and isinstance(file, bytes):
                parts = list(_fields(file))
                package = next((_text(value) for key, value in parts if key == 2), "")
                for key, value in parts:
                    if key == 4 and isinstance(value, bytes):
                        types._add(value, package)
        return types

    def _add(self, message: bytes, scope: str) -> None:
        parts = list(_fields(message))
        name = ".".join(part for part in (scope, next(_text(value) for key, value in parts if key == 1)) if part)
        self.fields[name] = {}
        for key, value in parts:
            if key == 2 and isinstance(value, bytes):
                number, described = _field_of(value)
                self.fields[name][number] = described
            elif key == 3 and isinstance(value, bytes):
                self._add(value, name)

    def decode(self, name: str, raw: bytes, depth: int = 0) -> dict[str, Any]:
        """A message's fields by name; those that are not set are missing.

        Raises:
            ValueError: The bytes are no message of that type.
        """
        if name not in self.fields or depth > DEPTH_MAX:
            raise ValueError(f"the message type {name} is not described")
        found: dict[str, Any] = {}
        for number, value in _fields(raw):
            described = self.fields[name].get(number)
            if described is None:
                continue
            values = list(self._values(described, value, depth))
            if described.is_repeated:
                found.setdefault(described.name, []).extend(values)
            elif values:
                found[described.name] = values[-1]
        return found

    def _values(self, described: Field, value: int | bytes, depth: int) -> Iterator[Any]:
        if described.kind == _MESSAGE and isinstance(value, bytes):
            yield self.decode(described.type_name, value, depth + 1)
        elif described.kind == _STRING:
            yield _text(value)
        elif described.kind == _BYTES:
            yield value
        elif described.kind in _FORMATS and isinstance(value, bytes):
            size = struct.calcsize(_FORMATS[described.kind])
            if len(value) % size:
                raise ValueError(f"{described.name} has {len(value)} bytes")
            yield from (each[0] for each in struct.iter_unpack(_FORMATS[described.kind], value))
        elif isinstance(value, bytes):
            at = 0
            while at < len(value):
                number, at = _varint(value, at)
                yield number
        else:
            yield bool(value) if described.kind == _BOOL else value


def _field_of(raw: bytes) -> tuple[int, Field]:
    values = dict(_fields(raw))
    number, kind, label = (int(values.get(key, 0)) for key in (3, 5, 4))
    return number, Field(_text(values[1]), kind, label == _REPEATED, _text(values.get(6, b"")).lstrip("."))


def _text(value: int | bytes) -> str:
    if not isinstance(value, bytes):
        raise ValueError("a text is a number")
    return value.decode("utf-8", errors="replace")


def _fields(raw: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Numbers and values of a message's fields; fixed numbers stay bytes."""
    at = 0
    while at < len(raw):
        key, at = _varint(raw, at)
        wire = key & 7
        if wire == 0:
            value, at = _varint(raw, at)
            yield key >> 3, value
            continue
        if wire == 2:
            size, at = _varint(raw, at)
        elif wire in (1, 5):
            size = 8 if wire == 1 else 4
        else:
            raise ValueError(f"wire type {wire} is not known")
        if at + size > len(raw):
            raise ValueError("the message ends too early")
        yield key >> 3, raw[at : at + size]
        at += size


def _varint(raw: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(raw):
            raise ValueError("the message ends too early")
        byte = raw[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("a number has too many bytes")
