"""What every graph file becomes: a pose graph, and what the file knows beyond it."""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import adjoint, in_units, inverse, umeyama
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

INDEX_BITS = 56
INDEX_MASK = (1 << INDEX_BITS) - 1
LABEL_BITS = 48
STEP_MAX_M = 1e6
"""A longer step of a robot is damage: a closure as long is refused by the back end, odometry has to be refused here."""
OPEN_SIGMA_RAD, OPEN_SIGMA_M = 1e4, 1e6
"""Standard deviations of a step that nothing measured: it says where the next keyframe starts, and no more."""


class GraphFileError(FloccError):
    """A pose-graph file that cannot be used; the message names the file and the line or key."""


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """A relative pose between two keys of a file: (4, 4), and its covariance (6, 6), rotation first."""

    first: int
    second: int
    T_first_second: Float
    covariance: Float


@dataclass(frozen=True, slots=True, eq=False)
class GraphFile:
    """A pose graph from a file.

    Attributes:
        graph: Odometry of every robot in its own frame, and closures, metric as in the file.
        truth_m: (N, 3) true position of every keyframe of each log, where the file has them.
        T_initial: (N, 4, 4) poses of each log in one frame, where the file has an initialisation.
        outliers: Indices of closures that the file labels as wrong.
        T_truth: (N, 4, 4) true pose of every keyframe of each log, where the file has whole poses.
        planar: Whether it was a file of two dimensions.
        left_out: How many lines of each kind were not read.
        fixed: Keyframes that the file holds where they are.
        notes: What else of the file was not taken as it stands, in one sentence each.
        stamps_s: (N,) time of every keyframe of each log, counted from the file's first, where it has times.
        vertices: The file's own number of every keyframe of each log, where it numbers them.
    """

    graph: PoseGraph
    truth_m: Mapping[LogId, Float] = field(default_factory=dict)
    T_initial: Mapping[LogId, Float] = field(default_factory=dict)
    outliers: frozenset[int] = frozenset()
    T_truth: Mapping[LogId, Float] = field(default_factory=dict)
    stamps_s: Mapping[LogId, Float] = field(default_factory=dict)
    planar: bool = False
    left_out: Mapping[str, int] = field(default_factory=dict)
    fixed: tuple[KeyframeId, ...] = ()
    notes: tuple[str, ...] = ()
    vertices: Mapping[LogId, tuple[int, ...]] = field(default_factory=dict)

    def without_outliers(self) -> "GraphFile":
        """The same file without the closures that it labels as wrong."""
        kept = tuple(c for k, c in enumerate(self.graph.closures) if k not in self.outliers)
        return replace(self, graph=replace(self.graph, closures=kept), outliers=frozenset())

    def shortened(self, keyframes: int) -> "GraphFile":
        """The same file with at most the first so many keyframes of each robot; labels of closures are left out."""

        def cut(by_log: Mapping[LogId, Float]) -> dict[LogId, Float]:
            return {log: values[:keyframes] for log, values in by_log.items()}

        trajectories = {
            log: Trajectory(
                t.T_odom_keyframe[:keyframes],
                None if t.edge_covariances is None else t.edge_covariances[: keyframes - 1],
            )
            for log, t in self.graph.trajectories.items()
        }
        closures = [c for c in self.graph.closures if max(c.query.index, c.match.index) < keyframes]
        graph = replace(self.graph, trajectories=trajectories, closures=closures)
        truth_m, T_initial = cut(self.truth_m), cut(self.T_initial)
        return GraphFile(graph, truth_m, T_initial, frozenset(), cut(self.T_truth), cut(self.stamps_s))

    def with_unit_scale(self) -> "GraphFile":
        """The same file with the translations of inter-robot closures reduced to length one and their scale free."""
        closures = tuple(unit_length(c) if c.query.log != c.match.log else c for c in self.graph.closures)
        return replace(self, graph=replace(self.graph, closures=closures))

    def with_isotropic_noise(self) -> "GraphFile":
        """The same file with the noise model of SE-Sync: one number each for rotation and translation of an edge.

        Twice the back end's cost is then SE-Sync's objective `sum kappa |R_j - R_i R|^2 + tau |t_j - t_i - R_i t|^2`.
        """
        trajectories = {
            log: replace(trajectory, edge_covariances=_isotropic_all(trajectory.edge_covariances, self.planar))
            for log, trajectory in self.graph.trajectories.items()
        }
        closures = tuple(
            c if c.covariance is None else replace(c, covariance=isotropic_noise(c.covariance, self.planar))
            for c in self.graph.closures
        )
        return replace(self, graph=replace(self.graph, trajectories=trajectories, closures=closures))


def isotropic_noise(covariance: Float, planar: bool = False) -> Float:
    """SE-Sync's isotropic noise (6, 6): `kappa = 3 / (2 tr)`, `tau = 3 / tr` of the inverse information blocks.

    An edge of a planar file takes `kappa` of its one angle and
    `tau = 2 / tr`. The back end's rotation residual is half of SE-Sync's squared, hence variance `1 / (2 kappa)`.
    """
    return isotropic_of(np.asarray(np.linalg.inv(covariance), dtype=np.float64), planar)


def isotropic_of(information: Float, planar: bool = False) -> Float:
    """The same of an information matrix, which need not be positive definite: only traces of its blocks count.

    Raises:
        ValueError: A trace is not positive.
    """
    rotation, translation = np.linalg.inv(information[:3, :3]), np.linalg.inv(information[3:, 3:])
    if np.trace(rotation) <= 0.0 or np.trace(translation) <= 0.0:
        raise ValueError("the information matrix is not positive definite")
    if planar:
        kappa, tau = information[2, 2], 2.0 / np.trace(translation[:2, :2])
    else:
        kappa, tau = 1.5 / np.trace(rotation), 3.0 / np.trace(translation)
    return np.diag([0.5 / kappa] * 3 + [1.0 / tau] * 3)


def _isotropic_all(covariances: Float | None, planar: bool) -> Float | None:
    return (
        None if covariances is None else np.array([isotropic_noise(S, planar) for S in covariances]).reshape(-1, 6, 6)
    )


def unit_length(closure: LoopClosure) -> LoopClosure:
    """A closure whose translation has length one and whose scale is free, its covariance in that unit; zero stays."""
    T = np.array(closure.T_query_match_unscaled)
    length_m = float(np.linalg.norm(T[:3, 3])) or 1.0
    T[:3, 3] /= length_m
    covariance = None if closure.covariance is None else in_units(closure.covariance, length_m)
    return replace(closure, T_query_match_unscaled=T, covariance=covariance, metric=False, scale_initial=None)


def log_of(key: int) -> LogId:
    """The log of a GTSAM-style key: its top byte is the robot's letter, or nothing where there is one robot.

    A letter in the byte below it, where no index reaches, is the robot's label (GTSAM's `LabeledSymbol`).
    """
    number, label = key >> INDEX_BITS, chr((key >> LABEL_BITS) & 0xFF)
    letter = chr(number).lower() if number < 128 else ""
    if not (letter.isascii() and letter.isalnum()):
        return LogId(f"robot-{number}")
    return LogId(letter + label.lower() if label.isascii() and label.isalpha() else letter)


def distinct(measurements: Iterable[Measurement], add_up: bool) -> list[Measurement]:
    """Measurements that occur several times, word for word, once.

    Args:
        measurements: In the order of the file.
        add_up: Their information is added up (g2o: every line is a term of the sum); otherwise it is taken once
            (JRL: both robots list what they share).
    """
    same: dict[tuple[int, int, bytes], list[Measurement]] = {}
    for m in measurements:
        same.setdefault((m.first, m.second, m.T_first_second.tobytes()), []).append(m)
    return [
        replace(ms[0], covariance=_together([m.covariance for m in ms])) if add_up and len(ms) > 1 else ms[0]
        for ms in same.values()
    ]


def _together(covariances: Sequence[Float]) -> Float:
    """Covariance of a measurement that occurs with each of these: their information is added up."""
    return np.asarray(np.linalg.inv(np.sum(np.linalg.inv(np.array(covariances)), axis=0)), dtype=np.float64)


def pose_graph(measurements: Sequence[Measurement], path: str) -> PoseGraph:
    """Sort measurements into odometry (from a key of a robot to its next, the first such) and closures.

    The order of keys is not the order of time: between a key and the next, odometry may run backwards, and is
    inverted then. Where nothing joins the two, the way round by other measurements says where the next one starts; its
    covariance says nothing.

    Raises:
        GraphFileError: There is no such way, two robots have one name, or a step is longer than any robot goes.
    """
    keys = sorted({key for m in measurements for key in (m.first, m.second)})
    _one_name_each(keys, path)
    following = {a: b for a, b in pairwise(keys) if log_of(a) == log_of(b)}
    odometry: dict[int, int] = {}
    for forward in (True, False):
        for k, m in enumerate(measurements):
            first, second = (m.first, m.second) if forward else (m.second, m.first)
            if following.get(first) == second:
                odometry.setdefault(first, k)
    steps = {key: measurements[k] for key, k in odometry.items()}
    steps = {key: m if m.first == key else inverted(m) for key, m in steps.items()}
    gaps = {a: b for a, b in following.items() if a not in steps}
    if gaps:
        steps |= _bridged(gaps, measurements, path)
    for key, m in steps.items():
        _possible(key, following[key], m, path)
    taken, numbers = set(odometry.values()), _numbers(keys)
    closures = [_closure(m, numbers) for k, m in enumerate(measurements) if k not in taken]
    return PoseGraph(_trajectories(keys, steps), closures)


def _one_name_each(keys: Sequence[int], path: str) -> None:
    """Refuse robots whose letters differ in their case only: names of logs have lower case."""
    letters: dict[LogId, int] = {}
    for key in keys:
        other = letters.setdefault(log_of(key), key >> LABEL_BITS if key >> INDEX_BITS else 0)
        if key >> INDEX_BITS and other != key >> LABEL_BITS:
            raise GraphFileError(
                f"{path}: vertices {other << LABEL_BITS} and {key} are of two robots of which both are named "
                f"{log_of(key)}, because case does not count; give one another letter"
            )


def _possible(first: int, second: int, m: Measurement, path: str) -> None:
    length_m = float(np.abs(m.T_first_second[:3, 3]).max())
    if length_m > STEP_MAX_M:
        where = f"robot {log_of(first)} from vertex {first & INDEX_MASK} to {second & INDEX_MASK}"
        raise GraphFileError(
            f"{path}: the step of {where} is {length_m:g} m long, {STEP_MAX_M:g} m at most are possible"
        )


def inverted(m: Measurement) -> Measurement:
    """The same measurement from its other end, to first order of its noise."""
    Ad = adjoint(m.T_first_second)
    return Measurement(m.second, m.first, inverse(m.T_first_second), Ad @ m.covariance @ Ad.T)


def _bridged(gaps: Mapping[int, int], measurements: Sequence[Measurement], path: str) -> dict[int, Measurement]:
    """Steps over gaps that no measurement joins, along a tree of measurements; they hold nothing."""
    ways: dict[int, list[tuple[int, Float]]] = {}
    for m in measurements:
        ways.setdefault(m.first, []).append((m.second, m.T_first_second))
        ways.setdefault(m.second, []).append((m.first, inverse(m.T_first_second)))
    T: dict[int, Float] = {}
    root: dict[int, int] = {}
    open_ = np.diag([OPEN_SIGMA_RAD**2] * 3 + [OPEN_SIGMA_M**2] * 3)
    found = {}
    for a, b in gaps.items():
        if a not in root:
            _reach(a, ways, T, root)
        if root.get(b) != root[a]:
            where = f"robot {log_of(a)} has no odometry from keyframe {a & INDEX_MASK} to {b & INDEX_MASK}"
            raise GraphFileError(f"{path}: {where}, and nothing else joins them")
        found[a] = Measurement(a, b, inverse(T[a]) @ T[b], open_)
    return found


def _reach(
    start: int, ways: Mapping[int, Sequence[tuple[int, Float]]], T: dict[int, Float], root: dict[int, int]
) -> None:
    """Pose and root of every key that measurements join to one, by the fewest of them."""
    T[start], root[start] = np.eye(4), start
    queue = deque([start])
    while queue:
        key = queue.popleft()
        for other, T_key_other in ways[key]:
            if other not in root:
                T[other], root[other] = T[key] @ T_key_other, start
                queue.append(other)


def unmeasured_steps(trajectory: Trajectory) -> int:
    """How many steps of a robot no measurement of the file joins."""
    covariances = trajectory.edge_covariances
    return 0 if covariances is None else int(np.count_nonzero(covariances[:, 5, 5] >= OPEN_SIGMA_M**2))


def _numbers(keys: Sequence[int]) -> dict[int, KeyframeId]:
    """Number every robot's keys from 0."""
    counts: dict[LogId, int] = {}
    numbers = {}
    for key in keys:
        log = log_of(key)
        numbers[key] = KeyframeId(log, counts.setdefault(log, 0))
        counts[log] += 1
    return numbers


def _trajectories(keys: Sequence[int], steps: Mapping[int, Measurement]) -> dict[LogId, Trajectory]:
    by_log: dict[LogId, list[int]] = {}
    for key in keys:
        by_log.setdefault(log_of(key), []).append(key)
    return {log: _trajectory(own, steps) for log, own in by_log.items()}


def _trajectory(keys: Sequence[int], steps: Mapping[int, Measurement]) -> Trajectory:
    T = np.empty((len(keys), 4, 4))
    T[0] = np.eye(4)
    covariances = np.empty((len(keys) - 1, 6, 6))
    for n, key in enumerate(keys[:-1]):
        T[n + 1] = T[n] @ steps[key].T_first_second
        covariances[n] = steps[key].covariance
    return Trajectory(T, covariances)


def _closure(m: Measurement, numbers: Mapping[int, KeyframeId]) -> LoopClosure:
    return LoopClosure(numbers[m.first], numbers[m.second], m.T_first_second, covariance=m.covariance, metric=True)


def ate_m(estimate_m: Mapping[LogId, Float], truth_m: Mapping[LogId, Float]) -> float | None:
    """Translation RMSE over all keyframes of all robots after one SE(3) alignment; None without ground truth."""
    logs = sorted(set(estimate_m) & set(truth_m))
    if not logs:
        return None
    source = np.concatenate([estimate_m[log] for log in logs])
    target = np.concatenate([truth_m[log] for log in logs])
    known = np.isfinite(target).all(axis=1)
    if not np.any(known):
        return None
    _, T = umeyama(source[known], target[known])
    moved = source[known] @ T[:3, :3].T + T[:3, 3]
    return float(np.sqrt(np.mean(np.sum((moved - target[known]) ** 2, axis=1))))


def first_poses_at(T_odom: Float, T_world_first: Float) -> Float:
    """Odometry (N, 4, 4) moved so that its first pose lies at a given one."""
    return np.asarray(T_world_first @ inverse(T_odom[0]) @ T_odom)
