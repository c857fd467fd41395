"""Whether a robot's odometry began anew while it was off: what follows is then another journey, with another log."""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.robot import Robot
from flocc_agent.geometry import angle_rad, between, inverse, pose_from_tq
from flocc_protocol.records import KeyframeRecord

Float = NDArray[np.float64]

AT_ORIGIN_M, AT_ORIGIN_RAD = 0.5, 0.2
"""Odometry that has just begun lies so near the origin of its frame."""
ELSEWHERE_M, ELSEWHERE_RAD = 2.0, 0.6
"""The last keyframe before lies so far from there; a robot that stopped where it began goes on with its log."""


def last_keyframe(robot: Robot) -> KeyframeRecord | None:
    """The last keyframe of the robot's own log; None where it has none."""
    records = reversed(robot.gossip.logs[robot.log].records)
    return next((record for record in records if isinstance(record, KeyframeRecord)), None)


def last_body(robot: Robot, T_body_camera: Float) -> Float | None:
    """`T_odom_body` (4, 4) at the last keyframe of the robot's own log; None where it has none."""
    last = last_keyframe(robot)
    return None if last is None else np.asarray(pose_from_tq(np.array(last.T_odom_camera)) @ inverse(T_body_camera))


def began_anew(T_odom_before: Float | None, T_odom_body: Float) -> bool:
    """Whether the first pose (4, 4) after a start is that of odometry which began meanwhile.

    It is where the pose lies at the origin of its frame and the last keyframe before did not. A robot that was driven
    back to its start while it was off looks the same: it gets another log, which closures join, and loses nothing.
    """
    if T_odom_before is None or not _is_near(np.eye(4), T_odom_body, AT_ORIGIN_M, AT_ORIGIN_RAD):
        return False
    return not _is_near(T_odom_before, T_odom_body, ELSEWHERE_M, ELSEWHERE_RAD)


def _is_near(T_a: Float, T_b: Float, distance_m: float, rotation_rad: float) -> bool:
    T = between(T_a, T_b)
    return bool(np.linalg.norm(T[:3, 3]) <= distance_m) and angle_rad(T[:3, :3]) <= rotation_rad
