"""`flocc experiment distributed`: RBCD against the known optima of g2o sets, cut among robots, over links that lose.

The machines are those of `flocc_lab.rbcd`; each cell ends when the cost is within the limit of the listed
optimum, or at the most iterations. Robots begin with their own odometry in their own frames.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import PoseGraph
from flocc_lab.experiments.experiment import (
    Cell,
    Experiment,
    ExperimentError,
    ExperimentFinding,
    Progress,
    Row,
    Settings,
    Summary,
    grid,
    judged,
)
from flocc_lab.experiments.plots import COLOURS
from flocc_lab.rbcd.machine import RbcdParameters
from flocc_lab.rbcd.run import cut_by_time, graph_cost, optimise_together
from flocc_launch.graph_files import read_g2o

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OPTIMA = {
    "sphere2500": 1687.006,
    "parking-garage": 1.26252,
    "smallGrid3D": 1025.398,
    "tinyGrid3D": 18.5194,
    "CSAIL": 31.4703,
    "kitti_00": 125.681,
}
"""SE-Sync's objective at the optimum, as ../shared/data/README.md lists it."""
TOLERANCE = 1e-7


class DistributedSettings(Settings):
    """Which sets, among how many robots, over which links."""

    data: Path = Path("../shared/data/g2o")
    """Folder of the g2o files."""
    sets: tuple[str, ...] = ("tinyGrid3D", "smallGrid3D", "CSAIL", "sphere2500", "parking-garage", "kitti_00")
    """Sets, by the name of their file."""
    robots: int = Field(5, ge=2, le=32)
    """Robots among which each set is cut by time; tinyGrid3D is cut among two."""
    losses: tuple[float, ...] = (0.0, 0.3)
    """Shares of messages that each receiver loses."""
    iterations_max: int = Field(3000, ge=1)
    """A cell ends when the slowest robot has done so many."""
    limit_ratio: float = Field(1e-3, gt=0)
    """How near to the optimum counts as reached."""


def cells(settings: DistributedSettings) -> list[Cell]:
    """Every set over every link."""
    return grid(dataset=settings.sets, loss_ratio=settings.losses)


def prepare(settings: DistributedSettings, _progress: Progress) -> None:
    """Refuse sets that are not there or whose optimum is not known."""
    for name in settings.sets:
        if name not in OPTIMA:
            raise ExperimentError(f"the optimum of {name!r} is not known; there are {', '.join(OPTIMA)}")
        if not (settings.data / f"{name}.g2o").is_file():
            raise ExperimentError(f"{settings.data / name}.g2o: is not there; give --data")


def measure(settings: DistributedSettings, cell: Cell, seed: int) -> Row:
    """Let robots optimise one set together."""
    name, loss_ratio = cell.parameters["dataset"], cell.parameters["loss_ratio"]
    graph = cut(settings, name)
    optimum, costs = OPTIMA[name], [float("inf")]

    def look(_number: int, poses: object) -> bool:
        costs.append(graph_cost(graph, poses))  # type: ignore[arg-type]
        return costs[-1] <= optimum * (1.0 + settings.limit_ratio)

    parameters = RbcdParameters(tolerance=TOLERANCE)
    run = optimise_together(
        graph, config(), parameters, loss_ratio=loss_ratio, seed=seed,
        iterations_max=settings.iterations_max, on_iteration=look,
    )  # fmt: skip
    return {
        "robots": len(graph.trajectories),
        "keyframes": sum(map(len, graph.trajectories.values())),
        "between_robots": sum(c.query.log != c.match.log for c in graph.closures),
        "optimum": optimum,
        "cost": costs[-1],
        "above_ratio": costs[-1] / optimum - 1.0,
        "reached": costs[-1] <= optimum * (1.0 + settings.limit_ratio),
        "iterations": max(run.iterations.values()),
        "virtual_s": run.end_s,
        "messages": run.traffic.messages,
        "bytes": run.traffic.payload_bytes,
    }


def cut(settings: DistributedSettings, name: str) -> PoseGraph:
    """A set with SE-Sync's noise, among the robots."""
    file = read_g2o(settings.data / f"{name}.g2o", isotropic=True)
    return cut_by_time(file.graph, 2 if name == "tinyGrid3D" else settings.robots)


def config() -> BackendConfig:
    """Plain least squares; one edge over a cut joins two parts."""
    return BackendConfig(
        formulation=Formulation.BASE,
        solver=Solver.LM,
        weight_by_probability=False,
        relative_tolerance=1e-9,
        closures_to_join_min=1,
    )


def summarise(settings: DistributedSettings, rows: Sequence[Row]) -> Summary:
    """A row per cell."""
    columns = [
        "dataset", "robots", "keyframes", "between_robots", "loss_ratio", "optimum", "cost", "above_ratio", "reached",
        "iterations", "virtual_s", "messages", "bytes", "cpu_s",
    ]  # fmt: skip
    return Summary([{name: row[name] for name in columns} for row in rows], findings(settings, rows))


def findings(settings: DistributedSettings, rows: Sequence[Row]) -> list[ExperimentFinding]:
    """Whether RBCD reaches the centralised optimum."""
    reached = [row for row in rows if row["reached"]]
    missed = [
        f"{row['dataset']} ({row['loss_ratio']:.0%} loss): {row['above_ratio']:.2%}"
        for row in rows
        if row not in reached
    ]
    numbers = f"{len(reached)} of {len(rows)} cells" + (f"; above the optimum: {', '.join(missed)}." if missed else ".")
    claim = f"The distributed solver reaches the centralised optimum within {settings.limit_ratio:.1%} of the cost"
    return [judged(claim, "Sec. IV, RBCD", len(reached) == len(rows), numbers)]


def draw(figure: "Figure", _settings: DistributedSettings, rows: Sequence[Row]) -> None:
    """Iterations per set, a bar per link."""
    panel = figure.subplots()
    names = list(dict.fromkeys(row["dataset"] for row in rows))
    losses = list(dict.fromkeys(row["loss_ratio"] for row in rows))
    width = 0.8 / len(losses)
    for k, loss in enumerate(losses):
        of_loss = [row for row in rows if row["loss_ratio"] == loss]
        at = [names.index(row["dataset"]) + (k - (len(losses) - 1) / 2) * width for row in of_loss]
        panel.bar(at, [row["iterations"] for row in of_loss], width, color=COLOURS[k], label=f"{loss:.0%} loss")
    panel.set_xticks(range(len(names)), names, rotation=15)
    panel.set_yscale("log")
    panel.set_ylabel("iterations of each robot")
    panel.legend(frameon=False)


DISTRIBUTED: Experiment[DistributedSettings] = Experiment(
    name="distributed",
    title="RBCD against the optima of g2o sets, over links that lose",
    settings=DistributedSettings,
    quick={"sets": ["tinyGrid3D", "smallGrid3D"], "robots": 3},
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
    prepare=prepare,
)
