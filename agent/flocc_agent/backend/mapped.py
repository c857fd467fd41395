"""A pose graph with an opened map, as the optimiser takes it: the map's logs first, and as they were saved.

`with_map` goes before the optimiser, `without_map` after it; what lies between knows of no maps. Each log of the map
becomes one whose odometry are its saved poses, and each closure that its solution used the relative pose that it has
there, with the spread that the closure had: so the map lies where it was saved, bends as its covariance allows, and
no closure of it is judged again. What a team measures at keyframes that several logs contradict counts less. A map that
must not move becomes one stiff log of the few keyframes that something holds to, so that a round costs nothing for the
rest. The names of these logs sort before all others: the frame is the map's, whatever the robots that join it are
called. A map that nothing joins is not solved at all.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.initial import extended
from flocc_agent.backend.measured import CERTAIN_RATIO, JOINS
from flocc_agent.backend.problem import closure_covariances, diagonal_covariance, initial_scale, prior_sigmas
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import (
    ClosureResult,
    ClosureState,
    Component,
    FactorResult,
    GraphSolution,
    LoopClosure,
    MeasuredFactor,
    PoseGraph,
    Trajectory,
    is_landmark,
)
from flocc_agent.core.saved_map import SavedMap
from flocc_agent.geometry import inverse
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

FIRST = "!"
"""Begins the names of a map's logs: no robot's does, and it sorts before all of them."""
STIFF_ROTATION_SIGMA_RAD, STIFF_TRANSLATION_SIGMA_M = 1e-6, 1e-5
"""Between the keyframes of a map that does not move: what it gives way by is far below what any closure measures."""
TIE_ROTATION_SIGMA_RAD, TIE_TRANSLATION_SIGMA_M = 0.5, 5.0
"""Between two logs of one map: so wide that it decides nothing, and holds what only a shared tag held together."""


class SavedLog(LogId):
    """A log of the map under a name that sorts first; for people it has its own."""

    __slots__ = ()

    def __new__(cls, robot: str, incarnation: int = 0) -> "SavedLog":
        """Take any name."""
        return tuple.__new__(cls, (robot, incarnation))

    def __str__(self) -> str:
        _, _, name = self.robot.partition("/")
        return str(LogId(name, self.incarnation))


@dataclass(frozen=True, slots=True, eq=False)
class Mapped:
    """A graph for the optimiser, and the way back from it.

    Attributes:
        graph: For the optimiser; None where nothing but the map is there.
        initial: The earlier solution under the optimiser's names.
        public: The graph as it was given.
        closures: Of each public closure, its place among the optimiser's; None where it has none.
        measured: The same of the measured factors.
        names: Public logs of the map -> the optimiser's, where each has its own.
        nodes: The keyframes of the one stiff log, in its order; empty where the map may move.
        T_map_camera: Saved poses, and what a log that grew has by odometry behind them.
        is_joined: Something of a team holds to the map.
    """

    graph: PoseGraph | None
    initial: GraphSolution | None
    public: PoseGraph
    closures: tuple[int | None, ...]
    measured: tuple[int | None, ...]
    names: Mapping[LogId, LogId]
    nodes: tuple[KeyframeId, ...]
    T_map_camera: Mapping[LogId, Float]
    is_joined: bool

    def keyframe(self, keyframe: KeyframeId) -> KeyframeId:
        """A keyframe under the optimiser's name."""
        if self.nodes and keyframe.log in self.T_map_camera:
            return KeyframeId(stiff_log(self.saved), self.nodes.index(keyframe))
        return KeyframeId(self.names.get(keyframe.log, keyframe.log), keyframe.index)

    @property
    def saved(self) -> SavedMap:
        """The map."""
        assert self.public.saved is not None
        return self.public.saved


def stiff_log(saved: SavedMap) -> LogId:
    """The one log of a map that does not move."""
    return SavedLog(f"{FIRST}/{saved.anchor.robot}", saved.anchor.incarnation)


def with_map(graph: PoseGraph, saved: SavedMap, config: BackendConfig, initial: GraphSolution | None) -> Mapped:
    """Put the map's logs first, as they were saved."""
    logs = [log for log in saved.logs if log in graph.trajectories]
    T = {log: extended(np.asarray(saved.T_map_camera[log]), graph.trajectories[log]) for log in logs}
    joined = _is_joined(graph, T)
    outer = [k for k, c in enumerate(graph.closures) if not (c.query.log in T and c.match.log in T)]
    factors = [k for k, f in enumerate(graph.measured) if joined or f.at.log not in T]
    names = {log: SavedLog(f"{FIRST}{k:04d}/{log.robot}", log.incarnation) for k, log in enumerate(logs)}
    nodes = _held(graph, T, logs[0]) if joined and saved.is_fixed else ()
    mapped = Mapped(None, None, graph, (), (), names, nodes, T, joined)
    live = {log: t for log, t in graph.trajectories.items() if log not in T}
    trajectories, inner, ties = _of_map(mapped, config)
    posed = replace(
        graph,
        trajectories={**live, **trajectories},
        closures=(*(_renamed(weighed(graph.closures[k], saved), mapped) for k in outer), *inner.values(), *ties),
        measured=tuple(_renamed_factor(graph.measured[k], mapped) for k in factors),
        saved=None,
    )
    started = None if initial is None else _started(initial, mapped)
    return replace(
        mapped,
        graph=posed if posed.trajectories else None,
        initial=started,
        closures=_places(len(graph.closures), [*outer, *inner]),
        measured=_places(len(graph.measured), factors),
    )


def _places(count: int, kept: Sequence[int]) -> tuple[int | None, ...]:
    """Of each of so many things its place among those that were kept."""
    places = {k: place for place, k in enumerate(kept)}
    return tuple(places.get(k) for k in range(count))


def _of_map(
    mapped: Mapped, config: BackendConfig
) -> tuple[Mapping[LogId, Trajectory], Mapping[int, LoopClosure], Sequence[LoopClosure]]:
    """What the optimiser gets of the map: logs, closures by their place in the graph, ties; nothing without a team."""
    if not mapped.is_joined:
        return {}, {}, ()
    if mapped.nodes:
        return _stiff(mapped), {}, ()
    return *_soft(mapped, config), _ties(mapped)


def without_map(solution: GraphSolution | None, mapped: Mapped) -> GraphSolution:
    """Give the map's logs their names back, and each public closure and factor its result."""
    solution = solution or GraphSolution((), ())
    components = [_public(component, mapped) for component in solution.components]
    if not mapped.is_joined:
        components.append(_saved_component(mapped))
    public = mapped.public
    closures = [
        _closure_result(closure, None if place is None else solution.closures[place], mapped)
        for closure, place in zip(public.closures, mapped.closures, strict=True)
    ]
    measured = [
        FactorResult(factor, ClosureState.USED, 1.0, 0.0)
        if place is None
        else replace(solution.measured[place], factor=factor)
        for factor, place in zip(public.measured, mapped.measured, strict=True)
    ]
    ordered = sorted(components, key=lambda c: (c.anchor not in mapped.T_map_camera, c.anchor))
    return replace(solution, components=tuple(ordered), closures=tuple(closures), measured=tuple(measured))


# Before


def _is_joined(graph: PoseGraph, T: Mapping[LogId, Float]) -> bool:
    """Whether a closure, or something seen by both, holds a robot of the team to the map."""
    if any((c.query.log in T) != (c.match.log in T) for c in graph.closures):
        return True
    ends = {True: set[LogId](), False: set[LogId]()}
    for factor in graph.measured:
        of_map = factor.at.log in T
        ends[of_map] |= {end.log for end in (factor.query, factor.match)}
    landmarks = {log for log in ends[True] & ends[False] if is_landmark(log)}
    return bool(landmarks or (ends[False] & set(T)) or any(log in graph.trajectories for log in ends[True] - set(T)))


def _held(graph: PoseGraph, T: Mapping[LogId, Float], anchor: LogId) -> tuple[KeyframeId, ...]:
    """Keyframes of the map that something is tied to, after the first of its anchor."""
    ends = {
        end
        for c in graph.closures
        if (c.query.log in T) != (c.match.log in T)
        for end in (c.query, c.match)
        if end.log in T
    }
    ends |= {end for f in graph.measured for end in (f.query, f.match) if end.log in T}
    first = KeyframeId(anchor, 0)
    return (first, *sorted(end for end in ends - {first} if end.index < len(T[end.log])))


def _stiff(mapped: Mapped) -> dict[LogId, Trajectory]:
    """One log of the held keyframes, which does not bend."""
    return {stiff_log(mapped.saved): stiff_trajectory(mapped.T_map_camera, mapped.nodes)}


def stiff_trajectory(T_map: Mapping[LogId, Float], nodes: Sequence[KeyframeId]) -> Trajectory:
    """Keyframes one after the other as what does not bend, where they are in a map."""
    poses = np.array([T_map[node.log][node.index] for node in nodes])
    S = diagonal_covariance(STIFF_ROTATION_SIGMA_RAD, STIFF_TRANSLATION_SIGMA_M)
    return Trajectory(poses, np.broadcast_to(S, (len(poses) - 1, 6, 6)).copy())


def _soft(mapped: Mapped, config: BackendConfig) -> tuple[dict[LogId, Trajectory], dict[int, LoopClosure]]:
    """Each log at its saved poses, and the closures that hold them together there, by their place in the graph."""
    public, T = mapped.public, mapped.T_map_camera
    trajectories = {
        mapped.names[log]: replace(public.trajectories[log], T_odom_keyframe=poses) for log, poses in T.items()
    }
    used = {
        k: c
        for k, c in enumerate(public.closures)
        if c.query.log in T and c.match.log in T and (c.query, c.match) in mapped.saved.closures
    }
    if not used:
        return trajectories, {}
    closures = list(used.values())
    spread = closure_covariances(closures, np.array([_metres(c, mapped.saved, config) for c in closures]), config)
    T_rel = np.array([inverse(T[c.query.log][c.query.index]) @ T[c.match.log][c.match.index] for c in closures])
    along = np.zeros((len(closures), 6))
    along[:, 3:] = np.einsum("eji,ej->ei", T_rel[:, :3, :3], T_rel[:, :3, 3])
    sigma = np.where([c.metric for c in closures], 0.0, prior_sigmas(closures, config))
    spread += sigma[:, None, None] ** 2 * along[:, :, None] * along[:, None, :]
    tied = {
        k: LoopClosure(
            mapped.keyframe(c.query), mapped.keyframe(c.match), T_hat, CERTAIN_RATIO, covariance=S, metric=True
        )
        for (k, c), T_hat, S in zip(used.items(), T_rel, spread, strict=True)
    }
    return trajectories, tied


def _metres(closure: LoopClosure, saved: SavedMap, config: BackendConfig) -> float:
    """Metres per network unit of a closure in the saved solution."""
    return saved.closures[closure.query, closure.match].scale or initial_scale(closure, config)


def _ties(mapped: Mapped) -> list[LoopClosure]:
    """Between the anchor and each other log of the map."""
    anchor, *others = (log for log in mapped.saved.logs if log in mapped.T_map_camera)
    S = diagonal_covariance(TIE_ROTATION_SIGMA_RAD, TIE_TRANSLATION_SIGMA_M)
    T = mapped.T_map_camera
    return [
        LoopClosure(
            KeyframeId(mapped.names[anchor], 0),
            KeyframeId(mapped.names[log], 0),
            inverse(T[anchor][0]) @ T[log][0],
            CERTAIN_RATIO,
            covariance=S,
            metric=True,
            support=JOINS,
        )
        for log in others
    ]


def weighed(closure: LoopClosure, saved: SavedMap) -> LoopClosure:
    """A closure as it counts: less where a map's keyframe is one that several logs contradict."""
    weight = min(saved.weights.get(end, 1.0) for end in (closure.query, closure.match))
    return closure if weight == 1.0 else replace(closure, weight=weight * closure.weight)


def _renamed(closure: LoopClosure, mapped: Mapped) -> LoopClosure:
    return replace(closure, query=mapped.keyframe(closure.query), match=mapped.keyframe(closure.match))


def _renamed_factor(factor: MeasuredFactor, mapped: Mapped) -> MeasuredFactor:
    at = mapped.keyframe(factor.at) if not mapped.nodes or factor.at in mapped.nodes else factor.at
    return replace(factor, at=at, query=mapped.keyframe(factor.query), match=mapped.keyframe(factor.match))


def _started(initial: GraphSolution, mapped: Mapped) -> GraphSolution:
    """An earlier solution under the optimiser's names."""
    components = [_renamed_component(component, mapped) for component in initial.components]
    nodes = set(mapped.nodes)

    def known(end: KeyframeId) -> bool:
        return not nodes or end.log not in mapped.T_map_camera or end in nodes

    closures = [
        replace(c, query=mapped.keyframe(c.query), match=mapped.keyframe(c.match))
        for c in initial.closures
        if known(c.query) and known(c.match)
    ]
    return replace(initial, components=tuple(components), closures=tuple(closures), measured=())


def _renamed_component(component: Component, mapped: Mapped) -> Component:
    T: dict[LogId, Float] = {}
    for log, poses in component.T_map_keyframe.items():
        if not (mapped.nodes and log in mapped.T_map_camera):
            T[mapped.names.get(log, log)] = poses
    if mapped.nodes and any(log in mapped.T_map_camera for log in component.logs):
        stiff = _stiff(mapped)
        T |= {log: np.asarray(trajectory.T_odom_keyframe) for log, trajectory in stiff.items()}
    return replace(component, logs=tuple(sorted(T)), T_map_keyframe=T)


# After


def _public(component: Component, mapped: Mapped) -> Component:
    """A component under public names; of a map that does not move, all its logs where they were saved."""
    own = {name: log for log, name in mapped.names.items()}
    if mapped.nodes:
        stiff = stiff_log(mapped.saved)
        logs = _flat([list(mapped.T_map_camera) if log == stiff else [log] for log in component.logs])
        T = {log: mapped.T_map_camera[log] if log in mapped.T_map_camera else component.T_map_keyframe[log]
             for log in logs}  # fmt: skip
    else:
        logs = [own.get(log, log) for log in component.logs]
        T = {own.get(log, log): poses for log, poses in component.T_map_keyframe.items()}
    covariances = {
        mapped_back: S
        for keyframe, S in component.covariance_keyframe.items()
        if (mapped_back := _own_keyframe(keyframe, own, mapped)) is not None
    }
    return replace(
        component,
        logs=tuple(logs),
        T_map_keyframe=T,
        T_map_odom={log: _T_map_odom(log, T, component, mapped) for log in logs},
        covariance_map_odom={log: component.covariance_map_odom.get(log) for log in logs},
        covariance_keyframe=covariances,
    )


def _flat(parts: Iterable[Iterable[LogId]]) -> list[LogId]:
    return [log for part in parts for log in part]


def _own_keyframe(keyframe: KeyframeId, own: Mapping[LogId, LogId], mapped: Mapped) -> KeyframeId | None:
    if mapped.nodes and keyframe.log == stiff_log(mapped.saved):
        return None
    return KeyframeId(own.get(keyframe.log, keyframe.log), keyframe.index)


def _T_map_odom(log: LogId, T: Mapping[LogId, Float], component: Component, mapped: Mapped) -> Float:
    """Of the map's logs by their own odometry: the optimiser took their saved poses for it."""
    if log not in mapped.T_map_camera:
        return np.asarray(component.T_map_odom[log])
    T_odom = np.asarray(mapped.public.trajectories[log].T_odom_keyframe, dtype=float)
    return np.asarray(T[log][-1] @ inverse(T_odom[-1]))


def _saved_component(mapped: Mapped) -> Component:
    """The map as it was saved."""
    T = dict(mapped.T_map_camera)
    empty = Component(tuple(T), {}, {}, {})
    return replace(
        empty,
        T_map_keyframe=T,
        T_map_odom={log: _T_map_odom(log, T, empty, mapped) for log in T},
        covariance_map_odom=dict.fromkeys(T),
    )


def _closure_result(closure: LoopClosure, solved: ClosureResult | None, mapped: Mapped) -> ClosureResult:
    """A closure between a team's keyframes as it was solved; one of the map as it was saved."""
    saved = mapped.saved.closures.get((closure.query, closure.match))
    of_map = closure.query.log in mapped.T_map_camera and closure.match.log in mapped.T_map_camera
    if not of_map:
        assert solved is not None
        return replace(solved, query=closure.query, match=closure.match)
    if saved is None:
        reason = "not used by the saved map"
        return ClosureResult(closure.query, closure.match, ClosureState.REJECTED, 0.0, None, 0.0, reason)
    residual = 0.0 if solved is None else solved.residual
    return ClosureResult(closure.query, closure.match, ClosureState.USED, saved.weight, saved.scale, residual)


def solver_keyframes(keyframes: Sequence[KeyframeId], mapped: Mapped) -> list[KeyframeId]:
    """Keyframes whose covariance is wanted, under the optimiser's names; a map that does not move has none."""
    wanted = [k for k in keyframes if not (mapped.nodes and k.log in mapped.T_map_camera)]
    return [mapped.keyframe(k) for k in wanted]
