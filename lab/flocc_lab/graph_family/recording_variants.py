"""Graphs drawn from recordings with labels and truth: real noise and real wrong closures, but nobody's own file.

Of a recording a seed takes some robots, a stretch of the way of each, a part of the right closures and a multiple of
the wrong ones; it changes the scale of some robots' odometry and what closures say of their errors, and leaves
closures metric or without unit. What is chosen on whole files can be held against that.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import inverse
from flocc_lab.graph_family.graphs import KnownGraph
from flocc_launch.graph_files.graph_file import GraphFile, unit_length
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

ROBOTS_MIN, KEYFRAMES_MIN = 2, 20
ALL_ROBOTS_PROBABILITY, WHOLE_WAY_PROBABILITY, ALL_CLOSURES_PROBABILITY = 0.6, 0.3, 0.4
STRETCH_MIN, CLOSURES_MIN = 0.4, 0.15
WRONG_TIMES = (0, 1, 1, 2, 3)
SCALE_OFF_PROBABILITY, SCALE_OFF_MAX = 0.2, 0.1
COVARIANCE_FACTORS = (1.0 / 9.0, 1.0, 1.0, 1.0, 9.0)


@dataclass(frozen=True, slots=True)
class RecordingVariant:
    """What a seed makes of the recordings.

    Attributes:
        seed: What everything follows from.
        recording: Which of the recordings.
        stretches: First keyframe of each robot's stretch, and the one after its last.
        closures_kept: Part of the right closures that are kept.
        wrong_times: How many times as many wrong closures as in the recording.
        scales: Measured over recorded length of each robot's odometry.
        covariance_factor: Stated over recorded covariance of closures.
        without_unit: Whether closures between robots have no length.
    """

    seed: int
    recording: int
    stretches: Mapping[LogId, tuple[int, int]]
    closures_kept: float
    wrong_times: int
    scales: Mapping[LogId, float]
    covariance_factor: float
    without_unit: bool


def drawn_variant(seed: int, files: Sequence[GraphFile]) -> RecordingVariant:
    """The variant that a seed names."""
    rng = np.random.default_rng([seed, 77])
    recording = int(rng.integers(len(files)))
    trajectories = files[recording].graph.trajectories
    robots = sorted(trajectories)
    if rng.random() > ALL_ROBOTS_PROBABILITY:
        count = int(rng.integers(ROBOTS_MIN, len(robots) + 1))
        robots = [robots[k] for k in sorted(rng.choice(len(robots), count, replace=False))]
    return RecordingVariant(
        seed=seed,
        recording=recording,
        stretches={log: _stretch(rng, len(trajectories[log])) for log in robots},
        closures_kept=_part(rng),
        wrong_times=int(rng.choice(WRONG_TIMES)),
        scales={log: _scale(rng) for log in robots},
        covariance_factor=float(rng.choice(COVARIANCE_FACTORS)),
        without_unit=bool(rng.random() < 0.5),
    )


def variant(seed: int, files: Sequence[GraphFile]) -> KnownGraph:
    """The graph that a seed makes of recordings with labels and whole true poses."""
    spec = drawn_variant(seed, files)
    rng, file = np.random.default_rng([seed, 78]), files[spec.recording]
    inside = [(k, c) for k, c in enumerate(file.graph.closures) if all(_is_in(spec, at) for at in (c.query, c.match))]
    right = [_changed(spec, c) for k, c in inside if k not in file.outliers and rng.random() < spec.closures_kept]
    recorded = [_changed(spec, c) for k, c in inside if k in file.outliers]
    wrong = recorded if spec.wrong_times else []
    for _ in range(1, spec.wrong_times):
        wrong = wrong + [_elsewhere(rng, spec, closure) for closure in recorded]
    mixed = [*right, *wrong]
    order = rng.permutation(len(mixed))
    trajectories = {log: _odometry(file.graph.trajectories[log], spec, log) for log in spec.stretches}
    truth = {log: file.T_truth[log][slice(*stretch)] for log, stretch in spec.stretches.items()}
    return KnownGraph(seed, 0, PoseGraph(trajectories, [mixed[k] for k in order]), truth, order < len(right))


def _stretch(rng: np.random.Generator, keyframes: int) -> tuple[int, int]:
    if rng.random() < WHOLE_WAY_PROBABILITY:
        return 0, keyframes
    count = min(max(int(keyframes * rng.uniform(STRETCH_MIN, 1.0)), KEYFRAMES_MIN), keyframes)
    first = int(rng.integers(keyframes - count + 1))
    return first, first + count


def _part(rng: np.random.Generator) -> float:
    if rng.random() < ALL_CLOSURES_PROBABILITY:
        return 1.0
    return math.exp(rng.uniform(math.log(CLOSURES_MIN), 0.0))


def _scale(rng: np.random.Generator) -> float:
    if rng.random() > SCALE_OFF_PROBABILITY:
        return 1.0
    return float(rng.uniform(1.0 - SCALE_OFF_MAX, 1.0 + SCALE_OFF_MAX))


def _odometry(trajectory: Trajectory, spec: RecordingVariant, log: LogId) -> Trajectory:
    first, end = spec.stretches[log]
    T = inverse(trajectory.T_odom_keyframe[first]) @ trajectory.T_odom_keyframe[first:end]
    T[:, :3, 3] *= spec.scales[log]
    covariances = trajectory.edge_covariances
    return Trajectory(T, None if covariances is None else covariances[first : end - 1])


def _is_in(spec: RecordingVariant, keyframe: KeyframeId) -> bool:
    first, end = spec.stretches.get(keyframe.log, (0, 0))
    return first <= keyframe.index < end


def _changed(spec: RecordingVariant, closure: LoopClosure) -> LoopClosure:
    """A closure with the variant's numbers of keyframes, covariance and unit."""
    query, match = (KeyframeId(at.log, at.index - spec.stretches[at.log][0]) for at in (closure.query, closure.match))
    covariance = None if closure.covariance is None else closure.covariance * spec.covariance_factor
    changed = replace(closure, query=query, match=match, covariance=covariance)
    return unit_length(changed) if spec.without_unit and query.log != match.log else changed


def _elsewhere(rng: np.random.Generator, spec: RecordingVariant, closure: LoopClosure) -> LoopClosure:
    """A wrong closure once more, between other keyframes of the same robots."""
    query, match = (
        KeyframeId(at.log, int(rng.integers(np.diff(spec.stretches[at.log])[0])))
        for at in (closure.query, closure.match)
    )
    return closure if query == match else replace(closure, query=query, match=match)
