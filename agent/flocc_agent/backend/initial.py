"""Where a component's poses start: at the last solution, or at the robust alignment of the odom frames."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.alignment import ROTATION_TOLERANCE_RAD, TRANSLATION_TOLERANCE_M, align
from flocc_agent.backend.bent_odometry import bent_along_fixes
from flocc_agent.backend.screening import first_not_rigid
from flocc_agent.core.pose_graph import ClosureState, Component, GraphSolution, LoopClosure, Trajectory
from flocc_agent.geometry import Float, inverse
from flocc_protocol.ids import LogId

JUDGES_MIN = 2


class Aligned(NamedTuple):
    """Where a component starts.

    Attributes:
        T_map_keyframe: (N, 4, 4) of every log, in one frame.
        is_warm: These are the poses of an earlier solution.
        lengths_m: How long closures without a unit are taken to be, by number, as far as something tells.
    """

    T_map_keyframe: dict[LogId, Float]
    is_warm: bool
    lengths_m: Mapping[int, float] = MappingProxyType({})


def lengths_at(closures: Mapping[int, LoopClosure], T_map_keyframe: Mapping[LogId, Float]) -> dict[int, float]:
    """How far apart the keyframes of closures are, m."""
    ends = {
        k: (T_map_keyframe[c.query.log][c.query.index], T_map_keyframe[c.match.log][c.match.index])
        for k, c in closures.items()
    }
    return {k: float(np.linalg.norm(T_query[:3, 3] - T_match[:3, 3])) for k, (T_query, T_match) in ends.items()}


def initial_poses(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    steepness: float,
    earlier: GraphSolution | None,
) -> Aligned:
    """Poses of every log in one frame.

    They come from the earlier solution where it has all logs in one component and most closures of every pair of robots
    still agree with it. Otherwise the robots are placed anew: a first closure that was wrong must not outlive the right
    ones that follow it.
    """
    component = component_with(trajectories, earlier)
    warm: dict[LogId, Float] = {}
    if component is not None:
        warm = {log: extended(component.T_map_keyframe[log], trajectories[log]) for log in trajectories}
        if all(upheld(warm, of_pair) for of_pair in by_pair(closures)):
            return Aligned(warm, True)
    T_map_odom, aligned = align(trajectories, closures, steepness)
    judges = [pair for pair in aligned.values() if len(pair.agreeing) >= JUDGES_MIN]
    if warm and all(upheld(warm, [closures[k] for k in pair.agreeing]) for pair in judges):
        return Aligned(warm, True)
    rigid = {log: T_map_odom[log] @ trajectory.T_odom_keyframe for log, trajectory in trajectories.items()}
    return Aligned(bent_along_fixes(rigid, closures), False)


def by_pair(closures: Mapping[int, LoopClosure]) -> list[list[LoopClosure]]:
    """Closures between robots, by pair of robots: where most of all agree with poses, no others can be more."""
    pairs: dict[frozenset[LogId], list[LoopClosure]] = {}
    for closure in closures.values():
        pairs.setdefault(frozenset((closure.query.log, closure.match.log)), []).append(closure)
    return [of_pair for logs, of_pair in pairs.items() if len(logs) > 1]


def upheld(T_map_keyframe: Mapping[LogId, Float], closures: Sequence[LoopClosure]) -> bool:
    """Whether most of these closures agree with the poses, in rotation and in the direction of their translation."""
    T_query = np.array([T_map_keyframe[c.query.log][c.query.index] for c in closures])
    T_match = np.array([T_map_keyframe[c.match.log][c.match.index] for c in closures])
    measured = np.array([c.T_query_match_unscaled for c in closures], dtype=float)
    return 2 * int(np.count_nonzero(_agree(inverse(T_query) @ T_match, measured))) > len(closures)


def _agree(T: Float, measured: Float) -> NDArray[np.bool_]:
    """Whether relative poses (K, 4, 4) turn as measured and lie on the measured rays."""
    t, u = T[:, :3, 3], measured[:, :3, 3]
    u = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)
    along = np.maximum(np.einsum("ki,ki->k", t, u), 0.0)
    aside_m = np.linalg.norm(t - along[:, None] * u, axis=1)
    cosine = 0.5 * (np.einsum("kij,kij->k", measured[:, :3, :3], T[:, :3, :3]) - 1.0)
    turned_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.asarray((turned_rad < ROTATION_TOLERANCE_RAD) & (aside_m < TRANSLATION_TOLERANCE_M))


def component_with(logs: Mapping[LogId, Trajectory], earlier: GraphSolution | None) -> Component | None:
    """The earlier component that holds all these logs with finite poses, or None."""
    for component in earlier.components if earlier is not None else ():
        if set(logs) <= set(component.logs):
            usable = all(_is_usable(component.T_map_keyframe[log]) for log in logs)
            return component if usable else None
    return None


def _is_usable(T: Float) -> bool:
    return len(T) > 0 and first_not_rigid(np.asarray(T)) is None


def extended(T_map_keyframe: Float, trajectory: Trajectory) -> Float:
    """Poses (N, 4, 4) of a log: earlier ones as they were, later ones by odometry from the last of them."""
    known = min(len(T_map_keyframe), len(trajectory))
    T_odom = np.asarray(trajectory.T_odom_keyframe, dtype=float)
    T_map_odom = T_map_keyframe[known - 1] @ inverse(T_odom[known - 1])
    return np.concatenate([T_map_keyframe[:known], T_map_odom @ T_odom[known:]])


def trusted_closures(
    closures: Sequence[LoopClosure], is_held: NDArray[np.bool_], earlier: GraphSolution
) -> NDArray[np.bool_]:
    """Which closures (L,) the earlier solution used, or has not seen; of those that are held only used ones."""
    states = {(c.query, c.match): c.state for c in earlier.closures}
    before = [states.get((c.query, c.match)) for c in closures]
    used, rejected = (np.array([s is state for s in before]) for state in (ClosureState.USED, ClosureState.REJECTED))
    return np.asarray(np.where(is_held, used, ~rejected), dtype=bool)
