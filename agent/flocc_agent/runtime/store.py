"""What a robot keeps over restarts: its log, others' logs, latents, applied corrections, its identity.

Two SQLite files: `robot.sqlite` holds everything small and is checked at each start, `latents.sqlite` is a bounded
cache whose entries carry a hash. An own record has survived even a power cut when `put_record` returns; others' may
lose the last moments before one, and gossip brings them again.

No failure of the disk stops the robot: a damaged file is kept aside and a fresh one begun, and when writing fails the
store goes on in memory and says so in `failure`. After either, the robot comes back with a new incarnation, so that
no number of its log is ever used twice. Methods are synchronous; any thread may call them.
"""

import hashlib
import logging
import sqlite3
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from flocc_agent.runtime.database import Database, StoreError, StoreFailed, hold_lock
from flocc_agent.runtime.stored_correction import from_envelope
from flocc_protocol.ids import KeyframeId, LogId

if TYPE_CHECKING:
    from flocc_agent.config import StoreConfig

logger = logging.getLogger(__name__)

MEMORY_LATENT_BYTES_MAX = 256 * 1024 * 1024

RECORD_SCHEMA = """
CREATE TABLE IF NOT EXISTS records(
    log TEXT, number INTEGER, data BLOB NOT NULL, PRIMARY KEY(log, number)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS corrections(robot TEXT PRIMARY KEY, data BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS facts(name TEXT PRIMARY KEY, data BLOB NOT NULL) WITHOUT ROWID;
"""
LATENT_SCHEMA = """
CREATE TABLE IF NOT EXISTS latents(
    age INTEGER PRIMARY KEY AUTOINCREMENT, keyframe TEXT UNIQUE, sha256 BLOB NOT NULL, bytes INTEGER NOT NULL,
    data BLOB NOT NULL);
"""


def _free_corrections_of_messages(connection: sqlite3.Connection) -> None:
    """Schema 0 kept corrections as messages of protocol version 2."""
    kept = connection.execute("SELECT robot, data FROM corrections").fetchall()
    for robot, data in kept:
        connection.execute(
            "UPDATE corrections SET data = ? WHERE robot = ?", (from_envelope(robot, data) or b"", robot)
        )


MIGRATIONS = (_free_corrections_of_messages,)
"""Each brings `robot.sqlite` one schema version up; never changed once released, only added to."""


@dataclass(frozen=True, slots=True)
class StoreIdentity:
    """Who writes here: the robot's own log, and how often it was started with it (1 at first)."""

    log: LogId
    boots: int


@dataclass(frozen=True, slots=True)
class StoredRecord:
    """One record of one log."""

    log: LogId
    number: int
    data: bytes


class Store:
    """A robot's memory over restarts; `Store.open` gives one."""

    def __init__(self, folder: Path | None, config: "StoreConfig") -> None:
        self.identity = StoreIdentity(LogId("nobody"), 0)
        self._folder = folder
        self._config = config
        self._lock = threading.RLock()
        self._lock_file = hold_lock(folder / "lock") if folder is not None else None
        self._records = Database(self._path("robot.sqlite"), RECORD_SCHEMA, True, self._forget_intact, MIGRATIONS)
        self._latents = Database(self._path("latents.sqlite"), LATENT_SCHEMA, False, self._forget_latents)
        self._others_bytes = self._latent_bytes = 0

    @classmethod
    def open(
        cls,
        folder: Path | None,
        robot: str,
        config: "StoreConfig",
        incarnation: int = 0,
        incarnation_after_loss: int = 1,
    ) -> "Store":
        """Open or begin a robot's store.

        Args:
            folder: Where its files are; None keeps everything in memory.
            robot: Whose store it is.
            config: Bounds.
            incarnation: The robot's life when nothing is known of an earlier one.
            incarnation_after_loss: Its life when an earlier one was damaged; must not have been used before.

        Raises:
            StoreError: It belongs to another robot, or another process uses it.
        """
        store = cls(folder, config)
        try:
            store._identify(robot, incarnation, incarnation_after_loss)
        except StoreError:
            store.close()
            raise
        store._measure()
        return store

    @property
    def failure(self) -> StoreFailed | None:
        """Why the store goes on in memory; None while the disk works."""
        return self._records.failure or self._latents.failure

    def end_log(self) -> None:
        """The robot's own log cannot be continued: the next start begins another one; this one stays valid."""
        self._forget_intact()

    def close(self) -> None:
        """Close the files; safe to call twice."""
        self._records.close()
        self._latents.close()
        if self._lock_file is not None:
            self._lock_file.close()

    # --- records

    def put_record(self, log: LogId, number: int, data: bytes) -> None:
        """Keep one record; an own one is safe when this returns. A record that is there already stays as it is."""
        self.put_records([StoredRecord(log, number, data)])

    def put_records(self, records: Iterable[StoredRecord]) -> None:
        """Keep records in one transaction; others' only as far as the configured size allows."""
        own = self.identity.log
        with self._lock:
            kept = [record for record in records if record.log == own or self._is_room_for(record)]
        rows = [(str(record.log), record.number, record.data) for record in kept]
        durable = any(record.log == own for record in kept)
        self._records.write("INSERT OR IGNORE INTO records VALUES (?, ?, ?)", rows, durable)

    def _is_room_for(self, record: StoredRecord) -> bool:
        if self._others_bytes + len(record.data) > self._config.record_bytes_max:
            return False
        self._others_bytes += len(record.data)
        return True

    def records(self, log: LogId, first: int = 0) -> list[StoredRecord]:
        """Give a log's records from a number on, in order; in others' logs numbers may be missing."""
        rows = self._records.read("SELECT number, data FROM records WHERE log = ? AND number >= ?", (str(log), first))
        found: dict[int, bytes] = dict(reversed(rows))
        return [StoredRecord(log, number, found[number]) for number in sorted(found)]

    def logs(self) -> list[LogId]:
        """Give all logs of which a record is kept, sorted."""
        return sorted({LogId.parse(name) for (name,) in self._records.read("SELECT DISTINCT log FROM records")})

    # --- latents

    def put_latent(self, keyframe: KeyframeId, latent: bytes) -> None:
        """Keep a latent; the oldest ones give way beyond the configured size."""
        if len(latent) > self._config.latent_bytes_max:
            return
        row = (str(keyframe), hashlib.sha256(latent).digest(), len(latent), latent)
        with self._lock:
            added = self._latents.write("INSERT OR IGNORE INTO latents VALUES (NULL, ?, ?, ?, ?)", [row])
            self._latent_bytes += len(latent) if added > 0 else 0
            while self._latent_bytes > self._latent_bytes_max():
                self._evict_oldest()

    def _latent_bytes_max(self) -> int:
        on_disk = self._folder is not None and self._latents.failure is None
        return self._config.latent_bytes_max if on_disk else min(MEMORY_LATENT_BYTES_MAX, self._config.latent_bytes_max)

    def _evict_oldest(self) -> None:
        oldest = self._latents.read("SELECT age, bytes FROM latents ORDER BY age LIMIT 1")
        if not oldest:
            self._latent_bytes = 0
            return
        age, size = oldest[0]
        self._latents.write("DELETE FROM latents WHERE age = ?", [(age,)])
        self._latent_bytes -= size

    def latent(self, keyframe: KeyframeId) -> bytes | None:
        """Give a latent, None when it was never kept, has been evicted or is damaged."""
        for sha256, data in self._latents.read("SELECT sha256, data FROM latents WHERE keyframe = ?", (str(keyframe),)):
            if hashlib.sha256(data).digest() == sha256:
                return bytes(data)
        return None

    def has_latent(self, keyframe: KeyframeId) -> bool:
        """Tell whether a latent is kept, without reading it."""
        return bool(self._latents.read("SELECT 1 FROM latents WHERE keyframe = ?", (str(keyframe),)))

    def latent_keyframes(self) -> list[KeyframeId]:
        """Give all keyframes whose latents are kept, sorted."""
        return sorted({KeyframeId.parse(name) for (name,) in self._latents.read("SELECT keyframe FROM latents")})

    # --- small things

    def put_correction(self, robot: str, data: bytes) -> None:
        """Keep the last correction that was applied for a robot."""
        self._records.write("INSERT OR REPLACE INTO corrections VALUES (?, ?)", [(robot, data)])

    def correction(self, robot: str) -> bytes | None:
        """Give the last correction that was applied for a robot."""
        rows = self._records.read("SELECT data FROM corrections WHERE robot = ?", (robot,))
        return bytes(rows[0][0]) if rows else None

    def put_term_counter(self, counter: int) -> None:
        """Keep the highest term counter that this robot claimed; it is safe when this returns."""
        self._put_facts([("term_counter", b"%d" % counter)], durable=True)

    def term_counter(self) -> int:
        """Give the highest term counter that this robot claimed, 0 before the first."""
        return int(self.fact("term_counter") or 0)

    def put_fact(self, name: str, data: bytes) -> None:
        """Keep anything small by name."""
        self._put_facts([(name, data)])

    def fact(self, name: str) -> bytes | None:
        """Give what was kept by name."""
        rows = self._records.read("SELECT data FROM facts WHERE name = ?", (name,))
        return bytes(rows[0][0]) if rows else None

    def _put_facts(self, facts: list[tuple[str, bytes]], durable: bool = False) -> None:
        self._records.write("INSERT OR REPLACE INTO facts VALUES (?, ?)", facts, durable)

    # --- identity

    def _identify(self, robot: str, incarnation: int, incarnation_after_loss: int) -> None:
        """Find or choose the robot's log; a life whose end may be missing on disk is not continued."""
        written = self.fact("log")
        log = LogId.parse(written.decode()) if written is not None else None
        if log is not None and log.robot != robot:
            raise StoreError(f"{self._folder}: belongs to robot {log.robot}, not to {robot}")
        intact = self._path("intact")
        was_cut = log is not None and intact is not None and not intact.exists()
        if log is None or was_cut:
            was_lost = was_cut or self._records.was_damaged
            self.identity = StoreIdentity(LogId(robot, incarnation_after_loss if was_lost else incarnation), 1)
            logger.info("robot %s: begins the log %s", robot, self.identity.log)
        else:
            self.identity = StoreIdentity(log, int(self.fact("boots") or 0) + 1)
        self._mark_intact()
        log_text, boots = str(self.identity.log).encode(), b"%d" % self.identity.boots
        self._put_facts([("log", log_text), ("boots", boots)], durable=True)

    def _mark_intact(self) -> None:
        """Leave a file that can be removed when the disk is full, to tell the next start that the log was cut."""
        intact = self._path("intact")
        if intact is not None and self._records.failure is None:
            try:
                intact.touch()
            except OSError as error:
                logger.error("%s: cannot be written: %s", intact, error.strerror)

    def _forget_intact(self) -> None:
        intact = self._path("intact")
        try:
            if intact is not None:
                intact.unlink(missing_ok=True)
        except OSError as error:
            logger.error("%s: cannot be removed: %s", intact, error.strerror)

    def _forget_latents(self) -> None:
        self._latent_bytes = 0

    def _measure(self) -> None:
        """Add up what is kept, for the bounds."""
        query = "SELECT COALESCE(SUM(LENGTH(data)), 0) FROM records WHERE log != ?"
        self._others_bytes = sum(size for (size,) in self._records.read(query, (str(self.identity.log),)))
        self._latent_bytes = sum(size for (size,) in self._latents.read("SELECT COALESCE(SUM(bytes), 0) FROM latents"))

    def _path(self, name: str) -> Path | None:
        return self._folder / name if self._folder is not None else None
