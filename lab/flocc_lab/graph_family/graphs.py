"""Graphs of the family: what the robots measure on their ways, and what of it is wrong."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flocc_agent.core.pose_graph import LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import inverse, pose, se3_exp, so3_exp
from flocc_lab.graph_family.family_spec import GROUP_CLOSURES, WEAK_CLOSURES, Lengths, Spec, drawn
from flocc_lab.graph_family.ways import true_poses
from flocc_launch.graph_files.graph_file import unit_length
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Pair = tuple[KeyframeId, KeyframeId]

RANGE_M, NEAREST_M = 7.0, 0.5
APART_KEYFRAMES_MIN = 30
OWN_RATIO = 0.3
TAIL_PROBABILITY, TAIL_FACTOR = 0.01, 5.5
GUESS_SIGMA_RATIO = 0.3
UNITS_SIGMA_RATIO = 0.3
FALSE_LENGTH_M = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class KnownGraph:
    """A graph whose answer is known.

    Attributes:
        seed: What it was drawn from.
        groups: Groups of wrong closures that agree with each other.
        graph: What is to be solved.
        T_world_keyframe: True poses (N, 4, 4) by log.
        is_right: Of each closure (L,).
    """

    seed: int
    groups: int
    graph: PoseGraph
    T_world_keyframe: Mapping[LogId, Float]
    is_right: NDArray[np.bool_]

    def right_closures(self) -> PoseGraph:
        """The same graph without its wrong closures."""
        kept = [c for c, right in zip(self.graph.closures, self.is_right, strict=True) if right]
        return PoseGraph(self.graph.trajectories, kept)


@dataclass(frozen=True, slots=True, eq=False)
class Member(KnownGraph):
    """A graph of the family."""

    spec: Spec


def member(seed: int) -> Member:
    """The member of the family that a seed names."""
    return made(drawn(seed))


def made(spec: Spec) -> Member:
    """A graph by its description."""
    rng = np.random.default_rng([spec.seed, 15])
    logs = [LogId(f"r{k:02d}") for k in range(spec.robots)]
    truth = dict(zip(logs, true_poses(rng, spec), strict=True))
    trajectories = {
        log: _odometry(rng, T, spec, off) for (log, T), off in zip(truth.items(), spec.scale_off, strict=True)
    }
    right = _meetings(rng, truth, spec)
    closures = [_measured(rng, pair, _between(truth, pair), spec) for pair in right]
    alone = round(len(right) * spec.outliers / (1.0 - spec.outliers))
    wrong = [_measured(rng, _wrong_pair(rng, truth, right, spec), _false_pose(rng, spec), spec) for _ in range(alone)]
    groups = min(spec.groups, len(right) // (2 * GROUP_CLOSURES))
    wrong += [closure for _ in range(groups) for closure in _facade(rng, truth, spec)]
    order = rng.permutation(len(closures) + len(wrong))
    mixed = [*closures, *wrong]
    graph = PoseGraph(trajectories, [mixed[k] for k in order])
    return Member(spec.seed, spec.groups, graph, truth, order < len(closures), spec)


def stray(rng: np.random.Generator, member: Member) -> LoopClosure:
    """One more wrong closure, between keyframes that have nothing to do with each other."""
    return _measured(rng, _any_pair(rng, member.T_world_keyframe), _false_pose(rng, member.spec), member.spec)


def _odometry(rng: np.random.Generator, T: Float, spec: Spec, scale_off: float) -> Trajectory:
    """What a robot measures of its own motion, from the identity on, with the declared covariance."""
    steps = inverse(T[:-1]) @ T[1:]
    noise = rng.normal(size=(len(steps), 6)) * np.repeat(spec.odometry, 3) * spec.odometry_factor
    if spec.heavy_tails:
        noise[rng.random(len(steps)) < TAIL_PROBABILITY] *= TAIL_FACTOR
    if spec.planar:
        noise[:, [0, 1, 5]] = 0.0
    steps[:, :3, 3] *= scale_off
    out = np.empty_like(T)
    out[0] = np.eye(4)
    for k, xi in enumerate(noise):
        out[k + 1] = out[k] @ steps[k] @ se3_exp(xi)
    covariance = np.diag(np.repeat(np.square(spec.odometry), 3))
    return Trajectory(out, np.broadcast_to(covariance, (len(steps), 6, 6)).copy())


def _meetings(rng: np.random.Generator, truth: Mapping[LogId, Float], spec: Spec) -> list[Pair]:
    """Keyframes that are near each other, of two robots or of one at different times."""
    names = [KeyframeId(log, k) for log, T in truth.items() for k in range(len(T))]
    robot = np.repeat(np.arange(spec.robots), spec.keyframes)
    index = np.concatenate([np.arange(n) for n in spec.keyframes])
    points = np.concatenate([T[:, :3, 3] for T in truth.values()])
    near = cKDTree(points).query_pairs(RANGE_M, output_type="ndarray")
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    a, b = near.T
    if spec.parallel:
        near = near[(robot[a] != robot[b]) & (index[a] == index[b])]
        a, b = near.T
    apart = np.linalg.norm(points[a] - points[b], axis=1) > NEAREST_M
    between, own = apart & (robot[a] != robot[b]), apart & (robot[a] == robot[b])
    own &= np.abs(index[a] - index[b]) > APART_KEYFRAMES_MIN
    held = between & (robot[b] == spec.robots - 1) if spec.weak else np.zeros(len(near), dtype=bool)
    of_own = round(spec.closures * OWN_RATIO)
    chosen = [
        *_some(rng, near[between & ~held], spec.closures - of_own),
        *_some(rng, near[own], of_own),
        *_some(rng, near[held], WEAK_CLOSURES),
    ]
    return [(names[int(j)], names[int(i)]) for i, j in chosen]


def _some(rng: np.random.Generator, rows: Int, count: int) -> Int:
    return np.asarray(rows[rng.choice(len(rows), min(count, len(rows)), replace=False)] if len(rows) else rows)


def _between(truth: Mapping[LogId, Float], pair: Pair) -> Float:
    T_query, T_match = (truth[keyframe.log][keyframe.index] for keyframe in pair)
    return np.asarray(inverse(T_query) @ T_match)


def _measured(rng: np.random.Generator, pair: Pair, T_query_match: Float, spec: Spec) -> LoopClosure:
    """A closure that measures a relative pose, with noise, in what is known of lengths."""
    noise = rng.normal(size=6) * np.repeat(spec.closure, 3) * spec.closure_factor
    if spec.planar:
        noise[[0, 1, 5]] = 0.0
    T = T_query_match @ se3_exp(noise)
    query, match = pair
    sigma = np.repeat(spec.closure, 3)
    metric = spec.lengths is Lengths.METRIC or (spec.lengths is Lengths.UNIT and query.log == match.log)
    if metric:
        return LoopClosure(query, match, T, covariance=np.diag(sigma**2), metric=True)
    if spec.lengths is Lengths.UNIT:
        return unit_length(LoopClosure(query, match, T, covariance=np.diag(sigma**2)))
    metres_per_unit = float(np.exp(rng.normal(0.0, UNITS_SIGMA_RATIO)))
    T[:3, 3] /= metres_per_unit
    sigma[3:] /= metres_per_unit
    guess = metres_per_unit * float(np.exp(rng.normal(0.0, GUESS_SIGMA_RATIO)))
    return LoopClosure(query, match, T, scale_initial=guess, covariance=np.diag(sigma**2))


def _any_keyframe(rng: np.random.Generator, truth: Mapping[LogId, Float]) -> KeyframeId:
    logs = list(truth)
    log = logs[int(rng.integers(len(logs)))]
    return KeyframeId(log, int(rng.integers(len(truth[log]))))


def _any_pair(rng: np.random.Generator, truth: Mapping[LogId, Float]) -> Pair:
    """Two keyframes that have nothing to do with each other."""
    while True:
        a, b = _any_keyframe(rng, truth), _any_keyframe(rng, truth)
        if a != b and (a.log != b.log or abs(a.index - b.index) > APART_KEYFRAMES_MIN or len(truth) == 1):
            return a, b


def _wrong_pair(rng: np.random.Generator, truth: Mapping[LogId, Float], right: Sequence[Pair], spec: Spec) -> Pair:
    """Keyframes of a wrong closure: of any robots, or of those of some right closure."""
    if spec.scattered:
        return _any_pair(rng, truth)
    logs = [keyframe.log for keyframe in right[int(rng.integers(len(right)))]]
    while True:
        a, b = (KeyframeId(log, int(rng.integers(len(truth[log])))) for log in logs)
        if a.log != b.log or abs(a.index - b.index) > APART_KEYFRAMES_MIN:
            return a, b


def _false_pose(rng: np.random.Generator, spec: Spec) -> Float:
    """A relative pose as places that look alike suggest it: near, and often turned like the right ones."""
    yaw = rng.normal(0.0, 0.3) if rng.random() < 0.5 else rng.uniform(-np.pi, np.pi)
    flat = np.array([1.0, 1.0, 0.0 if spec.planar else 0.2])
    return pose(so3_exp(np.array([0.0, 0.0, yaw])), rng.normal(0.0, FALSE_LENGTH_M, 3) * flat + 1e-3)


def _facade(rng: np.random.Generator, truth: Mapping[LogId, Float], spec: Spec) -> list[LoopClosure]:
    """Ten closures of consecutive keyframes that agree with each other and are wrong: a repeated facade."""
    while True:
        query, match = _any_pair(rng, truth)
        query = KeyframeId(query.log, min(query.index, len(truth[query.log]) - GROUP_CLOSURES))
        match = KeyframeId(match.log, min(match.index, len(truth[match.log]) - GROUP_CLOSURES))
        far = np.linalg.norm(_between(truth, (query, match))[:3, 3]) > 2 * RANGE_M
        if far or rng.random() < 0.02:
            break
    false = _false_pose(rng, spec)
    T_false = truth[query.log][query.index] @ false @ inverse(truth[match.log][match.index])
    closures = []
    for k in range(GROUP_CLOSURES):
        pair = (KeyframeId(query.log, query.index + k), KeyframeId(match.log, match.index + k))
        T_query, T_match = (truth[keyframe.log][keyframe.index] for keyframe in pair)
        closures.append(_measured(rng, pair, inverse(T_query) @ T_false @ T_match, spec))
    return closures
