"""Place recognition: cosine similarity of descriptors, best match per keyframe, threshold (Sec. III-A)."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.parameters import PlaceRecognitionParameters
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

CAPACITY_FIRST = 64
DIRECTIONS_MAX = 1024


@dataclass(frozen=True, slots=True)
class Candidate:
    """Two keyframes of different robots that look alike."""

    pair: CandidatePair
    similarity: float


class _Descriptors:
    """The descriptors of one log, as the rows of one growing matrix."""

    def __init__(self, dimension: int) -> None:
        self._rows = np.empty((CAPACITY_FIRST, dimension), dtype=np.float32)
        self.dimension = dimension
        self.indices: list[int] = []

    @property
    def matrix(self) -> NDArray[np.float32]:
        return self._rows[: len(self.indices)]

    def append(self, index: int, descriptor: NDArray[np.float32]) -> None:
        count = len(self.indices)
        if count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
        self._rows[count] = descriptor
        self.indices.append(index)


class PlaceRecognition:
    """Compares each new keyframe with those of the other robots.

    A robot with keyframes of its own looks at pairs that it is part of, since both partners do the same.

    Attributes:
        refused: Descriptors of another length than their log's, or without direction.
        best_similarities: Robot -> best similarity of any of its keyframes with one of this robot's, also below the
            threshold; at most as many as logs are kept.
    """

    def __init__(self, own: LogId, parameters: PlaceRecognitionParameters) -> None:
        self._own = own
        self._parameters = parameters
        self._by_log: dict[LogId, _Descriptors] = {}
        self.refused = 0
        self.best_similarities: dict[str, float] = {}

    def on_keyframe(self, keyframe: KeyframeId, place: Array) -> list[Candidate]:
        """Add a keyframe's descriptor and find its candidates, best first."""
        descriptor = direction(place)
        if descriptor is None or not self._fits(keyframe.log, descriptor):
            self.refused += 1
            return []
        known = self._by_log.get(keyframe.log)
        if known is None:
            known = self._by_log[keyframe.log] = _Descriptors(len(descriptor))
        known.append(keyframe.index, descriptor)
        found = [c for log in self._partners(keyframe.log) for c in self._best(keyframe, descriptor, log)]
        if len(found) > 1:
            found.sort(key=lambda candidate: (-candidate.similarity, candidate.pair))
        return found

    def _fits(self, log: LogId, descriptor: NDArray[np.float32]) -> bool:
        """One log has descriptors of one length; another length is another method."""
        known = self._by_log.get(log)
        return known is None or known.dimension == len(descriptor)

    def _partners(self, log: LogId) -> list[LogId]:
        if log == self._own:
            within = [log] if self._parameters.own_gap_keyframes > 0 else []
            return [*within, *(other for other in sorted(self._by_log) if other.robot != log.robot)]
        return [self._own] if self._own in self._by_log and log.robot != self._own.robot else []

    def _best(self, keyframe: KeyframeId, descriptor: NDArray[np.float32], log: LogId) -> list[Candidate]:
        others = self._by_log[log]
        if others.dimension != len(descriptor):
            return []
        similarities = others.matrix @ descriptor
        if log == keyframe.log:
            apart = keyframe.index - np.array(others.indices)
            similarities = np.where(apart >= self._parameters.own_gap_keyframes, similarities, -2.0)
        if self._parameters.best_matches == 1:
            best = [int(similarities.argmax())]
        else:
            best = np.argsort(-similarities, kind="stable")[: self._parameters.best_matches].tolist()
        if log != keyframe.log:
            self._note(log.robot if keyframe.log == self._own else keyframe.log.robot, float(similarities[best[0]]))
        return [
            Candidate(CandidatePair.of(keyframe, KeyframeId(log, others.indices[k])), float(similarities[k]))
            for k in best
            if similarities[k] >= self._parameters.similarity_threshold
        ]

    def _note(self, robot: str, similarity: float) -> None:
        """Remember the best similarity with each other robot, for those who ask why nothing was found."""
        self.best_similarities[robot] = max(similarity, self.best_similarities.get(robot, -1.0))


@lru_cache(maxsize=DIRECTIONS_MAX)
def direction(place: Array) -> NDArray[np.float32] | None:
    """Descriptor (D,) of unit length, or None where it has no direction; found once for all robots of a process."""
    values = place.numpy()
    norm = float(np.linalg.norm(values))
    if not np.isfinite(norm) or norm < 1e-12:
        return None
    unit = np.asarray(values / norm, dtype=np.float32)
    unit.flags.writeable = False
    return unit
