"""The parts of report.html about cost: bytes on every link, and time by stage."""

from flocc_launch.report.model import LinkBytes, RunReport, StageTime
from flocc_launch.report.sections import bar, noted, swatch, table
from flocc_launch.report.svg import element, svg, text_of, title
from flocc_launch.runs.plain_numbers import count_of, number, size_of

MATRIX_ROBOTS_MAX = 10
LINKS_SHOWN_MAX = 20
BARS_WIDTH_PX, BARS_HEIGHT_PX = 200.0, 26.0


def links(report: RunReport) -> str:
    """Bytes on every link: a matrix for few robots, the heaviest links for many."""
    if not report.links:
        return ""
    note = (
        "Payload bytes as handed to zenoh and as taken from it. A broadcast counts on every link that its sender had "
        "then. Lost: by the emulated radio, or refused by the receiver. Unaccounted: counted by the sender and not by "
        "the receiver."
    )
    robots = sorted({end for link in report.links for end in (link.sender, link.receiver)})
    shown = matrix(report, robots) if len(robots) <= MATRIX_ROBOTS_MAX else ""
    heaviest = sorted(report.links, key=lambda link: (-(link.sent or 0), link.sender, link.receiver))
    summary = f"All {len(heaviest)} links" if len(heaviest) <= LINKS_SHOWN_MAX else f"The {LINKS_SHOWN_MAX} heaviest"
    listed = link_table(report, heaviest[:LINKS_SHOWN_MAX])
    below = element("details", element("summary", summary), listed) if shown else listed
    return element("h3", "From whom to whom") + shown + noted(note) + below


def matrix(report: RunReport, robots: list[str]) -> str:
    """Received bytes, senders down and receivers across; darker is more."""
    by_ends = {(link.sender, link.receiver): link for link in report.links}
    most = max((received_of(link) for link in report.links), default=0) or 1
    rows = []
    for sender in robots:
        cells = [cell(by_ends.get((sender, receiver)), most) for receiver in robots]
        rows.append(element("tr", element("th", swatch(report, sender)), *cells))
    head = element("tr", element("th", "from ↓ to →"), *(element("th", swatch(report, r), class_="n") for r in robots))
    return element("div", element("table", element("thead", head), element("tbody", *rows)), class_="wide")


def received_of(link: LinkBytes) -> int:
    """What is known to have crossed a link."""
    return link.received if link.received is not None else link.sent or 0


def cell(link: LinkBytes | None, most: int) -> str:
    """One link's cell: what was received, and what was lost beside it."""
    if link is None:
        return element("td", "·", class_="n")
    lost = f" (lost {size_of(link.lost)})" if link.lost else ""
    shade = f"background:color-mix(in srgb, var(--p0) {45 * received_of(link) / most:.0f}%, transparent)"
    kinds = ", ".join(f"{kind} {size_of(n.received)}" for kind, n in link.by_kind.items() if n.received)
    said = f"{link.sender} to {link.receiver}: {kinds}"
    return element("td", text_of(size_of(received_of(link)) + lost), class_="n", style=shade, title=said)


def link_table(report: RunReport, shown: list[LinkBytes]) -> str:
    """Both ends' counts of each link."""
    rows = [
        [
            f"{swatch(report, link.sender)} → {swatch(report, link.receiver)}",
            size_of(link.sent),
            size_of(link.received),
            size_of(link.lost),
            size_of(link.repeated),
            unaccounted(link),
        ]
        for link in shown
    ]
    return table(["", "sent#", "received#", "lost#", "repeated#", "unaccounted#"], rows)


def unaccounted(link: LinkBytes) -> str:
    """What only the sender counted, as a share of what it sent."""
    if link.unaccounted is None or not link.sent:
        return "–"
    return f"{100 * link.unaccounted / link.sent:.2f} %"


def stages(report: RunReport) -> str:
    """How long each stage of the work took."""
    if not report.stages:
        return ""
    most = max(stage.total_s for stage in report.stages.values()) or 1.0
    rows = [
        [
            text_of(name.replace("_", " ")),
            count_of(stage.count),
            duration(stage.median_s),
            duration(stage.p90_s),
            duration(stage.max_s),
            histogram(stage, report.stage_bounds_s),
            duration(stage.total_s),
            bar(stage.total_s / most, "bad" if name.endswith("wait") else "good"),
        ]
        for name, stage in report.stages.items()
    ]
    clock = "virtual time, as the scenario draws it" if report.driver == "simulate" else "wall time on the robots"
    note = (
        f"All robots together, {clock}. A wait is what a task spent in its queue before a worker took it; decode, "
        "match and pose are parts of register. The bars of a histogram go from 0.1 ms to 100 s in steps of 1, 2, 5."
    )
    heads = ["", "count#", "median#", "90 %#", "longest#", "histogram", "together#", "!"]
    return element("h2", "Where time went") + noted(note) + element("div", table(heads, rows), class_="wide")


def histogram(stage: StageTime, bounds_s: list[float]) -> str:
    """A histogram as small bars."""
    most, width = max(stage.counts, default=0) or 1, BARS_WIDTH_PX / max(len(stage.counts), 1)
    bars = [
        element(
            "rect",
            title(f"{count} took {bucket(k, bounds_s)}"),
            x=k * width + 0.5,
            y=BARS_HEIGHT_PX * (1 - count / most),
            width=width - 1,
            height=BARS_HEIGHT_PX * count / most,
            class_="bar good",
        )
        for k, count in enumerate(stage.counts)
        if count
    ]
    base = element("line", x1=0, x2=BARS_WIDTH_PX, y1=BARS_HEIGHT_PX, y2=BARS_HEIGHT_PX, class_="grid")
    drawing = svg(BARS_WIDTH_PX, BARS_HEIGHT_PX, base, *bars, label="Histogram of durations")
    return element("div", drawing, style=f"width:{BARS_WIDTH_PX:g}px;max-width:30vw")


def bucket(k: int, bounds_s: list[float]) -> str:
    """A bucket in words."""
    if k >= len(bounds_s):
        return f"more than {duration(bounds_s[-1])}"
    return f"at most {duration(bounds_s[k])}"


def duration(value_s: float) -> str:
    """A duration in the unit that suits it."""
    if value_s >= 1.0 or value_s == 0.0:
        return number(value_s, "s")
    return number(1000.0 * value_s, "ms")
