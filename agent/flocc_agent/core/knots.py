"""Knots: a leader's solution of a log as a few corrections of that log's own odometry.

What a solution does to odometry changes slowly along a log, so a few knots say it within a centimetre and a tenth of a
degree. The same function gives poses to whoever chooses the knots and to whoever uses them, so what is checked is what
is shown. Twists turn about a point of the log, so that frames with a far origin (UTM) lose nothing.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import (
    Float,
    inverse,
    pose,
    pose7,
    pose_from_tq,
    poses_of_twists,
    twists_of_poses,
    upper_triangle,
)
from flocc_protocol.arrays import Array
from flocc_protocol.codec import Pose7
from flocc_protocol.messages import KNOTS_MAX, Knots, LogCorrection

TRANSLATION_BOUND_M = 0.01
ROTATION_BOUND_RAD = np.deg2rad(0.1)
"""Poses that consumers get differ from the leader's solution by at most this."""
CHOSEN_WITHIN = 0.7
"""Share of the bounds within which knots are chosen; the rest is room for the solution to move."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One log's part of a solution.

    Attributes:
        T_odom_camera: (N, 4, 4) as recorded.
        T_map_camera: (N, 4, 4) as solved.
        T_map_odom: (4, 4), of the last of them.
        covariance: (6, 6) of T_map_odom, or None.
    """

    T_odom_camera: Float
    T_map_camera: Float
    T_map_odom: Float
    covariance: Float | None


def corrected(correction: LogCorrection, T_odom_camera: Float, numbers: NDArray[np.integer]) -> Float:
    """Corrected poses (N, 4, 4) of keyframes (N, 4, 4) with these numbers (N,)."""
    T_map_odom, knots = pose_from_tq(np.array(correction.T_map_odom)), correction.knots
    if knots is None or not len(numbers):
        return np.asarray(T_map_odom @ T_odom_camera)
    twists, about_m = knots.twists.numpy(), knots.about_odom_m.numpy()
    return np.asarray(T_map_odom @ bent(knots.keyframes.numpy(), twists, about_m, numbers) @ T_odom_camera)


def bent(
    keyframes: Float | NDArray[np.integer], twists: Float, about_odom_m: Float, numbers: NDArray[np.integer]
) -> Float:
    """What knots at keyframes do to poses of a log in its odom frame: (N, 4, 4), or (4, 4) where it is nothing."""
    if not twists.any():
        return np.eye(4)
    twists = _between(keyframes, twists, numbers)
    return np.asarray(_moved(about_odom_m) @ poses_of_twists(twists) @ _moved(-about_odom_m))


def strays(correction: LogCorrection, track: Track) -> float:
    """How far a correction is from a solution at the worst keyframe, in bounds; above 1 consumers would notice."""
    poses = corrected(correction, track.T_odom_camera, np.arange(len(track.T_odom_camera)))
    return float(_errors(poses, track.T_map_camera).max(initial=0.0))


def knots_of(track: Track) -> tuple[Pose7, Knots]:
    """T_map_odom as it is told, and as many knots as say the solution within `CHOSEN_WITHIN` of the bounds.

    The worst keyframe of each stretch becomes a knot, until none is beyond the bounds; where a message does not hold so
    many, the bounds are widened. Odometry that was moved as a whole needs no twists.
    """
    told = pose7(track.T_map_odom)
    about_m = track.T_odom_camera[-1, :3, 3]
    covariance = None if track.covariance is None else upper_triangle(track.covariance)
    moved = pose_from_tq(np.array(told)) @ track.T_odom_camera
    if _errors(moved, track.T_map_camera).max() <= CHOSEN_WITHIN:
        ends = np.unique([0, len(moved) - 1])
        return told, Knots(
            covariance, Array.of(about_m, "f8"), Array.of(ends, "u4"), Array.of(np.zeros((len(ends), 6)), "f4")
        )
    T_point_camera = _moved(-about_m) @ track.T_odom_camera
    T_map_point = pose_from_tq(np.array(told)) @ _moved(about_m)
    targets = inverse(T_map_point) @ track.T_map_camera @ inverse(T_point_camera)
    twists = twists_of_poses(targets).astype(np.float32).astype(np.float64)
    keyframes = _chosen(twists, targets @ T_point_camera, T_point_camera)
    return told, Knots(
        covariance=covariance,
        about_odom_m=Array.of(about_m, "f8"),
        keyframes=Array.of(keyframes, "u4"),
        twists=Array.of(twists[keyframes], "f4"),
    )


def _chosen(twists: Float, T_point_target: Float, T_point_camera: Float) -> NDArray[np.integer]:
    """Numbers of the keyframes that become knots."""
    numbers = np.arange(len(twists))
    bound = CHOSEN_WITHIN
    knots = np.array(sorted({0, len(twists) - 1}))
    open_ = numbers
    while len(open_):
        poses = poses_of_twists(_between(knots, twists[knots], open_)) @ T_point_camera[open_]
        errors = _errors(poses, T_point_target[open_])
        stretches = np.searchsorted(knots, open_, side="right")
        order = np.lexsort((-errors, stretches))
        worst = order[np.unique(stretches[order], return_index=True)[1]]
        bad = worst[errors[worst] > bound]
        if len(knots) + len(bad) > KNOTS_MAX:
            bound *= 2.0
            continue
        knots = np.sort(np.concatenate([knots, open_[bad]]))
        open_ = open_[np.isin(stretches, stretches[bad]) & ~np.isin(open_, knots)]
    return knots


def _between(knots: Float | NDArray[np.integer], twists: Float, numbers: NDArray[np.integer]) -> Float:
    """Twists (N, 6) at keyframes, interpolated between knots and the same beyond the first and the last."""
    return np.stack([np.interp(numbers, knots, column) for column in twists.T], axis=1)


def distances(T_a: Float, T_b: Float) -> tuple[Float, Float]:
    """How far poses (N, 4, 4) are apart: metres (N,) and angles (N,).

    Two rotations by an angle apart differ by 8 sin^2(angle / 2) in the sum of their squared entries.
    """
    squares = np.square(T_a[:, :3] - T_b[:, :3]).sum(axis=1)
    turn_rad = 2.0 * np.arcsin(np.minimum(np.sqrt(squares[:, :3].sum(axis=1) / 8.0), 1.0))
    return np.sqrt(squares[:, 3]), turn_rad


def _errors(T_a: Float, T_b: Float) -> Float:
    """Distances of poses (N, 4, 4), in bounds of translation or rotation, whichever is more."""
    shift_m, turn_rad = distances(T_a, T_b)
    return np.asarray(np.maximum(shift_m / TRANSLATION_BOUND_M, turn_rad / ROTATION_BOUND_RAD))


def _moved(t_m: Float) -> Float:
    return pose(np.eye(3), t_m)
