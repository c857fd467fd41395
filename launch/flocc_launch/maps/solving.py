"""The solution of a map: all logs in one frame, with covariances and the closures that it used."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.alignment import evenly
from flocc_agent.config import BackendConfig
from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.pose_graph import (
    ClosureResult,
    ClosureState,
    Component,
    GraphSolution,
    OptimisationFailed,
    PoseGraph,
    map_frame,
)
from flocc_agent.core.saved_map import SavedClosure, SavedMap
from flocc_agent.geometry import nearest_rotation, upper_triangle
from flocc_agent.runtime.map_folder import UPPER
from flocc_launch.maps.gathering import Logs, opened_record
from flocc_protocol.errors import DecodeError, FloccError
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Solved = tuple[GraphSolution, Component]
"""A solution, and its component that becomes the map."""

CONTRADICTING_MIN = 2
"""Logs that contradict a keyframe that is named."""
COVARIANCES_MAX = 2000
"""Keyframes whose covariance is computed; of more, so many evenly spread ones."""


class NotSolved(FloccError):
    """Logs that give no map."""


@dataclass(frozen=True, slots=True, eq=False)
class SolvedMap:
    """All logs of a map in one frame.

    Attributes:
        saved: Poses and used closures; its closed logs are all that belong to the map.
        covariances: (N, 21) upper triangles by log, NaN where there is none.
        left_out: Logs that are not part of it, with the reason.
        warnings: What the solver said.
        contradicted: Keyframe -> the logs that contradict it, as text, where several do.
    """

    saved: SavedMap
    covariances: Mapping[LogId, NDArray[np.float32]]
    left_out: Mapping[LogId, str]
    warnings: Sequence[str] = ()
    contradicted: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def solved_map(
    where: str, logs: Logs, saved: SavedMap | None = None, frame: str | None = None, config: BackendConfig | None = None
) -> SolvedMap:
    """Solve the pose graph of logs, and keep the part with the most keyframes, or the one of a frame.

    A mission in a map that may move has all of the map's measurements beside its own: they are solved anew together, as
    if all robots had been there at one time, and laid onto the poses that the map had.

    Args:
        where: Whose logs they are, for sentences.
        logs: Records of each log, as stores keep them.
        saved: The map in which the mission took place: its frame is the frame, its logs are among the logs.
        frame: Name of the frame to keep; None: the largest, or the saved map's.
        config: The back end; None: as agents have it.

    Raises:
        NotSolved: There is no keyframe, no such frame, or the solver fails.
    """
    from flocc_agent.backend.optimiser import optimise

    assembly, described = _assembled(where, logs, saved)
    graph = assembly.graph()
    if not graph.trajectories:
        raise NotSolved(f"{where}: its logs hold no keyframe")
    wanted = [KeyframeId(log, k) for log, t in graph.trajectories.items() for k in range(len(t))]
    chosen = [wanted[k] for k in evenly(np.arange(len(wanted)), COVARIANCES_MAX)]
    solution = optimise(graph, config or BackendConfig(), None, chosen)
    if isinstance(solution, OptimisationFailed):
        raise NotSolved(f"{where}: its pose graph cannot be solved: {solution.reason}")
    component = _chosen(where, solution.components, frame, saved)
    if saved is not None and not saved.is_fixed:
        solution, component = _solved_anew(graph, saved, config, chosen, (solution, component))
    own = {log for log in logs if log in component.logs or not _has_poses(log, described)}
    used = {
        (r.query, r.match): SavedClosure(r.scale, r.weight)
        for r in solution.closures
        if r.state is ClosureState.USED and r.query.log in own and r.match.log in own
    }
    poses = {log: np.asarray(component.T_map_keyframe[log]) for log in component.logs}
    return SolvedMap(
        SavedMap(component.logs, frozenset(own), poses, used),
        {log: _triangles(log, len(poses[log]), component) for log in component.logs},
        {log: f"is in a map of its own, {_frame_of(log, solution.components)}" for log in logs if log not in own},
        solution.warnings,
        contradicted(solution.closures, own),
    )


def contradicted(closures: Iterable[ClosureResult], own: Set[LogId]) -> dict[str, tuple[str, ...]]:
    """Keyframes of these logs that several others contradict, more than agree with them, and which.

    A log contradicts a keyframe where a closure between them was rejected as an outlier, and none was used: what it
    shows has changed, or looks like another place.
    """
    logs: dict[ClosureState, dict[KeyframeId, set[LogId]]] = {state: defaultdict(set) for state in ClosureState}
    for closure in closures:
        query, match = closure.query, closure.match
        if query.log != match.log and {query.log, match.log} <= own:
            logs[closure.state][query].add(match.log)
            logs[closure.state][match].add(query.log)
    found = {}
    for keyframe, against in sorted(logs[ClosureState.REJECTED].items()):
        agree = logs[ClosureState.USED].get(keyframe, set())
        if len(against - agree) >= max(CONTRADICTING_MIN, len(agree) + 1):
            found[str(keyframe)] = tuple(map(str, sorted(against - agree)))
    return found


def _solved_anew(
    graph: PoseGraph, saved: SavedMap, config: BackendConfig | None, wanted: list[KeyframeId], in_map: Solved
) -> Solved:
    """The solution of all measurements at once, in the map's frame; that in the map where this one joins less."""
    from flocc_agent.backend.mapped import weighed
    from flocc_agent.backend.optimiser import optimise

    closures = tuple(weighed(closure, saved) for closure in graph.closures)
    solution = optimise(replace(graph, closures=closures, saved=None), config or BackendConfig(), None, wanted)
    if isinstance(solution, OptimisationFailed):
        return in_map
    joined = {*saved.logs, *in_map[1].logs}
    found = next((c for c in solution.components if joined <= set(c.logs)), None)
    if found is None:
        return in_map
    T_map_solved = laid_onto(found.T_map_keyframe, saved.T_map_camera)
    T = {log: np.asarray(T_map_solved @ poses) for log, poses in found.T_map_keyframe.items()}
    logs = (*saved.logs, *(log for log in found.logs if log not in saved.logs))
    return solution, replace(found, logs=logs, T_map_keyframe=T)


def laid_onto(poses: Mapping[LogId, Float], onto: Mapping[LogId, Float]) -> Float:
    """The pose (4, 4) of one solution in the frame of another, by all camera poses that both have."""
    pairs = [(poses[log][: len(T)], T[: len(poses[log])]) for log, T in onto.items() if log in poses]
    ours, theirs = (np.concatenate(each) for each in zip(*pairs, strict=True))
    found = np.eye(4)
    found[:3, :3] = nearest_rotation(np.einsum("nij,nkj->ik", theirs[:, :3, :3], ours[:, :3, :3]))
    found[:3, 3] = (theirs[:, :3, 3] - ours[:, :3, 3] @ found[:3, :3].T).mean(axis=0)
    return found


def _assembled(where: str, logs: Logs, saved: SavedMap | None) -> tuple[GraphAssembly, set[LogId]]:
    assembly = GraphAssembly(saved)
    for log in sorted(logs):
        for number, data in enumerate(logs[log]):
            try:
                assembly.add(NewRecord(log, number, opened_record(data)[0]))
            except DecodeError as error:
                raise NotSolved(f"{where}: record {number} of log {log} cannot be read: {error}") from error
    return assembly, set(assembly.graph().trajectories)


def _has_poses(log: LogId, described: set[LogId]) -> bool:
    return log in described


def _chosen(where: str, components: Sequence[Component], frame: str | None, saved: SavedMap | None) -> Component:
    """The part that becomes the map."""
    if frame is None and saved is not None:
        frame = map_frame(saved.anchor)
    if frame is None:
        return max(components, key=lambda c: sum(map(len, c.T_map_keyframe.values())))
    found = next((component for component in components if component.map_frame == frame), None)
    if found is None:
        known = ", ".join(component.map_frame for component in components)
        raise NotSolved(f"{where}: has no map {frame}; there are {known}")
    return found


def _frame_of(log: LogId, components: Sequence[Component]) -> str:
    return next((component.map_frame for component in components if log in component.logs), "without poses")


def _triangles(log: LogId, count: int, component: Component) -> NDArray[np.float32]:
    rows = np.full((count, UPPER), np.nan, dtype=np.float32)
    for k in range(count):
        S = component.covariance_keyframe.get(KeyframeId(log, k))
        if S is not None:
            rows[k] = upper_triangle(S).numpy()
    return rows
