"""One SQLite file that never stops its user: damaged, it is kept aside; unwritable, its place is taken by memory."""

import fcntl
import logging
import os
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from flocc_protocol.errors import FloccError

logger = logging.getLogger(__name__)

MEMORY = ":memory:"
DAMAGED_MAX = 1000
BUSY_TIMEOUT_S = 5.0
RETRY_S = 10.0
"""A full disk is tried again at the first write after so long."""
WAL_BYTES_MAX = 16 * 1024 * 1024
CACHE_KIB = 256
"""Pages of a file that its connection holds: what is written is not read again before the next start, and SQLite's own
2 MiB would fill with it in the first hours of a mission."""
VERSION_MARK = 0x464C0000
"""`application_id` of a file is this plus its schema version."""
MARKED_FROM = 2
DISK_CODES = {
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_PERM,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_NOLFS,
    sqlite3.SQLITE_AUTH,
    sqlite3.SQLITE_INTERRUPT,
}
DAMAGE_CODES = {sqlite3.SQLITE_IOERR_SHORT_READ, sqlite3.SQLITE_IOERR_CORRUPTFS}
"""Of the disk's codes, those that mean the file."""

Row = tuple[Any, ...]
Migration = Callable[[sqlite3.Connection], None]


class StoreError(FloccError):
    """A store that must not be used: another robot's, or one in use by another process."""


class LaterSchema(StoreError):
    """A store of a later version of flocc, whose tables this one does not know."""


class StoreFailed(FloccError):
    """The disk failed; the robot goes on in memory."""


@dataclass(frozen=True, slots=True)
class Rescued:
    """What a fresh file took over from a damaged one.

    Attributes:
        said: One clause for people.
        is_small_whole: Whether nothing but records was lost.
    """

    said: str
    is_small_whole: bool


class Inspection(Protocol):
    """Knows what must be in the tables; used when a file is opened."""

    def fault(self, connection: sqlite3.Connection) -> str | None:
        """What is wrong with the content; None when it is sound."""
        ...

    def rescue(self, damaged: sqlite3.Connection, fresh: sqlite3.Connection) -> Rescued:
        """Copy what is sound from a damaged file, which may fail at any row, into a fresh one."""
        ...


class Database:
    """A file in WAL mode, or memory. Any thread may use it.

    Attributes:
        failure: Why memory takes the file's place; None while the disk works. Logged once, when it happens.
        was_damaged: Whether the file was found damaged and a fresh one begun.
        rescued: What the fresh one took over; None when nothing was damaged, or nothing could be saved.
    """

    def __init__(
        self,
        path: Path | None,
        schema: str,
        on_failed: Callable[[], None],
        migrations: Sequence[Migration] = (),
        inspection: Inspection | None = None,
        carried: Mapping[str, str] | None = None,
        on_recovered: Callable[[], None] = lambda: None,
    ) -> None:
        """Open or begin the file.

        Args:
            path: The file; None keeps everything in memory.
            schema: Statements that make the tables where they do not exist, as they are after all migrations.
            on_failed: Called once when the disk fails.
            migrations: Each brings a file from the schema version of its place here to the next one.
            inspection: Reads all of it now and looks for damage, which takes seconds per gigabyte; None does not.

            carried: Table -> columns that go from memory to the file once a full disk has room again.
            on_recovered: Called when that happened.

        Raises:
            LaterSchema: The file's schema version is above the number of migrations.
        """
        self.failure: StoreFailed | None = None
        self.was_damaged = False
        self.rescued: Rescued | None = None
        self._path = path
        self._schema = schema
        self._on_failed = on_failed
        self._migrations = migrations
        self._inspection = inspection
        self._carried = dict(carried or {})
        self._on_recovered = on_recovered
        self._retry_s = float("inf")
        self._lock = threading.RLock()
        self._connections: list[sqlite3.Connection] = []
        self._open()

    def _open(self) -> None:
        if self._path is None:
            self._connections = [_connect(MEMORY, self._schema, self._migrations)]
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._connections = [self._open_file(self._path)]
        except (sqlite3.Error, OSError) as error:
            self._fail(error)

    def _open_file(self, path: Path) -> sqlite3.Connection:
        try:
            return _connect(path, self._schema, self._migrations, self._inspection)
        except (sqlite3.DatabaseError, MemoryError) as error:
            if not _is_damage(error):
                raise
            self.was_damaged = True
            aside = _keep_aside(path)
            fresh = _connect(path, self._schema, self._migrations)
            self.rescued = self._rescue(aside, fresh)
            said = "nothing of it can be read" if self.rescued is None else self.rescued.said
            logger.warning(
                "%s: is damaged (%s); it is kept as %s and a fresh one begun: %s", path, error, aside.name, said
            )
            return fresh

    def _rescue(self, aside: Path, fresh: sqlite3.Connection) -> Rescued | None:
        """Let the fresh file take over what is sound in a copy of the damaged one, which stays as it was found."""
        if self._inspection is None:
            return None
        copy = aside.with_name(f"{aside.name}.reading")
        try:
            _copy(aside, copy)
            damaged = _connect(copy, "", self._migrations)
            try:
                return self._inspection.rescue(damaged, fresh)
            finally:
                damaged.close()
        except (sqlite3.Error, OSError, MemoryError, LaterSchema):
            return None
        finally:
            for part in _parts(copy):
                part.unlink(missing_ok=True)

    def write(self, statement: str, rows: Sequence[Row], durable: bool = False) -> int:
        """Execute a statement for all rows in one transaction, and give the count of changed rows.

        Durable, it has survived a power cut when this returns; otherwise a crash of this process at most.
        When the disk fails, the rows go to memory, and so does everything until a full disk has room again.
        """
        with self._lock:
            if time.monotonic() >= self._retry_s:
                self._return_to_file()
            try:
                return self._write(statement, rows, durable)
            except sqlite3.Error as error:
                if self._path is None or self.failure is not None:
                    raise  # what fails in memory is a bug
                self._fail(error)
                return self._write(statement, rows, durable)

    def _write(self, statement: str, rows: Sequence[Row], durable: bool) -> int:
        newest = self._connections[0]
        newest.execute(f"PRAGMA synchronous={'FULL' if durable else 'NORMAL'}")
        with newest:
            return newest.executemany(statement, rows).rowcount

    def read(self, query: str, values: Row = ()) -> list[Row]:
        """Give rows, those of memory before those of a file that failed; what cannot be read is not there."""
        with self._lock:
            return [row for connection in list(self._connections) for row in self._read(connection, query, values)]

    def _read(self, connection: sqlite3.Connection, query: str, values: Row) -> list[Row]:
        try:
            return connection.execute(query, values).fetchall()
        except sqlite3.DatabaseError as error:
            if self._path is None:
                raise
            if self.failure is None:
                self._fail(error)
            return []

    def _fail(self, error: Exception) -> None:
        """Say so once, and put memory before the file."""
        self.failure = StoreFailed(f"{self._path}: the disk failed ({error}); the robot goes on in memory")
        logger.error("%s", self.failure)
        if self._connections and self._carried and not _is_damage(error):
            self._retry_s = time.monotonic() + RETRY_S
        self._connections.insert(0, _connect(MEMORY, self._schema, self._migrations))
        self._on_failed()

    def _return_to_file(self) -> None:
        """Bring what memory took in the file's place onto the disk, all or nothing."""
        memory, file = self._connections
        try:
            file.execute("PRAGMA synchronous=FULL")
            with file:
                for table, columns in self._carried.items():
                    rows = memory.execute(f"SELECT {columns} FROM {table}").fetchall()
                    marks = ", ".join("?" * len(columns.split(", ")))
                    file.executemany(f"INSERT OR REPLACE INTO {table}({columns}) VALUES ({marks})", rows)
        except sqlite3.Error:
            self._retry_s = time.monotonic() + RETRY_S
            return
        memory.close()
        self._connections, self.failure, self._retry_s = [file], None, float("inf")
        logger.warning("%s: the disk works again; what was in memory meanwhile is on it", self._path)
        self._on_recovered()

    def close(self) -> None:
        """Close the file; safe to call twice."""
        with self._lock:
            for connection in self._connections:
                connection.close()


def _connect(
    path: Path | str, schema: str, migrations: Sequence[Migration], inspection: Inspection | None = None
) -> sqlite3.Connection:
    """Open a database, make its tables or bring them up to date, and perhaps check all of it before and after."""
    connection = sqlite3.connect(path, timeout=BUSY_TIMEOUT_S, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute(f"PRAGMA cache_size=-{CACHE_KIB}")
        connection.execute(f"PRAGMA journal_size_limit={WAL_BYTES_MAX}")
        verdict = "ok" if inspection is None else connection.execute("PRAGMA quick_check(1)").fetchone()[0]
        if verdict != "ok":
            raise sqlite3.DatabaseError(verdict)
        _migrate(path, connection, migrations)
        connection.executescript(schema)
        fault = None if inspection is None else inspection.fault(connection)
        if fault is not None:
            raise sqlite3.DatabaseError(fault)
    except BaseException:
        connection.close()
        raise
    return connection


def _migrate(path: Path | str, connection: sqlite3.Connection, migrations: Sequence[Migration]) -> None:
    """Bring a file's tables to the schema version of today, each step whole or not at all; a fresh file is there."""
    is_fresh = connection.execute("SELECT COUNT(*) FROM sqlite_schema").fetchone()[0] == 0
    version = len(migrations) if is_fresh else _version(connection)
    if version > len(migrations):
        raise LaterSchema(f"{path}: is of schema {version}, a later flocc's; this one reads up to {len(migrations)}")
    for number, migration in enumerate(migrations[version:], start=version + 1):
        with connection:
            connection.execute("BEGIN")
            migration(connection)
            _mark_version(connection, number)
    if is_fresh:
        _mark_version(connection, version)


def _version(connection: sqlite3.Connection) -> int:
    """The schema version; from `MARKED_FROM` on it is there twice, so that an altered one is not believed."""
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    (mark,) = connection.execute("PRAGMA application_id").fetchone()
    if mark != (VERSION_MARK + version if version >= MARKED_FROM else 0):
        raise sqlite3.DatabaseError(f"its header says schema {version} and mark {mark:x}, which do not agree")
    return int(version)


def _mark_version(connection: sqlite3.Connection, version: int) -> None:
    connection.execute(f"PRAGMA user_version={version}")
    if version >= MARKED_FROM:
        connection.execute(f"PRAGMA application_id={VERSION_MARK + version}")


def _is_damage(error: Exception) -> bool:
    """Whether the file itself is at fault, rather than the disk or its permissions."""
    code = getattr(error, "sqlite_errorcode", None)
    return code is None or code in DAMAGE_CODES or code & 0xFF not in DISK_CODES


def _keep_aside(path: Path) -> Path:
    """Rename a database and its WAL, so that only a person opens them again."""
    asides = (path.with_name(f"{path.name}.damaged-{number}") for number in range(1, DAMAGED_MAX))
    aside = next((each for each in asides if not each.exists()), path.with_name(f"{path.name}.damaged-{DAMAGED_MAX}"))
    for part, kept in zip(_parts(path), _parts(aside), strict=True):
        if part.exists():
            os.replace(part, kept)
    return aside


def _copy(path: Path, copy: Path) -> None:
    """Copy a database with its WAL."""
    for part, copied in zip(_parts(path), _parts(copy), strict=True):
        if part.exists():
            shutil.copyfile(part, copied)


def _parts(path: Path) -> list[Path]:
    return [path.with_name(path.name + suffix) for suffix in ("", "-wal", "-shm")]


def hold_lock(path: Path) -> BinaryIO | None:
    """Hold a lock file for as long as this process lives; None where the disk has no place for one.

    Raises:
        StoreError: Another process holds it.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("wb")
    except OSError:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise StoreError(f"{path.parent}: is in use by another process") from None
    return file
