"""Consensus (`flocc_agent.backend.consensus`) on recordings with labels and truth, beside a leader's solution.

`python -m flocc_lab.bench.consensus_recordings FILE.jrl... [--metric] [--wrong] [--contacts 50] [--loss 0.3]` prints a
row of Markdown for each file. In a contact each robot in turn does one step and tells each of its neighbours; a message
is lost with the given probability. Without `--wrong` closures that are labelled as wrong are left out and all
others used, by both. With it the leader solves all closures at once, and robots choose as in distributed mode: each of
its own log, the lower one of a pair of both logs. Bytes are those of `ToldPoses`.
"""

import argparse
import sys
import time
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig, Solver
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, LoopClosure, PoseGraph
from flocc_lab.bench.consensus_sweeps import Sweeps
from flocc_launch.graph_files import GraphFile, read_graph_file
from flocc_launch.graph_files.graph_file import ate_m
from flocc_launch.graph_files.optimise import file_config, positions, prepared

WITHIN = 1.1
"""Of the leader's ATE: the issue's limit."""
HEAD = (
    "| recording | leader, m | wrong used | right lost | distributed: wrong used | right lost | within a tenth after "
    + "| MB | ended, m | MB | CPU s |\n"
    + "|---" * 11
    + "|\n"
)


@dataclass(frozen=True, slots=True)
class RecordingAgreed:
    """How a recording went.

    Attributes:
        ate_m: Joint ATE after each contact.
        bytes_at: Bytes told by then.
        cpu_s: Of all robots and contacts.
    """

    ate_m: tuple[float, ...]
    bytes_at: tuple[int, ...]
    cpu_s: float

    def settled(self, limit_m: float) -> int | None:
        """After how many contacts the ATE is within a limit and stays there; None where it never is."""
        beyond = max((k + 1 for k, error in enumerate(self.ate_m) if error > limit_m), default=0)
        return beyond + 1 if beyond < len(self.ate_m) else None


def solved(graph: PoseGraph, config: BackendConfig) -> GraphSolution:
    """The solution of a graph."""
    solution = optimise(graph, config)
    if not isinstance(solution, GraphSolution):
        sys.exit(solution.reason)
    return solution


def used_of(graph: PoseGraph, solution: GraphSolution) -> set[LoopClosure]:
    """Closures that a solution uses."""
    pairs = zip(graph.closures, solution.closures, strict=True)
    return {closure for closure, result in pairs if result.state is ClosureState.USED}


def chosen(graph: PoseGraph, config: BackendConfig) -> set[LoopClosure]:
    """Closures that robots choose in distributed mode: by one log, and by two."""
    found: set[LoopClosure] = set()
    groups = [{log} for log in graph.trajectories] + [set(pair) for pair in combinations(sorted(graph.trajectories), 2)]
    for logs in groups:
        closures = tuple(c for c in graph.closures if {c.query.log, c.match.log} <= logs)
        if any({c.query.log, c.match.log} == logs for c in closures):
            part = PoseGraph({log: graph.trajectories[log] for log in sorted(logs)}, closures)
            found |= {c for c in used_of(part, solved(part, config)) if {c.query.log, c.match.log} == logs}
    return found


def agreed(file: GraphFile, used: set[LoopClosure], contacts: int, loss_ratio: float, seed: int) -> RecordingAgreed:
    """Let robots agree on a recording with the closures that are used."""
    graph = replace(file.graph, closures=tuple(c for c in file.graph.closures if c in used))
    began = time.process_time()
    team = Sweeps(graph, file_config(None, Solver.LM, None), loss_ratio, seed)
    errors: list[float] = []
    told: list[int] = []
    for _ in range(contacts):
        team.sweep()
        error_m = ate_m({log: T[:, :3, 3] for log, T in team.T.items()}, file.truth_m)
        if error_m is None:
            sys.exit("a recording without true positions")
        errors.append(error_m)
        told.append(team.payload_bytes)
    return RecordingAgreed(tuple(errors), tuple(told), time.process_time() - began)


def choice(file: GraphFile, used: set[LoopClosure]) -> str:
    """Wrong closures used and right ones lost, as two cells."""
    wrong = {c for k, c in enumerate(file.graph.closures) if k in file.outliers}
    return f"{len(used & wrong)} | {len(set(file.graph.closures) - wrong - used)}"


def row(path: Path, options: argparse.Namespace) -> str:
    """A row of Markdown."""
    file = prepared(read_graph_file(path), path, not options.metric, not options.wrong, None)
    config = file_config(None, None if options.wrong else Solver.LM, None)
    solution = solved(file.graph, config)
    leader_m = ate_m(positions(solution), file.truth_m) or 0.0
    leaders = used_of(file.graph, solution)
    used = chosen(file.graph, config) if options.wrong else leaders
    found = agreed(file, used, options.contacts, options.loss, options.seed)
    after = found.settled(WITHIN * leader_m)
    megabytes = "" if after is None else f"{found.bytes_at[after - 1] / 1e6:.2f}"
    return (
        f"| {path.stem} | {leader_m:.3f} | {choice(file, leaders)} | {choice(file, used)} "
        f"| {after or 'no'} | {megabytes} "
        f"| {found.ate_m[-1]:.3f} | {found.bytes_at[-1] / 1e6:.2f} | {found.cpu_s:.1f} |\n"
    )


def parsed(words: list[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m flocc_lab.bench.consensus_recordings", description=__doc__)
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE")
    parser.add_argument("--metric", action="store_true", help="translations between robots keep their length")
    parser.add_argument("--wrong", action="store_true", help="closures that are labelled as wrong stay in")
    parser.add_argument("--contacts", type=int, default=50)
    parser.add_argument("--loss", type=float, default=0.0, help="share of messages that are lost")
    parser.add_argument("--seed", type=int, default=1, help="of the losses")
    return parser.parse_args(words)


def main(words: list[str]) -> None:
    """Print a row for each file."""
    options = parsed(words)
    sys.stdout.write(HEAD)
    for path in options.files:
        sys.stdout.write(row(path, options))
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
