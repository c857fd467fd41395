"""Solvers that a campaign compares: flocc's default, its neighbours, an oracle, and what others do."""

import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.initial import initial_poses
from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.problem import build
from flocc_agent.backend.screening import screen
from flocc_agent.config import BackendConfig, Solver
from flocc_agent.core.pose_graph import (
    ClosureState,
    Component,
    GraphSolution,
    OptimisationFailed,
    PoseGraph,
    components_of,
)
from flocc_lab.bench.solver_ratios import between_factors, gnc_with
from flocc_lab.graph_family.graphs import KnownGraph
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

EARLIER = """
import pickle, sys, time
from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
graph = pickle.load(sys.stdin.buffer)
began = time.process_time()
solution = optimise(graph, BackendConfig(weight_by_probability=False, covariances=False))
pickle.dump((solution, time.process_time() - began), sys.stdout.buffer)
"""
EARLIER_LIMIT_S = 600.0


class NoAnswer(Exception):
    """A method gave no solution for a graph; the message says why."""


@dataclass(frozen=True, slots=True, eq=False)
class MethodAnswer:
    """What a method makes of a graph.

    Attributes:
        T_map_keyframe: (N, 4, 4) of each log, in the frame of its component.
        groups: Logs that share a frame.
        used: (L,) whether each closure was used.
        warnings: Sentences.
        cpu_s: CPU time.
    """

    T_map_keyframe: Mapping[LogId, Float]
    groups: tuple[tuple[LogId, ...], ...]
    used: NDArray[np.bool_]
    warnings: tuple[str, ...]
    cpu_s: float


Method = Callable[[KnownGraph], MethodAnswer]


def settings(**changed: Any) -> BackendConfig:
    """The agent's defaults for measurements whose covariances are trusted, and what differs from them."""
    return BackendConfig(**{"weight_by_probability": False, "covariances": False, **changed})


def flocc(config: BackendConfig) -> Method:
    """The back end with a configuration."""

    def method(member: KnownGraph) -> MethodAnswer:
        began = time.process_time()
        solution = optimise(member.graph, config)
        return answer_of(solution, time.process_time() - began)

    return method


def answer_of(solution: GraphSolution | OptimisationFailed, cpu_s: float) -> MethodAnswer:
    """The back end's solution as an answer.

    Raises:
        NoAnswer: There is no solution.
    """
    if isinstance(solution, OptimisationFailed):
        raise NoAnswer(solution.reason)
    poses = {log: T for c in solution.components for log, T in c.T_map_keyframe.items()}
    used = np.array([c.state is ClosureState.USED for c in solution.closures], dtype=bool)
    return MethodAnswer(poses, tuple(c.logs for c in solution.components), used, tuple(solution.warnings), cpu_s)


def oracle(member: KnownGraph) -> MethodAnswer:
    """LM with the right closures alone, from the true poses."""
    graph = member.right_closures()
    logs = tuple(sorted(member.T_world_keyframe))
    truth = GraphSolution((Component(logs, member.T_world_keyframe, {}, {}),), ())
    began = time.process_time()
    answer = answer_of(optimise(graph, settings(solver=Solver.LM), truth), time.process_time() - began)
    used = member.is_right.copy()
    used[member.is_right] = answer.used
    return MethodAnswer(answer.T_map_keyframe, answer.groups, used, answer.warnings, answer.cpu_s)


def gtsam_gnc(member: KnownGraph) -> MethodAnswer:
    """GTSAM's `GncLMOptimizer` from the same start, lengths that are free put into the covariances."""
    graph, began = member.graph, time.process_time()
    excluded = screen(graph).excluded
    usable = {k: c for k, c in enumerate(graph.closures) if k not in excluded}
    used = np.zeros(len(graph.closures), dtype=bool)
    poses: dict[LogId, Float] = {}
    groups = components_of(list(graph.trajectories), list(usable.values()))
    for logs in groups:
        of_group = {k: c for k, c in usable.items() if c.query.log in logs}
        part = PoseGraph({log: graph.trajectories[log] for log in logs}, ())
        poses |= _gtsam_group(part, of_group, used)
    return MethodAnswer(poses, groups, used, (), time.process_time() - began)


def _gtsam_group(graph: PoseGraph, closures: Mapping[int, Any], used: NDArray[np.bool_]) -> dict[LogId, Float]:
    config = settings()
    T_start = initial_poses(graph.trajectories, closures, config.steepness, None).T_map_keyframe
    problem = build(graph.trajectories, closures, config)
    factors, values = between_factors(problem, T_start)
    odometry = [*range(problem.closure_rows.start), factors.size() - 1]
    try:
        found, weights = gnc_with(factors, values, odometry)
    except RuntimeError as error:
        raise NoAnswer(str(error).strip().splitlines()[0]) from error
    used[list(problem.closure_ids)] = weights[problem.closure_rows] > 0.5
    return {
        log: np.array([found.atPose3(problem.offsets[log] + k).matrix() for k in range(len(trajectory))])
        for log, trajectory in graph.trajectories.items()
    }


def earlier(source: Path) -> Method:
    """The default of another checkout, run by this interpreter in a process of its own."""
    paths = os.pathsep.join(str(source / name) for name in ("agent", "protocol", "launch"))

    def method(member: KnownGraph) -> MethodAnswer:
        done = subprocess.run(
            [sys.executable, "-c", EARLIER],
            input=pickle.dumps(member.graph),
            capture_output=True,
            env={**os.environ, "PYTHONPATH": paths},
            timeout=EARLIER_LIMIT_S,
            check=False,
        )
        if done.returncode:
            raise NoAnswer(done.stderr.decode(errors="replace").strip().splitlines()[-1])
        solution, cpu_s = pickle.loads(done.stdout)
        return answer_of(solution, cpu_s)

    return method


def methods(source: Path | None = None) -> dict[str, Method]:
    """Every method by its name."""
    out = {
        "flocc": flocc(settings()),
        "lm": flocc(settings(solver=Solver.LM)),
        "pcm+lm": flocc(settings(solver=Solver.LM, pairwise_consistency=True)),
        "gtsam-gnc": gtsam_gnc,
    }
    return {**out, "earlier": earlier(source)} if source is not None else out
