"""Parts of a map that hang on the rest by nothing but a step of odometry that nobody measured.

A robot that was carried, or whose odometry began anew, is two robots as far as measurements go. Where closures, tags or
fixes tie both of its parts to the rest all is well; where they do not, the part is drawn where its odometry went on,
and nobody knows where it is. A part is named by its first keyframe.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from flocc_agent.core.measured_records import nobody_measured
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, PoseGraph, Trajectory, groups_of, is_landmark
from flocc_protocol.ids import KeyframeId, LogId

HANG = "nothing measured ties"
"""Which every such sentence has."""


def hanging_parts(graph: PoseGraph, solution: GraphSolution) -> tuple[str, ...]:
    """A sentence for each part that no used closure or measurement ties to the greater part of its component."""
    starts = {log: part_starts(trajectory) for log, trajectory in graph.trajectories.items()}
    sentences = []
    for component in solution.components:
        of_logs = {log: starts[log] for log in component.logs if log in starts}
        if any(len(firsts) > 1 for firsts in of_logs.values()):
            sentences += [_sentence(parts, graph, of_logs) for parts in _loose(graph, solution, of_logs)]
    return tuple(sentences)


def part_starts(trajectory: Trajectory) -> list[int]:
    """First keyframe of a log, and those after steps that nobody measured."""
    covariances = trajectory.edge_covariances
    if covariances is None or np.shape(covariances)[1:] != (6, 6):
        return [0]
    known = np.flatnonzero(np.isfinite(covariances).all(axis=(1, 2)))
    return [0, *(known[nobody_measured(covariances[known])] + 1).tolist()]


def _loose(graph: PoseGraph, solution: GraphSolution, starts: Mapping[LogId, Sequence[int]]) -> list[list[KeyframeId]]:
    """Parts of a component by what holds them together, without the group that has most keyframes."""

    def part_of(keyframe: KeyframeId) -> KeyframeId:
        firsts = starts[keyframe.log]
        return KeyframeId(keyframe.log, firsts[int(np.searchsorted(firsts, keyframe.index, side="right")) - 1])

    parts = [KeyframeId(log, first) for log, firsts in starts.items() for first in firsts]
    ties = [
        (part_of(result.query), part_of(result.match))
        for result in solution.closures
        if result.state is ClosureState.USED and result.query.log in starts and result.match.log in starts
    ]
    groups = groups_of(parts, ties)
    sizes = [sum(_end(part, graph, starts) - part.index for part in group) for group in groups]
    greatest = int(np.argmax(sizes))
    loose = [[p for p in group if not is_landmark(p.log)] for k, group in enumerate(groups) if k != greatest]
    return [group for group in loose if group]


def _end(part: KeyframeId, graph: PoseGraph, starts: Mapping[LogId, Sequence[int]]) -> int:
    """The keyframe after a part's last."""
    return next((first for first in starts[part.log] if first > part.index), len(graph.trajectories[part.log]))


def _sentence(parts: Sequence[KeyframeId], graph: PoseGraph, starts: Mapping[LogId, Sequence[int]]) -> str:
    named = [f"keyframes {part} to {KeyframeId(part.log, _end(part, graph, starts) - 1)}" for part in parts]
    what = "this part" if len(parts) == 1 else "these parts"
    return f"{' and '.join(named)}: {HANG} {what} to the rest, only odometry that paused or jumped"
