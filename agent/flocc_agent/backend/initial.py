"""Where a component's poses start: at the last solution, or at the robust alignment of the odom frames."""

from collections.abc import Mapping, Sequence

import numpy as np

from flocc_agent.backend.alignment import align
from flocc_agent.backend.screening import first_not_rigid
from flocc_agent.core.pose_graph import AbsoluteFix, Component, GraphSolution, LoopClosure, Trajectory
from flocc_agent.geometry import Float, inverse, pose, umeyama
from flocc_protocol.ids import LogId


def initial_poses(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    steepness: float,
    earlier: GraphSolution | None,
) -> dict[LogId, Float]:
    """Poses (N, 4, 4) of every log in one frame, from the earlier solution where it has all logs in one component."""
    component = component_with(trajectories, earlier)
    if component is not None:
        return {log: extended(component.T_map_keyframe[log], trajectories[log]) for log in trajectories}
    T_map_odom, _ = align(trajectories, closures, steepness)
    return {log: T_map_odom[log] @ trajectory.T_odom_keyframe for log, trajectory in trajectories.items()}


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
