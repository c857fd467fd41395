"""From arrays back to components and closure results."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flocc_agent.backend.chains import Chains
from flocc_agent.backend.covariance import covariances_of, kept_covariances
from flocc_agent.backend.descent import Objective, Solved
from flocc_agent.backend.edges import State, residuals, scales_at
from flocc_agent.backend.problem import Problem
from flocc_agent.backend.scale_report import odometry_warnings, scale_warnings
from flocc_agent.backend.solvers import ACCEPTED_WEIGHT_MIN
from flocc_agent.backend.ties import tie_warnings
from flocc_agent.backend.trueness import inflations, told
from flocc_agent.backend.wrong_steps import wrong_step_warnings
from flocc_agent.config import Solver
from flocc_agent.core.pose_graph import ClosureResult, ClosureState, Component, LoopClosure, OdometryScale, Trajectory
from flocc_agent.geometry import Float, inverse
from flocc_protocol.ids import KeyframeId, LogId


@dataclass(frozen=True, slots=True, eq=False)
class SolvedLogs:
    """What solving some logs gave: their components, their closures' results by index, and sentences."""

    components: tuple[Component, ...]
    closures: Mapping[int, ClosureResult]
    warnings: tuple[str, ...] = ()
    iterations: int = 0
    timings_s: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A solved component, still in arrays, with where it started and what it was made of.

    `earlier` is the component of the round before, where all of its closures stand; `chains` are what its odometry
    was shortened to, where it was.
    """

    problem: Problem
    objective: Objective
    start: State
    solved: Solved
    trajectories: Mapping[LogId, Trajectory]
    closures: Mapping[int, LoopClosure]
    earlier: Component | None = None
    odometry_scales: Mapping[LogId, OdometryScale] = field(default_factory=dict)
    chains: Chains | None = None

    @property
    def recorded(self) -> Mapping[int, LoopClosure]:
        """The closures under their keyframes' own numbers."""
        return self.closures if self.chains is None else self.chains.recorded


def excluded(closure: LoopClosure, reason: str) -> ClosureResult:
    """Result of a closure that never reached the solver."""
    return ClosureResult(closure.query, closure.match, ClosureState.EXCLUDED, 0.0, None, 0.0, reason)


def rejected(closure: LoopClosure, reason: str) -> ClosureResult:
    """Result of a closure that was turned away as an outlier before solving."""
    return ClosureResult(closure.query, closure.match, ClosureState.REJECTED, 0.0, None, 0.0, reason)


def odometry_component(log: LogId, trajectory: Trajectory) -> Component:
    """A log on its own: its map frame is its odom frame, known without error."""
    T = np.array(trajectory.T_odom_keyframe, dtype=float)
    return Component((log,), {log: T}, {log: np.eye(4)}, {log: np.zeros((6, 6))})


def collect(solution: Solution, wanted: Sequence[KeyframeId]) -> SolvedLogs:
    """Component, closure results and warnings of a solved component; covariances where they are wanted."""
    results = closure_results(solution)
    component = _component(solution, wanted)
    warnings = scale_warnings(solution.problem, solution.solved, solution.recorded)
    scaled = odometry_warnings(solution.odometry_scales)
    steps = wrong_step_warnings(solution.problem, solution.solved) if scaled and solution.chains is None else ()
    warnings = (*warnings, *scaled, *steps, *_ties(solution, results))
    if not solution.solved.converged:
        warnings = (*warnings, f"{component.map_frame}: the solver stopped before it converged")
    return SolvedLogs((component,), results, warnings, solution.solved.iterations)


def _ties(solution: Solution, results: Mapping[int, ClosureResult]) -> tuple[str, ...]:
    problem, config = solution.problem, solution.objective.config
    T = solution.solved.state.poses()
    T_keyframes = {log: T[start : start + len(solution.trajectories[log])] for log, start in problem.offsets.items()}
    used = np.array([results[k].state is ClosureState.USED for k in problem.closure_ids], dtype=bool)
    return tie_warnings(
        problem,
        T_keyframes,
        used,
        solution.trajectories,
        solution.closures,
        config.steepness,
    )


def closure_results(solution: Solution) -> dict[int, ClosureResult]:
    """One result per closure, by index in the graph."""
    problem, solved, rows = solution.problem, solution.solved, solution.problem.closure_rows
    norms = np.sqrt(residuals(problem.edges, solved.state).squared()[rows])
    scales = scales_at(problem.edges, solved.state)[rows] * problem.scale_initial
    rejects = solution.objective.config.solver in (Solver.GNC_TLS, Solver.GNC_GM)
    results = {}
    for n, k in enumerate(problem.closure_ids):
        closure, weight = solution.recorded[k], float(solved.weights[rows][n])
        used = weight >= ACCEPTED_WEIGHT_MIN or not rejects
        results[k] = ClosureResult(
            query=closure.query,
            match=closure.match,
            state=ClosureState.USED if used else ClosureState.REJECTED,
            weight=weight,
            scale=float(scales[n]) if used and not closure.metric else None,
            residual=float(norms[n]),
            reason="" if used else "disagrees with the other closures",
        )
    return results


def _component(solution: Solution, wanted: Sequence[KeyframeId]) -> Component:
    """The component in the frame of its anchor, whose first keyframe lies at its odometry pose."""
    problem, trajectories, objective = solution.problem, solution.trajectories, solution.objective
    chains = solution.chains
    places = wanted if chains is None else [chains.place(keyframe) for keyframe in wanted]
    T_all = solution.solved.state.poses()
    anchor = problem.logs[0]
    T_map_all = trajectories[anchor].T_odom_keyframe[0] @ inverse(T_all[0])
    T_map_keyframe = {
        log: T_map_all @ T_all[problem.offsets[log] : problem.offsets[log] + len(trajectories[log])]
        for log in problem.logs
    }
    kept = kept_covariances(objective, problem, solution.earlier, wanted)
    larger = told(found := inflations(problem, solution.solved))
    if kept is None:
        of_logs, of_keyframes = covariances_of(problem, objective, solution.solved, trajectories, places, found)
    else:
        of_logs, of_keyframes = dict(kept), {}
        larger = dict(solution.earlier.covariance_factors) if solution.earlier is not None else larger
    component = Component(
        logs=problem.logs,
        T_map_keyframe=T_map_keyframe,
        T_map_odom={log: _T_map_odom(T_map_keyframe[log], trajectories[log]) for log in problem.logs},
        covariance_map_odom=of_logs,
        cost=solution.solved.cost,
        cost_initial=objective.cost(solution.start, solution.solved.weights, hold=True),
        covariance_keyframe=of_keyframes,
        covariance_rounds=0 if kept is None or solution.earlier is None else solution.earlier.covariance_rounds + 1,
        odometry_scales=solution.odometry_scales,
        covariance_factors=larger if objective.config.covariances else {},
    )
    if chains is None:
        return component
    return chains.whole_component(component, problem.scales_applied(solution.solved.state))


def _T_map_odom(T_map_keyframe: Float, trajectory: Trajectory) -> Float:
    return np.asarray(T_map_keyframe[-1] @ inverse(np.asarray(trajectory.T_odom_keyframe[-1], dtype=float)))
