"""Refinement of the views around one query image: poses and inverse depths by Levenberg-Marquardt.

A point is a query pixel's ray with an inverse depth, so a point at infinity is no special case. In a view with pose
`T_view_query = (R, t)` it lies along `R x + rho t`. Errors are pixels in the views; Cauchy weights bound what a
wrong correspondence does. A view whose translation is a direction only has two degrees of freedom for it.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import hat, pose, so3_exp, so3_log

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

DEPTH_MIN = 1e-3
"""Smallest third coordinate of `R x + rho t`; a point behind the view is held there."""
INVERSE_DEPTH_SIGMA = 1e3
"""Weak prior that keeps an unobservable inverse depth finite, in 1 / unit of the translations."""


INFORMATION_MIN = 1e-2
"""What the images do not fix has a standard deviation of ten (rad, units), not none."""


@dataclass(frozen=True, slots=True, eq=False)
class DirectionPrior:
    """What odometry says of a view: its pose, and how far off rotation and direction may be."""

    T_view_query: Float
    rotation_sigma_rad: float
    direction_sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class TiltPrior:
    """Which way is up in both images, (3,) of length one, and how far apart these may be: two degrees of freedom."""

    up_query: Float
    up_view: Float
    sigma_rad: float

    def error_rad(self, R_view_query: Float) -> float:
        """Angle between the two directions under a rotation."""
        return float(np.arccos(np.clip(self.up_view @ (R_view_query @ self.up_query), -1.0, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class BundleView:
    """One image beside the query.

    Attributes:
        T_view_query: (4, 4) pose of the query camera in the view.
        observed: (N, 2) x/z and y/z of the points in the view; anything where not seen.
        seen: (N,) which points the view sees.
        focal_px: Turns errors into pixels.
        unit_translation: Whether the translation is a direction of length one.
        prior: What is known of the pose.
        tilt: What is known of roll and pitch.
    """

    T_view_query: Float
    observed: Float
    seen: Mask
    focal_px: float
    unit_translation: bool
    prior: DirectionPrior | None = None
    tilt: TiltPrior | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Refined poses and inverse depths.

    Attributes:
        views: The views with their refined poses.
        inverse_depths: (N,) in the query frame.
        cost: Sum of the robust costs, in units of the pixel noise.
        information: (6V, 6V) of the poses (rotation, translation; left perturbation), points marginalised.
    """

    views: tuple[BundleView, ...]
    inverse_depths: Float
    cost: float
    information: Float


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    cost: float
    H: Float
    b: Float
    H_depth: Float
    b_depth: Float
    H_mixed: Float


def refine(
    points: Float, inverse_depths: Float, views: tuple[BundleView, ...], sigma_px: float, iterations_max: int = 15
) -> Refined:
    """Minimise the reprojection errors over the views' poses and the inverse depths.

    Args:
        points: (N, 2) x/z and y/z of the points in the query.
        inverse_depths: (N,) initial inverse depths in the query frame.
        views: The views with initial poses.
        sigma_px: Noise of one coordinate; errors of several sigma lose their weight.
        iterations_max: Steps tried.
    """
    rays = np.column_stack([points, np.ones(len(points))])
    state = _linearise(rays, inverse_depths, views, sigma_px)
    damping = 1e-4
    for _ in range(iterations_max):
        moved_views, moved_depths = _step(state, views, inverse_depths, damping)
        candidate = _linearise(rays, moved_depths, moved_views, sigma_px)
        if not candidate.cost < state.cost:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        gain = state.cost - candidate.cost
        views, inverse_depths, state = moved_views, moved_depths, candidate
        damping = max(damping / 10.0, 1e-9)
        if gain < 1e-6 * state.cost + 1e-9:
            break
    reduced, _ = _reduce(state, 0.0)
    return Refined(views, inverse_depths, state.cost, reduced)


def reprojection_errors_px(points: Float, inverse_depths: Float, view: BundleView) -> Float:
    """Distances (N,) between where the view sees the points and where they project; infinite behind the view."""
    rays = np.column_stack([points, np.ones(len(points))])
    P = rays @ view.T_view_query[:3, :3].T + inverse_depths[:, None] * view.T_view_query[:3, 3]
    in_front = P[:, 2] > DEPTH_MIN
    projected = P[:, :2] / np.where(in_front, P[:, 2], 1.0)[:, None]
    errors = np.linalg.norm(projected - view.observed, axis=1) * view.focal_px
    return np.where(in_front, errors, np.inf)


def inverse_depths_from(points: Float, T_view_query: Float, observed: Float) -> Float:
    """Least-squares inverse depths (N,) of query points from one view, in 1 / unit of its translation."""
    rays = np.column_stack([points, np.ones(len(points))]) @ T_view_query[:3, :3].T
    seen = np.column_stack([observed, np.ones(len(observed))])
    t = np.broadcast_to(T_view_query[:3, 3], seen.shape)
    normal, offset = crossed(seen, t), crossed(seen, rays)
    return np.asarray(-(normal * offset).sum(axis=1) / np.maximum((normal * normal).sum(axis=1), 1e-12))


def crossed(a: Float, b: Float) -> Float:
    """Cross products (..., 3), bit for bit `np.cross`'s; that takes twice as long on arrays as small as these."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)


def tangent_basis(direction: Float) -> Float:
    """Two orthonormal columns (3, 2) perpendicular to a direction (3,)."""
    axis = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = crossed(direction, axis)
    first /= np.linalg.norm(first)
    second = crossed(direction, first)
    return np.column_stack([first, second / np.linalg.norm(second)])


def _linearise(rays: Float, inverse_depths: Float, views: tuple[BundleView, ...], sigma_px: float) -> _Linearised:
    """Cost, gradient and Gauss-Newton blocks of all views; translations with six columns even where length is fixed."""
    size, count = 6 * len(views), len(rays)
    H, b, H_mixed = np.zeros((size, size)), np.zeros(size), np.zeros((count, size))
    H_depth = np.full(count, INVERSE_DEPTH_SIGMA**-2)
    b_depth = inverse_depths * INVERSE_DEPTH_SIGMA**-2
    cost = 0.0
    for k, view in enumerate(views):
        block = slice(6 * k, 6 * k + 6)
        errors, J_pose, J_depth = _residuals(rays, inverse_depths, view, sigma_px)
        squared = (errors * errors).sum(axis=1)
        weights = np.where(view.seen, 1.0 / (1.0 + squared / CAUCHY_SCALE**2), 0.0)
        robust = CAUCHY_SCALE**2 * np.log1p(squared[view.seen] / CAUCHY_SCALE**2)
        cost += float(robust.sum())
        weighted = J_pose * weights[:, None, None]
        H[block, block] += np.einsum("nij,nik->jk", weighted, J_pose)
        b[block] += np.einsum("nij,ni->j", weighted, errors)
        H_mixed[:, block] += np.einsum("nij,ni->nj", weighted, J_depth)
        H_depth += weights * (J_depth * J_depth).sum(axis=1)
        b_depth += weights * (J_depth * errors).sum(axis=1)
        cost += _add_prior(view, H[block, block], b[block]) + _add_tilt(view, H[block, block], b[block])
    cost += float((inverse_depths**2).sum()) * INVERSE_DEPTH_SIGMA**-2
    return _Linearised(cost, H, b, H_depth, b_depth, H_mixed)


CAUCHY_SCALE = 3.0
"""Errors of this many sigma have half their weight."""


def _residuals(rays: Float, inverse_depths: Float, view: BundleView, sigma_px: float) -> tuple[Float, Float, Float]:
    """Errors (N, 2) in sigmas, and their derivatives by the pose (N, 2, 6) and by the inverse depth (N, 2)."""
    R, t = view.T_view_query[:3, :3], view.T_view_query[:3, 3]
    rotated = rays @ R.T
    P = rotated + inverse_depths[:, None] * t
    z = np.maximum(P[:, 2], DEPTH_MIN)
    projected = P[:, :2] / z[:, None]
    gain = view.focal_px / sigma_px
    errors = np.where(view.seen[:, None], (projected - view.observed) * gain, 0.0)
    J_P = np.zeros((len(rays), 2, 3))
    J_P[:, 0, 0] = J_P[:, 1, 1] = gain / z
    J_P[:, :, 2] = -projected * (gain / z)[:, None]
    J_rotation = crossed(rotated[:, None, :], J_P)
    J_pose = np.concatenate([J_rotation, J_P * inverse_depths[:, None, None]], axis=2)
    return errors, J_pose, J_P @ t


def _add_prior(view: BundleView, H: Float, b: Float) -> float:
    """Add the view's prior to its blocks and return its cost."""
    if view.prior is None:
        return 0.0
    expected = view.prior.T_view_query
    rotation_error = so3_log(view.T_view_query[:3, :3] @ expected[:3, :3].T) / view.prior.rotation_sigma_rad
    direction = expected[:3, 3] / np.linalg.norm(expected[:3, 3])
    direction_error = (view.T_view_query[:3, 3] - direction) / view.prior.direction_sigma_rad
    H[:3, :3] += np.eye(3) * view.prior.rotation_sigma_rad**-2
    H[3:, 3:] += np.eye(3) * view.prior.direction_sigma_rad**-2
    b[:3] += rotation_error / view.prior.rotation_sigma_rad
    b[3:] += direction_error / view.prior.direction_sigma_rad
    return float(rotation_error @ rotation_error + direction_error @ direction_error)


def _add_tilt(view: BundleView, H: Float, b: Float) -> float:
    """Add what is known of roll and pitch to the view's blocks and return its cost."""
    if view.tilt is None:
        return 0.0
    turned = view.T_view_query[:3, :3] @ view.tilt.up_query
    error = crossed(view.tilt.up_view, turned) / view.tilt.sigma_rad
    J = -hat(view.tilt.up_view) @ hat(turned) / view.tilt.sigma_rad
    H[:3, :3] += J.T @ J
    b[:3] += J.T @ error
    return float(error @ error)


def _reduce(state: _Linearised, damping: float) -> tuple[Float, Float]:
    """Marginalise the inverse depths: the poses' normal equations."""
    inverse = 1.0 / (state.H_depth * (1.0 + damping))
    scaled = state.H_mixed * inverse[:, None]
    return state.H - state.H_mixed.T @ scaled, state.b - scaled.T @ state.b_depth


def _step(
    state: _Linearised, views: tuple[BundleView, ...], inverse_depths: Float, damping: float
) -> tuple[tuple[BundleView, ...], Float]:
    """Solve the damped normal equations and move poses and inverse depths."""
    H, b = _reduce(state, damping)
    basis = free_directions(views)
    H_free = basis.T @ H @ basis
    H_free += damping * np.diag(np.diag(basis.T @ state.H @ basis) + 1e-9)
    delta = -basis @ np.linalg.lstsq(H_free, basis.T @ b, rcond=None)[0]
    step_depth = -(state.b_depth + state.H_mixed @ delta) / (state.H_depth * (1.0 + damping))
    moved = tuple(_moved(view, delta[6 * k : 6 * k + 6]) for k, view in enumerate(views))
    return moved, inverse_depths + step_depth


def free_directions(views: tuple[BundleView, ...]) -> Float:
    """Orthonormal columns (6V, F) that span the poses' degrees of freedom."""
    columns = []
    for k, view in enumerate(views):
        block = np.zeros((6 * len(views), 5 if view.unit_translation else 6))
        block[6 * k : 6 * k + 3, :3] = np.eye(3)
        translation = tangent_basis(view.T_view_query[:3, 3]) if view.unit_translation else np.eye(3)
        block[6 * k + 3 : 6 * k + 6, 3:] = translation
        columns.append(block)
    return np.concatenate(columns, axis=1)


def _moved(view: BundleView, delta: Float) -> BundleView:
    """Rotate the view's pose from the left and shift its translation."""
    t = view.T_view_query[:3, 3] + delta[3:]
    if view.unit_translation:
        t = t / np.linalg.norm(t)
    return replace(view, T_view_query=pose(so3_exp(delta[:3]) @ view.T_view_query[:3, :3], t))


def covariance_of_view(refined: Refined, k: int, sigma_floor: Float) -> Float:
    """Covariance (6, 6) of view k as seen from the query: of `T_query_view`, right perturbation, GTSAM's order.

    Args:
        refined: Result of `refine`.
        k: Which view.
        sigma_floor: (6,) standard deviations that are added; no estimate is better than its calibration.
    """
    basis = free_directions(refined.views)
    information = basis.T @ refined.information @ basis
    values, vectors = np.linalg.eigh(information)
    vectors = basis @ vectors
    full = (vectors / np.maximum(values, INFORMATION_MIN)) @ vectors.T
    block = full[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
    A = -np.eye(6)
    A[3:, :3] = -hat(refined.views[k].T_view_query[:3, 3])
    return np.asarray(A @ block @ A.T + np.diag(sigma_floor**2))
