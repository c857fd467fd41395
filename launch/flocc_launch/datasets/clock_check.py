"""Whether pictures turn when the trajectory says that the camera did.

Odometry that is late against its pictures fits them wherever the robot goes straight on, and a run says nothing of it:
each turn is only put where the robot was not. So the stretch in which the trajectory turns most is looked at, before
anything runs; `flocc dataset clock` looks at all of it.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.datasets.clocks import agreement, fit_clocks, spaced, turned_rad, turns_of_pictures
from flocc_launch.datasets.source import Source

Float = NDArray[np.float64]

PICTURES_MIN, PICTURES_MAX = 40, 60
"""Pictures that are looked at, and fewer of which tell nothing; each costs 10 to 40 ms of a core."""
TURN_WANTED_RAD = 1.0
"""In the stretch, by the trajectory; less says little of when."""
STEP_S = 0.2
"""Between the moments of odometry that are looked at."""
REACH_S = 5.0
"""How far apart the clocks may be, so that it is found here."""
APART_MIN_S = 0.25
APART_MIN_STEPS = 1.25
"""An offset below, or below so many steps between the pictures, is not told."""
CORRELATION_MIN = 0.85
BETTER_MIN, LEFT_MAX_RATIO = 0.1, 0.4
"""How much better turns must go together with the offset than without, and what it may leave of what they lack."""


def clock_faults(source: Source, trajectory: Trajectory) -> tuple[str, ...]:
    """What pictures, a trajectory and ground truth say of clocks that are apart, one sentence each."""
    if source.is_posed_by_image:
        return ()
    apart_s = _of_pictures(source, trajectory)
    on_time = Trajectory(trajectory.stamps_s + (apart_s or 0.0), trajectory.T_fixed_body)
    told = () if source.truth is trajectory else tuple(_of_truth(source, on_time))
    if apart_s is None:
        return told
    return (
        f"{source.path}: the trajectory turns {_told(apart_s)} for the pictures: 'flocc dataset clock' measures it, "
        "and 'flocc dataset convert --time-offset' adds it to the trajectory's stamps",
        *told,
    )


def _of_pictures(source: Source, trajectory: Trajectory) -> float | None:
    """What is to be added to the trajectory's stamps by the pictures; None where nothing is, or they do not tell."""
    images = spaced(source.images)
    stamps_s = np.array([stamp_s for stamp_s, _ in images])
    stretch = turning_stretch(stamps_s, trajectory)
    if source.lens is None or stretch is None:
        return None
    turns_rad = turns_of_pictures([file for _, file in images[stretch]], source.lens.camera)
    return offset_s(stamps_s[stretch], turns_rad, trajectory)


def _of_truth(source: Source, trajectory: Trajectory) -> Iterator[str]:
    """That the ground truth turns when the trajectory does not: errors against it say nothing of the robot."""
    if source.truth is None:
        return
    _, first = np.unique((trajectory.stamps_s - trajectory.stamps_s[0]) // STEP_S, return_index=True)
    stamps_s = trajectory.stamps_s[first]
    stretch = turning_stretch(stamps_s, trajectory)
    if stretch is None:
        return
    turns_rad = np.diff(np.interp(stamps_s[stretch], trajectory.stamps_s, turned_rad(trajectory)))
    apart_s = offset_s(stamps_s[stretch], turns_rad, source.truth)
    if apart_s is not None:
        yield (
            f"{source.path}: the ground truth turns {_told(apart_s)} for the odometry: its stamps are of another "
            "clock, and errors against it say nothing of the robot"
        )


def _told(apart_s: float) -> str:
    return f"{abs(apart_s):.2f} s too {'late' if apart_s < 0 else 'early'}"


def offset_s(stamps_s: Float, turns_rad: Float, trajectory: Trajectory) -> float | None:
    """What is to be added to a trajectory's stamps; None where turns go together without, or do not tell.

    Args:
        stamps_s: (N,) of the pictures.
        turns_rad: (N - 1,) between neighbouring ones; nan where not known.
        trajectory: Of the body that carries the camera.
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
    if len(stamps_s) < PICTURES_MIN or len(trajectory.stamps_s) < 2:
        return None
    at_rad = np.interp(stamps_s, trajectory.stamps_s, turned_rad(trajectory))
    count = min(PICTURES_MAX, len(stamps_s))
    within_rad = at_rad[count - 1 :] - at_rad[: len(at_rad) - count + 1]
    first = int(np.argmax(within_rad))
    return slice(first, first + count) if within_rad[first] >= TURN_WANTED_RAD else None
