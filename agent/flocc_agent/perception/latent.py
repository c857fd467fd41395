"""Container of a latent: a kind, a small header and named arrays, as bytes; no pickle, every size checked.

Layout: `FLL1`, length of the description (uint32, little-endian), description (JSON), the arrays' raw bytes in the
order of the description. What is read back is exactly what was written, or `BadLatent` says what is wrong.
"""

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.registration import RegistrationFailed, RegistrationFailure
from flocc_protocol.errors import FloccError

MAGIC = b"FLL1"
DESCRIPTION_BYTES_MAX = 64 * 1024
ARRAYS_MAX = 16
DIMENSIONS_MAX = 4
LATENT_BYTES_MAX = 256 * 1024 * 1024
DTYPES = ("|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<f2", "<f4", "<f8")


class BadLatent(FloccError):
    """Bytes that are not a latent of the kind asked for; the message says why."""


class OtherFrontEnd(BadLatent):
    """A latent of another method, model or weights."""


def failed_by(error: BadLatent) -> RegistrationFailed:
    """What comes of a registration whose latents cannot be read together."""
    is_other = isinstance(error, OtherFrontEnd)
    failure = RegistrationFailure.OTHER_FRONT_END if is_other else RegistrationFailure.BAD_LATENT
    return RegistrationFailed(failure, str(error))


@dataclass(frozen=True, slots=True, eq=False)
class Latent:
    """What `unpack` read: the header (JSON values) and the arrays by name, read-only views of the bytes."""

    header: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]


def pack(kind: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Serialise a header of JSON values and named arrays.

    Raises:
        ValueError: A data type that latents do not carry, too many arrays, or a header that JSON cannot hold.
    """
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    described = [[name, array.dtype.str, list(array.shape)] for name, array in contiguous.items()]
    if len(described) > ARRAYS_MAX or any(dtype not in DTYPES for _, dtype, _ in described):
        raise ValueError(f"a latent carries at most {ARRAYS_MAX} arrays of {', '.join(DTYPES)}")
    fields = {"kind": kind, "header": dict(header), "arrays": described}
    description = json.dumps(fields, sort_keys=True, allow_nan=False, separators=(",", ":")).encode()
    parts = [MAGIC, struct.pack("<I", len(description)), description]
    return b"".join(parts + [array.tobytes() for array in contiguous.values()])


def unpack(data: bytes, kind: str) -> Latent:
    """Read what `pack` wrote for this kind.

    Raises:
        BadLatent: Another kind, a size that does not fit, an unknown data type, or a value that is not finite.
    """
    description, offset = _description(data)
    if description.get("kind") != kind:
        raise OtherFrontEnd(f"the latent is of kind {str(description.get('kind'))[:64]!r}, not {kind!r}")
    header, described = description.get("header"), description.get("arrays")
    if not isinstance(header, dict) or not isinstance(described, list) or len(described) > ARRAYS_MAX:
        raise BadLatent("the latent's description lacks its header or its list of arrays")
    arrays: dict[str, NDArray[Any]] = {}
    for entry in described:
        name, dtype, shape = _array_entry(entry)
        count = math.prod(shape)
        if offset + count * dtype.itemsize > len(data):
            raise BadLatent(f"the latent ends inside its array {name!r}")
        array = np.frombuffer(data, dtype, count, offset).reshape(shape)
        if dtype.kind == "f" and not np.all(np.isfinite(array)):
            raise BadLatent(f"the latent's array {name!r} has values that are not finite")
        arrays[name] = array
        offset += count * dtype.itemsize
    if offset != len(data):
        raise BadLatent(f"the latent has {len(data) - offset} bytes more than its arrays need")
    return Latent(header, arrays)


UP_LENGTH_TOLERANCE = 1e-3


def with_up(header: Mapping[str, Any], up: NDArray[np.float64] | None) -> dict[str, Any]:
    """A header that says which way is up, where that is known: (3,) against gravity in the camera frame."""
    return dict(header) if up is None else {**header, "up": [round(float(part), 6) for part in up]}


def up_of(header: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """Which way is up, as `with_up` wrote it; None where the header does not say.

    Raises:
        BadLatent: It says something else than a direction.
    """
    told = header.get("up")
    if told is None:
        return None
    if not isinstance(told, list) or len(told) != 3 or not all(isinstance(part, (int, float)) for part in told):
        raise BadLatent("the latent's direction against gravity is not three numbers")
    up = np.array(told, np.float64)
    length = float(np.linalg.norm(up))
    if not abs(length - 1.0) <= UP_LENGTH_TOLERANCE:
        raise BadLatent("the latent's direction against gravity is not of length one")
    return np.asarray(up / length)


def _description(data: bytes) -> tuple[dict[str, Any], int]:
    """Read the JSON description and the offset behind it."""
    if len(data) > LATENT_BYTES_MAX or len(data) < 8 or data[:4] != MAGIC:
        raise BadLatent("the bytes are not a latent")
    (length,) = struct.unpack_from("<I", data, 4)
    if length > DESCRIPTION_BYTES_MAX or 8 + length > len(data):
        raise BadLatent("the latent's description is cut off or too long")
    try:
        description = json.loads(data[8 : 8 + length], parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise BadLatent("the latent's description is not JSON") from error
    if not isinstance(description, dict):
        raise BadLatent("the latent's description is not an object")
    return description, 8 + length


def _array_entry(entry: object) -> tuple[str, np.dtype[Any], tuple[int, ...]]:
    """Check one [name, dtype, shape] of the description."""
    if not isinstance(entry, list) or len(entry) != 3:
        raise BadLatent("the latent describes an array without name, data type and shape")
    name, dtype, shape = entry
    if not isinstance(name, str) or dtype not in DTYPES or not isinstance(shape, list):
        raise BadLatent(f"the latent's array {str(name)[:64]!r} has an unknown data type or no shape")
    sizes_fit = all(type(size) is int and 0 <= size <= LATENT_BYTES_MAX for size in shape)
    if len(shape) > DIMENSIONS_MAX or not sizes_fit:
        raise BadLatent(f"the latent's array {name[:64]!r} has an impossible shape")
    return name, np.dtype(dtype), tuple(shape)


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not JSON")
