"""`python -m flocc_lab.bench.kimera_outdoor FOLDER`: the default back end and GTSAM's GNC on DPGO's measurements.

A folder of `robot*/measurements.csv`, as dpgo_ros writes them: six robots of Kimera-Multi outdoor, without truth, so
that what is compared is the truncated objective: squared residuals of odometry, and of each closure at most its bound.
Both begin at the same poses; CPU seconds are whole solves, screening and alignment included for the back end.
"""

import argparse
import csv
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from flocc_agent.backend.edges import residuals, state_of
from flocc_agent.backend.initial import initial_poses
from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.problem import Problem, build
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import GraphSolution, PoseGraph
from flocc_agent.geometry import R_from_q_wxyz, pose
from flocc_lab.bench.solver_ratios import between_factors, gnc_with
from flocc_launch.graph_files.graph_file import INDEX_BITS, Measurement, distinct, pose_graph
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

FIRST_LETTER = ord("a")
PROBABILITIES = (0.99, 0.9999)
"""Bounds of the truncation: GTSAM's default and the back end's."""
HEAD = "| | closures used | objective, truncated at 99 % | at 99.99 % | CPU s |\n" + "|---" * 5 + "|\n"


@dataclass(frozen=True, slots=True, eq=False)
class OutdoorAnswer:
    """What one solver made of the graph: poses by log, closures used, CPU seconds."""

    name: str
    T_map_keyframe: dict[LogId, Float]
    used: int
    cpu_s: float


def read(folder: Path) -> PoseGraph:
    """The pose graph of all robots; what two of them list counts once."""
    files = sorted(folder.glob("robot*/measurements.csv"))
    if not files:
        sys.exit(f"{folder}: no robot*/measurements.csv")
    measurements = [m for path in files for m in _measurements(path)]
    return pose_graph(distinct(measurements, add_up=False), str(folder))


def _measurements(path: Path) -> Iterable[Measurement]:
    """Lines of one file; `kappa` and `tau` are information of rotation (1/rad^2) and translation (1/m^2)."""
    with path.open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            first, second = (
                ((FIRST_LETTER + int(row[f"robot_{end}"])) << INDEX_BITS) + int(row[f"pose_{end}"])
                for end in ("src", "dst")
            )
            q = np.array([float(row[name]) for name in ("qw", "qx", "qy", "qz")])
            t = np.array([float(row[name]) for name in ("tx", "ty", "tz")])
            variances = [1.0 / float(row["kappa"])] * 3 + [1.0 / float(row["tau"])] * 3
            yield Measurement(first, second, pose(R_from_q_wxyz(q), t), np.diag(variances))


def ours(graph: PoseGraph, config: BackendConfig) -> OutdoorAnswer:
    """The default back end."""
    began = time.process_time()
    solution = optimise(graph, config)
    cpu_s = time.process_time() - began
    if not isinstance(solution, GraphSolution) or len(solution.components) != 1:
        sys.exit("the back end did not bring all robots into one frame")
    used = sum(c.state.value == "used" for c in solution.closures)
    return OutdoorAnswer("flocc", dict(solution.components[0].T_map_keyframe), used, cpu_s)


def gtsam_gnc(graph: PoseGraph, config: BackendConfig) -> OutdoorAnswer:
    """GTSAM's GNC from the poses that the back end begins with; only its optimiser is timed."""
    closures = dict(enumerate(graph.closures))
    T_start = initial_poses(graph.trajectories, closures, config.steepness, None).T_map_keyframe
    problem = build(graph.trajectories, closures, config)
    factors, values = between_factors(problem, T_start)
    began = time.process_time()
    found, weights = gnc_with(factors, values, [*range(problem.closure_rows.start), factors.size() - 1])
    cpu_s = time.process_time() - began
    used = int(np.count_nonzero(weights[problem.closure_rows] > 0.5))
    return OutdoorAnswer("GTSAM's `GncLMOptimizer`", problem.by_log(_poses(found, problem)), used, cpu_s)


def _poses(values: gtsam.Values, problem: Problem) -> Float:
    return np.array([values.atPose3(n).matrix() for n in range(problem.poses)])


def truncated(problem: Problem, T_map_keyframe: dict[LogId, Float], probability: float) -> float:
    """Squared residuals of all edges, of closures at most what a right one has with this probability."""
    state = state_of(np.concatenate([T_map_keyframe[log] for log in problem.logs]))
    squared = residuals(problem.edges, state).squared()
    rows = problem.closure_rows
    squared[rows] = np.minimum(squared[rows], chdtri(6.0, 1.0 - probability))
    return float(np.sum(squared))


def main(words: list[str]) -> None:
    """Print a row per solver."""
    parser = argparse.ArgumentParser(prog="python -m flocc_lab.bench.kimera_outdoor", description=__doc__)
    parser.add_argument("folder", type=Path, help="where robot*/measurements.csv are")
    graph = read(parser.parse_args(words).folder)
    config = BackendConfig(weight_by_probability=False, covariances=False)
    problem = build(graph.trajectories, dict(enumerate(graph.closures)), config)
    sys.stdout.write(HEAD)
    for row in (ours(graph, config), gtsam_gnc(graph, config)):
        costs = " | ".join(f"{truncated(problem, row.T_map_keyframe, p):.1f}" for p in PROBABILITIES)
        sys.stdout.write(f"| {row.name} | {row.used} of {len(graph.closures)} | {costs} | {row.cpu_s:.2f} |\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
