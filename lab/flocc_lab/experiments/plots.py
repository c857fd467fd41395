"""Marks that several figures share."""

from collections.abc import Sequence
from statistics import median
from typing import TYPE_CHECKING

from flocc_lab.experiments.experiment import Row
from flocc_lab.experiments.statistics import values

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

COLOURS = ("#1f6f8b", "#d1495b", "#66a182", "#edae49", "#5f4b8b", "#8d6a4f")
"""Told apart by people who see few colours, and in print."""
MEGABYTE = 1e6
MARKERS = ("o", "s", "^", "D", "v", "P")


def spread_line(
    panel: "Axes", levels: Sequence[tuple[float, Sequence[Row]]], column: str, k: int = 0, label: str | None = None
) -> None:
    """Medians of a column over levels as a line, every repetition as a small dot; bytes are drawn in megabytes."""
    colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
    for level, rows in levels:
        known = drawn_values(rows, column)
        panel.plot([level] * len(known), known, ".", color=colour, alpha=0.45, markersize=5)
    line = [(level, median(known)) for level, rows in levels if (known := drawn_values(rows, column))]
    if line:
        panel.plot(*zip(*line, strict=True), color=colour, marker=marker, markersize=5, label=label)


def drawn_values(rows: Sequence[Row], column: str) -> list[float]:
    """What is known of a column, bytes in megabytes."""
    unit = MEGABYTE if column.endswith("bytes") else 1.0
    return [value / unit for value in values(rows, column)]


def from_zero(panel: "Axes", known: Sequence[float]) -> None:
    """Let the upright axis begin at zero and end above every value."""
    panel.set_ylim(0.0, 1.08 * max(known, default=1.0) or 1.0)


def label_logarithmic(axis: "Axis") -> None:
    """Plain numbers at powers of ten and at 2, 3 and 5 times these, so that a narrow range has labels too."""

    def labelled(value: float, _place: float) -> str:
        return f"{value:g}" if f"{value:e}"[0] in "1235" else ""

    axis.set_major_formatter(labelled)
    axis.set_minor_formatter(labelled)
    axis.set_tick_params(which="both", labelsize=7)
