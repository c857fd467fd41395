"""The back end's entry point: a pose graph in, every component optimised in the frame of its anchor out.

The story of `optimise`: screen the input; for every connected component align the odom frames, filter closures by
pairwise consistency, solve, and take components apart that only rejected closures held together. Bad measurements
become exclusions with a reason; what cannot be solved keeps its odometry. Deterministic: no clock decides anything.
"""

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flocc_agent.backend.covariance import covariances_map_odom
from flocc_agent.backend.edges import residuals, scales_at, state_of
from flocc_agent.backend.initial import initial_poses
from flocc_agent.backend.linear import LinearSolver, SingularSystem
from flocc_agent.backend.problem import Problem, build
from flocc_agent.backend.scale_report import scale_warnings
from flocc_agent.backend.screening import Screened, screen
from flocc_agent.backend.solvers import ACCEPTED_WEIGHT_MIN, Objective, Solved, solve
from flocc_agent.config import BackendConfig, Solver
from flocc_agent.core.pose_graph import (
    AbsoluteFix,
    ClosureResult,
    ClosureState,
    Component,
    GraphSolution,
    LoopClosure,
    OptimisationFailed,
    PoseGraph,
    Trajectory,
    components_of,
)
from flocc_agent.geometry import Float, inverse
from flocc_protocol.ids import LogId

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What solving some logs together gave: their components, their closures' results by index, and sentences."""

    components: tuple[Component, ...]
    closures: Mapping[int, ClosureResult]
    warnings: tuple[str, ...]
    iterations: int


def optimise(
    graph: PoseGraph, config: BackendConfig, initial: GraphSolution | None = None
) -> GraphSolution | OptimisationFailed:
    """Optimise every connected component of a pose graph.

    Args:
        graph: Odometry, closures and fixes; nothing in it is trusted.
        config: Formulation, solver, noise model and priors.
        initial: An earlier solution to start from; keyframes that it lacks follow their odometry.

    Returns:
        The solution, with one result per closure and a sentence for whatever was left out; or why there is none.
    """
    began = time.perf_counter()
    screened = screen(graph)
    if not screened.trajectories:
        reason = "; ".join(screened.warnings) or "the pose graph has no odometry"
        return OptimisationFailed(reason)
    usable = {k: c for k, c in enumerate(graph.closures) if k not in screened.excluded}
    outcomes = [
        _solve_logs(logs, usable, screened, config, initial)
        for logs in components_of(list(screened.trajectories), list(usable.values()))
    ]
    results = {k: _excluded(graph.closures[k], reason) for k, reason in screened.excluded.items()}
    for outcome in outcomes:
        results.update(outcome.closures)
    components = sorted((c for outcome in outcomes for c in outcome.components), key=lambda c: c.anchor)
    warnings = [*screened.warnings, *screened.excluded.values(), *(w for o in outcomes for w in o.warnings)]
    return GraphSolution(
        components=tuple(components),
        closures=tuple(results[k] for k in range(len(graph.closures))),
        warnings=tuple(warnings),
        iterations=sum(outcome.iterations for outcome in outcomes),
        solve_s=time.perf_counter() - began,
    )


def _excluded(closure: LoopClosure, reason: str) -> ClosureResult:
    return ClosureResult(closure.query, closure.match, ClosureState.EXCLUDED, 0.0, None, 0.0, reason)


def _solve_logs(
    logs: Sequence[LogId],
    usable: Mapping[int, LoopClosure],
    screened: Screened,
    config: BackendConfig,
    initial: GraphSolution | None,
) -> Outcome:
    """Solve logs that closures connect; take them apart where only rejected closures did."""
    trajectories = {log: screened.trajectories[log] for log in logs}
    closures = {k: c for k, c in usable.items() if c.query.log in trajectories}
    fixes = [f for f in screened.fixes if f.keyframe.log in trajectories]
    if not closures and not fixes:
        return Outcome((_odometry_component(logs[0], trajectories[logs[0]]),), {}, (), 0)
    try:
        return _solve_connected(trajectories, closures, fixes, config, initial)
    except (SingularSystem, np.linalg.LinAlgError, FloatingPointError) as error:
        logger.error("component of %s could not be solved: %s", logs[0], error)
        return _fallback(
            trajectories, closures, f"component of {logs[0]} could not be solved and keeps odometry: {error}"
        )


def _fallback(trajectories: Mapping[LogId, Trajectory], closures: Mapping[int, LoopClosure], reason: str) -> Outcome:
    """Every log on its own odometry, every closure excluded for one reason."""
    components = tuple(_odometry_component(log, trajectory) for log, trajectory in trajectories.items())
    return Outcome(components, {k: _excluded(c, reason) for k, c in closures.items()}, (reason,), 0)


def _odometry_component(log: LogId, trajectory: Trajectory) -> Component:
    T = np.asarray(trajectory.T_odom_keyframe, dtype=float)
    return Component((log,), {log: T.copy()}, {log: np.eye(4)}, {log: np.zeros((6, 6))})


def _solve_connected(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    fixes: Sequence[AbsoluteFix],
    config: BackendConfig,
    initial: GraphSolution | None,
) -> Outcome:
    T_initial = initial_poses(trajectories, closures, config.steepness, initial)
    problem = build(trajectories, closures, fixes, config)
    state = state_of(_stacked(problem, T_initial), problem.clusters)
    linear = LinearSolver(0, config.scale_prior_unknown_sigma_ratio)
    solved = solve(Objective(problem.edges, problem.closure_rows, linear, config), state)
    if not (np.all(np.isfinite(solved.state.t)) and np.all(np.isfinite(solved.state.q))):
        raise SingularSystem("the solution is not finite")
    return _collect(problem, trajectories, closures, solved, linear, config)


def _stacked(problem: Problem, T: Mapping[LogId, Float]) -> Float:
    return np.concatenate([T[log] for log in problem.logs])


def _collect(
    problem: Problem,
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    solved: Solved,
    linear: LinearSolver,
    config: BackendConfig,
) -> Outcome:
    """Turn arrays back into components and closure results."""
    rows = problem.closure_rows
    weights = solved.weights[rows]
    squared = residuals(problem.edges, solved.state).squared()[rows]
    scales = scales_at(problem.edges, solved.state)[rows] * problem.scale_initial
    results = {
        k: _result(closures[k], float(weights[n]), float(scales[n]), float(np.sqrt(squared[n])), config)
        for n, k in enumerate(problem.closure_ids)
    }
    used = [closures[k] for k in problem.closure_ids if results[k].state is ClosureState.USED]
    T_all = solved.state.poses()
    groups = components_of(problem.logs, used)
    covariances = (
        covariances_map_odom(problem, trajectories, solved, linear) if config.covariances and len(groups) == 1 else {}
    )
    cost = solved.cost if len(groups) == 1 else 0.0
    components = tuple(_component(group, problem, trajectories, T_all, covariances, cost) for group in groups)
    return Outcome(components, results, scale_warnings(problem, solved, closures), solved.iterations)


def _result(closure: LoopClosure, weight: float, scale: float, residual: float, config: BackendConfig) -> ClosureResult:
    rejects = config.solver in (Solver.GNC_TLS, Solver.GNC_GM)
    used = weight >= ACCEPTED_WEIGHT_MIN or not rejects
    state = ClosureState.USED if used else ClosureState.REJECTED
    estimated = used and not closure.metric
    return ClosureResult(
        closure.query,
        closure.match,
        state,
        weight,
        scale if estimated else None,
        residual if np.isfinite(residual) else 0.0,
    )


def _component(
    group: Sequence[LogId],
    problem: Problem,
    trajectories: Mapping[LogId, Trajectory],
    T_all: Float,
    covariances: Mapping[LogId, Float],
    cost: float,
) -> Component:
    """A component in the frame of its own anchor, whose first keyframe lies at its odometry pose."""
    anchor = group[0]
    T_map_all = trajectories[anchor].T_odom_keyframe[0] @ inverse(T_all[problem.offsets[anchor]])
    T_map_keyframe = {
        log: T_map_all @ T_all[problem.offsets[log] : problem.offsets[log] + len(trajectories[log])] for log in group
    }
    T_map_odom = {log: T_map_keyframe[log][-1] @ inverse(trajectories[log].T_odom_keyframe[-1]) for log in group}
    return Component(tuple(group), T_map_keyframe, T_map_odom, {log: covariances.get(log) for log in group}, cost)
