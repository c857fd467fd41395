"""Pairs of keyframes, found by their two logs.

A set grows with the mission: some 90 to 140 bytes a pair instead of 300. A table is bounded, and says which of its
pairs are of the same stretches of two ways as a pair.
"""

from collections.abc import Iterator
from typing import Generic, TypeVar

from flocc_protocol.ids import INDEX_MAX, LogId
from flocc_protocol.messages import CandidatePair


class PairSet:
    """Pairs, by their two logs, as whole numbers made of their two indices."""

    def __init__(self) -> None:
        self._of_logs: dict[tuple[LogId, LogId], set[int]] = {}

    def __contains__(self, pair: CandidatePair) -> bool:
        return _number(pair) in self._of_logs.get((pair.low.log, pair.high.log), ())

    def add(self, pair: CandidatePair) -> None:
        """Take a pair in."""
        self._of_logs.setdefault((pair.low.log, pair.high.log), set()).add(_number(pair))

    def discard(self, pair: CandidatePair) -> None:
        """Leave a pair out, where it is there."""
        self._of_logs.get((pair.low.log, pair.high.log), set()).discard(_number(pair))


Value = TypeVar("Value")


class PairTable(Generic[Value]):
    """Pairs with a value each; beyond a maximum the oldest is forgotten."""

    def __init__(self, pairs_max: int) -> None:
        """Start without any, for at most so many."""
        self._pairs_max = pairs_max
        self._values: dict[CandidatePair, Value] = {}
        self._of_logs: dict[tuple[LogId, LogId], dict[CandidatePair, None]] = {}

    def __contains__(self, pair: CandidatePair) -> bool:
        return pair in self._values

    def __len__(self) -> int:
        return len(self._values)

    def size(self) -> tuple[int, int]:
        """How many there are, and at most."""
        return len(self._values), self._pairs_max

    def put(self, pair: CandidatePair, value: Value) -> None:
        """Take a pair in; one that is there keeps its place."""
        self._values[pair] = value
        self._of_logs.setdefault((pair.low.log, pair.high.log), {})[pair] = None
        if len(self._values) > self._pairs_max:
            self.pop(next(iter(self._values)))

    def pop(self, pair: CandidatePair) -> Value | None:
        """Leave a pair out; its value, None where it was not there."""
        value = self._values.pop(pair, None)
        if value is not None:
            logs = pair.low.log, pair.high.log
            del self._of_logs[logs][pair]
            if not self._of_logs[logs]:
                del self._of_logs[logs]
        return value

    def beside(self, pair: CandidatePair, reach: int) -> Iterator[CandidatePair]:
        """Pairs of the same logs whose keyframes are at most so many from a pair's, at both ends."""
        of_logs = self._of_logs.get((pair.low.log, pair.high.log), ())
        return (other for other in of_logs if is_beside(pair, other, reach))


def is_beside(pair: CandidatePair, other: CandidatePair, reach: int) -> bool:
    """Whether two pairs of the same two logs are of the same stretches."""
    low, high = abs(pair.low.index - other.low.index), abs(pair.high.index - other.high.index)
    return low <= reach and high <= reach


def _number(pair: CandidatePair) -> int:
    return pair.low.index * (INDEX_MAX + 1) + pair.high.index
