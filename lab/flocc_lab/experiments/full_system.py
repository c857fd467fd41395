"""`flocc experiment full-system`: whole swarms on virtual time, formulations and solvers against the baselines.

Every cell runs the agents: odometry and pictures in, corrections out; the ATE is that of the robots' own corrections at
the end. On cosmo_bench the closures are the recorded ones, offered when both keyframes are known, wrong ones included;
flocc's methods get them without scale, the baselines, which stand for systems with metric sensors, with it.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import OptimisationFailed, PoseGraph
from flocc_lab.experiments.benchmarks import COSMO
from flocc_lab.experiments.experiment import (
    Cell,
    Experiment,
    ExperimentError,
    ExperimentFinding,
    Progress,
    Row,
    Summary,
    judged,
)
from flocc_lab.experiments.formulation_claims import MeasuredClaim, formulation_findings
from flocc_lab.experiments.full_system_data import METHODS, PICTURES, FullSystemSettings, recordings_of, scenario_of
from flocc_lab.experiments.overlap import require_overlap
from flocc_lab.experiments.plots import COLOURS, MARKERS, label_logarithmic
from flocc_lab.experiments.statistics import grouped, middle, values, with_spread
from flocc_launch.report.finish import finish
from flocc_launch.report.model import RunReport
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.setup.cache import cache_folder
from flocc_launch.simulation.simulate import playbacks_of, run, swarm_of, write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TARGET_ATE_M = 2.5
NEAR_M = 10.0
"""Robots whose true ways never come this near show nothing."""
DEFAULT = "flocc independent gnc-tls"


def cells(settings: FullSystemSettings) -> list[Cell]:
    """Every method on every source that it can be run on."""
    pairs = [(source, method) for source in settings.sources for method in settings.methods if _runs_on(source, method)]
    return [Cell({"source": s, "method": m}, run) for s, m in pairs for run in range(settings.runs)]


def _runs_on(source: str, method: str) -> bool:
    """Single pictures give no metric closures."""
    return source not in PICTURES or not METHODS[method].metric


def prepare(settings: FullSystemSettings, progress: Progress) -> None:
    """Check names, and make the recordings that all cells share.

    Raises:
        FloccError: There is no such method or source, or its data is missing, has no ground truth or no overlap.
    """
    for method in settings.methods:
        if method not in METHODS:
            raise ExperimentError(f"there is no method {method!r}; there are {', '.join(METHODS)}")
    for number, source in enumerate(settings.sources):
        if source not in (*COSMO, "tracks", *PICTURES):
            raise ExperimentError(f"there is no source {source!r}; see --help")
        given = scenario_of(settings, source, METHODS[DEFAULT], seed=1)
        require_overlap(playbacks_of(given, recordings_of(settings, source, given)), NEAR_M, source)
        progress(number + 1, len(settings.sources))


def measure(settings: FullSystemSettings, cell: Cell, seed: int) -> Row:
    """Run one swarm, and time one solve of the graph that it ends with."""
    source, method = cell.parameters["source"], METHODS[cell.parameters["method"]]
    scenario = scenario_of(settings, source, method, seed)
    report, graph = simulated_with_graph(scenario, seed, recordings_of(settings, source, scenario))
    return {
        "robots": len(report.robots),
        "ate_m": report.ate_joint_m,
        "ate_odometry_m": report.ate_joint_odometry_m,
        "map_frames": len(report.map_frames),
        "closures": report.closures.accepted,
        "merged_after_s": report.merged_after_s,
        "bytes": sum(report.bytes.values()),
        **solved(scenario.backend, graph),
    }


def simulated_with_graph(scenario: Scenario, seed: int, recordings: dict[str, Path]) -> tuple[RunReport, PoseGraph]:
    """Run a scenario on virtual time; its report, and the pose graph of the first robot's logs at the end."""
    with TemporaryDirectory(prefix="flocc-experiment-") as folder:
        out = RunFolder.create(Path(folder) / "run")
        swarm = swarm_of(scenario, playbacks_of(scenario, recordings), seed, cache_folder() / "perception")
        end_s = run(swarm)
        write(out, swarm, seed, end_s, recordings)
        core = next(station.core for _, station in sorted(swarm.stations.items()) if station.core is not None)
        return finish(out), core.assembly.graph()


def solved(config: BackendConfig, graph: PoseGraph) -> Row:
    """Time of one cold solve."""
    from flocc_agent.backend.optimiser import optimise

    began_s = time.process_time()
    solution = optimise(graph, config)
    cpu_s = time.process_time() - began_s
    if isinstance(solution, OptimisationFailed):
        return {"solve_cpu_s": cpu_s, "iterations": None, "closures_rejected": None}
    rejected = sum(result.state.name == "REJECTED" for result in solution.closures)
    return {"solve_cpu_s": cpu_s, "iterations": solution.iterations, "closures_rejected": rejected}


def summarise(_settings: FullSystemSettings, rows: Sequence[Row]) -> Summary:
    """A row per source and method, medians over the runs."""
    table = [
        {
            "source": source,
            "method": method,
            "runs": len(group),
            **with_spread(group, "ate_m"),
            "ate_odometry_m": middle(group, "ate_odometry_m"),
            "one_frame": sum(row["map_frames"] == 1 for row in group),
            "closures": middle(group, "closures"),
            "closures_rejected": middle(group, "closures_rejected"),
            "solve_cpu_s": middle(group, "solve_cpu_s"),
            "iterations": middle(group, "iterations"),
            "bytes": middle(group, "bytes"),
        }
        for (source, method), group in grouped(rows, "source", "method").items()
    ]
    notes = [
        "metric: closures keep their scale, as of a stereo camera or a lidar; flocc: their scale is removed.",
        "solve_cpu_s: CPU time of one cold solve of the final graph.",
    ]
    return Summary(table, findings(rows), notes)


def findings(rows: Sequence[Row]) -> list[ExperimentFinding]:
    """The paper's claims on whole systems."""
    return [f for (source,), of_source in grouped(rows, "source").items() for f in _of_source(source, of_source)]


def _of_source(source: str, rows: Sequence[Row]) -> list[ExperimentFinding]:
    of = {method: group for (method,), group in grouped(rows, "method").items()}
    ate = {method: value for method, group in of.items() if (value := middle(group, "ate_m")) is not None}
    found = []
    if source in COSMO and DEFAULT in ate:
        claim = f"flocc's default ends at most {TARGET_ATE_M} m off on {source}"
        found.append(
            judged(claim, "docs/experiments.md, full-system", ate[DEFAULT] <= TARGET_ATE_M, f"{ate[DEFAULT]:.2f} m.")
        )
    measured = {
        (method.formulation.value, method.solver.value): MeasuredClaim(
            ate[name], middle(of[name], "solve_cpu_s") or 0.0
        )
        for name, method in METHODS.items()
        if name in ate and not method.metric
    }
    return [*found, *formulation_findings(source, measured, middle(rows, "ate_odometry_m"))]


def draw(figure: "Figure", _settings: FullSystemSettings, rows: Sequence[Row]) -> None:
    """A panel per source, a line per method: its error as a mark with its value, runs as small dots."""
    by_source = {source: of_source for (source,), of_source in grouped(rows, "source").items()}
    methods = list(dict.fromkeys(row["method"] for row in rows))
    figure.set_size_inches(2.6 + 3.2 * len(by_source), 1.6 + 0.34 * len(methods))
    panels = figure.subplots(1, len(by_source), sharey=True, squeeze=False)[0]
    for panel, (source, of_source) in zip(panels, by_source.items(), strict=True):
        _draw_source(panel, methods, of_source)
        panel.set_title(source)
    panels[0].set_yticks(range(len(methods)), methods)
    panels[0].invert_yaxis()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=8)


def _draw_source(panel: "Axes", methods: Sequence[str], rows: Sequence[Row]) -> None:
    of = {method: group for (method,), group in grouped(rows, "method").items()}
    kinds = {False: "closures without scale", True: "metric closures"}
    for metric, label in kinds.items():
        drawn = [(n, of[name]) for n, name in enumerate(methods) if name in of and METHODS[name].metric == metric]
        known = [(value, n) for n, group in drawn if (value := middle(group, "ate_m")) is not None]
        if known:
            panel.plot(*zip(*known, strict=True), MARKERS[metric], color=COLOURS[metric], label=label)
        for n, group in drawn:
            panel.plot(
                values(group, "ate_m"), [n] * len(values(group, "ate_m")), ".", color=COLOURS[metric], alpha=0.45
            )
        for value, n in known:
            panel.annotate(f"{value:.3g}", (value, n), (7, 0), textcoords="offset points", fontsize=7, va="center")
    if (odometry_m := middle(rows, "ate_odometry_m")) is not None:
        panel.axvline(odometry_m, color="#555555", linestyle=":", label="odometry alone")
    panel.set_xscale("log")
    label_logarithmic(panel.xaxis)
    panel.margins(x=0.2)
    panel.set_xlabel("joint ATE, m")
    panel.grid(visible=False, axis="y")


FULL_SYSTEM: Experiment[FullSystemSettings] = Experiment(
    name="full-system",
    title="whole swarms: formulations and solvers against the baselines",
    settings=FullSystemSettings,
    quick={
        "sources": ["tracks"],
        "methods": [DEFAULT, "flocc smoothed lm", "metric swarm-slam", "metric distributed"],
        "walk_m": 18.0,
    },
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
    prepare=prepare,
    timed=True,
)
