"""One SQLite file that never stops its user: damaged, it is kept aside; unwritable, its place is taken by memory."""

import fcntl
import logging
import os
import sqlite3
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from flocc_protocol.errors import FloccError

logger = logging.getLogger(__name__)

MEMORY = ":memory:"
DAMAGED_MAX = 1000
BUSY_TIMEOUT_S = 5.0
WAL_BYTES_MAX = 16 * 1024 * 1024

Row = tuple[Any, ...]
Migration = Callable[[sqlite3.Connection], None]


class StoreError(FloccError):
    """A store that must not be used: another robot's, or one in use by another process."""


class LaterSchema(StoreError):
    """A store of a later version of flocc, whose tables this one does not know."""


class StoreFailed(FloccError):
    """The disk failed; the robot goes on in memory."""


class Database:
    """A file in WAL mode, or memory. Any thread may use it.

    Attributes:
        failure: Why memory took the file's place; None while the disk works. Logged once, when it happens.
        was_damaged: Whether the file was found damaged and a fresh one begun.
    """

    def __init__(
        self,
        path: Path | None,
        schema: str,
        is_checked: bool,
        on_failed: Callable[[], None],
        migrations: Sequence[Migration] = (),
    ) -> None:
        """Open or begin the file.

        Args:
            path: The file; None keeps everything in memory.
            schema: Statements that make the tables where they do not exist, as they are after all migrations.
            is_checked: Whether to read all of it now and look for damage; takes seconds per gigabyte.
            on_failed: Called once when the disk fails.
            migrations: Each brings a file from the schema version of its place here to the next one.

        Raises:
            LaterSchema: The file's schema version is above the number of migrations.
        """
        self.failure: StoreFailed | None = None
        self.was_damaged = False
        self._path = path
        self._schema = schema
        self._is_checked = is_checked
        self._on_failed = on_failed
        self._migrations = migrations
        self._lock = threading.RLock()
        self._connections: list[sqlite3.Connection] = []
        self._open()

    def _open(self) -> None:
        if self._path is None:
            self._connections = [_connect(MEMORY, self._schema, False, self._migrations)]
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._connections = [self._open_file(self._path)]
        except (sqlite3.Error, OSError) as error:
            self._fail(error)

    def _open_file(self, path: Path) -> sqlite3.Connection:
        try:
            return _connect(path, self._schema, self._is_checked, self._migrations)
        except sqlite3.DatabaseError as error:
            if not _is_damage(error):
                raise
            self.was_damaged = True
            aside = _keep_aside(path)
            logger.warning("%s: is damaged (%s); it is kept as %s and a fresh one begun", path, error, aside.name)
            return _connect(path, self._schema, False, self._migrations)

    def write(self, statement: str, rows: Sequence[Row], durable: bool = False) -> int:
        """Execute a statement for all rows in one transaction, and give the count of changed rows.

        Durable, it has survived a power cut when this returns; otherwise a crash of this process at most.
        When the disk fails, the rows go to memory, and so does everything from then on.
        """
        with self._lock:
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
        self._connections.insert(0, _connect(MEMORY, self._schema, False, self._migrations))
        self._on_failed()

    def close(self) -> None:
        """Close the file; safe to call twice."""
        with self._lock:
            for connection in self._connections:
                connection.close()


def _connect(path: Path | str, schema: str, is_checked: bool, migrations: Sequence[Migration]) -> sqlite3.Connection:
    """Open a database, perhaps check all of it, make its tables or bring them up to date."""
    connection = sqlite3.connect(path, timeout=BUSY_TIMEOUT_S, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute(f"PRAGMA journal_size_limit={WAL_BYTES_MAX}")
        verdict = connection.execute("PRAGMA quick_check(1)").fetchone()[0] if is_checked else "ok"
        if verdict != "ok":
            raise sqlite3.DatabaseError(verdict)
        _migrate(path, connection, migrations)
        connection.executescript(schema)
    except (sqlite3.Error, StoreError):
        connection.close()
        raise
    return connection


def _migrate(path: Path | str, connection: sqlite3.Connection, migrations: Sequence[Migration]) -> None:
    """Bring a file's tables to the schema version of today, each step whole or not at all; a fresh file is there."""
    is_fresh = connection.execute("SELECT COUNT(*) FROM sqlite_schema").fetchone()[0] == 0
    version = len(migrations) if is_fresh else connection.execute("PRAGMA user_version").fetchone()[0]
    if version > len(migrations):
        raise LaterSchema(f"{path}: is of schema {version}, a later flocc's; this one reads up to {len(migrations)}")
    for number, migration in enumerate(migrations[version:], start=version + 1):
        with connection:
            connection.execute("BEGIN")
            migration(connection)
            connection.execute(f"PRAGMA user_version={number}")
    if is_fresh:
        connection.execute(f"PRAGMA user_version={len(migrations)}")


def _is_damage(error: sqlite3.DatabaseError) -> bool:
    """Whether the file itself is at fault, rather than the disk or its permissions."""
    code = getattr(error, "sqlite_errorcode", None)
    return code is None or code & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


def _keep_aside(path: Path) -> Path:
    """Rename a database and its WAL, so that only a person opens them again."""
    asides = (path.with_name(f"{path.name}.damaged-{number}") for number in range(1, DAMAGED_MAX))
    aside = next((each for each in asides if not each.exists()), path.with_name(f"{path.name}.damaged-{DAMAGED_MAX}"))
    for suffix in ("", "-wal", "-shm"):
        part = path.with_name(path.name + suffix)
        if part.exists():
            os.replace(part, aside.with_name(aside.name + suffix))
    return aside


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
