"""Generated pose graphs with ground truth: robots that cross one another's ways, drift, and close loops up to scale.

For benchmarks, tables and tests of the back end; no images. Everything is drawn from the generator that is passed.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flocc_agent.core.pose_graph import LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import inverse, pose, se3_exp, so3_exp
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]

KEYFRAME_SPACING_M = 1.0
AREA_PER_KEYFRAME_M2 = 6.0
CLOSURE_RANGE_M = 6.0
CLOSURE_DISTANCE_MIN_M = 0.3
OWN_KEYFRAMES_APART_MIN = 100
"""A robot alone closes loops with keyframes that are so many back."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of what is generated.

    Attributes:
        odometry: Rotation rad and translation m of one edge.
        closure: Rotation rad and translation m of one closure.
        scale_place_ratio: Spread of the network's scale between places (log).
        scale_own_ratio: Spread of it between closures of one place (log).
        scale_initial_ratio: Error of the initial scale, Eq. (6) (log).
    """

    odometry: tuple[float, float] = (0.003, 0.02)
    closure: tuple[float, float] = (0.03, 0.1)
    scale_place_ratio: float = 0.3
    scale_own_ratio: float = 0.05
    scale_initial_ratio: float = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class GeneratedGraph:
    """A pose graph, the true poses (N, 4, 4) of each log, and which closures are right."""

    graph: PoseGraph
    T_world_keyframe: Mapping[LogId, Float]
    is_right: NDArray[np.bool_]

    def truth_m(self) -> dict[LogId, Float]:
        """True positions (N, 3) of each log."""
        return {log: T[:, :3, 3] for log, T in self.T_world_keyframe.items()}


def generate(
    rng: np.random.Generator,
    robots: int = 6,
    keyframes: int = 500,
    closures: int = 5000,
    outlier_ratio: float = 0.0,
    scale_known: bool = True,
    noise: Noise | None = None,
) -> GeneratedGraph:
    """Draw a graph of so many robots, keyframes per robot and closures between robots.

    Args:
        rng: Source of all chance.
        robots: Number of robots; one alone closes loops with itself.
        keyframes: Keyframes of each robot, one metre apart.
        closures: Wanted number; fewer where the robots do not come near enough to one another.
        outlier_ratio: Part of the closures that is wrong: a pose that has nothing to do with the keyframes.
        scale_known: Whether closures carry an initial scale.
        noise: How far measurements are off.
    """
    noise = noise or Noise()
    side_m = float(np.sqrt(AREA_PER_KEYFRAME_M2 * robots * keyframes))
    logs = [LogId(f"r{k:02d}") for k in range(robots)]
    truth = {log: wander(rng, keyframes, side_m) for log in logs}
    trajectories = {
        log: Trajectory(drifting(rng, T, noise.odometry), _covariances(T, noise)) for log, T in truth.items()
    }
    pairs = meetings(rng, [truth[log] for log in logs], closures)
    is_right = rng.random(len(pairs)) >= outlier_ratio
    places = _scale_field(rng, side_m)
    measured = [
        _closure(rng, logs, truth, (int(a), int(b)), keyframes, bool(right), scale_known, noise, places)
        for (a, b), right in zip(pairs, is_right, strict=True)
    ]
    return GeneratedGraph(PoseGraph(trajectories, measured), truth, is_right)


def wander(rng: np.random.Generator, keyframes: int, side_m: float) -> Float:
    """A smooth walk (N, 4, 4) through a square, turned back at its edge; x forward, z up."""
    position = np.append(rng.uniform(-side_m / 3, side_m / 3, 2), 0.0)
    heading, turn = rng.uniform(-np.pi, np.pi), 0.0
    T = np.empty((keyframes, 4, 4))
    for k in range(keyframes):
        turn = 0.9 * turn + rng.normal(0.0, 0.03)
        if np.max(np.abs(position[:2])) > side_m / 2.5:
            inward = np.arctan2(-position[1], -position[0])
            turn += 0.2 * float(np.sin(inward - heading))
        heading += np.clip(turn, -0.3, 0.3)
        position = position + KEYFRAME_SPACING_M * np.array([np.cos(heading), np.sin(heading), rng.normal(0.0, 0.02)])
        T[k] = pose(so3_exp(np.array([0.0, 0.0, heading])), position)
    return T


def drifting(rng: np.random.Generator, T: Float, sigma: tuple[float, float]) -> Float:
    """Odometry (N, 4, 4) of true poses: noisy steps, put together from the identity on."""
    steps = inverse(T[:-1]) @ T[1:]
    out = np.empty_like(T)
    out[0] = np.eye(4)
    for k, xi in enumerate(tangent_noise(rng, len(steps), sigma)):
        out[k + 1] = out[k] @ steps[k] @ se3_exp(xi)
    return out


def tangent_noise(rng: np.random.Generator, count: int, sigma: tuple[float, float]) -> Float:
    """Normal tangent vectors (N, 6), rotation first."""
    return np.asarray(rng.normal(size=(count, 6)) * np.repeat(sigma, 3))


def meetings(rng: np.random.Generator, truth: list[Float], count: int) -> Int:
    """Pairs (M, 2) of global keyframe numbers of different robots that come near, drawn without repetition.

    Of one robot alone they are keyframes of its own.
    """
    points = np.concatenate([T[:, :3, 3] for T in truth])
    robot = np.repeat(np.arange(len(truth)), [len(T) for T in truth])
    near = cKDTree(points).query_pairs(CLOSURE_RANGE_M, output_type="ndarray")
    apart = np.linalg.norm(points[near[:, 0]] - points[near[:, 1]], axis=1) > CLOSURE_DISTANCE_MIN_M
    others = robot[near[:, 0]] != robot[near[:, 1]]
    again = np.abs(near[:, 0] - near[:, 1]) >= OWN_KEYFRAMES_APART_MIN
    near = near[apart & (others if len(truth) > 1 else again)]
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    chosen = rng.choice(len(near), size=min(count, len(near)), replace=False)
    return np.asarray(near[np.sort(chosen)], dtype=np.int64)


def _covariances(T: Float, noise: Noise) -> Float:
    return np.broadcast_to(_covariance(noise.odometry), (len(T) - 1, 6, 6)).copy()


def _covariance(sigma: tuple[float, float]) -> Float:
    return np.diag(np.repeat(np.square(sigma), 3))


def _scale_field(rng: np.random.Generator, side_m: float) -> Float:
    """Waves (4, 3) whose sum is a smooth field over the plane: wave numbers, phase."""
    return np.column_stack([rng.normal(0.0, 4.0 / side_m, (4, 2)), rng.uniform(0.0, 2 * np.pi, 4)])


def _closure(
    rng: np.random.Generator,
    logs: list[LogId],
    truth: Mapping[LogId, Float],
    pair: tuple[int, int],
    keyframes: int,
    right: bool,
    scale_known: bool,
    noise: Noise,
    places: Float,
) -> LoopClosure:
    """One registered pair: the true pose with noise, or a pose that has nothing to do with it, in network units."""
    query, match = (KeyframeId(logs[n // keyframes], n % keyframes) for n in pair)
    T_query, T_match = truth[query.log][query.index], truth[match.log][match.index]
    T = inverse(T_query) @ T_match @ se3_exp(tangent_noise(rng, 1, noise.closure)[0])
    if not right:
        yaw = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
        T = pose(so3_exp(yaw + rng.normal(0.0, 0.05, 3)), rng.normal(0.0, 4.0, 3) * np.array([1.0, 1.0, 0.1]))
    waves = np.sin(places[:, :2] @ T_query[:2, 3] * 2 * np.pi + places[:, 2])
    metres_per_unit = np.exp(noise.scale_place_ratio * waves.mean() * 2 + rng.normal(0.0, noise.scale_own_ratio))
    T[:3, 3] /= metres_per_unit
    guess = float(metres_per_unit * np.exp(rng.normal(0.0, noise.scale_initial_ratio)))
    covariance = _covariance((noise.closure[0], noise.closure[1] / metres_per_unit))
    return LoopClosure(query, match, T, 1.0, guess if scale_known else None, covariance)
