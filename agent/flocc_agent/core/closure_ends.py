"""Closures as one of their logs sees them: what a robot holds corrections against, without reading a record again."""

import math
from array import array
from collections.abc import Sequence
from typing import NamedTuple

from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import ClosureRecord


class Tie(NamedTuple):
    """One closure of a log: its keyframe there, the other end, and how long its translation is, metres or 0."""

    near: int
    far: KeyframeId
    length_m: float


def tie_of(log: LogId, closure: ClosureRecord) -> Tie:
    """A closure as one of its logs sees it."""
    near, far = (closure.query, closure.match) if closure.query.log == log else (closure.match, closure.query)
    return Tie(near.index, far, (closure.scale_initial or 0.0) * math.hypot(*closure.T_query_match_unscaled[:3]))


class _Columns:
    """The ties of one log in the order in which they became known; logs by their number."""

    __slots__ = ("far", "far_log", "length_m", "near")

    def __init__(self) -> None:
        self.near = array("I")
        self.far_log = array("I")
        self.far = array("I")
        self.length_m = array("f")

    def append(self, near: int, far_log: int, far: int, length_m: float) -> None:
        self.near.append(near)
        self.far_log.append(far_log)
        self.far.append(far)
        self.length_m.append(length_m)

    def remove(self, near: int, far_log: int, far: int) -> None:
        for k in range(len(self.near)):
            if (self.near[k], self.far_log[k], self.far[k]) == (near, far_log, far):
                for column in (self.near, self.far_log, self.far, self.length_m):
                    del column[k]
                return


class TieColumns:
    """The ties of all logs: 16 bytes for each end of a closure."""

    def __init__(self) -> None:
        self._logs: list[LogId] = []
        self._numbers: dict[LogId, int] = {}
        self._columns: dict[LogId, _Columns] = {}
        self._links: dict[tuple[LogId, LogId], None] = {}

    def put(self, closure: ClosureRecord) -> None:
        """Note a closure."""
        logs = closure.query.log, closure.match.log
        for log in dict.fromkeys(logs):
            near, far, length_m = tie_of(log, closure)
            self._columns_of(log).append(near, self._number(far.log), far.index, length_m)
        self._links[min(logs), max(logs)] = None

    def remove(self, one: KeyframeId, other: KeyframeId) -> None:
        """Forget the closure of a pair: another registration takes its place."""
        for near, far in ((one, other), (other, one)):
            self._columns_of(near.log).remove(near.index, self._number(far.log), far.index)

    def of(self, log: LogId, ties_max: int) -> Sequence[Tie]:
        """The newest ties of a log, the newest first."""
        held = self._columns.get(log)
        if held is None:
            return ()
        return [
            Tie(held.near[k], KeyframeId(self._logs[held.far_log[k]], held.far[k]), held.length_m[k])
            for k in range(len(held.near) - 1, max(-1, len(held.near) - 1 - ties_max), -1)
        ]

    def links(self) -> list[tuple[LogId, LogId]]:
        """Pairs of logs with closures between them, or within one."""
        return list(self._links)

    def _columns_of(self, log: LogId) -> _Columns:
        held = self._columns.get(log)
        if held is None:
            held = self._columns[log] = _Columns()
        return held

    def _number(self, log: LogId) -> int:
        number = self._numbers.get(log)
        if number is None:
            number = self._numbers[log] = len(self._logs)
            self._logs.append(log)
        return number
