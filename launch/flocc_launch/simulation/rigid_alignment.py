"""A quick stand-in for the back end: every log as a rigid whole, hung onto its component's anchor by one closure.

Campaigns and large swarms ask who corrects whom and when, not how well; this answers in microseconds per log.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import (
    ClosureResult,
    ClosureState,
    Component,
    GraphSolution,
    LoopClosure,
    PoseGraph,
    components_of,
)
from flocc_agent.geometry import inverse
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

COVARIANCE = np.diag([1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2])
"""What it says of every log, since it does not estimate any: 0.6 degrees, 0.1 m."""


def align(graph: PoseGraph, _initial: GraphSolution | None = None) -> GraphSolution:
    """Place every log in its component's map frame; trusts the closures it comes across first."""
    bridges: dict[tuple[LogId, LogId], LoopClosure] = {}
    for closure in reversed(graph.closures):
        one, other = closure.query.log, closure.match.log
        bridges[(one, other) if one < other else (other, one)] = closure
    groups = components_of(list(graph.trajectories), list(bridges.values()))
    components = tuple(_component(logs, graph, bridges) for logs in groups)
    return GraphSolution(components, tuple(_used(closure) for closure in graph.closures))


def _used(closure: LoopClosure) -> ClosureResult:
    return ClosureResult(closure.query, closure.match, ClosureState.USED, 1.0, closure.scale_initial, 0.0)


def _component(
    logs: tuple[LogId, ...], graph: PoseGraph, bridges: Mapping[tuple[LogId, LogId], LoopClosure]
) -> Component:
    T_map_odom = {logs[0]: np.eye(4)}
    inside = set(logs)
    ours = [closure for closure in bridges.values() if closure.query.log in inside]
    while len(T_map_odom) < len(logs):
        for closure in ours:
            _hang(closure, graph, T_map_odom)
    return Component(
        logs=logs,
        T_map_keyframe={log: T_map_odom[log] @ graph.trajectories[log].T_odom_keyframe for log in logs},
        T_map_odom={log: T_map_odom[log] for log in logs},
        covariance_map_odom=dict.fromkeys(logs, COVARIANCE),
    )


def _hang(closure: LoopClosure, graph: PoseGraph, T_map_odom: dict[LogId, Float]) -> None:
    """Where a closure joins a placed log and one that is not, place the other one."""
    query, match = closure.query, closure.match
    if (query.log in T_map_odom) == (match.log in T_map_odom):
        return
    T_query_match = closure.T_query_match_unscaled.copy()
    T_query_match[:3, 3] *= closure.scale_initial or 1.0
    if match.log in T_map_odom:
        query, match, T_query_match = match, query, inverse(T_query_match)
    T_map_query = T_map_odom[query.log] @ graph.trajectories[query.log].T_odom_keyframe[query.index]
    T_odom_match = graph.trajectories[match.log].T_odom_keyframe[match.index]
    T_map_odom[match.log] = T_map_query @ T_query_match @ inverse(T_odom_match)
