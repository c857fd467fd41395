"""Which component of a quaternion comes first, where no header says so.

A wrong order turns every rotation into another one of the same size (the inverse, between two fixed rotations), so
that smoothness shows nothing. What shows it: a trajectory that starts at exactly no rotation; and a body that moves as
bodies do, at a right angle to the axis about which it turns, or always forwards. Each sign must be clear, and none may
contradict; otherwise nobody knows.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Order = Literal["xyzw", "wxyz"]

SAMPLES_MAX = 200
TURNED_MIN_RAD = 0.2
AXIS_SHARE_MIN = 0.85
ACROSS_MAX, ALONG_MIN = 0.25, 0.5
FORWARD_MIN, SIDEWAYS_MAX = 0.95, 0.85
EXACT = 1e-6


def clear_order(positions_m: Float, quaternions: Float) -> Order | None:
    """The order that a trajectory can only have, or None where both can be.

    Args:
        positions_m: (N, 3), in order of time.
        quaternions: (N, 4) of unit length, in the order of the file.
    """
    kept = _spaced(positions_m)
    t, q = positions_m[kept], quaternions[kept]
    readings = {"xyzw": rotations(q[:, [3, 0, 1, 2]]), "wxyz": rotations(q)}
    signs = {start_order(quaternions[0]), _by_axis(t, readings), _by_heading(t, readings)} - {None}
    return signs.pop() if len(signs) == 1 else None


def _spaced(positions_m: Float) -> NDArray[np.intp]:
    """Indices of poses at about equal distances along the path, so that standing still has no weight."""
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions_m, axis=0), axis=1))])
    wanted_m = np.linspace(0.0, along_m[-1], min(SAMPLES_MAX, len(along_m)))
    return np.unique(np.minimum(np.searchsorted(along_m, wanted_m), len(along_m) - 1))


def rotations(q_wxyz: Float) -> Float:
    """Rotations (N, 3, 3) of unit quaternions (N, 4)."""
    w, x, y, z = q_wxyz.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def start_order(first: Float) -> Order | None:
    """The order in which the first quaternion is exactly no rotation."""
    if np.allclose(np.abs(first), [0, 0, 0, 1], atol=EXACT):
        return "xyzw"
    return "wxyz" if np.allclose(np.abs(first), [1, 0, 0, 0], atol=EXACT) else None


def _clear(low: dict[str, float], at_most: float, at_least: float) -> Order | None:
    """The reading whose figure is low, where the other's is high."""
    if low["xyzw"] <= at_most and low["wxyz"] >= at_least:
        return "xyzw"
    return "wxyz" if low["wxyz"] <= at_most and low["xyzw"] >= at_least else None


def _by_axis(t: Float, readings: dict[str, Float]) -> Order | None:
    """Wheels, feet and level flight move at a right angle to the axis about which they turn."""
    steps = np.diff(t, axis=0)
    lengths_m = np.linalg.norm(steps, axis=1)
    if lengths_m.sum() <= 0:
        return None
    across = {}
    for order, R in readings.items():
        turned = R[1:] @ R[:-1].transpose(0, 2, 1)
        off = 0.5 * (turned - turned.transpose(0, 2, 1))
        vectors = np.stack([off[:, 2, 1], off[:, 0, 2], off[:, 1, 0]], axis=1)
        spread, axes = np.linalg.eigh(vectors.T @ vectors)
        if np.linalg.norm(vectors, axis=1).sum() < TURNED_MIN_RAD or spread[2] < AXIS_SHARE_MIN * spread.sum():
            return None
        across[order] = float(np.sqrt(np.sum((steps @ axes[:, 2]) ** 2) / np.sum(lengths_m**2)))
    return _clear(across, ACROSS_MAX, ALONG_MIN)


def _by_heading(t: Float, readings: dict[str, Float]) -> Order | None:
    """Most robots drive where they look."""
    steps = np.diff(t, axis=0)
    lengths_m = np.linalg.norm(steps, axis=1)
    moved = lengths_m > 0
    if np.count_nonzero(moved) < 8:
        return None
    directions = steps[moved] / lengths_m[moved, None]
    sideways = {}
    for order, R in readings.items():
        in_body = np.einsum("nji,nj->ni", R[:-1][moved], directions)
        sideways[order] = 1.0 - float(np.linalg.norm(in_body.mean(axis=0)))
    return _clear(sideways, 1.0 - FORWARD_MIN, 1.0 - SIDEWAYS_MAX)
