"""The unit of stamps that no header names: by their size where they count from 1970, else by their steps.

A trajectory has between 0.2 and 2000 poses a second; numbers whose steps fit that in one unit only are in that unit.
"""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.runtime.columns import UNITS_S

Float = NDArray[np.float64]

EPOCH_S = (8e8, 4.2e9)
"""1995 to 2103: stamps that count from 1970."""
STEP_S = (5e-4, 5.0)
EPOCH_STEP_S = (5e-5, 3600.0)
"""Steps of stamps that count from 1970, whose size alone says their unit; nanoseconds from 0 s have other steps."""


def since_1970(value: float) -> str | None:
    """The unit in which a stamp is a time of ours, or None where it counts from another zero."""
    return next((name for name, unit_s in UNITS_S.items() if EPOCH_S[0] <= value * unit_s <= EPOCH_S[1]), None)


def plausible_units(stamps: Float) -> list[str]:
    """Units in which stamps can be: one where they count from 1970, else all whose steps are those of a robot."""
    steps = np.abs(np.diff(stamps))
    steps = steps[steps > 0]
    epoch = since_1970(float(np.median(stamps)))
    if len(steps) == 0:
        return [epoch or "seconds"]
    step = float(np.median(steps))
    if epoch is not None and EPOCH_STEP_S[0] <= step * UNITS_S[epoch] <= EPOCH_STEP_S[1]:
        return [epoch]
    if not _whole(stamps):
        return ["seconds"] if _fits(step, "seconds") else [name for name in UNITS_S if _fits(step, name)]
    return [name for name in UNITS_S if _fits(step, name)]


def _fits(step: float, unit: str) -> bool:
    return STEP_S[0] <= step * UNITS_S[unit] <= STEP_S[1]


def _whole(stamps: Float) -> bool:
    return bool(np.all(stamps == np.round(stamps)))


def are_counted(stamps: Float) -> bool:
    """Whether stamps are 0, 1, 2 ...: numbers of images, or seconds."""
    return len(stamps) > 1 and _whole(stamps) and bool(np.all(np.diff(stamps) == 1.0))
