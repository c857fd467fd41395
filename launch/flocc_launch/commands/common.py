"""What commands share: endings, progress, and how a scenario's report is shown."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from flocc_launch.report.model import RunReport

EXIT_MISSED = 1
EXIT_BAD_INPUT = 2


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar that takes (done, all); nothing is shown where nobody looks at a terminal."""
    from rich.progress import Progress

    with Progress(transient=True, disable=not sys.stdout.isatty()) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def show_report(report: "RunReport", out: Path) -> None:
    """Print what came of a run; leave with exit code 1 when an expectation is missed or unknown, or no robot lived."""
    from flocc_launch.report.text import sentences

    for sentence in sentences(report):
        typer.echo(sentence)
    typer.echo(f"report: {(out / 'report.html').resolve()}")
    none_lived = bool(report.robot_details) and all(robot.end == "died" for robot in report.robot_details)
    if none_lived or any(expectation.met is not True for expectation in report.expectations):
        sys.exit(EXIT_MISSED)
