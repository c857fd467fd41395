"""The parts of report.html, in the order in which they are read."""

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

from flocc_launch.doctor import Severity, diagnose_loaded
from flocc_launch.doctor.cameras import CAUSES
from flocc_launch.report.album import Album
from flocc_launch.report.figure_charts import error_figure, ratio_figure
from flocc_launch.report.figure_map import colour, map_figure, scenes, view_of
from flocc_launch.report.figure_time import time_figure
from flocc_launch.report.model import RobotReport, RunReport
from flocc_launch.report.svg import element, text_of
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.plain_numbers import count_of, number, plain, seconds, size_of


def kicker(report: RunReport) -> str:
    """What ran, in one line above the verdict."""
    parts = [f"flocc {report.driver or 'run'}", report.scenario, f"{len(report.robots)} robots"]
    parts += [when(report.start)] if report.start is not None else []
    return element("p", text_of(" · ".join(parts)), class_="kicker")


def when(start: str | float) -> str:
    """Wall clock of a start, to the minute."""
    try:
        moment = datetime.fromisoformat(start) if isinstance(start, str) else datetime.fromtimestamp(start, UTC)
    except (ValueError, OverflowError, OSError):
        return str(start)
    return f"{moment:%Y-%m-%d %H:%M} {moment.tzname() or ''}".rstrip()


def tiles(report: RunReport) -> str:
    """The figures that matter most; errors only where something of the truth is known."""
    known = report.has_truth()
    during = (number(report.iate_m, "m"), f"mean ATE during the run; F1 of closures {number(report.if1)}")
    if report.iate_m is None:
        during = (number(report.if1), "F1 of closures")
    shown = [
        (seconds(report.merged_after_s), "until one map" if report.merged_after_s else "not merged into one map"),
        *((ate_tile(report),) if known else ()),
        (count_of(report.closures.accepted_inter_robot), "closures between robots accepted"),
        *((during,) if known else ()),
        (count_of(report.closures.rejected), "candidates rejected"),
        (size_of(sum(report.bytes.values())) if report.bytes else "–", "sent by all robots"),
        (seconds(report.duration_s), duration_text(report)),
    ]
    made = [element("div", element("b", text_of(v)), element("span", text_of(t)), class_="tile") for v, t in shown]
    return element("div", *made, class_="tiles")


def duration_text(report: RunReport) -> str:
    """On which clock the run was that long."""
    if report.wall_s is None:
        return "run, virtual time" if report.driver == "simulate" else "run"
    wall = seconds(report.wall_s)
    return "run" if wall == seconds(report.duration_s) else f"run; {wall} of wall time"


def ate_tile(report: RunReport) -> tuple[str, str]:
    """The joint error beside odometry's; of the one map there is, where some robots are not in it."""
    before, after = report.ate_joint_odometry_m, report.ate_joint_m
    alone = report.ate_by_frame_m.get(report.map_frames[0]) if len(report.map_frames) == 1 else None
    if after is None and alone is not None:
        return number(alone, "m"), f"ATE of the robots in {report.map_frames[0]}"
    if before is None:
        return number(after, "m"), "joint ATE; ground truth of all robots is needed"
    gain = f" ({100 * (after / before - 1):+.0f}\u00a0%)" if before and after is not None else ""
    return number(after, "m"), f"joint ATE; odometry alone: {number(before, 'm')}{gain}"


def expectations(report: RunReport) -> str:
    """What the scenario asked for, and whether it holds."""
    if not report.expectations:
        return ""
    words = {True: ("good-text", "✓ met"), False: ("bad-text", "✗ missed"), None: ("bad-text", "not measured")}
    rows = []
    for asked in report.expectations:
        class_, said = words[asked.met]
        verdict = element("span", said, class_=class_)
        rows.append([text_of(asked.name), text_of(plain(asked.limit)), text_of(plain(asked.value)), verdict])
    return element("h2", "Expectations") + table(["name", "limit#", "value#", ""], rows, class_="narrow")


def warnings(report: RunReport) -> str:
    """What a reader should know before trusting the rest."""
    if not report.warnings:
        return ""
    items = "".join(element("li", text_of(warning)) for warning in report.warnings)
    return element("div", element("h3", "Worth knowing"), element("ul", items), class_="callout")


UNDER_WARNINGS = (*CAUSES.values(), "agent-died", "agent-killed", "solver-warning", "truth-clock", "truth-frames")
"""Findings that the report's warnings say already."""


def findings(loaded: LoadedRun) -> str:
    """What the doctor says that blocks or hinders."""
    found = [f for f in diagnose_loaded(loaded) if f.severity in (Severity.BLOCKS, Severity.HINDERS)]
    found = [f for f in found if f.cause not in UNDER_WARNINGS]
    if not found:
        return ""
    blocked = any(f.severity is Severity.BLOCKS for f in found)
    heading = "Why the maps have not merged" if blocked else "What the doctor finds"
    items = [element("li", text_of(f.sentence), " ", element("em", text_of(f.advice))) for f in found]
    return element("div", element("h3", heading), element("ul", *items), class_="callout")


def trajectories(report: RunReport, loaded: LoadedRun, album: Album) -> str:
    """Before and after, seen from above, with what is needed to read it."""
    shown = scenes(loaded)
    heading = element("h2", "Where the robots went")
    if not shown:
        return heading + element("p", "No robot has a corrected trajectory or ground truth to draw.")
    view = view_of(shown)
    figures = [
        element(
            "figure",
            element("h3", text_of(scene.name)),
            map_figure(scene, view, loaded, album),
            element(
                "figcaption",
                text_of(scene.caption),
                " Click a closure to see its pictures." * bool(album.pairs and scene.with_closures),
            ),
        )
        for scene in shown
    ]
    errors = error_figure(loaded)
    below = "" if errors is None else errors_part(report, errors)
    return (
        heading
        + map_legend(report, bool(shown[0].truth_m), any(pair.used is False for pair in loaded.pairs))
        + element("div", *figures, class_="pair")
        + below
    )


def map_legend(report: RunReport, with_truth: bool, unused: bool) -> str:
    """Colours and marks, with switches for the layers."""
    robots = [
        element("li", key(f'<line x1="0" x2="26" y1="6" y2="6" class="track {colour(report.robots, robot)}"/>'), robot)
        for robot in map(text_of, report.robots)
    ]
    truth = '<line x1="0" x2="26" y1="6" y2="6" class="truth"/>'
    dots = "".join(f'<circle cx="{5 + 11 * k}" cy="6" r="3.6" class="q{k}"/>' for k in range(5))
    ring = '<g class="closure unused"><circle cx="13" cy="6" r="3.6"/></g>'
    cross = '<path d="M9 2l8 8m0 -8l-8 8" class="cross"/>'
    switches = [
        switch("truth", key(truth), "ground truth", True) if with_truth else "",
        switch("accepted", key(f'<g class="closure">{dots}</g>', 54), "closure, probability 0 to 1", True),
        element("li", key(ring), "not used by the solver") if unused else "",
        switch("rejected", key(cross), "rejected candidate", False),
    ]
    return element("ul", *robots, *switches, class_="legend")


def key(content: str, width: int = 26) -> str:
    """A small drawing in a legend."""
    return f'<svg viewBox="0 0 {width} 12" style="width:{width}px" aria-hidden="true">{content}</svg>'


def switch(layer: str, drawing: str, name: str, on: bool) -> str:
    """A box that shows or hides a layer of the map."""
    box = f'<input type="checkbox" id="show-{layer}"{" checked" if on else ""}> '
    return element("li", element("label", box, drawing, name))


def errors_part(report: RunReport, errors: str) -> str:
    """Error of each keyframe, beside the errors of each robot."""
    rows = []
    for robot in report.robot_details:
        before, after = robot.odometry, robot.corrected
        rows.append(
            [
                swatch(report, robot.robot),
                number(before.ate_m),
                number(after.ate_m),
                number(before.rpe_translation_m),
                number(after.rpe_translation_m),
            ]
        )
    rows.append(["all, jointly", number(report.ate_joint_odometry_m), number(report.ate_joint_m), "", ""])
    if report.iate_m is not None:
        rows.append(["during the run", number(report.iate_odometry_m), number(report.iate_m), "", ""])
    heads = ["", "ATE before#", "after, m#", "RPE before#", "after, m#"]
    note = (
        "Per robot: each trajectory aligned on its own. Jointly: odometry stands at its true first poses "
        f"({number(report.ate_joint_odometry_aligned_m, 'm')} after one alignment for all), the corrected "
        "trajectories after one alignment for all robots together."
    )
    if report.iate_m is not None:
        note += (
            " During the run: the joint error of what was believed after each of the "
            f"{count_of(report.iate_moments)} rounds that found one map, on average."
        )
    left = element(
        "figure",
        element("h3", "Error of each keyframe"),
        errors,
        element("figcaption", "Dashed: odometry from its true start. Solid: corrected."),
    )
    right = element("div", element("h3", "Translation error, RMSE"), table(heads, rows, sums=2), noted(note))
    return element("div", left, right, class_="pair")


def over_time(report: RunReport, loaded: LoadedRun) -> str:
    """What happened when."""
    text = (
        "Bars take the colour of the map's anchor or of the leader. "
        "Of two half bars, the upper one is what the first robot heard."
    )
    figure = element("figure", time_figure(loaded, report), class_="wide")
    return element("h2", "What happened when") + noted(text) + figure


def closures(report: RunReport, loaded: LoadedRun) -> str:
    """Where closures came from and why candidates were rejected."""
    counts, heading = report.closures, element("h2", "Loop closures")
    solver = "" if counts.used is None else f" The last optimisation used {counts.used}"
    if counts.rejected_by_solver is not None and solver:
        solver += f", rejected {counts.rejected_by_solver} as outliers"
        waiting = counts.accepted - (counts.used or 0) - counts.rejected_by_solver
        solver += f" and left out {waiting} that are held or came later" if waiting > 0 else ""
    text = (
        f"{count_of(counts.candidates)} pairs looked alike, {count_of(counts.accepted)} became closures, "
        f"{count_of(counts.rejected)} were rejected.{solver}{'.' if solver else ''}"
    )
    histogram = ratio_figure(loaded)
    legend = element(
        "ul",
        element("li", key('<rect width="26" height="12" class="bar good"/>'), "accepted"),
        element("li", key('<rect width="26" height="12" class="bar bad"/>'), "rejected"),
        class_="legend",
    )
    parts = [] if histogram is None else [element("figure", element("h3", "Match ratios"), histogram, legend)]
    parts.append(element("div", by_robots(report, loaded), by_reason(counts.rejected_by_reason)))
    return heading + element("p", text_of(text)) + element("div", *parts, class_="pair")


def by_robots(report: RunReport, loaded: LoadedRun) -> str:
    """Accepted and rejected pairs of each two robots."""
    accepted: Counter[tuple[str, str]] = Counter()
    rejected: Counter[tuple[str, str]] = Counter()
    for pair in loaded.pairs:
        ends = sorted((pair.query.log.robot, pair.match.log.robot))
        accepted[ends[0], ends[1]] += pair.accepted
        rejected[ends[0], ends[1]] += pair.rejected
    inter = [(a, b) for k, a in enumerate(report.robots) for b in report.robots[k + 1 :]]
    pairs = sorted(set(inter if len(inter) <= 15 else []) | set(accepted))
    rows = [
        [
            f"{swatch(report, a)} – {swatch(report, b)}" if a != b else f"within {swatch(report, a)}",
            count_of(accepted[a, b]),
            count_of(rejected[a, b]),
        ]
        for a, b in pairs
    ]
    return element("h3", "Between whom") + table(["", "accepted#", "rejected#"], rows)


def by_reason(reasons: dict[str, int]) -> str:
    """Why candidates were rejected, the most frequent first."""
    if not reasons:
        return ""
    most = max(reasons.values())
    ordered = sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
    rows = [[text_of(reason), count_of(count), bar(count / most, "bad")] for reason, count in ordered]
    return element("h3", "Why candidates were rejected") + table(["reason", "pairs#", "!"], rows)


def network(report: RunReport) -> str:
    """Bytes by kind and by robot."""
    heading = element("h2", "What travelled")
    if not report.bytes:
        return heading + element("p", "No robot counted its bytes.")
    total = sum(report.bytes.values())
    rate = f"{size_of(total / report.duration_s / len(report.robots))}/s per robot" if report.duration_s else ""
    ordered = sorted(report.bytes.items(), key=lambda item: (-item[1], item[0]))
    most = max(ordered[0][1], 1)
    kinds = [[text_of(kind), size_of(n), share(n, total), bar(n / most, "good")] for kind, n in ordered]
    kinds.append(["all", size_of(total), "", text_of(rate)])
    robots = [
        [swatch(report, robot), size_of(sum(b.sent.values())), size_of(sum(b.received.values()))]
        for robot, b in report.bytes_by_robot.items()
    ]
    left = element("div", element("h3", "Sent, by kind"), table(["", "bytes#", "share#", "!"], kinds, sums=1))
    right = element("div", element("h3", "By robot"), table(["", "sent#", "received#"], robots))
    return heading + element("div", left, right, class_="pair")


def share(part: int, total: int) -> str:
    """A part as a percentage."""
    return f"{100 * part / total:.1f} %" if total else "–"


def bar(ratio: float, kind: str) -> str:
    """A bar in a table cell."""
    return f'<span class="in" style="width:{100 * ratio:.1f}%;background:var(--p{0 if kind == "good" else 1})"></span>'


def robots(report: RunReport) -> str:
    """Every robot at the end."""
    rows = [robot_row(report, robot) for robot in report.robot_details]
    heads = ["", "keyframes#", "path, m#", "map frame", "corrections#", "frame changes#", "records held#", "end"]
    wide = element("div", table(heads, rows), class_="wide")
    led = [
        [text_of(span.term), swatch(report, span.leader), seconds(span.from_s), seconds(span.to_s)]
        for span in report.leaders
    ]
    leaders = element(
        "details", element("summary", f"All {len(led)} terms"), table(["term", "leader", "from#", "to#"], led)
    )
    return element("h2", "Robots") + wide + (leaders if led else "")


def robot_row(report: RunReport, robot: RobotReport) -> list[str]:
    """One robot's row."""
    end = "–" if robot.end is None else f"{robot.end} at {seconds(robot.ended_s)}"
    return [
        swatch(report, robot.robot),
        count_of(robot.keyframes),
        number(robot.path_length_m),
        text_of(robot.map_frame or "–"),
        count_of(robot.corrections),
        count_of(robot.frame_changes),
        count_of(sum(robot.logs.values())) if robot.logs else "–",
        element("span", text_of(end), class_="bad-text" if robot.end == "died" else None),
    ]


def settings(report: RunReport, loaded: LoadedRun) -> str:
    """With what it ran: enough to run it again."""
    run = loaded.run
    pairs: list[tuple[str, Any]] = [("scenario", report.scenario), ("driver", report.driver), ("seed", report.seed)]
    pairs += [(f"radio.{name}", value) for name, value in flat(run.radio)]
    pairs += list(flat(run.settings))
    pairs += [(f"recording of {robot}", where) for robot, where in sorted(run.recordings.items())]
    rows = [[text_of(name), element("code", text_of(setting(value)))] for name, value in pairs]
    return element("h2", "Settings") + table(["", ""], rows, class_="narrow")


def flat(settings: dict[str, Any], above: str = "") -> Iterable[tuple[str, Any]]:
    """Nested settings as dotted names."""
    for name, value in settings.items():
        if isinstance(value, dict) and value:
            yield from flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def setting(value: Any) -> str:
    """A setting as it would stand in a file."""
    return "–" if value is None else value if isinstance(value, str) else json.dumps(value)


def footer(report: RunReport) -> str:
    """What the figures mean and where the rest lies."""
    text = (
        "ATE is the translation RMSE over keyframes. Beside this page: report.json (the same figures), trajectories/, "
        "odometry/ and groundtruth/ in TUM format for evo, pose_graph.g2o, events.jsonl."
    )
    return element("footer", element("p", text), element("p", text_of(f"flocc {report.flocc_version}")))


def noted(text: str) -> str:
    """A remark in small letters."""
    return element("p", text_of(text), class_="note")


def swatch(report: RunReport, robot: str) -> str:
    """A robot's name beside its colour."""
    square = element("span", class_=f"swatch {colour(report.robots, robot)}")
    return element("span", square, text_of(robot), style="white-space:nowrap")


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], sums: int = 0, class_: str | None = None) -> str:
    """A table of markup; a head that ends in '#' is a column of numbers, '!' one of bars, the last rows are sums."""
    classes = ["n" if head.endswith("#") else "fill" if head == "!" else None for head in heads]
    head = "".join(element("th", text_of(h.rstrip("#!")), class_=c) for h, c in zip(heads, classes, strict=True))
    body = list(rows)
    lines = []
    for k, row in enumerate(body):
        cells = "".join(element("td", cell, class_=c) for cell, c in zip(row, classes, strict=True))
        lines.append(element("tr", cells, class_="sum" if k >= len(body) - sums else None))
    header = element("thead", element("tr", head)) if any(heads) else ""
    return element("table", header, element("tbody", *lines), class_=class_)
