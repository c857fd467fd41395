"""One decoded pair to counted matches and a relative pose; loop pairs and odometry pairs take the same way."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from flocc_agent.geometry import angle_rad
from flocc_agent.perception.mast3r.payload import PixelGeometry
from flocc_agent.perception.mast3r.reciprocal_matching import Matches, MatchParameters, match_views
from flocc_agent.perception.mast3r.relative_pose import (
    PnpParameters,
    PoseFailed,
    RelativePose,
    relative_pose,
    reray,
    weiszfeld_focal,
)
from flocc_agent.perception.mast3r.two_view_network import DenseView
from flocc_agent.stages import stage

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PairResult:
    """What one pair gave.

    Attributes:
        matches: Number of filtered reciprocal matches.
        pose: Pose of camera 2 in camera 1, or why there is none.
        confidence: Mean confidence of both views' points; None where the network gave values that are not finite.
    """

    matches: int
    pose: RelativePose | PoseFailed
    confidence: float | None = None


def estimated_K(view: DenseView, geometry: PixelGeometry) -> Float | None:
    """Calibration that a view's own pointmap implies, with the principal point in the middle; None if it fixes none."""
    centre = (geometry.crop.width / 2, geometry.crop.height / 2)
    focal = weiszfeld_focal(view.pts3d[0].float().cpu().numpy(), centre, clip=True)
    if focal is None:
        return None
    return np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])


def match_pair(views: tuple[DenseView, DenseView], parameters: MatchParameters) -> Matches | PoseFailed:
    """Match the two views of a decode, unless the network gave values that are not finite."""
    for view in views:
        if not all(bool(torch.isfinite(part).all()) for part in (view.pts3d, view.desc, view.desc_conf)):
            return PoseFailed("the network gave values that are not finite")
    desc = (views[0].desc[0], views[1].desc[0])
    return match_views(desc, (views[0].desc_conf[0], views[1].desc_conf[0]), parameters)


def register_pair(
    views: tuple[DenseView, DenseView],
    calibrations: tuple[Float, Float] | None,
    K_estimated: Float | None,
    matching: MatchParameters,
    pnp: PnpParameters,
) -> PairResult:
    """Matches and pose of camera 2 in camera 1.

    Args:
        views: Both views of one decode, points in camera 1.
        calibrations: (3, 3) of each network input for calibrated robots, else None.
        K_estimated: (3, 3) of image 2 where there is no calibration; None where none could be estimated.
        matching: The matcher's parameters.
        pnp: The solver's parameters.
    """
    with stage("match"):
        matches = match_pair(views, matching)
    if isinstance(matches, PoseFailed):
        return PairResult(0, matches)
    confidence = mean_confidence(views)
    if calibrations is None and K_estimated is None:
        return PairResult(len(matches), PoseFailed("the pointmap fixes no focal length", degenerate=True), confidence)
    pts3d = views[0].pts3d[0].cpu().double().numpy()
    points = pts3d[matches.xy1[:, 1], matches.xy1[:, 0]]
    if calibrations is not None:
        points = reray(points[:, 2], matches.xy1.astype(np.float64), calibrations[0])
    K_2 = calibrations[1] if calibrations is not None else K_estimated
    assert K_2 is not None
    with stage("pose"):
        return PairResult(len(matches), relative_pose(points, matches.xy2.astype(np.float64), K_2, pnp), confidence)


def mean_confidence(views: tuple[DenseView, DenseView]) -> float:
    """Mean confidence of both views' points, >= 1: what the paper compares the match ratio with (Sec. IV-B)."""
    return float(torch.stack([view.conf.float().mean() for view in views]).mean())


def disagreement_rad(T_query_match: Float, T_match_query: Float) -> float:
    """Larger of the angle between two decodes' rotations and that between their directions of translation."""
    rotation = angle_rad(T_query_match[:3, :3] @ T_match_query[:3, :3])
    there = T_query_match[:3, 3]
    back = -T_match_query[:3, :3].T @ T_match_query[:3, 3]
    lengths = float(np.linalg.norm(there) * np.linalg.norm(back))
    if lengths < 1e-12:
        return rotation
    return max(rotation, float(np.arccos(np.clip(there @ back / lengths, -1.0, 1.0))))
