"""`flocc experiment faults`: what loss, range and the number of robots do to a swarm, on virtual time.

Robots walk through one town with synthetic perception and the real back end. One thing is varied at a time; runs differ
in walks, drift, links and perception, and runs of the same number are the same walks under every fault.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pydantic import Field

from flocc_agent.config import KeyframeConfig, PerceptionConfig, RadioConfig
from flocc_agent.core.parameters import CoreParameters, RoundParameters
from flocc_lab.experiments.experiment import Cell, Experiment, ExperimentFinding, Row, Settings, Summary, judged
from flocc_lab.experiments.plots import drawn_values, from_zero, spread_line
from flocc_lab.experiments.simulated import simulated
from flocc_lab.experiments.statistics import grouped, middle, with_spread
from flocc_launch.scenarios.scenario import Scenario, TracksScenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AXES = {"loss": "loss_ratio", "range": "range_m", "robots": "robots"}
LABELS = {"loss": "share of messages lost", "range": "communication range, m", "robots": "robots"}
MEASURES = {
    "ate_m": "joint ATE, m",
    "merged_after_s": "one map after, s",
    "bytes": "sent by all robots, MB",
    "leader_changes": "changes of the leader",
}
LATENCY_S = 0.02


class FaultsSettings(Settings):
    """What is varied, and what stays."""

    losses: tuple[float, ...] = (0.0, 0.1, 0.3, 0.5, 0.7, 0.8)
    """Shares of messages lost on every link."""
    ranges_m: tuple[float, ...] = (3.0, 5.0, 8.0, 12.0, 20.0)
    """Communication ranges by true position."""
    robot_counts: tuple[int, ...] = (2, 3, 5, 8, 12, 20, 30)
    """Numbers of robots."""
    robots: int = Field(5, ge=2, le=200)
    """Robots where loss or range is varied."""
    area_m: float = Field(20.0, gt=0)
    """Edge of the square town."""
    length_m: float = Field(40.0, gt=0)
    """Length of each walk."""
    keyframe_distance_m: float = Field(1.5, gt=0)
    """Distance between keyframes."""
    round_s: float = Field(5.0, gt=0)
    """Shortest time between two optimisations; an agent's default of 2 s merges a little sooner and computes longer."""
    runs: int = Field(2, ge=1, le=100)
    """Repetitions with other seeds."""


def cells(settings: FaultsSettings) -> list[Cell]:
    """One axis after the other, all else as it is."""
    base = {"loss_ratio": 0.0, "range_m": None, "robots": settings.robots}
    levels = {"loss": settings.losses, "range": settings.ranges_m, "robots": settings.robot_counts}
    varied = [{"axis": axis, **base, AXES[axis]: level} for axis in AXES for level in levels[axis]]
    return [Cell(parameters, run) for parameters in varied for run in range(settings.runs)]


def measure(settings: FaultsSettings, cell: Cell, seed: int) -> Row:
    """Simulate one swarm."""
    given = cell.parameters
    report = simulated(scenario(settings, given["robots"], given["loss_ratio"], given["range_m"], seed), seed).report
    return {
        "ate_m": report.ate_joint_m,
        "ate_odometry_m": report.ate_joint_odometry_m,
        "merged_after_s": report.merged_after_s,
        "map_frames": len(report.map_frames),
        "closures": report.closures.accepted_inter_robot,
        "bytes": sum(report.bytes.values()),
        "leader_changes": report.leader_changes,
        "virtual_s": report.duration_s,
    }


def scenario(settings: FaultsSettings, robots: int, loss_ratio: float, range_m: float | None, seed: int) -> Scenario:
    """The swarm of one cell."""
    return Scenario(
        name="faults",
        seed=seed,
        tracks=TracksScenario(robots=robots, seed=seed, area_m=settings.area_m, length_m=settings.length_m),
        core=CoreParameters(rounds=RoundParameters(period_s=settings.round_s)),
        keyframes=KeyframeConfig(distance_m=settings.keyframe_distance_m),
        radio=RadioConfig(loss_ratio=loss_ratio, range_m=range_m, latency_s=LATENCY_S),
        perception=PerceptionConfig(method="synthetic"),
    )


def summarise(_settings: FaultsSettings, rows: Sequence[Row]) -> Summary:
    """A row per level, medians over the runs."""
    table = [_level(axis, level, of_level) for axis in AXES for level, of_level in levels_of(rows, axis)]
    return Summary(table, findings(rows), notes(rows))


def levels_of(rows: Sequence[Row], axis: str) -> list[tuple[float, list[Row]]]:
    """Rows of one axis by its level."""
    of_axis = [row for row in rows if row["axis"] == axis]
    return [(level[0], group) for level, group in grouped(of_axis, AXES[axis]).items()]


def _level(axis: str, level: float, rows: Sequence[Row]) -> Row:
    return {
        "axis": axis,
        "level": level,
        "runs": len(rows),
        "merged": sum(row["merged_after_s"] is not None for row in rows),
        "one_frame_at_end": sum(row["map_frames"] == 1 for row in rows),
        **with_spread(rows, "ate_m"),
        "ate_odometry_m": middle(rows, "ate_odometry_m"),
        **with_spread(rows, "merged_after_s"),
        "closures": middle(rows, "closures"),
        "bytes": middle(rows, "bytes"),
        "leader_changes": middle(rows, "leader_changes"),
    }


def findings(rows: Sequence[Row]) -> list[ExperimentFinding]:
    """What DESIGN.md promises: a lost message is never a hole."""
    losses = dict(levels_of(rows, "loss"))
    worst = max(losses, default=0.0)
    if 0.0 not in losses or worst == 0.0:
        return []
    clean, lossy = losses[0.0], losses[worst]
    merged = sum(row["map_frames"] == 1 for row in lossy)
    ate = middle(clean, "ate_m"), middle(lossy, "ate_m")
    numbers = (
        f"{merged} of {len(lossy)} runs with {worst:.0%} loss end in one frame; median ATE "
        f"{_metres(ate[1])} against {_metres(ate[0])} without loss."
    )
    return [
        judged(
            "A swarm that loses messages still ends in one map",
            "docs/concepts.md, What robots tell each other",
            merged == len(lossy),
            numbers,
        )
    ]


def notes(rows: Sequence[Row]) -> list[str]:
    """Which runs have no ATE, and why."""
    apart = [row for row in rows if row["map_frames"] != 1]
    said = "The joint ATE is n/a where the robots end in several frames; the median is over the runs that have one."
    listed = [f"{row['cell']}: {row['map_frames']} frames, {row['closures']} closures." for row in apart]
    return [said, *listed] if apart else []


def _metres(value: float | None) -> str:
    return "n/a" if value is None else f"{value:.2f} m"


def draw(figure: "Figure", _settings: FaultsSettings, rows: Sequence[Row]) -> None:
    """A column per axis, a line of panels per measure."""
    axes = [axis for axis in AXES if levels_of(rows, axis)]
    figure.set_size_inches(1.5 + 3.0 * len(axes), 9)
    panels = figure.subplots(len(MEASURES), len(axes), sharex="col", sharey="row", squeeze=False)
    for column, axis in enumerate(axes):
        levels = levels_of(rows, axis)
        for line, (measure_name, label) in enumerate(MEASURES.items()):
            panel = panels[line][column]
            spread_line(panel, levels, measure_name, label="flocc")
            if measure_name == "ate_m":
                spread_line(panel, levels, "ate_odometry_m", 1, "odometry alone")
            if column == 0:
                panel.set_ylabel(label)
        panels[-1][column].set_xlabel(LABELS[axis])
    panels[0][0].legend(fontsize=8, frameon=False)
    for line, measure_name in zip(panels, MEASURES, strict=True):
        extra = drawn_values(rows, "ate_odometry_m") if measure_name == "ate_m" else []
        from_zero(line[0], [*drawn_values(rows, measure_name), *extra])


FAULTS = Experiment(
    name="faults",
    title="loss, range and number of robots, on virtual time",
    settings=FaultsSettings,
    quick={
        "losses": (0.0, 0.5),
        "ranges_m": (),
        "robot_counts": (),
        "robots": 2,
        "area_m": 8.0,
        "length_m": 12.0,
        "runs": 1,
    },
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
)
