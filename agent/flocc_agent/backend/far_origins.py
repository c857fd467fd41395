"""Odometry whose origin is far away, as UTM coordinates are: it is solved near its own beginning, and put back.

A rotation by a milliradian moves a frame's origin that is 5,000 km away by 5 km, so that rounding, damping and whatever
is told apart by metres depend on where an origin lies. What is solved should not: moving an odometry frame changes
nothing but the numbers.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from flocc_agent.core.pose_graph import Component, GraphSolution, PoseGraph
from flocc_agent.geometry import Float, adjoint, inverse, pose
from flocc_protocol.ids import LogId

FAR_M = 1e4
"""Nearer ones stay as they are: a drawn graph was joined alike up to 100 km, and not from 500 km on."""


@dataclass(frozen=True, slots=True, eq=False)
class Origins:
    """`T_near_odom` (4, 4) of the logs whose odometry begins far from its origin."""

    moved: Mapping[LogId, Float]

    def near(self, graph: PoseGraph) -> PoseGraph:
        """The graph with these logs' odometry near its origin."""
        trajectories = {
            log: replace(each, T_odom_keyframe=self.moved[log] @ each.T_odom_keyframe) if log in self.moved else each
            for log, each in graph.trajectories.items()
        }
        return replace(graph, trajectories=trajectories)

    def near_solution(self, solution: GraphSolution) -> GraphSolution:
        """An earlier solution, of the graph near its origins."""
        return self._moved(solution, self.moved)

    def far_solution(self, solution: GraphSolution) -> GraphSolution:
        """A solution, of the graph as it was given."""
        return self._moved(solution, {log: inverse(T) for log, T in self.moved.items()})

    def _moved(self, solution: GraphSolution, moves: Mapping[LogId, Float]) -> GraphSolution:
        components = tuple(_component_moved(component, moves) for component in solution.components)
        return replace(solution, components=components)


def far_origins(graph: PoseGraph) -> Origins:
    """Logs that begin farther from their origin than `FAR_M`."""
    moved = {}
    for log, trajectory in graph.trajectories.items():
        T = np.asarray(trajectory.T_odom_keyframe, dtype=float)
        if T.ndim == 3 and len(T) and np.isfinite(T[0]).all() and np.linalg.norm(T[0, :3, 3]) > FAR_M:
            moved[log] = pose(np.eye(3), -T[0, :3, 3])
    return Origins(moved)


def _component_moved(component: Component, moves: Mapping[LogId, Float]) -> Component:
    """Move the map with its anchor's odometry frame, and each odometry frame against its keyframes.

    A covariance is in the tangent space of `T_map_odom`, whose right side moves.
    """
    T_map = moves.get(component.anchor, np.eye(4))
    back = {log: inverse(moves[log]) if log in moves else np.eye(4) for log in component.logs}
    covariances: dict[LogId, Float | None] = {}
    for log, covariance in component.covariance_map_odom.items():
        J = adjoint(inverse(back[log])) if log in moves else None
        covariances[log] = covariance if covariance is None or J is None else J @ covariance @ J.T
    return replace(
        component,
        T_map_keyframe={log: T_map @ T for log, T in component.T_map_keyframe.items()},
        T_map_odom={log: T_map @ T @ back[log] for log, T in component.T_map_odom.items()},
        covariance_map_odom=covariances,
    )
