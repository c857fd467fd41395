"""`flocc evaluate --plot`: trajectories and errors as PNG and SVG, for papers and slides; drawn by matplotlib."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flocc_agent.extras import to_install
from flocc_launch.report.figure_charts import errors_after, errors_before
from flocc_launch.report.figure_map import AXIS_NAMES, MapScene, scenes, view_of
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_protocol.errors import FloccError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#b5508f", "#c98a00", "#3a9bd9", "#6b5fc7", "#6f6f6f")
"""Of the report's light theme."""
FORMATS = ("png", "svg")
DPI = 200
STYLE: Any = {"svg.hashsalt": "flocc", "font.size": 9.0, "axes.spines.top": False, "axes.spines.right": False}
SIZE_IN = (9.0, 4.4)
ERRORS_SIZE_IN = (6.4, 3.6)


class PlotError(FloccError):
    """Nothing can be drawn; one sentence says why."""


def write_plots(loaded: LoadedRun, folder: Path) -> list[Path]:
    """Write `trajectories` and, where ground truth is known, `errors` into a run's folder.

    Raises:
        PlotError: matplotlib is not installed, or no robot has a corrected trajectory or ground truth.
    """
    try:
        import matplotlib as mpl
    except ImportError as error:
        raise PlotError(f"--plot needs matplotlib: {to_install('figures')}") from error
    shown = scenes(loaded)
    if not shown:
        raise PlotError(f"{folder}: no robot has a corrected trajectory or ground truth to draw")
    with mpl.rc_context(STYLE):
        figures = {"trajectories": trajectories(loaded, shown)}
        if any(track.true.any() for track in loaded.tracks.values()):
            figures["errors"] = errors(loaded)
        return [save(figure, folder / f"{name}.{kind}") for name, figure in figures.items() for kind in FORMATS]


def save(figure: "Figure", path: Path) -> Path:
    """Write a figure so that the same run gives the same file."""
    metadata = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    figure.savefig(path, dpi=DPI, metadata=metadata)
    return path


def trajectories(loaded: LoadedRun, shown: list[MapScene]) -> "Figure":
    """Before and after, seen from above, one row per map."""
    from matplotlib.figure import Figure

    view, rows = view_of(shown), (len(shown) + 1) // 2
    figure = Figure(figsize=(SIZE_IN[0], SIZE_IN[1] * rows), layout="constrained")
    places = figure.subplots(rows, 2, squeeze=False, sharex="row", sharey="row").flat
    for axes, scene in zip(places, shown, strict=True):
        axes.set_title(scene.name, loc="left")
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlabel(f"{AXIS_NAMES[view.across]}, m")
        axes.set_ylabel(f"{AXIS_NAMES[view.up]}, m")
        for points in scene.truth_m.values():
            axes.plot(points[:, view.across], points[:, view.up], ":", color="0.55", linewidth=1.0)
        for robot, points in scene.lines_m.items():
            across, up = points[:, view.across], points[:, view.up]
            axes.plot(across, up, color=colour_of(loaded, robot), linewidth=1.4, label=robot)
        if scene.with_closures:
            draw_closures(axes, loaded, scene, (view.across, view.up))
    figure.axes[0].legend(frameon=False)
    return figure


def draw_closures(axes: "Axes", loaded: LoadedRun, scene: MapScene, plane: tuple[int, int]) -> None:
    """Thin lines between the keyframes of accepted closures."""
    for pair in loaded.pairs:
        lines = [scene.lines_m.get(keyframe.log.robot) for keyframe in (pair.query, pair.match)]
        if not pair.accepted or lines[0] is None or lines[1] is None:
            continue
        if pair.query.index < len(lines[0]) and pair.match.index < len(lines[1]):
            ends = np.array([lines[0][pair.query.index], lines[1][pair.match.index]])[:, plane]
            axes.plot(*ends.T, color="0.2", linewidth=0.5, alpha=0.5)


def errors(loaded: LoadedRun) -> "Figure":
    """Error of each keyframe over the recording: odometry dashed, corrected solid."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=ERRORS_SIZE_IN, layout="constrained")
    axes, after = figure.subplots(), errors_after(loaded)
    known = {robot: track for robot, track in loaded.tracks.items() if track.true.any()}
    start_s = min(float(track.stamps_s[0]) for track in known.values())
    for robot, track in known.items():
        times_s, colour = track.stamps_s - start_s, colour_of(loaded, robot)
        axes.plot(times_s, errors_before(track), "--", color=colour, linewidth=1.0)
        if robot in after:
            axes.plot(times_s, after[robot], color=colour, linewidth=1.4, label=robot)
    axes.set_xlabel("stamp, s")
    axes.set_ylabel("error, m")
    axes.set_ylim(bottom=0.0)
    axes.set_title("Error of each keyframe; dashed: odometry from its true start", loc="left")
    axes.legend(frameon=False)
    return figure


def colour_of(loaded: LoadedRun, robot: str) -> str:
    """A robot's colour, as in the report."""
    return COLOURS[loaded.robots.index(robot) % len(COLOURS)] if robot in loaded.robots else COLOURS[-1]
