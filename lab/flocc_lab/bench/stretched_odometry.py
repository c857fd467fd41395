"""`python -m flocc_lab.bench.stretched_odometry FILE...`: pose graphs whose robots measure lengths wrongly.

Each robot's odometry is stretched by 0.9, 0.95, 1.05 and 1.1 on its own, then all of them differently. The row's
reference is the same file with true lengths.
"""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from flocc_agent.backend.optimiser import optimise
from flocc_agent.core.pose_graph import GraphSolution, stretched
from flocc_launch.graph_files import GraphFile, read_graph_file
from flocc_launch.graph_files.graph_file import ate_m
from flocc_launch.graph_files.optimise import file_config, positions
from flocc_protocol.ids import LogId

RATIOS = (0.9, 0.95, 1.05, 1.1)
ALL = (1.08, 0.94, 1.03, 0.9, 1.1, 0.97)


def with_stretched(file: GraphFile, ratios: Mapping[LogId, float]) -> GraphFile:
    """The file with the odometry of robots measured too long or too short."""
    trajectories = {log: stretched(t, ratios.get(log, 1.0)) for log, t in file.graph.trajectories.items()}
    return replace(file, graph=replace(file.graph, trajectories=trajectories))


def cases(logs: list[LogId]) -> Iterator[tuple[str, dict[LogId, float]]]:
    """Names of what is done to the robots, and each one's ratio."""
    yield "true", {}
    for ratio in RATIOS:
        for log in logs:
            yield f"{log} {ratio:g}", {log: ratio}
    yield "all", dict(zip(logs, ALL, strict=False))


def solved(file: GraphFile) -> tuple[float, GraphSolution]:
    """Joint ATE in metres with the agent's defaults, and the solution."""
    solution = optimise(file.graph, file_config(None, None, None).model_copy(update={"covariances": False}))
    assert isinstance(solution, GraphSolution)
    error_m = ate_m(positions(solution), file.truth_m)
    assert error_m is not None
    return error_m, solution


def applied(solution: GraphSolution) -> str:
    """The scales that a solution applied."""
    scales = {log: s for c in solution.components for log, s in c.odometry_scales.items() if s.is_applied}
    return ", ".join(f"{log} {s.ratio:.4f}" for log, s in sorted(scales.items())) or "none"


def main(paths: list[str]) -> None:
    """Print a table per file, unit scale between robots and metric closures."""
    for path in paths:
        metric = read_graph_file(Path(path))
        for name, file in (("unit scale", metric.with_unit_scale()), ("metric", metric)):
            sys.stdout.write(f"\n{Path(path).stem}, {name}\n\n| odometry | ATE m | applied |\n|---|---|---|\n")
            for case, ratios in cases(sorted(file.graph.trajectories)):
                error_m, solution = solved(with_stretched(file, ratios))
                sys.stdout.write(f"| {case} | {error_m:.3f} | {applied(solution)} |\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
