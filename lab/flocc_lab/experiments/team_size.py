"""`flocc experiment team-size`: errors during a mission by the size of the team, by the published protocol.

The graphs are `graph_family.team_walks`'s. Every so many steps a team's graph as it is then is solved, beginning with
the solution before; the errors of those moments are averaged (iATE, iF1), and medians over the graphs stand beside what
was read off the plot of riMESA (arXiv 2603.01178).
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flocc_agent.core.pose_graph import ClosureState, Component, GraphSolution, OptimisationFailed
from flocc_agent.geometry import inverse
from flocc_lab.experiments.experiment import (
    Cell,
    Experiment,
    ExperimentError,
    ExperimentFinding,
    Row,
    Settings,
    Summary,
    judged,
)
from flocc_lab.experiments.plots import COLOURS, MARKERS, label_logarithmic
from flocc_lab.experiments.statistics import grouped, middle
from flocc_lab.graph_family.methods import settings as backend_settings
from flocc_lab.graph_family.team_walks import TEAM_POSES, TEAM_SIZES, TeamGraph, TeamSpec, team_graph
from flocc_launch.runs.trajectory_errors import alignment, rmse_m

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Float = NDArray[np.float64]

ALONE, METRIC, UNKNOWN = "alone", "leader-metric", "leader-unknown"
ARMS: dict[str, Callable[[TeamGraph], TeamGraph]] = {
    ALONE: TeamGraph.alone,
    METRIC: lambda team: team,
    UNKNOWN: TeamGraph.without_lengths,
}
PUBLISHED_M = {
    ALONE: dict(zip(TEAM_SIZES, (1.0, 1.5, 2.3, 3.4, 4.4), strict=True)),
    METRIC: dict(zip(TEAM_SIZES, (0.17, 0.14, 0.12, 0.11, 0.13), strict=True)),
}
"""Median iATE, read off the plot with an error of about 10 %."""
WITHIN_RATIO = 1.2
UNKNOWN_RATIO_MAX = 1.3
AGGREGATIONS = {"iate_mean_m": "mean over robots", "iate_sum_m": "sum over robots"}
PAGE = "docs/experiments.md, team-size"


class TeamSizeSettings(Settings):
    """How large teams are, and how often they are looked at."""

    robots: tuple[int, ...] = TEAM_SIZES
    """Team sizes."""
    graphs: int = Field(20, ge=1, le=1000)
    """Graphs of each size up to 12 robots."""
    graphs_large: int = Field(5, ge=1, le=1000)
    """Graphs of each larger size."""
    poses: int = Field(TEAM_POSES, ge=20)
    """Keyframes of each robot."""
    every: int = Field(10, ge=1)
    """Steps between two looks."""
    outlier_ratio: float = Field(0.0, ge=0, lt=1)
    """Part of closures that are wrong."""
    all_pairs: bool = True
    """Whether at every fifth step all robots in range measure each other; else each robot one of them."""
    arms: tuple[str, ...] = tuple(ARMS)
    """Who solves, and what is known of lengths."""


def cells(settings: TeamSizeSettings) -> list[Cell]:
    """Every arm on every graph, small teams first."""
    return [
        Cell({"robots": robots, "arm": arm}, run)
        for robots in settings.robots
        for run in range(settings.graphs if robots <= 12 else settings.graphs_large)
        for arm in settings.arms
    ]


def measure(settings: TeamSizeSettings, cell: Cell, seed: int) -> Row:
    """Follow one team over its mission."""
    from flocc_agent.backend.optimiser import optimise

    arm = cell.parameters["arm"]
    if arm not in ARMS:
        raise ExperimentError(f"there is no arm {arm!r}; there are {', '.join(ARMS)}")
    spec = TeamSpec(seed, cell.parameters["robots"], settings.poses, settings.outlier_ratio, settings.all_pairs)
    team = ARMS[arm](team_graph(spec))
    solution: GraphSolution | None = None
    aligned, placed, f1 = [], [], []
    for poses in range(settings.every, settings.poses + 1, settings.every):
        now = team.until(poses)
        found = optimise(now.graph, backend_settings(), solution)
        if isinstance(found, OptimisationFailed):
            raise ExperimentError(f"{cell.key}, step {poses}: {found.reason}")
        solution = found
        aligned.append(robot_errors_m(now, solution, align=True))
        placed.append(robot_errors_m(now, solution, align=False))
        f1.append(f1_of(now, solution))
    known = [value for value in f1 if value is not None]
    return {
        "closures": len(team.graph.closures),
        "iate_mean_m": float(np.mean(aligned)),
        "iate_sum_m": float(np.mean(np.sum(aligned, axis=1))),
        "iate_placed_m": float(np.mean(placed)),
        "ate_end_m": float(np.mean(aligned[-1])),
        "if1": float(np.mean(known)) if known else None,
        "components": len(solution.components) if solution else 0,
    }


def robot_errors_m(team: TeamGraph, solution: GraphSolution, align: bool) -> list[float]:
    """RMSE of each robot's positions, every component put where its anchor believes to have begun.

    Args:
        team: The truth.
        solution: The estimates.
        align: Whether one motion of the whole team then brings it onto the truth.
    """
    estimates = [_placed(team, c)[k] for c in solution.components for k in range(len(c.logs))]
    truths = [team.T_world_keyframe[log] for c in solution.components for log in c.logs]
    T = alignment(estimates, truths) if align else np.eye(4)
    return [rmse_m((T @ a)[:, :3, 3] - b[:, :3, 3]) for a, b in zip(estimates, truths, strict=True)]


def _placed(team: TeamGraph, component: Component) -> list[Float]:
    first = component.T_map_keyframe[component.anchor][0]
    T_world_map = team.T_world_odom[component.anchor] @ inverse(first)
    return [np.asarray(T_world_map @ component.T_map_keyframe[log]) for log in component.logs]


def f1_of(team: TeamGraph, solution: GraphSolution) -> float | None:
    """F1 of accepted against right closures; None where there is none of either."""
    used = np.array([result.state is ClosureState.USED for result in solution.closures], dtype=bool)
    total = int(np.count_nonzero(used)) + int(np.count_nonzero(team.is_right))
    return 2.0 * int(np.count_nonzero(used & team.is_right)) / total if total else None


def summarise(_settings: TeamSizeSettings, rows: Sequence[Row]) -> Summary:
    """A row per team size and arm: medians, and what was published."""
    table = [_level(robots, arm, of) for (robots, arm), of in grouped(rows, "robots", "arm").items()]
    notes = [
        "iATE is the mean over the moments; the error of a robot is taken after one alignment of the whole team, "
        "iate_placed_m without any, from the priors on first poses. Published figures are read off a plot.",
    ]
    return Summary(table, findings(table), notes)


def _level(robots: int, arm: str, rows: Sequence[Row]) -> Row:
    names = ("iate_mean_m", "iate_sum_m", "iate_placed_m", "ate_end_m", "if1", "closures", "cpu_s")
    medians = {name: middle(rows, name) for name in names}
    return {"robots": robots, "arm": arm, "graphs": len(rows), "published_m": published_m(arm, robots), **medians}


def published_m(arm: str, robots: int) -> float | None:
    """The published median of an arm; None where there is none."""
    return PUBLISHED_M.get(arm, {}).get(robots)


def findings(table: Sequence[Row]) -> list[ExperimentFinding]:
    """Whether it is the same problem, and what unknown scales cost."""
    found = [_as_published(table, arm) for arm in PUBLISHED_M if any(row["arm"] == arm for row in table)]
    errors = {(row["robots"], row["arm"]): row["iate_mean_m"] for row in table}
    ratios = {
        n: errors[n, UNKNOWN] / errors[n, METRIC] for n, arm in errors if arm == UNKNOWN and (n, METRIC) in errors
    }
    if ratios:
        numbers = ", ".join(f"{ratio:.2f} with {robots} robots" for robots, ratio in ratios.items()) + "."
        claim = f"Without known scales the leader's iATE is at most {UNKNOWN_RATIO_MAX} times the metric one"
        found.append(judged(claim, PAGE, max(ratios.values()) <= UNKNOWN_RATIO_MAX, numbers))
    return found


def _as_published(table: Sequence[Row], arm: str) -> ExperimentFinding:
    """Within a fifth of the published medians at all sizes, in one of the two aggregations."""
    rows = [row for row in table if row["arm"] == arm and row["published_m"]]
    ratios = {column: [row[column] / row["published_m"] for row in rows] for column in AGGREGATIONS}
    holds = any(all(1 / WITHIN_RATIO <= r <= WITHIN_RATIO for r in of) for of in ratios.values()) if rows else None
    shown = [f"{AGGREGATIONS[c]}: {', '.join(f'{r:.2f}' for r in of)} times" for c, of in ratios.items()]
    sizes = ", ".join(str(row["robots"]) for row in rows)
    claim = f"The median iATE of '{arm}' is within 20 % of the published one in one aggregation"
    return judged(claim, PAGE, holds, f"With {sizes or 'no'} robots; {'; '.join(shown)}.")


def draw(figure: "Figure", _settings: TeamSizeSettings, rows: Sequence[Row]) -> None:
    """Median iATE over the size of the team, published ones dashed."""
    panel = figure.subplots()
    for k, ((arm,), of) in enumerate(grouped(rows, "arm").items()):
        style: dict[str, Any] = {"color": COLOURS[k], "marker": MARKERS[k], "markersize": 5}
        levels = sorted(grouped(of, "robots").items())
        panel.plot([n for (n,), _ in levels], [middle(g, "iate_mean_m") or 0.0 for _, g in levels], label=arm, **style)
        known = [(n, value) for (n,), _ in levels if (value := published_m(arm, n)) is not None]
        if known:
            panel.plot(*zip(*known, strict=True), linestyle="--", label=f"{arm}, published", fillstyle="none", **style)
    panel.set_xscale("log")
    panel.set_yscale("log")
    for axis in (panel.xaxis, panel.yaxis):
        label_logarithmic(axis)
    panel.set_xlabel("robots")
    panel.set_ylabel("median iATE, m")
    panel.legend(frameon=False, fontsize=8)


TEAM_SIZE: Experiment[TeamSizeSettings] = Experiment(
    name="team-size",
    title="errors during a mission by team size: alone, a leader, by the published protocol",
    settings=TeamSizeSettings,
    quick={"robots": [3], "graphs": 2, "poses": 100, "every": 50},
    cells=cells,
    measure=measure,
    summarise=summarise,
    draw=draw,
)
