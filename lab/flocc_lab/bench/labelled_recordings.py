"""`python -m flocc_lab.bench.labelled_recordings FILE...`: the default back end on recordings with labels and truth.

Each file as it is and with unit scale: joint ATE beside that of LM without the closures that are labelled as wrong, the
choice of closures, linear systems solved (which do not depend on the machine), and CPU seconds of the solve alone.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np

from flocc_agent.backend.linear import LinearSolver
from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig, Solver
from flocc_agent.core.pose_graph import ClosureState, GraphSolution
from flocc_launch.graph_files import GraphFile, read_graph_file
from flocc_launch.graph_files.graph_file import ate_m
from flocc_launch.graph_files.optimise import file_config, positions, prepared

HEAD = (
    "| recording | reference, m | default, m | ratio | closures used | wrong used | right lost | systems | CPU s |\n"
    + "|---" * 9
    + "|\n"
)


@dataclass(frozen=True, slots=True)
class RecordingAnswer:
    """What came out of one recording.

    Attributes:
        ate_m: Joint ATE.
        used: Closures used.
        wrong_used: Of those that the file labels as wrong.
        right_lost: Others that are not used.
        systems: Linear systems solved.
        cpu_s: CPU seconds of the solve.
    """

    ate_m: float
    used: int
    wrong_used: int
    right_lost: int
    systems: int
    cpu_s: float


@contextmanager
def counted_systems() -> Iterator[list[int]]:
    """The number of linear systems that are solved meanwhile, as the list's only entry."""
    step, count = LinearSolver.step, [0]

    def counting(self: LinearSolver, *words: object, **named: object) -> object:
        count[0] += 1
        return step(self, *words, **named)  # type: ignore[arg-type]

    with mock.patch.object(LinearSolver, "step", counting):
        yield count


def answered(file: GraphFile, outliers: frozenset[int], config: BackendConfig) -> RecordingAnswer:
    """Solve a file; `outliers` are the closures of it that are labelled as wrong."""
    began = time.process_time()
    with counted_systems() as systems:
        solution = optimise(file.graph, config)
    cpu_s = time.process_time() - began
    if not isinstance(solution, GraphSolution):
        sys.exit(solution.reason)
    error_m = ate_m(positions(solution), file.truth_m)
    if error_m is None:
        sys.exit("a recording without true positions")
    states = [closure.state is ClosureState.USED for closure in solution.closures]
    lost = sum(not used for k, used in enumerate(states) if k not in outliers)
    return RecordingAnswer(error_m, sum(states), sum(states[k] for k in outliers), lost, systems[0], cpu_s)


def main(words: list[str]) -> None:
    """Print a row per recording and scale, and the geometric mean of the ratios of each scale."""
    parser = argparse.ArgumentParser(prog="python -m flocc_lab.bench.labelled_recordings", description=__doc__)
    parser.add_argument("files", nargs="+", type=Path, help="JRL files with labels and true poses")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="the back end so changed")
    options = parser.parse_args(words)
    changed = dict(pair.split("=", 1) for pair in options.set)
    config = BackendConfig(**{**file_config(None, None, None).model_dump(), **changed})
    ratios: dict[str, list[float]] = {"metric": [], "unit scale": []}
    sys.stdout.write(HEAD)
    for path in options.files:
        file = read_graph_file(path)
        for name in ratios:
            unit = name == "unit scale"
            of_reference = prepared(file, path, unit, True, None)
            reference = answered(of_reference, frozenset(), file_config(None, Solver.LM, None))
            default = answered(prepared(file, path, unit, False, None), frozenset(file.outliers), config)
            ratios[name].append(default.ate_m / reference.ate_m)
            sys.stdout.write(
                f"| {path.stem}, {name} | {reference.ate_m:.2f} | {default.ate_m:.2f} | {ratios[name][-1]:.2f} "
                f"| {default.used} | {default.wrong_used} | {default.right_lost} | {default.systems} "
                f"| {default.cpu_s:.1f} |\n"
            )
            sys.stdout.flush()
    means = (f"{name} {np.exp(np.mean(np.log(found))):.3f}" for name, found in ratios.items())
    sys.stdout.write(f"\nratio, geometric mean: {', '.join(means)}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
