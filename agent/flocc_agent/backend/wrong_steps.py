"""One wrong stretch of odometry that looks like a wrong scale.

Wheels that slip for three metres, or a robot that is pushed, leave a way that is too long at one place. Closures before
and after ask for a shorter one, and a scale of the whole way explains most of that. What tells is where the rest lies:
what a wrong scale leaves is spread along the way, what a wrong stretch leaves is beside it.
"""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.descent import Solved
from flocc_agent.backend.edges import residuals
from flocc_agent.backend.problem import Problem
from flocc_agent.backend.solvers import ACCEPTED_WEIGHT_MIN
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

STEPS_MIN = 20
"""Shorter ways have too few steps to compare."""
STRETCH_RATIO = 0.15
"""How much of a way a stretch is at most."""
MISFIT_RATIO = 0.42
"""So much of a way's misfit in one stretch is no matter of scale; `tests/agent/backend/test_backend_wrong_steps.py`."""
CLOSURES_RATIO = 0.5
"""A stretch that has more than this part of its share of misfit as its share of closures has it because of them."""


def wrong_step_warnings(problem: Problem, solved: Solved) -> tuple[str, ...]:
    """Name the stretches that may be wrong where scales seem to be; none where there is none.

    Two robots that are tied to each other pull at each other there, so that both are named.
    """
    squared = residuals(problem.edges, solved.state).squared()
    found = [stretch for log in problem.logs if (stretch := _stretch(log, problem, solved, squared)) is not None]
    if not found:
        return ()
    where = " and ".join(f"{KeyframeId(log, first)} to {KeyframeId(log, last)}" for log, first, last in found)
    return (
        f"what does not fit lies at {where}, not along the way: odometry that is wrong there, as of wheels that "
        "slip or a robot that was pushed, looks like a wrong scale of the whole way",
    )


def _stretch(log: LogId, problem: Problem, solved: Solved, squared: Float) -> tuple[LogId, int, int] | None:
    """The keyframes of a log between which most of its misfit lies; None where it is spread, or closures are."""
    edges, closures = problem.edges, problem.closure_rows
    begin = problem.offsets[log]
    count = len(problem.by_log(np.empty(problem.poses))[log])
    if count - 1 < STEPS_MIN:
        return None
    steps = np.flatnonzero((edges.i[: closures.start] >= begin) & (edges.i[: closures.start] < begin + count - 1))
    width = max(2, int(STRETCH_RATIO * (count - 1)))
    misfit = np.convolve(squared[steps], np.ones(width), "valid")
    first, whole = int(np.argmax(misfit)), float(np.sum(squared[steps]))
    if whole <= 0.0 or misfit[first] < MISFIT_RATIO * whole:
        return None
    used = solved.weights[closures] >= ACCEPTED_WEIGHT_MIN
    ends = np.concatenate([edges.i[closures][used], edges.j[closures][used]]) - begin
    ends = ends[(ends >= 0) & (ends < count)]
    inside = np.count_nonzero((ends >= first) & (ends <= first + width))
    if not len(ends) or inside / len(ends) > CLOSURES_RATIO * misfit[first] / whole:
        return None
    return log, first, first + width
