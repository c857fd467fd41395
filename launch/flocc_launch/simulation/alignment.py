"""A quick stand-in for the back end: every log as a rigid whole, hung onto its component's anchor by one closure.

Campaigns and large swarms ask who corrects whom and when, not how well; this answers in microseconds per log.
"""

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


def align(graph: PoseGraph, _initial: GraphSolution | None = None) -> GraphSolution:
    """Place every log in its component's map frame; trusts the closures it comes across first."""
    groups = components_of(list(graph.trajectories), graph.closures)
    used = [ClosureResult(c.query, c.match, ClosureState.USED, 1.0, c.scale_initial, 0.0) for c in graph.closures]
    return GraphSolution(tuple(_component(logs, graph) for logs in groups), tuple(used))


def _component(logs: tuple[LogId, ...], graph: PoseGraph) -> Component:
    T_map_odom = {logs[0]: np.eye(4)}
    bridges = {tuple(sorted((c.query.log, c.match.log))): c for c in reversed(graph.closures)}
    while len(T_map_odom) < len(logs):
        for closure in bridges.values():
            _hang(closure, graph, T_map_odom)
    return Component(
        logs=logs,
        T_map_keyframe={log: T_map_odom[log] @ graph.trajectories[log].T_odom_keyframe for log in logs},
        T_map_odom={log: T_map_odom[log] for log in logs},
        covariance_map_odom=dict.fromkeys(logs),
    )


def _hang(closure: LoopClosure, graph: PoseGraph, T_map_odom: dict[LogId, Float]) -> None:
    """Where a closure joins a placed log and one that is not, place the other one."""
    T_query_match = closure.T_query_match_unscaled.copy()
    T_query_match[:3, 3] *= closure.scale_initial or 1.0
    query, match = closure.query, closure.match
    if match.log in T_map_odom:
        query, match, T_query_match = match, query, inverse(T_query_match)
    if query.log not in T_map_odom or match.log in T_map_odom:
        return
    T_map_query = T_map_odom[query.log] @ graph.trajectories[query.log].T_odom_keyframe[query.index]
    T_odom_match = graph.trajectories[match.log].T_odom_keyframe[match.index]
    T_map_odom[match.log] = T_map_query @ T_query_match @ inverse(T_odom_match)
