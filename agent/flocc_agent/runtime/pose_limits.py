"""Which odometry can be: near enough for the wire, slower than any robot, and newer than what came before.

What cannot be is refused where it comes in; behind this gate every pose fits a record.
"""

from numbers import Real

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import is_rigid
from flocc_protocol.codec import COORDINATE_MAX

Float = NDArray[np.float64]

SPEED_MAX_M_S = 1000.0
"""No robot moves faster: what does is a broken pose, or a stamp in another unit."""

MOUNT_MAX_M = 1000.0
"""How far from the body a camera may sit."""

POSITION_MAX_M = COORDINATE_MAX - MOUNT_MAX_M
"""Largest coordinate of a body, so that its camera's pose fits a record."""

STAMP_MAX_S = 1e12
"""Largest stamp that a record takes."""

BREAK_RATIO, BREAK_MIN_M, BREAK_MIN_RAD = 10.0, 0.5, 0.5
ACCELERATION_MAX_M_PER_S2, TURN_MAX_RAD_S = 100.0, 12.0
"""A step so far, so fast against those beside it and beyond these is where odometry begins anew."""


class PoseGate:
    """Remembers the last pose that was let in, and says what is wrong with the next."""

    def __init__(self) -> None:
        self._last: tuple[float, Float] | None = None
        self._kept = False

    def fault(self, T_odom_body: Float, stamp_s: float) -> str | None:
        """What is wrong with a pose, or None; a frame that did not become a keyframe may be given once more.

        Args:
            T_odom_body: What should be a (4, 4) pose, metres.
            stamp_s: When, seconds.
        """
        if (fault := pose_fault(T_odom_body)) is not None:
            return fault
        if not _is_number(stamp_s):
            return f"its stamp is no number of seconds but {type(stamp_s).__name__}"
        if not abs(stamp_s) <= STAMP_MAX_S:
            return f"its stamp is not within {STAMP_MAX_S:g} s"
        if self._last is None:
            return None
        last_s, T_odom_last = self._last
        if stamp_s < last_s or (stamp_s == last_s and self._kept):
            return f"it is not newer than the one before, at {last_s} s"
        return step_fault(np.asarray(T_odom_body)[:3, 3] - T_odom_last[:3, 3], stamp_s - last_s)

    def let_in(self, T_odom_body: Float, stamp_s: float, kept: bool) -> None:
        """A pose without fault came; `kept` says whether it became a keyframe."""
        self._last, self._kept = (stamp_s, np.array(T_odom_body, dtype=float)), kept


def pose_fault(T: Float) -> str | None:
    """Why an array is no pose (4, 4) of a body, or None."""
    try:
        T = np.asarray(T, dtype=float)
    except (TypeError, ValueError):
        return "its pose is no array of numbers"
    if T.shape != (4, 4):
        return f"its pose has the shape {T.shape}, not (4, 4)"
    if not is_rigid(T):
        return "its pose is not finite and rigid"
    return position_fault(T[:3, 3])


def position_fault(position_m: Float) -> str | None:
    """Why a body cannot be at a finite position (3,), or None."""
    farthest_m = float(np.max(np.abs(position_m)))
    if farthest_m > POSITION_MAX_M:
        return f"its position {farthest_m:.6g} m is over 10000 km from the origin"
    return None


def step_fault(moved_m: Float, after_s: float) -> str | None:
    """Why a body cannot have moved so far (3, metres) in that time, or None."""
    far_m = float(np.linalg.norm(moved_m))
    if far_m > SPEED_MAX_M_S * after_s:
        return f"it lies {far_m:.6g} m from the pose {after_s:.6g} s before, which is faster than {SPEED_MAX_M_S:g} m/s"
    return None


def possible(stamps_s: Float, positions_m: Float) -> NDArray[np.bool_]:
    """Which poses of a trajectory can be, where some lie farther from the others than a robot gets in the time.

    The longest part without such a step is believed; from its ends each pose must be in reach of the last good one.

    Args:
        stamps_s: (N,) increasing, seconds.
        positions_m: (N, 3).

    Returns:
        (N,) bool.
    """
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    breaks = np.flatnonzero(steps_m > SPEED_MAX_M_S * np.diff(stamps_s)) + 1
    good = np.ones(len(stamps_s), dtype=bool)
    if not len(breaks):
        return good
    bounds = np.concatenate([[0], breaks, [len(stamps_s)]])
    longest = int(np.argmax(np.diff(bounds)))
    first, end = int(bounds[longest]), int(bounds[longest + 1])
    for way in (range(end, len(stamps_s)), range(first - 1, -1, -1)):
        last = end - 1 if way.step > 0 else first
        for k in way:
            reach_m = SPEED_MAX_M_S * abs(stamps_s[k] - stamps_s[last])
            good[k] = np.linalg.norm(positions_m[k] - positions_m[last]) <= reach_m
            last = k if good[k] else last
    return good


STILL_M = 1e-6
TURNS_SAMPLED, TURN_COS_MAX = 20, 0.5
"""A path of straight pieces turns where one of so many leads 60 degrees off the first."""


def oddity(positions_m: Float, rotations: Float) -> str | None:
    """What poses say that no robot's odometry does, though each can be: that nothing moves, or nothing but positions.

    Args:
        positions_m: (N, 3) in order of time.
        rotations: (N, ...) matrices or quaternions.
    """
    if len(positions_m) < 3 or np.ptp(rotations, axis=0).max() > 0.0:
        return None
    if np.ptp(positions_m, axis=0).max() <= STILL_M:
        return "all poses are one: nothing moves"
    sampled = positions_m[np.linspace(0, len(positions_m) - 1, min(TURNS_SAMPLED, len(positions_m))).astype(int)]
    moved_m = np.diff(sampled, axis=0)
    length_m = np.linalg.norm(moved_m, axis=1)
    far = moved_m[length_m > 0.5 * length_m.mean()]
    ways = far / np.linalg.norm(far, axis=1, keepdims=True)
    if np.min(ways @ ways[0]) < TURN_COS_MAX:
        return "rotations never change though the path turns, as where only positions are known"
    return None


RESET_STEPS, RESET_MIN_M = 2.0, 0.1
"""A step to the origin is so many times the median one that moves, and so long."""
SPIKE_STEPS = 20.0
SPIKE_MIN_M = 10.0
SPIKE_POSES_MIN = 8


def spikes(positions_m: Float) -> NDArray[np.bool_]:
    """Single poses that jump away from both sides and back, far beyond any other step; of no speed, so of any stamps.

    Args:
        positions_m: (N, 3) in order of time.

    Returns:
        (N,) bool; all False where there are too few poses to tell.
    """
    found = np.zeros(len(positions_m), dtype=bool)
    if len(positions_m) < SPIKE_POSES_MIN:
        return found
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    far_m = max(SPIKE_MIN_M, SPIKE_STEPS * float(np.quantile(steps_m, 0.75)))
    away_m = np.minimum(steps_m[:-1], steps_m[1:])
    across_m = np.linalg.norm(positions_m[2:] - positions_m[:-2], axis=1)
    found[1:-1] = (away_m > far_m) & (across_m < 0.1 * away_m)
    return found


def reset_poses(T: Float) -> NDArray[np.bool_]:
    """Poses (N, 4, 4) that are exactly the identity, between poses of which neither neighbour is near it.

    Programs write it where they have lost themselves. A robot that comes back to where it began gets there in steps
    like all others, and its numbers never become whole; where it stands there at first, nothing is before it.
    """
    at_origin = np.all(np.eye(4) == T, axis=(1, 2))
    found = np.zeros(len(T), dtype=bool)
    runs = np.flatnonzero(np.diff(np.concatenate([[False], at_origin, [False]]).astype(int)))
    steps_m = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    moves_m = steps_m[steps_m > STILL_M]
    if len(runs) == 0 or len(moves_m) == 0:
        return found
    far_m = max(RESET_MIN_M, RESET_STEPS * float(np.median(moves_m)))
    for first, end in zip(runs[::2], runs[1::2], strict=True):
        before = [float(steps_m[first - 1])] if first > 0 else []
        after = [float(steps_m[end - 1])] if end < len(T) else []
        if before and min(before + after) > far_m:
            found[first:end] = True
    return found


def breaks(stamps_s: Float, T: Float) -> NDArray[np.bool_]:
    """Poses (N, 4, 4) to which a step leads that is unlike the steps before and after it, at increasing times (N,).

    Such a step is `BREAK_RATIO` times as fast as both, and needs an acceleration that no robot survives, or a turn that
    no gyroscope measures.
    """
    found = np.zeros(len(T), dtype=bool)
    if len(T) < 4:
        return found
    step_s = np.diff(stamps_s)
    R = T[:, :3, :3]
    moved_m = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    turned_rad = np.arccos(np.clip(0.5 * (np.einsum("nij,nij->n", R[:-1], R[1:]) - 1.0), -1.0, 1.0))

    def beside(amount: Float) -> Float:
        rate = amount / step_s
        return np.asarray(np.maximum(np.r_[0.0, rate[:-1]], np.r_[rate[1:], 0.0]))

    inner = _is_break(moved_m, turned_rad, step_s, beside(moved_m), beside(turned_rad))
    found[2:-1] = inner[1:-1]
    return found


def is_break(moved_m: float, turned_rad: float, step_s: float, m_per_s: float, rad_per_s: float) -> bool:
    """Whether a step is one where odometry begins anew, by the speed of the step before alone."""
    step = (np.array([value]) for value in (moved_m, turned_rad, step_s, m_per_s, rad_per_s))
    return bool(_is_break(*step)[0])


def _is_break(moved_m: Float, turned_rad: Float, step_s: Float, m_per_s: Float, rad_per_s: Float) -> NDArray[np.bool_]:
    """Which steps (N,) are so, by the speeds beside each."""

    def lonely(amount: Float, amount_min: float, beside: Float, rate_min: Float | float) -> NDArray[np.bool_]:
        rate = amount / step_s
        return np.asarray((amount > amount_min) & (rate > BREAK_RATIO * beside) & (rate - beside > rate_min))

    moved = lonely(moved_m, BREAK_MIN_M, m_per_s, ACCELERATION_MAX_M_PER_S2 * step_s)
    return moved | lonely(turned_rad, BREAK_MIN_RAD, rad_per_s, TURN_MAX_RAD_S)


def _is_number(value: object) -> bool:
    return isinstance(value, Real)
