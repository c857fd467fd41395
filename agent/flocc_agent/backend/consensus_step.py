"""One step of a robot's part in distributed mode: put it together, hear, step, tell.

A robot's part changes from step to step: keyframes and closures come, what is shared with a neighbour is listed anew,
and the whole part moves into another frame. What is kept between two steps is kept by keyframe, so that it fits
whatever part comes next. Forces live in the poses' own tangents and need not be moved; targets move with the part.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.consensus import (
    ConsensusPart,
    PartBeginning,
    beginning_scale,
    information_by_keyframe,
    part_of,
)
from flocc_agent.backend.consensus_pair import PairedRobot, Tidings, paired
from flocc_agent.backend.measured import measured_odometry
from flocc_agent.backend.screening import first_not_rigid
from flocc_agent.config import BackendConfig
from flocc_agent.core.own_part import ConsensusProblem, ConsensusState, ConsensusStep, SharedWith, ToldPoses
from flocc_agent.core.pose_graph import LoopClosure, OptimisationFailed
from flocc_agent.geometry import inverse, nearest_rotation, pose
from flocc_protocol.codec import COORDINATE_MAX
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

OUTSIDE_M = 0.5 * COORDINATE_MAX
"""No pose is farther from where its frame begins."""
AGREED = 0.05
"""Two robots agree on a pose that they have no farther from each other, in metres or entries of a rotation."""


@dataclass(frozen=True, slots=True, eq=False)
class PartState(ConsensusState):
    """What is kept of a part between two steps.

    Attributes:
        T: (N, 4, 4) own poses.
        copies: Higher robots' poses.
        scales: Of the cluster of each closure that has one.
        pairs: What is known of each neighbour.
    """

    T: Float
    copies: Mapping[KeyframeId, Float] = field(default_factory=dict)
    scales: Mapping[tuple[KeyframeId, KeyframeId], float] = field(default_factory=dict)
    pairs: Mapping[LogId, PairedRobot] = field(default_factory=dict)

    def moved(self, by: Float) -> "PartState":
        """The same in another frame."""
        pairs = {
            other: neighbour if neighbour.T is None else replace(neighbour, T=by @ neighbour.T)
            for other, neighbour in self.pairs.items()
        }
        copies = {keyframe: by @ T for keyframe, T in self.copies.items()}
        return replace(self, T=by @ self.T, copies=copies, pairs=pairs)


def consensus_step(config: BackendConfig, problem: ConsensusProblem) -> ConsensusStep | OptimisationFailed:
    """Do one step of a part.

    Args:
        config: Formulation and noise model.
        problem: The part, and what others said.

    Returns:
        Where the part stands now, or why it could not be moved.
    """
    broken = first_not_rigid(np.asarray(problem.trajectory.T_odom_keyframe))
    if broken is not None:
        return OptimisationFailed(f"robot {problem.log}: odometry of keyframe {broken} is not rigid")
    reason = ""
    for left_out, attempt in _attempts(problem):
        try:
            step = _stepped(config, attempt)
        except (np.linalg.LinAlgError, RuntimeError, FloatingPointError, ValueError) as error:
            reason = reason or str(error).strip().split("\n")[0]
        else:
            return replace(step, refused={**step.refused, **dict.fromkeys(left_out, reason)})
    return OptimisationFailed(reason)


def _attempts(problem: ConsensusProblem) -> Iterator[tuple[tuple[LogId, ...], ConsensusProblem]]:
    """The problem, and for where it has no step: without what one neighbour told, or all told, or ever told."""
    yield (), problem
    told = tuple(other for other, shared in problem.shared.items() if shared.told is not None)
    moves_to = () if problem.move_to is None else (problem.move_to[0],)
    named = tuple(dict.fromkeys((*told, *moves_to)))
    for left_out in [*((other,) for other in named if len(named) > 1), named]:
        shared = {other: replace(s, told=None) if other in left_out else s for other, s in problem.shared.items()}
        move_to = None if problem.move_to is None or problem.move_to[0] in left_out else problem.move_to
        yield left_out, replace(problem, shared=shared, move_to=move_to)
    if isinstance(problem.state, PartState):
        shared = {other: replace(s, told=None) for other, s in problem.shared.items()}
        yield named, replace(problem, shared=shared, move_to=None, state=replace(problem.state, pairs={}))


def _stepped(config: BackendConfig, problem: ConsensusProblem) -> ConsensusStep:
    state = problem.state or PartState(problem.T_alone)
    assert isinstance(state, PartState)
    state = replace(state, T=_extended(state.T, np.asarray(problem.trajectory.T_odom_keyframe, dtype=float)))
    owned = [each.closure for each in problem.owned]
    scale = np.array([beginning_scale(each, config) for each in problem.owned])
    state = replace(state, copies={**state.copies, **_copies(problem, state)})
    information = _informations(problem, owned, scale, config)
    pairs = {other: _neighbour(problem, state, other, information) for other in problem.shared}
    state = replace(state, pairs=pairs)
    aligned = problem.move_to is not None and problem.move_to[0] in pairs
    if problem.move_to is not None and aligned:
        state = state.moved(_motion(state, *problem.move_to))
    part = _part(config, problem, state, scale)
    refused = _heard(part, problem.shared)
    heard = [other for other, shared in problem.shared.items() if shared.told is not None and other not in refused]
    before, apart = part.T, {other: part.apart(other) for other in heard}
    refused |= part.step(problem.number)
    told = {other: part.tell(other).told() for other in part.neighbours}
    _require_within_map(part, told)
    after = _state_of(part, problem)
    origin = _origin(problem, after.T)
    poses = part.state.poses()
    apart = {other: before_it.most(part.apart(other)) for other, before_it in apart.items()}
    gaps = [float(np.abs(poses[n.index] - n.T).max()) for n in part.neighbours.values() if n.T is not None]
    return ConsensusStep(
        after,
        inverse(origin) @ after.T,
        origin,
        told,
        {other: neighbour.information for other, neighbour in part.neighbours.items() if neighbour.lower},
        float(np.abs(after.T - before).max()),
        max(gaps, default=0.0),
        part.own_cost(),
        aligned,
        refused,
        apart,
    )


def _require_within_map(part: ConsensusPart, told: Mapping[LogId, ToldPoses]) -> None:
    """Refuse a step that leads where no pose can be, or to forces that cannot be said.

    Raises:
        ValueError: It does.
    """
    poses = part.state.poses()
    numbers = [told_poses.rows for told_poses in told.values()]
    if not all(np.all(np.isfinite(each)) for each in (poses, *numbers)):
        raise ValueError("it leads to poses or forces that are not finite")
    if float(np.abs(poses[:, :3, 3]).max(initial=0.0)) > OUTSIDE_M:
        raise ValueError("it leads out of the map")


def _extended(T: Float, T_odom: Float) -> Float:
    """Append keyframes that came since, by odometry from the last one."""
    n = len(T)
    if n == 0:
        return T_odom
    return T if len(T_odom) <= n else np.concatenate([T, T[-1] @ inverse(T_odom[n - 1]) @ T_odom[n:]])


def _copies(problem: ConsensusProblem, state: PartState) -> dict[KeyframeId, Float]:
    """Poses of higher robots at owned closures: as they stood, new ones where they were when they were chosen."""
    found: dict[KeyframeId, Float] = {}
    for each in problem.owned:
        low, high = sorted((each.closure.query, each.closure.match))
        if high.log != problem.log and high not in found:
            found[high] = state.copies[high] if high in state.copies else state.T[low.index] @ each.T_low_high
    return found


def _informations(
    problem: ConsensusProblem, owned: list[LoopClosure], scale: Float, config: BackendConfig
) -> dict[LogId, Float]:
    """Of the closures at the poses that are shared with higher robots, which this robot owns; as it travels."""
    between = [k for k, c in enumerate(owned) if c.query.log != c.match.log]
    by_keyframe = information_by_keyframe([owned[k] for k in between], scale[between], config)
    return {
        other: np.asarray(np.array([by_keyframe[k] for k in shared.keyframes]), dtype=np.float32).astype(float)
        for other, shared in problem.shared.items()
        if problem.log < other
    }


def _neighbour(
    problem: ConsensusProblem, state: PartState, other: LogId, information: Mapping[LogId, Float]
) -> PairedRobot:
    """What is known of a neighbour; where poses are listed anew, those that stay are pulled as before."""
    shared, held = problem.shared[other], state.pairs.get(other)
    same = held if held is not None and held.edition == shared.edition else None
    told = information[other] if problem.log < other else shared.information
    assert told is not None, "who does not own closures was told their information"
    said = told if same is None else same.information
    neighbour = paired(problem.log < other, shared.keyframes, said, shared.edition)
    if held is None or held.T is None:
        return neighbour if same is None else replace(same)
    T_held = _poses_of(problem.log, state, held.keyframes)
    if shared.forgotten and T_held is not None and float(np.abs(T_held - held.T).max()) > AGREED:
        return neighbour
    if same is not None:
        return replace(same)
    T = _poses_of(problem.log, state, shared.keyframes)
    kept = [(k, held.keyframes.index(each)) for k, each in enumerate(shared.keyframes) if each in held.keyframes]
    if T is None or T_held is None or not kept:
        return neighbour
    new, old = np.array(kept).T
    force = np.zeros((len(T), 6))
    force[new] = held.pull(T_held).reshape(-1, 6)[old]
    return replace(neighbour, T=T, force=force.ravel())


def _poses_of(log: LogId, state: PartState, keyframes: tuple[KeyframeId, ...]) -> Float | None:
    """Poses (S, 4, 4) of keyframes, None where a copy of one is no longer here."""
    if any(each.log != log and each not in state.copies for each in keyframes):
        return None
    return np.array([_pose_of(log, state, each) for each in keyframes])


def _pose_of(log: LogId, state: PartState, keyframe: KeyframeId) -> Float:
    return np.asarray(state.T[keyframe.index] if keyframe.log == log else state.copies[keyframe])


def _motion(state: PartState, other: LogId, told: ToldPoses) -> Float:
    """The rigid motion (4, 4) that brings the poses that are shared with a robot to where it has them."""
    neighbour = state.pairs[other]
    log = min(neighbour.keyframes).log
    own = log != other
    T = np.array([state.T[k.index] if own else state.copies[k] for k in neighbour.keyframes])
    there = Tidings.of(told, len(T)).T
    R = nearest_rotation(np.sum(there[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2), axis=0))
    return pose(R, there[:, :3, 3].mean(axis=0) - R @ T[:, :3, 3].mean(axis=0))


def _part(config: BackendConfig, problem: ConsensusProblem, state: PartState, scale: Float) -> ConsensusPart:
    owned = [each.closure for each in problem.owned]
    weights = np.array([each.weight for each in problem.owned])
    trajectory = measured_odometry(problem.trajectory, config)
    begins = PartBeginning(state.T, state.copies, scale, weights)
    part = part_of(problem.log, config, trajectory, owned, begins, state.pairs)
    found = [(c, state.scales.get((o.query, o.match))) for c, o in zip(_clusters(part, problem), owned, strict=True)]
    for cluster, before in found:
        if cluster >= 0 and before is not None:
            part.state.scale[cluster] = before
    return part


def _clusters(part: ConsensusPart, problem: ConsensusProblem) -> list[int]:
    """The cluster of each owned closure, -1 for none."""
    clusters: list[int] = part.edges.cluster[len(part.edges) - len(problem.owned) :].tolist()
    return clusters


def _heard(part: ConsensusPart, shared: Mapping[LogId, SharedWith]) -> dict[LogId, str]:
    """Hear what neighbours told; who told what cannot be, and why."""
    refused: dict[LogId, str] = {}
    for other, with_it in shared.items():
        if with_it.told is not None:
            try:
                part.hear(other, Tidings.of(with_it.told, len(with_it.keyframes)))
            except ValueError as error:
                refused[other] = str(error)
    return refused


def _state_of(part: ConsensusPart, problem: ConsensusProblem) -> PartState:
    """What is kept of a part."""
    poses = part.state.poses()
    highs = {max(c.closure.query, c.closure.match) for c in problem.owned}
    copies = sorted(high for high in highs if high.log != part.log)
    of_closure = {
        (each.closure.query, each.closure.match): float(part.state.scale[cluster])
        for cluster, each in zip(_clusters(part, problem), problem.owned, strict=True)
        if cluster >= 0
    }
    return PartState(poses[: part.own], dict(zip(copies, poses[part.own :], strict=True)), of_closure, part.neighbours)


def _origin(problem: ConsensusProblem, T: Float) -> Float:
    """Where the map frame lies (4, 4): at the anchor's first keyframe, less its odometry; else as heard."""
    if problem.origin is not None and not problem.anchored:
        return problem.origin
    return np.asarray(T[0] @ inverse(np.asarray(problem.trajectory.T_odom_keyframe[0], dtype=float)))
