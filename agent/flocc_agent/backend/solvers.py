"""The solvers of one component: Levenberg-Marquardt, robust kernels and graduated non-convexity.

On the way a closure's scale may pass through zero, which is what keeps the search out of corners; at the end it is held
at its bound (`edges.GAMMA_MIN`) and the rest moves to the constrained optimum.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.averaging import averaged
from flocc_agent.backend.descent import Objective, Solved, descend, voted_cost
from flocc_agent.backend.edges import State, directions, residuals
from flocc_agent.backend.graduated import graduated
from flocc_agent.backend.passages import passages
from flocc_agent.backend.placing import NEARLY_RATIO, Places
from flocc_agent.config import Solver

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

KERNEL_STEPS = 1
ACCEPTED_WEIGHT_MIN = 0.5
SELECTIONS_MAX = 5
EXPLAINED_RATIO = 100.0
"""LM looks for a better start where its first cost is so many times its degrees of freedom."""
START_RATIOS = (1e-4, 1e-6)
WIDENED_RATIO = 0.03
"""Control parameter at which the choice is widened: closures within 34 times the bound are asked. Smaller forgets where
the search ended."""
PLACEMENTS_MAX = 10
SEARCH_TOLERANCE_RATIO = 1e-5
"""Candidates are compared where a step lowers their cost by less than this part; only the best one goes on from there,
as far as is configured."""
AWAY_RATIO_MAX = 1e-3
"""Ten times the part of right closures outside of a sharp bound, by chance: of fewer than a thousand none is away."""
SAME_RATIO = 1e-3
"""Two schedules that use the same closures, at costs that differ by less than this part, ended in one place."""


def solve(objective: Objective, state: State, trusted: Bool | None = None, places: Places | None = None) -> Solved:
    """Run the configured solver from a state, then hold scales at their bound where they passed it.

    Args:
        objective: What is minimised.
        state: Where to start.
        trusted: (L,) closures that an earlier solution kept or has not seen, where the start is that solution.
        places: Other places for robots that rejected closures propose; without it none are tried.
    """
    solver = objective.config.solver
    if solver is Solver.LM or objective.closures.start == objective.closures.stop:
        solved = lowest(objective, state)
    elif solver in (Solver.HUBER, Solver.CAUCHY):
        solved = reweighted(objective, state)
    else:
        solved = (confirmed(objective, state, trusted) if trusted is not None else None) or to_rest(
            objective, best(searching(objective), state, places)
        )
    return held(objective, solved)


def solve_once(objective: Objective, state: State, places: Places) -> Solved:
    """GNC by its most careful schedule alone."""
    search = searching(objective)
    solved = scheduled(search, state, START_RATIOS[-1])
    if not explains(search, solved):
        solved = replaced(search, solved, places)
    return held(objective, to_rest(objective, solved))


def searching(objective: Objective) -> Objective:
    """The objective with the sharp bound and the tolerance of searches, where others are configured."""
    bound = min(objective.config.kept_probability, objective.config.inlier_probability)
    return configured(coarse(objective), kept_probability=bound)


def coarse(objective: Objective) -> Objective:
    """The objective with the tolerance of searches, where a finer one is configured."""
    return configured(objective, relative_tolerance=max(objective.config.relative_tolerance, SEARCH_TOLERANCE_RATIO))


def configured(objective: Objective, **values: float) -> Objective:
    """The objective with other settings; itself where it has these."""
    if all(getattr(objective.config, name) == value for name, value in values.items()):
        return objective
    return replace(objective, config=objective.config.model_copy(update=values))


def to_rest(objective: Objective, solved: Solved) -> Solved:
    """Go on from where a search ended, as far as is configured; `held` does so where there are directions.

    A wide bound is for the closures that lie just outside of a sharp one, because real noise has heavier tails than its
    covariance: a search with it would also take wrong ones for right. Where the search ended GNC begins once more with
    it, but late; what it finds is taken where nothing that was used is turned away for it.
    """
    hold, used = objective.has_directions, accepted(objective, solved)
    if hold:
        objective = coarse(objective)
    if objective.config.kept_probability > objective.config.inlier_probability and not np.all(used):
        stages = graduated(widening(objective, used), solved.state, WIDENED_RATIO, hold)
        widened = selected(objective, stages.state, solved.iterations + stages.iterations, hold)
        if np.all(accepted(objective, widened) >= used):
            return widened
        solved = replace(solved, iterations=widened.iterations)
    if searching(objective) is objective or hold:
        return solved
    return selected(objective, solved.state, solved.iterations)


def widening(objective: Objective, used: Bool) -> Objective:
    """The objective in which of the closures that are not used only those take part whose bound is a wide one.

    The others come back where the poses that these give agree with them: a wrong direction that pulls soon agrees.
    """
    away = ~used & directions(objective.edges)[objective.closures]
    return replace(objective, held=away if objective.held is None else objective.held | away)


def continued(objective: Objective, state: State) -> Solved:
    """Go on from a state that differs little from a solution."""
    if (
        objective.config.solver in (Solver.GNC_TLS, Solver.GNC_GM)
        and objective.closures.start < objective.closures.stop
    ):
        return held(objective, selected(objective, state, 0))
    return solve(objective, state)


def lowest(objective: Objective, state: State) -> Solved:
    """LM from a state, or from averaged rotations where noise does not explain that and they are lower."""
    weights, edges = objective.weights(), objective.edges
    cost, freedom = objective.cost(state, weights, hold=False), 6 * max(len(edges) - len(state.q) + 1, 1)
    if 2.0 * cost > EXPLAINED_RATIO * freedom and len(state.scale) == 0:
        start = averaged(edges, state, objective.linear.fixed)
        if start is not None and objective.cost(start, weights, hold=False) < cost:
            state = start
    return descend(objective, state, weights)


def best(objective: Objective, state: State, places: Places | None) -> Solved:
    """GNC by several schedules from one state; the lowest truncated cost wins, each taken where it ended.

    With directions the careful schedule is the one that tells them by their angles.
    """
    says = places.votes if places is not None else 1.0
    found = [scheduled(objective, state, START_RATIOS[0])]
    if not objective.has_directions and not explains(objective, found[0]):
        found += [scheduled(objective, state, ratio) for ratio in START_RATIOS[1:]]
    found = different(objective, found)
    if objective.has_directions:
        found = [as_angles(objective, solved) for solved in found]
        found.append(scheduled(objective, state, START_RATIOS[-1], hold=True))
    solved = min(found, key=lambda solved: objective.truncated_cost(solved.state, says))
    if places is None or explains(objective, solved):
        return solved
    return replaced(objective, solved, places)


def explains(objective: Objective, solved: Solved) -> bool:
    """Whether a solution turns away hardly more closures than chance does: no other one can explain more of them."""
    used = accepted(objective, solved)
    return bool(np.count_nonzero(~used) <= AWAY_RATIO_MAX * len(used))


def different(objective: Objective, found: Sequence[Solved]) -> list[Solved]:
    """Those of the solutions that ended in places of their own, the first of each."""
    kept: list[Solved] = []
    for solved in found:
        chosen, cost = accepted(objective, solved), objective.truncated_cost(solved.state)
        alike = [other for other in kept if np.array_equal(accepted(objective, other), chosen)]
        if not any(abs(objective.truncated_cost(other.state) - cost) <= SAME_RATIO * cost for other in alike):
            kept.append(solved)
    return kept


def replaced(objective: Objective, solved: Solved, places: Places) -> Solved:
    """Try other places for robots, and passages, as long as one lowers the truncated cost and enough closures stay.

    Votes make it cheap to let go of closures that stand close together: where odometry is stated too exact, a place
    that leaves hardly any may cost less than all that bend it (drawn seeds 2088, 2593).
    """
    cost: float | None = None
    for _ in range(PLACEMENTS_MAX):
        chosen, better = accepted(objective, solved), None
        votes_min = NEARLY_RATIO * places.votes[chosen].sum()
        taken_in = passages(objective, solved.state, chosen, places.votes, places.groups)
        others = ((placement.state, placement.chosen) for placement in places.proposals(solved.state, chosen))
        for start, begun in chain(others, ((solved.state, chosen | members) for members in taken_in)):
            moved = descend(objective, start, objective.weights(begun.astype(float)), 5)
            there = selected(objective, moved.state, moved.iterations)
            if places.votes[accepted(objective, there)].sum() < votes_min:
                continue
            cost = voted_cost(objective, solved.state, places.votes) if cost is None else cost
            if (lower := voted_cost(objective, there.state, places.votes)) < cost:
                better, cost = there, lower
                break
        if better is None:
            break
        solved = better
    return solved


def accepted(objective: Objective, solved: Solved) -> Bool:
    """Which closures (L,) are used."""
    return np.asarray(solved.weights[objective.closures] >= ACCEPTED_WEIGHT_MIN)


def scheduled(objective: Objective, state: State, start_ratio: float, hold: bool = False) -> Solved:
    """GNC, then plain inliers."""
    stages = graduated(objective, state, start_ratio, hold)
    return selected(objective, stages.state, stages.iterations, hold)


def held(objective: Objective, solved: Solved) -> Solved:
    """Move to the optimum whose scales all stay above their bound."""
    if objective.has_directions:
        return as_angles(objective, solved)
    at = residuals(objective.edges, solved.state)
    if not np.any(at.held & (solved.weights > 0.0)):
        return solved
    final = descend(objective, solved.state, solved.weights, hold=True)
    return Solved(final.state, final.weights, final.cost, solved.iterations + final.iterations, final.converged)


def as_angles(objective: Objective, solved: Solved) -> Solved:
    """Go on with directions told by their angles, and with the closures that agree so, until the choice stands."""
    final = descend(objective, solved.state, solved.weights, hold=True)
    iterations = solved.iterations + final.iterations
    if objective.config.solver not in (Solver.GNC_TLS, Solver.GNC_GM):
        return Solved(final.state, final.weights, final.cost, iterations, final.converged)
    if np.array_equal(objective.agreeing(final.state, True), accepted(objective, final)):
        return Solved(final.state, final.weights, final.cost, iterations, final.converged)
    return selected(objective, final.state, iterations, hold=True)


def reweighted(objective: Objective, state: State) -> Solved:
    """Iteratively reweighted least squares with a Huber or Cauchy kernel on closures."""
    config, bound = objective.config, objective.bounds()
    robust_before, iterations = np.inf, 0
    while True:
        squared = objective.closure_residuals(state)
        weights = objective.weights(kernel_weights(config.solver, squared, bound))
        solved = descend(objective, state, weights, steps_max=KERNEL_STEPS)
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
    solved = descend(objective, state, weights)
    if not np.array_equal(objective.agreeing(solved.state), trusted):
        return None
    return Solved(solved.state, weights, solved.cost, solved.iterations, solved.converged)


def selected(objective: Objective, state: State, iterations: int, hold: bool = False) -> Solved:
    """Keep the closures within their bounds, solve with them alone, and repeat until the choice stands."""
    chosen = objective.agreeing(state, hold)
    for _ in range(SELECTIONS_MAX):
        weights = objective.weights(chosen.astype(float))
        solved = descend(objective, state, weights, hold=hold)
        state, iterations = solved.state, iterations + solved.iterations
        again = objective.agreeing(state, hold)
        if np.array_equal(again, chosen) or iterations >= objective.config.iterations_max:
            break
        chosen = again
    return Solved(state, weights, solved.cost, iterations, solved.converged)
