"""What a robot says of a table with one entry per log: a hash of all of it, and what changed to those who ask.

Changes are numbered from the robot's start on, and each entry carries the number of its last change; so whoever knows
the table up to a number is told what changed since, and nothing is kept of who was told what.
"""

from itertools import islice
from typing import Generic, TypeVar

from flocc_protocol.digests import LogDigest, TableState, entry_hash
from flocc_protocol.ids import LogId
from flocc_protocol.log_corrections import CorrectionVersion

Entry = TypeVar("Entry", LogDigest, CorrectionVersion)


class Announcer(Generic[Entry]):
    """One table's entries by log, in the order of their last change."""

    def __init__(self) -> None:
        self._entries: dict[LogId, tuple[int, Entry, int]] = {}
        self._hash = 0
        self._changes = 0

    def put(self, log: LogId, entry: Entry) -> None:
        """Note an entry, new or changed."""
        before = self._entries.pop(log, None)
        if before is not None:
            self._hash ^= before[2]
        hashed = entry_hash(entry)
        self._hash ^= hashed
        self._changes += 1
        self._entries[log] = (self._changes, entry, hashed)

    def remove(self, log: LogId) -> None:
        """Forget an entry; those who know of it find that hashes differ."""
        before = self._entries.pop(log, None)
        if before is not None:
            self._hash ^= before[2]
            self._changes += 1

    def state(self) -> TableState:
        """The whole table, for a heartbeat."""
        return TableState(self._hash, self._changes)

    def all(self) -> tuple[Entry, ...]:
        """Every entry, in the order of the logs."""
        return tuple([self._entries[log][1] for log in sorted(self._entries)])

    def since(self, changes: int, entries_max: int) -> tuple[int, tuple[Entry, ...]]:
        """What changed after that many changes, at most so many entries, and the change up to which this tells."""
        changed: list[tuple[int, Entry, int]] = []
        for each in reversed(self._entries.values()):
            if each[0] <= changes:
                break
            changed.append(each)
        told = list(islice(reversed(changed), entries_max))
        through = told[-1][0] if len(told) < len(changed) else self._changes
        return through, tuple([entry for _, entry, _ in told])
