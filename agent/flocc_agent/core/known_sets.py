"""Sets that grow with the mission, in few bytes: of keyframes, and of pairs of them.

A set is whole numbers in their order, an array for each log or pair of logs: 4 bytes a keyframe and 8 a pair, where
objects take some 200 and 300. A table of pairs is bounded, and finds those with a keyframe of the same stretch.
"""

from array import array
from bisect import bisect_left
from collections.abc import Callable
from itertools import product
from typing import Generic, TypeVar

from flocc_protocol.ids import INDEX_MAX, KeyframeId, LogId
from flocc_protocol.messages import CandidatePair


def pair_number(pair: CandidatePair) -> int:
    """A pair of keyframes of two known logs as one number; numbers are in the order of the pairs."""
    return pair.low.index * (INDEX_MAX + 1) + pair.high.index


def pair_of(logs: tuple[LogId, LogId], number: int) -> CandidatePair:
    """The pair of two logs that a number stands for."""
    low, high = divmod(number, INDEX_MAX + 1)
    return CandidatePair(KeyframeId(logs[0], low), KeyframeId(logs[1], high))


def place_of(numbers: "array[int]", number: int) -> tuple[int, bool]:
    """Where a number is among others in their order, or would be; and whether it is there."""
    at = bisect_left(numbers, number)
    return at, at < len(numbers) and numbers[at] == number


class PairSet:
    """Pairs, by their two logs."""

    def __init__(self) -> None:
        self._of_logs: dict[tuple[LogId, LogId], array[int]] = {}

    def __contains__(self, pair: CandidatePair) -> bool:
        numbers = self._of_logs.get((pair.low.log, pair.high.log))
        return numbers is not None and place_of(numbers, pair_number(pair))[1]

    def add(self, pair: CandidatePair) -> None:
        """Take a pair in."""
        key = (pair.low.log, pair.high.log)
        numbers = self._of_logs.get(key)
        if numbers is None:
            numbers = self._of_logs[key] = array("Q")
        _put(numbers, pair_number(pair))

    def discard(self, pair: CandidatePair) -> None:
        """Leave a pair out, where it is there."""
        _take_out(self._of_logs.get((pair.low.log, pair.high.log)), pair_number(pair))

    def of_logs(self, low: LogId, high: LogId) -> "array[int]":
        """Numbers of the pairs of two logs, in their order."""
        return self._of_logs.get((low, high), array("Q"))

    def keep_of_stretch(self, log: LogId, first: int, end: int, stays: Callable[[CandidatePair], bool]) -> None:
        """Of the pairs with a keyframe of a log, from one to before another, keep those that are to stay."""
        for logs in [logs for logs in self._of_logs if log in logs]:
            pairs = ((number, pair_of(logs, number)) for number in self._of_logs[logs])
            kept = [number for number, pair in pairs if not _is_of_stretch(pair, log, first, end) or stays(pair)]
            self._of_logs[logs] = array("Q", kept)


class KeyframeSet:
    """Keyframes, by their logs."""

    def __init__(self) -> None:
        self._of_log: dict[LogId, array[int]] = {}

    def __contains__(self, keyframe: object) -> bool:
        if not isinstance(keyframe, KeyframeId):
            return False
        numbers = self._of_log.get(keyframe.log)
        return numbers is not None and place_of(numbers, keyframe.index)[1]

    def add(self, keyframe: KeyframeId) -> None:
        """Take a keyframe in."""
        numbers = self._of_log.get(keyframe.log)
        if numbers is None:
            numbers = self._of_log[keyframe.log] = array("I")
        _put(numbers, keyframe.index)

    def discard(self, keyframe: KeyframeId) -> None:
        """Leave a keyframe out, where it is there."""
        _take_out(self._of_log.get(keyframe.log), keyframe.index)


Value = TypeVar("Value")
BLOCK = 16
"""Keyframes of a log that are looked for together."""


class PairTable(Generic[Value]):
    """Pairs with a value each; beyond a maximum the oldest is forgotten."""

    def __init__(self, pairs_max: int) -> None:
        """Start without any, for at most so many."""
        self._pairs_max = pairs_max
        self._values: dict[CandidatePair, Value] = {}
        self._of_block: dict[tuple[LogId, int], dict[CandidatePair, None]] = {}

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
        for block in _blocks_of(pair):
            self._of_block.setdefault(block, {})[pair] = None
        if len(self._values) > self._pairs_max:
            self.pop(next(iter(self._values)))

    def pop(self, pair: CandidatePair) -> Value | None:
        """Leave a pair out; its value, None where it was not there."""
        value = self._values.pop(pair, None)
        if value is not None:
            for block in _blocks_of(pair):
                del self._of_block[block][pair]
                if not self._of_block[block]:
                    del self._of_block[block]
        return value

    def beside(self, pair: CandidatePair, reach: int) -> list[CandidatePair]:
        """Pairs of the same logs whose keyframes are at most so many from a pair's, at both ends; in their order."""
        found = self._around(pair.low, reach)
        logs = pair.low.log, pair.high.log
        return sorted(p for p in found if (p.low.log, p.high.log) == logs and is_beside(pair, p, reach))

    def near(self, pair: CandidatePair, reach: int) -> list[CandidatePair]:
        """Pairs with a keyframe that is at most so many from one of a pair's, in their order."""
        found = self._around(pair.low, reach) | self._around(pair.high, reach)
        return sorted(other for other in found if is_near(pair, other, reach))

    def _around(self, keyframe: KeyframeId, reach: int) -> set[CandidatePair]:
        log, index = keyframe
        blocks = range((index - reach) // BLOCK, (index + reach) // BLOCK + 1)
        return {pair for block in blocks for pair in self._of_block.get((log, block), ())}


def is_near(pair: CandidatePair, other: CandidatePair, reach: int) -> bool:
    """Whether a keyframe of one pair is in a stretch of the other."""
    ends = product((pair.low, pair.high), (other.low, other.high))
    return any(one.log == end.log and abs(one.index - end.index) <= reach for one, end in ends)


def is_beside(pair: CandidatePair, other: CandidatePair, reach: int) -> bool:
    """Whether two pairs of the same two logs are of the same stretches."""
    low, high = abs(pair.low.index - other.low.index), abs(pair.high.index - other.high.index)
    return low <= reach and high <= reach


def _blocks_of(pair: CandidatePair) -> dict[tuple[LogId, int], None]:
    return dict.fromkeys((log, index // BLOCK) for log, index in (pair.low, pair.high))


def _is_of_stretch(pair: CandidatePair, log: LogId, first: int, end: int) -> bool:
    return any(each.log == log and first <= each.index < end for each in (pair.low, pair.high))


def _put(numbers: "array[int]", number: int) -> None:
    at, is_there = place_of(numbers, number)
    if not is_there:
        numbers.insert(at, number)


def _take_out(numbers: "array[int] | None", number: int) -> None:
    if numbers is None:
        return
    at, is_there = place_of(numbers, number)
    if is_there:
        del numbers[at]
