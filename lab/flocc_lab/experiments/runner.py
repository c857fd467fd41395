"""Run an experiment's cells, on one or several processes, and write what they add up to.

Every finished cell is on disk before the next one counts as done. An error in a cell stands in its row and the others
go on; such cells run again when the same command is given again. Ctrl-C ends the cells that run and keeps the rest.
"""

import math
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flocc_lab.experiments.experiment import Cell, Experiment, ExperimentError, Progress, Row, S, Summary
from flocc_lab.experiments.folder import ExperimentFolder, configuration_of
from flocc_lab.experiments.outputs import write_outputs
from flocc_protocol.errors import FloccError

OnRow = Callable[[Row, int, int], None]
"""Takes each row with (cells finished, all cells)."""


@dataclass(frozen=True, slots=True)
class Result:
    """What a run of an experiment left.

    Attributes:
        folder: Where it is.
        summary: Tables and findings of the rows so far.
        cells: Number of all cells.
        rows: Finished ones, in the order of the cells.
    """

    folder: Path
    summary: Summary
    cells: int
    rows: Sequence[Row]

    @property
    def errors(self) -> list[str]:
        """Sentences of cells that failed."""
        return [f"{row['cell']}: {row['error']}" for row in self.rows if row["error"] is not None]


class Interrupted(ExperimentError):
    """Somebody ended the experiment; what is finished is kept."""


def run_experiment(
    experiment: Experiment[S],
    settings: S,
    seed: int,
    out: Path,
    processes: int = 1,
    on_row: OnRow = lambda _row, _done, _all: None,
    on_prepare: Progress = lambda _done, _all: None,
) -> Result:
    """Run what is missing of an experiment and write its tables, figures and findings.

    Args:
        experiment: What is measured.
        settings: Its settings.
        seed: Seed of everything drawn.
        out: Its folder, new or of the same experiment.
        processes: Processes that measure cells; 1 measures in this one.
        on_row: Told of each row.
        on_prepare: Told how far the data is.

    Raises:
        ExperimentError: The folder holds something else, every cell failed, or a worker process died.
        Interrupted: Ctrl-C.
        FloccError: The data cannot be used.
    """
    configuration = configuration_of(experiment.name, settings.model_dump(mode="json"), seed)
    folder = ExperimentFolder.start(out, configuration)
    try:
        experiment.prepare(settings, on_prepare)
        cells = experiment.cells(settings)
        rows = folder.rows()
        missing = [cell for cell in cells if rows.get(cell.key, {"error": "missing"})["error"] is not None]
        _measure_all(experiment, settings, seed, cells, missing, processes, folder, on_row)
    except KeyboardInterrupt:
        raise _interrupted(experiment, settings, folder) from None
    result = finish(experiment, settings, folder, cells)
    if result.rows and len(result.errors) == len(result.rows):
        raise ExperimentError(f"{out}: every cell failed; {result.errors[0]}")
    return result


def finish(experiment: Experiment[S], settings: S, folder: ExperimentFolder, cells: Sequence[Cell]) -> Result:
    """Sum up the rows on disk and write tables, figures and findings, marked partial where cells are missing."""
    found = folder.rows()
    rows = [found[cell.key] for cell in cells if cell.key in found]
    good = [row for row in rows if row["error"] is None]
    summary = experiment.summarise(settings, good) if good else Summary([], (), ["No cell is finished."])
    result = Result(folder.path, summary, len(cells), rows)
    folder.write_state(len(cells), *_counts(found, cells))
    write_outputs(experiment, settings, folder, summary, rows, len(cells))
    return result


def _interrupted(experiment: Experiment[S], settings: S, folder: ExperimentFolder) -> Interrupted:
    """Write what there is, and the sentence that says so."""
    cells = experiment.cells(settings) if folder.rows() else ()
    done = len(finish(experiment, settings, folder, cells).rows) if cells else 0
    what = f"{done} of {len(cells)} cells are kept" if cells else "before its first cell was finished"
    return Interrupted(f"{folder.path}: the experiment was interrupted, {what}; the same command goes on")


def _counts(rows: dict[str, Row], cells: Sequence[Cell]) -> tuple[int, int]:
    """Cells that are done and cells that failed."""
    known = [rows[cell.key] for cell in cells if cell.key in rows]
    failed = sum(row["error"] is not None for row in known)
    return len(known) - failed, failed


def _measure_all(
    experiment: Experiment[S],
    settings: S,
    seed: int,
    cells: Sequence[Cell],
    missing: Sequence[Cell],
    processes: int,
    folder: ExperimentFolder,
    on_row: OnRow,
) -> None:
    """Measure cells and keep each row, so that the folder says how far it is even after a kill."""
    one_by_one = processes == 1 or len(missing) < 2
    jobs = [(experiment.measure, settings, cell, seed) for cell in missing]
    rows = (measured(*job) for job in jobs) if one_by_one else _in_processes(jobs, processes)
    known = folder.rows()
    folder.write_state(len(cells), *_counts(known, cells))
    with closing(rows):  # an interrupt while a row is written ends the processes too
        for done, row in enumerate(rows, start=len(cells) - len(missing) + 1):
            folder.append(row)
            known[row["cell"]] = row
            folder.write_state(len(cells), *_counts(known, cells))
            on_row(row, done, len(cells))


def measured(measure: Callable[[S, Cell, int], Row], settings: S, cell: Cell, seed: int) -> Row:
    """Measure one cell; what goes wrong in it becomes its row's error."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    values: Row = {}
    error = None
    try:
        values = measure(settings, cell, seed + cell.run)
    except FloccError as failure:
        error = str(failure)
    except Exception as failure:  # noqa: BLE001 - one cell's bug must not cost the hours of all others
        error = f"{type(failure).__name__}: {failure}"
    assert not set(values) & {*cell.parameters, "cell", "run", "error", "wall_s", "cpu_s"}, "columns have one meaning"
    took = {"wall_s": round(time.perf_counter() - wall_s, 3), "cpu_s": round(time.process_time() - cpu_s, 3)}
    row = {"cell": cell.key, **cell.parameters, "run": cell.run, **values, **took, "error": error}
    return {name: plain(value) for name, value in row.items()}


def plain(value: Any) -> Any:
    """JSON's values: numpy's numbers become Python's, and what is not finite is not known."""
    if isinstance(value, dict):
        return {name: plain(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    number = value.item() if not isinstance(value, float) else value
    return None if isinstance(number, float) and not math.isfinite(number) else number


def _in_processes(jobs: Sequence[tuple[Any, ...]], processes: int) -> Generator[Row, None, None]:
    """Measure cells in several processes, as they finish; never more jobs are handed out than processes."""
    context = multiprocessing.get_context("spawn")
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(min(processes, len(jobs)), context, _leave_interrupts_to_the_parent)
    waiting, running = list(reversed(jobs)), set[Future[Row]]()
    try:
        while waiting or running:
            while waiting and len(running) < processes:
                running.add(pool.submit(measured, *waiting.pop()))
            done, running = wait(running, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)
        pool.shutdown()
    except BrokenProcessPool as error:
        raise ExperimentError("a worker process died (out of memory?); the same command goes on") from error
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()
        raise


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def processes_of(experiment: Experiment[Any], given: int | None) -> int:
    """How many processes measure: what was asked for, at most one per core; one where times are measured."""
    cores = os.cpu_count() or 1
    if given is None:
        return 1 if experiment.timed else cores
    return max(1, min(given, cores))
