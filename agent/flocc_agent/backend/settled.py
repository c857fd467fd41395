"""Rounds in which the choice of closures is settled, but for what is new.

A whole round judges every closure: it screens it, compares it with others around it, lets robust weights choose, tries
other places of robots and scales of their odometry. A round that follows one closely judges what came since, and solves
all that was used together with it from where the round before ended, by the chains between closures: one or two linear
systems, in which everything moves. A whole round follows where what is new demands it: where a closure that was used
disagrees, or one that was not agrees; where a second new closure is turned away at one place; and in any case when
enough is new, or a closure that counted is doubted. A single closure that disagrees is turned away until then.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flocc_agent.backend.alarms import held_closures
from flocc_agent.backend.chains import Chains, chains_of, is_explained
from flocc_agent.backend.descent import Solved, descend
from flocc_agent.backend.initial import Aligned, extended, lengths_at
from flocc_agent.backend.linear import SingularSystem
from flocc_agent.backend.mapped import SavedLog
from flocc_agent.backend.odometry_scale import scales_before
from flocc_agent.backend.pair_closures import by_logs
from flocc_agent.backend.posing import Posed, posed_by_chains
from flocc_agent.backend.results import Solution, collect, excluded, odometry_component
from flocc_agent.backend.screening import closure_complaints, screen
from flocc_agent.backend.together import AGREEING_MIN
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import (
    ClosureResult,
    ClosureState,
    Component,
    GraphSolution,
    LoopClosure,
    PoseGraph,
    Trajectory,
)
from flocc_protocol.ids import KeyframeId, LogId

Bool = NDArray[np.bool_]
Ends = tuple[KeyframeId, KeyframeId]

SETTLED_KEYFRAMES_MIN = 2000
"""A smaller map is solved whole each time: that takes no time."""
NEW_KEYFRAMES_RATIO, NEW_KEYFRAMES_MIN = 0.05, 200
"""With more new keyframes, as a part of the whole and at least, the next round is a whole one."""
NEW_CLOSURES_RATIO, NEW_CLOSURES_MIN = 0.1, 50
BESIDE_KEYFRAMES = 100
"""Closures of the same two logs are at one place where both of their keyframes are so near to each other."""
COMPARED_CLOSURES = 32
"""With so many of the nearest closures of its two logs a new one is compared before it is believed."""


def settled_round(graph: PoseGraph, config: BackendConfig, initial: GraphSolution) -> GraphSolution | None:
    """Solve with the closures of the last whole round and what is new; None where all are to be judged.

    Args:
        graph: Odometry and closures from images; with anything else all rounds are whole.
        config: The noise model; only the default kind of closures' scales and solvers that reject are known here.
        initial: The round before.
    """
    last = initial.whole or initial
    if not _is_small(graph, config, last):
        return None
    seen = {(c.query, c.match): c for c in last.closures}
    if any(closure.doubt and _counts(seen, closure) for closure in graph.closures):
        return None
    news = _news(graph, seen, config)
    if news is None:
        return None
    fresh, results = news
    before = {log: component for component in initial.components for log in component.logs}
    components = []
    for component in last.components:
        solved = _solved(component, graph, fresh, seen, before[component.anchor], config)
        if solved is None:
            return None
        components.append(solved[0])
        results |= solved[1]
    closures = [results[k] if k in results else seen[c.query, c.match] for k, c in enumerate(graph.closures)]
    reasons = (result.reason for result in results.values() if result.state is ClosureState.EXCLUDED)
    warnings = (*last.warnings, *(reason for reason in reasons if reason not in last.warnings))
    return GraphSolution(tuple(components), tuple(closures), warnings, 1, whole=last)


def _is_small(graph: PoseGraph, config: BackendConfig, last: GraphSolution) -> bool:
    """Whether little has come since the last whole round, and nothing of another kind."""
    known = (
        config.formulation is Formulation.INDEPENDENT
        and config.solver in (Solver.GNC_TLS, Solver.GNC_GM)
        and not config.pairwise_consistency
        and all(closure.from_images for closure in graph.closures)
        and not any(isinstance(log, SavedLog) for log in graph.trajectories)
    )
    lengths = {log: len(T) for component in last.components for log, T in component.T_map_keyframe.items()}
    if not known or set(lengths) != set(graph.trajectories):
        return False
    grown = [len(graph.trajectories[log]) - length for log, length in lengths.items()]
    keyframes, closures = sum(lengths.values()), len(last.closures)
    return (
        last.iterations > 0
        and keyframes >= SETTLED_KEYFRAMES_MIN
        and min(grown) >= 0
        and sum(grown) <= max(NEW_KEYFRAMES_RATIO * keyframes, NEW_KEYFRAMES_MIN)
        and 0 <= len(graph.closures) - closures <= max(NEW_CLOSURES_RATIO * closures, NEW_CLOSURES_MIN)
    )


def _news(
    graph: PoseGraph, seen: Mapping[Ends, ClosureResult], config: BackendConfig
) -> tuple[set[int], dict[int, ClosureResult]] | None:
    """Closures that came, or were released, since the last whole round, and results of those that are held.

    None where two logs have so few closures that third robots' would have to judge them.
    """
    came = [k for k, c in enumerate(graph.closures) if (c.query, c.match) not in seen]
    if len(came) != len(graph.closures) - len(seen):
        return None
    near = _near(graph, came)
    if near is None:
        return None
    ids = list(near)
    results = {
        ids[n]: excluded(near[ids[n]], reason)
        for n, reason in closure_complaints(list(near.values()), graph.trajectories).items()
    }
    usable = {k: c for k, c in near.items() if k not in results}
    held = held_closures(graph.trajectories, usable, config) if usable else {}
    fresh = {k for k, c in usable.items() if _was(seen, c, ClosureState.EXCLUDED) or (c.query, c.match) not in seen}
    results |= {k: excluded(near[k], held[k]) for k in fresh if k in held}
    return fresh - set(held), results


def _near(graph: PoseGraph, came: Sequence[int]) -> dict[int, LoopClosure] | None:
    """New closures and, of the same two logs, those nearest to them; None where there are too few of these."""
    chosen = set(came)
    for ids in by_logs(dict(enumerate(graph.closures))).values():
        new = np.flatnonzero(np.isin(ids, came))
        if len(new) == 0:
            continue
        if len(ids) <= AGREEING_MIN:
            return None
        at = np.array([[end.index for end in sorted((graph.closures[k].query, graph.closures[k].match))] for k in ids])
        beside = cKDTree(at).query(at[new], k=np.arange(1, min(COMPARED_CLOSURES, len(ids)) + 1), p=1)[1]
        chosen |= {ids[n] for n in np.unique(beside).tolist()}
    return {k: graph.closures[k] for k in sorted(chosen)}


def _solved(
    component: Component,
    graph: PoseGraph,
    fresh: set[int],
    seen: Mapping[Ends, ClosureResult],
    before: Component,
    config: BackendConfig,
) -> tuple[Component, Mapping[int, ClosureResult]] | None:
    """One component, and results of its closures that count; None where all of them are to be judged."""
    logs = set(component.logs)
    if any((graph.closures[k].query.log in logs) != (graph.closures[k].match.log in logs) for k in fresh):
        return None
    if component.logs == (component.anchor,) and not any(c.query.log in logs for c in graph.closures):
        return odometry_component(component.anchor, graph.trajectories[component.anchor]), {}
    trajectories = {log: graph.trajectories[log] for log in component.logs}
    if screen(PoseGraph(_grown(trajectories, component))).warnings:
        return None
    closures = {
        k: c
        for k, c in enumerate(graph.closures)
        if c.query.log in logs and c.match.log in logs and (k in fresh or _counts(seen, c))
    }
    T = {log: extended(np.asarray(before.T_map_keyframe[log]), trajectory) for log, trajectory in trajectories.items()}
    chains = chains_of(trajectories, closures, (), config)
    began = posed_by_chains(trajectories, closures, chains, Aligned(T, True, lengths_at(closures, T)), config)
    began = began.with_scaled(scales_before(began, (before,)))
    ids = began.problem.closure_ids
    is_new = np.array([k in fresh for k in ids], dtype=bool)
    old = np.array([_was(seen, graph.closures[k], ClosureState.USED) for k in ids], dtype=bool)
    try:
        solved = _agreed(began, old | is_new, is_new, graph.closures)
        if solved is None or (chains is not None and not is_explained(chains, began.problem, solved)):
            return None
        found = collect(_solution(began, solved, before, chains), ())
    except (SingularSystem, np.linalg.LinAlgError):
        return None
    return found.components[0], found.closures


def _solution(began: Posed, solved: Solved, before: Component, chains: Chains | None) -> Solution:
    places, scales = began.places, before.odometry_scales
    return Solution(
        began.problem,
        began.objective,
        began.start,
        solved,
        places.trajectories,
        places.closures,
        before,
        scales,
        chains,
    )


def _counts(seen: Mapping[Ends, ClosureResult], closure: LoopClosure) -> bool:
    """Whether the last whole round used a closure or turned it away."""
    return (closure.query, closure.match) in seen and not _was(seen, closure, ClosureState.EXCLUDED)


def _was(seen: Mapping[Ends, ClosureResult], closure: LoopClosure, state: ClosureState) -> bool:
    result = seen.get((closure.query, closure.match))
    return result is not None and result.state is state


def _grown(trajectories: Mapping[LogId, Trajectory], component: Component) -> dict[LogId, Trajectory]:
    """What each log grew by since a solution, from its last keyframe then on."""
    grown = {}
    for log, trajectory in trajectories.items():
        base = len(component.T_map_keyframe[log]) - 1
        S = trajectory.edge_covariances
        grown[log] = Trajectory(trajectory.T_odom_keyframe[base:], None if S is None else S[base:])
    return grown


def _agreed(began: Posed, wanted: Bool, is_new: Bool, closures: Sequence[LoopClosure]) -> Solved | None:
    """Solve with wanted closures, less the new ones that disagree alone; None where more than that is wrong."""
    objective, state, taken = began.objective, began.start, wanted
    hold = objective.has_directions
    for _ in range(2):
        solved = descend(objective, state, objective.weights(taken.astype(float)), hold=hold)
        agree = objective.closure_residuals(solved.state, hold) <= objective.bounds()
        wrong = np.flatnonzero(agree != taken)
        if len(wrong) == 0:
            return solved if solved.converged else None
        if not np.all(is_new[wrong] & taken[wrong]):
            return None
        state, taken = solved.state, taken & agree
        turned_away = [k for k, on in zip(began.problem.closure_ids, taken, strict=True) if not on]
        if _are_beside([closures[k] for k in turned_away], is_new[~taken]):
            return None
    return None


def _are_beside(closures: Sequence[LoopClosure], is_new: Bool) -> bool:
    """Whether another of these closures is of the same two logs as a new one, and at one place of both."""
    pairs: dict[tuple[LogId, LogId], list[tuple[int, int]]] = {}
    new: dict[tuple[LogId, LogId], list[tuple[int, int]]] = {}
    for closure, of_now in zip(closures, is_new.tolist(), strict=True):
        low, high = sorted((closure.query, closure.match))
        for of_pair in (pairs, new) if of_now else (pairs,):
            of_pair.setdefault((low.log, high.log), []).append((low.index, high.index))
    apart = [np.abs(np.array(new[pair])[:, None] - np.array(pairs[pair])).max(axis=2) for pair in new]
    return any(np.any(np.count_nonzero(of_pair <= BESIDE_KEYFRAMES, axis=1) > 1) for of_pair in apart)
