"""The back end's entry point: a pose graph in, every component optimised in the frame of its anchor out.

The story: screen the input; for every connected component align the odom frames, filter closures by pairwise
consistency, solve, and take components apart that only rejected closures held together. Bad measurements become
exclusions with a reason; what cannot be solved keeps its odometry. Deterministic: no clock and no chance decide.
"""

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from flocc_agent.backend.clusters import votes
from flocc_agent.backend.consistency import inconsistent
from flocc_agent.backend.descent import Objective
from flocc_agent.backend.edges import state_of
from flocc_agent.backend.initial import initial_poses, trusted_closures
from flocc_agent.backend.joining import too_few
from flocc_agent.backend.linear import LinearSolver, SingularSystem
from flocc_agent.backend.measured import with_factors, without_factors
from flocc_agent.backend.placing import Places
from flocc_agent.backend.problem import build
from flocc_agent.backend.results import Solution, SolvedLogs, collect, excluded, odometry_component, rejected
from flocc_agent.backend.screening import Screened, screen
from flocc_agent.backend.solvers import solve
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import (
    ClosureResult,
    ClosureState,
    GraphSolution,
    LoopClosure,
    OptimisationFailed,
    PoseGraph,
    Trajectory,
    components_of,
)
from flocc_protocol.ids import KeyframeId, LogId

logger = logging.getLogger(__name__)


def optimise(
    graph: PoseGraph,
    config: BackendConfig,
    initial: GraphSolution | None = None,
    covariance_of: Sequence[KeyframeId] = (),
) -> GraphSolution | OptimisationFailed:
    """Optimise every connected component of a pose graph.

    Args:
        graph: Odometry, closures and measured factors; nothing in it is trusted.
        config: Formulation, solver, noise model and priors.
        initial: An earlier solution to start from; keyframes that it lacks follow their odometry.
        covariance_of: Keyframes whose marginal covariance is wanted, beside every robot's `T_map_odom`.

    Returns:
        The solution, with one result per closure and a sentence for whatever was left out; or why there is none.
    """
    expanded = with_factors(graph, config, initial)
    solution = _optimise(expanded.graph, config, expanded.initial, covariance_of)
    return solution if isinstance(solution, OptimisationFailed) else without_factors(solution, graph, expanded)


def _optimise(
    graph: PoseGraph, config: BackendConfig, initial: GraphSolution | None, covariance_of: Sequence[KeyframeId]
) -> GraphSolution | OptimisationFailed:
    """Optimise a graph of odometry and closures."""
    began = time.perf_counter()
    screened = screen(graph)
    if not screened.trajectories:
        return OptimisationFailed("; ".join(screened.warnings) or "the pose graph has no odometry")
    usable = {k: c for k, c in enumerate(graph.closures) if k not in screened.excluded}
    after_screening = time.perf_counter()
    outcomes = [
        _solve_group(logs, usable, screened, config, initial, covariance_of)
        for logs in components_of(list(screened.trajectories), list(usable.values()))
    ]
    results = {k: excluded(graph.closures[k], reason) for k, reason in screened.excluded.items()}
    for outcome in outcomes:
        results.update(outcome.closures)
    timings_s = {"screening": after_screening - began, **summed_timings(outcomes)}
    return GraphSolution(
        components=tuple(sorted((c for outcome in outcomes for c in outcome.components), key=lambda c: c.anchor)),
        closures=tuple(results[k] for k in range(len(graph.closures))),
        warnings=(*screened.warnings, *screened.excluded.values(), *(w for o in outcomes for w in o.warnings)),
        iterations=sum(outcome.iterations for outcome in outcomes),
        solve_s=time.perf_counter() - began,
        timings_s=timings_s,
    )


def _solve_group(
    logs: Sequence[LogId],
    usable: Mapping[int, LoopClosure],
    screened: Screened,
    config: BackendConfig,
    initial: GraphSolution | None,
    covariance_of: Sequence[KeyframeId],
) -> SolvedLogs:
    """Solve logs that closures connect; where that fails, every log keeps its odometry."""
    trajectories = {log: screened.trajectories[log] for log in logs}
    closures = {k: c for k, c in usable.items() if c.query.log in trajectories and c.match.log in trajectories}
    if not closures:
        return SolvedLogs(tuple(odometry_component(log, trajectories[log]) for log in logs), {})
    wanted = [keyframe for keyframe in covariance_of if keyframe.log in trajectories]
    try:
        return _solve_and_split(trajectories, closures, config, initial, wanted)
    except (SingularSystem, np.linalg.LinAlgError, FloatingPointError) as error:
        reason = f"the component of robot {logs[0]} could not be solved and keeps its odometry: {error}"
        logger.error("%s", reason)
        components = tuple(odometry_component(log, trajectories[log]) for log in logs)
        return SolvedLogs(components, {k: excluded(c, reason) for k, c in closures.items()}, (reason,))


def _solve_and_split(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    config: BackendConfig,
    initial: GraphSolution | None,
    wanted: Sequence[KeyframeId],
) -> SolvedLogs:
    """Solve; where too few closures join maps, or are left to, solve each component with the closures that it has."""
    began = time.perf_counter()
    dropped = inconsistent(trajectories, closures, config) if config.pairwise_consistency else {}
    turned_away = {k: rejected(closures[k], reason) for k, reason in dropped.items()}
    turned_away |= _joining_too_few(trajectories, closures, turned_away, config)
    outcome = SolvedLogs((), {})
    groups = _groups(trajectories, closures, turned_away)
    if len(groups) == 1:
        kept = {k: c for k, c in closures.items() if k not in turned_away}
        outcome = _solve_connected(trajectories, kept, config, initial, wanted)
        turned_away |= {k: r for k, r in outcome.closures.items() if r.state is not ClosureState.USED}
        turned_away |= _joining_too_few(trajectories, closures, turned_away, config)
        groups = _groups(trajectories, closures, turned_away)
    if len(groups) == 1:
        timings_s = {"consistency": time.perf_counter() - began - sum(outcome.timings_s.values()), **outcome.timings_s}
        return replace(outcome, closures={**outcome.closures, **turned_away}, timings_s=timings_s)
    left = {k: c for k, c in closures.items() if k not in turned_away}
    screened = Screened(dict(trajectories), {}, ())
    plain = config.model_copy(update={"pairwise_consistency": False})
    parts = [_solve_group(logs, left, screened, plain, initial, wanted) for logs in groups]
    return _joined(parts, turned_away, outcome)


def _joining_too_few(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    turned_away: Mapping[int, ClosureResult],
    config: BackendConfig,
) -> dict[int, ClosureResult]:
    """Those of the remaining closures that are too few to join maps."""
    left = {k: c for k, c in closures.items() if k not in turned_away}
    reason = f"fewer than {config.closures_to_join_min} closures join these maps"
    return {k: rejected(left[k], reason) for k in too_few(list(trajectories), left, config.closures_to_join_min)}


def _groups(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    turned_away: Mapping[int, ClosureResult],
) -> tuple[tuple[LogId, ...], ...]:
    """The logs that the remaining closures connect."""
    return components_of(list(trajectories), [c for k, c in closures.items() if k not in turned_away])


def _joined(parts: Sequence[SolvedLogs], turned_away: Mapping[int, ClosureResult], before: SolvedLogs) -> SolvedLogs:
    closures = dict(turned_away)
    for part in parts:
        closures.update(part.closures)
    return SolvedLogs(
        tuple(c for part in parts for c in part.components),
        closures,
        tuple(w for part in parts for w in part.warnings),
        before.iterations + sum(part.iterations for part in parts),
        summed_timings([before, *parts]),
    )


def summed_timings(outcomes: Sequence[SolvedLogs]) -> dict[str, float]:
    """Seconds of each stage, of all outcomes together."""
    names = sorted({name for outcome in outcomes for name in outcome.timings_s})
    return {name: sum(outcome.timings_s.get(name, 0.0) for outcome in outcomes) for name in names}


def _solve_connected(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    config: BackendConfig,
    initial: GraphSolution | None,
    wanted: Sequence[KeyframeId],
) -> SolvedLogs:
    times = [time.perf_counter()]
    T_initial, warm = initial_poses(trajectories, closures, config.steepness, initial)
    times.append(time.perf_counter())
    problem = build(trajectories, closures, config)
    state = state_of(np.concatenate([T_initial[log] for log in problem.logs]), problem.clusters)
    linear = LinearSolver(0, config.scale_prior_unknown_sigma_ratio)
    objective = Objective(problem.edges, problem.closure_rows, linear, config)
    trusted = trusted_closures([closures[k] for k in problem.closure_ids], initial) if warm and initial else None
    says = votes([closures[k] for k in problem.closure_ids], config.cluster_keyframes_max)
    places = Places(problem, trajectories, closures, says, config.steepness)
    solved = solve(objective, state, trusted, places)
    if not (np.all(np.isfinite(solved.state.t)) and np.all(np.isfinite(solved.state.q))):
        raise SingularSystem("the solution is not finite")
    times.append(time.perf_counter())
    solution = Solution(problem, objective, state, solved, trajectories, closures)
    outcome = collect(solution, wanted)
    times.append(time.perf_counter())
    spans_s = np.diff(times).tolist()
    return replace(outcome, timings_s=dict(zip(("alignment", "solver", "results"), spans_s, strict=True)))
