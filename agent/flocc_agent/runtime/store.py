"""What a robot keeps over restarts: its log, others' logs, latents, applied corrections, its identity.

Two SQLite files: `robot.sqlite` holds everything small and is checked at each start, `latents.sqlite` is a bounded
cache whose entries carry a hash. An own record has survived even a power cut when `put_record` returns; others' may
lose the last moments before one, and gossip brings them again.

No failure of the disk stops the robot: of a damaged file what is sound goes into a fresh one and the file is kept
aside; when writing fails the store goes on in memory until there is room again, and says so in `failure`. Where
anything may be missing that others heard of this robot, it comes back with a new incarnation, so that no number of
its log is ever used twice; its earlier log is then another's, of which gossip brings what peers hold. Methods are
synchronous; any thread may call them.
"""

import hashlib
import logging
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from flocc_agent.runtime.database import Database, StoreError, StoreFailed, hold_lock
from flocc_agent.runtime.intact import Intact, Reached
from flocc_agent.runtime.record_tables import (
    COLUMNS,
    MIGRATIONS,
    PUT_CORRECTION,
    PUT_FACT,
    PUT_RECORD,
    SCHEMA,
    RecordTables,
    row,
)
from flocc_protocol.ids import KeyframeId, LogId

if TYPE_CHECKING:
    from flocc_agent.config import StoreConfig
    from flocc_agent.runtime.map_folder import MapFolder

logger = logging.getLogger(__name__)

MEMORY_LATENT_BYTES_MAX = 256 * 1024 * 1024
ASIDE_MAX = 100_000
"""Records that are kept aside; the oldest give way."""

LATENT_SCHEMA = """
CREATE TABLE IF NOT EXISTS latents(
    age INTEGER PRIMARY KEY AUTOINCREMENT, keyframe TEXT UNIQUE, sha256 BLOB NOT NULL, bytes INTEGER NOT NULL,
    data BLOB NOT NULL);
"""
REPLACE_LATENT = "UPDATE latents SET sha256 = ?, bytes = ?, data = ? WHERE keyframe = ?"


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

    def __init__(self, folder: Path | None, config: "StoreConfig", incarnation_after_loss: int) -> None:
        self.identity = StoreIdentity(LogId("nobody"), 0)
        self._folder = folder
        self._config = config
        self._incarnation_after_loss = incarnation_after_loss
        self._lock = threading.RLock()
        self._lock_file = hold_lock(folder / "lock") if folder is not None else None
        self._intact = Intact(self._path("intact"))
        self._intact_is_kept = True
        self._reached = Reached(0, 0)
        self._records = Database(
            self._path("robot.sqlite"),
            SCHEMA,
            self._intact.remove,
            MIGRATIONS,
            RecordTables(),
            COLUMNS,
            lambda: self._reach(self._reached),
        )
        self._latents = Database(
            self._path("latents.sqlite"),
            LATENT_SCHEMA,
            self._forget_latents,
            carried={"latents": "keyframe, sha256, bytes, data"},
            on_recovered=self._measure,
        )
        self._others_bytes = self._latent_bytes = 0
        self._map: MapFolder | None = None

    def open_map(self, opened: "MapFolder") -> None:
        """Give latents of a saved map as if they were the store's; the map is closed with it, and never written to."""
        self._map = opened

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
        store = cls(folder, config, incarnation_after_loss)
        try:
            store._identify(robot, incarnation)
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
        """The robot's own log cannot be continued, since others hold another one: the next start begins a new one.

        What the disk has of it is set aside, and what comes is not kept: gossip brings back what others hold.
        """
        with self._lock:
            self._intact_is_kept = False
            self._intact.remove()
            self._move_aside(self.identity.log)

    def begin_journey(self) -> None:
        """Write another log from now on, unless nothing was written yet; the earlier one stays, and its latents."""
        if self.records(self.identity.log):
            self._be(StoreIdentity(LogId(self.identity.log.robot, self._incarnation_after_loss), 1))
            self._measure()

    def set_aside(self, log: LogId) -> None:
        """Keep a log's records for a person only; where it is the robot's own, begin another one."""
        self._move_aside(log)
        if log == self.identity.log:
            self._be(StoreIdentity(LogId(log.robot, self._incarnation_after_loss), 1))
        self._measure()

    def _move_aside(self, log: LogId) -> None:
        name = str(log)
        self._records.write(f"INSERT INTO aside SELECT {COLUMNS['records']} FROM records WHERE log = ?", [(name,)])
        self._records.write("DELETE FROM records WHERE log = ?", [(name,)])
        self._records.write("DELETE FROM aside WHERE rowid <= (SELECT MAX(rowid) FROM aside) - ?", [(ASIDE_MAX,)])

    def close(self) -> None:
        """Close the files; safe to call twice."""
        self._records.close()
        self._latents.close()
        if self._lock_file is not None:
            self._lock_file.close()
        if self._map is not None:
            self._map.close()

    # --- records

    def put_record(self, log: LogId, number: int, data: bytes) -> None:
        """Keep one record; an own one is safe when this returns. A record that is there already stays as it is."""
        self.put_records([StoredRecord(log, number, data)])

    def put_records(self, records: Iterable[StoredRecord]) -> None:
        """Keep records in one transaction; others' only as far as the configured size allows."""
        own = self.identity.log
        with self._lock:
            kept = [r for r in records if (self._intact_is_kept if r.log == own else self._is_room_for(r))]
            rows = [row("records", str(record.log), record.number, record.data) for record in kept]
            own_numbers = [record.number for record in kept if record.log == own]
            self._records.write(PUT_RECORD, rows, durable=bool(own_numbers))
            if own_numbers:
                self._reach(Reached(max(own_numbers) + 1, self._reached.term_counter))

    def _is_room_for(self, record: StoredRecord) -> bool:
        if self._others_bytes + len(record.data) > self._config.record_bytes_max:
            return False
        self._others_bytes += len(record.data)
        return True

    def drop_log(self, log: LogId) -> None:
        """Keep nothing of another robot's log any more."""
        assert log != self.identity.log
        with self._lock:
            self._records.write("DELETE FROM records WHERE log = ?", [(str(log),)])
            self._measure()

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

    def replace_latent(self, keyframe: KeyframeId, latent: bytes) -> None:
        """Keep another latent in the place of one that is there."""
        row = (hashlib.sha256(latent).digest(), len(latent), latent, str(keyframe))
        with self._lock:
            known = self._latents.read("SELECT bytes FROM latents WHERE keyframe = ?", (str(keyframe),))
            if known and self._latents.write(REPLACE_LATENT, [row]) > 0:
                self._latent_bytes += len(latent) - known[0][0]

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
        return None if self._map is None else self._map.latent(keyframe)

    def has_latent(self, keyframe: KeyframeId) -> bool:
        """Tell whether a latent is kept, without reading it."""
        return bool(self._latents.read("SELECT 1 FROM latents WHERE keyframe = ?", (str(keyframe),)))

    def latent_keyframes(self) -> list[KeyframeId]:
        """Give all keyframes whose latents are kept, sorted."""
        names = {name for (name,) in self._latents.read("SELECT keyframe FROM latents")}
        return sorted(keyframe for name in names if (keyframe := _keyframe(name)) is not None)

    # --- small things

    def put_correction(self, robot: str, data: bytes) -> None:
        """Keep the last correction that was applied for a robot."""
        self._records.write(PUT_CORRECTION, [row("corrections", robot, data)])

    def correction(self, robot: str) -> bytes | None:
        """Give the last correction that was applied for a robot."""
        rows = self._records.read("SELECT data FROM corrections WHERE robot = ?", (robot,))
        return bytes(rows[0][0]) if rows else None

    def put_term_counter(self, counter: int) -> None:
        """Keep the highest term counter that this robot claimed; it is safe when this returns."""
        with self._lock:
            self._put_facts([("term_counter", b"%d" % counter)], durable=True)
            self._reach(Reached(self._reached.records, counter))

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
        self._records.write(PUT_FACT, [row("facts", *fact) for fact in facts], durable)

    # --- identity

    def _identify(self, robot: str, incarnation: int) -> None:
        """Find or choose the robot's log; a life whose end may be missing on disk is not continued."""
        written = self.fact("log")
        log = LogId.parse(written.decode()) if written is not None else None
        if log is not None and log.robot != robot:
            raise StoreError(f"{self._folder}: belongs to robot {log.robot}, not to {robot}")
        if log is not None and self._is_whole(log):
            self._be(StoreIdentity(log, int(self.fact("boots") or 0) + 1))
        else:
            had_one = log is not None or self._intact.exists() or self._records.was_damaged
            self._be(StoreIdentity(LogId(robot, self._incarnation_after_loss if had_one else incarnation), 1))

    def _be(self, identity: StoreIdentity) -> None:
        """Write a log from now on."""
        self.identity = identity
        if identity.boots == 1:
            logger.info("robot %s: begins the log %s", identity.log.robot, identity.log)
        self._reached = Reached(len(self.records(identity.log)), self.term_counter())
        log_text, boots = str(identity.log).encode(), b"%d" % identity.boots
        counter = b"%d" % self._reached.term_counter
        self._put_facts([("log", log_text), ("boots", boots), ("term_counter", counter)], durable=True)
        self._reach(self._reached)

    def _is_whole(self, log: LogId) -> bool:
        """Whether nothing of the own log is missing that others may have heard."""
        if self._folder is None:
            return True
        if not self._intact.exists():
            return False
        held, rescued = Reached(len(self.records(log)), self.term_counter()), self._records.rescued
        reached = self._intact.reached(str(log))
        if self._records.was_damaged:
            return held == reached and rescued is not None and rescued.is_small_whole
        if reached is None or (held.records >= reached.records and held.term_counter >= reached.term_counter):
            return True
        logger.warning(
            "%s: holds %d records of %s, and held %d: it went back in time; the robot begins a new log",
            self._folder,
            held.records,
            log,
            reached.records,
        )
        return False

    def _reach(self, reached: Reached) -> None:
        """Note how far the own log came, unless the disk failed and it must not be continued."""
        self._reached = reached
        if self._records.failure is None and self._intact_is_kept:
            self._intact.write(str(self.identity.log), reached)

    def _forget_latents(self) -> None:
        self._latent_bytes = 0

    def _measure(self) -> None:
        """Add up what is kept, for the bounds."""
        query = "SELECT COALESCE(SUM(LENGTH(data)), 0) FROM records WHERE log != ?"
        self._others_bytes = sum(size for (size,) in self._records.read(query, (str(self.identity.log),)))
        self._latent_bytes = sum(size for (size,) in self._latents.read("SELECT COALESCE(SUM(bytes), 0) FROM latents"))

    def _path(self, name: str) -> Path | None:
        return self._folder / name if self._folder is not None else None


def _keyframe(name: str) -> KeyframeId | None:
    """The keyframe of a latent's entry; None where the entry is damaged."""
    try:
        return KeyframeId.parse(name)
    except ValueError:
        return None
