"""Arrays on the wire: dtype, shape and little-endian bytes; int8 carries a scale.

An `Array` is a plain value (comparable, hashable, immutable), so records and messages stay plain values too.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_protocol.errors import DecodeError

ARRAY_BYTES_MAX = 48 * 1024
DIMENSIONS_MAX = 3
_NUMPY = {"f8": "<f8", "f4": "<f4", "f2": "<f2", "i1": "|i1", "u1": "|u1"}


@dataclass(frozen=True, slots=True)
class Array:
    """A dense array: dtype code (f8, f4, f2, i1, u1), shape, bytes, and the value of one int8 step."""

    dtype: str
    shape: tuple[int, ...]
    data: bytes
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.dtype not in _NUMPY:
            raise DecodeError(f"array dtype {self.dtype!r} is not one of {', '.join(_NUMPY)}")
        if len(self.shape) > DIMENSIONS_MAX or any(size < 0 for size in self.shape):
            raise DecodeError(f"array shape {self.shape} is not allowed")
        expected = math.prod(self.shape) * np.dtype(_NUMPY[self.dtype]).itemsize
        if len(self.data) != expected or expected > ARRAY_BYTES_MAX:
            raise DecodeError(f"array {self.dtype}{list(self.shape)} cannot have {len(self.data)} bytes")
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise DecodeError(f"array scale {self.scale} must be positive")

    @classmethod
    def of(cls, values: NDArray[np.generic], dtype: str = "f4") -> "Array":
        """Store values as floats of the given width (or u1), without a scale."""
        stored = np.ascontiguousarray(values, dtype=_NUMPY[dtype])
        return cls(dtype, stored.shape, stored.tobytes())

    @classmethod
    def int8(cls, values: NDArray[np.floating]) -> "Array":
        """Quantise values to int8 with one scale, the largest magnitude at 127."""
        largest = float(np.max(np.abs(values), initial=0.0))
        scale = max(largest / 127.0, float(np.finfo(np.float32).tiny))
        steps = np.clip(np.rint(np.asarray(values, dtype=np.float64) / scale), -127, 127).astype("|i1")
        return cls("i1", steps.shape, steps.tobytes(), scale)

    def numpy(self) -> NDArray[np.float64]:
        """Values as float64, scaled."""
        raw = np.frombuffer(self.data, dtype=_NUMPY[self.dtype]).reshape(self.shape).astype(np.float64)
        return raw * self.scale

    def is_finite(self) -> bool:
        """Whether every value is finite."""
        return bool(np.all(np.isfinite(np.frombuffer(self.data, dtype=_NUMPY[self.dtype]))))
