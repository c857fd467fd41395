"""Steps of odometry that nobody measured: it paused, or jumped because it began anew.

A robot that is switched off, carried and switched on again goes on from its last pose, and an estimator that lost
track begins at another one. Such a step says where the next poses start, and nothing of where the robot is: it gets a
covariance that lets loop closures decide. Where it was right after all, they say so.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.measurements import OdometryCovariance
from flocc_agent.geometry import angle_rad, between
from flocc_agent.runtime.pose_limits import breaks, is_break

Float = NDArray[np.float64]

PAUSE_MIN_S, PAUSE_STEPS = 5.0, 10.0
"""A pause is as long, and as many times the median step: photographs may be minutes apart."""
POSES_MIN = 8
SPEED_M_S, TURN_RAD_S = 1.5, 0.5
"""How a robot may be carried meanwhile: one standard deviation."""
JUMP_RATIO = 3.0
"""Of a jump's length: where the robot truly was may be as far from where odometry says."""
ANYWHERE_RAD = float(np.pi)
LEAST_M, ANYWHERE_M = 1.0, 1e5
"""Beyond a hundred kilometres a larger one would change nothing, and make the solver's system worse."""
STEPS_REMEMBERED = 20
UNMEASURED_MAX = 16


def pauses(stamps_s: Float) -> NDArray[np.intp]:
    """Poses before which odometry paused, by stamps (N,) that increase."""
    if len(stamps_s) < POSES_MIN:
        return np.empty(0, dtype=np.intp)
    steps_s = np.diff(stamps_s)
    return np.flatnonzero(steps_s > max(PAUSE_MIN_S, PAUSE_STEPS * float(np.median(steps_s)))) + 1


def unmeasured(
    stamps_s: Float, T_odom_body: Float, paused: NDArray[np.intp] | None = None
) -> dict[int, OdometryCovariance]:
    """Steps that nobody measured, by the pose that each leads to.

    Args:
        stamps_s: (N,) increasing.
        T_odom_body: (N, 4, 4).
        paused: What `pauses` found in these stamps; None finds it.

    Returns:
        How exact these steps are, in the tangent of the later pose.
    """
    paused = pauses(stamps_s) if paused is None else paused
    found = {int(k): after_pause(float(stamps_s[k] - stamps_s[k - 1])) for k in paused}
    for k in np.flatnonzero(breaks(stamps_s, T_odom_body)).tolist():
        found[k] = after_jump(T_odom_body[k - 1], T_odom_body[k])
    return found


def after_pause(pause_s: float) -> OdometryCovariance:
    """How exact a step is during which nothing was measured for so long."""
    return _covariance(TURN_RAD_S * pause_s, SPEED_M_S * pause_s)


def after_jump(T_before: Float, T_after: Float) -> OdometryCovariance:
    """How exact a step is with which odometry began anew, between two poses (4, 4)."""
    return _covariance(ANYWHERE_RAD, JUMP_RATIO * float(np.linalg.norm(T_after[:3, 3] - T_before[:3, 3])))


def together(steps: Sequence[OdometryCovariance]) -> OdometryCovariance:
    """How exact odometry is over several such steps."""
    return OdometryCovariance(np.sum([step.covariance for step in steps], axis=0))


def _covariance(rotation_rad: float, translation_m: float) -> OdometryCovariance:
    sigmas = [min(rotation_rad, ANYWHERE_RAD)] * 3 + [min(max(translation_m, LEAST_M), ANYWHERE_M)] * 3
    return OdometryCovariance(np.diag(np.square(sigmas)))


class StepWatch:
    """The same of poses that come one by one: a step is judged by those before it."""

    def __init__(self, pauses_count: bool) -> None:
        """Start without any.

        Args:
            pauses_count: These are all poses of odometry, so that a pause is one of odometry, not of the camera.
        """
        self._pauses_count = pauses_count
        self._last: tuple[float, Float] | None = None
        self._steps_s: deque[float] = deque(maxlen=STEPS_REMEMBERED)
        self._rates: tuple[float, float] | None = None
        self._found: deque[tuple[float, OdometryCovariance]] = deque(maxlen=UNMEASURED_MAX)
        self._has_keyframe = False

    def saw(self, stamp_s: float, T_odom_body: Float) -> None:
        """Look at a pose (4, 4), newer than those before."""
        last, self._last = self._last, (stamp_s, np.array(T_odom_body, dtype=float))
        if last is None or stamp_s <= last[0]:
            return
        step_s, T_step = stamp_s - last[0], between(last[1], self._last[1])
        moved_m, turned_rad = float(np.linalg.norm(T_step[:3, 3])), angle_rad(T_step[:3, :3])
        before, self._rates = self._rates, (moved_m / step_s, turned_rad / step_s)
        known = len(self._steps_s) >= POSES_MIN
        paused_s = max(PAUSE_MIN_S, PAUSE_STEPS * float(np.median(self._steps_s))) if known else float("inf")
        self._steps_s.append(step_s)
        if before is not None and known and is_break(moved_m, turned_rad, step_s, *before):
            self._found.append((stamp_s, after_jump(last[1], self._last[1])))
            self._rates = before
        elif self._pauses_count and step_s > paused_s:
            self._found.append((stamp_s, after_pause(step_s)))

    def of_keyframe(self, stamp_s: float) -> OdometryCovariance | None:
        """How exact odometry is to a keyframe from the one before; None where it was measured. Asked in their order."""
        is_first, self._has_keyframe = not self._has_keyframe, True
        found: list[OdometryCovariance] = []
        while self._found and self._found[0][0] <= stamp_s:
            found.append(self._found.popleft()[1])
        return None if is_first or not found else together(found)
