"""The folder of one run: what the drivers write into it, and typed readers for it.

    run.json                    who ran, on what, with which settings and seed
    events.jsonl                what happened, one JSON object per line, sorted by time, all robots together
    robots/ROBOT/result.json    what a robot knew at its end

`flocc_launch.report.finish` adds the rest. A file that is missing, cut off or of another version, or a key that is
missing or of another type, is a `RunFolderError` that names the file.
"""

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from flocc_agent.core.reports import Fact
from flocc_agent.runtime.event_lines import BadLine, Reported, reported_of
from flocc_agent.runtime.robot_result import Record, RobotResult
from flocc_launch.runs.run_records import RUN_VERSION, Run
from flocc_protocol.errors import FloccError

__all__ = ["Run", "RobotResult", "RunFolder", "RunFolderError"]

R = TypeVar("R", bound=Record)


WRITTEN = frozenset({"odometry", "trajectories", "report", "pose_graph", "errors"})
"""Files and folders, by the first part of their names, that are made of what a run left."""


class RunFolderError(FloccError):
    """A run folder that cannot be read or written; the message names the file."""


@dataclass(frozen=True, slots=True)
class RunFolder:
    """A run's folder on disk."""

    path: Path

    @classmethod
    def create(cls, path: Path) -> "RunFolder":
        """Make the folder for a new run.

        Raises:
            RunFolderError: It cannot be made, or it holds a run already.
        """
        if (path / "run.json").exists():
            raise RunFolderError(f"{path}: holds a run already; give another folder")
        try:
            (path / "robots").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunFolderError(f"{path}: cannot be made: {error.strerror}") from error
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """Open the folder of a run that was started.

        Raises:
            RunFolderError: There is no run in it, or one of another version.
        """
        if not path.is_dir():
            raise RunFolderError(f"{path}: is not a folder")
        if not (path / "run.json").is_file():
            raise RunFolderError(f"{path}: has no run.json, so it is not the folder of a run")
        folder = cls(path)
        version = folder.run().version
        if version != RUN_VERSION:
            raise RunFolderError(f"{path / 'run.json'}: is of version {version}, this flocc reads {RUN_VERSION}")
        return folder

    def refuse_links(self) -> None:
        """Check that what is written into the folder again stays in it.

        Raises:
            RunFolderError: A file or folder that is written is a link, by which something elsewhere would be.
        """
        written = [path for path in self.path.iterdir() if path.name.split(".")[0] in WRITTEN]
        written += [path for folder in written if folder.is_dir() for path in folder.iterdir()]
        for path in sorted(written):
            if path.is_symlink():
                raise RunFolderError(f"{path}: is a link; a run is evaluated in its own folder only")

    def write_run(self, run: Run) -> None:
        """Write `run.json`; call it again at the end to add what was measured."""
        write_json(self.path / "run.json", run.model_dump(mode="json"))

    def write_events(self, events: Iterable[Mapping[str, Any]]) -> None:
        """Write `events.jsonl`, sorted by time and then robot; events of one robot keep their order."""
        ordered = sorted(events, key=lambda event: (float(event["t"]), str(event["robot"])))
        lines = [json.dumps(event, allow_nan=False) + "\n" for event in ordered]
        (self.path / "events.jsonl").write_text("".join(lines), encoding="utf-8")

    def write_result(self, result: RobotResult) -> None:
        """Write `robots/ROBOT/result.json`."""
        path = self.path / "robots" / result.robot / "result.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, result.model_dump(mode="json"))

    def run(self) -> Run:
        """Read `run.json`.

        Raises:
            RunFolderError: It cannot be read.
        """
        return read_record(self.path / "run.json", Run)

    def events(self) -> list[Reported[Fact]]:
        """Read `events.jsonl`; a kind that this version does not know comes back as an `UnknownFact`.

        Raises:
            RunFolderError: The file is missing, or a line is cut off, not JSON or lacks a key.
        """
        return list(self.iterate_events())

    def iterate_events(self) -> Iterator[Reported[Fact]]:
        """Read `events.jsonl` line by line, as `events`; where a run was cut short, its agents' files instead."""
        path = self.path / "events.jsonl"
        if not path.exists() and (parts := self._parts()):
            yield from sorted(chain.from_iterable(map(_whole_lines, parts)), key=lambda event: (event.t, event.robot))
            return
        for number, line in enumerate(read_text(path).splitlines(), start=1):
            yield event_from_line(line, f"{path}:{number}")

    def _parts(self) -> list[Path]:
        """Files of events that the launcher and the agents write while a run goes on."""
        return [*sorted(self.path.glob("*.events.jsonl")), *sorted(self.path.glob("robots/*/events.jsonl"))]

    def result(self, robot: str) -> RobotResult | None:
        """Read a robot's `result.json`; None where it left none.

        Raises:
            RunFolderError: It is there and cannot be read.
        """
        path = self.path / "robots" / robot / "result.json"
        return read_record(path, RobotResult) if path.exists() else None

    def results(self) -> dict[str, RobotResult]:
        """Read the results of all robots that left one, by name, sorted."""
        found = {robot: self.result(robot) for robot in sorted(self.run().robots)}
        return {robot: result for robot, result in found.items() if result is not None}

    def recording(self, robot: str) -> Path | None:
        """Folder of a robot's recording, or None where the run names none, or one that this user may not read."""
        name = self.run().recordings.get(robot)
        return None if name is None or not _may_read(self.path / name) else self.path / name

    def barred(self) -> dict[str, Path]:
        """Recordings that this user may not read, by robot: another user's cache, most often."""
        named = {robot: self.path / name for robot, name in self.run().recordings.items() if name is not None}
        return {robot: path for robot, path in sorted(named.items()) if not _may_read(path)}


def _may_read(recording: Path) -> bool:
    """Whether a recording may be looked into; one that is not there may."""
    try:
        return os.access(recording, os.R_OK | os.X_OK) or not recording.exists()
    except PermissionError:
        return False


def _whole_lines(path: Path) -> Iterator[Reported[Fact]]:
    """Events of a file whose last line may be cut off."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        with suppress(RunFolderError):
            yield event_from_line(line, f"{path}:{number}")


def event_from_line(line: str, where: str) -> Reported[Fact]:
    """Read one line of `events.jsonl`.

    Raises:
        RunFolderError: It is cut off, not JSON or lacks a key; the message starts with `where`.
    """
    try:
        return reported_of(line)
    except BadLine as error:
        raise RunFolderError(f"{where}: {error}") from error


def validated(fields: Any, record: type[R], where: str) -> R:
    """Check decoded JSON against a record.

    Raises:
        RunFolderError: A key is missing or of another type; the message names `where` and the key.
    """
    try:
        return record.model_validate(fields)
    except ValidationError as error:
        complaint = error.errors()[0]
        key = ".".join(str(part) for part in complaint["loc"]) or "(top level)"
        raise RunFolderError(f"{where}: {key}: {complaint['msg']}") from error


def read_text(path: Path) -> str:
    """Read a text file of the folder.

    Raises:
        RunFolderError: It is missing or unreadable.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RunFolderError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def read_record(path: Path, record: type[R]) -> R:
    """Read a JSON file of the folder.

    Raises:
        RunFolderError: It is missing, cut off, not JSON, or lacks a key.
    """
    try:
        fields = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise RunFolderError(f"{path}: is cut off or not JSON: {error.msg}") from error
    return validated(fields, record, str(path))


def write_json(path: Path, fields: Any) -> None:
    """Write JSON in one step, so that no reader sees half a file."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(fields, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    partial.replace(path)
