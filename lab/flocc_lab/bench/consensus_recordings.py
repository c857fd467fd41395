"""Consensus (`flocc_agent.backend.consensus`) on recordings with labels and truth, beside a leader's solution.

`python -m flocc_lab.bench.consensus_recordings FILE.jrl... [--metric] [--wrong] [--contacts 50] [--loss 0.3]` prints a
row of Markdown for each file. In a contact each robot in turn does one step and tells each of its neighbours; a message
is lost with the given probability. The leader solves all closures at once; robots choose as in distributed mode, each
of its own log, the lower one of a pair of both logs, and take over with which weight and length a closure was chosen.
Without `--wrong` closures that are labelled as wrong are left out, and no robust solver is asked. "Above" is the cost
of what the robots own, over the least that one solver of all of it reaches. Bytes are those of `ToldPoses`.
"""

import argparse
import sys
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig, Solver
from flocc_agent.core.closure_choices import shared_of, used_closures
from flocc_agent.core.own_part import OwnedClosure
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, LoopClosure, PoseGraph
from flocc_lab.bench.consensus_sweeps import Sweeps
from flocc_lab.consensus_graphs import least_cost, whole_of
from flocc_launch.graph_files import GraphFile, read_graph_file
from flocc_launch.graph_files.graph_file import ate_m
from flocc_launch.graph_files.optimise import file_config, positions, prepared

WITHIN = 1.1
"""Of the leader's ATE: the issue's limit."""
HEAD = (
    "| recording | leader, m | wrong used | right lost | distributed: wrong used | right lost | within a tenth after "
    + "| MB | ended, m | above | MB | CPU s |\n"
    + "|---" * 12
    + "|\n"
)


@dataclass(frozen=True, slots=True)
class RecordingAgreed:
    """How a recording went.

    Attributes:
        ate_m: Joint ATE after each contact.
        bytes_at: Bytes told by then.
        above: Cost at the end over the least, less one.
        cpu_s: Of all robots and contacts.
    """

    ate_m: tuple[float, ...]
    bytes_at: tuple[int, ...]
    above: float
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


def chosen(graph: PoseGraph, config: BackendConfig) -> dict[LoopClosure, OwnedClosure]:
    """Closures that robots choose in distributed mode: by one log, and by two."""
    found: dict[LoopClosure, OwnedClosure] = {}
    groups = [{log} for log in graph.trajectories] + [set(pair) for pair in combinations(sorted(graph.trajectories), 2)]
    for logs in groups:
        closures = tuple(c for c in graph.closures if {c.query.log, c.match.log} <= logs)
        of_all = [c for c in closures if {c.query.log, c.match.log} == logs]
        if of_all:
            part = PoseGraph({log: graph.trajectories[log] for log in sorted(logs)}, closures)
            solution = solved(part, config)
            component = next((c for c in solution.components if logs <= set(c.logs)), None)
            T = {} if component is None else {log: component.T_map_keyframe[log] for log in logs}
            used = used_closures(closures, solution, T, of_all)
            found |= {each.closure: each for each in (shared_of(used)[1] if len(logs) > 1 else used)}
    return found


def agreed(
    file: GraphFile, owned: Mapping[LoopClosure, OwnedClosure], contacts: int, loss_ratio: float, seed: int
) -> RecordingAgreed:
    """Let robots agree on a recording with the closures that they chose."""
    graph = replace(file.graph, closures=tuple(c for c in file.graph.closures if c in owned))
    began = time.process_time()
    team = Sweeps(graph, file_config(None, Solver.LM, None), loss_ratio, seed, owned)
    least = least_cost(team.parts)
    errors: list[float] = []
    told: list[int] = []
    for _ in range(contacts):
        team.sweep()
        error_m = ate_m({log: T[:, :3, 3] for log, T in team.T.items()}, file.truth_m)
        if error_m is None:
            sys.exit("a recording without true positions")
        errors.append(error_m)
        told.append(team.payload_bytes)
    above = whole_of(team.parts).own_cost() / least - 1.0
    return RecordingAgreed(tuple(errors), tuple(told), above, time.process_time() - began)


def choice(file: GraphFile, used: Collection[LoopClosure]) -> str:
    """Wrong closures used and right ones lost, as two cells."""
    wrong = {c for k, c in enumerate(file.graph.closures) if k in file.outliers}
    return f"{len(wrong & set(used))} | {len(set(file.graph.closures) - wrong - set(used))}"


def row(path: Path, options: argparse.Namespace) -> str:
    """A row of Markdown."""
    file = prepared(read_graph_file(path), path, not options.metric, not options.wrong, None)
    config = file_config(None, None if options.wrong else Solver.LM, None)
    solution = solved(file.graph, config)
    leader_m = ate_m(positions(solution), file.truth_m) or 0.0
    leaders = used_of(file.graph, solution)
    used = chosen(file.graph, config)
    found = agreed(file, used, options.contacts, options.loss, options.seed)
    after = found.settled(WITHIN * leader_m)
    megabytes = "" if after is None else f"{found.bytes_at[after - 1] / 1e6:.2f}"
    return (
        f"| {path.stem} | {leader_m:.3f} | {choice(file, leaders)} | {choice(file, used)} "
        f"| {after or 'no'} | {megabytes} "
        f"| {found.ate_m[-1]:.3f} | {found.above:.2%} | {found.bytes_at[-1] / 1e6:.2f} | {found.cpu_s:.1f} |\n"
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
