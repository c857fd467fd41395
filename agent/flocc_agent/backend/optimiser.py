"""The back end's entry point: a pose graph in, every component optimised in the frame of its anchor out.

The story: screen the input; for every connected component align the odom frames, filter closures by pairwise
consistency, solve, and take components apart that only rejected closures held together. Bad measurements become
exclusions with a reason; what cannot be solved keeps its odometry. Deterministic: no clock and no chance decide.
"""

import logging
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from flocc_agent.backend.alarms import fitted_lengths, held_closures
from flocc_agent.backend.chains import Chains, chains_of, is_explained
from flocc_agent.backend.filtering import Filtered, filtered
from flocc_agent.backend.hanging import HANG, hanging_parts
from flocc_agent.backend.initial import Aligned, component_with, initial_poses, lengths_at
from flocc_agent.backend.linear import SingularSystem
from flocc_agent.backend.mapped import solver_keyframes, with_map, without_map
from flocc_agent.backend.measured import with_factors, without_factors
from flocc_agent.backend.odometry_scale import SolvedWithScales, solve_with_scales, with_mean_of_one
from flocc_agent.backend.parted import less_exact, sentence
from flocc_agent.backend.posing import Posed, posed, posed_by_chains
from flocc_agent.backend.results import Solution, SolvedLogs, collect, excluded, odometry_component
from flocc_agent.backend.screening import Screened, screen
from flocc_agent.backend.settled import settled_round
from flocc_agent.backend.solvers import continued
from flocc_agent.backend.understated import widened
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import (
    ClosureResult,
    ClosureState,
    GraphSolution,
    LoopClosure,
    OptimisationFailed,
    PoseGraph,
    Trajectory,
    components_of,
    stretched,
)
from flocc_agent.core.saved_map import SavedMap
from flocc_protocol.ids import KeyframeId, LogId

logger = logging.getLogger(__name__)

AWAY_MIN = 10
"""Fewer closures that are turned away are named one by one, and say nothing of all."""


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
    if graph.saved is not None:
        return _optimise_in_map(graph, graph.saved, config, initial, covariance_of)
    expanded = with_factors(graph, config, initial)
    solution = _optimise(expanded.graph, config, expanded.initial, covariance_of)
    if isinstance(solution, OptimisationFailed):
        return solution
    lasting = (warning for warning in solution.warnings if HANG not in warning)
    solution = replace(solution, warnings=(*lasting, *hanging_parts(expanded.graph, solution)))
    return without_factors(solution, graph, expanded)


def _optimise_in_map(
    graph: PoseGraph,
    saved: SavedMap,
    config: BackendConfig,
    initial: GraphSolution | None,
    covariance_of: Sequence[KeyframeId],
) -> GraphSolution | OptimisationFailed:
    """Optimise what a team adds to an opened map, in the map's frame."""
    mapped = with_map(graph, saved, config, initial)
    if mapped.graph is None:
        return without_map(None, mapped)
    solution = optimise(mapped.graph, config, mapped.initial, solver_keyframes(covariance_of, mapped))
    return solution if isinstance(solution, OptimisationFailed) else without_map(solution, mapped)


def _optimise(
    graph: PoseGraph, config: BackendConfig, initial: GraphSolution | None, covariance_of: Sequence[KeyframeId]
) -> GraphSolution | OptimisationFailed:
    """Optimise a graph of odometry and closures."""
    began = time.perf_counter()
    settled = None if initial is None or covariance_of else settled_round(graph, config, initial)
    if settled is not None:
        solve_s = time.perf_counter() - began
        return replace(settled, solve_s=solve_s, timings_s={"settled": solve_s})
    screened = screen(graph)
    left = {k: c for k, c in enumerate(graph.closures) if k not in screened.excluded}
    if config.formulation is not Formulation.BASE and config.solver in (Solver.GNC_TLS, Solver.GNC_GM):
        larger = widened(screened.trajectories, left, config)
        left, warnings = larger.closures, (*screened.warnings, *larger.warnings)
        screened = replace(screened, trajectories=larger.trajectories, warnings=warnings)
    held = held_closures(screened.trajectories, left, config)
    screened = replace(screened, excluded={**screened.excluded, **held})
    if not screened.trajectories:
        return OptimisationFailed("; ".join(screened.warnings) or "the pose graph has no odometry")
    usable = {k: c for k, c in left.items() if k not in held}
    after_screening = time.perf_counter()
    of_held = {k: left[k] for k in held}
    outcomes = [
        _solve_group(logs, usable, of_held, screened, config, initial, covariance_of)
        for logs in components_of(list(screened.trajectories), list(usable.values()))
    ]
    results: dict[int, ClosureResult] = {}
    for outcome in outcomes:
        results.update(outcome.closures)
    left_out = {k: reason for k, reason in screened.excluded.items() if k not in results}
    results.update({k: excluded(graph.closures[k], reason) for k, reason in left_out.items()})
    timings_s = {"screening": after_screening - began, **summed_timings(outcomes)}
    return GraphSolution(
        components=tuple(sorted((c for outcome in outcomes for c in outcome.components), key=lambda c: c.anchor)),
        closures=tuple(results[k] for k in range(len(graph.closures))),
        warnings=(
            *screened.warnings,
            *turned_away(results, left),
            *left_out.values(),
            *(w for o in outcomes for w in o.warnings),
        ),
        iterations=sum(outcome.iterations for outcome in outcomes),
        solve_s=time.perf_counter() - began,
        timings_s=timings_s,
    )


def turned_away(results: Mapping[int, ClosureResult], closures: Collection[int]) -> tuple[str, ...]:
    """A sentence where a solution rests on less than half of the closures that could be used."""
    away = sum(results[k].state is not ClosureState.USED for k in closures)
    if away < AWAY_MIN or 2 * away <= len(closures):
        return ()
    return (
        f"{away} of {len(closures)} closures contradict others or odometry and were turned away: most are wrong, "
        "or covariances are stated too small; robots may be in wrong places",
    )


def _solve_group(
    logs: Sequence[LogId],
    usable: Mapping[int, LoopClosure],
    held: Mapping[int, LoopClosure],
    screened: Screened,
    config: BackendConfig,
    initial: GraphSolution | None,
    covariance_of: Sequence[KeyframeId],
) -> SolvedLogs:
    """Solve logs that closures connect; where that fails, every log keeps its odometry."""
    trajectories = {log: screened.trajectories[log] for log in logs}
    closures, of_held = (
        {k: c for k, c in all_.items() if c.query.log in trajectories and c.match.log in trajectories}
        for all_ in (usable, held)
    )
    if not closures:
        return SolvedLogs(tuple(odometry_component(log, trajectories[log]) for log in logs), {})
    wanted = [keyframe for keyframe in covariance_of if keyframe.log in trajectories]
    try:
        return _solve_and_split(trajectories, closures, of_held, config, initial, wanted)
    except (SingularSystem, np.linalg.LinAlgError, FloatingPointError) as error:
        reason = f"the component of robot {logs[0]} could not be solved and keeps its odometry: {error}"
        logger.error("%s", reason)
        components = tuple(odometry_component(log, trajectories[log]) for log in logs)
        return SolvedLogs(components, {k: excluded(c, reason) for k, c in closures.items()}, (reason,))


def _solve_and_split(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    held: Mapping[int, LoopClosure],
    config: BackendConfig,
    initial: GraphSolution | None,
    wanted: Sequence[KeyframeId],
) -> SolvedLogs:
    """Filter and solve; what the closures left do not hold together is solved apart, with the closures that it has."""
    began = time.perf_counter()
    kept = filtered(trajectories, closures, held, config)
    filtering_s = time.perf_counter() - began
    outcome = SolvedLogs((), {}, timings_s={"consistency": filtering_s})
    if kept.is_connected:
        whole = kept
        outcome, kept = _solve_and_choose(whole, config, initial, wanted)
        if not kept.is_connected and (wider := less_exact(whole, kept, config)):
            again = replace(whole, closures={**whole.closures, **wider})
            outcome_again, kept_again = _solve_and_choose(again, config, initial, wanted)
            if wider.keys() <= kept_again.left.keys():
                warnings = (*outcome_again.warnings, sentence(wider))
                outcome, kept = replace(outcome_again, warnings=warnings), kept_again
        outcome = replace(outcome, timings_s={"consistency": filtering_s, **outcome.timings_s})
    if kept.is_connected:
        return replace(outcome, closures={**outcome.closures, **kept.turned_away})
    return _split(kept, outcome, config, initial, wanted)


def _solve_and_choose(
    whole: Filtered, config: BackendConfig, initial: GraphSolution | None, wanted: Sequence[KeyframeId]
) -> tuple[SolvedLogs, Filtered]:
    """Solve a component; what it makes of it, and what is left once closures that disagree are turned away."""
    outcome = _solve_connected(whole, config, initial, wanted)
    kept = whole.released(outcome.closures)
    outcome = replace(outcome, closures={k: r for k, r in outcome.closures.items() if k in kept.closures})
    return outcome, kept.without({k: r for k, r in outcome.closures.items() if r.state is not ClosureState.USED})


def _split(
    kept: Filtered,
    before: SolvedLogs,
    config: BackendConfig,
    initial: GraphSolution | None,
    wanted: Sequence[KeyframeId],
) -> SolvedLogs:
    """Solve each group that the closures left connect by itself."""
    screened = Screened(dict(kept.trajectories), {}, ())
    plain = config.model_copy(update={"pairwise_consistency": False})
    left = kept.left
    parts = [_solve_group(logs, left, kept.held, screened, plain, initial, wanted) for logs in kept.groups]
    closures = dict(kept.turned_away)
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
    kept: Filtered, config: BackendConfig, initial: GraphSolution | None, wanted: Sequence[KeyframeId]
) -> SolvedLogs:
    """Align the odom frames, pose the problem, solve it, collect what consumers get (Sec. III-C)."""
    times = [time.perf_counter()]
    aligned = initial_poses(kept.trajectories, kept.left, config.steepness, initial)
    aligned = aligned._replace(lengths_m=fitted_lengths(kept.trajectories, kept.taking_part, config))
    times.append(time.perf_counter())
    chains = chains_of(kept.trajectories, kept.taking_part, wanted, config)
    found = _solve_aligned(kept, chains, aligned, config, initial)
    if chains is not None and not is_explained(chains, found.posed.problem, found.solved):
        found = _solve_all(kept, chains, found, config)
        chains = None
    solved, at = found.solved, found.posed
    if not (np.all(np.isfinite(solved.state.t)) and np.all(np.isfinite(solved.state.q))):
        raise SingularSystem("the solution is not finite")
    times.append(time.perf_counter())
    earlier = component_with(kept.trajectories, initial) if at.is_confirmed(solved) else None
    trajectories, closures = (kept if chains is None else chains).trajectories, at.places.closures
    solution = Solution(
        at.problem,
        at.objective,
        at.start,
        solved,
        trajectories,
        closures,
        earlier,
        found.odometry_scales,
        chains,
    )
    outcome = collect(solution, wanted)
    times.append(time.perf_counter())
    spans_s = np.diff(times).tolist()
    return replace(outcome, timings_s=dict(zip(("alignment", "solver", "results"), spans_s, strict=True)))


def _solve_aligned(
    kept: Filtered, chains: Chains | None, aligned: Aligned, config: BackendConfig, initial: GraphSolution | None
) -> SolvedWithScales:
    """Solve an aligned component, with all its keyframes or by its chains."""
    begun = posed_by_chains(kept.trajectories, kept.taking_part, chains, aligned, config, initial, kept.held)

    def anew(scales: Mapping[LogId, float]) -> Posed:
        """The component, begun with the ways of logs made longer or shorter."""
        longer = {log: stretched(trajectory, scales.get(log, 1.0)) for log, trajectory in kept.trajectories.items()}
        again = initial_poses(longer, kept.left, config.steepness, None)._replace(lengths_m=aligned.lengths_m)
        return posed_by_chains(kept.trajectories, kept.taking_part, chains, again, config, None, kept.held)

    return solve_with_scales(begun, initial, anew)


def _solve_all(kept: Filtered, chains: Chains, found: SolvedWithScales, config: BackendConfig) -> SolvedWithScales:
    """Go on from where the chains' solution has all keyframes, with all of odometry and the same closures."""
    problem, state = found.posed.problem, found.solved.state
    scales = problem.scales_applied(state)
    T = chains.lengthened(problem.by_log(state.poses()), scales)
    aligned = Aligned(T, False, lengths_at(kept.taking_part, T))
    whole = posed(kept.trajectories, kept.taking_part, aligned, config, None, None, kept.held)
    whole = whole.with_scaled(scales)
    start = replace(whole.start, scale=state.scale)
    whole = replace(whole, start=start, trusted=found.posed.trusted)
    solved = continued(whole.objective, start)
    if not found.estimates.is_metric:
        solved = replace(solved, state=with_mean_of_one(whole, solved.state))
    return replace(found, posed=whole, solved=solved)
