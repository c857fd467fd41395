"""Rotations in batches: unit quaternions (N, 4), w first, and their matrices (N, 3, 3)."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def matrices(q: Float) -> Float:
    """Rotations (N, 3, 3) of unit quaternions (N, 4), w first."""
    w, x, y, z = q.T
    R = np.empty((len(q), 3, 3))
    R[:, 0, 0] = 1 - 2 * (y * y + z * z)
    R[:, 0, 1] = 2 * (x * y - w * z)
    R[:, 0, 2] = 2 * (x * z + w * y)
    R[:, 1, 0] = 2 * (x * y + w * z)
    R[:, 1, 1] = 1 - 2 * (x * x + z * z)
    R[:, 1, 2] = 2 * (y * z - w * x)
    R[:, 2, 0] = 2 * (x * z - w * y)
    R[:, 2, 1] = 2 * (y * z + w * x)
    R[:, 2, 2] = 1 - 2 * (x * x + y * y)
    return R


def multiply(a: Float, b: Float) -> Float:
    """Hamilton products (N, 4) of quaternions (N, 4)."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=1,
    )


def conjugate(q: Float) -> Float:
    """Inverse rotations of unit quaternions (N, 4)."""
    return np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))


def exponential(omega_rad: Float) -> Float:
    """Unit quaternions (N, 4) of rotation vectors (N, 3)."""
    half = 0.5 * np.linalg.norm(omega_rad, axis=1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * omega_rad * np.sinc(half / np.pi)], axis=1)


def hats(v: Float) -> Float:
    """Skew-symmetric matrices (N, 3, 3) of vectors (N, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return out


def angles_rad(q: Float) -> Float:
    """Rotation angles (N,) in [0, pi] of unit quaternions (N, 4)."""
    return np.asarray(2.0 * np.arctan2(np.linalg.norm(q[:, 1:], axis=1), np.abs(q[:, 0])))
