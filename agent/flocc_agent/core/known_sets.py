"""Sets that grow with the mission, in few bytes: of keyframes, and of pairs of them.

A set is whole numbers in their order, an array for each log or pair of logs: 4 bytes a keyframe and 8 a pair, where
objects take some 200 and 300.
"""

from array import array
from bisect import bisect_left

from flocc_protocol.ids import INDEX_MAX, KeyframeId, LogId
from flocc_protocol.messages import CandidatePair


def pair_number(pair: CandidatePair) -> int:
    """A pair of keyframes of two known logs as one number; numbers are in the order of the pairs."""
    return pair.low.index * (INDEX_MAX + 1) + pair.high.index


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
