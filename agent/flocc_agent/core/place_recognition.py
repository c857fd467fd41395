"""Place recognition: cosine similarity of descriptors, best match per keyframe, threshold (Sec. III-A)."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.closed_partners import ClosedPartners
from flocc_agent.core.descriptor_rows import NOTHING, Descriptor, DescriptorRows, Floats, comparable
from flocc_agent.core.parameters import KEYFRAMES_HELD, PlaceRecognitionParameters
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

RUN_REACH = 2
"""Keyframes to either side that a run has; 1 and 3 tell as much on `street`."""
RUN_MIN = 2


@dataclass(frozen=True, slots=True)
class Candidate:
    """Two keyframes of different robots that look alike."""

    pair: CandidatePair
    similarity: float


Found = tuple[KeyframeId, Candidate]
"""A keyframe and a candidate that it gave."""


class PlaceRecognition:
    """Compares each new keyframe with those of the other robots.

    A robot with keyframes of its own looks at pairs that it is part of, since both partners do the same. Its own
    earlier logs that it knows for closed are compared like another robot's.

    Attributes:
        refused: Descriptors of another length than their log's, or without direction.
    """

    def __init__(
        self,
        own: LogId,
        parameters: PlaceRecognitionParameters,
        closed: frozenset[LogId] = frozenset(),
        keyframes_held: int = KEYFRAMES_HELD,
    ) -> None:
        """Start without any.

        Args:
            own: The log that this robot writes.
            parameters: What is a candidate.
            closed: Earlier logs of its own.
            keyframes_held: Keyframes of other logs that are compared whole, the newest of each; older ones are thinned.
        """
        self._own = own
        self._keyframes_held = keyframes_held
        self._closed = closed
        self._parameters = parameters
        self._numbers: dict[LogId, int] = {}
        self._logs: list[LogId] = []
        self._dimensions: list[int] = []
        self._best: list[float] = []
        self._own_rows: DescriptorRows | None = None
        self._others: dict[int, DescriptorRows] = {}
        self._forgotten: set[int] = set()
        self._closed_partners = ClosedPartners(parameters.similarity_threshold)
        self.refused = 0

    @property
    def similarity_threshold(self) -> float:
        """From which on two keyframes are candidates."""
        return self._parameters.similarity_threshold

    @property
    def rows(self) -> int:
        """Descriptors that are held."""
        return len(self._own_rows or ()) + sum(map(len, self._others.values()))

    @property
    def best_similarities(self) -> dict[str, float]:
        """Robot -> best similarity of any of its keyframes with one of this robot's, also below the threshold."""
        best: dict[str, float] = {}
        for log, similarity in zip(self._logs, self._best, strict=True):
            name = str(log) if log.robot == self._own.robot else log.robot  # an earlier journey of this one
            if similarity > best.get(name, -1.0):
                best[name] = similarity
        return best

    def on_keyframes(self, keyframes: Sequence[tuple[KeyframeId, Array]]) -> list[Found]:
        """Add keyframes' descriptors in order, and find the candidates that each gives, best first."""
        found: list[Found] = []
        others: list[tuple[KeyframeId, Descriptor]] = []
        self._meet(keyframes)
        for keyframe, place in keyframes:
            descriptor = comparable(place)
            if descriptor is None or not self._add(keyframe, descriptor):
                self.refused += 1
            elif self._is_compared(keyframe.log):
                others.append((keyframe, descriptor))
            elif keyframe.log == self._own:
                found += self._among_own(others)
                found += self._among_all(keyframe, descriptor)
                others = []
        return found + self._among_own(others)

    def lend(self, log: LogId, indices: Sequence[int], rows: NDArray[np.int8]) -> None:
        """Somebody holds descriptors of a log's keyframes as rows (K, D) that never change: compare them there."""
        number = self._numbers.get(log)
        others = self._others.get(rows.shape[1])
        if indices and number is not None and others is not None and self._dimensions[number] == others.dimension:
            others.lend(number, indices, rows)

    def forget(self, log: LogId) -> None:
        """Compare a log's keyframes with no further ones."""
        number = self._numbers.get(log)
        if number is None:
            return
        self._forgotten.add(number)
        self._best[number] = -1.0
        others = self._others.get(self._dimensions[number])
        if others is not None and number in others.numbers:
            others.forget(number)

    def agreement(self, pair: CandidatePair) -> float | None:
        """How well the keyframes around a pair's agree in order, -1 to 1; None where too few are known."""
        one, other = self._around(pair.low, RUN_REACH), self._around(pair.high, RUN_REACH + 1)
        if one is None or other is None or one[0].shape[1] != other[0].shape[1]:
            return None
        return run_agreement(one[0] @ other[0].T, one[1], other[1])

    def similarity(self, pair: CandidatePair) -> float | None:
        """How alike two keyframes are; None where a descriptor is not held, or theirs are of different lengths."""
        found = self._around(pair.low, 0), self._around(pair.high, 0)
        if found[0] is None or found[1] is None or found[0][0].shape[1] != found[1][0].shape[1]:
            return None
        return float(found[0][0][0] @ found[1][0][0])

    def _around(self, keyframe: KeyframeId, reach: int) -> tuple[Floats, int] | None:
        number = self._numbers.get(keyframe.log)
        if number is None:
            return None
        rows = self._own_rows if keyframe.log == self._own else self._others.get(self._dimensions[number])
        return None if rows is None else rows.around(number, keyframe.index, reach)

    def _add(self, keyframe: KeyframeId, descriptor: Descriptor) -> bool:
        """Keep a descriptor; one log has descriptors of one length, another length is another method."""
        log, dimension = keyframe.log, len(descriptor.row)
        number = self._numbers[log]
        if self._dimensions[number] != dimension:
            return False
        if log == self._own:
            if self._own_rows is None:
                self._own_rows = DescriptorRows(dimension, np.float32)
            self._own_rows.append(number, keyframe.index, descriptor)
            self._own_rows.thin(number, self._share)
        elif self._is_compared(log):
            rows = self._others.get(dimension)
            if rows is None:
                rows = self._others[dimension] = DescriptorRows(dimension, np.int8)
            rows.append(number, keyframe.index, descriptor)
            rows.thin(number, self._share)
        return True

    def _meet(self, keyframes: Iterable[tuple[KeyframeId, Array]]) -> None:
        """Number logs that are new: each has a smaller share then, also one that gets no more keyframes."""
        known = len(self._logs) - len(self._forgotten)
        for keyframe, place in keyframes:
            self._forgotten.discard(self._numbers.get(keyframe.log, -1))
            if keyframe.log not in self._numbers and (descriptor := comparable(place)) is not None:
                self._numbers[keyframe.log] = len(self._logs)
                self._logs.append(keyframe.log)
                self._dimensions.append(len(descriptor.row))
                self._best.append(-1.0)
        if len(self._logs) - len(self._forgotten) == known:
            return
        for rows in (*self._others.values(), *([] if self._own_rows is None else [self._own_rows])):
            for number in rows.numbers:
                rows.thin(number, self._share)

    @property
    def _share(self) -> int:
        """Rows of one log that are compared whole: all robots that know the same logs have the same of each."""
        return self._keyframes_held // max(len(self._logs) - len(self._forgotten) - 1, 1)

    def _among_all(self, keyframe: KeyframeId, descriptor: Descriptor) -> list[Found]:
        """Candidates of one of this robot's keyframes, with each other robot's and, if wanted, with its own."""
        found = self._within(keyframe, descriptor) if self._parameters.own_gap_keyframes > 0 else []
        others = self._others.get(len(descriptor.row))
        if others is None:
            return found
        similarities = others.similarities([descriptor])[0]
        best = np.full(len(self._logs), NOTHING, dtype=np.float32)
        np.maximum.at(best, others.logs, similarities)
        self._best = np.maximum(best, self._best).tolist()
        for number in np.flatnonzero(best >= self._parameters.similarity_threshold).tolist():
            found += self._candidates(keyframe, number, others, similarities)
        for log in self._closed & self._numbers.keys():
            found += self._of_closed(log, keyframe.index, others, similarities)
        return _sorted(found)

    def _of_closed(self, log: LogId, index: int, rows: DescriptorRows, similarities: Floats) -> Iterator[Found]:
        """Candidates that keyframes of a closed log give, which this robot's way led on from at its so manieth one."""
        number = self._numbers[log]
        places = rows.places(number)
        partners = self._closed_partners.found(number, rows.indices[places], similarities[places], index)
        for given, own, similarity in partners:
            giver = KeyframeId(log, given)
            yield giver, Candidate(CandidatePair.of(KeyframeId(self._own, own), giver), similarity)

    def _among_own(self, keyframes: Sequence[tuple[KeyframeId, Descriptor]]) -> list[Found]:
        """Candidates of other robots' keyframes with this robot's."""
        own = self._own_rows
        fitting = [each for each in keyframes if own is not None and own.dimension == len(each[1].row)]
        if own is None or not fitting:
            return []
        found: list[Found] = []
        similarities = own.similarities([descriptor for _, descriptor in fitting])
        for k, highest in enumerate(similarities.max(axis=1).tolist()):
            keyframe = fitting[k][0]
            number = self._numbers[keyframe.log]
            if highest > self._best[number]:
                self._best[number] = highest
            if highest >= self._parameters.similarity_threshold:
                found += _sorted(self._candidates(keyframe, self._numbers[self._own], own, similarities[k]))
        return found

    def _is_compared(self, log: LogId) -> bool:
        """Whether a log's keyframes may be partners of this robot's."""
        return log.robot != self._own.robot or (log in self._closed and log != self._own)

    def _within(self, keyframe: KeyframeId, descriptor: Descriptor) -> list[Found]:
        """Candidates among this robot's own keyframes that are far enough apart."""
        own = self._own_rows
        assert own is not None
        apart = keyframe.index - own.indices
        similarities = own.similarities([descriptor])[0]
        far = np.where(apart >= self._parameters.own_gap_keyframes, similarities, np.float32(-2.0))
        return self._candidates(keyframe, self._numbers[self._own], own, far)

    def _candidates(self, keyframe: KeyframeId, number: int, rows: DescriptorRows, similarities: Floats) -> list[Found]:
        """The most similar keyframes of one log, those above the threshold.

        Args:
            keyframe: That it is compared with.
            number: The log's.
            rows: Where the log is.
            similarities: (N,) of all rows.
        """
        log, places = self._logs[number], rows.places(number)
        of_log = similarities[places]
        best = [int(of_log.argmax())]
        if self._parameters.best_matches > 1:
            best = np.argsort(-of_log, kind="stable")[: self._parameters.best_matches].tolist()
        indices = rows.indices[places[best]].tolist()
        return [
            (keyframe, Candidate(CandidatePair.of(keyframe, KeyframeId(log, index)), similarity))
            for index, similarity in zip(indices, of_log[best].tolist(), strict=True)
            if similarity >= self._parameters.similarity_threshold
        ]


def run_agreement(similarities: Floats, row: int, column: int) -> float | None:
    """The mean similarity of two runs of keyframes through a pair, in the same or in opposite directions.

    Each keyframe of one run is compared with the one across and those beside it, since robots differ in pace.

    Args:
        similarities: (M, N) of keyframes around the pair's.
        row: Of the pair.
        column: Of the pair.
    """
    best: float | None = None
    table = similarities.tolist()
    for way in (1, -1):
        highest = []
        for number in range(max(row - RUN_REACH, 0), min(row + RUN_REACH + 1, len(table))):
            across = column + way * (number - row)
            near = table[number][max(across - 1, 0) : max(across + 2, 0)]
            highest += [max(near)] if near else []
        if len(highest) >= RUN_MIN:
            best = max(sum(highest) / len(highest), -1.0 if best is None else best)
    return best


def _sorted(found: list[Found]) -> list[Found]:
    """The most similar first."""
    if len(found) > 1:
        found.sort(key=lambda one: (-one[1].similarity, one[1].pair))
    return found
