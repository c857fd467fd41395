"""One image that holds every texture at six scales, so that a whole view is sampled with a few calls of remap.

Slots are aligned to the coarsest scale and padded by their own edge, so a level is half of the level before it,
everywhere, and no texture bleeds into another.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Pixels = NDArray[np.uint8]

LEVELS = 6
CELL: int = 2 ** (LEVELS - 1)
PAD = CELL
WIDTH_MAX = 12288


@dataclass(frozen=True, slots=True, eq=False)
class Atlas:
    """Textures side by side, level 0 at the top and the smaller ones in a row below.

    Attributes:
        pixels: (H, W, C) uint8.
        offsets: (N, 2) float32, x and y of each texture's first texel at level 0.
        level_corners: (2, LEVELS) float32, first column and first row of each level.
    """

    pixels: Pixels
    offsets: Float32
    level_corners: Float32


def pack(textures: list[Pixels], levels: int = LEVELS) -> Atlas:
    """Place textures on shelves, tallest first, and compute the smaller levels."""
    import cv2

    offsets, height = _shelves([texture.shape[:2] for texture in textures])
    channels = textures[0].shape[2]
    base = np.zeros((height, WIDTH_MAX, channels), dtype=np.uint8)
    for texture, (x, y) in zip(textures, offsets, strict=True):
        rows, columns = texture.shape[:2]
        bottom, right = _padding(rows), _padding(columns)
        padded = cv2.copyMakeBorder(texture, PAD, bottom, PAD, right, cv2.BORDER_REPLICATE)
        base[y - PAD : y + rows + bottom, x - PAD : x + columns + right] = padded.reshape(*padded.shape[:2], channels)
    pixels = np.zeros((height + (height + 1) // 2 if levels > 1 else height, WIDTH_MAX, channels), dtype=np.uint8)
    pixels[:height] = base
    corners, column = [(0, 0)], 0
    for _ in range(1, levels):
        base = np.asarray(cv2.resize(base, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        pixels[height : height + base.shape[0], column : column + base.shape[1]] = base
        corners.append((column, height))
        column += base.shape[1]
    return Atlas(pixels, np.array(offsets, dtype=np.float32), np.array(corners, dtype=np.float32).T)


def _padding(length: int) -> int:
    """Texels after a texture, so that its slot ends on a cell."""
    return PAD + (CELL - length % CELL) % CELL


def _shelves(shapes: list[tuple[int, int]]) -> tuple[list[tuple[int, int]], int]:
    offsets: list[tuple[int, int]] = [(0, 0)] * len(shapes)
    x = y = shelf = 0
    for index in sorted(range(len(shapes)), key=lambda i: (-shapes[i][0], i)):
        rows, columns = shapes[index]
        width, height = PAD + columns + _padding(columns), PAD + rows + _padding(rows)
        if width > WIDTH_MAX:
            raise ValueError(f"a texture of {columns} texels does not fit into an atlas of {WIDTH_MAX}")
        if x + width > WIDTH_MAX:
            x, y, shelf = 0, y + shelf, 0
        offsets[index] = (x + PAD, y + PAD)
        x, shelf = x + width, max(shelf, height)
    return offsets, y + shelf
