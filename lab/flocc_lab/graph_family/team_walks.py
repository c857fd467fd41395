"""Graphs of teams by the published protocol for distributed back ends (iMESA, arXiv 2406.07371; riMESA, 2603.01178).

Every step of a robot is a metre forward or a turn of 90 degrees about one of its axes, and a keyframe. What the papers
as we know them leave open is a field of `TeamSpec` or a constant here, with its reason.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import inverse, se3_exp, so3_exp
from flocc_launch.graph_files.graph_file import unit_length
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Pair = tuple[KeyframeId, KeyframeId]

TEAM_SIZES = (3, 6, 12, 24, 48)
TEAM_POSES = 500
STEP_M, TURN_RAD = 1.0, np.pi / 2
TURN_PROBABILITY = 2 / 3
"""Not published as far as we know: forward, a turn to one side and one to the other are equally likely. Chosen beside
1/3 and 1/2 on two graphs, because the central solve comes out as published with it (docs/experiments.md)."""
PRIOR_SIGMA = (np.deg2rad(0.1), 0.01)
STEP_SIGMA = (np.deg2rad(1.0), 0.05)
TEAM_CLOSURE_SIGMA = (np.deg2rad(1.0), 0.1)
"""Standard deviations: rotation rad, translation m."""
OWN_RANGE_M, OWN_PROBABILITY = 2.0, 0.4
OWN_APART_STEPS = 10
"""Not published: a closure with a pose just left would be odometry once more."""
BETWEEN_STEPS, BETWEEN_RANGE_M = 5, 30.0
STARTS_SIDE_M = 20.0
"""Not published: robots begin in a cube of this side, so that nearly all are within range of each other."""
FALSE_SIGMA_M = 10.0


@dataclass(frozen=True, slots=True)
class TeamSpec:
    """One draw of the protocol.

    Attributes:
        seed: What everything follows from.
        robots: Number of robots.
        poses: Keyframes of each.
        outlier_ratio: Part of closures that measure something else.
        all_pairs: Whether every fifth step every two robots in range measure each other; else each robot one other.
            As read, the protocol says nothing of a choice.
    """

    seed: int
    robots: int
    poses: int = TEAM_POSES
    outlier_ratio: float = 0.0
    all_pairs: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class TeamGraph:
    """What a team measured.

    Attributes:
        spec: What was drawn.
        graph: Odometry from the identity on, and all closures, metric, in the order of their later keyframes.
        T_world_keyframe: (N, 4, 4) true poses of each log.
        T_world_odom: (4, 4) where each robot believes to have begun: the prior on its first pose.
        is_right: (L,) which closures are right.
    """

    spec: TeamSpec
    graph: PoseGraph
    T_world_keyframe: Mapping[LogId, Float]
    T_world_odom: Mapping[LogId, Float]
    is_right: NDArray[np.bool_]

    def until(self, poses: int) -> "TeamGraph":
        """The same after each robot's first so many keyframes."""
        cut = {log: _begun(trajectory, poses) for log, trajectory in self.graph.trajectories.items()}
        known = np.array([max(c.query.index, c.match.index) < poses for c in self.graph.closures], dtype=bool)
        closures = [c for c, now in zip(self.graph.closures, known, strict=True) if now]
        truth = {log: T[:poses] for log, T in self.T_world_keyframe.items()}
        return replace(self, graph=PoseGraph(cut, closures), T_world_keyframe=truth, is_right=self.is_right[known])

    def alone(self) -> "TeamGraph":
        """The same without closures between robots."""
        own = np.array([c.query.log == c.match.log for c in self.graph.closures], dtype=bool)
        closures = [c for c, mine in zip(self.graph.closures, own, strict=True) if mine]
        return replace(self, graph=PoseGraph(self.graph.trajectories, closures), is_right=self.is_right[own])

    def without_lengths(self) -> "TeamGraph":
        """The same measurements, of closures between robots the direction only; those of one robot stay metric."""
        closures = [c if c.query.log == c.match.log else unit_length(c) for c in self.graph.closures]
        return replace(self, graph=PoseGraph(self.graph.trajectories, closures))


def team_graph(spec: TeamSpec) -> TeamGraph:
    """A team by its description."""
    rng = np.random.default_rng([spec.seed, spec.robots, 22])
    logs = [LogId(f"r{k:02d}") for k in range(spec.robots)]
    truth = {log: _walk(rng, spec.poses) for log in logs}
    prior = {log: T[0] @ se3_exp(rng.normal(size=6) * np.repeat(PRIOR_SIGMA, 3)) for log, T in truth.items()}
    trajectories = {log: _odometry(rng, T) for log, T in truth.items()}
    pairs = [*_own_pairs(rng, truth), *_pairs_between(rng, truth, spec.all_pairs)]
    pairs.sort(key=lambda pair: (max(pair[0].index, pair[1].index), pair))
    is_right = rng.random(len(pairs)) >= spec.outlier_ratio
    closures = [_measured(rng, truth, pair, right) for pair, right in zip(pairs, is_right.tolist(), strict=True)]
    return TeamGraph(spec, PoseGraph(trajectories, closures), truth, prior, is_right)


def _begun(trajectory: Trajectory, poses: int) -> Trajectory:
    covariances = trajectory.edge_covariances
    return Trajectory(trajectory.T_odom_keyframe[:poses], None if covariances is None else covariances[: poses - 1])


def _walk(rng: np.random.Generator, poses: int) -> Float:
    """True poses: metres forward (x), and quarter turns to either side about x, y or z, from a start in the cube."""
    turns = rng.random(poses - 1) < TURN_PROBABILITY
    axes = rng.integers(3, size=poses - 1)
    sides = rng.choice([-1.0, 1.0], size=poses - 1)
    T = np.tile(np.eye(4), (poses, 1, 1))
    T[0, :3, 3] = rng.uniform(-STARTS_SIDE_M / 2, STARTS_SIDE_M / 2, 3)
    for k in range(poses - 1):
        step = np.eye(4)
        if turns[k]:
            step[:3, :3] = np.round(so3_exp(sides[k] * TURN_RAD * np.eye(3)[axes[k]]))
        else:
            step[0, 3] = STEP_M
        T[k + 1] = T[k] @ step
    return T


def _odometry(rng: np.random.Generator, T: Float) -> Trajectory:
    """What a robot measures of its own steps, from the identity on."""
    steps = inverse(T[:-1]) @ T[1:]
    out = np.tile(np.eye(4), (len(T), 1, 1))
    for k, xi in enumerate(rng.normal(size=(len(steps), 6)) * np.repeat(STEP_SIGMA, 3)):
        out[k + 1] = out[k] @ steps[k] @ se3_exp(xi)
    covariance = np.diag(np.repeat(np.square(STEP_SIGMA), 3))
    return Trajectory(out, np.broadcast_to(covariance, (len(steps), 6, 6)).copy())


def _own_pairs(rng: np.random.Generator, truth: Mapping[LogId, Float]) -> list[Pair]:
    """With its probability at each step one earlier pose in range, any of them."""
    pairs = []
    for log, T in truth.items():
        for k in range(OWN_APART_STEPS, len(T)):
            before = T[: k - OWN_APART_STEPS + 1, :3, 3]
            near = np.flatnonzero(np.linalg.norm(before - T[k, :3, 3], axis=1) <= OWN_RANGE_M)
            if len(near) and rng.random() < OWN_PROBABILITY:
                pairs.append((KeyframeId(log, k), KeyframeId(log, int(rng.choice(near)))))
    return pairs


def _pairs_between(rng: np.random.Generator, truth: Mapping[LogId, Float], all_pairs: bool) -> list[Pair]:
    """At every fifth step the robots in range of each robot: all, each pair once, or one of them."""
    logs, points = list(truth), np.stack([T[:, :3, 3] for T in truth.values()])
    pairs: list[Pair] = []
    for k in range(0, points.shape[1], BETWEEN_STEPS):
        met: set[tuple[int, int]] = set()
        for a in range(len(logs)):
            near = np.flatnonzero(np.linalg.norm(points[:, k] - points[a, k], axis=1) <= BETWEEN_RANGE_M)
            near = near[near != a]
            if len(near):
                met |= {(min(a, b), max(a, b)) for b in map(int, near if all_pairs else [rng.choice(near)])}
        pairs += [(KeyframeId(logs[a], k), KeyframeId(logs[b], k)) for a, b in sorted(met)]
    return pairs


def _measured(rng: np.random.Generator, truth: Mapping[LogId, Float], pair: Pair, right: bool) -> LoopClosure:
    """A closure with its noise; a wrong one measures any pose."""
    T_query, T_match = (truth[keyframe.log][keyframe.index] for keyframe in pair)
    noise = rng.normal(size=6) * np.repeat(TEAM_CLOSURE_SIGMA, 3)
    T = inverse(T_query) @ T_match @ se3_exp(noise)
    if not right:
        T = se3_exp(np.append(rng.uniform(-np.pi, np.pi, 3), rng.normal(0.0, FALSE_SIGMA_M, 3)))
    covariance = np.diag(np.repeat(np.square(TEAM_CLOSURE_SIGMA), 3))
    return LoopClosure(*pair, T, covariance=covariance, metric=True)
