"""What a mission left in its robots' stores: logs, latents, front end, cameras. Stores are read and never changed.

A store may belong to a robot that still runs: its files are opened as SQLite's readers open them, without the lock that
the robot holds.
"""

import hashlib
import json
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from flocc_agent.config import BackendConfig
from flocc_agent.runtime.kept_for_maps import BACK_END_FACT, CAMERA_FACT, FRONT_END_FACT, MAP_FACT, UsedMap
from flocc_agent.runtime.map_folder import MANIFEST, BadMap, LensModel, MapFolder, MapFrontEnd, longer_copy
from flocc_agent.runtime.record_tables import COLUMNS, is_sound
from flocc_protocol.codec import Pose7
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import SIGNATURE_BYTES, KeyframeRecord, Record, decode_record

Logs = Mapping[LogId, tuple[bytes, ...]]
DECODED_MAX = 50_000


@dataclass(frozen=True, slots=True)
class Optics:
    """A log's camera, and where it sits on the robot's body."""

    camera: LensModel | None = None
    T_body_camera: Pose7 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Gathered:
    """What a mission left.

    Attributes:
        where: For sentences.
        logs: The longest sound copy of each log.
        front_end: What made descriptors and latents.
        optics: Of each log, as far as its robot kept it.
        stores: Folders of the stores, for latents.
        recordings: Log -> its recording, where a run names one; for thumbnails.
        back_end: How its robots solved; None where their stores do not say.
        used: The map in which the robots worked, None where there was none.
        swarm: Its name, as far as it is known.
    """

    where: str
    logs: Logs
    front_end: MapFrontEnd
    optics: Mapping[LogId, Optics]
    stores: tuple[Path, ...]
    recordings: Mapping[LogId, Path] = field(default_factory=dict)
    back_end: BackendConfig | None = None
    used: UsedMap | None = None
    swarm: str | None = None

    def latents(self) -> Iterator[tuple[KeyframeId, bytes, bytes]]:
        """(keyframe, SHA-256, latent) of every latent of these logs that is sound, each once."""
        seen: set[str] = set()
        for store in self.stores:
            for name, sha256, data in _latents(store):
                keyframe = None if name in seen else _keyframe(name)
                if keyframe is None or keyframe.log not in self.logs or hashlib.sha256(data).digest() != sha256:
                    continue
                seen.add(name)
                yield keyframe, sha256, data


def store_folders(where: Path) -> list[Path]:
    """Stores below a run folder, an agent's folder, or a store itself.

    Raises:
        BadMap: There are none.
    """
    found = [folder for folder in (where, where / "store") if (folder / "robot.sqlite").is_file()]
    found += [path.parent for path in sorted(where.glob("robots/*/store/robot.sqlite"))]
    if not found and (where / MANIFEST).is_file():
        raise BadMap(f"{where}: is a map already")
    if not where.is_dir():
        raise BadMap(f"{where}: there is no such folder")
    if not found:
        raise BadMap(f"{where}: holds no robot's store (robots/*/store of a run, or the folder of an agent)")
    return found


def gathered(where: Path, recordings: Mapping[str, Path] | None = None) -> Gathered:
    """Read all stores of a run, or one agent's.

    Raises:
        BadMap: There is no store, one cannot be read, two contradict each other, or robots used different front ends.
    """
    stores = store_folders(where)
    logs: dict[LogId, tuple[bytes, ...]] = {}
    optics: dict[LogId, Optics] = {}
    of_robots: dict[LogId, Path] = {}
    front_ends: list[MapFrontEnd] = []
    back_ends: list[BackendConfig] = []
    used: list[UsedMap] = []
    for store in stores:
        facts, records = _small(store)
        for log, copy in records.items():
            logs[log] = _longer(where, log, logs.get(log, ()), copy)
        optics |= _optics(facts)
        front_ends += _parsed(facts, FRONT_END_FACT, MapFrontEnd)
        back_ends += _parsed(facts, BACK_END_FACT, BackendConfig)
        used += _parsed(facts, MAP_FACT, UsedMap)
        own = facts.get("log", b"").decode()
        if own and (recording := (recordings or {}).get(LogId.parse(own).robot)) is not None:
            of_robots[LogId.parse(own)] = recording
    return Gathered(
        str(where),
        {log: logs[log] for log in sorted(logs)},
        _one_front_end(where, front_ends),
        optics,
        tuple(stores),
        of_robots,
        back_ends[0] if back_ends else None,
        _one_map(where, used),
    )


def _small(store: Path) -> tuple[dict[str, bytes], dict[LogId, tuple[bytes, ...]]]:
    """Facts, and each log as far as it has no gap and no damaged record."""
    with _reading(store / "robot.sqlite") as connection:
        facts = {
            row[0]: row[1]
            for row in connection.execute(f"SELECT {COLUMNS['facts']} FROM facts")
            if is_sound("facts", row)
        }
        by_log: dict[str, list[bytes]] = {}
        query = f"SELECT {COLUMNS['records']} FROM records ORDER BY log, number"
        for row in connection.execute(query):
            copy = by_log.setdefault(row[0], [])
            if row[1] == len(copy) and is_sound("records", row):
                copy.append(row[2])
    return facts, {LogId.parse(name): tuple(copy) for name, copy in by_log.items()}


def _latents(store: Path) -> Iterator[tuple[str, bytes, bytes]]:
    if (store / "latents.sqlite").is_file():
        with _reading(store / "latents.sqlite") as connection:
            yield from connection.execute("SELECT keyframe, sha256, data FROM latents ORDER BY age")


@contextmanager
def _reading(file: Path) -> Iterator[sqlite3.Connection]:
    try:
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True)) as connection:
            yield connection
    except sqlite3.Error as error:
        raise BadMap(f"{file}: cannot be read: {error}") from error


def _longer(where: Path, log: LogId, one: tuple[bytes, ...], other: tuple[bytes, ...]) -> tuple[bytes, ...]:
    longer = longer_copy(one, other)
    if longer is None:
        raise BadMap(f"{where}: two robots hold different logs {log}: two missions, or two writers of one log")
    return longer


def _optics(facts: Mapping[str, bytes]) -> dict[LogId, Optics]:
    found = {}
    for name, data in facts.items():
        kind, _, log = name.partition(" ")
        if kind == CAMERA_FACT and log:
            kept = json.loads(data)
            T = tuple(float(each) for each in kept["T_body_camera"])
            found[LogId.parse(log)] = Optics(LensModel.model_validate(kept["camera"]), T)  # type: ignore[arg-type]
    return found


def _parsed(facts: Mapping[str, bytes], name: str, model: Any) -> list[Any]:
    try:
        return [model.model_validate_json(facts[name])] if name in facts else []
    except ValidationError:
        return []


def _one_front_end(where: Path, found: list[MapFrontEnd]) -> MapFrontEnd:
    """What all robots saw with; settings may differ, models may not."""
    kinds = sorted({(str(each.method), str(each.model)) for each in found})
    if len(kinds) > 1:
        raise BadMap(f"{where}: its robots saw with different front ends: {', '.join(model for _, model in kinds)}")
    return found[0] if found else MapFrontEnd()


def _one_map(where: Path, used: list[UsedMap]) -> UsedMap | None:
    paths = sorted({each.path for each in used})
    if len(paths) > 1:
        raise BadMap(f"{where}: its robots worked in different maps: {', '.join(paths)}")
    return used[0] if used else None


def _keyframe(name: str) -> KeyframeId | None:
    try:
        return KeyframeId.parse(name)
    except ValueError:
        return None


@lru_cache(maxsize=DECODED_MAX)
def opened_record(data: bytes) -> tuple[Record, bool]:
    """A record of a log, and whether its writer's signature stands behind it; signatures are not checked here.

    Raises:
        DecodeError: It is no record.
    """
    try:
        return decode_record(data), False
    except DecodeError:
        return decode_record(data[:-SIGNATURE_BYTES]), True


def stamps_s(opened: MapFolder, log: LogId) -> list[float]:
    """Stamp of each keyframe of a log; the place of one that cannot be read is taken by the next."""
    found: list[float] = []
    for data in opened.records[log]:
        record = opened_record(data)[0]
        if isinstance(record, KeyframeRecord):
            found += [record.stamp_s] * (record.index + 1 - len(found))
    return found
