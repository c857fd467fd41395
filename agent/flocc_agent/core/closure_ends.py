"""Closures as their logs see them: what a robot holds corrections against, without reading a record again.

Rules: every robot takes in every closure, and corrections are looked at now and then; so taking one in is five numbers
at the ends of columns, and who asks for those of one log looks through all.
"""

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import ClosureRecord

COUNT_MAX = 2**16 - 1


class Tie(NamedTuple):
    """One closure of a log: its keyframe there, the other end, and how long its translation is, metres or 0."""

    near: int
    far: KeyframeId
    length_m: float


def length_m(closure: ClosureRecord) -> float:
    """How far apart its cameras are; 0 without a scale."""
    x, y, z = closure.T_query_match_unscaled[:3]
    return (closure.scale_initial or 0.0) * math.hypot(x, y, z)


def tie_of(log: LogId, query: KeyframeId, match: KeyframeId, length_m: float) -> Tie:
    """A closure as one of its logs sees it."""
    return Tie(query.index, match, length_m) if query.log == log else Tie(match.index, query, length_m)


@dataclass(slots=True)
class _Between:
    """Keyframes that closures between two logs join, among the first so many closures."""

    known: int = 0
    ends: list[tuple[int, int]] = field(default_factory=list)


@dataclass(slots=True)
class _Counts:
    """How many of the first so many closures each keyframe of a log has."""

    known: int = 0
    at: "array[int]" = field(default_factory=lambda: array("H"))

    def add(self, indices: NDArray[np.uintc]) -> None:
        """Count one more at each of some keyframes."""
        for index in indices.tolist():
            if index >= len(self.at):
                self.at.extend([0] * (index + 1 - len(self.at)))
            self.at[index] = min(self.at[index] + 1, COUNT_MAX)


class ClosureEnds:
    """All closures, in the order in which they became known: 20 bytes each."""

    def __init__(self) -> None:
        self._logs: list[LogId] = []
        self._numbers: dict[LogId, int] = {}
        self._query_logs = array("I")
        self._queries = array("I")
        self._match_logs = array("I")
        self._matches = array("I")
        self._lengths_m = array("f")
        self._between: dict[tuple[int, int], _Between] = {}
        self._counts: dict[int, _Counts] = {}

    def put(self, closure: ClosureRecord) -> None:
        """Note a closure."""
        (query_log, query), (match_log, match) = closure.query, closure.match
        self._query_logs.append(self._number(query_log))
        self._queries.append(query)
        self._match_logs.append(self._number(match_log))
        self._matches.append(match)
        self._lengths_m.append(length_m(closure))

    def remove(self, one: KeyframeId, other: KeyframeId) -> None:
        """Forget the closure of a pair: another registration takes its place."""
        for k in self._of(one.log).tolist():
            if {self._query(k), self._match(k)} == {one, other}:
                for column in (self._query_logs, self._queries, self._match_logs, self._matches, self._lengths_m):
                    del column[k]
                self._between.clear()
                self._counts.clear()
                return

    def ties(self, log: LogId, ties_max: int) -> Sequence[Tie]:
        """The newest ones of a log, the newest first."""
        newest = self._of(log)[-ties_max:][::-1].tolist()
        return [tie_of(log, self._query(k), self._match(k), self._lengths_m[k]) for k in newest]

    def beside(self, one: KeyframeId, other: KeyframeId, reach: int) -> list[tuple[int, int]]:
        """Closures with a length whose keyframes are at most so many from two of these logs; the same ends' indices.

        Which closures are between two logs is remembered, and only later ones are looked through.
        """
        logs = self._numbers.get(one.log), self._numbers.get(other.log)
        if logs[0] is None or logs[1] is None:
            return []
        between = self._between.setdefault((logs[0], logs[1]), _Between())
        if between.known < len(self._queries):
            between.ends += self._ends_between(logs[0], logs[1], between.known)
            between.known = len(self._queries)
        low, high = one.index, other.index
        return [(i, j) for i, j in between.ends if abs(i - low) <= reach and abs(j - high) <= reach]

    def tied(self, keyframe: KeyframeId, reach: int) -> int:
        """Closures at keyframes of a log that are at most so many from one, whatever log is at their other end."""
        number = self._numbers.get(keyframe.log)
        if number is None:
            return 0
        counts = self._counts.setdefault(number, _Counts())
        if counts.known < len(self._queries):
            for logs, indices in ((self._query_logs, self._queries), (self._match_logs, self._matches)):
                of_log = np.frombuffer(logs, dtype=np.uintc)[counts.known :] == number
                counts.add(np.frombuffer(indices, dtype=np.uintc)[counts.known :][of_log])
            counts.known = len(self._queries)
        return sum(counts.at[max(keyframe.index - reach, 0) : keyframe.index + reach + 1])

    def _ends_between(self, one: int, other: int, first: int) -> list[tuple[int, int]]:
        """Keyframes of two logs that closures from a place on join, the first log's first."""
        query_logs, match_logs = (
            np.frombuffer(each, dtype=np.uintc)[first:] for each in (self._query_logs, self._match_logs)
        )
        forth = (query_logs == one) & (match_logs == other)
        back = (query_logs == other) & (match_logs == one)
        found: list[tuple[int, int]] = []
        for k in (np.flatnonzero(forth | back) + first).tolist():
            if self._lengths_m[k] > 0.0:
                ends = self._queries[k], self._matches[k]
                is_back = self._query_logs[k] != one or (one == other and ends[0] > ends[1])
                found.append((ends[1], ends[0]) if is_back else ends)
        return found

    def links(self) -> list[tuple[LogId, LogId]]:
        """Pairs of logs with closures between them, or within one."""
        numbers = sorted(set(zip(self._query_logs, self._match_logs, strict=True)))
        return [(self._logs[query], self._logs[match]) for query, match in numbers]

    def _of(self, log: LogId) -> NDArray[np.intp]:
        """Where closures of a log stand."""
        number = self._numbers.get(log)
        if number is None:
            return np.empty(0, dtype=np.intp)
        query_logs, match_logs = (np.frombuffer(each, dtype=np.uintc) for each in (self._query_logs, self._match_logs))
        return np.flatnonzero((query_logs == number) | (match_logs == number))

    def _query(self, k: int) -> KeyframeId:
        return KeyframeId(self._logs[self._query_logs[k]], self._queries[k])

    def _match(self, k: int) -> KeyframeId:
        return KeyframeId(self._logs[self._match_logs[k]], self._matches[k])

    def _number(self, log: LogId) -> int:
        number = self._numbers.get(log)
        if number is None:
            number = self._numbers[log] = len(self._logs)
            self._logs.append(log)
        return number
