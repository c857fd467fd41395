"""Whether ground truth turns when odometry does: of another clock it makes errors that no robot has."""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.datasets.clocks import agreement, fit_clocks, turned_rad
from flocc_launch.datasets.source import Source

Float = NDArray[np.float64]

STEP_S = 0.2
"""Between the moments of odometry that are looked at."""
MOMENTS_MIN, MOMENTS_MAX = 40, 60
"""Moments that are looked at, and fewer of which tell nothing."""
TURN_WANTED_RAD = 1.0
"""Among them, by the odometry; less says little of when."""
REACH_S = 5.0
"""How far apart the clocks may be, so that it is found here."""
APART_MIN_S = 0.25
APART_MIN_STEPS = 1.25
"""An offset below, or below so many steps between the moments, is not told."""
CORRELATION_MIN = 0.85
BETTER_MIN, LEFT_MAX_RATIO = 0.1, 0.4
"""How much better turns must go together with the offset than without, and what it may leave of what they lack."""


def truth_faults(source: Source, odometry: Trajectory) -> tuple[str, ...]:
    """That ground truth and odometry are of clocks that are apart, in one sentence; none where they are not."""
    if source.truth is None or source.truth is odometry or len(odometry.stamps_s) < MOMENTS_MIN:
        return ()
    _, first = np.unique((odometry.stamps_s - odometry.stamps_s[0]) // STEP_S, return_index=True)
    stamps_s = odometry.stamps_s[first]
    stretch = turning_stretch(stamps_s, odometry)
    if stretch is None:
        return ()
    turns_rad = np.diff(np.interp(stamps_s[stretch], odometry.stamps_s, turned_rad(odometry)))
    apart_s = offset_s(stamps_s[stretch], turns_rad, source.truth)
    if apart_s is None:
        return ()
    return (
        f"{source.path}: the ground truth turns {abs(apart_s):.2f} s too {'late' if apart_s < 0 else 'early'} for the "
        "odometry: one of them is of another clock, and errors against it say nothing of the robot",
    )


def offset_s(stamps_s: Float, turns_rad: Float, trajectory: Trajectory) -> float | None:
    """What is to be added to a trajectory's stamps; None where turns go together without, or do not tell.

    Args:
        stamps_s: (N,) moments.
        turns_rad: (N - 1,) by which something that the trajectory's body carries turned between neighbouring ones.
        trajectory: Of the body, by its own clock.
    """
    inside = (trajectory.stamps_s >= stamps_s[0] - REACH_S) & (trajectory.stamps_s <= stamps_s[-1] + REACH_S)
    if np.count_nonzero(inside) < 2:
        return None
    near = Trajectory(trajectory.stamps_s[inside], trajectory.T_fixed_body[inside])
    fit = fit_clocks(stamps_s, turns_rad, near)
    if fit is None or fit.correlation < CORRELATION_MIN:
        return None
    least_s = max(APART_MIN_S, APART_MIN_STEPS * float(np.median(np.diff(stamps_s))))
    without = agreement(stamps_s, turns_rad, near)
    is_better = fit.correlation - without >= BETTER_MIN and 1 - fit.correlation <= LEFT_MAX_RATIO * (1 - without)
    return fit.offset_s if abs(fit.offset_s) >= least_s and is_better else None


def turning_stretch(stamps_s: Float, trajectory: Trajectory) -> slice | None:
    """Which moments, in a row, the trajectory turns most among; None where that is too little."""
    if len(stamps_s) < MOMENTS_MIN:
        return None
    at_rad = np.interp(stamps_s, trajectory.stamps_s, turned_rad(trajectory))
    count = min(MOMENTS_MAX, len(stamps_s))
    within_rad = at_rad[count - 1 :] - at_rad[: len(at_rad) - count + 1]
    first = int(np.argmax(within_rad))
    return slice(first, first + count) if within_rad[first] >= TURN_WANTED_RAD else None
