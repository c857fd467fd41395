"""Two consecutive keyframes as pictures alone see them: matched rays, and the motion that they give.

Everything is a function of one number, the focal length's factor: with a focal length `factor` times the configured
one, a ray (x, y, 1) was (x / factor, y / factor, 1) in truth. Matches are verified by a fundamental matrix, which does
not care for the focal length.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import between, so3_log
from flocc_agent.perception.multiview.bundle import BundleView, covariance_of_view, inverse_depths_from, refine
from flocc_agent.perception.multiview.degeneracy import rotation_share
from flocc_agent.perception.multiview.two_view import essential_pose, usac_parameters
from flocc_agent.perception.multiview.view_parameters import Geometry, LocalFeatures, Matched

Float = NDArray[np.float64]

GEOMETRY = Geometry(iterations_max=300)
POINTS_MAX = 150
"""Matches that are kept of a pair; more make no rotation surer than calibration allows."""
POINTS_MIN = 15
ROTATION_ONLY_SHARE = 0.8
"""Where a rotation explains this share of the matches, the direction of motion is not looked at."""
DIRECTION_SIGMA_MAX_RAD = 0.15
FAR_M = 60.0
MOVES_MIN_PX = 6.0
"""A motion, by odometry, that moves a point that far away by so much leaves no point of the scene where it was."""
STAYS_MAX_PX = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """Verified matches of a keyframe and the one before it.

    Attributes:
        before: (N, 2) rays x/z, y/z in the earlier picture, by the configured camera.
        now: (N, 2) rays in the later picture.
        focal_px: Of the searched picture.
        T_odom_before: (4, 4) camera poses by odometry, metres.
        T_odom_now: The same of the later one.
    """

    before: Float
    now: Float
    focal_px: float
    T_odom_before: Float
    T_odom_now: Float


@dataclass(frozen=True, slots=True, eq=False)
class SeenMotion:
    """What pictures say of a pair.

    Attributes:
        turn_rad: (3,) rotation vector of the later camera in the earlier one.
        direction: (3,) of its motion, of length one; None where pictures do not fix it.
    """

    turn_rad: Float
    direction: Float | None


def flow_of(
    before: LocalFeatures, now: LocalFeatures, matched: Matched, T_odom_before: Float, T_odom_now: Float
) -> Flow | None:
    """Keep the matches (of `now` with `before`) that any one pinhole camera could have seen; None where few are."""
    indices_now, indices_before = matched
    a, b = before.points[indices_before].astype(np.float64), now.points[indices_now].astype(np.float64)
    moves = moves_with_the_scene(a, b, now.focal_px, between(T_odom_before, T_odom_now))
    a, b = a[moves], b[moves]
    if len(a) < POINTS_MIN:
        return None
    kept = _of_one_camera(a, b, now.focal_px)
    if len(kept) < POINTS_MIN:
        return None
    kept = kept[np.linspace(0, len(kept) - 1, min(len(kept), POINTS_MAX)).astype(np.intp)]
    return Flow(a[kept], b[kept], now.focal_px, T_odom_before, T_odom_now)


def _of_one_camera(before: Float, now: Float, focal_px: float) -> NDArray[np.intp]:
    """Indices of the matches that agree with one fundamental matrix; none where nothing does.

    OpenCV 5.0 raises on about half of all sets of matches that agree with none.
    """
    try:
        _, mask = cv2.findFundamentalMat(before, now, usac_parameters(Geometry(), focal_px))
    except cv2.error:
        mask = None
    return np.zeros(0, np.intp) if mask is None else np.flatnonzero(mask.ravel())


def moves_with_the_scene(before: Float, now: Float, focal_px: float, T_before_now: Float) -> NDArray[np.bool_]:
    """(N,) which matches of two own pictures do not stay at their pixel though the robot's motion must move them.

    Args:
        before: (N, 2) rays x/z, y/z in the earlier picture.
        now: (N, 2) rays in the later one.
        focal_px: Of the picture.
        T_before_now: (4, 4) later camera in the earlier one, by odometry, metres.
    """
    far = np.column_stack([now, np.ones(len(now))]) @ T_before_now[:3, :3].T + T_before_now[:3, 3] / FAR_M
    must_px = np.linalg.norm(far[:, :2] / np.maximum(far[:, 2:], 1e-3) - now, axis=1) * focal_px
    return np.asarray((must_px < MOVES_MIN_PX) | (np.linalg.norm(now - before, axis=1) * focal_px > STAYS_MAX_PX))


def seen_motion(flow: Flow, focal_factor: float = 1.0, mirrored: bool = False) -> SeenMotion | None:
    """The motion with another focal length, or with the pictures mirrored back; None where there is none."""
    stretch = np.array([-1.0 if mirrored else 1.0, 1.0]) / focal_factor
    before, now, focal_px = flow.before * stretch, flow.now * stretch, flow.focal_px * focal_factor
    found = essential_pose(now, before, focal_px, GEOMETRY)
    if found is None or int(found[1].sum()) < POINTS_MIN:
        return None
    T, agree = found
    view = BundleView(T, before[agree], np.ones(int(agree.sum()), np.bool_), focal_px, unit_translation=True)
    refined = refine(now[agree], inverse_depths_from(now[agree], T, before[agree]), (view,), GEOMETRY.sigma_px)
    view = refined.views[0]
    covariance = covariance_of_view(refined, 0, np.zeros(6))
    direction_sigma_rad = float(np.sqrt(max(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]), 0.0)))
    is_fixed = (
        direction_sigma_rad < DIRECTION_SIGMA_MAX_RAD
        and rotation_share(now[agree], view, GEOMETRY) < ROTATION_ONLY_SHARE
    )
    T = view.T_view_query
    return SeenMotion(so3_log(T[:3, :3]), T[:3, 3] / np.linalg.norm(T[:3, 3]) if is_fixed else None)
