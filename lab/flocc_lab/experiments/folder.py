"""The folder of one experiment: its configuration, and the rows of finished cells.

    config.json   experiment, settings, seed, version, machine, how many cells are done
    rows.jsonl    one JSON object per finished cell, in the order in which they finished

An experiment that was cut short goes on in its folder; rows of another configuration are never mixed in.
"""

import json
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flocc_agent.config import read_json
from flocc_lab.experiments.experiment import ExperimentError, Row
from flocc_launch.runs.run_folder import write_json
from flocc_launch.runs.version import flocc_version

Json = dict[str, Any]

SAME = ("experiment", "seed", "flocc_version", "settings")
"""Keys of config.json on which a resumed experiment agrees with its first start."""


@dataclass(frozen=True, slots=True)
class ExperimentFolder:
    """An experiment's folder on disk."""

    path: Path
    configuration: Json

    @classmethod
    def start(cls, path: Path, configuration: Json) -> "ExperimentFolder":
        """Begin an experiment, or go on with the one that the folder holds.

        Raises:
            ExperimentError: The folder holds another configuration's rows, something else, or cannot be made.
        """
        found = path / "config.json"
        if found.exists():
            _require_same(path, read_json(found), configuration)
        elif path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise ExperimentError(f"{path}: holds something that is no experiment; give another --out")
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ExperimentError(f"{path}: cannot be made: {error.strerror}") from error
        return cls(path, configuration)

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return str(self.configuration["experiment"])

    def write_state(self, cells: int, done: int, failed: int) -> None:
        """Write `config.json` with how far the experiment is."""
        state = {"state": "finished" if done == cells else "partial", "cells": cells, "done": done}
        write_json(self.path / "config.json", {**self.configuration, **state, "failed": failed})

    def rows(self) -> dict[str, Row]:
        """Rows of finished cells by cell; of a cell that ran again after an error, the last. A torn line is dropped."""
        path = self.path / "rows.jsonl"
        lines = path.read_bytes().split(b"\n") if path.exists() else []
        whole = [line for line in lines[:-1] if line]
        if lines and lines[-1]:
            path.write_bytes(b"".join(line + b"\n" for line in whole))
        rows = [_row(line, f"{path}:{number}") for number, line in enumerate(whole, start=1)]
        return {row["cell"]: row for row in rows}

    def append(self, row: Row) -> None:
        """Keep the row of a cell that is finished."""
        line = json.dumps(row, allow_nan=False).encode() + b"\n"
        with (self.path / "rows.jsonl").open("ab") as file:
            file.write(line)


def configuration_of(experiment: str, settings: Mapping[str, Any], seed: int) -> Json:
    """What `config.json` says of an experiment before it runs."""
    return {
        "experiment": experiment,
        "settings": dict(settings),
        "seed": seed,
        "flocc_version": flocc_version(),
        "machine": machine(),
    }


def machine() -> Json:
    """What cells ran on."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="ascii", errors="ignore").splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


def _row(line: bytes, where: str) -> Row:
    try:
        row = json.loads(line)
    except ValueError as error:
        raise ExperimentError(f"{where}: is not JSON: {error}") from error
    if not isinstance(row, dict) or "cell" not in row or "error" not in row:
        raise ExperimentError(f"{where}: is no row of an experiment")
    return row


def _require_same(path: Path, there: Json, now: Json) -> None:
    """Compare configurations.

    Raises:
        ExperimentError: They differ; the sentence names the first key.
    """
    for key, before, after in _differences(there, now):
        raise ExperimentError(
            f"{path}: holds rows of another configuration: {key} is {json.dumps(before)} there and "
            f"{json.dumps(after)} now; give another --out"
        )


def _differences(there: Json, now: Json) -> list[tuple[str, Any, Any]]:
    """Keys on which two configurations differ, with both values."""
    flat = [_flat({key: fields.get(key) for key in SAME}) for fields in (there, now)]
    keys = sorted({*flat[0], *flat[1]})
    return [(key, flat[0].get(key), flat[1].get(key)) for key in keys if flat[0].get(key) != flat[1].get(key)]


def _flat(fields: Json) -> Json:
    settings = fields.pop("settings") or {}
    return {**fields, **{f"settings.{name}": value for name, value in settings.items()}}
