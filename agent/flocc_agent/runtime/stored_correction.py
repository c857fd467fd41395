"""The form in which a store keeps an applied correction: its own, whatever the messages of a version look like.

A message is understood by one protocol version; a store is opened by many. So what is kept starts with the number of
its form, and a later form keeps a reader for the earlier ones (docs/compatibility.md).
"""

from typing import Any

import numpy as np

from flocc_protocol.arrays import Array
from flocc_protocol.codec import (
    ARRAY,
    COUNT,
    FRAME,
    LOG_ID,
    POSE,
    TERM,
    Pose7,
    blob,
    from_bytes,
    integer,
    optional,
    struct,
    to_bytes,
)
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import LogId, Term
from flocc_protocol.log_corrections import KNOTS
from flocc_protocol.messages import MESSAGE_BYTES_MAX, Knots, LogCorrection
from flocc_protocol.records import SIGNATURE_BYTES

FORM = 2


_FIELDS = struct(
    LogCorrection,
    log=LOG_ID,
    term=TERM,
    round=COUNT,
    anchor=LOG_ID,
    T_map_odom=FRAME,
    knots=optional(KNOTS),
    signature=blob(SIGNATURE_BYTES),
)


def _of_form_1(
    log: LogId,
    term: Term,
    round: int,
    anchor: LogId,
    T_map_odom: Pose7,
    covariance: Array | None,
    first: int,
    step: int,
    T_map_camera: Array,
    signature: bytes,  # noqa: ARG001  # of other bytes than today's
) -> LogCorrection:
    """Poses were listed then; without the odometry they only say where the odom frame lay at the last of them."""
    last = first + step * max(T_map_camera.shape[0] - 1, 0)
    numbers = np.zeros(3), np.array([last]), np.zeros((1, 6))
    about, keyframes, twists = (Array.of(n, dtype) for n, dtype in zip(numbers, ("f8", "u4", "f4"), strict=True))
    return LogCorrection(log, term, round, anchor, T_map_odom, Knots(covariance, about, keyframes, twists))


_FIELDS_1 = struct(
    _of_form_1,
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
_FORMS = {1: _FIELDS_1, FORM: _FIELDS}


def stored(correction: LogCorrection) -> bytes:
    """A correction as a store keeps it."""
    return to_bytes([FORM, *_FIELDS.pack(correction)])


def correction_in(data: bytes) -> LogCorrection | None:
    """Read what `stored` gave; None where it is of a later form, or damaged: the next correction takes its place."""
    try:
        value = from_bytes(data, MESSAGE_BYTES_MAX)
        form = _FORMS.get(value[0]) if type(value) is list and value and type(value[0]) is int else None
        return None if form is None else form.unpack(value[1:])
    except DecodeError:
        return None


def from_envelope(robot: str, data: bytes) -> bytes | None:
    """What the store of schema 0 kept: a message of protocol version 2 with the correction of one robot among others.

    Written out, because it must read that version's bytes for ever: [2, kind, sender, [[[fields, signature], ...]]].
    """
    try:
        version, _, _, (pairs,) = from_bytes(data, MESSAGE_BYTES_MAX)
        found = [(_fields_of(packed), signature) for packed, signature in pairs] if version == 2 else []
        return next((to_bytes([1, *values, sig]) for values, sig in found if values[0][0] == robot), None)
    except (DecodeError, ValueError, TypeError, IndexError):
        return None


def _fields_of(packed: bytes) -> list[Any]:
    values: list[Any] = from_bytes(packed, MESSAGE_BYTES_MAX)
    return values
