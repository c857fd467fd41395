"""Arrays on the wire: dtype, shape and little-endian bytes; int8 carries a scale.

An `Array` is a plain value (comparable, hashable, immutable), so records and messages stay plain values too. It is
finite and within its limits from construction on: what cannot be received cannot be built either.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

ARRAY_BYTES_MAX = 48 * 1024
DIMENSIONS_MAX = 3
SCALE_MAX = 1e30
_NUMPY = {"f8": "<f8", "f4": "<f4", "f2": "<f2", "i1": "|i1", "u1": "|u1", "u4": "<u4"}
_ITEM_BYTES = {dtype: np.dtype(name).itemsize for dtype, name in _NUMPY.items()}
_ALWAYS_FINITE = frozenset({"i1", "u1", "u4"})


@dataclass(frozen=True, slots=True)
class Array:
    """A dense array: dtype code (f8, f4, f2, i1, u1, u4), shape, bytes, and the value of one int8 step."""

    dtype: str
    shape: tuple[int, ...]
    data: bytes
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.dtype not in _NUMPY:
            raise ValueError(f"array dtype {self.dtype[:8]!r} is not one of {', '.join(_NUMPY)}")
        if len(self.shape) > DIMENSIONS_MAX or not all(0 <= size <= ARRAY_BYTES_MAX for size in self.shape):
            raise ValueError(f"an array has at most {DIMENSIONS_MAX} dimensions of 0 to {ARRAY_BYTES_MAX}")
        expected = math.prod(self.shape) * _ITEM_BYTES[self.dtype]
        if len(self.data) != expected or expected > ARRAY_BYTES_MAX:
            raise ValueError(f"array {self.dtype}{list(self.shape)} cannot have {len(self.data)} bytes")
        if not 0.0 < self.scale <= SCALE_MAX or (self.dtype != "i1" and self.scale != 1.0):
            raise ValueError(f"array {self.dtype} cannot have the scale {self.scale}")
        if self.dtype not in _ALWAYS_FINITE and not np.isfinite(self._stored()).all():
            raise ValueError("an array must be finite")

    @classmethod
    def of(cls, values: NDArray[np.generic], dtype: str = "f4") -> "Array":
        """Store values as floats of the given width (or u1, u4), without a scale.

        Raises:
            ValueError: A value is not finite in that width, or the array is too large.
        """
        stored = np.ascontiguousarray(values, dtype=_NUMPY[dtype])
        return cls(dtype, stored.shape, stored.tobytes())

    @classmethod
    def int8(cls, values: NDArray[np.floating]) -> "Array":
        """Quantise values to int8 with one scale, the largest magnitude at 127; at most half a step is lost.

        Raises:
            ValueError: A value is not finite.
        """
        largest = float(np.max(np.abs(values), initial=0.0))
        if not math.isfinite(largest):
            raise ValueError("an array must be finite")
        scale = max(largest / 127.0, float(np.finfo(np.float32).tiny))
        steps = np.clip(np.rint(np.asarray(values, dtype=np.float64) / scale), -127, 127).astype("|i1")
        return cls("i1", steps.shape, steps.tobytes(), scale)

    def numpy(self) -> NDArray[np.float64]:
        """Values as float64, scaled."""
        return self._stored().astype(np.float64) * self.scale

    def _stored(self) -> NDArray[Any]:
        return np.frombuffer(self.data, dtype=_NUMPY[self.dtype]).reshape(self.shape)
