"""Parts of a whole pose graph, one for each robot, as `flocc_agent.backend.consensus` solves them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.consensus import (
    ConsensusPart,
    PartBeginning,
    beginning_scale,
    information_by_keyframe,
    part_of,
)
from flocc_agent.backend.consensus_pair import paired
from flocc_agent.backend.edges import state_of, taken
from flocc_agent.backend.problem import concatenate, initial_scale
from flocc_agent.config import BackendConfig
from flocc_agent.core.own_part import OwnedClosure
from flocc_agent.core.pose_graph import LoopClosure, PoseGraph
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


def part_of_graph(
    graph: PoseGraph, log: LogId, config: BackendConfig, T: Float, chosen: Mapping[LoopClosure, OwnedClosure]
) -> ConsensusPart:
    """Begin a robot's part of a graph.

    Args:
        graph: Odometry and closures; only the robot's own odometry and closures of its own are read.
        log: The robot.
        config: Formulation and noise model.
        T: (N, 4, 4) where its keyframes begin, in the common frame.
        chosen: With which weight and length a closure was chosen; of others Eq. (6) says the length.
    """
    owned = [c for c in graph.closures if min(c.query.log, c.match.log) == log]
    scale = _scales(owned, config, chosen)
    between = [c for c in graph.closures if c.query.log != c.match.log]
    informations = information_by_keyframe(between, _scales(between, config, chosen), config)
    neighbours = {
        other: paired(log < other, keyframes, np.array([informations[k] for k in keyframes]))
        for other, keyframes in shared_poses(graph, log).items()
    }
    weights = np.array([chosen[c].weight if c in chosen else 1.0 for c in owned])
    begins = PartBeginning(T, {}, scale, weights)
    return part_of(log, config, graph.trajectories[log], owned, begins, neighbours)


def _scales(
    closures: Sequence[LoopClosure], config: BackendConfig, chosen: Mapping[LoopClosure, OwnedClosure]
) -> Float:
    """Metres per network unit (L,) at which closures begin."""
    return np.array([beginning_scale(chosen[c], config) if c in chosen else initial_scale(c, config) for c in closures])


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
    _descend(alone)
    return alone.T


def _descend(part: ConsensusPart) -> None:
    """Step a part that nobody tells anything until its cost falls no more."""
    cost = np.inf
    for number in range(ALONE_STEPS_MAX):
        part.step(number + 1)
        before, cost = cost, part.merit()
        if before - cost <= ALONE_TOLERANCE_RATIO * cost:
            break


def whole_of(parts: Mapping[LogId, ConsensusPart]) -> ConsensusPart:
    """What all robots own as one part, copies of others' poses being those themselves."""
    first = dict(zip(parts, np.cumsum([0, *(part.own for part in parts.values())]).tolist(), strict=False))
    edges, weights = [], []
    for log, part in parts.items():
        at = np.concatenate([first[log] + np.arange(part.own), np.zeros(len(part.state.q) - part.own, dtype=np.int64)])
        for other, neighbour in part.neighbours.items():
            if neighbour.lower:
                at[neighbour.index] = first[other] + np.array([k.index for k in neighbour.keyframes])
        edges.append(replace(part.edges, i=at[part.edges.i], j=at[part.edges.j]))
        weights.append(part.weights)
    some = next(iter(parts.values()))
    poses = np.concatenate([part.T for part in parts.values()])
    return replace(
        some,
        own=len(poses),
        edges=concatenate(edges),
        neighbours={},
        state=state_of(poses),
        weights=np.concatenate(weights),
    )


def least_cost(parts: Mapping[LogId, ConsensusPart]) -> float:
    """Of all that robots own, where one solver begins where they stand."""
    whole = whole_of(parts)
    _descend(whole)
    return whole.own_cost()
