"""An experiment without any meaning: cells that give numbers, fail, are interrupted or wait."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from flocc_lab.experiments.experiment import Cell, Experiment, Row, Settings, Summary, grid, judged

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class ToySettings(Settings):
    levels: tuple[int, ...] = (1, 2, 3)
    """Levels."""
    fails_at: int | None = None
    """Level whose cells have a bug."""
    interrupted_at: int | None = None
    """Level at which somebody presses Ctrl-C."""
    waits_at: int | None = None
    """Level whose cells take for ever."""


def cells(settings: ToySettings) -> list[Cell]:
    return grid(level=settings.levels)


def measure(settings: ToySettings, cell: Cell, seed: int) -> Row:
    level = cell.parameters["level"]
    if level == settings.fails_at:
        raise ZeroDivisionError("the cell has a bug")
    if level == settings.interrupted_at:
        raise KeyboardInterrupt
    if level == settings.waits_at:
        time.sleep(600.0)
    return {"height": np.float64(level * 10 + seed), "missing": float("nan")}


def summarise(_settings: ToySettings, rows: Sequence[Row]) -> Summary:
    table = [{"level": row["level"], "height": row["height"]} for row in rows]
    rises = len(rows) > 1 and rows[-1]["height"] > rows[0]["height"]
    return Summary(table, [judged("it rises", "Sec. 0", rises, f"{len(rows)} rows.")], ["a note"])


def draw(figure: "Figure", _settings: ToySettings, rows: Sequence[Row]) -> None:
    figure.subplots().plot([row["level"] for row in rows], [row["height"] for row in rows])


TOY = Experiment("toy", "a toy", ToySettings, {"levels": (1,)}, cells, measure, summarise, draw)
