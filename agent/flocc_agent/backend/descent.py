"""Descent to the nearest optimum of weighted squares: Gauss-Newton steps, shortened, then damped.

Closures carry weights in [0, 1] that multiply their information; odometry always weighs 1. A closure of
weight 0 takes no part at all.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from flocc_agent.backend.edges import Edges, Residuals, State, directions, residuals, taken
from flocc_agent.backend.linear import LinearSolver, SingularSystem
from flocc_agent.config import BackendConfig, Solver

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

DAMPING_MIN, DAMPING_MAX = 1.0, 1e12
DAMPING_FACTOR = 10.0
LENGTHS = (1.0, 0.5, 0.25, 0.125, 0.0625)
"""Parts of a step that are tried before it is damped: they cost residuals, damping costs a linear system and holds back
the softest motions most, which are those that long chains need."""
CREEPING_RATIO = 1e-5
"""Where two poses of a direction meet its cost has a kink at which damped steps creep: one that lowers the cost by less
than this part is the last one."""
VOTED_STEPS_MAX = 3
"""Linear systems that are solved to compare states by votes: they stand near their optimum."""


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
    """What is minimised: edges, which of them are closures, and how its linear systems are solved.

    Closures (L,) that are `held` take no part until the poses that others give agree with them.
    """

    edges: Edges
    closures: slice
    linear: LinearSolver
    config: BackendConfig
    held: Bool | None = None

    @property
    def has_directions(self) -> bool:
        """Whether closures without a unit are among the edges: `hold` tells those by their angles."""
        return bool(np.any(directions(self.edges)))

    def cost(self, state: State, weights: Float, hold: bool) -> float:
        """Sum of half squared residuals, weighted, with the priors of cluster scales."""
        return self.cost_at(residuals(self.edges, state, hold), state, weights)

    def cost_at(self, at: Residuals, state: State, weights: Float) -> float:
        """The cost of residuals that are already there."""
        prior = np.sum(((state.scale - 1.0) / self.linear.scale_prior_sigma) ** 2)
        return float(0.5 * (weights @ at.squared() + prior))

    def truncated_cost(self, state: State, votes: Float | float = 1.0) -> float:
        """The cost in which no closure counts more than one at its bound, times its votes (L,)."""
        at = residuals(self.edges, state)
        squared = at.squared()
        squared[self.closures] = votes * np.minimum(squared[self.closures], self.bounds())
        prior = np.sum(((state.scale - 1.0) / self.linear.scale_prior_sigma) ** 2)
        return float(0.5 * (np.sum(squared) + prior))

    def closure_residuals(self, state: State, hold: bool = False) -> Float:
        """Squared residuals (L,) of the closures."""
        return residuals(taken(self.edges, self.closures), state, hold).squared()

    def agreeing(self, state: State, hold: bool = False) -> Bool:
        """Whether each closure (L,) is within its bound; a held one also where no scale may pass zero."""
        edges, bounds = taken(self.edges, self.closures), self.bounds()
        agree = residuals(edges, state, hold).squared() <= bounds
        if self.held is not None and np.any(self.held & agree):
            agree &= ~self.held | (residuals(edges, state, hold=True).squared() <= bounds)
        return np.asarray(agree)

    def weights(self, of_closures: Float | float = 1.0) -> Float:
        """Weights (E,) of all edges, given those of the closures."""
        out = np.ones(len(self.edges))
        out[self.closures] = of_closures
        return out

    def bounds(self) -> Float:
        """Squared residual (L,) below which a right closure lies with the configured probability.

        A free scale takes one of the six degrees of freedom. Of closures without a unit the bound is sharp: a wrong one
        among them bends lengths that nothing holds.
        """
        config = self.config
        graduated = config.solver in (Solver.GNC_TLS, Solver.GNC_GM)
        kept = config.kept_probability if graduated else config.inlier_probability
        without_unit = directions(self.edges)[self.closures]
        probability = np.where(without_unit, min(kept, config.inlier_probability), kept)
        free = (self.edges.sigma[self.closures] > 0) | (self.edges.cluster[self.closures] >= 0)
        return np.asarray(chdtri(np.where(free, 5.0, 6.0), 1.0 - probability))


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """A state, its residuals and its cost."""

    state: State
    at: Residuals
    cost: float


def descend(
    objective: Objective,
    state: State,
    weights: Float,
    steps_max: int | None = None,
    hold: bool = False,
    damping: float = 0.0,
) -> Solved:
    """Go down for given weights until the cost rests, or so many linear systems are solved, the first one damped so."""
    budget = objective.config.iterations_max if steps_max is None else steps_max
    here, solves = _point(objective, state, weights, hold), 0
    kinked = hold and objective.has_directions
    while solves < budget:
        while True:
            solves += 1
            there = _lower(objective, here, weights, damping, hold)
            if there.cost <= here.cost:
                break
            if _is_finished(objective.config, here.cost, there.cost - here.cost):
                return Solved(here.state, weights, here.cost, solves, True)
            if solves >= budget or damping >= DAMPING_MAX:
                return Solved(here.state, weights, here.cost, solves, False)
            damping = max(damping * DAMPING_FACTOR, DAMPING_MIN)
        decrease, here = here.cost - there.cost, there
        creeps = kinked and damping > 0.0 and decrease <= CREEPING_RATIO * here.cost
        if creeps or _is_finished(objective.config, here.cost, decrease):
            return Solved(here.state, weights, here.cost, solves, True)
        damping = 0.0 if damping <= DAMPING_MIN else damping / DAMPING_FACTOR**2
    return Solved(here.state, weights, here.cost, solves, False)


def voted_cost(objective: Objective, state: State, votes: Float) -> float:
    """The truncated cost in which closures count as many times as they have votes, where it is least near a state.

    A state is where all closures count once. There many that agree bend odometry as many do; to hold that against them
    while they count as few would let go of all of them.
    """
    hold = objective.has_directions
    agreeing = objective.agreeing(state, hold)
    if not np.all(votes[agreeing] == 1.0):
        state = descend(objective, state, objective.weights(votes * agreeing), VOTED_STEPS_MAX, hold).state
    return objective.truncated_cost(state, votes)


def _point(objective: Objective, state: State, weights: Float, hold: bool) -> Point:
    at = residuals(objective.edges, state, hold)
    return Point(state, at, objective.cost_at(at, state, weights))


def _lower(objective: Objective, here: Point, weights: Float, damping: float, hold: bool) -> Point:
    """The first of the shortened steps that goes down, or the least bad of them; infinite cost where there is none."""
    try:
        delta = objective.linear.step(objective.edges, here.state, here.at, weights, damping)
    except SingularSystem:
        return Point(here.state, here.at, np.inf)
    best = Point(here.state, here.at, np.inf)
    for length in LENGTHS:
        there = _point(objective, here.state.retract(length * delta), weights, hold)
        if there.cost < best.cost:
            best = there
        if best.cost <= here.cost or _is_finished(objective.config, here.cost, best.cost - here.cost):
            break
    return best


def _is_finished(config: BackendConfig, cost: float, change: float) -> bool:
    return change <= max(config.relative_tolerance * cost, config.absolute_tolerance)
