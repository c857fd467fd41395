"""Parts of a whole pose graph, one for each robot, as `flocc_agent.backend.consensus` solves them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.consensus import (
    ConsensusPart,
    PartBeginning,
    information_by_keyframe,
    part_of,
)
from flocc_agent.backend.consensus_pair import paired
from flocc_agent.backend.edges import state_of, taken
from flocc_agent.backend.problem import initial_scale
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import PoseGraph
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

ALONE_STEPS_MAX = 20
ALONE_TOLERANCE_RATIO = 1e-6


def shared_poses(graph: PoseGraph, log: LogId) -> dict[LogId, list[KeyframeId]]:
    """Keyframes that a robot shares, by the other robot: those of the higher robot at their closures, sorted."""
    found: dict[LogId, set[KeyframeId]] = {}
    for closure in graph.closures:
        low, high = sorted((closure.query, closure.match))
        if low.log != high.log and log in (low.log, high.log):
            found.setdefault(low.log if log == high.log else high.log, set()).add(high)
    return {other: sorted(keyframes) for other, keyframes in sorted(found.items())}


def part_of_graph(graph: PoseGraph, log: LogId, config: BackendConfig, T: Float) -> ConsensusPart:
    """Begin a robot's part of a graph.

    Args:
        graph: Odometry and closures; only the robot's own odometry and closures of its own are read.
        log: The robot.
        config: Formulation and noise model.
        T: (N, 4, 4) where its keyframes begin, in the common frame.
    """
    owned = [c for c in graph.closures if min(c.query.log, c.match.log) == log]
    scale = np.array([initial_scale(c, config) for c in owned])
    between = [c for c in graph.closures if c.query.log != c.match.log]
    informations = information_by_keyframe(between, np.array([initial_scale(c, config) for c in between]), config)
    neighbours = {
        other: paired(log < other, keyframes, np.array([informations[k] for k in keyframes]))
        for other, keyframes in shared_poses(graph, log).items()
    }
    begins = PartBeginning(T, {}, scale, np.ones(len(owned)))
    return part_of(log, config, graph.trajectories[log], owned, begins, neighbours)


def solved_alone(part: ConsensusPart) -> Float:
    """Poses (N, 4, 4) of a robot by its odometry and the closures within it; nothing else is known yet."""
    own = np.flatnonzero((part.edges.i < part.own) & (part.edges.j < part.own))
    alone = replace(
        part,
        edges=taken(part.edges, own),
        neighbours={},
        state=state_of(part.T, len(part.state.scale)),
        weights=np.ones(len(own)),
    )
    cost = np.inf
    for number in range(ALONE_STEPS_MAX):
        alone.step(number + 1)
        before, cost = cost, alone.merit()
        if before - cost <= ALONE_TOLERANCE_RATIO * cost:
            break
    return alone.T
