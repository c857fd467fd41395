"""What commands share: endings, progress, and how a scenario's report is shown."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from flocc_launch.report.model import RunReport

EXIT_MISSED = 1
EXIT_BAD_INPUT = 2
EXIT_TRY_AGAIN = 75
"""An agent's disk or machine was at its end: systemd starts it again, which it does not after bad input."""


PROGRESS_LINE_PERIOD_S = 15.0
"""Where nobody looks at a terminal, a long job says a line this often, so that a log shows that it goes on."""


@contextmanager
def progress_bar(what: str, unit: str = "picture") -> Iterator[Callable[[int, int], None]]:
    """A progress bar with an estimate, which takes (done, all); without a terminal, a line now and then."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    if not sys.stdout.isatty():
        yield ProgressLines(what, unit, time.monotonic).tell
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn(unit), MofNCompleteColumn(" of "))
    with Progress(*columns, TimeRemainingColumn(elapsed_when_finished=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


class ProgressLines:
    """Progress as lines of a log, the first of which comes only when a job takes long."""

    def __init__(self, what: str, unit: str, clock: Callable[[], float]) -> None:
        self._what, self._unit, self._clock = what, unit, clock
        self._begin_s = self._said_s = clock()

    def tell(self, done: int, total: int) -> None:
        """Say how far the job is and what it will still take, if the last line is old enough."""
        now_s = self._clock()
        if now_s - self._said_s < PROGRESS_LINE_PERIOD_S or done == 0:
            return
        self._said_s = now_s
        left_s = (now_s - self._begin_s) / done * (total - done)
        typer.echo(f"{self._what}: {self._unit} {done} of {total}, about {left_s:.0f} s left", err=True)


def show_report(report: "RunReport", out: Path) -> None:
    """Print what came of a run, what was missed in red; exit code 1 where something was, or where no robot lived."""
    from flocc_launch.report.text import MISSED, sentences

    for sentence in sentences(report):
        is_missed = sentence.startswith(MISSED)
        typer.secho(sentence, fg="red" if is_missed else None, bold=is_missed or None)
    typer.echo(f"report: {(out / 'report.html').resolve()}")
    none_lived = bool(report.robot_details) and all(robot.end == "died" for robot in report.robot_details)
    if none_lived or any(expectation.met is not True for expectation in report.expectations):
        sys.exit(EXIT_MISSED)
