"""The swarms of `flocc experiment full-system`: which lines the table has, and the scenario of each on each source."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

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
from flocc_lab.experiments.benchmarks import COSMO, cosmo_file
from flocc_lab.experiments.experiment import Settings
from flocc_launch.graph_files import read_graph_file
from flocc_launch.graph_files.graph_recording import (
    OWN_GAP_KEYFRAMES,
    GraphRecordings,
    odometry_sigmas,
    write_recordings,
)
from flocc_launch.scenarios.own_data import OwnData
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import DatasetScenario, RobotScenario, Scenario, TracksScenario, WorldScenario
from flocc_launch.setup.cache import cache_folder

PICTURES = ("world", "sevenscenes", "street", "herz_jesu")
"""Sources with real pictures: single ones, which give no metric closures."""
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
    "metric distributed": Method(Formulation.BASE, Solver.GNC_TLS, metric=True, mode=BackendMode.DISTRIBUTED),
}
"""Swarm-SLAM: metric closures, spectral order of candidates, GNC, the lowest robot optimises (all are of one class)."""


class FullSystemSettings(Settings):
    """Which data, which methods."""

    data: Path = Path("../shared/data")
    """Folder of shared data; cosmo_bench and sevenscenes are looked for there."""
    sources: tuple[str, ...] = ("cosmo-wifi", "cosmo-proradio", "tracks")
    """cosmo-wifi, cosmo-proradio: recorded robots; tracks: walks with synthetic perception; with pictures: world, a
    generated town, sevenscenes, a video cut among robots, street and herz_jesu, robots of one place."""
    perception: PerceptionConfig = PerceptionConfig()
    """Front end of the sources with pictures: a configuration file whose [perception] is taken."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Lines of the table."""
    runs: int = Field(1, ge=1, le=100)
    """Repetitions with other seeds: links, workers, walks."""
    loss_ratio: float = Field(0.1, ge=0, lt=1)
    """Share of messages lost on every link."""
    round_period_s: float = Field(100.0, gt=0, le=200)
    """Time between rounds on cosmo_bench, whose robots drive for a quarter of an hour; elsewhere the default."""
    iteration_period_s: float = Field(2.0, gt=0)
    """Time between steps of distributed mode on cosmo_bench; elsewhere the default."""
    keyframes_max: int = Field(100_000, ge=10)
    """Keyframes of each robot of cosmo_bench that are used."""
    walk_m: float = Field(60.0, gt=0)
    """Length of each walk of tracks."""


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
        sigmas = odometry_sigmas(read_graph_file(cosmo_file(settings.data, source)))
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
    return Scenario.model_validate(
        {
            **_with_pictures(settings, source),
            **common,
            "perception": settings.perception,
            "core": core,
            "backend": BackendConfig(**backend),
        }
    )


def _with_pictures(settings: FullSystemSettings, source: str) -> dict[str, Any]:
    """Where a source's pictures are, and its keyframes."""
    if source == "world":
        return {"world": WorldScenario()}
    if source == "sevenscenes":
        dataset = DatasetScenario(source=settings.data / source, robots=3)
        return {"dataset": dataset, "keyframes": KeyframeConfig(distance_m=0.1, rotation_rad=0.17)}
    return OwnData.open(settings.data / source).fields()


def recordings_of(settings: FullSystemSettings, source: str, scenario: Scenario) -> dict[str, Path]:
    """The recording of each robot of a source, made once; walks have none."""
    if source in COSMO:
        return _cosmo(settings, source).robots
    return {} if source == "tracks" else recordings(scenario)


def _cosmo(settings: FullSystemSettings, source: str) -> GraphRecordings:
    """Recordings of a file, made once for its content."""
    path = cosmo_file(settings.data, source)
    content = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    out = cache_folder() / "graphs" / f"{path.stem}-{content}-{settings.keyframes_max}"
    marker = out / "whole"
    if marker.exists():
        robots = {folder.name: folder for folder in sorted(out.iterdir()) if folder.is_dir()}
        return GraphRecordings(robots, out / "registrations.json")
    made = write_recordings(read_graph_file(path).shortened(settings.keyframes_max), out, path.stem)
    marker.touch()
    return made
