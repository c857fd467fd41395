"""What commands share: endings, progress, and how a scenario's report is shown."""

import json
import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from flocc_launch.report.model import RunReport

EXIT_MISSED = 1
EXIT_BAD_INPUT = 2
EXIT_TRY_AGAIN = 75
EXIT_READER_LEFT = 141
"""As any program ends that writes into a pipe whose reader has left (`| head`): 128 + SIGPIPE."""
"""An agent's disk or machine was at its end: systemd starts it again, which it does not after bad input."""


WARNINGS_REMEMBERED = 1000


class SaidOnce(logging.Filter):
    """Lets a sentence through once: a command reads one recording several times, and it has the same to say."""

    def __init__(self) -> None:
        """Remember nothing yet."""
        super().__init__()
        self._said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether it was not said before."""
        text = record.getMessage()
        if text in self._said:
            return False
        if len(self._said) < WARNINGS_REMEMBERED:
            self._said.add(text)
        return True


def say_warnings_once() -> None:
    """Where a command's warnings go to the terminal, each does once; agents' own logs have all."""
    handler = logging.lastResort
    if handler is not None:
        handler.filters = [*(each for each in handler.filters if not isinstance(each, SaidOnce)), SaidOnce()]


Json = Annotated[bool, typer.Option("--json", help="Print JSON, for scripts; all else goes to stderr.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say only what came of it, and what was missed.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say bytes by kind and times by stage as well.")]


@dataclass(frozen=True, slots=True)
class Speech:
    """How much a command says, and in which form."""

    as_json: bool = False
    quiet: bool = False
    verbose: bool = False

    def __post_init__(self) -> None:
        if self.quiet and self.verbose:
            raise typer.BadParameter("--quiet and --verbose contradict each other")

    def tell(self, sentence: str) -> None:
        """Say something on the way; where JSON is wanted, beside it."""
        if not self.quiet:
            typer.echo(sentence, err=self.as_json)


def facts(fields: Any) -> None:
    """Print facts as JSON; what JSON has no word for, such as a path, as text."""
    typer.echo(json.dumps(fields, indent=1, default=str))


PROGRESS_LINE_PERIOD_S = 15.0
"""Where nobody looks at a terminal, a long job says a line this often, so that a log shows that it goes on."""


@contextmanager
def progress_bar(what: str, unit: str = "picture") -> Iterator[Callable[[int, int], None]]:
    """A progress bar with an estimate, which takes (done, all); without a terminal, a line now and then."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    if not sys.stderr.isatty():
        yield ProgressLines(what, unit, time.monotonic).tell
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn(unit), MofNCompleteColumn(" of "))
    left = TimeRemainingColumn(elapsed_when_finished=True)
    with Progress(*columns, left, transient=True, console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


class ProgressLines:
    """Progress as lines of a log, the first of which comes only when a job takes long.

    What comes before the first piece is done (workers that start) counts for no other one. A count that begins again is
    that of another job, such as the next robot's.
    """

    def __init__(self, what: str, unit: str, clock: Callable[[], float]) -> None:
        self._what, self._unit, self._clock = what, unit, clock
        self._said_s = clock()
        self._first: tuple[float, int] | None = None
        self._done = 0

    def tell(self, done: int, total: int) -> None:
        """Say how far the job is and what it will still take, if the last line is old enough."""
        now_s = self._clock()
        if done < self._done:
            self._first = None
        self._done = done
        if self._first is None:
            self._first = (now_s, done) if done else None
            return
        first_s, first = self._first
        if now_s - self._said_s < PROGRESS_LINE_PERIOD_S or done <= first:
            return
        from flocc_launch.runs.plain_numbers import duration

        self._said_s = now_s
        left_s = (now_s - first_s) / (done - first) * (total - done)
        typer.echo(f"{self._what}: {self._unit} {done} of {total}, about {duration(left_s)} left", err=True)


def show_report(report: "RunReport", out: Path, speech: Speech | None = None) -> None:
    """Print what came of a run, what was missed in red; exit code 1 where something was, or where no robot lived."""
    from flocc_launch.report.text import MISSED, sentences, short_sentences

    said = speech or Speech()
    if said.as_json:
        typer.echo(report.model_dump_json(indent=1))
    for sentence in () if said.as_json else short_sentences(report) if said.quiet else sentences(report, said.verbose):
        is_missed = sentence.startswith(MISSED)
        typer.secho(sentence, fg="red" if is_missed else None, bold=is_missed or None)
    typer.echo(f"report: {(out / 'report.html').resolve()}", err=said.as_json)
    none_lived = bool(report.robot_details) and all(robot.end == "died" for robot in report.robot_details)
    if none_lived or any(expectation.met is not True for expectation in report.expectations):
        sys.exit(EXIT_MISSED)
