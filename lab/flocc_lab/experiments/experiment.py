"""What an experiment is: settings, cells that are measured one by one, and what their rows add up to.

A cell is a deterministic function of (settings, cell, seed), so that an interrupted experiment goes on where it ended
and cells may run in any order, in several processes. Times measured in a cell are the one thing that differs.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from flocc_agent.config import Section
from flocc_protocol.errors import FloccError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = dict[str, Any]
"""JSON values by column; what was not measured is None."""
Progress = Callable[[int, int], None]


class ExperimentError(FloccError):
    """An experiment that cannot be run or go on; one sentence says why."""


class Settings(Section):
    """Base of an experiment's settings: flat fields with defaults and one line each, which become options."""


S = TypeVar("S", bound=Settings)


@dataclass(frozen=True, slots=True)
class Cell:
    """One measurement of an experiment.

    Attributes:
        parameters: What distinguishes it, JSON values; they become columns of its row.
        run: Repetition; it is added to the experiment's seed, so that cells of one run share their draws.
    """

    parameters: Mapping[str, Any]
    run: int = 0

    @property
    def key(self) -> str:
        """Names the cell within its experiment."""
        return " ".join([*(f"{name}={value}" for name, value in self.parameters.items()), f"run={self.run}"])


def grid(runs: int = 1, **axes: Iterable[Any]) -> list[Cell]:
    """A cell for every combination of values, and as often as there are runs."""
    combinations = itertools.product(*axes.values())
    return [Cell(dict(zip(axes, values, strict=True)), run) for values in combinations for run in range(runs)]


class Verdict(StrEnum):
    """What the rows say of a claim."""

    CONFIRMED = "confirmed"
    CONTRADICTED = "contradicted"
    NOT_SHOWN = "not shown"


@dataclass(frozen=True, slots=True)
class ExperimentFinding:
    """A claim of the paper held against the rows.

    Attributes:
        claim: In one sentence.
        source: Where the paper says so, as `Sec. IV-B, Fig. 5`; else the page of the repository that does.
        verdict: Whether it holds here.
        numbers: The figures that decide, in one sentence.
    """

    claim: str
    source: str
    verdict: Verdict
    numbers: str


def judged(claim: str, source: str, holds: bool | None, numbers: str) -> ExperimentFinding:
    """A finding; None where the rows cannot decide."""
    verdicts = {True: Verdict.CONFIRMED, False: Verdict.CONTRADICTED, None: Verdict.NOT_SHOWN}
    return ExperimentFinding(claim, source, verdicts[holds], numbers)


@dataclass(frozen=True, slots=True)
class Summary:
    """What an experiment's rows add up to.

    Attributes:
        table: Rows with the same columns, in order.
        findings: The paper's claims, held against them.
        notes: Sentences that a reader of the table needs, such as what could not be measured and why.
    """

    table: Sequence[Row]
    findings: Sequence[ExperimentFinding] = ()
    notes: Sequence[str] = ()


def nothing_to_prepare(_settings: Any, _progress: Progress) -> None:
    """For experiments whose cells need no data that is made once."""


@dataclass(frozen=True, slots=True)
class Experiment(Generic[S]):
    """One experiment; functions are of module level, so that cells can run in other processes.

    Attributes:
        name: As on the command line.
        title: What it shows, in one line.
        settings: Type of its settings; their defaults are the full version.
        quick: Settings of its smallest version, which the tests run.
        cells: Names all measurements.
        measure: Measures one cell with (settings, cell, seed); gives columns beyond the cell's parameters.
        summarise: Adds up the rows of cells without error; there may be fewer than cells.
        draw: Draws the rows of cells without error into an empty figure.
        prepare: Checks the settings and makes data that all cells share, before any of them runs.
        timed: Its cells measure times: they run one after the other unless asked otherwise.
    """

    name: str
    title: str
    settings: type[S]
    quick: Mapping[str, object]
    cells: Callable[[S], Sequence[Cell]]
    measure: Callable[[S, Cell, int], Row]
    summarise: Callable[[S, Sequence[Row]], Summary]
    draw: "Callable[[Figure, S, Sequence[Row]], None]"
    prepare: Callable[[S, Progress], None] = nothing_to_prepare
    timed: bool = False
