"""Measured factors as closures, so that all the back end does with closures it does with them.

A landmark (a tag, the world of fixes) becomes a log of one keyframe, and each factor a metric closure: screened,
aligned, weighed by GNC and named when it is rejected. `with_factors` goes before the optimiser, `without_factors`
after it; what lies between knows of none of this.

Where only positions were measured, the closure's rotation is completed from all positions between the same two logs
(Umeyama 1991, on the greatest set that agrees), and given a spread so wide that it decides nothing. Positions on one
line or point do not fix the rotation: such fixes keep a world of their own log, and robots that have seen each other
so are named, not joined.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.alignment import evenly
from flocc_agent.backend.joining import too_few
from flocc_agent.backend.misread import misread
from flocc_agent.backend.problem import diagonal_covariance
from flocc_agent.backend.screening import first_not_rigid, is_covariance
from flocc_agent.config import BackendConfig
from flocc_agent.core.geodesy import Place, T_enu_enu
from flocc_agent.core.measurements import PoseFix
from flocc_agent.core.pose_graph import (
    EARTH,
    LANDMARK,
    WORLD,
    ClosureState,
    Component,
    FactorResult,
    GraphSolution,
    LoopClosure,
    MeasuredFactor,
    PoseGraph,
    Trajectory,
    is_landmark,
    landmark,
)
from flocc_agent.geometry import inverse, pose, umeyama
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]

CERTAIN_RATIO = 1e6
"""Match ratio of what was measured: Eq. (2) gives it the probability 1."""
JOINS = 1000
"""Support of what fixes all six degrees of freedom: one joins maps."""
NOTHING_CONFIRMS = "and nothing else confirms it yet: if it is wrong, so is the whole map"
ROTATION_OPEN_SIGMA_RAD = 10.0
POSITIONS_MIN = 3
SPREAD_SIGMAS = 3.0
"""Positions fix a rotation when they spread this many of their standard deviations in two directions."""
AGREEING_M = 1.5
AGREEING_SIGMAS = 4.0
TRIED_MAX = 12
"""Positions of which all triples are tried as hypotheses."""


@dataclass(frozen=True, slots=True)
class Expanded:
    """A graph whose factors are closures.

    Attributes:
        graph: It.
        initial: The earlier solution with its landmarks as logs.
        places: Of each closure beyond the graph's own, its factor's place in `PoseGraph.measured`.
        left_out: Reason for each factor that is no closure.
        notes: Sentences for people.
        joins_min: How many closures join two maps.
    """

    graph: PoseGraph
    initial: GraphSolution | None
    places: tuple[int, ...] = ()
    left_out: Mapping[int, str] = ()  # type: ignore[assignment]
    notes: tuple[str, ...] = ()
    joins_min: int = 1


def with_factors(graph: PoseGraph, config: BackendConfig, initial: GraphSolution | None) -> Expanded:
    """Turn landmarks into logs and factors into closures; a graph without any is left as it is."""
    trajectories = {log: measured_odometry(t, config) for log, t in graph.trajectories.items()}
    if not graph.measured:
        return Expanded(replace(graph, trajectories=trajectories), initial)
    origin = origin_of(graph.measured)
    left_out = {k: text for k, f in enumerate(graph.measured) if (text := _complaint(f, trajectories))}
    factors = {k: _from_origin(f, origin) for k, f in enumerate(graph.measured) if k not in left_out}
    closures = {k: _whole(f) for k, f in factors.items() if f.has_rotation}
    positions: dict[tuple[LogId, LogId], list[int]] = defaultdict(list)
    for k, factor in factors.items():
        if not factor.has_rotation:
            low, high = sorted((factor.query.log, factor.match.log))
            positions[low, high].append(k)
    notes = []
    for (low, high), ids in sorted(positions.items()):
        of_pair = {k: factors[k] for k in ids}
        completed, note = _completed(low, high, of_pair, trajectories, initial)
        closures |= completed
        left_out |= {k: note for k in ids if k not in completed}
        notes += [note] if note else []
    places = tuple(sorted(closures))
    landmarks = {end.log for k in places for end in (closures[k].query, closures[k].match) if is_landmark(end.log)}
    trajectories |= {log: Trajectory(np.eye(4)[None]) for log in landmarks}
    expanded = replace(
        graph, trajectories=trajectories, closures=(*graph.closures, *(closures[k] for k in places)), measured=()
    )
    started = None if initial is None else _with_landmarks(initial, [closures[k] for k in places])
    return Expanded(expanded, started, places, left_out, tuple(notes), config.closures_to_join_min)


def without_factors(solution: GraphSolution, graph: PoseGraph, expanded: Expanded) -> GraphSolution:
    """Take landmarks out of the components, and give each factor its own result."""
    if not graph.measured:
        return solution
    own = len(graph.closures)
    results = {
        k: FactorResult(graph.measured[k], closure.state, closure.weight, closure.residual, _plain(closure.reason))
        for k, closure in zip(expanded.places, solution.closures[own:], strict=True)
    }
    for k, reason in expanded.left_out.items():
        results[k] = FactorResult(graph.measured[k], ClosureState.EXCLUDED, 0.0, 0.0, reason)
    measured = tuple(results[k] for k in range(len(graph.measured)))
    of_many = misread(measured, solution.components)
    return replace(
        solution,
        components=tuple(
            _of_robots(component, graph.measured)
            for component in solution.components
            if not all(is_landmark(log) for log in component.logs)
        ),
        closures=solution.closures[:own],
        warnings=(
            *(warning for warning in solution.warnings if LANDMARK not in warning),
            *expanded.notes,
            *_unconfirmed(solution, graph, expanded),
            *dict.fromkeys(of_many.values()),
            *(
                f"{r.factor} is not used: {r.reason}"
                for k, r in enumerate(measured)
                if r.reason and k not in of_many and r.reason not in expanded.notes
            ),
        ),
        measured=measured,
    )


def origin_of(factors: Sequence[MeasuredFactor]) -> Place | None:
    """The first geodetic fix of the lowest log: the origin of east, north and up."""
    fixes = [(factor.at, factor.place) for factor in factors if factor.place is not None]
    return min(fixes, default=(None, None), key=lambda fix: fix[0])[1]


def measured_odometry(trajectory: Trajectory, config: BackendConfig) -> Trajectory:
    """The configured covariance where an edge has none of its own."""
    covariances = trajectory.edge_covariances
    if covariances is None or np.ndim(covariances) != 3:
        return trajectory
    open_ = np.asarray(np.isnan(covariances).all(axis=(1, 2)))
    if not open_.any() or covariances.shape[1:] != (6, 6):
        return trajectory
    default = diagonal_covariance(config.odometry_rotation_sigma_rad, config.odometry_translation_sigma_m)
    return replace(trajectory, edge_covariances=np.where(open_[:, None, None], default, covariances))


def _complaint(factor: MeasuredFactor, trajectories: Mapping[LogId, Trajectory]) -> str:
    """Why a factor cannot be used; empty where it can. What is wrong with whole poses is told by screening."""
    ends = [end for end in (factor.query, factor.match) if not is_landmark(end.log)]
    if not all(end.log in trajectories and end.index < len(trajectories[end.log]) for end in ends):
        return "its keyframes are not there"
    poses = [factor.T_query_match, *(_pose_of(end, trajectories) for end in ends)]
    if first_not_rigid(np.array(poses)) is not None:
        return "its pose, or the odometry there, is not a rigid pose"
    if not factor.has_rotation and not is_covariance(factor.covariance, 3):
        return "the covariance is not positive definite"
    return ""


def _from_origin(factor: MeasuredFactor, origin: Place | None) -> MeasuredFactor:
    """A geodetic fix as a position in the frame east, north, up of the origin."""
    if factor.place is None or origin is None:
        return factor
    T = T_enu_enu(origin, factor.place)
    R = T[:3, :3]
    return replace(factor, T_query_match=pose(np.eye(3), T[:3, 3]), covariance=R @ factor.covariance @ R.T)


def _unconfirmed(solution: GraphSolution, graph: PoseGraph, expanded: Expanded) -> list[str]:
    """One sentence for each sighting, pose or registration on which alone a join of maps rests: it may be wrong."""
    results = zip(expanded.graph.closures, solution.closures, strict=True)
    used = {k: closure for k, (closure, result) in enumerate(results) if result.state is ClosureState.USED}
    factors = {len(graph.closures) + n: graph.measured[k] for n, k in enumerate(expanded.places)}
    once = {k for k in used if k in factors and factors[k].has_rotation and not _is_start(factors[k])}
    counted = {k: replace(closure, support=1) if k in once else closure for k, closure in used.items()}
    alone = too_few(list(expanded.graph.trajectories), counted, expanded.joins_min)
    return [f"{factors[k]} alone joins two maps, {NOTHING_CONFIRMS}" for k in alone if k in once]


def _is_start(factor: MeasuredFactor) -> bool:
    return factor.kind == PoseFix.kind and factor.at.index == 0


def _whole(factor: MeasuredFactor) -> LoopClosure:
    return _closure(factor, factor.T_query_match, factor.covariance, JOINS)


def _closure(factor: MeasuredFactor, T: Float, covariance: Float, support: int) -> LoopClosure:
    return LoopClosure(
        factor.query, factor.match, T, CERTAIN_RATIO, covariance=covariance, metric=True, support=support
    )


# Positions without a rotation


def _completed(
    low: LogId,
    high: LogId,
    factors: Mapping[int, MeasuredFactor],
    trajectories: Mapping[LogId, Trajectory],
    initial: GraphSolution | None,
) -> tuple[dict[int, LoopClosure], str]:
    """The positions between two logs as closures, or the reason why they are none yet."""
    landmark_log = high if is_landmark(high) else None
    in_low, in_high = _points(low, factors, trajectories)
    sigmas_m = np.array([np.sqrt(np.trace(f.covariance) / 3.0) for f in factors.values()])
    T_low_high, is_fixed = aligned_points(in_high, in_low, sigmas_m)
    if is_fixed:
        return _with_rotation(low, T_low_high, factors, trajectories, JOINS), ""
    if landmark_log is not None:
        private = landmark(f"{landmark_log.robot.removeprefix(LANDMARK)}.{low}")
        own = {k: _moved_to(private, factor) for k, factor in factors.items()}
        return _with_rotation(low, T_low_high, own, trajectories, JOINS), ""
    earlier = _earlier(low, high, trajectories, initial)
    if earlier is not None:
        return _with_rotation(low, earlier, factors, trajectories, 0), ""
    times = "once" if len(factors) == 1 else f"{len(factors)} times"
    return {}, f"robots {low} and {high} have seen each other {times}, which does not fix where they are to each other"


def _points(
    low: LogId, factors: Mapping[int, MeasuredFactor], trajectories: Mapping[LogId, Trajectory]
) -> tuple[Float, Float]:
    """What was seen, (N, 3) each in the odom frames of the lower and of the higher log."""
    in_low, in_high = [], []
    for factor in factors.values():
        seen = _pose_of(factor.query, trajectories) @ factor.T_query_match
        own = _pose_of(factor.match, trajectories)
        of_query, of_match = seen[:3, 3], own[:3, 3]
        in_low.append(of_query if factor.query.log == low else of_match)
        in_high.append(of_match if factor.query.log == low else of_query)
    return np.array(in_low), np.array(in_high)


def _pose_of(keyframe: KeyframeId, trajectories: Mapping[LogId, Trajectory]) -> Float:
    if is_landmark(keyframe.log):
        return np.eye(4)
    return np.asarray(trajectories[keyframe.log].T_odom_keyframe[keyframe.index], dtype=float)


def _moved_to(private: KeyframeId, factor: MeasuredFactor) -> MeasuredFactor:
    if is_landmark(factor.query.log):
        return replace(factor, query=private)
    return replace(factor, match=private)


def _with_rotation(
    low: LogId,
    T_low_high: Float,
    factors: Mapping[int, MeasuredFactor],
    trajectories: Mapping[LogId, Trajectory],
    support: int,
) -> dict[int, LoopClosure]:
    """Closures whose rotations follow from where the two odom frames are to each other."""
    closures = {}
    for k, factor in factors.items():
        R_odoms = T_low_high[:3, :3] if factor.query.log == low else T_low_high[:3, :3].T
        R_query, R_match = (_pose_of(end, trajectories)[:3, :3] for end in (factor.query, factor.match))
        R = R_query.T @ R_odoms @ R_match
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = ROTATION_OPEN_SIGMA_RAD**2 * np.eye(3)
        covariance[3:, 3:] = R.T @ factor.covariance @ R
        closures[k] = _closure(factor, pose(R, factor.T_query_match[:3, 3]), covariance, support)
    return closures


def aligned_points(source: Float, target: Float, sigmas_m: Float) -> tuple[Float, bool]:
    """The rigid pose (4, 4) that moves most of the points (N, 3) onto others, and whether they fix its rotation."""
    tolerance_m = AGREEING_M + AGREEING_SIGMAS * sigmas_m
    best = np.ones(len(source), dtype=bool)
    if len(source) > POSITIONS_MIN:
        tried = [int(k) for k in evenly(np.arange(len(source)), TRIED_MAX)]
        agreeing = [_agreeing(source, target, list(three), tolerance_m) for three in combinations(tried, POSITIONS_MIN)]
        best = max(agreeing, key=lambda found: int(found.sum()))
    if best.sum() < POSITIONS_MIN:
        best = np.ones(len(source), dtype=bool)
    _, T = umeyama(source[best], target[best])
    return T, bool(best.sum() >= POSITIONS_MIN and _spread_m(source[best]) > SPREAD_SIGMAS * np.median(sigmas_m))


def _agreeing(source: Float, target: Float, chosen: list[int], tolerance_m: Float) -> NDArray[np.bool_]:
    _, T = umeyama(source[chosen], target[chosen])
    return np.asarray(np.linalg.norm(source @ T[:3, :3].T + T[:3, 3] - target, axis=1) < tolerance_m)


def _spread_m(points: Float) -> float:
    """Standard deviation of points across the line that they lie on best."""
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(singular[1] / np.sqrt(len(points)))


def _earlier(
    low: LogId, high: LogId, trajectories: Mapping[LogId, Trajectory], initial: GraphSolution | None
) -> Float | None:
    """Where an earlier solution has one odom frame in the other, (4, 4)."""
    for component in initial.components if initial is not None else ():
        if low in component.logs and high in component.logs and low in trajectories and high in trajectories:
            return np.asarray(inverse(component.T_map_odom[low]) @ component.T_map_odom[high])
    return None


# Landmarks


def _with_landmarks(initial: GraphSolution, closures: Sequence[LoopClosure]) -> GraphSolution:
    """An earlier solution that has the landmarks as logs: where they were, or where a closure sees them."""
    return replace(initial, components=tuple(_component_with(c, closures) for c in initial.components))


def _component_with(component: Component, closures: Sequence[LoopClosure]) -> Component:
    poses = dict(component.T_map_keyframe)
    for name, T in component.T_map_landmark.items():
        if name != EARTH:
            poses[landmark(name).log] = T[None]
    for closure in closures:
        for seen, by, T in (
            (closure.match, closure.query, closure.T_query_match_unscaled),
            (closure.query, closure.match, inverse(closure.T_query_match_unscaled)),
        ):
            if is_landmark(seen.log) and seen.log not in poses and by.index < len(poses.get(by.log, ())):
                poses[seen.log] = (poses[by.log][by.index] @ T)[None]
    return replace(component, logs=tuple(sorted(poses)), T_map_keyframe=poses)


def _of_robots(component: Component, factors: Sequence[MeasuredFactor]) -> Component:
    """A component without its landmarks' logs, and with their poses."""
    logs = tuple(log for log in component.logs if not is_landmark(log))
    found = {
        log.robot.removeprefix(LANDMARK): component.T_map_keyframe[log][0] for log in component.logs if is_landmark(log)
    }
    world = next((found[name] for name in sorted(found) if name.split(".")[0] == WORLD), component.T_map_world)
    earth = next((found[name] for name in sorted(found) if name.split(".")[0] == EARTH), None)
    if earth is not None:
        origin, first = origin_of(factors), origin_of([f for f in factors if f.at.log in logs])
        assert origin is not None
        assert first is not None
        found[EARTH] = earth @ T_enu_enu(origin, first)
    return replace(
        component,
        logs=logs,
        T_map_keyframe={log: component.T_map_keyframe[log] for log in logs},
        T_map_odom={log: component.T_map_odom[log] for log in logs},
        covariance_map_odom={log: component.covariance_map_odom[log] for log in logs},
        T_map_world=found.get(EARTH) if world is None else world,
        T_map_landmark=found,
    )


def _plain(reason: str) -> str:
    """A reason without the name of the closure that stood for a factor."""
    return reason.split(": ", 1)[1] if reason.startswith("closure ") else reason
