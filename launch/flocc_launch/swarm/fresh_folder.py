"""The folder that a run is to be written into: an earlier run in it goes, and nothing else ever does."""

import json
import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flocc_agent.runtime.database import StoreError, hold_lock
from flocc_launch.maps.opening import MapUse
from flocc_launch.runs.run_folder import RunFolder, RunFolderError

logger = logging.getLogger(__name__)

LAUNCHER_EVENTS = "launcher.events.jsonl"
LOCK = "lock"
LEFT_BY_A_KILL = frozenset({"robots", "groundtruth", "events.jsonl", LAUNCHER_EVENTS, LOCK})
"""All that a run can have written before its `run.json`."""


@contextmanager
def fresh_folder(out: Path, scenario: str, use: MapUse | None = None) -> Iterator[RunFolder]:
    """An empty run folder, which is this process's own for as long as the block lasts.

    Only an earlier run folder is ever replaced: none that holds the map in use, and none in which a run is going on. It
    stands aside until the new run has its `run.json`, and comes back where that never came: a start that failed, or
    was broken off, costs nothing. An earlier run of another scenario is kept beside the new one: its robots' stores may
    be all that is left of a mission.

    Raises:
        RunFolderError: Something else stands there, or the map does, or a run is going on.
    """
    aside = _make_way(out, scenario, use)
    try:
        folder = RunFolder.create(out)
    except RunFolderError:
        if aside.exists() and not out.exists():
            aside.rename(out)
        raise
    try:
        lock = hold_lock(out / LOCK)
    except StoreError:
        raise _going_on(out) from None  # what stands aside is the other one's to settle
    try:
        yield folder
    finally:
        if lock is not None:
            (out / LOCK).unlink(missing_ok=True)
            lock.close()
        _settle(out, aside, scenario)


def _make_way(out: Path, scenario: str, use: MapUse | None) -> Path:
    """Put an earlier run aside; gives where that is, or would be."""
    aside, before = (out.with_name(f"{out.resolve().name}.{suffix}") for suffix in ("earlier", "before"))
    if use is not None and use.folder.resolve().is_relative_to(out.resolve()):
        raise RunFolderError(f"{out}: holds the map {use.folder}, which is only read; choose another --out")
    if not out.exists() and not _is_run(aside):
        return aside
    if out.exists() and any(out.iterdir()):
        if not _is_run(out):
            raise RunFolderError(f"{out}: is not empty and not an earlier run; choose another --out")
        _check_idle(out)
    if aside.exists():  # a driver was killed before it could settle
        if not _is_run(aside):
            raise RunFolderError(f"{aside}: is no run, and a run that stands in {out} would be put there: move it away")
        _settle(out, aside, _scenario_of(out))
    if not out.exists() or _holds_nothing(out):
        return aside
    if _scenario_of(out) != scenario and before.exists():
        if not _is_run(before):
            raise RunFolderError(
                f"{out}: holds a run of another scenario, and {before} is no run: choose another --out"
            )
        _check_idle(before)
    out.rename(aside)
    return aside


def _settle(out: Path, aside: Path, scenario: str | None) -> None:
    """What was put aside goes where the new run has begun, is kept where it is of another scenario, or comes back."""
    if not aside.exists():
        return
    if not (out / "run.json").exists():
        shutil.rmtree(out, ignore_errors=True)
        aside.rename(out)
        return
    earlier = _scenario_of(aside)
    if earlier == scenario:
        shutil.rmtree(aside)
        return
    before = out.with_name(f"{out.resolve().name}.before")
    if before.exists():
        shutil.rmtree(before)
    aside.rename(before)
    logger.warning("%s: held a run of %s, which is kept as %s", out, earlier or "no known scenario", before)


def _holds_nothing(run: Path) -> bool:
    """Whether a folder holds no file but a lock: what a driver leaves that was killed before anything happened."""
    return all(path.is_dir() or path == run / LOCK for path in run.rglob("*"))


def _check_idle(run: Path) -> None:
    """See that neither a launcher nor an agent that outlived its launcher is at work in a run.

    Raises:
        RunFolderError: One is.
    """
    for path in (run / LOCK, *run.glob("robots/*/store/lock")):
        if not path.exists():
            continue
        try:
            lock = hold_lock(path)
        except StoreError:
            raise _going_on(run) from None
        if lock is not None:
            lock.close()


def _going_on(run: Path) -> RunFolderError:
    return RunFolderError(f"{run}: a run is going on in it; stop that one, or choose another --out")


def _is_run(path: Path) -> bool:
    """Whether a path is a folder with a run, or with what a run leaves that was killed before it said which it is."""
    if not path.is_dir():
        return False
    names = {entry.name for entry in path.iterdir()}
    return "run.json" in names or ("robots" in names and names <= LEFT_BY_A_KILL)


def _scenario_of(run: Path) -> str | None:
    """Whose run a folder holds; None where it does not say so."""
    try:
        content = json.loads((run / "run.json").read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    return content.get("scenario") if isinstance(content, dict) else None
