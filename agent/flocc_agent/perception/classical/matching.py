"""Which features of two images show the same point: mutual nearest neighbours that pass Lowe's ratio test."""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.perception.multiview.view_parameters import Indices, Matched


def mutual_matches(first: NDArray[np.uint8], second: NDArray[np.uint8], distance_ratio_max: float) -> Matched:
    """Match descriptors, the same whichever image comes first.

    Args:
        first: (N, D) uint8 descriptors.
        second: (M, D) uint8 descriptors.
        distance_ratio_max: Largest distance to the nearest over distance to the second nearest, in both directions.

    Returns:
        Indices into first and second, (K,) each, ascending in first.
    """
    if len(first) < 2 or len(second) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    squared = squared_distances(first, second)
    forward, forward_passes = _nearest(squared, distance_ratio_max)
    backward, backward_passes = _nearest(squared.T, distance_ratio_max)
    rows = np.arange(len(first))
    keep = (backward[forward] == rows) & forward_passes & backward_passes[forward]
    return np.flatnonzero(keep), forward[keep]


def squared_distances(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Squared Euclidean distances (N, M) of bytes; exact, since every sum is an integer below 2^24."""
    a, b = first.astype(np.float32), second.astype(np.float32)
    products = a @ b.T
    return np.asarray((a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1)[None, :] - 2.0 * products)


def _nearest(squared: NDArray[np.float32], distance_ratio_max: float) -> tuple[Indices, NDArray[np.bool_]]:
    """Nearest column of every row, and whether it is clearly nearer than the second nearest."""
    rows = np.arange(len(squared))
    nearest = squared.argmin(axis=1)
    first = squared[rows, nearest]
    squared[rows, nearest] = np.inf  # for the second smallest, which is faster than to partition
    second = squared.min(axis=1)
    squared[rows, nearest] = first
    return nearest, first < distance_ratio_max**2 * second
