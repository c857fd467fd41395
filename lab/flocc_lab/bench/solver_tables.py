"""Tables for docs/back-end-figures.md: outliers, growth with the number of closures, the scale task's time.

`python -m flocc_lab.bench.solver_tables outliers|growth|scale|lm [FILE]` prints one as Markdown.
"""

import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from flocc_agent.backend.descent import Objective
from flocc_agent.backend.edges import state_of
from flocc_agent.backend.initial import initial_poses
from flocc_agent.backend.linear import LinearSolver
from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.problem import build
from flocc_agent.backend.screening import screen
from flocc_agent.backend.solvers import solve
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import GraphSolution
from flocc_lab.bench.generated_graph import GeneratedGraph, generate
from flocc_lab.bench.solver_ratios import between_factors, gnc_with, gtsam_lm
from flocc_lab.bench.solver_sizes import peak_mb
from flocc_launch.graph_files import GraphFile, read_graph_file
from flocc_launch.graph_files.graph_file import ate_m
from flocc_launch.graph_files.optimise import positions

RATES = (0.0, 0.1, 0.3, 0.5)
GROWTH = (1000, 3000, 10000, 30000, 50000)
KEYFRAMES_PER_CLOSURE = 0.6
ROBOTS = 6
SEEDS = (1, 2, 3)


def outlier_table(robots: int = 3, keyframes: int = 150, closures: int = 300) -> str:
    """Median joint ATE over seeds, for every formulation, solver and rate of wrong closures."""
    graphs = {
        rate: [generate(np.random.default_rng(s), robots, keyframes, closures, outlier_ratio=rate) for s in SEEDS]
        for rate in RATES
    }
    lines = [
        "| formulation | solver | " + " | ".join(f"{rate:.0%}" for rate in RATES) + " |",
        "|---|---|---|---|---|---|",
    ]
    for formulation in Formulation:
        for solver in Solver:
            cells = [statistics.median(_ate(g, formulation, solver) for g in graphs[rate]) for rate in RATES]
            lines.append(f"| {formulation} | {solver} | " + " | ".join(f"{m:.2f}" for m in cells) + " |")
    return "\n".join(lines)


def _ate(generated: GeneratedGraph, formulation: Formulation, solver: Solver) -> float:
    config = BackendConfig(formulation=formulation, solver=solver, weight_by_probability=False, covariances=False)
    solution = optimise(generated.graph, config)
    assert isinstance(solution, GraphSolution)
    return ate_m(positions(solution), generated.truth_m()) or 0.0


def growth_row(closures: int) -> str:
    """Time and peak memory of one whole solve (smoothed, LM), in a process of its own."""
    keyframes = int(closures * KEYFRAMES_PER_CLOSURE / ROBOTS)
    generated = generate(np.random.default_rng(1), ROBOTS, keyframes, closures)
    before_mb = peak_mb()
    config = BackendConfig(
        formulation=Formulation.SMOOTHED, solver=Solver.LM, weight_by_probability=False, covariances=False
    )
    began, cpu = time.perf_counter(), time.process_time()
    solution = optimise(generated.graph, config)
    assert isinstance(solution, GraphSolution)
    cpu_s, wall_s = time.process_time() - cpu, time.perf_counter() - began
    found = len(generated.graph.closures)
    return (
        f"| {found} | {ROBOTS * keyframes} | {solution.iterations} | {wall_s:.2f} | {cpu_s:.2f} "
        f"| {1e6 * cpu_s / found:.0f} | {peak_mb():.0f} | {1e3 * (peak_mb() - before_mb) / found:.0f} |"
    )


def growth_table() -> str:
    """Rows of `growth_row` from 1,000 to 50,000 closures."""
    head = "| closures | keyframes | solves | wall s | CPU s | CPU us per closure | peak MB | kB per closure |"
    lines = [head, "|---|---|---|---|---|---|---|---|"]
    for closures in GROWTH:
        command = [sys.executable, "-m", "flocc_lab.bench.solver_tables", "growth-row", str(closures)]
        lines.append(subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip())
    return "\n".join(lines)


def scale_row(path: Path) -> str:
    """The scale task with outliers: the default against GTSAM's GNC on widened between factors, same start."""
    file = read_graph_file(path).with_unit_scale()
    config = BackendConfig(weight_by_probability=False, covariances=False)
    began, cpu = time.perf_counter(), time.process_time()
    solution = optimise(file.graph, config)
    ours_s, ours_cpu_s = time.perf_counter() - began, time.process_time() - cpu
    assert isinstance(solution, GraphSolution)
    began, cpu = time.perf_counter(), time.process_time()
    reference_m = _gtsam_scale_task(file, config)
    theirs_s, theirs_cpu_s = time.perf_counter() - began, time.process_time() - cpu
    return (
        f"| {path.stem} | {ate_m(positions(solution), file.truth_m):.3f} | {ours_s:.2f} | {reference_m:.3f} "
        f"| {theirs_s:.2f} | {ours_s / theirs_s:.3f} | {ours_cpu_s / theirs_cpu_s:.3f} |"
    )


def lm_row(path: Path, repeats: int = 3) -> str:
    """LM of one file, least CPU of some runs: GTSAM's on its own between factors, and ours; both from odometry.

    Both stop by GTSAM's rule, a relative decrease of 1e-5; the graph is built beforehand on both sides.
    """
    file = read_graph_file(path)
    config = BackendConfig(
        formulation=Formulation.BASE, solver=Solver.LM, weight_by_probability=False, covariances=False
    )
    excluded = screen(file.graph).excluded
    closures = {k: c for k, c in enumerate(file.graph.closures) if k not in excluded}
    T_start = initial_poses(file.graph.trajectories, closures, config.steepness, None).T_map_keyframe
    problem = build(file.graph.trajectories, closures, config)
    factors, values = between_factors(problem, T_start)
    state = state_of(np.concatenate([T_start[log] for log in problem.logs]))

    def ours() -> int:
        linear = LinearSolver(0, config.scale_prior_unknown_sigma_ratio)
        return solve(Objective(problem.edges, problem.closure_rows, linear, config), state).iterations

    theirs_s, ours_s = [], []
    for _ in range(repeats):
        began = time.process_time()
        their_steps = gtsam_lm(factors, values)
        between = time.process_time()
        our_steps = ours()
        theirs_s.append(between - began)
        ours_s.append(time.process_time() - between)
    return (
        f"| {path.stem} | {problem.poses} | {len(problem.edges)} | {1e3 * min(theirs_s):.0f} ({their_steps}) "
        f"| {1e3 * min(ours_s):.0f} ({our_steps}) | {min(ours_s) / min(theirs_s):.2f} |"
    )


def _gtsam_scale_task(file: GraphFile, config: BackendConfig) -> float:
    """ATE of GTSAM's GNC, where an independent scale is a between factor with a wider covariance."""
    graph = file.graph
    excluded = screen(graph).excluded
    closures = {k: c for k, c in enumerate(graph.closures) if k not in excluded}
    T_start = initial_poses(graph.trajectories, closures, config.steepness, None).T_map_keyframe
    problem = build(graph.trajectories, closures, config)
    factors, values = between_factors(problem, T_start)
    known = [*range(problem.closure_rows.start), factors.size() - 1]
    poses, _ = gnc_with(factors, values, known)
    found = {
        log: np.array([poses.atPose3(problem.offsets[log] + k).translation() for k in range(len(trajectory))])
        for log, trajectory in graph.trajectories.items()
    }
    return ate_m(found, file.truth_m) or 0.0


def main() -> None:
    """Print the table that the command line names."""
    what, *rest = sys.argv[1:]
    tables = {"outliers": outlier_table, "growth": growth_table}
    if what == "growth-row":
        text = growth_row(int(rest[0]))
    elif what == "scale":
        text = "\n".join(scale_row(Path(path)) for path in rest)
    elif what == "lm":
        text = "\n".join(lm_row(Path(path)) for path in rest)
    else:
        text = tables[what]()
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
