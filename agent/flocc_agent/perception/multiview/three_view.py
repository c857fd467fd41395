"""The closure's length in units of the odometry pair's: neighbour, query and match refined together.

Points seen in all three images tie the two translations: the odometry pair (translation of length one) gives their
depths, and these the match's pose with its length.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import pose
from flocc_agent.perception.multiview.bundle import (
    BundleView,
    Refined,
    covariance_of_view,
    inverse_depths_from,
    refine,
    reprojection_errors_px,
)
from flocc_agent.perception.multiview.two_view import TwoView, usac_parameters
from flocc_agent.perception.multiview.view_parameters import Geometry, Indices, LocalFeatures

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

INVERSE_DEPTH_MIN = 1e-3
"""A nearer point than this many baselines has a depth to start from, in baselines^-1."""
AGREEING_SHARE_MIN = 0.6
"""Share of the points seen by all that must fit, or the pairs contradict each other."""


def three_view(query: LocalFeatures, odometry_pair: TwoView, loop_pair: TwoView, geometry: Geometry) -> Refined | None:
    """Refine both views of a query together.

    Returns:
        The neighbour (a translation of length one) and the match, in this order; None where too few points are seen
        by all, they contradict each other, or the match's distance remains uncertain.
    """
    indices = np.union1d(loop_pair.query_indices, odometry_pair.query_indices)
    neighbour, match = _spread(odometry_pair, indices), _spread(loop_pair, indices)
    common = neighbour.seen & match.seen
    if int(common.sum()) < geometry.common_points_min:
        return None
    points = query.points[indices].astype(np.float64)
    depths = np.zeros(len(indices))
    depths[neighbour.seen] = odometry_pair.refined.inverse_depths
    loop_depths = np.zeros(len(indices))
    loop_depths[match.seen] = loop_pair.refined.inverse_depths
    guesses = [
        _by_depth_ratio(match, depths, loop_depths, common),
        _by_known_points(points, match, depths, common, geometry),
    ]
    refined = [_refined(points, depths, neighbour, match, T, geometry) for T in guesses if T is not None]
    if not refined:
        return None
    best = min(refined, key=lambda candidate: candidate.cost)
    return best if _is_certain(best, points, common, geometry) else None


def _spread(pair: TwoView, indices: Indices) -> BundleView:
    """A pair's view over a larger, sorted set of query features."""
    places = np.searchsorted(indices, pair.query_indices)
    observed = np.zeros((len(indices), 2))
    observed[places] = pair.view.observed
    seen = np.zeros(len(indices), np.bool_)
    seen[places] = True
    return replace(pair.view, observed=observed, seen=seen)


def _by_depth_ratio(match: BundleView, depths: Float, loop_depths: Float, common: Mask) -> Float | None:
    """Match pose with the length that makes the two pairs' depths agree at the median."""
    usable = common & (depths > INVERSE_DEPTH_MIN) & (loop_depths > INVERSE_DEPTH_MIN)
    if not np.any(usable):
        return None
    T = match.T_view_query.copy()
    T[:3, 3] *= np.median(loop_depths[usable] / depths[usable])
    return T


def _by_known_points(points: Float, match: BundleView, depths: Float, common: Mask, geometry: Geometry) -> Float | None:
    """Match pose from the points that the odometry pair placed (perspective-n-point)."""
    usable = common & (depths > INVERSE_DEPTH_MIN)
    if int(usable.sum()) < geometry.common_points_min:
        return None
    placed = np.column_stack([points[usable], np.ones(int(usable.sum()))]) / depths[usable, None]
    found, _, rotation, translation, _ = cv2.solvePnPRansac(
        placed,
        match.observed[usable],
        np.eye(3),
        np.zeros(4),
        params=usac_parameters(geometry, match.focal_px),
    )
    if not found or not np.all(np.isfinite(rotation)) or not np.all(np.isfinite(translation)):
        return None
    return pose(np.asarray(cv2.Rodrigues(rotation)[0], np.float64), np.asarray(translation, np.float64).ravel())


def _refined(
    points: Float, depths: Float, neighbour: BundleView, match: BundleView, T_match_query: Float, geometry: Geometry
) -> Refined:
    """Refine from one guess of the match's pose."""
    only_match = match.seen & ~neighbour.seen
    started = depths.copy()
    started[only_match] = inverse_depths_from(points[only_match], T_match_query, match.observed[only_match])
    match = replace(match, T_view_query=T_match_query, unit_translation=False, prior=None)
    return refine(points, started, (neighbour, match), geometry.sigma_px)


def _is_certain(refined: Refined, points: Float, common: Mask, geometry: Geometry) -> bool:
    """Whether the points seen by all agree and fix the match's distance."""
    neighbour, match = refined.views
    limit = geometry.inlier_threshold_px
    agrees = reprojection_errors_px(points, refined.inverse_depths, match) < limit
    agrees &= reprojection_errors_px(points, refined.inverse_depths, neighbour) < limit
    count = int((agrees & common).sum())
    if count < geometry.common_points_min or count < AGREEING_SHARE_MIN * int(common.sum()):
        return False
    return length_sigma_ratio(refined, 1) < geometry.scale_sigma_ratio_max


def length_sigma_ratio(refined: Refined, k: int) -> float:
    """Standard deviation of a view's distance, relative to it; to one baseline where the view is nearer."""
    covariance = covariance_of_view(refined, k, np.zeros(6))
    t = refined.views[k].T_view_query[:3, 3]
    length = float(np.linalg.norm(t))
    direction = t / max(length, 1e-9)
    variance = float(direction @ covariance[3:, 3:] @ direction)
    return float(np.sqrt(max(variance, 0.0))) / max(length, 1.0)
