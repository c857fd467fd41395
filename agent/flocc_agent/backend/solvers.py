"""Nonlinear solvers on the edges of one component: Levenberg-Marquardt, robust kernels and GNC.

Closures carry weights in [0, 1] that multiply their information; odometry and fixes always weigh 1.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from flocc_agent.backend.edges import Edges, State, jacobians, residuals
from flocc_agent.backend.linear import LinearSolver, SingularSystem
from flocc_agent.config import BackendConfig, Solver

Float = NDArray[np.float64]

DAMPING_MIN, DAMPING_MAX = 1.0, 1e12
DAMPING_FACTOR = 10.0
WEIGHT_MIN = 1e-6
GNC_INNER_STEPS = 2
ACCEPTED_WEIGHT_MIN = 0.5


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


def cost_of(edges: Edges, state: State, weights: Float, scale_prior_sigma: float) -> float:
    """Sum of half squared residuals, weighted, with the priors of cluster scales."""
    prior = np.sum(((state.scale - 1.0) / scale_prior_sigma) ** 2)
    return float(0.5 * (weights @ residuals(edges, state).squared() + prior))


def solve(edges: Edges, state: State, closures: slice, linear: LinearSolver, config: BackendConfig) -> Solved:
    """Run the configured solver from a state."""
    if config.solver is Solver.LM or closures.start == closures.stop:
        return levenberg_marquardt(edges, state, np.ones(len(edges)), linear, config)
    if config.solver in (Solver.HUBER, Solver.CAUCHY):
        return reweighted(edges, state, closures, linear, config)
    return graduated(edges, state, closures, linear, config)


def levenberg_marquardt(
    edges: Edges,
    state: State,
    weights: Float,
    linear: LinearSolver,
    config: BackendConfig,
    steps_max: int | None = None,
) -> Solved:
    """Minimise the weighted cost: Gauss-Newton steps, damped only where one does not go down."""
    sigma, sqrt_weights = linear.scale_prior_sigma, np.sqrt(weights)
    cost, damping, began = cost_of(edges, state, weights, sigma), 0.0, linear.solves
    budget = config.iterations_max if steps_max is None else steps_max
    while linear.solves - began < budget:
        at = residuals(edges, state)
        jac = jacobians(edges, at)
        candidate, candidate_cost = state, np.inf
        while linear.solves - began < budget:
            try:
                candidate = state.retract(linear.step(edges, state, at, jac, sqrt_weights, damping))
                candidate_cost = cost_of(edges, candidate, weights, sigma)
            except SingularSystem:
                candidate_cost = np.inf
            if candidate_cost <= cost * (1 + 1e-12):
                break
            if damping >= DAMPING_MAX:
                return Solved(state, weights, cost, linear.solves - began, False)
            damping = max(damping * DAMPING_FACTOR, DAMPING_MIN)
        if not candidate_cost <= cost * (1 + 1e-12):
            break
        decrease = cost - candidate_cost
        state, cost = candidate, min(cost, candidate_cost)
        if decrease <= config.relative_tolerance * cost or cost < config.absolute_tolerance:
            return Solved(state, weights, cost, linear.solves - began, True)
        damping = 0.0 if damping <= DAMPING_MIN else damping / DAMPING_FACTOR**2
    return Solved(state, weights, cost, linear.solves - began, False)


def thresholds(edges: Edges, closures: slice, probability: float) -> Float:
    """Squared residual (L,) below which a right closure lies with the given probability; a free scale costs one."""
    freedom = np.where((edges.sigma[closures] > 0) | (edges.cluster[closures] >= 0), 5.0, 6.0)
    return np.asarray(chdtri(freedom, 1.0 - probability))


def reweighted(edges: Edges, state: State, closures: slice, linear: LinearSolver, config: BackendConfig) -> Solved:
    """Iteratively reweighted least squares with a Huber or Cauchy kernel on closures."""
    bound = thresholds(edges, closures, config.inlier_probability)
    cost, iterations = np.inf, 0
    weights = np.ones(len(edges))
    while iterations < config.iterations_max:
        squared = residuals(edges, state).squared()[closures]
        weights[closures] = kernel_weights(config.solver, squared, bound)
        solved = levenberg_marquardt(edges, state, np.maximum(weights, WEIGHT_MIN), linear, config, steps_max=1)
        iterations += max(solved.iterations, 1)
        state = solved.state
        if cost - solved.cost <= config.relative_tolerance * solved.cost and np.isfinite(cost):
            return Solved(state, weights, solved.cost, iterations, True)
        cost = solved.cost
    return Solved(state, weights, cost, iterations, False)


def kernel_weights(solver: Solver, squared: Float, bound: Float) -> Float:
    """Weights of squared residuals for a kernel whose threshold is the square root of `bound`."""
    if solver is Solver.HUBER:
        return np.sqrt(bound / np.maximum(squared, bound))
    return np.asarray(1.0 / (1.0 + squared / bound))


def graduated(edges: Edges, state: State, closures: slice, linear: LinearSolver, config: BackendConfig) -> Solved:
    """Graduated non-convexity (Yang 2020) with truncated least squares or Geman-McClure."""
    bound = thresholds(edges, closures, config.inlier_probability)
    weights, iterations = np.ones(len(edges)), 0
    squared = residuals(edges, state).squared()[closures]
    control = initial_control(config.solver, squared, bound, config.gnc_start_ratio)
    while iterations < config.iterations_max:
        weights[closures] = gnc_weights(config.solver, squared, bound, control)
        solved = levenberg_marquardt(
            edges, state, np.maximum(weights, WEIGHT_MIN), linear, config, steps_max=GNC_INNER_STEPS
        )
        iterations += max(solved.iterations, 1)
        state = solved.state
        squared = residuals(edges, state).squared()[closures]
        if gnc_finished(config.solver, weights[closures], control):
            break
        control = control * config.gnc_step if config.solver is Solver.GNC_TLS else control / config.gnc_step
    weights[closures] = (
        (weights[closures] >= ACCEPTED_WEIGHT_MIN) if config.solver is Solver.GNC_TLS else weights[closures]
    )
    final = levenberg_marquardt(edges, state, np.maximum(weights, WEIGHT_MIN), linear, config)
    return Solved(final.state, weights, final.cost, iterations + final.iterations, final.converged)


def initial_control(solver: Solver, squared: Float, bound: Float, start_ratio: float) -> float:
    """First value of the control parameter, at which the cost is convex, or as far on as `start_ratio` says."""
    worst = float(np.max(squared / bound))
    if solver is Solver.GNC_TLS:
        return max(1.0 / max(2.0 * worst - 1.0, 1e-3), start_ratio)
    return max(min(2.0 * worst, 1.0 / start_ratio), 1.0)


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
    return bool(np.all((weights < 1e-4) | (weights > 1 - 1e-4))) or control > 1e6
