"""Relative pose of two images from matched features: essential matrix, cheirality, refinement, degenerate cases."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import nearest_rotation, pose
from flocc_agent.perception.multiview.bundle import (
    BundleView,
    DirectionPrior,
    Refined,
    TiltPrior,
    inverse_depths_from,
    refine,
    reprojection_errors_px,
)
from flocc_agent.perception.multiview.upright import upright_poses
from flocc_agent.perception.multiview.view_parameters import Geometry, Indices, LocalFeatures, Matched

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

Found = tuple[BundleView, Float, Mask] | int
"""The other image as a view of the verified points, their inverse depths, and which are verified; or how many are
where they are too few."""

GENERATOR_STATE = 20_260_101
"""Start of the robust estimators' own generators: the same input gives the same result, in any thread."""
INVERSE_DEPTH_MIN = -0.01
"""A point at infinity may come out slightly behind the camera, in baselines^-1."""
UPRIGHT_WIDTH_PX = 5.0
"""A degree of tilt moves points by about so much, before the refinement takes it back."""
UPRIGHT_TRIED = 2


@dataclass(frozen=True, slots=True, eq=False)
class TwoView:
    """A pair of images whose relative pose is known up to scale.

    Attributes:
        query_indices: (K,) features of the query that are verified.
        other_indices: (K,) their correspondences in the other image.
        refined: One view, the other image, with a translation of length one.
    """

    query_indices: Indices
    other_indices: Indices
    refined: Refined

    @property
    def view(self) -> BundleView:
        """The other image as a view of the query."""
        return self.refined.views[0]

    @property
    def correspondences(self) -> int:
        """How many correspondences are verified; what Eq. (1) counts."""
        return len(self.query_indices)


def two_view(
    query: LocalFeatures,
    other: LocalFeatures,
    matched: Matched,
    geometry: Geometry,
    prior: DirectionPrior | None = None,
) -> TwoView | int:
    """Verify the matches of two images.

    Args:
        query: Features of the query.
        other: Features of the other image.
        matched: Which of them look alike.
        geometry: Thresholds.
        prior: What odometry says of the other image's pose; it refines the pose but verifies nothing.

    Returns:
        The verified pair, or how many verified correspondences there were where they are too few.
    """
    query_indices, other_indices = matched
    points = query.points[query_indices].astype(np.float64)
    observed = other.points[other_indices].astype(np.float64)
    found = _verified(points, observed, other.focal_px, geometry)
    tilt = tilt_of(query, other, geometry)
    if tilt is not None and _count(found) < geometry.sure_without_gravity:
        found = max(found, _verified_upright(points, observed, other.focal_px, geometry, tilt), key=_count)
    if isinstance(found, int):
        return found
    view, depths, verified = found
    points = points[verified]
    guesses = [(view, depths)]
    if prior is not None:
        by_odometry = replace(view, T_view_query=unit_translation(prior.T_view_query), prior=prior)
        depths_by_odometry = inverse_depths_from(points, by_odometry.T_view_query, view.observed)
        guesses = [(replace(view, prior=prior), depths), (by_odometry, depths_by_odometry)]
    candidates = [refine(points, start, (guess,), geometry.sigma_px) for guess, start in guesses]
    refined = min(candidates, key=lambda candidate: candidate.cost)
    return TwoView(query_indices[verified], other_indices[verified], refined)


def tilt_of(query: LocalFeatures, other: LocalFeatures, geometry: Geometry) -> TiltPrior | None:
    """What gravity says of the pair; None where not both know which way is up."""
    if query.up is None or other.up is None or not np.isfinite(geometry.tilt_sigma_rad):
        return None
    return TiltPrior(query.up, other.up, geometry.tilt_sigma_rad)


def _verified(points: Float, observed: Float, focal_px: float, geometry: Geometry) -> Found:
    """Find the relative pose and verify the matches with it, the same way for loop pairs and odometry pairs.

    Returns:
        The other image as a view of the verified points, their inverse depths, and which are verified; or how many
        are verified where they are too few.
    """
    found = essential_pose(points, observed, focal_px, geometry)
    if found is None:
        return 0
    T_other_query, agree = found
    if int(agree.sum()) < geometry.correspondences_min:
        return int(agree.sum())
    view = BundleView(T_other_query, observed, agree, focal_px, unit_translation=True)
    return _refined_and_verified(points, view, geometry)


def _verified_upright(points: Float, observed: Float, focal_px: float, geometry: Geometry, tilt: TiltPrior) -> Found:
    """The same from three correspondences and gravity, which remains as a prior: what it does not fit, it loses."""
    width = UPRIGHT_WIDTH_PX / focal_px
    best: Found = 0
    for T in upright_poses(points, observed, (tilt.up_query, tilt.up_view), width, UPRIGHT_TRIED):
        errors = reprojection_errors_px(
            points,
            inverse_depths_from(points, T, observed),
            BundleView(T, observed, np.ones(len(points), np.bool_), focal_px, unit_translation=True),
        )
        view = BundleView(T, observed, errors < 2.0 * UPRIGHT_WIDTH_PX, focal_px, unit_translation=True, tilt=tilt)
        best = max(best, _refined_and_verified(points, view, geometry), key=_count)
    return best


def _count(found: Found) -> int:
    return found if isinstance(found, int) else int(found[2].sum())


def _refined_and_verified(points: Float, view: BundleView, geometry: Geometry) -> Found:
    """Refine a pose with the correspondences that agree with it, and verify all with the result."""
    depths = inverse_depths_from(points, view.T_view_query, view.observed)
    refined = refine(points, depths, (view,), geometry.sigma_px)
    errors = reprojection_errors_px(points, refined.inverse_depths, refined.views[0])
    verified = (errors < geometry.inlier_threshold_px) & (refined.inverse_depths > INVERSE_DEPTH_MIN)
    count = int(verified.sum())
    if count < geometry.correspondences_min:
        return count
    view = replace(refined.views[0], observed=view.observed[verified], seen=np.ones(count, np.bool_))
    return view, refined.inverse_depths[verified], verified


def unit_translation(T: Float) -> Float:
    """The pose with its translation made one long."""
    return pose(T[:3, :3], T[:3, 3] / np.linalg.norm(T[:3, 3]))


def essential_pose(points: Float, observed: Float, focal_px: float, geometry: Geometry) -> tuple[Float, Mask] | None:
    """Pose of the query in the other image by a robust essential matrix.

    Returns:
        `T_other_query` with a translation of length one, and which correspondences agree; None where nothing fits.
    """
    if len(points) < 8:
        return None
    K = np.eye(3)
    parameters = usac_parameters(geometry, focal_px)
    E, mask = cv2.findEssentialMat(points, observed, K, K, None, None, parameters)
    if E is None or E.shape != (3, 3) or mask is None or not np.all(np.isfinite(E)):
        return None
    inliers = mask.ravel() > 0
    best, best_front = None, -1
    for T in decompose_essential(np.asarray(E, np.float64)):
        inverse_depths = inverse_depths_from(points, T, observed)
        rays = np.column_stack([points, np.ones(len(points))])
        z_other = (rays @ T[:3, :3].T + inverse_depths[:, None] * T[:3, 3])[:, 2]
        front = inliers & (inverse_depths > INVERSE_DEPTH_MIN) & (z_other > 0)
        if int(front.sum()) > best_front:
            best, best_front, best_mask = T, int(front.sum()), front
    return None if best is None else (best, best_mask)


def usac_parameters(geometry: Geometry, focal_px: float) -> cv2.UsacParams:
    """Parameters of OpenCV's robust estimators with a generator of their own, so that results repeat."""
    parameters = cv2.UsacParams()
    parameters.threshold = geometry.inlier_threshold_px / focal_px
    parameters.confidence = 0.999
    parameters.maxIterations = geometry.iterations_max
    parameters.isParallel = False
    parameters.randomGeneratorState = GENERATOR_STATE
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
    parameters.loIterations = 10
    return parameters


def decompose_essential(E: Float) -> list[Float]:
    """The four poses `T_other_query` of an essential matrix."""
    U, _, Vt = np.linalg.svd(E)
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rotations = [nearest_rotation(sign * U @ M @ Vt) for M in (W, W.T) for sign in (np.linalg.det(U @ M @ Vt),)]
    return [pose(R, sign * U[:, 2]) for R in rotations for sign in (1.0, -1.0)]
