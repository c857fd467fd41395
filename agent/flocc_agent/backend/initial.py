"""Where a component's poses start: at the last solution, or at the robust alignment of the odom frames."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.alignment import ROTATION_TOLERANCE_RAD, TRANSLATION_TOLERANCE_M, align
from flocc_agent.backend.screening import first_not_rigid
from flocc_agent.core.pose_graph import AbsoluteFix, ClosureState, Component, GraphSolution, LoopClosure, Trajectory
from flocc_agent.geometry import Float, angle_rad, inverse, pose, umeyama
from flocc_protocol.ids import LogId

JUDGES_MIN = 2


def initial_poses(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    steepness: float,
    earlier: GraphSolution | None,
) -> tuple[dict[LogId, Float], bool]:
    """Poses (N, 4, 4) of every log in one frame, and whether they are those of the earlier solution.

    They come from the earlier solution where it has all logs in one component and most closures of every pair of robots
    still agree with it. Otherwise the robots are placed anew: a first closure that was wrong must not outlive the right
    ones that follow it.
    """
    T_map_odom, aligned = align(trajectories, closures, steepness)
    component = component_with(trajectories, earlier)
    if component is not None:
        warm = {log: extended(component.T_map_keyframe[log], trajectories[log]) for log in trajectories}
        judges = [pair for pair in aligned.values() if len(pair.agreeing) >= JUDGES_MIN]
        if all(upheld(warm, [closures[k] for k in pair.agreeing]) for pair in judges):
            return warm, True
    return {log: T_map_odom[log] @ trajectory.T_odom_keyframe for log, trajectory in trajectories.items()}, False


def upheld(T_map_keyframe: Mapping[LogId, Float], closures: Sequence[LoopClosure]) -> bool:
    """Whether most of these closures agree with the poses, in rotation and in the direction of their translation."""
    return 2 * sum(_agrees(T_map_keyframe, closure) for closure in closures) > len(closures)


def _agrees(T_map_keyframe: Mapping[LogId, Float], closure: LoopClosure) -> bool:
    T_map_query = T_map_keyframe[closure.query.log][closure.query.index]
    T_map_match = T_map_keyframe[closure.match.log][closure.match.index]
    T = inverse(T_map_query) @ T_map_match
    measured = np.asarray(closure.T_query_match_unscaled, dtype=float)
    u = measured[:3, 3] / max(float(np.linalg.norm(measured[:3, 3])), 1e-12)
    aside_m = float(np.linalg.norm(T[:3, 3] - max(float(T[:3, 3] @ u), 0.0) * u))
    turned_rad = angle_rad(measured[:3, :3].T @ T[:3, :3])
    return turned_rad < ROTATION_TOLERANCE_RAD and aside_m < TRANSLATION_TOLERANCE_M


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


def initial_world(T_map_keyframe: Mapping[LogId, Float], fixes: Sequence[AbsoluteFix]) -> Float:
    """Pose (4, 4) of the fixes' world frame: from the first whole pose, else from all positions together."""
    for fix in fixes:
        if fix.R_world_keyframe is not None:
            T_world_keyframe = pose(fix.R_world_keyframe, fix.position_m)
            return np.asarray(T_map_keyframe[fix.keyframe.log][fix.keyframe.index] @ inverse(T_world_keyframe))
    if not fixes:
        return np.eye(4)
    in_map = np.array([T_map_keyframe[fix.keyframe.log][fix.keyframe.index][:3, 3] for fix in fixes])
    return umeyama(np.array([fix.position_m for fix in fixes]), in_map)[1]


def trusted_closures(closures: Sequence[LoopClosure], earlier: GraphSolution) -> NDArray[np.bool_]:
    """Which closures (L,) the earlier solution did not reject: those that it used, and those that it has not seen."""
    rejected = {(c.query, c.match) for c in earlier.closures if c.state is ClosureState.REJECTED}
    return np.array([(c.query, c.match) not in rejected for c in closures], dtype=bool)
