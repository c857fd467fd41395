"""Graduated non-convexity (Yang 2020): from a cost in which all closures count to one in which wrong ones do not.

Each stage holds a control parameter, weighs closures by their residuals and moves down its own objective. A stage
whose steps had to be shortened goes on until it has moved: the control goes on only where the poses came along.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.descent import DAMPING_FACTOR, DAMPING_MIN, Objective, descend
from flocc_agent.backend.edges import State
from flocc_agent.config import BackendConfig, Solver

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

WEIGHT_MIN = 1e-4
"""A closure that weighs less takes no part: a tiny part of a huge residual still pulls."""
CONTROL_MAX = 1e6
STAGE_STEPS_MAX = 4
MOVED_RATIO = 0.1


@dataclass(frozen=True, slots=True)
class Stage:
    """What one value of the control parameter did.

    Attributes:
        control: The parameter.
        cost_before: Of the stage's own objective, where it began.
        cost_after: The same where it ended; never higher.
        iterations: Linear systems solved.
        resting: Whether it ended because the cost did not go down any further, not because its steps were over.
    """

    control: float
    cost_before: float
    cost_after: float
    iterations: int
    resting: bool


@dataclass(frozen=True, slots=True, eq=False)
class Graduated:
    """Where the stages ended.

    Attributes:
        state: Poses and scales.
        chosen: (L,) closures within their bounds there.
        iterations: Linear systems solved.
        stages: Each of them.
    """

    state: State
    chosen: Bool
    iterations: int
    stages: tuple[Stage, ...]


def graduated(objective: Objective, state: State, start_ratio: float, hold: bool = False) -> Graduated:
    """Run the stages from a state; the control parameter starts at `start_ratio` at the latest."""
    config, bound = objective.config, objective.bounds()
    squared = _squared(objective, state, hold)
    control, stages = initial_control(config.solver, squared, bound, start_ratio), []
    iterations = 0
    while iterations < config.iterations_max:
        of_closures = gnc_weights(config.solver, squared, bound, control)
        state, stage = _staged(objective, state, np.where(of_closures < WEIGHT_MIN, 0.0, of_closures), control, hold)
        stages.append(stage)
        iterations += stage.iterations
        squared = _squared(objective, state, hold)
        if gnc_finished(config.solver, of_closures, control):
            break
        control = next_control(config, squared, bound, control, start_ratio)
    return Graduated(state, squared <= bound, iterations, tuple(stages))


def _squared(objective: Objective, state: State, hold: bool) -> Float:
    """Squared residuals (L,) of the closures; of those that are held infinite, so that they weigh nothing."""
    squared = objective.closure_residuals(state, hold)
    return squared if objective.held is None else np.where(objective.held, np.inf, squared)


def _staged(objective: Objective, state: State, of_closures: Float, control: float, hold: bool) -> tuple[State, Stage]:
    """Go down the objective of one control parameter until a step changes its cost by little.

    A step of which no part goes down does not say that the cost rests, and a damped one follows: directions between
    poses that meet have a kink there, which a step that would pass it does not see.
    """
    weights, iterations, damping = objective.weights(of_closures), 0, 0.0
    steps_max = objective.config.gnc_inner_steps
    before = cost = objective.cost(state, weights, hold)
    while True:
        solved = descend(objective, state, weights, steps_max, hold, damping)
        iterations += solved.iterations
        refused = solved.cost == cost and not solved.converged
        state, decrease, cost = solved.state, cost - solved.cost, solved.cost
        resting = decrease <= MOVED_RATIO * cost and not refused
        if resting or iterations >= STAGE_STEPS_MAX:
            return state, Stage(control, before, cost, iterations, resting)
        damping = max(damping * DAMPING_FACTOR, DAMPING_MIN) if refused else 0.0


def initial_control(solver: Solver, squared: Float, bound: Float, start_ratio: float) -> float:
    """First value of the control parameter, at which the cost is convex, or as far on as `start_ratio` says."""
    worst = float(np.max(squared / bound, where=np.isfinite(squared), initial=0.0))
    if solver is Solver.GNC_TLS:
        return max(1.0 / max(2.0 * worst - 1.0, 1e-3), start_ratio)
    return max(min(2.0 * worst, 1.0 / start_ratio), 1.0)


def next_control(config: BackendConfig, squared: Float, bound: Float, control: float, start_ratio: float) -> float:
    """One step on, or as far as the largest residual that is left allows without losing convexity."""
    allowed = initial_control(config.solver, squared, bound, start_ratio)
    if config.solver is Solver.GNC_TLS:
        return max(control * config.gnc_step, allowed)
    return min(control / config.gnc_step, allowed)


def gnc_weights(solver: Solver, squared: Float, bound: Float, control: float) -> Float:
    """Weights (L,) at a control parameter: Yang 2020, Eqs. (12) for Geman-McClure and (14) for TLS."""
    if solver is Solver.GNC_GM:
        return np.asarray((control * bound / (squared + control * bound)) ** 2)
    low, high = control / (control + 1) * bound, (control + 1) / control * bound
    between = np.sqrt(bound * control * (control + 1) / np.maximum(squared, 1e-12)) - control
    return np.where(squared <= low, 1.0, np.where(squared >= high, 0.0, np.clip(between, 0.0, 1.0)))


def gnc_finished(solver: Solver, weights: Float, control: float) -> bool:
    """Whether weights are binary (TLS) or the original cost is reached (GM)."""
    if solver is Solver.GNC_GM:
        return control <= 1.0
    return bool(np.all((weights < 1e-4) | (weights > 1 - 1e-4))) or control > CONTROL_MAX
