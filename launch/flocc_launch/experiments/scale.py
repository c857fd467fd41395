"""`flocc experiment scale`: where scales start, which unknowns they are, how it is solved, and how good odometry is.

Pose graphs only, no agents: generated ones, and cosmo_bench's with its closures' translations in drawn network units.
Poor odometry is that of a VIO whose scale is some per cent off, differently on every robot; Eq. (6) inherits its error.
"""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flocc_agent.config import BackendConfig, Formulation, ScaleInitial, Solver
from flocc_agent.core.pose_graph import LoopClosure, OptimisationFailed, PoseGraph, Trajectory
from flocc_agent.geometry import inverse
from flocc_launch.experiments.experiment import (
    Cell,
    Experiment,
    ExperimentError,
    Finding,
    Progress,
    Row,
    Settings,
    Summary,
    grid,
)
from flocc_launch.experiments.formulation_claims import Measured, formulation_findings
from flocc_launch.experiments.overlap import joined
from flocc_launch.experiments.plots import COLOURS, MARKERS, label_logarithmic
from flocc_launch.experiments.statistics import grouped, middle, with_spread
from flocc_launch.generated_graph import Noise, generate
from flocc_launch.graph_files import read_graph_file
from flocc_launch.graph_files.graph_file import GraphFile, ate_m
from flocc_launch.optimise import positions
from flocc_protocol.ids import LogId

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Float = NDArray[np.float64]

COSMO = {"cosmo-wifi": "wifi", "cosmo-proradio": "proradio"}
FORMULATIONS = tuple(
    f.value for f in (Formulation.BASE, Formulation.INDEPENDENT, Formulation.SMOOTHED, Formulation.SHARED)
)
SOLVERS = (Solver.LM.value, Solver.GNC_TLS.value)

DRAWS_MAX = 100
JOINING_MIN = 10
"""Closures of a pair of robots that surely join it, wrong ones among them."""


class ScaleSettings(Settings):
    """Which graphs, and how they are drawn."""

    data: Path = Path("../shared/data")
    """Folder of shared data; cosmo_bench is looked for there."""
    sources: tuple[str, ...] = ("generated", "cosmo-wifi", "cosmo-proradio")
    """Graphs."""
    robots: int = Field(4, ge=2, le=20)
    """Robots of a generated graph."""
    keyframes: int = Field(150, ge=20)
    """Keyframes of each robot of a generated graph."""
    closures: int = Field(500, ge=4)
    """Closures of a generated graph, at most."""
    outlier_ratio: float = Field(0.05, ge=0, lt=1)
    """Share of wrong closures of a generated graph; cosmo_bench has its own."""
    labelled_outliers: bool = True
    """Whether closures that cosmo_bench labels as wrong stay in."""
    unit_sigma_ratio: float = Field(0.3, ge=0)
    """Spread of metres per network unit on cosmo_bench (log-normal)."""
    initial_sigma_ratio: float = Field(0.1, ge=0)
    """Error of Eq. (6) on cosmo_bench (log-normal), beside that of odometry."""
    odometry_scale_sigma_ratio: float = Field(0.05, ge=0)
    """Error of poor odometry's scale, one per robot (log-normal)."""
    runs: int = Field(3, ge=1, le=100)
    """Repetitions with other draws."""


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
            path = _file(settings, source)
            _require_measurable(read_graph_file(path), path)


def _require_measurable(file: GraphFile, path: Path) -> None:
    blind = sorted(set(file.graph.trajectories) - set(file.truth_m))
    if blind:
        raise ExperimentError(f"{path}: has no ground truth of robot {blind[0]}, so no error can be measured")
    pairs = {(c.query.log, c.match.log) for c in file.graph.closures}
    apart = sorted(set(file.graph.trajectories) - joined(file.graph.trajectories, pairs))
    if apart:
        raise ExperimentError(f"{path}: no closures join robot {apart[0]} to the others: no overlap, no map")


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


# Graphs


@dataclass(frozen=True, slots=True, eq=False)
class DrawnGraph:
    """A graph in network units, with true scales, those of Eq. (6), and true positions."""

    graph: PoseGraph
    true_scale: list[float]
    odometry_scale: list[float]
    truth_m: dict[LogId, Float]


def draw_graph(settings: ScaleSettings, source: str, poor: bool, seed: int) -> DrawnGraph:
    """The graph of one cell; the same for all formulations and solvers."""
    rng = np.random.default_rng([seed, 31])
    drawn = _generated(settings, poor, rng) if source == "generated" else _cosmo(settings, source, rng)
    return _with_wrong_odometry_scale(drawn, settings.odometry_scale_sigma_ratio, rng) if poor else drawn


def _generated(settings: ScaleSettings, poor: bool, rng: np.random.Generator) -> DrawnGraph:
    """A generated graph whose closures join all robots; walks that never meet are drawn again.

    Raises:
        ExperimentError: So many robots hardly ever meet.
    """
    noise = Noise(odometry=(0.006, 0.05) if poor else (0.003, 0.02), scale_initial_ratio=0.0)
    given = settings.robots, settings.keyframes, settings.closures, settings.outlier_ratio
    drawn = (generate(rng, *given, noise=noise) for _ in range(DRAWS_MAX))
    made = next((each for each in drawn if _hangs_together(each.graph)), None)
    if made is None:
        raise ExperimentError(
            f"{settings.robots} robots of {settings.keyframes} keyframes do not all meet in {DRAWS_MAX} draws"
        )
    true_scale = [c.scale_initial or 1.0 for c in made.graph.closures]
    errors = np.exp(settings.initial_sigma_ratio * rng.normal(size=len(true_scale)))
    return DrawnGraph(made.graph, true_scale, (np.array(true_scale) * errors).tolist(), made.truth_m())


def _hangs_together(graph: PoseGraph) -> bool:
    """Whether pairs of robots with enough closures join all robots."""
    counts = Counter((c.query.log, c.match.log) for c in graph.closures)
    pairs = {pair for pair, count in counts.items() if count >= JOINING_MIN}
    return joined(graph.trajectories, pairs) == set(graph.trajectories)


def _cosmo(settings: ScaleSettings, source: str, rng: np.random.Generator) -> DrawnGraph:
    """The file's graph; closures between robots in network units of their own."""
    file = read_graph_file(_file(settings, source))
    file = file if settings.labelled_outliers else file.without_outliers()
    units = np.exp(settings.unit_sigma_ratio * rng.normal(size=len(file.graph.closures)))
    errors = np.exp(settings.initial_sigma_ratio * rng.normal(size=len(units)))
    closures = [
        _in_units(c, float(unit)) if c.query.log != c.match.log else c
        for c, unit in zip(file.graph.closures, units, strict=True)
    ]
    graph = replace(file.graph, closures=closures)
    return DrawnGraph(graph, units.tolist(), (units * errors).tolist(), dict(file.truth_m))


def _in_units(closure: LoopClosure, unit_m: float) -> LoopClosure:
    T = np.array(closure.T_query_match_unscaled)
    T[:3, 3] /= unit_m
    units = np.diag([1.0] * 3 + [1.0 / unit_m] * 3)
    covariance = None if closure.covariance is None else units @ closure.covariance @ units
    return replace(closure, T_query_match_unscaled=T, covariance=covariance, metric=False)


def _with_wrong_odometry_scale(drawn: DrawnGraph, sigma_ratio: float, rng: np.random.Generator) -> DrawnGraph:
    """Stretch every robot's odometry, and with it what Eq. (6) says of its queries."""
    stretch = {log: float(np.exp(sigma_ratio * rng.normal())) for log in sorted(drawn.graph.trajectories)}
    trajectories = {log: stretched(t, stretch[log]) for log, t in drawn.graph.trajectories.items()}
    scales = [s * stretch[c.query.log] for s, c in zip(drawn.odometry_scale, drawn.graph.closures, strict=True)]
    return replace(drawn, graph=replace(drawn.graph, trajectories=trajectories), odometry_scale=scales)


def stretched(trajectory: Trajectory, factor: float) -> Trajectory:
    """Odometry whose steps are longer by a factor; covariances stay."""
    T = np.array(trajectory.T_odom_keyframe, dtype=float)
    steps = inverse(T[:-1]) @ T[1:]
    steps[:, :3, 3] *= factor
    for k, step in enumerate(steps):
        T[k + 1] = T[k] @ step
    return replace(trajectory, T_odom_keyframe=T)


def _file(settings: ScaleSettings, source: str) -> Path:
    if source not in COSMO:
        raise ExperimentError(f"there is no source {source!r}; there are generated, {', '.join(COSMO)}")
    folder = settings.data / "cosmo_bench" / COSMO[source]
    found = next(iter(sorted(folder.glob("*.jrl"))), None)
    if found is None:
        raise ExperimentError(f"{folder}: holds no .jrl file; give --data")
    return found


# Summary

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


def findings(rows: Sequence[Row]) -> list[Finding]:
    """The paper's claims, for every source and odometry."""
    return [
        f for (source, odometry), of in grouped(rows, "source", "odometry").items() for f in _of(source, odometry, of)
    ]


def _of(source: str, odometry: str, rows: Sequence[Row]) -> list[Finding]:
    started = [row for row in rows if row["initial"] == ScaleInitial.ODOMETRY.value]
    measured = {
        (key[0], key[1]): Measured(ate_m, middle(group, "solve_cpu_s") or 0.0)
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
    quick={"sources": ["generated"], "robots": 2, "keyframes": 40, "closures": 40, "runs": 1},
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
    prepare=prepare,
    timed=True,
)
