"""Marks that several figures share."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from flocc_launch.experiments.experiment import Row
from flocc_launch.experiments.statistics import middle, values

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#1f6f8b", "#d1495b", "#66a182", "#edae49", "#5f4b8b", "#8d6a4f")
"""Told apart by people who see few colours, and in print."""
MARKERS = ("o", "s", "^", "D", "v", "P")


def spread_line(
    panel: "Axes", levels: Sequence[tuple[float, Sequence[Row]]], column: str, k: int = 0, label: str | None = None
) -> None:
    """Medians of a column over levels as a line, every repetition as a small dot; unknown values are gaps."""
    colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
    for level, rows in levels:
        known = values(rows, column)
        panel.plot([level] * len(known), known, ".", color=colour, alpha=0.45, markersize=5)
    medians = [(level, middle(rows, column)) for level, rows in levels]
    line = [(level, value) for level, value in medians if value is not None]
    panel.plot(*zip(*line, strict=True), color=colour, marker=marker, markersize=5, label=label) if line else None


def from_zero(panel: "Axes", known: Sequence[float]) -> None:
    """Let the upright axis begin at zero and end above every value."""
    panel.set_ylim(0.0, 1.08 * max(known, default=1.0) or 1.0)
