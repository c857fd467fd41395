"""Rounds that solve what moves: what the last whole round placed is held, but for the newest part of each log.

A round that follows a whole one opens the last keyframes of every log and what came since. All that other keyframes
say reaches them through the keyframes that closures or odometry tie them to, and those stay where the whole round put
them: they become one stiff log, as an opened map that does not move does. So a round costs what is new, not what was
driven. The settled part is opened again, by a whole round, where the new part demands it: where a closure that was
used disagrees, or one that was not agrees; where a second closure speaks against it at one place; where the new
closures together cost more than noise explains, because they pull at what is held; and in any case when enough is new.
A single closure that disagrees is turned away until then. What is uncertain in the settled part is added to what is
uncertain in the open one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import chdtri

from flocc_agent.backend.alarms import held_closures
from flocc_agent.backend.covariance import COVARIANCE_ROUNDS, keyframe_covariances
from flocc_agent.backend.descent import Solved, descend
from flocc_agent.backend.edges import state_of
from flocc_agent.backend.initial import Aligned, extended
from flocc_agent.backend.linear import SingularSystem
from flocc_agent.backend.mapped import (
    FIRST,
    STIFF_ROTATION_SIGMA_RAD,
    STIFF_TRANSLATION_SIGMA_M,
    SavedLog,
    stiff_trajectory,
)
from flocc_agent.backend.measured import CERTAIN_RATIO, JOINS
from flocc_agent.backend.pair_closures import by_logs
from flocc_agent.backend.posing import Posed, posed
from flocc_agent.backend.problem import diagonal_covariance
from flocc_agent.backend.results import Solution, closure_results, excluded, odometry_component
from flocc_agent.backend.screening import closure_complaints, screen
from flocc_agent.backend.together import AGREEING_MIN
from flocc_agent.backend.trueness import EXPECTED_FREEDOM, FACTOR_MAX, Inflation
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import (
    ClosureResult,
    ClosureState,
    Component,
    GraphSolution,
    LoopClosure,
    PoseGraph,
    Trajectory,
    stretched,
)
from flocc_agent.geometry import adjoint, inverse
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Ends = tuple[KeyframeId, KeyframeId]

SETTLED_KEYFRAMES_MIN = 2000
"""A smaller map is solved whole each time: that takes no time."""
OPEN_KEYFRAMES = 100
"""So many of a log's last keyframes stay open beside those that are new."""
NEW_KEYFRAMES_RATIO, NEW_KEYFRAMES_MIN = 0.05, 200
"""With more new keyframes, as a part of the whole and at least, the next round is a whole one."""
NEW_CLOSURES_RATIO, NEW_CLOSURES_MIN = 0.1, 50
HELD_CLOSURES_RATIO, HELD_CLOSURES_MIN = 0.005, 8
"""The same of new closures between two held keyframes: they move nothing before the next whole round."""
BESIDE_KEYFRAMES = 100
"""Closures of the same two logs are at one place where both of their keyframes are so near to each other."""
COMPARED_CLOSURES = 32
"""With so many of the nearest closures of its two logs a new one is compared before it is believed."""
TENSION_PROBABILITY = 1e-3
"""How rarely new closures cost more than this allows where the settled part is right."""


@dataclass(frozen=True, slots=True, eq=False)
class Open:
    """What of a component may move.

    Attributes:
        component: As the last whole round left it.
        bases: Of each log the last keyframe that is held, its tie to the rest; 0 where all of the log may move.
        tails: Odometry from there on, as long as the component says it is.
        nodes: Held keyframes that something open is tied to, in order.
        closures: Between open keyframes, or between them and the nodes, and new ones; by their number in the graph.
    """

    component: Component
    bases: Mapping[LogId, int]
    tails: Mapping[LogId, Trajectory]
    nodes: tuple[KeyframeId, ...]
    closures: Mapping[int, LoopClosure]

    def is_open(self, keyframe: KeyframeId) -> bool:
        """Whether a keyframe may move."""
        base = self.bases[keyframe.log]
        return keyframe.index > base or base == 0


def settled_round(graph: PoseGraph, config: BackendConfig, initial: GraphSolution) -> GraphSolution | None:
    """Solve what is new since the last whole round; None where everything is to be solved.

    Args:
        graph: Odometry and closures from images; with anything else all rounds are whole.
        config: The noise model; only the default kind of closures' scales and solvers that reject are known here.
        initial: The round before.
    """
    last = initial.whole or initial
    if not _is_small(graph, config, last):
        return None
    seen = {(c.query, c.match): c for c in last.closures}
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
        and all(closure.support == 1 for closure in graph.closures)
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
) -> tuple[Component, dict[int, ClosureResult]] | None:
    """One component, and results of its closures that were not seen before; None where it is to be opened."""
    logs = set(component.logs)
    of_fresh = {k: graph.closures[k] for k in fresh}
    if any((c.query.log in logs) != (c.match.log in logs) for c in of_fresh.values()):
        return None
    if component.logs == (component.anchor,) and not any(c.query.log in logs for c in graph.closures):
        return odometry_component(component.anchor, graph.trajectories[component.anchor]), {}
    opened = _opened(component, graph, fresh, seen)
    if opened is None or screen(PoseGraph(opened.tails)).warnings:
        return None
    began = _posed(opened, _extended(opened, before), config)
    ids = began.problem.closure_ids
    is_new = np.array([k in fresh for k in ids], dtype=bool)
    old = np.array([k < 0 or _was(seen, graph.closures[k], ClosureState.USED) for k in ids], dtype=bool)
    try:
        solved = _agreed(began, old | is_new, is_new, graph.closures)
        if solved is None or _is_strained(opened, began, solved, old, is_new, _excess(component, seen)):
            return None
        return _result(opened, graph, began, solved, fresh)
    except (SingularSystem, np.linalg.LinAlgError):
        return None


def _was(seen: Mapping[Ends, ClosureResult], closure: LoopClosure, state: ClosureState) -> bool:
    result = seen.get((closure.query, closure.match))
    return result is not None and result.state is state


def _opened(component: Component, graph: PoseGraph, fresh: set[int], seen: Mapping[Ends, ClosureResult]) -> Open | None:
    """Find what may move; None where too many new closures would move nothing."""
    bases, tails = {}, {}
    for log in component.logs:
        bases[log] = base = max(len(component.T_map_keyframe[log]) - OPEN_KEYFRAMES - 1, 0)
        trajectory = graph.trajectories[log]
        covariances = trajectory.edge_covariances
        tail = Trajectory(trajectory.T_odom_keyframe[base:], None if covariances is None else covariances[base:])
        scale = component.odometry_scales.get(log)
        tails[log] = stretched(tail, 1.0 / scale.ratio) if scale is not None and scale.is_applied else tail
    some = Open(component, bases, tails, (), {})
    closures = {
        k: c
        for k, c in enumerate(graph.closures)
        if c.query.log in bases and c.match.log in bases
        and c.match.log in bases
        and (
            k in fresh
            or ((some.is_open(c.query) or some.is_open(c.match))
                and not _was(seen, c, ClosureState.EXCLUDED) and (c.query, c.match) in seen)
        )
    }  # fmt: skip
    held = sum(not some.is_open(c.query) and not some.is_open(c.match) for c in closures.values())
    if held > max(HELD_CLOSURES_RATIO * len(seen), HELD_CLOSURES_MIN):
        return None
    ends = {end for c in closures.values() for end in (c.query, c.match) if not some.is_open(end)}
    ends |= {KeyframeId(log, base) for log, base in bases.items() if base}
    return Open(component, bases, tails, tuple(sorted(ends)), closures)


def _posed(opened: Open, T_tails: Mapping[LogId, Float], config: BackendConfig) -> Posed:
    """The open part and the stiff log, whose keyframes are named by their places; ties have numbers below zero."""
    stiff = SavedLog(f"{FIRST}/settled")
    places = {node: n for n, node in enumerate(opened.nodes)}

    def named(end: KeyframeId) -> KeyframeId:
        if opened.is_open(end):
            return KeyframeId(end.log, end.index - opened.bases[end.log])
        return KeyframeId(stiff, places[end])

    renamed = {k: replace(c, query=named(c.query), match=named(c.match)) for k, c in opened.closures.items()}
    trajectories, T = dict(opened.tails), dict(T_tails)
    if opened.nodes:
        trajectories[stiff] = stiff_trajectory(opened.component.T_map_keyframe, opened.nodes)
        T[stiff] = _stiff_poses(opened)
    S = diagonal_covariance(STIFF_ROTATION_SIGMA_RAD, STIFF_TRANSLATION_SIGMA_M)
    tied = [log for log, base in sorted(opened.bases.items()) if base]
    for n, log in enumerate(tied):
        at = KeyframeId(stiff, places[KeyframeId(log, opened.bases[log])])
        renamed[n - len(tied)] = LoopClosure(
            at, KeyframeId(log, 0), np.eye(4), CERTAIN_RATIO, covariance=S, metric=True, support=JOINS
        )
    lengths_m = {
        k: float(np.linalg.norm(T[c.query.log][c.query.index][:3, 3] - T[c.match.log][c.match.index][:3, 3]))
        for k, c in renamed.items()
        if not c.metric and c.scale_initial is None and c.covariance is not None
    }
    return posed(trajectories, renamed, Aligned(T, True), config, None, None, (), lengths_m)


def _stiff_poses(opened: Open) -> Float:
    return np.array([opened.component.T_map_keyframe[node.log][node.index] for node in opened.nodes])


def _agreed(began: Posed, wanted: Bool, is_new: Bool, closures: Sequence[LoopClosure]) -> Solved | None:
    """Solve with wanted closures, less the new ones that disagree alone; None where more than that is wrong."""
    objective, state, taken = began.objective, began.start, wanted
    for _ in range(2):
        solved = descend(objective, state, objective.weights(taken.astype(float)))
        agree = objective.closure_residuals(solved.state) <= objective.bounds()
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


def _is_strained(opened: Open, began: Posed, solved: Solved, old: Bool, is_new: Bool, excess: float) -> bool:
    """Whether new closures cost more than noise explains, which is so many times larger than it should be."""
    used = int(np.count_nonzero(is_new & (solved.weights[began.problem.closure_rows] > 0.0)))
    if used == 0:
        return False
    T = _extended(opened, opened.component)
    state = state_of(np.concatenate([T.get(log, _stiff_poses(opened)) for log in began.problem.logs]))
    cost = began.objective.cost(state, began.objective.weights(old.astype(float)), hold=False)
    return solved.cost - cost > 0.5 * float(chdtri(5.0 * used, TENSION_PROBABILITY)) * excess


def _excess(component: Component, seen: Mapping[Ends, ClosureResult]) -> float:
    """How many times larger a component's squared residuals are than their degrees of freedom."""
    logs = set(component.logs)
    used = sum(c.state is ClosureState.USED and c.query.log in logs for c in seen.values())
    freedom = max(5.0 * used - 6.0 * (len(logs) - 1), 0.0)
    return min((2.0 * component.cost + EXPECTED_FREEDOM) / (freedom + EXPECTED_FREEDOM), FACTOR_MAX)


def _extended(opened: Open, component: Component) -> dict[LogId, Float]:
    """Poses (N, 4, 4) of each log's tail: a solution's, and behind them by odometry."""
    return {
        log: extended(np.asarray(component.T_map_keyframe[log])[opened.bases[log] :], tail)
        for log, tail in opened.tails.items()
    }


def _result(
    opened: Open, graph: PoseGraph, began: Posed, solved: Solved, fresh: set[int]
) -> tuple[Component, dict[int, ClosureResult]]:
    """The component with its open part as solved, and the results of new closures."""
    problem, earlier = began.problem, opened.component
    T_open = problem.by_log(solved.state.poses())
    T_map_keyframe = {
        log: np.concatenate([np.asarray(earlier.T_map_keyframe[log])[:base], T_open[log]])
        for log, base in opened.bases.items()
    }
    recorded = {k: graph.closures[k] if k >= 0 else began.places.closures[k] for k in problem.closure_ids}
    solution = Solution(problem, began.objective, began.start, solved, began.places.trajectories, recorded)
    of_new = {k: result for k, result in closure_results(solution).items() if k in fresh}
    component = replace(
        earlier,
        T_map_keyframe=T_map_keyframe,
        T_map_odom={log: T[-1] @ inverse(_last(graph.trajectories[log])) for log, T in T_map_keyframe.items()},
        covariance_map_odom=_covariances(opened, graph, began, solved),
        covariance_rounds=COVARIANCE_ROUNDS,
    )
    return component, of_new


def _covariances(opened: Open, graph: PoseGraph, began: Posed, solved: Solved) -> dict[LogId, Float | None]:
    """Of each log's `T_map_odom` (6, 6): the settled part's, and what its open part adds to it."""
    earlier, problem = opened.component, began.problem
    found = dict(earlier.covariance_map_odom)
    logs = [log for log in earlier.logs if found.get(log) is not None]
    ends = [problem.offsets[log] + len(opened.tails[log]) - 1 for log in logs]
    for log, S in zip(logs, keyframe_covariances(began.objective, solved, ends) if ends else [], strict=True):
        larger = Inflation(*earlier.covariance_factors.get(log, (1.0, 1.0)))
        Ad = adjoint(_last(graph.trajectories[log]))
        found[log] = np.asarray(earlier.covariance_map_odom[log]) + Ad @ larger.of(S) @ Ad.T
    return found


def _last(trajectory: Trajectory) -> Float:
    return np.asarray(trajectory.T_odom_keyframe[-1], dtype=float)
