"""`flocc experiment scale`: where scales start, which unknowns they are, how it is solved, and how good odometry is.

Pose graphs only, no agents; `scale_graphs` draws them.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flocc_agent.config import BackendConfig, Formulation, ScaleInitial, Solver
from flocc_agent.core.pose_graph import OptimisationFailed, components_of
from flocc_lab.experiments.benchmarks import cosmo_file
from flocc_lab.experiments.experiment import (
    Cell,
    Experiment,
    ExperimentError,
    ExperimentFinding,
    Progress,
    Row,
    Summary,
    grid,
)
from flocc_lab.experiments.formulation_claims import MeasuredClaim, formulation_findings
from flocc_lab.experiments.plots import COLOURS, MARKERS, label_logarithmic
from flocc_lab.experiments.scale_graphs import ScaleSettings, draw_graph
from flocc_lab.experiments.statistics import grouped, middle, with_spread
from flocc_launch.graph_files import read_graph_file
from flocc_launch.graph_files.graph_file import GraphFile, ate_m
from flocc_launch.graph_files.optimise import positions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMULATIONS = tuple(
    f.value for f in (Formulation.BASE, Formulation.INDEPENDENT, Formulation.SMOOTHED, Formulation.SHARED)
)
SOLVERS = (Solver.LM.value, Solver.GNC_TLS.value)


def cells(settings: ScaleSettings) -> list[Cell]:
    """Every combination."""
    return grid(
        settings.runs,
        source=settings.sources,
        odometry=("good", "poor"),
        initial=tuple(initial.value for initial in ScaleInitial),
        formulation=FORMULATIONS,
        solver=SOLVERS,
    )


def prepare(settings: ScaleSettings, _progress: Progress) -> None:
    """Refuse sources that are not there, or of which no joint error can be measured.

    Raises:
        FloccError: A file is missing or damaged, has no ground truth, or its robots have no closures with each other.
    """
    for source in settings.sources:
        if source != "generated":
            path = cosmo_file(settings.data, source)
            _require_measurable(read_graph_file(path), path)


def _require_measurable(file: GraphFile, path: Path) -> None:
    blind = sorted(set(file.graph.trajectories) - set(file.truth_m))
    if blind:
        raise ExperimentError(f"{path}: has no ground truth of robot {blind[0]}, so no error can be measured")
    _, *apart = components_of(list(file.graph.trajectories), file.graph.closures)
    if apart:
        raise ExperimentError(f"{path}: no closures join robot {apart[0][0]} to the others: no overlap, no map")


def measure(settings: ScaleSettings, cell: Cell, seed: int) -> Row:
    """Solve one graph."""
    from flocc_agent.backend.optimiser import optimise

    given = cell.parameters
    drawn = draw_graph(settings, given["source"], given["odometry"] == "poor", seed)
    initial = ScaleInitial(given["initial"])
    scales = drawn.true_scale if initial is ScaleInitial.GROUND_TRUTH else drawn.odometry_scale
    closures = [
        c if c.metric else replace(c, scale_initial=scale)
        for c, scale in zip(drawn.graph.closures, scales, strict=True)
    ]
    config = BackendConfig(
        formulation=Formulation(given["formulation"]),
        solver=Solver(given["solver"]),
        scale_initial=initial,
        weight_by_probability=False,
        covariances=False,
    )
    began_s = time.process_time()
    solution = optimise(replace(drawn.graph, closures=closures), config)
    took_s = time.process_time() - began_s
    if isinstance(solution, OptimisationFailed):
        raise ExperimentError(f"{cell.key}: {solution.reason}")
    return {
        "ate_m": ate_m(positions(solution), drawn.truth_m) if len(solution.components) == 1 else None,
        "components": len(solution.components),
        "closures": len(closures),
        "closures_rejected": sum(result.state.name == "REJECTED" for result in solution.closures),
        "solve_cpu_s": took_s,
        "iterations": solution.iterations,
    }


AXES = ("source", "odometry", "initial", "formulation", "solver")


def summarise(_settings: ScaleSettings, rows: Sequence[Row]) -> Summary:
    """A row per combination, medians over the runs."""
    table = [
        {
            **dict(zip(AXES, key, strict=True)),
            "runs": len(group),
            **with_spread(group, "ate_m"),
            "closures": middle(group, "closures"),
            "closures_rejected": middle(group, "closures_rejected"),
            "solve_cpu_s": middle(group, "solve_cpu_s"),
        }
        for key, group in grouped(rows, *AXES).items()
    ]
    return Summary(table, findings(rows), ["The ATE is n/a where the robots end in several components."])


def findings(rows: Sequence[Row]) -> list[ExperimentFinding]:
    """The paper's claims, for every source and odometry."""
    return [
        f for (source, odometry), of in grouped(rows, "source", "odometry").items() for f in _of(source, odometry, of)
    ]


def _of(source: str, odometry: str, rows: Sequence[Row]) -> list[ExperimentFinding]:
    started = [row for row in rows if row["initial"] == ScaleInitial.ODOMETRY.value]
    measured = {
        (key[0], key[1]): MeasuredClaim(ate_m, middle(group, "solve_cpu_s") or 0.0)
        for key, group in grouped(started, "formulation", "solver").items()
        if (ate_m := middle(group, "ate_m")) is not None
    }
    return formulation_findings(f"{source}, {odometry} odometry, scales from it", measured)


def draw(figure: "Figure", _settings: ScaleSettings, rows: Sequence[Row]) -> None:
    """A panel per source and odometry: ATE by formulation, a mark per initialisation; LM full, GNC hollow."""
    groups = grouped(rows, "source", "odometry")
    columns = len({source for source, _ in groups})
    figure.set_size_inches(2.0 + 3.4 * columns, 6.5)
    panels = figure.subplots(2, columns, sharex=True, squeeze=False)
    places = {key: panels[k % 2][k // 2] for k, key in enumerate(groups)}
    for key, of in groups.items():
        _draw_panel(places[key], of)
        places[key].set_title(f"{key[0]}, {key[1]} odometry", fontsize=9)
    for line in panels:
        line[0].set_ylabel("joint ATE, m")
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=8)


def _draw_panel(panel: "Axes", rows: Sequence[Row]) -> None:
    marks = list(grouped(rows, "initial", "solver").items())
    for k, ((initial, solver), group) in enumerate(marks):
        by_formulation = grouped(group, "formulation")
        known = [(n, middle(by_formulation.get((name,), []), "ate_m")) for n, name in enumerate(FORMULATIONS)]
        at = [(n + (k - (len(marks) - 1) / 2) * 0.11, value) for n, value in known if value is not None]
        colour, fill = COLOURS[k // 2], "full" if solver == Solver.LM.value else "none"
        if at:
            style: Any = {"linestyle": "", "marker": MARKERS[k // 2], "fillstyle": fill, "markersize": 6}
            panel.plot(*zip(*at, strict=True), color=colour, label=f"{initial}, {solver}", **style)
    panel.set_yscale("log")
    label_logarithmic(panel.yaxis)
    panel.set_xticks(range(len(FORMULATIONS)), FORMULATIONS, fontsize=8)
    panel.set_xlim(-0.5, len(FORMULATIONS) - 0.5)


SCALE: Experiment[ScaleSettings] = Experiment(
    name="scale",
    title="initial scale, formulation and solver, with good and poor odometry",
    settings=ScaleSettings,
    quick={"sources": ["generated"], "robots": 2, "keyframes": 20, "closures": 20, "runs": 1},
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
    prepare=prepare,
    timed=True,
)
