"""Writes a map's folder: other files first, `map.json` last and in one step, then what nothing names any more goes.

A `kill -9` at any moment leaves the map that was there, or the new one, and perhaps files that the next save removes.
"""

import hashlib
import io
import os
import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import map_frame
from flocc_agent.geometry import tq_from_poses
from flocc_agent.runtime.map_folder import (
    LATENT_TABLE,
    LENGTH,
    MANIFEST,
    MAP_FORMAT,
    BadMap,
    FileSum,
    MapFolder,
    MapFrontEnd,
    MapManifest,
    SavedLogEntry,
    read_manifest,
)
from flocc_launch.maps.gathering import Logs, Optics, opened_record
from flocc_launch.maps.solving import SolvedMap
from flocc_launch.runs.version import flocc_version
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import KeyframeRecord

PAGE = "index.html"
PARTS = ("records-*.bin", "solution-*.npz", "latents-*.sqlite")
CHUNK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class MapContent:
    """What a map holds.

    Attributes:
        name: For people.
        logs: All records.
        solved: Poses, covariances, closures.
        front_end: What made descriptors and latents.
        optics: Camera of each log, as far as it is known.
        latents: (keyframe, SHA-256, latent).
        back_end: How it was solved; None: as agents do by default.
        edition: See `MapManifest`.
        swarm: See `MapManifest`.
        pruned: See `MapManifest`.
        page: Makes the page that shows it; None: there is none.
    """

    name: str
    logs: Logs
    solved: SolvedMap
    front_end: MapFrontEnd
    optics: Mapping[LogId, Optics]
    latents: Iterable[tuple[KeyframeId, bytes, bytes]]
    back_end: BackendConfig | None = None
    edition: int = 1
    swarm: str | None = None
    pruned: bool = False
    page: Callable[[MapManifest], str] | None = field(default=None)


def check_target(out: Path, *others: Path) -> None:
    """Refuse to write over anything but a map, and over a map that is being read.

    Raises:
        BadMap: Something else stands there.
    """
    for other in others:
        if out.resolve() == other.resolve():
            raise BadMap(f"{out}: is the map that was given; the new one needs another folder (--out)")
    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not _is_left_over(out))):
        if out.is_dir() and not (out / MANIFEST).exists():
            raise BadMap(f"{out}: holds something else than a map; choose another --out")
        read_manifest(out)


def write_map(out: Path, content: MapContent) -> MapManifest:
    """Write a map, in the place of an earlier state of the same one if there is any.

    Raises:
        BadMap: The folder cannot be written, or holds a map of which records would be lost.
    """
    _refuse_to_lose(out, content.logs)
    try:
        out.mkdir(parents=True, exist_ok=True)
        return _write(out, content)
    except OSError as error:
        raise BadMap(f"{out}: cannot be written: {error.strerror or error}") from error
    except sqlite3.Error as error:
        raise BadMap(f"{out}: cannot be written: {error}") from error


def _refuse_to_lose(out: Path, logs: Logs) -> None:
    """Whether all that a map in this folder holds stands in logs, too.

    Raises:
        BadMap: It does not, or that map cannot be read.
    """
    if not (out / MANIFEST).exists():
        return
    there = MapFolder.open(out)
    for log, records in there.records.items():
        if logs.get(log, ())[: len(records)] != records:
            of_swarm = f" of swarm {there.manifest.swarm}" if there.manifest.swarm else ""
            raise BadMap(
                f"{out}: holds the map {there.manifest.name!r}{of_swarm}, whose log {log} this one does not have; "
                "choose another --out, or remove that folder first"
            )


def _write(out: Path, content: MapContent) -> MapManifest:
    saved = content.solved.saved
    order = [*saved.logs, *sorted(saved.closed - set(saved.logs))]
    records = _put(out, "records", "bin", _packed(content.logs[log] for log in order))
    solution = _put(out, "solution", "npz", _arrays(content.solved, order))
    latent_file, latents = _put_latents(out, content.latents, set(order))
    entries = [_entry(log, content) for log in order]
    manifest = MapManifest(
        format=MAP_FORMAT,
        name=_readable(content.name),
        edition=content.edition,
        frame=map_frame(saved.anchor),
        made_by=flocc_version(),
        swarm=content.swarm,
        signed=any(opened_record(content.logs[log][0])[1] for log in order if content.logs[log]),
        front_end=content.front_end,
        back_end=(content.back_end or BackendConfig()).model_dump(mode="json"),
        logs=tuple(entries),
        poses=len(saved.logs),
        latents=latents,
        pruned=content.pruned,
        closures=len(saved.closures),
        left_out={str(log): reason for log, reason in content.solved.left_out.items()},
        contradicted=dict(content.solved.contradicted),
        records=records,
        solution=solution,
        latent_file=latent_file,
    )
    _replace(out / MANIFEST, (manifest.model_dump_json(indent=1) + "\n").encode())
    if content.page is not None:
        _replace(out / PAGE, content.page(manifest).encode())
    _sweep(out, manifest)
    return manifest


def _readable(name: str) -> str:
    """A name for people: what is no UTF-8, or no letter that can be printed, is replaced."""
    text = os.fsencode(name).decode("utf-8", "replace")
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)


def _entry(log: LogId, content: MapContent) -> SavedLogEntry:
    optics = content.optics.get(log, Optics())
    data = content.logs[log]
    return SavedLogEntry(
        log=str(log),
        records=len(data),
        bytes=sum(map(len, data)),
        keyframes=sum(isinstance(opened_record(each)[0], KeyframeRecord) for each in data),
        camera=optics.camera,
        T_body_camera=optics.T_body_camera,
    )


def _packed(logs: Iterable[Sequence[bytes]]) -> bytes:
    return b"".join(LENGTH.pack(len(data)) + data for records in logs for data in records)


def _arrays(solved: SolvedMap, order: Sequence[LogId]) -> bytes:
    saved, places = solved.saved, {log: k for k, log in enumerate(order)}
    ends = [(places[q.log], q.index, places[m.log], m.index) for q, m in saved.closures]
    values = [(0.0 if c.scale is None else c.scale, c.weight) for c in saved.closures.values()]
    arrays: dict[str, NDArray[Any]] = {
        "closures": np.array(ends, dtype=np.int64).reshape(-1, 4),
        "closure_values": np.array(values, dtype=float).reshape(-1, 2),
        **{f"poses{k}": tq_from_poses(saved.T_map_camera[log]) for k, log in enumerate(saved.logs)},
        **{f"covariances{k}": solved.covariances[log] for k, log in enumerate(saved.logs)},
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _put(out: Path, what: str, suffix: str, data: bytes) -> FileSum:
    """Write a file under a name that tells its content."""
    digest = hashlib.sha256(data).hexdigest()
    name = f"{what}-{digest[:16]}.{suffix}"
    _replace(out / name, data)
    return FileSum(name=name, bytes=len(data), sha256=digest)


def _put_latents(out: Path, latents: Iterable[tuple[KeyframeId, bytes, bytes]], of: set[LogId]) -> tuple[FileSum, int]:
    partial = out / "latents.partial"
    partial.unlink(missing_ok=True)
    with closing(sqlite3.connect(partial, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode = OFF")
        connection.execute("PRAGMA synchronous = OFF")
        connection.execute("BEGIN")
        connection.execute(LATENT_TABLE)
        rows = ((str(keyframe), sha256, data) for keyframe, sha256, data in latents if keyframe.log in of)
        connection.executemany("INSERT OR IGNORE INTO latents VALUES (?, ?, ?)", rows)
        (count,) = connection.execute("SELECT COUNT(*) FROM latents").fetchone()
        connection.execute("COMMIT")
    digest = hashlib.sha256()
    with partial.open("r+b") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
        os.fsync(file.fileno())
        size = file.tell()
    name = f"latents-{digest.hexdigest()[:16]}.sqlite"
    partial.replace(out / name)
    return FileSum(name=name, bytes=size, sha256=digest.hexdigest()), count


def _replace(path: Path, data: bytes) -> None:
    """Write a file in one step that a power cut does not take back."""
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _sweep(out: Path, manifest: MapManifest) -> None:
    """Remove what no `map.json` names any more: parts of the map before, and of saves that were cut off."""
    named = {manifest.records.name, manifest.solution.name, manifest.latent_file.name}
    for pattern in (*PARTS, "*.partial"):
        for file in out.glob(pattern):
            if file.name not in named:
                file.unlink(missing_ok=True)


def _is_left_over(out: Path) -> bool:
    """Whether a folder holds nothing but parts of a save that was cut off before there was a map."""
    parts = {file for pattern in (*PARTS, "*.partial") for file in out.glob(pattern)}
    return set(out.iterdir()) <= parts
