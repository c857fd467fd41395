"""How much larger uncertainties are than the normal equations say, from what residuals say.

Two things are looked at. Residuals of the whole component: squared they should be as many as degrees of freedom are
left. And each robot's odometry: drift that keeps its direction adds up, so that residuals summed over a window of steps
are larger than independent ones would make them, though each for itself is small. Covariances that are given out are
multiplied by the larger of the two; the solution itself is not changed.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.descent import Solved
from flocc_agent.backend.edges import residuals
from flocc_agent.backend.problem import Problem
from flocc_agent.backend.solvers import ACCEPTED_WEIGHT_MIN
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

WINDOW_STEPS = 80
"""Steps of odometry that are summed up: of 20, 40 and 80 the longest brought NEES nearest to 6 on each recording."""
WINDOWS_MIN = 4
STEPS_MIN = 8
"""Of fewer steps nothing is said."""
EXPECTED_FREEDOM = 12.0
"""Degrees of freedom with true residuals that are added: of few closures residuals say little."""
FACTOR_MAX = 16.0


@dataclass(frozen=True, slots=True)
class Inflation:
    """What variances of a robot's poses are multiplied by: those of rotation and those of translation."""

    rotation: float = 1.0
    translation: float = 1.0

    def of(self, S: Float) -> Float:
        """A covariance (6, 6), rotation first, made larger."""
        D = np.sqrt(np.repeat([self.rotation, self.translation], 3))
        return np.asarray(S * D * D[:, None])


def inflations(problem: Problem, solved: Solved) -> dict[LogId, Inflation]:
    """Factors of every log of a component."""
    e = residuals(problem.edges, solved.state).e
    whole = excess(problem, solved)
    found, first = {}, 0
    starts = [*problem.offsets.values(), problem.poses]
    for log, steps in zip(problem.logs, (np.diff(starts) - 1).tolist(), strict=True):
        rotation, translation = window_variances(e[first : first + steps])
        first += steps
        turning = min(max(1.0, whole, rotation), FACTOR_MAX)
        found[log] = Inflation(turning, min(max(turning, translation), FACTOR_MAX))
    return found


def excess(problem: Problem, solved: Solved) -> float:
    """Squared residuals over degrees of freedom: of used closures, less a pose for every robot but one."""
    rows = problem.closure_rows
    used = solved.weights[rows] >= ACCEPTED_WEIGHT_MIN
    free = (problem.edges.sigma[rows] > 0) | (problem.edges.cluster[rows] >= 0)
    freedom = float(np.sum(np.where(free, 5.0, 6.0)[used])) - 6.0 * (len(problem.logs) - 1) - len(problem.scaled)
    return (2.0 * solved.cost + EXPECTED_FREEDOM) / (max(freedom, 0.0) + EXPECTED_FREEDOM)


def window_variances(e: Float) -> tuple[float, float]:
    """Variance of sums of whitened residuals (N, 6) over windows, as a part of what independent ones have.

    At most 1 is expected where noise is as stated and independent: closures explain part of it.
    """
    if len(e) < STEPS_MIN:
        return 1.0, 1.0
    steps = min(WINDOW_STEPS, len(e) // WINDOWS_MIN)
    windows = len(e) // steps
    sums = e[: windows * steps].reshape(windows, steps, 6).sum(axis=1)
    variances = np.mean(sums**2, axis=0) / steps
    return float(variances[:3].mean()), float(variances[3:].mean())


def told(found: Mapping[LogId, Inflation]) -> dict[LogId, tuple[float, float]]:
    """The same as plain numbers: of rotation and of translation."""
    return {log: (inflation.rotation, inflation.translation) for log, inflation in found.items()}
