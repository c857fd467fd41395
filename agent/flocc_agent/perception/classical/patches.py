"""Upright gradient histograms of patches on a dense grid, at several sizes: what the global descriptor aggregates.

A patch is 4 x 4 cells of 8 gradient orientations, as SIFT's (Lowe 2004), Hellinger-normalised. Dense and upright
since a place is recognised by all of the image, and a robot's camera rarely rolls.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

PATCH_LENGTH = 128
SIDES_PX = (320, 226, 160)
"""Longer sides that the image is brought to; patches of three sizes."""
CELL_PX = 6
STEP_PX = 8
SMOOTHING_PX = 0.8
CONTRAST_MIN = 60.0
"""Patches with less gradient than this, in sum, are flat and say nothing."""
ORIENTATIONS = 8


def dense_patches(grey: NDArray[np.uint8], hidden: NDArray[np.bool_] | None = None) -> Float32:
    """Describe an image by its patches (N, 128), each of unit length; none for a flat image.

    Args:
        grey: (H, W).
        hidden: (H, W) pixels that no patch may touch.
    """
    patches = np.concatenate([_patches_at(grey, hidden, side_px) for side_px in SIDES_PX])
    total = patches.sum(axis=1, keepdims=True)
    textured = total[:, 0] > CONTRAST_MIN
    return np.asarray(np.sqrt(patches[textured] / total[textured]))


def _patches_at(grey: NDArray[np.uint8], hidden: NDArray[np.bool_] | None, side_px: int) -> Float32:
    """Cells of gradient orientations around the points of a grid, of the image brought to a size."""
    height, width = (max(round(size * side_px / max(grey.shape)), 1) for size in grey.shape)
    reduced = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    maps = _orientation_maps(cv2.GaussianBlur(reduced, (0, 0), SMOOTHING_PX).astype(np.float32))
    border = 2 * CELL_PX
    rows, columns = np.arange(border, height - border + 1, STEP_PX), np.arange(border, width - border + 1, STEP_PX)
    offsets = ((np.arange(4) - 1.5) * CELL_PX).astype(np.intp)
    y = rows[:, None, None, None] + offsets[None, None, :, None]
    x = columns[None, :, None, None] + offsets[None, None, None, :]
    patches = np.asarray(maps[y, x].reshape(-1, PATCH_LENGTH))
    return patches if hidden is None else patches[_shown(hidden, (width, height))[np.ix_(rows, columns)].ravel()]


def _shown(hidden: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Where (H, W) a patch around a pixel touches nothing hidden."""
    reduced = cv2.resize(hidden.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.dilate(reduced, np.ones((4 * CELL_PX, 4 * CELL_PX), np.uint8)) == 0)


def _orientation_maps(grey: Float32) -> Float32:
    """Gradient magnitude by orientation (H, W, 8), averaged over a cell."""
    dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=1)
    dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=1)
    magnitude = cv2.magnitude(dx, dy)
    angle = cv2.phase(dx, dy) * np.float32(ORIENTATIONS / (2.0 * np.pi))
    lower = np.floor(angle)
    upper_share = magnitude * (angle - lower)
    lower_share = magnitude - upper_share
    lower_bin = lower.astype(np.int32) % ORIENTATIONS
    upper_bin = (lower_bin + 1) % ORIENTATIONS
    maps = np.empty((*grey.shape, ORIENTATIONS), np.float32)
    for k in range(ORIENTATIONS):
        share = lower_share * (lower_bin == k) + upper_share * (upper_bin == k)
        maps[:, :, k] = cv2.GaussianBlur(share, (0, 0), 0.5 * CELL_PX)
    return maps
