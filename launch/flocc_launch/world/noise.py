"""Random fields for textures; every one comes from the generator that is passed in."""

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


def smooth_noise(rng: np.random.Generator, rows: int, columns: int, cell: float) -> Float32:
    """Noise of one scale, (rows, columns), mean 0 and deviation about 1; `cell` is its wavelength in texels."""
    grid = rng.standard_normal((max(int(rows / cell), 1) + 3, max(int(columns / cell), 1) + 3)).astype(np.float32)
    size = (int(grid.shape[1] * cell) + 1, int(grid.shape[0] * cell) + 1)
    large = cv2.resize(grid, size, interpolation=cv2.INTER_CUBIC)
    x, y = int(cell), int(cell)
    field = large[y : y + rows, x : x + columns]
    if field.shape != (rows, columns):
        field = cv2.resize(large, (columns, rows), interpolation=cv2.INTER_CUBIC)
    return np.asarray(field, dtype=np.float32)


def fractal_noise(
    rng: np.random.Generator, rows: int, columns: int, cell: float, octaves: int = 4, gain: float = 0.6
) -> Float32:
    """Noise of several scales, each half as long as the one before and weaker by `gain`; deviation about 1."""
    total = np.zeros((rows, columns), dtype=np.float32)
    weight, power = 1.0, 0.0
    for _ in range(octaves):
        total += np.float32(weight) * smooth_noise(rng, rows, columns, max(cell, 1.0))
        power += weight**2
        cell, weight = cell / 2, weight * gain
    return np.asarray(total / np.float32(np.sqrt(power)) * np.float32(1.3), dtype=np.float32)
