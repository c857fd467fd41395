"""`flocc experiment sparse-keyframes`: error, memory and bytes against the distance between keyframes (Sec. IV-D).

Only distance calls for keyframes here, so that their number falls with it. Every perception back-end runs on what it
can see: image-based ones on a generated town or a scenario of the user's, the synthetic one on walks without images.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pydantic import Field

from flocc_agent.config import KeyframeConfig, PerceptionConfig
from flocc_lab.experiments.experiment import (
    Cell,
    Experiment,
    ExperimentError,
    ExperimentFinding,
    Progress,
    Row,
    Settings,
    Summary,
    judged,
)
from flocc_lab.experiments.overlap import require_overlap
from flocc_lab.experiments.plots import COLOURS, drawn_values, from_zero, spread_line
from flocc_lab.experiments.simulated import simulated
from flocc_lab.experiments.statistics import grouped, middle, values, with_spread
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Scenario, TracksScenario
from flocc_launch.scenarios.shipped import read_scenario
from flocc_launch.setup.cache import cache_folder
from flocc_launch.simulation.simulate import playbacks_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SYNTHETIC = "synthetic"
NEAR_M = 5.0
NO_ROTATION_RAD = 10.0
"""More than any rotation: turning calls for no keyframe."""
SPARSE_M = 4.0
"""Up to here the paper's ATE stays low."""
WALKERS = 3
MEASURES = {
    "ate_m": "joint ATE, m",
    "closures": "closures between robots",
    "latent_bytes": "latents on all disks, MB",
    "bytes": "sent by all robots, MB",
}
SOURCE = "Sec. IV-D, sparse keyframes"


class SparseKeyframesSettings(Settings):
    """Which back-ends, on what, and how sparse."""

    distances_m: tuple[float, ...] = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0)
    """Distances between keyframes."""
    backends: tuple[str, ...] = ("classical", SYNTHETIC)
    """Back-ends: classical, synthetic, or configured, which is the one of --perception."""
    perception: PerceptionConfig = PerceptionConfig()
    """The configured back-end, such as mast3r with its checkpoints: the [perception] of a configuration file."""
    scenario: str = "demo"
    """Scenario with images, a file or a shipped one, for the image-based back-ends; its keyframes are replaced."""
    area_m: float = Field(20.0, gt=0)
    """Edge of the town of the synthetic back-end's walks."""
    length_m: float = Field(60.0, gt=0)
    """Length of each of these walks."""
    runs: int = Field(3, ge=1, le=100)
    """Repetitions with other seeds: links and workers, and for synthetic also walks and drift."""


def prepare(settings: SparseKeyframesSettings, progress: Progress) -> None:
    """Make the data, and refuse robots that never see one place.

    Raises:
        FloccError: A back-end is unknown or its checkpoint is wrong, there is no ground truth, or no overlap.
    """
    from flocc_agent.perception.backends import build_perception

    for backend in settings.backends:
        given = scenario(settings, backend, min(settings.distances_m), 1)
        build_perception(given.perception)
        made = recordings(given, progress) if given.tracks is None else {}
        require_overlap(playbacks_of(given, made), NEAR_M, f"scenario {given.name}")


def cells(settings: SparseKeyframesSettings) -> list[Cell]:
    """Every back-end at every distance."""
    return [
        Cell({"backend": backend, "distance_m": distance_m}, run)
        for backend in settings.backends
        for distance_m in settings.distances_m
        for run in range(settings.runs)
    ]


def measure(settings: SparseKeyframesSettings, cell: Cell, seed: int) -> Row:
    """Simulate one swarm."""
    given = scenario(settings, cell.parameters["backend"], cell.parameters["distance_m"], seed)
    made = recordings(given) if given.tracks is None else {}
    found = simulated(given, seed, made, cache_folder() / "perception")
    report = found.report
    return {
        "keyframes": sum(robot.keyframes for robot in report.robot_details),
        "ate_m": report.ate_joint_m,
        "ate_odometry_m": report.ate_joint_odometry_m,
        "map_frames": len(report.map_frames),
        "closures": report.closures.accepted_inter_robot,
        "latent_bytes": found.latent_bytes,
        "record_bytes": found.record_bytes,
        "bytes": sum(report.bytes.values()),
    }


def scenario(settings: SparseKeyframesSettings, backend: str, distance_m: float, seed: int) -> Scenario:
    """The swarm of one cell.

    Raises:
        ExperimentError: The back-end is unknown.
    """
    keyframes = KeyframeConfig(distance_m=distance_m, rotation_rad=NO_ROTATION_RAD)
    match backend:
        case "synthetic":
            tracks = TracksScenario(robots=WALKERS, seed=seed, area_m=settings.area_m, length_m=settings.length_m)
            perception = PerceptionConfig(method="synthetic")
            return Scenario(name="walks", seed=seed, tracks=tracks, keyframes=keyframes, perception=perception)
        case "classical" | "configured":
            chosen = settings.perception if backend == "configured" else PerceptionConfig(method="classical")
            return read_scenario(settings.scenario, {}).model_copy(
                update={"keyframes": keyframes, "perception": chosen, "seed": seed}
            )
    raise ExperimentError(f"there is no back-end {backend!r}; there are classical, synthetic and configured")


def summarise(_settings: SparseKeyframesSettings, rows: Sequence[Row]) -> Summary:
    """A row per back-end and distance, medians over the runs."""
    table = [
        {
            "backend": backend,
            "distance_m": distance_m,
            "runs": len(of_level),
            "merged": sum(row["map_frames"] == 1 for row in of_level),
            "keyframes": middle(of_level, "keyframes"),
            **with_spread(of_level, "ate_m"),
            "ate_odometry_m": middle(of_level, "ate_odometry_m"),
            "closures": middle(of_level, "closures"),
            "latent_bytes": middle(of_level, "latent_bytes"),
            "record_bytes": middle(of_level, "record_bytes"),
            "bytes": middle(of_level, "bytes"),
        }
        for (backend, distance_m), of_level in grouped(rows, "backend", "distance_m").items()
    ]
    return Summary(
        table,
        [finding(backend, of_backend) for (backend,), of_backend in grouped(rows, "backend").items()],
        notes(rows),
    )


def finding(backend: str, rows: Sequence[Row]) -> ExperimentFinding:
    """Whether the error stays low, of the runs whose densest keyframes make one map that is better than odometry.

    It does where at every distance up to 4 m these runs still end in one map, with at most twice the densest ATE.
    """
    levels = {key[0]: group for key, group in sorted(grouped(rows, "distance_m").items())}
    densest, odometry_m = levels[min(levels)], middle(rows, "ate_odometry_m")
    merging = {row["run"] for row in densest if row["map_frames"] == 1}
    densest_m, shown, low = middle(densest, "ate_m"), [], True
    for distance_m, group in levels.items():
        ate_m, merged = middle(group, "ate_m"), {row["run"] for row in group if row["map_frames"] == 1}
        shown.append(f"{distance_m:g} m: {_metres(ate_m)} ({len(merged)}/{len(group)} merged)")
        if distance_m <= SPARSE_M:
            low &= merging <= merged and ate_m is not None and densest_m is not None and ate_m <= 2.0 * densest_m
    better = densest_m is not None and odometry_m is not None and densest_m < odometry_m
    numbers = f"{', '.join(shown)}, odometry alone {_metres(odometry_m)}."
    if not better:
        numbers += " The densest map is no better than odometry here, so there is nothing to keep low."
    holds = low if better and max(levels) >= SPARSE_M and len(levels) > 1 else None
    claim = f"{backend}: ATE stays low up to {SPARSE_M:g} m between keyframes (at most twice the densest one's)"
    return judged(claim, SOURCE, holds, numbers)


def _metres(value: float | None) -> str:
    return "n/a" if value is None else f"{value:.2f} m"


def notes(rows: Sequence[Row]) -> list[str]:
    """What the table cannot show."""
    said = ["The ATE is n/a where the robots end in several frames; medians are over the runs that have one."]
    if all(row["backend"] != "configured" for row in rows):
        said.append("MASt3R is not in the table: it needs checkpoints (--backends configured --perception FILE).")
    if any(row["backend"] == SYNTHETIC for row in rows):
        said.append(
            "synthetic is a noise model on walks of its own: its errors cannot be compared with image-based ones."
        )
    return said


def draw(figure: "Figure", _settings: SparseKeyframesSettings, rows: Sequence[Row]) -> None:
    """A panel per measure, a line per back-end."""
    figure.set_size_inches(9.5, 7.0)
    panels = figure.subplots(2, 2, sharex=True).flat
    for panel, (column, label) in zip(panels, MEASURES.items(), strict=True):
        for k, ((backend,), of_backend) in enumerate(grouped(rows, "backend").items()):
            levels = [(key[0], group) for key, group in grouped(of_backend, "distance_m").items()]
            spread_line(panel, levels, column, k, backend)
            if column == "ate_m" and (odometry := middle(of_backend, "ate_odometry_m")) is not None:
                panel.axhline(odometry, color=COLOURS[k], linestyle=":", label=f"{backend}: odometry alone")
        panel.set_ylabel(label)
        extra = values(rows, "ate_odometry_m") if column == "ate_m" else []
        from_zero(panel, [*drawn_values(rows, column), *extra])
    figure.axes[0].legend(fontsize=8)
    for panel in figure.axes[2:]:
        panel.set_xlabel("distance between keyframes, m")


SPARSE_KEYFRAMES = Experiment(
    name="sparse-keyframes",
    title="error, memory and bytes against the distance between keyframes",
    settings=SparseKeyframesSettings,
    quick={"backends": (SYNTHETIC,), "distances_m": (1.0, 4.0), "area_m": 8.0, "length_m": 20.0, "runs": 1},
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
    prepare=prepare,
)
