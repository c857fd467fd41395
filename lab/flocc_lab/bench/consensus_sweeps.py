"""Consensus (`flocc_agent.backend.consensus`) on graphs of one robot that are cut among several, beside the optimum.

`python -m flocc_lab.bench.consensus_sweeps FILE... [--robots 5] [--sweeps 60] [--loss 0.3] [--seed 1]` prints a row of
Markdown for each g2o file. In a sweep each robot in turn does one step and tells each of its neighbours; a message is
lost with the given probability. Bytes are those of `ToldPoses`, which is what the other side reads.
"""

import argparse
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.alignment import align
from flocc_agent.backend.consensus import ConsensusPart
from flocc_agent.backend.consensus_pair import Tidings
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.own_part import OwnedClosure
from flocc_agent.core.pose_graph import LoopClosure, PoseGraph, Trajectory
from flocc_lab.consensus_graphs import part_of_graph, solved_alone
from flocc_lab.experiments.distributed import OPTIMA
from flocc_lab.rbcd.run import cut_by_time, graph_cost
from flocc_launch.graph_files import read_g2o
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

LIMITS = (1e-3, 1e-2, 2e-2)
TORUS_OPTIMUM = 24227.09


class Sweeps:
    """Robots that agree on one graph, and what they have told so far."""

    def __init__(
        self,
        graph: PoseGraph,
        config: BackendConfig,
        loss_ratio: float = 0.0,
        seed: int = 0,
        chosen: Mapping[LoopClosure, OwnedClosure] | None = None,
    ) -> None:
        self.parts = begun(graph, config, chosen or {})
        self.payload_bytes = 0
        self.refused = 0
        self.sweeps = 0
        self._loss_ratio = loss_ratio
        self._rng = np.random.default_rng(seed)

    @property
    def T(self) -> dict[LogId, Float]:
        """Poses of each robot."""
        return {log: part.T for log, part in self.parts.items()}

    def sweep(self) -> None:
        """Every robot does a step, one after the other, and tells its neighbours."""
        self.sweeps += 1
        for log, part in self.parts.items():
            part.step(self.sweeps)
            for other in part.neighbours:
                told = part.tell(other).told()
                self.payload_bytes += told.size_bytes
                if self._rng.random() >= self._loss_ratio:
                    count = len(part.neighbours[other].index)
                    try:
                        self.parts[other].hear(log, Tidings.of(told, count))
                    except ValueError:
                        self.refused += 1


def begun(
    graph: PoseGraph, config: BackendConfig, chosen: Mapping[LoopClosure, OwnedClosure]
) -> dict[LogId, ConsensusPart]:
    """Each robot solved alone, then placed in the frame of the lowest by the closures between them."""
    T_odom = {log: np.asarray(t.T_odom_keyframe, dtype=float) for log, t in sorted(graph.trajectories.items())}
    T_alone = {log: solved_alone(part_of_graph(graph, log, config, T, chosen)) for log, T in T_odom.items()}
    moved = {log: Trajectory(T, graph.trajectories[log].edge_covariances) for log, T in T_alone.items()}
    T_map_odom, _ = align(moved, dict(enumerate(graph.closures)), config.steepness)
    return {log: part_of_graph(graph, log, config, T_map_odom[log] @ T, chosen) for log, T in T_alone.items()}


@dataclass(frozen=True, slots=True)
class SweepsVerdict:
    """How a set went.

    Attributes:
        shared: Poses that pairs share, of all pairs.
        above: Cost over the optimum, less one, after each sweep.
        bytes_at: Bytes told by then.
        cpu_s: Of all robots and sweeps.
    """

    shared: int
    above: tuple[float, ...]
    bytes_at: tuple[int, ...]
    cpu_s: float

    def first_within(self, limit: float) -> int | None:
        """After how many sweeps the cost is within the limit; None where it never is."""
        return next((k + 1 for k, above in enumerate(self.above) if above <= limit), None)


def judge(graph: PoseGraph, optimum: float, sweeps: int, loss_ratio: float = 0.0, seed: int = 0) -> SweepsVerdict:
    """Run a metric graph until it is within a thousandth of the optimum, or for so many sweeps."""
    config = BackendConfig(formulation=Formulation.BASE, solver=Solver.LM, weight_by_probability=False)
    began = time.process_time()
    team = Sweeps(graph, config, loss_ratio, seed)
    above: list[float] = []
    told: list[int] = []
    while len(above) < sweeps and (not above or above[-1] > LIMITS[0]):
        team.sweep()
        above.append(graph_cost(graph, team.T) / optimum - 1.0)
        told.append(team.payload_bytes)
    shared = sum(len(n.index) for part in team.parts.values() for n in part.neighbours.values()) // 2
    return SweepsVerdict(shared, tuple(above), tuple(told), time.process_time() - began)


def row(name: str, verdict: SweepsVerdict) -> str:
    """A row of Markdown."""
    firsts = " | ".join(str(verdict.first_within(limit) or "no") for limit in LIMITS)
    return (
        f"| {name} | {verdict.shared} | {firsts} | {len(verdict.above)}: {verdict.above[-1]:.2%} "
        f"| {verdict.bytes_at[-1] / 1e6:.2f} | {verdict.cpu_s:.1f} |"
    )


def parsed(words: list[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m flocc_lab.bench.consensus_sweeps", description=__doc__)
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE")
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--sweeps", type=int, default=60)
    parser.add_argument("--loss", type=float, default=0.0, help="share of messages that are lost")
    parser.add_argument("--seed", type=int, default=1, help="of the losses")
    return parser.parse_args(words)


def main() -> None:
    """Print a row for each file."""
    options = parsed(sys.argv[1:])
    known: Mapping[str, float] = {**OPTIMA, "torus3D": TORUS_OPTIMUM}
    lines = ["| set | shared poses | sweeps to 0.1 % | 1 % | 2 % | ended after | MB | CPU s |", "|---" * 8 + "|"]
    sys.stdout.write("\n".join(lines) + "\n")
    for path in options.files:
        graph = cut_by_time(read_g2o(path, isotropic=True).graph, options.robots)
        verdict = judge(graph, known[path.stem], options.sweeps, options.loss, options.seed)
        sys.stdout.write(row(path.stem, verdict) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
