"""Pairs whose correspondences do not fix the direction of translation: no parallax, or one plane seen two ways."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import angle_rad, nearest_rotation, pose
from flocc_agent.perception.multiview.bundle import (
    BundleView,
    covariance_of_view,
    inverse_depths_from,
    refine,
)
from flocc_agent.perception.multiview.two_view import TwoView, usac_parameters
from flocc_agent.perception.multiview.view_parameters import Geometry

Float = NDArray[np.float64]

EXPLAINED_SHARE_MIN = 0.9
"""A motion that explains this share of the correspondences explains the pair."""
PLANE_SHARE_MIN = 0.6
"""With fewer correspondences on one plane the others tell its two motions apart; wrong ones are among the others."""
ROTATION_ROUNDS = 5
COST_RATIO_MAX = 1.5
"""Two solutions whose costs differ by less are equally good."""
SAME_ANGLE_RAD = 0.05
"""Solutions that differ by less in rotation and in direction are one."""
INVERSE_DEPTH_MIN = -0.01


def degeneracy(points: Float, pair: TwoView, geometry: Geometry) -> str | None:
    """Say why a pair's direction of translation is not fixed; None where it is.

    Args:
        points: (K, 2) x/z and y/z of the pair's correspondences in the query.
        pair: The verified pair.
        geometry: Thresholds.
    """
    view = pair.view
    if rotation_share(points, view, geometry) > EXPLAINED_SHARE_MIN:
        return "the images differ by a rotation only, and odometry gives no structure"
    sigma_rad = direction_sigma_rad(pair)
    if sigma_rad > geometry.direction_sigma_max_rad:
        return f"the direction of translation is uncertain by {sigma_rad:.2f} rad"
    if _plane_is_ambiguous(points, pair, geometry):
        return "the correspondences lie in one plane, which two motions explain equally well"
    return None


def direction_sigma_rad(pair: TwoView) -> float:
    """How uncertain the direction of translation is."""
    covariance = covariance_of_view(pair.refined, 0, np.zeros(6))
    return float(np.sqrt(max(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]), 0.0)))


def rotation_share(points: Float, view: BundleView, geometry: Geometry) -> float:
    """Share of the correspondences that a rotation alone explains."""
    bearings, seen = _bearings(points), _bearings(view.observed)
    weights = np.ones(len(points))
    threshold = geometry.inlier_threshold_px
    errors = np.full(len(points), np.inf)
    for _ in range(ROTATION_ROUNDS):
        R = nearest_rotation((seen * weights[:, None]).T @ bearings)
        rotated = bearings @ R.T
        in_front = rotated[:, 2] > 1e-3
        projected = rotated[:, :2] / np.where(in_front, rotated[:, 2], 1.0)[:, None]
        errors = np.linalg.norm(projected - view.observed, axis=1) * view.focal_px
        errors = np.where(in_front, errors, np.inf)
        weights = 1.0 / (1.0 + (errors / threshold) ** 2)
    return float(np.mean(errors < threshold))


def _plane_is_ambiguous(points: Float, pair: TwoView, geometry: Geometry) -> bool:
    """Whether one plane holds most correspondences and a second motion fits as well as the pair's."""
    view = pair.view
    H, mask = cv2.findHomography(points, view.observed, usac_parameters(geometry, view.focal_px))
    if H is None or mask is None or float(np.mean(mask)) < PLANE_SHARE_MIN:
        return False
    _, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    for R, t in zip(rotations, translations, strict=True):
        length = float(np.linalg.norm(t))
        if length < 1e-6:
            continue
        other = pose(np.asarray(R, np.float64), np.asarray(t, np.float64).ravel() / length)
        if not _is_same(other, view.T_view_query) and _fits_as_well(points, pair, other, geometry):
            return True
    return False


def _is_same(T: Float, T_other: Float) -> bool:
    """Whether two poses with unit translations are nearly equal."""
    direction = float(np.clip(T[:3, 3] @ T_other[:3, 3], -1.0, 1.0))
    turned = angle_rad(T[:3, :3] @ T_other[:3, :3].T)
    return turned < SAME_ANGLE_RAD and float(np.arccos(direction)) < SAME_ANGLE_RAD


def _fits_as_well(points: Float, pair: TwoView, T_other: Float, geometry: Geometry) -> bool:
    """Whether another motion, refined, has about the pair's cost, points in front, and remains another one."""
    view = replace(pair.view, T_view_query=T_other)
    inverse_depths = inverse_depths_from(points, T_other, view.observed)
    if float(np.mean(inverse_depths > INVERSE_DEPTH_MIN)) < EXPLAINED_SHARE_MIN:
        return False
    refined = refine(points, inverse_depths, (view,), geometry.sigma_px)
    if _is_same(refined.views[0].T_view_query, pair.view.T_view_query):
        return False
    in_front = float(np.mean(refined.inverse_depths > INVERSE_DEPTH_MIN))
    return in_front > EXPLAINED_SHARE_MIN and refined.cost < COST_RATIO_MAX * pair.refined.cost + 1.0


def _bearings(points: Float) -> Float:
    """Unit vectors (N, 3) of points (N, 2)."""
    rays = np.column_stack([points, np.ones(len(points))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
