"""Relative pose of two cameras from a pointmap and matches.

The pointmap has a focal length of its own, often some per cent off. With the true calibration, PnP on such a map
gives directions of translation that are wrong by tens of degrees. Calibrated robots therefore keep each point's
depth only and put it on the pixel's true ray; uncalibrated ones estimate the focal length from the map (Weiszfeld).
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse, pose

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

MATCHES_MIN = 6
WEISZFELD_ROUNDS = 10
FOCAL_RATIO_MIN, FOCAL_RATIO_MAX = 0.5, 3.5
DEPTH_MIN = 1e-6
DEGREES_OF_FREEDOM = 6
SIGMA_MIN_PX = 0.5
CONDITION_MAX = 1e12


@dataclass(frozen=True, slots=True)
class PnpParameters:
    """How PnP treats outliers.

    Attributes:
        reprojection_px: Matches that reproject within this are inliers.
        iterations: RANSAC samples; at 70 % outliers 100 fail in a third of the cases.
        confidence: RANSAC stops early when it is this sure.
        inliers_min: Fewer inliers are no pose.
    """

    reprojection_px: float = 5.0
    iterations: int = 2000
    confidence: float = 0.9999
    inliers_min: int = 12


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """Pose of camera 2 in camera 1.

    Attributes:
        T_1_2_unscaled: (4, 4), translation in the pointmap's units.
        covariance: (6, 6) in the tangent space of camera 2, rotation (rad) first, translation in those units.
        inliers: (N,) which matches agree.
    """

    T_1_2_unscaled: Float
    covariance: Float
    inliers: Bool


@dataclass(frozen=True, slots=True)
class PoseFailed:
    """Why matches gave no pose."""

    detail: str
    degenerate: bool = False


def reray(z: Float, uv: Float, K: Float) -> Float:
    """Put depths on the true rays of their pixels.

    Args:
        z: (N,) depths of the pointmap.
        uv: (N, 2) pixels.
        K: (3, 3) true calibration.

    Returns:
        (N, 3) points with the same depths.
    """
    rays = np.column_stack([(uv[:, 0] - K[0, 2]) / K[0, 0], (uv[:, 1] - K[1, 2]) / K[1, 1], np.ones(len(uv))])
    return np.asarray(rays * z[:, None])


def weiszfeld_focal(pts3d: NDArray[np.floating], principal_px: tuple[float, float], clip: bool = False) -> float | None:
    """Focal length that a pointmap implies, by iteratively reweighted least squares.

    Args:
        pts3d: (H, W, 3) points of a view in its own camera frame.
        principal_px: Principal point, column and row.
        clip: Keep the result within 0.5 to 3.5 times the focal length of a 60 degree field of view.

    Returns:
        Pixels, or None where the map fixes no positive focal length.
    """
    height, width = pts3d.shape[:2]
    v, u = np.mgrid[:height, :width]
    p = np.stack([u - principal_px[0], v - principal_px[1]], axis=-1).reshape(-1, 2).astype(np.float64)
    q = _normalised(pts3d)
    squares = float((q * q).sum(-1).mean())
    if squares <= 0:
        return None
    focal = float((q * p).sum(-1).mean()) / squares
    for _ in range(WEISZFELD_ROUNDS):
        w = 1.0 / np.maximum(np.linalg.norm(p - focal * q, axis=-1), 1e-8)
        focal = float((w * (q * p).sum(-1)).mean() / (w * (q * q).sum(-1)).mean())
    if clip:
        base = max(height, width) / (2 * np.tan(np.deg2rad(60) / 2))
        focal = float(np.clip(focal, FOCAL_RATIO_MIN * base, FOCAL_RATIO_MAX * base))
    return focal if np.isfinite(focal) and focal > 0 else None


def _normalised(pts3d: NDArray[np.floating]) -> Float:
    """(N, 2) x/z and y/z, zero where they are not finite."""
    points = np.asarray(pts3d, np.float64).reshape(-1, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        q = points[:, :2] / points[:, 2:3]
    return np.nan_to_num(q, posinf=0.0, neginf=0.0)


def relative_pose(points_1: Float, uv_2: Float, K_2: Float, parameters: PnpParameters) -> RelativePose | PoseFailed:
    """Pose of camera 2 from points in camera 1's frame and their pixels in image 2.

    Args:
        points_1: (N, 3) points in camera 1, network units; unusable ones (not finite, behind) are ignored.
        uv_2: (N, 2) matched pixels of image 2.
        K_2: (3, 3) calibration of image 2.
        parameters: RANSAC's.
    """
    usable = np.isfinite(points_1).all(axis=1) & (points_1[:, 2] > DEPTH_MIN)
    if int(usable.sum()) < MATCHES_MIN:
        return PoseFailed(f"{int(usable.sum())} matches with a point in front of the camera, {MATCHES_MIN} needed")
    unit = float(np.median(points_1[usable, 2]))
    solved = _ransac(points_1[usable] / unit, uv_2[usable], K_2, parameters)
    if isinstance(solved, PoseFailed):
        return solved
    T_2_1, found = solved
    covariance = pose_covariance(points_1[usable][found] / unit, uv_2[usable][found], K_2, T_2_1)
    if covariance is None:
        return PoseFailed("the inliers do not fix the pose", degenerate=True)
    to_units = np.diag([1.0, 1.0, 1.0, unit, unit, unit])
    T_1_2 = inverse(T_2_1)
    T_1_2[:3, 3] *= unit
    inliers = np.zeros(len(points_1), np.bool_)
    inliers[np.flatnonzero(usable)[found]] = True
    return RelativePose(T_1_2, to_units @ covariance @ to_units, inliers)


def _ransac(
    points: Float, uv: Float, K: Float, parameters: PnpParameters
) -> tuple[Float, NDArray[np.intp]] | PoseFailed:
    """PnP with RANSAC, refined on the inliers; gives T_2_1 and the inliers' indices."""
    try:
        found, rotation, t, inliers = cv2.solvePnPRansac(
            points,
            uv.astype(np.float64),
            K,
            None,
            iterationsCount=parameters.iterations,
            reprojectionError=parameters.reprojection_px,
            confidence=parameters.confidence,
            flags=cv2.SOLVEPNP_P3P,  # samples of four points: at 70 % outliers far more of them are clean
        )
    except cv2.error as error:
        return PoseFailed(f"PnP failed: {str(error).strip().splitlines()[0]}", degenerate=True)
    count = 0 if not found or inliers is None else len(inliers)
    if count < parameters.inliers_min:
        return PoseFailed(f"{count} of {len(points)} matches agree on a pose, {parameters.inliers_min} needed")
    T_2_1 = pose_of(rotation, t)
    kept = np.asarray(inliers[:, 0], np.intp)
    for _ in range(2):
        rotation, t = cv2.solvePnPRefineLM(points[kept], uv[kept].astype(np.float64), K, None, rotation, t)
        T_2_1 = pose_of(rotation, t)
        kept = np.flatnonzero(reprojection_errors_px(points, uv, K, T_2_1) < parameters.reprojection_px)
        if len(kept) < parameters.inliers_min:
            return PoseFailed(f"{len(kept)} matches agree after refinement, {parameters.inliers_min} needed")
    if not np.all(np.isfinite(T_2_1)):
        return PoseFailed("PnP gave no finite pose", degenerate=True)
    return T_2_1, kept


def pose_of(rotation: NDArray[Any], t: NDArray[Any]) -> Float:
    """Pose of OpenCV's rotation vector and translation, (3, 1) each."""
    return pose(np.asarray(cv2.Rodrigues(rotation)[0], np.float64), np.asarray(t[:, 0], np.float64))


def reprojection_errors_px(points: Float, uv: Float, K: Float, T_2_1: Float) -> Float:
    """(N,) distances of projected points from their pixels; infinite behind the camera."""
    p = points @ T_2_1[:3, :3].T + T_2_1[:3, 3]
    front = p[:, 2] > DEPTH_MIN
    projected = np.full((len(points), 2), np.inf)
    projected[front] = p[front, :2] / p[front, 2:3] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
    return np.asarray(np.linalg.norm(projected - uv, axis=1))


def reprojection_jacobian(points: Float, K: Float, T_2_1: Float) -> Float:
    """(2N, 6) derivative of projections with respect to xi in T_1_2 Exp(xi), rotation first."""
    x, y, z = (points @ T_2_1[:3, :3].T + T_2_1[:3, 3]).T
    fx, fy, one, zero = K[0, 0], K[1, 1], np.ones_like(x), np.zeros_like(x)
    by_point = np.array([[fx / z, zero, -fx * x / z**2], [zero, fy / z, -fy * y / z**2]]).transpose(2, 0, 1)
    # T_2_1 becomes Exp(-xi) T_2_1, so a point moves by hat(p) omega - v.
    by_xi = np.array(
        [[zero, -z, y, -one, zero, zero], [z, zero, -x, zero, -one, zero], [-y, x, zero, zero, zero, -one]]
    )
    return np.asarray((by_point @ by_xi.transpose(2, 0, 1)).reshape(-1, 6))


def pose_covariance(points: Float, uv: Float, K: Float, T_2_1: Float) -> Float | None:
    """(6, 6) covariance of a refined pose from its inliers' residuals, or None where they do not fix it."""
    J = reprojection_jacobian(points, K, T_2_1)
    information = J.T @ J
    if not np.all(np.isfinite(information)) or np.linalg.cond(information) > CONDITION_MAX:
        return None
    squares = float((reprojection_errors_px(points, uv, K, T_2_1) ** 2).sum())
    variance = max(squares / max(len(J) - DEGREES_OF_FREEDOM, 1), SIGMA_MIN_PX**2)
    return np.asarray(variance * np.linalg.inv(information))
