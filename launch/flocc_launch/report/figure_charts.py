"""Histogram of match ratios, and each keyframe's error over time."""

import numpy as np
from numpy.typing import NDArray

from flocc_launch.report.figure_map import colour
from flocc_launch.report.svg import Axis, element, path, svg, text_of, title
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.run_records import setting_number
from flocc_launch.runs.tracks import RobotTrack
from flocc_launch.runs.trajectory_errors import alignment

Float = NDArray[np.float64]

WIDTH_PX = 470.0
HEIGHT_PX = 250.0
LEFT_PX, RIGHT_PX, TOP_PX, BOTTOM_PX = 48.0, 12.0, 26.0, 44.0
PEAK_RATIO_MAX = 4.0
BINS = 20


def ratio_figure(loaded: LoadedRun) -> str | None:
    """Histogram of match ratios, accepted upon rejected; None where no ratio is known."""
    known = [(pair.ratio, pair.accepted) for pair in loaded.pairs if pair.ratio is not None]
    if not known:
        return None
    edges = np.linspace(0.0, max(max(ratio for ratio, _ in known), 1e-6), BINS + 1)
    accepted, rejected = (
        np.histogram([ratio for ratio, taken in known if taken is wanted], edges)[0] for wanted in (True, False)
    )
    x, y = axes(0.0, float(edges[-1]), shown_peak(accepted + rejected))
    bars = [bar for k in range(BINS) for bar in stacked(x, y, edges, int(rejected[k]), int(accepted[k]), k)]
    limit = setting_number(loaded.run.settings, "match_ratio_threshold", "match_ratio_min")
    mark = "" if limit is None else threshold(x, y, limit)
    return svg(WIDTH_PX, HEIGHT_PX, frame(x, y, "match ratio, Eq. (1)", "pairs"), *bars, mark, label="Match ratios")


def shown_peak(counts: NDArray[np.int_]) -> float:
    """Height of the axis: one bin far above all others is cut, so that the others can be seen."""
    highest, second = (float(count) for count in np.sort(counts)[::-1][:2])
    return highest if highest <= PEAK_RATIO_MAX * second or second == 0 else PEAK_RATIO_MAX * second


def stacked(x: Axis, y: Axis, edges: Float, rejected: int, accepted: int, k: int) -> list[str]:
    """The two bars of one bin; a bin that is cut says its count."""
    left, width = x(float(edges[k])) + 0.7, max(x(float(edges[k + 1])) - x(float(edges[k])) - 1.4, 1.0)
    bars = []
    for low, count, name in ((0, rejected, "bad"), (rejected, accepted, "good")):
        top, bottom = (y(min(value, y.high)) for value in (low + count, low))
        if count and bottom > top:
            word = "accepted" if name == "good" else "rejected"
            said = title(f"{count} {word}, ratio {edges[k]:.2f} to {edges[k + 1]:.2f}")
            bars.append(element("rect", said, x=left, y=top, width=width, height=bottom - top, class_=f"bar {name}"))
    if rejected + accepted > y.high:
        bars.append(element("text", f"↑ {rejected + accepted}", x=left, y=y.to_px - 5, font_size=12))
    return bars


def threshold(x: Axis, y: Axis, limit: float) -> str:
    """A line at R_thr."""
    at = x(limit)
    if not x.from_px <= at <= x.to_px:
        return ""
    line = element("line", x1=at, x2=at, y1=y.to_px, y2=y.from_px, class_="mark")
    return line + element("text", f"R_thr {limit:g}", x=at + 5, y=TOP_PX + 12, font_size=12)


def error_figure(loaded: LoadedRun) -> str | None:
    """Position error of every keyframe over the recording, before dashed and after; None without truth."""
    after = errors_after(loaded)
    before = {robot: errors_before(track) for robot, track in loaded.tracks.items() if track.true.any()}
    if not before:
        return None
    most = max(float(np.nanmax(errors, initial=1e-3)) for errors in (*before.values(), *after.values()))
    start_s = min(float(loaded.tracks[robot].stamps_s[0]) for robot in before)
    stop_s = max(float(loaded.tracks[robot].stamps_s[-1]) for robot in before)
    x, y = axes(0.0, max(stop_s - start_s, 1e-3), most)
    lines = []
    for robot in before:
        times_s = loaded.tracks[robot].stamps_s - start_s
        drawn = curve(times_s, before[robot], x, y, "track thin dashed")
        if robot in after:
            drawn += curve(times_s, after[robot], x, y, "track")
        lines.append(element("g", drawn, class_=colour(loaded.robots, robot)))
    return svg(WIDTH_PX, HEIGHT_PX, frame(x, y, "stamp, s", "error, m"), *lines, label="Error of each keyframe")


def errors_before(track: RobotTrack) -> Float:
    """Position error (N,) of odometry put at its true first pose, NaN without truth."""
    errors = np.full(len(track), np.nan)
    estimate, truth = track.odometry_and_true()
    errors[track.true] = np.linalg.norm(estimate[:, :3, 3] - truth[:, :3, 3], axis=1)
    return errors


def errors_after(loaded: LoadedRun) -> dict[str, Float]:
    """Position error (N,) of each robot once all of its map frame are aligned together."""
    errors = {}
    for frame_name in {track.map_frame for track in loaded.tracks.values() if track.map_frame is not None}:
        members = {robot: track for robot, track in loaded.tracks.items() if track.map_frame == frame_name}
        pairs = [track.corrected_and_true() for track in members.values()]
        if not sum(len(truth) for _, truth in pairs):
            continue
        T_world_map = alignment([estimate for estimate, _ in pairs], [truth for _, truth in pairs])
        for robot, track in members.items():
            offsets = (T_world_map @ track.T_map_body)[:, :3, 3] - track.T_world_body[:, :3, 3]
            errors[robot] = np.linalg.norm(offsets, axis=1)
    return errors


def curve(times_s: Float, values: Float, x: Axis, y: Axis, class_: str) -> str:
    """A line through the known values."""
    known = np.isfinite(values)
    points = zip(times_s[known], values[known], strict=True)
    return path([(x(float(t)), y(float(value))) for t, value in points], class_)


def axes(low: float, high: float, most: float) -> tuple[Axis, Axis]:
    """Axes of a small chart; y starts at zero."""
    x = Axis(low, high, LEFT_PX, WIDTH_PX - RIGHT_PX)
    return x, Axis(0.0, most * 1.12, HEIGHT_PX - BOTTOM_PX, TOP_PX)


def frame(x: Axis, y: Axis, x_name: str, y_name: str) -> str:
    """Grid, ticks and names of the axes."""
    parts = []
    for tick in y.ticks(4):
        parts.append(element("line", x1=x.from_px, x2=x.to_px, y1=y(tick), y2=y(tick), class_="grid"))
        parts.append(element("text", f"{tick:g}", x=x.from_px - 7, y=y(tick) + 4, text_anchor="end", class_="soft"))
    below = {"y": y.from_px + 18, "text_anchor": "middle", "class_": "soft"}
    parts.extend(element("text", f"{tick:g}", x=x(tick), **below) for tick in x.ticks(6))
    parts.append(element("line", x1=x.from_px, x2=x.to_px, y1=y.from_px, y2=y.from_px, class_="axis"))
    middle = (x.from_px + x.to_px) / 2
    parts.append(element("text", text_of(x_name), x=middle, y=HEIGHT_PX - 6, text_anchor="middle", class_="soft"))
    parts.append(element("text", text_of(y_name), x=0, y=12, class_="soft", font_size=12))
    return "".join(parts)
