"""The pose graphs of `flocc experiment scale`: generated ones, and cosmo_bench's in drawn network units.

Poor odometry is that of a VIO whose scale is some per cent off, differently on every robot; Eq. (6) inherits its error.
"""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flocc_agent.core.pose_graph import LoopClosure, PoseGraph, Trajectory, components_of
from flocc_agent.geometry import in_units, inverse
from flocc_lab.bench.generated_graph import Noise, generate
from flocc_lab.experiments.benchmarks import cosmo_file
from flocc_lab.experiments.experiment import ExperimentError, Settings
from flocc_launch.graph_files import read_graph_file
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

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
    joining = [c for c in graph.closures if counts[c.query.log, c.match.log] >= JOINING_MIN]
    return len(components_of(list(graph.trajectories), joining)) == 1


def _cosmo(settings: ScaleSettings, source: str, rng: np.random.Generator) -> DrawnGraph:
    """The file's graph; closures between robots in network units of their own."""
    file = read_graph_file(cosmo_file(settings.data, source))
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
    covariance = None if closure.covariance is None else in_units(closure.covariance, unit_m)
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
