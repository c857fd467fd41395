"""`flocc experiment full-system`: whole swarms on virtual time, formulations and solvers against the baselines.

Every cell runs the agents: odometry and pictures in, corrections out; the ATE is that of the robots' own corrections at
the end. On cosmo_bench the closures are the recorded ones, offered when both keyframes are known, wrong ones included;
flocc's methods get them without scale, the baselines, which stand for systems with metric sensors, with it.
"""

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from flocc_agent.config import (
    BackendConfig,
    BackendMode,
    Formulation,
    KeyframeConfig,
    PerceptionConfig,
    RadioConfig,
    RecordedConfig,
    Solver,
    SyntheticConfig,
)
from flocc_agent.core.parameters import (
    CoreParameters,
    DistributedParameters,
    PlaceRecognitionParameters,
    RoundParameters,
)
from flocc_agent.core.pose_graph import OptimisationFailed, PoseGraph
from flocc_launch.data import cache_folder
from flocc_launch.data import recordings as recordings_of
from flocc_launch.distributed import optimise_together
from flocc_launch.experiments.experiment import (
    Cell,
    Experiment,
    ExperimentError,
    Finding,
    Progress,
    Row,
    Settings,
    Summary,
    judged,
)
from flocc_launch.experiments.formulation_claims import Measured, formulation_findings
from flocc_launch.experiments.overlap import require_overlap
from flocc_launch.experiments.plots import COLOURS, MARKERS, label_logarithmic
from flocc_launch.experiments.statistics import grouped, middle, values, with_spread
from flocc_launch.graph_files import read_graph_file
from flocc_launch.graph_recording import OWN_GAP_KEYFRAMES, GraphRecordings, odometry_sigmas, write_recordings
from flocc_launch.report.finish import finish
from flocc_launch.report.model import Report
from flocc_launch.run_folder import RunFolder
from flocc_launch.scenario import DatasetScenario, RobotScenario, Scenario, TracksScenario, WorldScenario
from flocc_launch.simulation.simulate import playbacks_of, run, swarm_of, write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COSMO = {"cosmo-wifi": "wifi", "cosmo-proradio": "proradio"}
TARGET_ATE_M = 2.5
NEAR_M = 10.0
"""Robots whose true ways never come this near show nothing."""
DEFAULT = "flocc independent gnc-tls"
SETTLE_S = 20.0
"""A run on cosmo_bench is quiet when nothing happened for a round's period and this."""


@dataclass(frozen=True, slots=True)
class Method:
    """One line of the table.

    Attributes:
        formulation: Which unknowns scales are.
        solver: How it is solved.
        metric: Closures keep their metric scale.
        mode: Who optimises.
        pairwise_consistency: Filter closures first.
        order: Which candidates are registered first.
    """

    formulation: Formulation
    solver: Solver
    metric: bool = False
    mode: BackendMode = BackendMode.CENTRALISED
    pairwise_consistency: bool = False
    order: Literal["similarity", "spectral"] = "similarity"


METHODS: dict[str, Method] = {
    **{
        f"flocc {formulation.value} {solver.value}": Method(formulation, solver)
        for formulation in (Formulation.BASE, Formulation.INDEPENDENT, Formulation.SMOOTHED, Formulation.SHARED)
        for solver in (Solver.LM, Solver.GNC_TLS)
    },
    "metric lm": Method(Formulation.BASE, Solver.LM, metric=True),
    "metric pcm lm": Method(Formulation.BASE, Solver.LM, metric=True, pairwise_consistency=True),
    "metric swarm-slam": Method(Formulation.BASE, Solver.GNC_TLS, metric=True, order="spectral"),
    "metric rbcd gnc": Method(Formulation.BASE, Solver.GNC_TLS, metric=True, mode=BackendMode.DISTRIBUTED),
}
"""Swarm-SLAM: metric closures, spectral order of candidates, GNC, the lowest robot optimises (all are of one class)."""


class FullSystemSettings(Settings):
    """Which data, which methods."""

    data: Path = Path("../shared/data")
    """Folder of shared data; cosmo_bench and sevenscenes are looked for there."""
    sources: tuple[str, ...] = ("cosmo-wifi", "cosmo-proradio", "tracks")
    """cosmo-wifi, cosmo-proradio: recorded robots; tracks: walks with synthetic perception; world: a generated town
    and sevenscenes: a video cut among robots, both with real pictures and the classical front end."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Lines of the table."""
    runs: int = Field(1, ge=1, le=100)
    """Repetitions with other seeds: links, workers, walks."""
    loss_ratio: float = Field(0.1, ge=0, lt=1)
    """Share of messages lost on every link."""
    round_period_s: float = Field(100.0, gt=0, le=200)
    """Time between rounds on cosmo_bench, whose robots drive for a quarter of an hour; elsewhere the default."""
    iteration_period_s: float = Field(2.0, gt=0)
    """Time between iterations of rbcd on cosmo_bench; elsewhere the default."""
    keyframes_max: int = Field(100_000, ge=10)
    """Keyframes of each robot of cosmo_bench that are used."""
    walk_m: float = Field(60.0, gt=0)
    """Length of each walk of tracks."""


def cells(settings: FullSystemSettings) -> list[Cell]:
    """Every method on every source that it can be run on."""
    pairs = [(source, method) for source in settings.sources for method in settings.methods if _runs_on(source, method)]
    return [Cell({"source": s, "method": m}, run) for s, m in pairs for run in range(settings.runs)]


def _runs_on(source: str, method: str) -> bool:
    """Single pictures give no metric closures."""
    return source not in ("world", "sevenscenes") or not METHODS[method].metric


def prepare(settings: FullSystemSettings, progress: Progress) -> None:
    """Check names, and make the recordings that all cells share.

    Raises:
        FloccError: There is no such method or source, or its data is missing, has no ground truth or no overlap.
    """
    for method in settings.methods:
        if method not in METHODS:
            raise ExperimentError(f"there is no method {method!r}; there are {', '.join(METHODS)}")
    for number, source in enumerate(settings.sources):
        if source not in (*COSMO, "tracks", "world", "sevenscenes"):
            raise ExperimentError(f"there is no source {source!r}; see --help")
        given = scenario_of(settings, source, METHODS[DEFAULT], seed=1)
        require_overlap(playbacks_of(given, _recordings(settings, source, given)), NEAR_M, source)
        progress(number + 1, len(settings.sources))


def measure(settings: FullSystemSettings, cell: Cell, seed: int) -> Row:
    """Run one swarm, and time one solve of the graph that it ends with."""
    source, method = cell.parameters["source"], METHODS[cell.parameters["method"]]
    scenario = scenario_of(settings, source, method, seed)
    report, graph = simulated_with_graph(scenario, seed, _recordings(settings, source, scenario))
    return {
        "robots": len(report.robots),
        "ate_m": report.ate_joint_m,
        "ate_odometry_m": report.ate_joint_odometry_m,
        "map_frames": len(report.map_frames),
        "closures": report.closures.accepted,
        "merged_after_s": report.merged_after_s,
        "bytes": sum(report.bytes.values()),
        **solved(scenario.backend, scenario.core.distributed, graph),
    }


def simulated_with_graph(scenario: Scenario, seed: int, recordings: dict[str, Path]) -> tuple[Report, PoseGraph]:
    """Run a scenario on virtual time; its report, and the pose graph of the first robot's logs at the end."""
    with TemporaryDirectory(prefix="flocc-experiment-") as folder:
        out = RunFolder.create(Path(folder) / "run")
        swarm = swarm_of(scenario, playbacks_of(scenario, recordings), seed, cache_folder() / "perception")
        end_s = run(swarm)
        write(out, swarm, seed, end_s, recordings)
        core = next(station.core for _, station in sorted(swarm.stations.items()) if station.core is not None)
        return finish(out), core.assembly.graph()


def solved(config: BackendConfig, parameters: DistributedParameters, graph: PoseGraph) -> Row:
    """Time of one cold solve; of rbcd the time of all robots together over their number."""
    began_s = time.process_time()
    if config.mode is BackendMode.DISTRIBUTED:
        together = optimise_together(graph, config, parameters, iterations_max=300)
        cpu_s = (time.process_time() - began_s) / max(len(together.iterations), 1)
        iterations = max(together.iterations.values(), default=0)
        return {"solve_cpu_s": cpu_s, "iterations": iterations, "closures_rejected": together.rejected}
    from flocc_agent.backend.optimiser import optimise

    solution = optimise(graph, config)
    cpu_s = time.process_time() - began_s
    if isinstance(solution, OptimisationFailed):
        return {"solve_cpu_s": cpu_s, "iterations": None, "closures_rejected": None}
    rejected = sum(result.state.name == "REJECTED" for result in solution.closures)
    return {"solve_cpu_s": cpu_s, "iterations": solution.iterations, "closures_rejected": rejected}


# Data


def scenario_of(settings: FullSystemSettings, source: str, method: Method, seed: int) -> Scenario:
    """The swarm of one cell."""
    backend: dict[str, Any] = {
        "mode": method.mode,
        "formulation": method.formulation,
        "solver": method.solver,
        "pairwise_consistency": method.pairwise_consistency,
    }
    common: dict[str, Any] = {"name": "full", "seed": seed, "radio": RadioConfig(loss_ratio=settings.loss_ratio)}
    places: dict[str, Any] = {"candidate_order": method.order}
    if source in COSMO:
        made = _cosmo(settings, source)
        sigmas = odometry_sigmas(read_graph_file(_file(settings, source)))
        places |= {"similarity_threshold": 0.01, "best_matches": 16, "own_gap_keyframes": OWN_GAP_KEYFRAMES}
        pause_s = settings.iteration_period_s
        return Scenario(
            **common,
            robots={name: RobotScenario(recording=path) for name, path in made.robots.items()},
            keyframes=KeyframeConfig(distance_m=0.01),
            perception=PerceptionConfig(
                method="recorded",
                recorded=RecordedConfig(file=made.registrations, scale="kept" if method.metric else "removed"),
            ),
            core=CoreParameters(
                place_recognition=PlaceRecognitionParameters(**places),
                rounds=RoundParameters(period_s=settings.round_period_s),
                distributed=DistributedParameters(period_s=pause_s, wait_s=2.0 * pause_s),
            ),
            backend=BackendConfig(
                **backend,
                weight_by_probability=False,
                odometry_rotation_sigma_rad=sigmas[0],
                odometry_translation_sigma_m=sigmas[1],
            ),
            settle_s=settings.round_period_s + SETTLE_S,
        )
    core = CoreParameters(place_recognition=PlaceRecognitionParameters(**places))
    if source == "tracks":
        exact = {"scale_sigma_ratio": 0.0, "scale_drift_sigma_ratio": 0.0} if method.metric else {}
        return Scenario(
            **common,
            tracks=TracksScenario(robots=3, seed=seed, area_m=15.0, length_m=settings.walk_m),
            perception=PerceptionConfig(method="synthetic", synthetic=SyntheticConfig.model_validate(exact)),
            core=core,
            backend=BackendConfig(**backend),
        )
    data = (
        {"world": WorldScenario()}
        if source == "world"
        else {"dataset": DatasetScenario(source=settings.data / "sevenscenes", robots=3)}
    )
    apart = {"distance_m": 0.1, "rotation_rad": 0.17} if source == "sevenscenes" else {}
    return Scenario(
        **common, **data, keyframes=KeyframeConfig.model_validate(apart), core=core, backend=BackendConfig(**backend)
    )


def _recordings(settings: FullSystemSettings, source: str, scenario: Scenario) -> dict[str, Path]:
    if source in COSMO:
        return _cosmo(settings, source).robots
    return {} if source == "tracks" else recordings_of(scenario)


def _file(settings: FullSystemSettings, source: str) -> Path:
    folder = settings.data / "cosmo_bench" / COSMO[source]
    found = next(iter(sorted(folder.glob("*.jrl"))), None)
    if found is None:
        raise ExperimentError(f"{folder}: holds no .jrl file; give --data")
    return found


def _cosmo(settings: FullSystemSettings, source: str) -> GraphRecordings:
    """Recordings of a file, made once for its content."""
    path = _file(settings, source)
    content = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    out = cache_folder() / "graphs" / f"{path.stem}-{content}-{settings.keyframes_max}"
    marker = out / "whole"
    if marker.exists():
        robots = {folder.name: folder for folder in sorted(out.iterdir()) if folder.is_dir()}
        return GraphRecordings(robots, out / "registrations.json")
    made = write_recordings(read_graph_file(path).shortened(settings.keyframes_max), out, path.stem)
    marker.touch()
    return made


# Summary


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
        "solve_cpu_s: CPU time of one cold solve of the final graph; of rbcd per robot.",
    ]
    return Summary(table, findings(rows), notes)


def findings(rows: Sequence[Row]) -> list[Finding]:
    """The paper's claims on whole systems."""
    return [f for (source,), of_source in grouped(rows, "source").items() for f in _of_source(source, of_source)]


def _of_source(source: str, rows: Sequence[Row]) -> list[Finding]:
    of = {method: group for (method,), group in grouped(rows, "method").items()}
    ate = {method: value for method, group in of.items() if (value := middle(group, "ate_m")) is not None}
    found = []
    if source in COSMO and DEFAULT in ate:
        claim = f"flocc's default ends at most {TARGET_ATE_M} m off on {source}"
        found.append(judged(claim, "issue 8", ate[DEFAULT] <= TARGET_ATE_M, f"{ate[DEFAULT]:.2f} m."))
    measured = {
        (method.formulation.value, method.solver.value): Measured(ate[name], middle(of[name], "solve_cpu_s") or 0.0)
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
        "methods": [DEFAULT, "flocc smoothed lm", "metric swarm-slam", "metric rbcd gnc"],
        "walk_m": 25.0,
    },
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
    prepare=prepare,
    timed=True,
)
