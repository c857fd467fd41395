"""Place recognition: cosine similarity of descriptors, best match per keyframe, threshold (Sec. III-A)."""

import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.parameters import PlaceRecognitionParameters
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

Descriptor = NDArray[np.float32]

CAPACITY_FIRST = 64
DIRECTIONS_MAX = 1024
RUN_REACH = 2
"""Keyframes to either side that a run has; 1 and 3 tell as much on `street`."""
RUN_MIN = 2


@dataclass(frozen=True, slots=True)
class Candidate:
    """Two keyframes of different robots that look alike."""

    pair: CandidatePair
    similarity: float


Found = tuple[KeyframeId, Candidate]
"""A new keyframe and a candidate that it gave."""


class _Descriptors:
    """The descriptors of one log, as the rows of one growing matrix."""

    def __init__(self, dimension: int) -> None:
        self._rows = np.empty((CAPACITY_FIRST, dimension), dtype=np.float32)
        self.dimension = dimension
        self.indices: list[int] = []

    @property
    def matrix(self) -> Descriptor:
        return self._rows[: len(self.indices)]

    def position(self, index: int) -> int | None:
        """Row of a keyframe, None where it has none."""
        at = bisect_left(self.indices, index)
        return at if at < len(self.indices) and self.indices[at] == index else None

    def append(self, index: int, descriptor: Descriptor) -> None:
        count = len(self.indices)
        if count == len(self._rows):
            rows = np.empty((count + max(CAPACITY_FIRST, count // 4), self.dimension), dtype=np.float32)
            rows[:count] = self._rows
            self._rows = rows
        self._rows[count] = descriptor
        self.indices.append(index)


class PlaceRecognition:
    """Compares each new keyframe with those of the other robots.

    A robot with keyframes of its own looks at pairs that it is part of, since both partners do the same. Its own
    earlier logs that it knows for closed are compared like another robot's.

    Attributes:
        refused: Descriptors of another length than their log's, or without direction.
        best_similarities: Robot -> best similarity of any of its keyframes with one of this robot's, also below the
            threshold; at most as many as logs are kept.
    """

    def __init__(
        self, own: LogId, parameters: PlaceRecognitionParameters, closed: frozenset[LogId] = frozenset()
    ) -> None:
        self._own = own
        self._closed = closed
        self._parameters = parameters
        self._by_log: dict[LogId, _Descriptors] = {}
        self.refused = 0
        self.best_similarities: dict[str, float] = {}

    @property
    def similarity_threshold(self) -> float:
        """From which on two keyframes are candidates."""
        return self._parameters.similarity_threshold

    def on_keyframes(self, keyframes: Iterable[tuple[KeyframeId, Array]]) -> list[Found]:
        """Add keyframes' descriptors in order, and find the candidates that each gives, best first."""
        found: list[Found] = []
        others: list[tuple[KeyframeId, Descriptor]] = []
        for keyframe, place in keyframes:
            descriptor = direction(place)
            if descriptor is None or not self._add(keyframe, descriptor):
                self.refused += 1
            elif self._is_compared(keyframe.log):
                others.append((keyframe, descriptor))
            elif keyframe.log == self._own:
                found += self._among_own(others)
                found += self._among_all(keyframe, descriptor)
                others = []
        return found + self._among_own(others)

    def agreement(self, pair: CandidatePair) -> float | None:
        """How well the keyframes around a pair's agree in order, -1 to 1; None where too few are known."""
        one, other = self._by_log.get(pair.low.log), self._by_log.get(pair.high.log)
        if one is None or other is None or one.dimension != other.dimension:
            return None
        row, column = one.position(pair.low.index), other.position(pair.high.index)
        if row is None or column is None:
            return None
        first, left = max(row - RUN_REACH, 0), max(column - RUN_REACH - 1, 0)
        rows, columns = one.matrix[first : row + RUN_REACH + 1], other.matrix[left : column + RUN_REACH + 2]
        return run_agreement(rows @ columns.T, row - first, column - left)

    def _add(self, keyframe: KeyframeId, descriptor: Descriptor) -> bool:
        """Keep a descriptor; one log has descriptors of one length, another length is another method."""
        known = self._by_log.get(keyframe.log)
        if known is None:
            known = self._by_log[keyframe.log] = _Descriptors(len(descriptor))
        elif known.dimension != len(descriptor):
            return False
        known.append(keyframe.index, descriptor)
        return True

    def _among_all(self, keyframe: KeyframeId, descriptor: Descriptor) -> list[Found]:
        """Candidates of one of this robot's keyframes, with each other robot's and, if wanted, with its own."""
        found = self._within(keyframe, descriptor) if self._parameters.own_gap_keyframes > 0 else []
        for log in sorted(self._by_log):
            others = self._by_log[log]
            if self._is_compared(log) and others.dimension == len(descriptor):
                similarities = others.matrix @ descriptor
                found += self._best(keyframe, log, others.indices, similarities, self._name(log))
        return _sorted(found)

    def _among_own(self, keyframes: Sequence[tuple[KeyframeId, Descriptor]]) -> list[Found]:
        """Candidates of other robots' keyframes with this robot's."""
        own = self._by_log.get(self._own)
        if own is None:
            return []
        found: list[Found] = []
        fitting = [(keyframe, descriptor) for keyframe, descriptor in keyframes if own.dimension == len(descriptor)]
        if fitting:
            similarities = np.array([descriptor for _, descriptor in fitting]) @ own.matrix.T
            for (keyframe, _), row in zip(fitting, similarities, strict=True):
                found += _sorted(self._best(keyframe, self._own, own.indices, row, self._name(keyframe.log)))
        return found

    def _is_compared(self, log: LogId) -> bool:
        """Whether a log's keyframes may be partners of this robot's."""
        return log.robot != self._own.robot or (log in self._closed and log != self._own)

    def _name(self, log: LogId) -> str:
        """Whose log it is, for people: a robot, or an earlier journey of this one."""
        return str(log) if log.robot == self._own.robot else log.robot

    def _within(self, keyframe: KeyframeId, descriptor: Descriptor) -> list[Found]:
        """Candidates among this robot's own keyframes that are far enough apart."""
        own = self._by_log[self._own]
        apart = keyframe.index - np.array(own.indices)
        similarities = np.where(apart >= self._parameters.own_gap_keyframes, own.matrix @ descriptor, -2.0)
        return self._best(keyframe, self._own, own.indices, similarities, None)

    def _best(
        self, keyframe: KeyframeId, log: LogId, indices: list[int], similarities: Descriptor, robot: str | None
    ) -> list[Found]:
        """The most similar keyframes of one log, those above the threshold; what was best is noted for a robot."""
        first = int(similarities.argmax())
        highest = float(similarities[first])
        if robot is not None and highest > self.best_similarities.get(robot, -1.0):
            self.best_similarities[robot] = highest
        if highest < self._parameters.similarity_threshold:
            return []
        best = [first]
        if self._parameters.best_matches > 1:
            best = np.argsort(-similarities, kind="stable")[: self._parameters.best_matches].tolist()
        return [
            (keyframe, Candidate(CandidatePair.of(keyframe, KeyframeId(log, indices[k])), float(similarities[k])))
            for k in best
            if similarities[k] >= self._parameters.similarity_threshold
        ]


def run_agreement(similarities: Descriptor, row: int, column: int) -> float | None:
    """The mean similarity of two runs of keyframes through a pair, in the same or in opposite directions.

    Each keyframe of one run is compared with the one across and those beside it, since robots differ in pace.

    Args:
        similarities: (M, N) of keyframes around the pair's.
        row: Of the pair.
        column: Of the pair.
    """
    best: float | None = None
    for way in (1, -1):
        means = []
        for step in range(-RUN_REACH, RUN_REACH + 1):
            across = column + way * step
            if 0 <= row + step < len(similarities):
                near = similarities[row + step, max(across - 1, 0) : max(across + 2, 0)]
                means += [float(near.max())] if near.size else []
        if len(means) >= RUN_MIN:
            best = max(float(np.mean(means)), -1.0 if best is None else best)
    return best


def _sorted(found: list[Found]) -> list[Found]:
    """The most similar first."""
    if len(found) > 1:
        found.sort(key=lambda one: (-one[1].similarity, one[1].pair))
    return found


@lru_cache(maxsize=DIRECTIONS_MAX)
def direction(place: Array) -> Descriptor | None:
    """Descriptor (D,) of unit length, or None where it has no direction; found once for all robots of a process."""
    values = place.numpy()
    norm = math.sqrt(float(values.dot(values)))
    if not math.isfinite(norm) or norm < 1e-12:
        return None
    unit = np.asarray(values / norm, dtype=np.float32)
    unit.flags.writeable = False
    return unit
