"""SE(3) on numpy.

Poses are (4, 4) float64; `T_a_b` is the pose of frame b in frame a, so `p_a = T_a_b @ p_b`. Tangent vectors are
ordered as GTSAM's: rotation (rad), then translation (m).
"""

import math

import numpy as np
from numpy.typing import NDArray

from flocc_protocol.arrays import Array
from flocc_protocol.codec import Pose7

Float = NDArray[np.float64]

SMALL_ANGLE_RAD = 1e-9
SMALL_TWIST_RAD = 1e-5
RIGID_TOLERANCE = 1e-3
_UPPER = np.triu_indices(6)
_IDENTITY = np.eye(4)


def pose(R: Float, t: Float) -> Float:
    """Put a rotation (3, 3) and a translation (3,) into a (4, 4) pose."""
    T = _IDENTITY.copy()
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def inverse(T: Float) -> Float:
    """Invert poses (..., 4, 4)."""
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R_transposed
    out[..., :3, 3] = -(R_transposed @ T[..., :3, 3:4])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def between(T_a_b: Float, T_a_c: Float) -> Float:
    """Pose of c in b, `T_b_c`, from both in a."""
    return inverse(T_a_b) @ T_a_c


def is_rigid(T: Float, tolerance: float = RIGID_TOLERANCE) -> bool:
    """Whether a (4, 4) array is finite, with an orthonormal right-handed rotation and last row 0 0 0 1."""
    if T.shape != (4, 4) or not np.all(np.isfinite(T)):
        return False
    R = T[:3, :3]
    off = np.concatenate([np.abs(R @ R.T - _IDENTITY[:3, :3]).ravel(), np.abs(T[3] - _IDENTITY[3])])
    return bool(off.max() <= tolerance and np.linalg.det(R) > 0)


def nearest_rotation(M: Float) -> Float:
    """Closest rotation (3, 3) to a matrix in the Frobenius norm, by SVD."""
    U, _, Vt = np.linalg.svd(M)
    D = np.diag([1.0, 1.0, np.linalg.det(U @ Vt)])
    return np.asarray(U @ D @ Vt)


def hat(v: Float) -> Float:
    """Skew-symmetric matrix of (3,), so that `hat(v) @ w == cross(v, w)`."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def so3_exp(omega_rad: Float) -> Float:
    """Rotation (3, 3) of a rotation vector (3,)."""
    theta = float(np.linalg.norm(omega_rad))
    W = hat(omega_rad)
    if theta < SMALL_ANGLE_RAD:
        return np.eye(3) + W
    return np.asarray(np.eye(3) + np.sin(theta) / theta * W + (1 - np.cos(theta)) / theta**2 * (W @ W))


def so3_log(R: Float) -> Float:
    """Rotation vector (3,) of a rotation, norm in [0, pi]; by way of the quaternion, stable near pi."""
    q = q_wxyz_from_R(R)
    w, v = q[0], q[1:]
    n = float(np.linalg.norm(v))
    if n < SMALL_ANGLE_RAD:
        return np.asarray(2.0 * v)
    return np.asarray(2.0 * np.arctan2(n, w) / n * v)


def se3_exp(xi: Float) -> Float:
    """Pose of a tangent vector (6,), rotation first."""
    omega, v = xi[:3], xi[3:]
    theta = float(np.linalg.norm(omega))
    W = hat(omega)
    if theta < 1e-6:
        V = np.eye(3) + 0.5 * W + W @ W / 6.0
    else:
        V = np.eye(3) + (1 - np.cos(theta)) / theta**2 * W + (theta - np.sin(theta)) / theta**3 * (W @ W)
    return pose(so3_exp(omega), V @ v)


def se3_log(T: Float) -> Float:
    """Tangent vector (6,) of a pose, rotation first."""
    omega = so3_log(T[:3, :3])
    theta = float(np.linalg.norm(omega))
    W = hat(omega)
    if theta < 1e-6:
        V_inverse = np.eye(3) - 0.5 * W + W @ W / 12.0
    else:
        half = theta / 2.0
        V_inverse = np.eye(3) - 0.5 * W + (1 / theta**2) * (1 - half * np.cos(half) / np.sin(half)) * (W @ W)
    return np.concatenate([omega, V_inverse @ T[:3, 3]])


def poses_of_twists(xi: Float) -> Float:
    """Poses (N, 4, 4) of tangent vectors (N, 6), rotation first."""
    omega = xi[:, :3]
    theta = np.linalg.norm(omega, axis=1)[:, None, None]
    small = theta < SMALL_TWIST_RAD
    safe = np.where(small, 1.0, theta)
    W = hats(omega)
    WW = W @ W
    T = np.zeros((len(xi), 4, 4))
    second = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    T[:, :3, :3] = np.eye(3) + np.where(small, 1.0, np.sin(safe) / safe) * W + second * WW
    V = np.eye(3) + second * W + np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3) * WW
    T[:, :3, 3] = (V @ xi[:, 3:, None])[..., 0]
    T[:, 3, 3] = 1.0
    return T


def twists_of_poses(T: Float) -> Float:
    """Tangent vectors (N, 6) of poses (N, 4, 4), rotation first, its norm in [0, pi]."""
    q = quaternions(T[:, :3, :3])
    norm = np.linalg.norm(q[:, 1:], axis=1)
    theta = 2.0 * np.arctan2(norm, q[:, 0])
    omega = (
        np.where(norm < SMALL_ANGLE_RAD, 2.0, theta / np.where(norm < SMALL_ANGLE_RAD, 1.0, norm))[:, None] * q[:, 1:]
    )
    half = np.where(theta < SMALL_TWIST_RAD, 1.0, theta / 2.0)
    last = np.where(theta < SMALL_TWIST_RAD, 1.0 / 12.0, (1.0 - half / np.tan(half)) / (4.0 * half**2))
    W = hats(omega)
    V_inverse = np.eye(3) - 0.5 * W + last[:, None, None] * (W @ W)
    return np.concatenate([omega, (V_inverse @ T[:, :3, 3:4])[..., 0]], axis=1)


def hats(v: Float) -> Float:
    """Skew-symmetric matrices (N, 3, 3) of (N, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = v.T
    return out - np.swapaxes(out, 1, 2)


def adjoint(T: Float) -> Float:
    """Adjoint (6, 6) of a pose, rotation first."""
    R, t = T[:3, :3], T[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = hat(t) @ R
    return out


def adjoints(T: Float) -> Float:
    """Adjoints (N, 6, 6) of poses (N, 4, 4), rotation first."""
    out = np.zeros((len(T), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = T[:, :3, :3]
    out[:, 3:, :3] = hats(T[:, :3, 3]) @ T[:, :3, :3]
    return out


def angle_rad(R: Float) -> float:
    """Angle of a rotation, in [0, pi]."""
    return float(np.linalg.norm(so3_log(R)))


def q_wxyz_from_R(R: Float) -> Float:
    """Unit quaternion (4,), w first and not negative."""
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = np.asarray(R, dtype=float).tolist()
    candidates = (1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22)
    k = candidates.index(max(candidates))
    s = 2.0 * math.sqrt(candidates[k])
    if k == 0:
        q = np.array([s / 4, (m21 - m12) / s, (m02 - m20) / s, (m10 - m01) / s])
    elif k == 1:
        q = np.array([(m21 - m12) / s, s / 4, (m01 + m10) / s, (m02 + m20) / s])
    elif k == 2:
        q = np.array([(m02 - m20) / s, (m01 + m10) / s, s / 4, (m12 + m21) / s])
    else:
        q = np.array([(m10 - m01) / s, (m02 + m20) / s, (m12 + m21) / s, s / 4])
    q = q if q[0] >= 0 else -q
    return np.asarray(q / math.sqrt(q.dot(q)))


def R_from_q_wxyz(q_wxyz: Float) -> Float:
    """Rotation (3, 3) of a quaternion (4,), which is normalised first.

    Raises:
        ValueError: The quaternion is zero or not finite.
    """
    q = np.asarray(q_wxyz, dtype=float)
    norm = math.sqrt(q.dot(q))
    if not math.isfinite(norm) or norm < 1e-12:
        raise ValueError(f"quaternion {q_wxyz} has no direction")
    w, x, y, z = (q / norm).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose_from_tq(tq: Float) -> Float:
    """Pose of seven numbers: translation x y z, quaternion w x y z."""
    return pose(R_from_q_wxyz(tq[3:7]), tq[:3])


def poses_from_tq(tq: Float) -> Float:
    """Poses (N, 4, 4) of rows (N, 7): translation x y z, quaternion w x y z, which is normalised first.

    Raises:
        ValueError: A quaternion is zero or not finite.
    """
    norms = np.linalg.norm(tq[:, 3:7], axis=1)
    if not np.all(np.isfinite(norms) & (norms >= 1e-12)):
        raise ValueError("a quaternion has no direction")
    w, x, y, z = (tq[:, 3:7] / norms[:, None]).T
    T = np.zeros((len(tq), 4, 4))
    T[:, 0, 0], T[:, 0, 1], T[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    T[:, 1, 0], T[:, 1, 1], T[:, 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    T[:, 2, 0], T[:, 2, 1], T[:, 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    T[:, :3, 3], T[:, 3, 3] = tq[:, :3], 1.0
    return T


def quaternions(R: Float) -> Float:
    """Unit quaternions (N, 4), w first and not negative, of rotations (N, 3, 3); stable at every angle."""
    xx, yy, zz = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    squares = np.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], axis=1)
    wx, wy, wz = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    xy, xz, yz = R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]
    s0, s1, s2, s3 = squares.T
    rows = np.array([[s0, wx, wy, wz], [wx, s1, xy, xz], [wy, xy, s2, yz], [wz, xz, yz, s3]])
    q = rows[np.argmax(squares, axis=1), :, np.arange(len(R))]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return np.asarray(np.where(q[:, :1] < 0, -q, q))


def tq_from_poses(T: Float) -> Float:
    """Rows (N, 7) of poses (N, 4, 4): translation x y z, unit quaternion w x y z, w not negative."""
    return np.concatenate([T[:, :3, 3], quaternions(T[:, :3, :3])], axis=1)


def tq_from_pose(T: Float) -> Float:
    """Seven numbers of a pose: translation x y z, quaternion w x y z."""
    return np.concatenate([T[:3, 3], q_wxyz_from_R(T[:3, :3])])


def pose7(T: Float) -> Pose7:
    """A pose (4, 4) as the wire has it: translation x y z, quaternion w x y z."""
    x, y, z, qw, qx, qy, qz = (float(v) for v in tq_from_pose(T))
    return (x, y, z, qw, qx, qy, qz)


def pose7s(T: Float) -> tuple[Pose7, ...]:
    """Poses (N, 4, 4) as the wire has them."""
    return tuple([(x, y, z, qw, qx, qy, qz) for x, y, z, qw, qx, qy, qz in tq_from_poses(T).tolist()])


def interpolated(T_a_b: Float, T_a_c: Float, share: float) -> Float:
    """Pose on the way from b (share 0) to c (share 1), along one twist."""
    return np.asarray(T_a_b @ se3_exp(share * se3_log(between(T_a_b, T_a_c))))


def symmetric(upper: Float) -> Float:
    """Covariances (..., 6, 6) of their upper triangles (..., 21)."""
    out = np.empty((*upper.shape[:-1], 6, 6))
    rows, columns = _UPPER
    out[..., rows, columns] = upper
    out[..., columns, rows] = upper
    return out


def upper_triangle(covariance: Float, dtype: str = "f4") -> Array:
    """Upper triangle (21,) of a covariance (6, 6), as the wire has it."""
    return Array.of(np.asarray(covariance, dtype=float)[_UPPER], dtype)


def umeyama(source: Float, target: Float, with_scale: bool = False) -> tuple[float, Float]:
    """Least-squares similarity that moves source points onto target points (Umeyama 1991).

    Args:
        source: (N, 3), metres.
        target: (N, 3), metres.
        with_scale: Whether a common scale is estimated as well.

    Returns:
        The scale (1.0 without `with_scale`) and `T_target_source`, with `target ~ scale * R @ source + t`.

    Raises:
        ValueError: Fewer than one point, or shapes that differ.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or len(source) < 1:
        raise ValueError(f"need two (N, 3) arrays, got {source.shape} and {target.shape}")
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    covariance = (target - mean_target).T @ (source - mean_source) / len(source)
    U, singular_values, Vt = np.linalg.svd(covariance)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt)) or 1.0])
    R = U @ np.diag(signs) @ Vt
    variance = float(((source - mean_source) ** 2).sum() / len(source))
    scale = float(singular_values @ signs / variance) if with_scale and variance > 0 else 1.0
    return scale, pose(R, mean_target - scale * R @ mean_source)


def in_units(covariance: Float, unit_m: float) -> Float:
    """A covariance (6, 6) of a rotation and a translation in metres, the translation in units so many metres long."""
    units = np.repeat((1.0, 1.0 / unit_m), 3)
    return np.asarray(covariance * units[:, None] * units)
