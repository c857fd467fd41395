"""Where a map lies on Earth, by the geodetic fixes of the robots in it: REP 105's `earth` to `map`.

The solver places the fixes at the leader only. Every robot holds the fixes and its corrected way, so each can tell it
without a message: the rigid motion that brings the cameras nearest to their fixes, wrong fixes counting little.
"""

from collections.abc import Iterable

import numpy as np

from flocc_agent.core.corrected import CorrectedLog
from flocc_agent.core.geodesy import Place, T_earth_enu
from flocc_agent.geometry import Float, pose

ROTATION_SIGMA_MAX_RAD = np.radians(5.0)
"""A map that may hang askew by more is not placed: robots that drove one straight line may be turned about it."""
CAUCHY_SIGMAS = 2.385
"""Residuals, in sigmas, from which on a fix counts for less: 95 % efficiency where all are right (Holland 1977)."""
ITERATIONS = 20
FIXES_MIN = 4


def T_earth_map(logs: Iterable[CorrectedLog]) -> Float | None:
    """Pose (4, 4) of a map in the Earth-centred frame (ECEF).

    Args:
        logs: Of one map.

    Returns:
        None where too few fixes are there, or they leave open how the map is turned.
    """
    pairs = [log.fixed_cameras() for log in logs]
    fixes = [fix for log_fixes, _ in pairs for fix in log_fixes]
    if len(fixes) < FIXES_MIN:
        return None
    places = [T_earth_enu(Place(fix.latitude_deg, fix.longitude_deg, fix.altitude_m))[:3, 3] for fix in fixes]
    variances_m2 = [np.trace(fix.covariance_m2.numpy().reshape(3, 3)) / 3.0 for fix in fixes]
    return placed(np.concatenate([cameras_m for _, cameras_m in pairs]), np.array(places), np.array(variances_m2))


def placed(points_m: Float, seen_m: Float, variances_m2: Float) -> Float | None:
    """The rigid motion (4, 4) that brings points to where they were seen; None where a rotation stays open.

    Args:
        points_m: (N, 3).
        seen_m: (N, 3), in the other frame.
        variances_m2: (N,) of one axis of each.
    """
    weights = 1.0 / variances_m2
    T = _nearest(points_m, seen_m, weights)
    for _ in range(ITERATIONS):
        residuals_m = np.linalg.norm(points_m @ T[:3, :3].T + T[:3, 3] - seen_m, axis=1)
        weights = 1.0 / variances_m2 / (1.0 + residuals_m**2 / (variances_m2 * CAUCHY_SIGMAS**2))
        T = _nearest(points_m, seen_m, weights)
    centred = points_m - np.average(points_m, axis=0, weights=weights)
    information = np.einsum("n,nij->ij", weights, _turning(centred))
    return T if np.linalg.eigvalsh(information)[0] * ROTATION_SIGMA_MAX_RAD**2 > 1.0 else None


def _turning(points_m: Float) -> Float:
    """What each point (N, 3) tells of a rotation: (N, 3, 3), `|p|^2 I - p p^T`."""
    squares = np.einsum("ni,ni->n", points_m, points_m)
    return np.asarray(squares[:, None, None] * np.eye(3) - np.einsum("ni,nj->nij", points_m, points_m))


def _nearest(points_m: Float, seen_m: Float, weights: Float) -> Float:
    """Least squares over rigid motions (Kabsch 1976), about the centres: places on Earth are 6,000 km from its own."""
    centre, seen_centre = (np.average(of, axis=0, weights=weights) for of in (points_m, seen_m))
    U, _, Vt = np.linalg.svd(((seen_m - seen_centre) * weights[:, None]).T @ (points_m - centre))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return pose(R, seen_centre - R @ centre)
