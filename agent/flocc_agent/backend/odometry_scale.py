"""Scales of the robots' odometry: always estimated, applied where the measurements demand it.

A scale is a variable that multiplies the lengths of one robot's odometry. Where odometry is true it costs accuracy, so
that it is held at 1 unless it is more than `DEMANDED_SIGMAS` of its standard deviations away; these are widened where
residuals are larger than they should be. A wrong scale makes right closures look wrong, and then nothing is left that
demands it: a cold round that rejected closures is solved with all scales free as well, and the lower truncated cost
wins. Where nothing was measured in metres only the ratios between robots show; their mean stays 1.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.alignment import evenly
from flocc_agent.backend.descent import Solved
from flocc_agent.backend.edges import State, residuals
from flocc_agent.backend.linear import SingularSystem
from flocc_agent.backend.mapped import SavedLog
from flocc_agent.backend.posing import Posed
from flocc_agent.backend.solvers import ACCEPTED_WEIGHT_MIN, continued, explains, searching, solve, solve_once
from flocc_agent.config import Formulation, Solver
from flocc_agent.core.pose_graph import Component, GraphSolution, OdometryScale, is_landmark
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]
PosedAnew = Callable[[Mapping[LogId, float]], Posed]

DEMANDED_SIGMAS = 3.0
OTHERS_SIGMAS = 2.0
"""How far from 1 the other robots' scales are demanded where one robot's is: these robots' odometry is not all true."""
MOVED_SIGMAS_MAX = 3.0
"""So far scales may move once they are applied."""
BIAS_RATIO = 0.005
"""Standard deviation of an estimate beyond what noise explains: drift that keeps its direction looks like scale."""
ASKED_CLOSURES_MAX = 2500
"""Of more closures so many, evenly chosen, are asked for the scales."""
ROUNDS_MAX = 3
ASKED_EVERY_ROUND_EDGES_MAX = 5000
"""With more edges, rounds that confirm the one before them do not estimate anew."""
ASKED_POSES_MAX = 50_000
"""A still larger graph is not asked at all: everything but the scales is eliminated for it."""
SCALE_MIN = 0.1
TOLD_SIGMA_MAX = 0.01
TOLD_USED_MIN = 0.75
"""Scales are not freed for another search where each robot uses so many of its closures, and they tell its scale with
at most this standard deviation, drift included."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """Scales that a solution suggests, true over measured length.

    Attributes:
        logs: Of which (K).
        scale: (K,) of each.
        sigma: (K,) standard deviations, widened by `excess`.
        is_metric: Something was measured in metres; else scales are relative to their mean.
        excess: How many times larger squared residuals are than they should be; at least 1.
    """

    logs: tuple[LogId, ...] = ()
    scale: Float = field(default_factory=lambda: np.zeros(0))
    sigma: Float = field(default_factory=lambda: np.zeros(0))
    is_metric: bool = True
    excess: float = 1.0

    def demanded(self) -> dict[LogId, float]:
        """Scales of logs whose odometry is not true; all scales where only ratios are known and one is not 1."""
        sigmas = np.abs(self.scale - 1.0) / np.hypot(self.sigma, BIAS_RATIO)
        off = sigmas > (OTHERS_SIGMAS if np.any(sigmas > DEMANDED_SIGMAS) else DEMANDED_SIGMAS)
        if not self.is_metric:
            off[:] = np.any(off)
        return {log: float(self.scale[k]) for k, log in enumerate(self.logs) if off[k]}

    def told(self, applied: tuple[LogId, ...]) -> dict[LogId, OdometryScale]:
        """The same for people: measured over true length."""
        return {
            log: OdometryScale(1.0 / scale, sigma / scale**2, log in applied, self.is_metric)
            for log, scale, sigma in zip(self.logs, self.scale.tolist(), self.sigma.tolist(), strict=True)
        }


@dataclass(frozen=True, slots=True, eq=False)
class SolvedWithScales:
    """A solved component, and what it says of its robots' odometry."""

    posed: Posed
    solved: Solved
    estimates: Estimates

    @property
    def odometry_scales(self) -> dict[LogId, OdometryScale]:
        """What people are told."""
        return self.estimates.told(self.posed.problem.scaled)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which closures (L,) are used."""
        return np.asarray(self.solved.weights[self.posed.problem.closure_rows] >= ACCEPTED_WEIGHT_MIN)

    def penalised_cost(self) -> float:
        """The truncated cost, and for each scale what it must save at least."""
        price = 0.5 * DEMANDED_SIGMAS**2 * self.estimates.excess
        cost = self.posed.objective.truncated_cost(self.solved.state, self.posed.places.votes)
        return cost + price * len(self.posed.problem.scaled)


def solve_with_scales(posed: Posed, initial: GraphSolution | None, anew: PosedAnew) -> SolvedWithScales:
    """Solve a component, with a scale for the odometry of every robot whose measurements demand it.

    Args:
        posed: The component with all odometry taken as true.
        initial: An earlier solution, whose scales are begun with.
        anew: Poses it again, from an alignment of the robots whose ways were made as long as given scales say.
    """
    begun = posed.with_scaled(scales_before(posed, initial.components if initial is not None else ()))
    solved = solve(begun.objective, begun.start, begun.trusted, begun.places)
    told = told_before(posed, initial) if begun.is_confirmed(solved) else None
    if told is not None and len(posed.problem.edges) > ASKED_EVERY_ROUND_EDGES_MAX:
        return SolvedWithScales(begun, solved, told)
    found = settled(begun, solved)
    if not is_worth_another(found):
        return found
    logs = scalable(posed)
    if set(found.posed.problem.scaled) != set(logs):
        free = posed.with_scaled(dict.fromkeys(logs, 1.0))
        searched = settled(free, solve_once(free.objective, free.start, free.places))
        found = lower(found, searched) if takes_in(found, searched) else found
    applied = found.posed.problem.scales_applied(found.solved.state)
    if not applied or set(applied) == set(begun.problem.scaled):
        return found
    aligned = anew(applied).with_scaled(applied)
    return lower(found, settled(aligned, solve(aligned.objective, aligned.start, None, aligned.places)))


def lower(a: SolvedWithScales, b: SolvedWithScales) -> SolvedWithScales:
    """The better of two; the first where they are equally good."""
    return min(a, b, key=SolvedWithScales.penalised_cost)


def told_before(posed: Posed, initial: GraphSolution | None) -> Estimates | None:
    """Estimates of an earlier solution of the same robots; None where it has none."""
    for component in initial.components if initial is not None else ():
        scales = [component.odometry_scales.get(log) for log in scalable(posed)]
        told = [scale for scale in scales if scale is not None]
        if told and len(told) == len(scales):
            ratio = np.array([scale.ratio for scale in told])
            sigma = np.array([scale.sigma_ratio for scale in told])
            return Estimates(tuple(scalable(posed)), 1.0 / ratio, sigma / ratio**2, told[0].is_metric)
    return None


def scales_before(posed: Posed, components: Iterable[Component]) -> dict[LogId, float]:
    """Scales that an earlier solution of these components applied."""
    return {
        log: 1.0 / scale.ratio
        for component in components
        for log, scale in component.odometry_scales.items()
        if scale.is_applied and log in posed.problem.logs
    }


def scalable(posed: Posed) -> list[LogId]:
    """Robots' logs that have a way; not those of an opened map."""
    lengths = np.diff([*posed.problem.offsets.values(), posed.problem.poses])
    return [
        log
        for log, n in zip(posed.problem.logs, lengths, strict=True)
        if n > 1 and not is_landmark(log) and not isinstance(log, SavedLog)
    ]


def is_worth_another(found: SolvedWithScales) -> bool:
    """Whether more closures than by chance were rejected, in a round that chose them anew: a scale may explain them."""
    config, posed = found.posed.objective.config, found.posed
    robust = config.solver in (Solver.GNC_TLS, Solver.GNC_GM) and config.formulation is not Formulation.BASE
    few = posed.problem.poses <= ASKED_POSES_MAX
    if not robust or not few or posed.is_confirmed(found.solved) or explains(posed.objective, found.solved):
        return False
    return not is_told(found)


def is_told(found: SolvedWithScales) -> bool:
    """Whether most closures of every robot are used, and tell its scale so surely that freeing it can change nothing.

    A scale that is wrong turns its robot's closures away, or it is demanded by those that are used.
    """
    estimates, problem, closures = found.estimates, found.posed.problem, found.posed.places.closures
    sure = np.all(np.hypot(estimates.sigma, BIAS_RATIO) <= TOLD_SIGMA_MAX)
    if problem.scaled or not estimates.logs or not sure:
        return False
    used = found.used
    ends = [{closures[k].query.log, closures[k].match.log} for k in problem.closure_ids]
    shares = (np.mean(used[[log in of for of in ends]]) for log in estimates.logs)
    return all(share >= TOLD_USED_MIN for share in shares)


def settled(posed: Posed, solved: Solved) -> SolvedWithScales:
    """Add the scales that a solution demands and take those away that it does not, until nothing changes.

    Scales that are not `believed` once they are applied are not.
    """
    here = SolvedWithScales(posed, solved, estimated(posed, solved))
    for _ in range(ROUNDS_MAX if posed.objective.config.formulation is not Formulation.BASE else 0):
        demanded, scaled = here.estimates.demanded(), set(here.posed.problem.scaled)
        if set(demanded) == scaled:
            break
        there = replace(here.posed, start=here.solved.state).with_scaled(demanded)
        solved = continued(there.objective, there.start)
        solved = replace(solved, iterations=here.solved.iterations + solved.iterations)
        found = SolvedWithScales(there, solved, estimated(there, solved))
        if demanded.keys() - scaled and not believed(here, found):
            here = replace(here, solved=replace(here.solved, iterations=solved.iterations))
            break
        here = found
    if not here.estimates.is_metric:
        here = replace(here, solved=replace(here.solved, state=with_mean_of_one(here.posed, here.solved.state)))
    return here


def believed(before: SolvedWithScales, applied: SolvedWithScales) -> bool:
    """Whether scales explain what demanded them, once they are applied.

    Few closures that agree and are wrong demand scales, too. These bend the rest until other closures are turned away,
    or those themselves, and what is left suggests other scales still.
    """
    if not takes_in(before, applied):
        return False
    said, sigma = before.estimates.scale, np.hypot(before.estimates.sigma, BIAS_RATIO)
    return len(applied.estimates.scale) != len(said) or bool(
        np.all(np.abs(applied.estimates.scale - said) <= MOVED_SIGMAS_MAX * sigma)
    )


def estimated(posed: Posed, solved: Solved) -> Estimates:
    """What a solution says of all scales, applied or not: one step with all of them free.

    Here they divide the poses: as a factor of noisy steps they make odometry seem too long, and the shorter the steps
    the more.
    """
    problem, rows = posed.problem, posed.problem.closure_rows
    if problem.poses > ASKED_POSES_MAX:
        return Estimates()
    now = dict.fromkeys(scalable(posed), 1.0) | problem.scales_applied(solved.state)
    free = replace(posed, start=solved.state).with_scaled(now, divides=True)
    weights, edges = asked(solved.weights, rows), free.problem.edges
    at = residuals(edges, free.start)
    cost = free.objective.cost_at(at, free.start, solved.weights)
    try:
        information, right = free.objective.linear.scales_alone(edges, free.start, at, weights, problem.clusters)
        covariance = np.linalg.inv(information)
    except (SingularSystem, np.linalg.LinAlgError):
        return Estimates()
    moved = covariance @ right
    used = solved.weights[rows] >= ACCEPTED_WEIGHT_MIN
    metric = np.array([posed.places.closures[k].metric for k in problem.closure_ids], dtype=bool)
    is_metric = bool(np.any(metric & used))
    scale = free.start.scale[problem.clusters :] + moved
    if not is_metric:
        scale, covariance = relative_to_mean(scale, np.asarray(covariance))
    unexplained = cost - 0.5 * float(moved @ right)
    bodies = len(problem.logs) - 1
    freedom = float(np.sum(np.where(free_lengths(posed), 5.0, 6.0)[used])) - 6.0 * bodies
    excess = max(1.0, 2.0 * unexplained / max(freedom, 1.0))
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0) * excess)
    return Estimates(tuple(free.problem.scaled), np.maximum(scale, SCALE_MIN), sigma, is_metric, excess)


def takes_in(before: SolvedWithScales, applied: SolvedWithScales) -> bool:
    """Whether with scales at least as many closures are used as without: those that explain nothing turn some away.

    Where each that is turned away is paid for twice, by what all cost less, the scales do explain: wrong ones that bent
    odometry of a wrong length fall away, too.
    """
    lost = np.count_nonzero(before.used) - np.count_nonzero(applied.used)
    if lost <= 0:
        return True
    price = 0.5 * float(np.max(searching(before.posed.objective).bounds()))
    return bool(applied.penalised_cost() + lost * price < before.penalised_cost())


def relative_to_mean(scale: Float, covariance: Float) -> tuple[Float, Float]:
    """Scales (K,) over their mean, with their covariance (K, K)."""
    mean = float(np.mean(scale))
    by_scale = (np.eye(len(scale)) - np.outer(scale / mean, np.full(len(scale), 1.0 / len(scale)))) / mean
    return scale / mean, np.asarray(by_scale @ covariance @ by_scale.T)


def free_lengths(posed: Posed) -> NDArray[np.bool_]:
    """Whether each closure (L,) has a scale of its own or of its cluster."""
    edges, rows = posed.problem.edges, posed.problem.closure_rows
    return np.asarray((edges.sigma[rows] > 0) | (edges.cluster[rows] >= 0))


def asked(weights: Float, closures: slice) -> Float:
    """Weights (E,) with which at most `ASKED_CLOSURES_MAX` closures take part, evenly spread over those that do."""
    taking_part = np.flatnonzero(weights[closures] > 0.0)
    if len(taking_part) <= ASKED_CLOSURES_MAX:
        return weights
    out = weights.copy()
    out[closures] = 0.0
    chosen = closures.start + evenly(taking_part, ASKED_CLOSURES_MAX)
    out[chosen] = weights[chosen]
    return out


def with_mean_of_one(posed: Posed, state: State) -> State:
    """The state made larger or smaller as a whole, so that scales of odometry are 1 in the mean."""
    if not posed.problem.scaled:
        return state
    ratio = 1.0 / float(np.mean(state.scale[posed.problem.clusters :]))
    first = state.t[0]
    return State(state.q, first + ratio * (state.t - first), ratio * state.scale)
