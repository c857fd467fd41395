"""What `nav_msgs/Odometry` says of its own exactness, as the measurement that a keyframe keeps.

ROS gives the covariance of the whole way from where odometry began; a keyframe keeps that of the step from the keyframe
before. The one follows from the other where covariances grow as odometry integrates them. Where they do not (constant,
zeros), they say nothing of a step, and nothing is made of them.
"""

from bisect import bisect_right
from collections import deque

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.measurements import BadMeasurement, OdometryCovariance
from flocc_agent.geometry import hat

Float = NDArray[np.float64]

SAMPLES_MAX = 4096
GROWTH_MIN_RATIO = 1e-6
"""A step's smallest variance over its largest, at least; below it the difference of two covariances is rounding."""


def step_covariance(T_odom_before: Float, before: Float, T_odom_after: Float, after: Float) -> Float | None:
    """Covariance of a step, out of those of the ways to its ends.

    An error of the way to the first end moves the second by `dp + dw x (p_after - p_before)` and turns it by `dw`; what
    the second covariance has besides is the step's.

    Args:
        T_odom_before: (4, 4) of the body at the step's begin.
        before: (6, 6) as ROS has it: x, y, z, then rotations about the axes of odom.
        T_odom_after: (4, 4) at its end.
        after: (6, 6) likewise.

    Returns:
        (6, 6) in the tangent of the body's pose at the end, rotation first; None where it is not positive definite.
    """
    carried = np.eye(6)
    carried[:3, 3:] = -hat(T_odom_after[:3, 3] - T_odom_before[:3, 3])
    added = after - carried @ before @ carried.T
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = T_odom_after[:3, :3].T  # translation first in ROS, rotation first here
    step = turn @ (0.5 * (added + added.T)) @ turn.T
    if not np.all(np.isfinite(step)):
        return None
    variances = np.linalg.eigvalsh(step)
    return step if variances[0] > GROWTH_MIN_RATIO * abs(variances[-1]) > 0 else None


class StepCovariances:
    """Covariances of a robot's odometry as they come, and those of the steps between its keyframes."""

    def __init__(self) -> None:
        self._stamps_ns: deque[int] = deque(maxlen=SAMPLES_MAX)
        self._covariances: deque[Float] = deque(maxlen=SAMPLES_MAX)
        self._before: tuple[Float, Float] | None = None

    def add(self, stamp_ns: int, covariance: Float) -> None:
        """Take in what an Odometry message says of its pose, (6, 6)."""
        self._stamps_ns.append(stamp_ns)
        self._covariances.append(covariance)

    def of_keyframe(self, stamp_ns: int, T_odom_body: Float) -> OdometryCovariance | None:
        """Measurement of the step from the keyframe before to this one; None where nothing is known of it."""
        at = bisect_right(self._stamps_ns, stamp_ns)
        if at == 0:
            self._before = None
            return None
        before, self._before = self._before, (T_odom_body, self._covariances[at - 1])
        step = None if before is None else step_covariance(*before, *self._before)
        try:
            return None if step is None else OdometryCovariance(step)
        except BadMeasurement:
            return None
