"""The form in which a store keeps an applied correction: its own, whatever the messages of a version look like.

A message is understood by one protocol version; a store is opened by many. So what is kept starts with the number of
its form, and a later form keeps a reader for the earlier ones (docs/compatibility.md).
"""

from typing import Any

from flocc_protocol.codec import (
    ARRAY,
    COUNT,
    LOG_ID,
    POSE,
    TERM,
    blob,
    from_bytes,
    integer,
    optional,
    struct,
    to_bytes,
)
from flocc_protocol.errors import DecodeError
from flocc_protocol.messages import MESSAGE_BYTES_MAX, LogCorrection
from flocc_protocol.records import SIGNATURE_BYTES

FORM = 1


_FIELDS = struct(
    LogCorrection,
    log=LOG_ID,
    term=TERM,
    round=COUNT,
    anchor=LOG_ID,
    T_map_odom=POSE,
    covariance=optional(ARRAY),
    first=COUNT,
    step=integer(1, 2**31 - 1),
    T_map_camera=ARRAY,
    signature=blob(SIGNATURE_BYTES),
)


def stored(correction: LogCorrection) -> bytes:
    """A correction as a store keeps it."""
    return to_bytes([FORM, *_FIELDS.pack(correction)])


def correction_in(data: bytes) -> LogCorrection | None:
    """Read what `stored` gave; None where it is of a later form, or damaged: the next correction takes its place."""
    try:
        value = from_bytes(data, MESSAGE_BYTES_MAX)
        return _FIELDS.unpack(value[1:]) if type(value) is list and value[:1] == [FORM] else None
    except DecodeError:
        return None


def from_envelope(robot: str, data: bytes) -> bytes | None:
    """What the store of schema 0 kept: a message of protocol version 2 with the correction of one robot among others.

    Written out, because it must read that version's bytes for ever: [2, kind, sender, [[[fields, signature], ...]]].
    """
    try:
        version, _, _, (pairs,) = from_bytes(data, MESSAGE_BYTES_MAX)
        found = [(_fields_of(packed), signature) for packed, signature in pairs] if version == 2 else []
        return next((to_bytes([FORM, *values, sig]) for values, sig in found if values[0][0] == robot), None)
    except (DecodeError, ValueError, TypeError, IndexError):
        return None


def _fields_of(packed: bytes) -> list[Any]:
    values: list[Any] = from_bytes(packed, MESSAGE_BYTES_MAX)
    return values
