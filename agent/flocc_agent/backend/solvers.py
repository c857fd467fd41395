"""Nonlinear solvers on the edges of one component: Levenberg-Marquardt, robust kernels and GNC.

Closures carry weights in [0, 1] that multiply their information; odometry and fixes always weigh 1. On the way a
closure's scale may pass through zero, which is what keeps the search out of corners; at the end it is held at its
bound (`edges.GAMMA_MIN`) and the rest moves to the constrained optimum.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from flocc_agent.backend.edges import Edges, Residuals, State, jacobians, residuals
from flocc_agent.backend.linear import LinearSolver, SingularSystem
from flocc_agent.config import BackendConfig, Solver

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

DAMPING_MIN, DAMPING_MAX = 1.0, 1e12
DAMPING_FACTOR = 10.0
WEIGHT_MIN = 1e-6
KERNEL_STEPS = 1
ACCEPTED_WEIGHT_MIN = 0.5
CONTROL_MAX = 1e6
SELECTIONS_MAX = 5


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Where a solver stopped.

    Attributes:
        state: The best state.
        weights: (E,) robust weight of each edge.
        cost: Sum of half squared weighted residuals, scale priors included.
        iterations: Linear systems solved.
        converged: Whether the stop rule was met before the iterations ran out.
    """

    state: State
    weights: Float
    cost: float
    iterations: int
    converged: bool


@dataclass(frozen=True, slots=True, eq=False)
class Objective:
    """What is minimised: edges, which of them are closures, and how its linear systems are solved."""

    edges: Edges
    closures: slice
    linear: LinearSolver
    config: BackendConfig

    def cost(self, state: State, weights: Float, hold: bool) -> float:
        """Sum of half squared residuals, weighted, with the priors of cluster scales."""
        return self.cost_at(residuals(self.edges, state, hold), state, weights)

    def cost_at(self, at: Residuals, state: State, weights: Float) -> float:
        """The cost of residuals that are already there."""
        prior = np.sum(((state.scale - 1.0) / self.linear.scale_prior_sigma) ** 2)
        return float(0.5 * (weights @ at.squared() + prior))

    def closure_residuals(self, state: State) -> Float:
        """Squared residuals (L,) of the closures."""
        return residuals(self.edges, state, hold=False).squared()[self.closures]

    def weights(self, of_closures: Float | float = 1.0) -> Float:
        """Weights (E,) of all edges, given those of the closures."""
        out = np.ones(len(self.edges))
        out[self.closures] = of_closures
        return out

    def bounds(self) -> Float:
        """Squared residual (L,) below which a right closure lies with the configured probability.

        A free scale takes one of the six degrees of freedom.
        """
        free = (self.edges.sigma[self.closures] > 0) | (self.edges.cluster[self.closures] >= 0)
        return np.asarray(chdtri(np.where(free, 5.0, 6.0), 1.0 - self.config.inlier_probability))


def solve(objective: Objective, state: State, trusted: Bool | None = None) -> Solved:
    """Run the configured solver from a state, then hold scales at their bound where they passed it.

    Args:
        objective: What is minimised.
        state: Where to start.
        trusted: (L,) closures that an earlier solution kept or has not seen, where the start is that solution.
    """
    solver = objective.config.solver
    if solver is Solver.LM or objective.closures.start == objective.closures.stop:
        solved = descend(objective, state, objective.weights())
    elif solver in (Solver.HUBER, Solver.CAUCHY):
        solved = reweighted(objective, state)
    else:
        solved = (confirmed(objective, state, trusted) if trusted is not None else None) or graduated(objective, state)
    return held(objective, solved)


def held(objective: Objective, solved: Solved) -> Solved:
    """Move to the optimum whose scales all stay above their bound."""
    at = residuals(objective.edges, solved.state)
    if not np.any(at.held & (solved.weights > WEIGHT_MIN)):
        return solved
    final = descend(objective, solved.state, solved.weights, hold=True)
    return Solved(final.state, final.weights, final.cost, solved.iterations + final.iterations, final.converged)


def descend(
    objective: Objective, state: State, weights: Float, steps_max: int | None = None, hold: bool = False
) -> Solved:
    """Levenberg-Marquardt for given weights: Gauss-Newton steps, damped only where one does not go down."""
    budget = objective.config.iterations_max if steps_max is None else steps_max
    at = residuals(objective.edges, state, hold)
    cost, damping, solves = objective.cost_at(at, state, weights), 0.0, 0
    while solves < budget:
        jac = jacobians(objective.edges, at)
        while True:
            solves += 1
            try:
                delta = objective.linear.step(objective.edges, state, at, jac, weights, damping)
                candidate = state.retract(delta)
                there = residuals(objective.edges, candidate, hold)
                candidate_cost = objective.cost_at(there, candidate, weights)
            except SingularSystem:
                candidate, there, candidate_cost = state, at, np.inf
            if candidate_cost <= cost:
                break
            if _is_finished(objective.config, cost, candidate_cost - cost):
                return Solved(state, weights, cost, solves, True)
            if solves >= budget or damping >= DAMPING_MAX:
                return Solved(state, weights, cost, solves, False)
            damping = max(damping * DAMPING_FACTOR, DAMPING_MIN)
        decrease, state, at, cost = cost - candidate_cost, candidate, there, candidate_cost
        if _is_finished(objective.config, cost, decrease):
            return Solved(state, weights, cost, solves, True)
        damping = 0.0 if damping <= DAMPING_MIN else damping / DAMPING_FACTOR**2
    return Solved(state, weights, cost, solves, False)


def _is_finished(config: BackendConfig, cost: float, change: float) -> bool:
    return change <= max(config.relative_tolerance * cost, config.absolute_tolerance)


def reweighted(objective: Objective, state: State) -> Solved:
    """Iteratively reweighted least squares with a Huber or Cauchy kernel on closures."""
    config, bound = objective.config, objective.bounds()
    robust_before, iterations = np.inf, 0
    while True:
        squared = objective.closure_residuals(state)
        weights = objective.weights(kernel_weights(config.solver, squared, bound))
        solved = descend(objective, state, np.maximum(weights, WEIGHT_MIN), steps_max=KERNEL_STEPS)
        state, iterations = solved.state, iterations + solved.iterations
        others = objective.cost(state, objective.weights(0.0), hold=False)
        robust = others + 0.5 * float(np.sum(kernel_loss(config.solver, objective.closure_residuals(state), bound)))
        if abs(robust_before - robust) <= config.relative_tolerance * robust or iterations >= config.iterations_max:
            return Solved(state, weights, solved.cost, iterations, iterations < config.iterations_max)
        robust_before = robust


def kernel_weights(solver: Solver, squared: Float, bound: Float) -> Float:
    """Weights of squared residuals for a kernel whose threshold is the square root of `bound`."""
    if solver is Solver.HUBER:
        return np.sqrt(bound / np.maximum(squared, bound))
    return np.asarray(1.0 / (1.0 + squared / bound))


def kernel_loss(solver: Solver, squared: Float, bound: Float) -> Float:
    """Twice the robust loss of squared residuals; its derivative by `squared` is the weight."""
    if solver is Solver.HUBER:
        return np.where(squared <= bound, squared, 2.0 * np.sqrt(bound * squared) - bound)
    return np.asarray(bound * np.log1p(squared / bound))


def confirmed(objective: Objective, state: State, trusted: Bool) -> Solved | None:
    """Solve with the trusted closures alone; None where one of them then disagrees, or another one agrees.

    From an earlier solution this is the whole work of a round whose new closures fit, a few linear systems instead of
    all of GNC. Where they do not fit, either they or the earlier choice may be wrong, and GNC decides anew.
    """
    weights = objective.weights(trusted.astype(float))
    solved = descend(objective, state, np.maximum(weights, WEIGHT_MIN))
    agree = objective.closure_residuals(solved.state) <= objective.bounds()
    if not np.array_equal(agree, trusted):
        return None
    return Solved(solved.state, weights, solved.cost, solved.iterations, solved.converged)


def graduated(objective: Objective, state: State) -> Solved:
    """Graduated non-convexity (Yang 2020) with truncated least squares or Geman-McClure, then plain inliers."""
    config, bound = objective.config, objective.bounds()
    squared, iterations = objective.closure_residuals(state), 0
    control = initial_control(config.solver, squared, bound, config.gnc_start_ratio)
    while iterations < config.iterations_max:
        of_closures = gnc_weights(config.solver, squared, bound, control)
        weights = np.maximum(objective.weights(of_closures), WEIGHT_MIN)
        solved = descend(objective, state, weights, steps_max=config.gnc_inner_steps)
        state, iterations = solved.state, iterations + solved.iterations
        squared = objective.closure_residuals(state)
        if gnc_finished(config.solver, of_closures, control):
            break
        control = next_control(config, squared, bound, control)
    return selected(objective, state, iterations)


def selected(objective: Objective, state: State, iterations: int) -> Solved:
    """Keep the closures within their bounds, solve with them alone, and repeat until the choice stands."""
    bound = objective.bounds()
    chosen = objective.closure_residuals(state) <= bound
    for _ in range(SELECTIONS_MAX):
        weights = objective.weights(chosen.astype(float))
        solved = descend(objective, state, np.maximum(weights, WEIGHT_MIN))
        state, iterations = solved.state, iterations + solved.iterations
        again = objective.closure_residuals(state) <= bound
        if np.array_equal(again, chosen) or iterations >= objective.config.iterations_max:
            break
        chosen = again
    return Solved(state, weights, solved.cost, iterations, solved.converged)


def initial_control(solver: Solver, squared: Float, bound: Float, start_ratio: float) -> float:
    """First value of the control parameter, at which the cost is convex, or as far on as `start_ratio` says."""
    worst = float(np.max(squared / bound))
    if solver is Solver.GNC_TLS:
        return max(1.0 / max(2.0 * worst - 1.0, 1e-3), start_ratio)
    return max(min(2.0 * worst, 1.0 / start_ratio), 1.0)


def next_control(config: BackendConfig, squared: Float, bound: Float, control: float) -> float:
    """One step on, or as far as the largest residual that is left allows without losing convexity."""
    allowed = initial_control(config.solver, squared, bound, config.gnc_start_ratio)
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
