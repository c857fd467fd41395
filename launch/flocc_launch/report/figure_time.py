"""Over time, on one axis: map frames, leaders, neighbours and closures."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from flocc_agent.core.reports import CorrectionApplied
from flocc_agent.runtime.event_lines import of_kind
from flocc_agent.runtime.facts import AgentDied, AgentStopped
from flocc_launch.report.figure_map import colour
from flocc_launch.report.model import RunReport
from flocc_launch.report.svg import Axis, element, path, svg, text_of, title
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.plain_numbers import count_of, seconds
from flocc_launch.runs.timeline import Link
from flocc_protocol.ids import LogId

WIDTH_PX = 960.0
LEFT_PX, LEFT_PX_MAX = 118.0, 320.0
NAME_PX = 7.0
"""Width of a letter of a row's name."""
RIGHT_PX = 18.0
ROW_PX = 21.0
BAR_PX = 15.0
HEADING_PX = 30.0
CURVE_PX = 120.0
PAIR_ROWS_MAX = 15
LANE_PX = 17.0


@dataclass(frozen=True, slots=True)
class Bar:
    """A coloured bar in a row."""

    from_s: float
    to_s: float
    class_: str
    label: str
    said: str


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the chart; `below` are bars of the lower half, where a row has two sides."""

    name: str
    class_: str
    spans: Sequence[Bar]
    below: Sequence[Bar] | None = None


def time_figure(loaded: LoadedRun, report: RunReport) -> str:
    """Draw everything that happened over time."""
    groups = [
        ("Map frame", frame_rows(loaded)),
        ("Leader followed", leader_rows(loaded)),
        ("Neighbours heard", link_rows(loaded)),
    ]
    left_px = room_for([row.name for _, rows in groups for row in rows])
    axis = Axis(0.0, max(loaded.end_s, 1e-3), left_px, WIDTH_PX - RIGHT_PX)
    marked = moments(loaded, report)
    top = LANE_PX * len(marked)
    drawn: list[str] = []
    y = top
    for heading, rows in groups:
        if rows:
            drawn.append(heading_of(heading, y))
            y += HEADING_PX
            drawn.extend(draw_row(row, axis, y + k * ROW_PX) for k, row in enumerate(rows))
            y += len(rows) * ROW_PX + 8
    drawn.append(heading_of("Closures so far", y))
    drawn.append(closure_curves(loaded, axis, y + HEADING_PX))
    y += HEADING_PX + CURVE_PX
    behind = time_grid(axis, top + HEADING_PX - 4, y)
    return svg(WIDTH_PX, y + 34, behind, *drawn, draw_moments(marked, axis, y), label="What happened over time")


def room_for(names: Sequence[str]) -> float:
    """Width of the names at the left, in pixels."""
    return min(max(LEFT_PX, 24 + NAME_PX * max(map(len, names), default=0)), LEFT_PX_MAX)


def heading_of(text: str, y: float) -> str:
    """Title of a group of rows."""
    return element("text", text_of(text), x=0, y=y + 19, font_weight=650)


def draw_row(row: Row, axis: Axis, y: float) -> str:
    """Name at the left, bars at the right."""
    name = element("text", text_of(row.name), x=14, y=y + 12, class_="row", font_size=12.5)
    rail = element("line", x1=axis.from_px, x2=axis.to_px, y1=y + BAR_PX / 2, y2=y + BAR_PX / 2, class_="grid")
    if row.below is None:
        return name + rail + "".join(draw_span(span, axis, y, BAR_PX) for span in row.spans)
    half = BAR_PX / 2 - 0.5
    above = "".join(draw_span(span, axis, y, half) for span in row.spans)
    return name + rail + above + "".join(draw_span(span, axis, y + half + 1, half) for span in row.below)


def draw_span(span: Bar, axis: Axis, y: float, height: float) -> str:
    """One bar, with its label where there is room."""
    x, width = axis(span.from_s), max(axis(span.to_s) - axis(span.from_s), 1.5)
    bar = element("rect", x=x, y=y, width=width, height=height, rx=2, class_="span")
    roomy = width > 7.5 * len(span.label) + 8 and height > 10
    label = element("text", text_of(span.label), x=x + 5, y=y + 11.5, class_="span-name") if roomy else ""
    return element("g", title(span.said), bar, label, class_=span.class_)


def frame_rows(loaded: LoadedRun) -> list[Row]:
    """Which map frame each robot was in."""
    names = list(loaded.robots)
    return [Row(robot, colour(names, robot), frame_spans(loaded, robot)) for robot in names]


def frame_spans(loaded: LoadedRun, robot: str) -> list[Bar]:
    """Stretches of one robot in one map frame; a robot that died is in none."""
    changes: list[tuple[float, str | None]] = []
    for event in loaded.events:
        if event.robot == robot and isinstance(event.fact, CorrectionApplied | AgentDied | AgentStopped):
            frame = event.fact.map_frame if isinstance(event.fact, CorrectionApplied) else None
            if not changes or changes[-1][1] != frame:
                changes.append((event.t, frame))
    spans = []
    for (from_s, frame), (to_s, _) in pairwise([*changes, (loaded.end_s, None)]):
        if frame is not None:
            said = f"{robot} in {frame}: {seconds(from_s)} to {seconds(to_s)}"
            spans.append(Bar(from_s, to_s, colour(loaded.robots, anchor_of(frame)), frame, said))
    return spans


def anchor_of(map_frame: str) -> str:
    """Robot that a map frame is named after; the frame itself where it is named otherwise."""
    name = map_frame.removeprefix("map/")
    try:
        return LogId.parse(name).robot
    except ValueError:
        return name


def leader_rows(loaded: LoadedRun) -> list[Row]:
    """Whom each robot followed."""
    rows = []
    for robot in loaded.robots:
        spans = [
            Bar(
                span.from_s, span.to_s, colour(loaded.robots, span.leader), span.leader,
                f"{robot} followed {span.leader} (term {span.term}): {seconds(span.from_s)} to {seconds(span.to_s)}",
            )
            for span in loaded.followings
            if span.robot == robot
        ]  # fmt: skip
        rows.append(Row(robot, colour(loaded.robots, robot), spans))
    return rows


def link_rows(loaded: LoadedRun) -> list[Row]:
    """Who heard whom: a row per pair of robots, or per robot where there are many."""
    pairs = [(a, b) for k, a in enumerate(loaded.robots) for b in loaded.robots[k + 1 :]]
    if len(pairs) > PAIR_ROWS_MAX:
        return [Row(robot, colour(loaded.robots, robot), heard_by(loaded, robot)) for robot in loaded.robots]
    return [
        Row(f"{a} ↔ {b}", "c7", link_spans(loaded.links, a, b, "c7"), link_spans(loaded.links, b, a, "c7"))
        for a, b in pairs
    ]


def link_spans(links: Iterable[Link], robot: str, peer: str, class_: str) -> list[Bar]:
    """When one robot heard one other."""
    return [
        Bar(k.from_s, k.to_s, class_, "", f"{robot} heard {peer}: {seconds(k.from_s)} to {seconds(k.to_s)}")
        for k in links
        if (k.robot, k.peer) == (robot, peer)
    ]


def heard_by(loaded: LoadedRun, robot: str) -> list[Bar]:
    """How many neighbours one robot heard, as bars with their count."""
    mine = [link for link in loaded.links if link.robot == robot]
    times = sorted({link.from_s for link in mine} | {link.to_s for link in mine})
    spans = []
    for from_s, to_s in pairwise(times):
        heard = sum(link.from_s <= from_s and to_s <= link.to_s for link in mine)
        if heard:
            spans.append(Bar(from_s, to_s, "c7", str(heard), f"{robot} heard {heard} robots"))
    return spans


def closure_curves(loaded: LoadedRun, axis: Axis, top: float) -> str:
    """Accepted and rejected pairs so far."""
    accepted = sorted(pair.at_s for pair in loaded.pairs if pair.accepted and pair.at_s is not None)
    rejected = sorted(pair.at_s for pair in loaded.pairs if pair.rejected and pair.at_s is not None)
    most = max(len(accepted), len(rejected), 1)
    y = Axis(0, most, top + CURVE_PX - 6, top + 6)
    lines = []
    for tick in y.ticks(3):
        lines.append(element("line", x1=axis.from_px, x2=axis.to_px, y1=y(tick), y2=y(tick), class_="grid"))
        label = element(
            "text", count_of(round(tick)), x=axis.from_px - 8, y=y(tick) + 4, text_anchor="end", class_="soft"
        )
        lines.append(label if tick == round(tick) else "")
    for times, class_ in ((rejected, "steps bad"), (accepted, "steps")):
        lines.append(path(steps(times, axis, y, loaded.end_s), class_))
    counted = ((len(accepted), "accepted", "steps"), (len(rejected), "rejected", "steps bad"))
    return "".join(lines) + "".join(
        curve_name(*row, axis.from_px + 8, top + 12 + 17 * k) for k, row in enumerate(counted)
    )


def steps(times: Sequence[float], axis: Axis, y: Axis, end_s: float) -> list[tuple[float, float]]:
    """Corners of a staircase that rises by one at each time."""
    corners = [(axis(0.0), y(0.0))]
    for k, t in enumerate(times):
        corners += [(axis(t), y(k)), (axis(t), y(k + 1))]
    return [*corners, (axis(end_s), y(len(times)))]


def curve_name(count: int, name: str, class_: str, x: float, y: float) -> str:
    """Name and final count of a curve, beside a piece of its line."""
    line = element("line", x1=x, x2=x + 24, y1=y, y2=y, class_=class_)
    return line + element("text", f"{count} {name}", x=x + 30, y=y + 4, font_size=12.5)


def time_grid(axis: Axis, top: float, bottom: float) -> str:
    """Vertical lines and their times."""
    lines = []
    for tick in axis.ticks(9):
        x = axis(tick)
        lines.append(element("line", x1=x, x2=x, y1=top, y2=bottom, class_="grid"))
        lines.append(element("text", f"{tick:g} s", x=x, y=bottom + 18, text_anchor="middle", class_="soft"))
    return "".join(lines)


def moments(loaded: LoadedRun, report: RunReport) -> list[tuple[float, str, str]]:
    """Time, name and class of the moments that are marked, in order of time: merges, those taken back, deaths."""
    found = [(event.t, f"{event.robot} died", "mark bad") for event in of_kind(loaded.events, AgentDied)]
    found += [(span.to_s, "merge taken back", "mark bad") for span in report.merges_taken_back]
    if report.merged_after_s is not None:
        found.append((report.merged_after_s, f"one map after {seconds(report.merged_after_s)}", "mark"))
    return sorted(found)


def draw_moments(marked: Sequence[tuple[float, str, str]], axis: Axis, bottom: float) -> str:
    """Lines through the whole chart, each named in a lane of its own at the top."""
    drawn = []
    for lane, (t, text, class_) in enumerate(marked):
        x, y = axis(t), LANE_PX * lane + 4
        left = x > (axis.from_px + axis.to_px) / 2
        side = {"x": x + (-5 if left else 5), "text_anchor": "end" if left else "start"}
        drawn.append(element("line", x1=x, x2=x, y1=y, y2=bottom, class_=class_))
        drawn.append(element("text", text_of(text), **side, y=y + 10, font_size=12.5))
    return "".join(drawn)
