"""What a heartbeat says of a table with one entry per log: all of it while that is little, else a part.

A part holds what changed lately, each change in `REPEATS` heartbeats, and some of the others in turn, so that a robot
that missed a change hears of it within a few heartbeats. A new neighbour is told everything.
"""

from typing import Generic, TypeVar

from flocc_protocol.ids import LogId

TURN = 16
REPEATS = 2

Entry = TypeVar("Entry")


class Announcer(Generic[Entry]):
    """One table's entries by log, and which of them the next heartbeat carries."""

    def __init__(self) -> None:
        self._entries: dict[LogId, Entry] = {}
        self._all: tuple[Entry, ...] | None = ()
        self._fresh: dict[LogId, int] = {}
        self._logs: list[LogId] = []
        self._position = 0

    def put(self, log: LogId, entry: Entry) -> None:
        """Note an entry, new or changed."""
        if log not in self._entries:
            self._logs = sorted([*self._logs, log])
        self._entries[log] = entry
        self._fresh[log] = REPEATS
        self._all = None

    def all(self) -> tuple[Entry, ...]:
        """Every entry, in the order of the logs."""
        if self._all is None:
            self._all = tuple(self._entries[log] for log in self._logs)
        return self._all

    def say_all(self) -> None:
        """Let the next heartbeat carry everything: somebody new listens."""
        self._fresh = {log: self._fresh.get(log, 1) for log in self._logs}

    def next(self) -> tuple[Entry, ...]:
        """What one heartbeat carries."""
        if len(self._entries) <= TURN:
            self._fresh.clear()
            return self.all()
        said = dict.fromkeys(self._fresh)
        self._fresh = {log: left - 1 for log, left in self._fresh.items() if left > 1}
        for _ in range(TURN):
            self._position = (self._position + 1) % len(self._logs)
            said[self._logs[self._position]] = None
        return tuple(self._entries[log] for log in said)
