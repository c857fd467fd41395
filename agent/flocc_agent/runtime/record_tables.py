"""The tables of `robot.sqlite`: each row carries a checksum of its own, over what it is as well as what it holds.

A row whose checksum is wrong is never given to anybody. SQLite's own check finds broken pages, not altered bytes in
them; a write-ahead log that is cut or altered is not found by either, see `intact`.
"""

import sqlite3
import zlib
from collections import defaultdict
from collections.abc import Iterator

from flocc_agent.runtime.database import Rescued, Row
from flocc_agent.runtime.stored_correction import from_envelope

SCHEMA = """
CREATE TABLE IF NOT EXISTS records(
    log TEXT, number INTEGER, data BLOB NOT NULL, checksum INTEGER NOT NULL DEFAULT -1, PRIMARY KEY(log, number)
    ) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS corrections(
    robot TEXT PRIMARY KEY, data BLOB NOT NULL, checksum INTEGER NOT NULL DEFAULT -1) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS facts(
    name TEXT PRIMARY KEY, data BLOB NOT NULL, checksum INTEGER NOT NULL DEFAULT -1) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS aside(log TEXT, number INTEGER, data BLOB, checksum INTEGER);
"""
COLUMNS = {
    "records": "log, number, data, checksum",
    "corrections": "robot, data, checksum",
    "facts": "name, data, checksum",
}
"""Table -> columns: what a row is, then its content and its checksum."""
PUT_RECORD = f"INSERT OR IGNORE INTO records({COLUMNS['records']}) VALUES (?, ?, ?, ?)"
PUT_CORRECTION = f"INSERT OR REPLACE INTO corrections({COLUMNS['corrections']}) VALUES (?, ?, ?)"
PUT_FACT = f"INSERT OR REPLACE INTO facts({COLUMNS['facts']}) VALUES (?, ?, ?)"


def row(table: str, *fields: str | int | bytes) -> Row:
    """A row with its checksum; the last field is its content."""
    return (*fields, _checksum(table, fields))


def is_sound(table: str, stored: Row) -> bool:
    """Whether a row as it was read is the one that was put."""
    *fields, checksum = stored
    types = (str, int, bytes) if table == "records" else (str, bytes)
    return tuple(map(type, fields)) == types and checksum == _checksum(table, tuple(fields))


def _checksum(table: str, fields: tuple[str | int | bytes, ...]) -> int:
    *place, data = fields
    assert isinstance(data, bytes)
    return zlib.crc32(data, zlib.crc32("/".join([table, *map(str, place)]).encode("utf-8", "surrogateescape")))


def _free_corrections_of_messages(connection: sqlite3.Connection) -> None:
    """Schema 0 kept corrections as messages of protocol version 2."""
    kept = connection.execute("SELECT robot, data FROM corrections").fetchall()
    for robot, data in kept:
        connection.execute(
            "UPDATE corrections SET data = ? WHERE robot = ?", (from_envelope(robot, data) or b"", robot)
        )


def _add_checksums(connection: sqlite3.Connection) -> None:
    """Schema 1 had none: what an older store holds now is taken for sound."""
    for table, columns in COLUMNS.items():
        *fields, _ = columns.split(", ")
        connection.execute(f"ALTER TABLE {table} ADD COLUMN checksum INTEGER NOT NULL DEFAULT -1")
        rows = connection.execute(f"SELECT {', '.join(fields)} FROM {table}").fetchall()
        where = " AND ".join(f"{field} = ?" for field in fields[:-1])
        sums = [(_checksum(table, each), *each[:-1]) for each in rows]
        connection.executemany(f"UPDATE {table} SET checksum = ? WHERE {where}", sums)


MIGRATIONS = (_free_corrections_of_messages, _add_checksums)
"""Each brings `robot.sqlite` one schema version up; never changed once released, only added to."""


class RecordTables:
    """Looks for altered rows, and saves what is sound of a damaged file."""

    def fault(self, connection: sqlite3.Connection) -> str | None:
        """Name the first row that is not as it was put; None when all are."""
        for table, columns in COLUMNS.items():
            for stored in connection.execute(f"SELECT {columns} FROM {table}"):
                if not is_sound(table, stored):
                    return f"a row of {table} was altered: {' '.join(map(str, stored[:-2]))[:100]!r}"
        return None

    def rescue(self, damaged: sqlite3.Connection, fresh: sqlite3.Connection) -> Rescued:
        """Copy what can be read and is sound; of each log, what stands before the first record that is not."""
        damaged.text_factory = _text
        small = [_sound_rows(damaged, table) for table in ("facts", "corrections")]
        records = _sound_rows(damaged, "records")
        with fresh:
            for statement, table in ((PUT_FACT, small[0]), (PUT_CORRECTION, small[1])):
                fresh.executemany(statement, table.rows)
            prefixes = _prefixes(records.rows)
            fresh.executemany(PUT_RECORD, prefixes)
        lost = records.altered + len(records.rows) - len(prefixes)
        is_torn = records.is_torn or any(table.is_torn for table in small)
        said = f"{len(prefixes)} records are sound and kept, {lost} are not{', and some of it is unreadable' * is_torn}"
        return Rescued(said, is_small_whole=not any(table.altered or table.is_torn for table in small))


class _Read:
    """What could be read of a damaged table: sound rows, the count of others, and whether reading ended early."""

    def __init__(self) -> None:
        self.rows: list[Row] = []
        self.altered = 0
        self.is_torn = False


def _sound_rows(damaged: sqlite3.Connection, table: str) -> _Read:
    """Read from the front, and from the back what a broken page hides from there."""
    read = _Read()
    seen: dict[Row, None] = {}
    for order in ("ASC", "DESC"):
        try:
            for stored in _rows(damaged, table, order):
                if is_sound(table, stored):
                    seen[stored] = None
                elif not read.is_torn:
                    read.altered += 1
            break
        except (sqlite3.Error, MemoryError):
            read.is_torn = True
    read.rows = list(seen)
    return read


def _rows(damaged: sqlite3.Connection, table: str, order: str) -> Iterator[Row]:
    key = COLUMNS[table].split(", ")[:-2]
    by = ", ".join(f"{column} {order}" for column in key)
    yield from damaged.execute(f"SELECT {COLUMNS[table]} FROM {table} ORDER BY {by}")


def _prefixes(rows: list[Row]) -> list[Row]:
    """Of each log the records from number 0 on without a gap."""
    of_log: defaultdict[str, dict[int, Row]] = defaultdict(dict)
    for stored in rows:
        of_log[stored[0]][stored[1]] = stored
    return [held[number] for _, held in sorted(of_log.items()) for number in _whole(held)]


def _whole(held: dict[int, Row]) -> range:
    return range(next(number for number in range(len(held) + 1) if number not in held))


def _text(data: bytes) -> str:
    """Text as it is in a damaged file; what is none compares unequal to all that was put."""
    return data.decode("utf-8", "surrogateescape")
