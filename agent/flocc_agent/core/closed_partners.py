"""What keyframes of logs that nobody writes any more find among this robot's.

Of two robots that are on their way at once, each new keyframe looks for a partner among those before it, so both look.
In a saved map all keyframes were before: only the newcomer would look, and half of the loop closures would be missed.
So each of the map's keyframes is given its best partner, too, as soon as the way leads on from it.
"""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.descriptor_rows import NOTHING

NOBODY = -1


class _Best:
    """Of one log, by keyframe (K,): its best partner so far.

    Attributes:
        similarity: With that partner.
        partner: Which keyframe of this robot it is.
        given: Similarity of the best partner that was given.
    """

    def __init__(self) -> None:
        self.similarity: NDArray[np.float32] = np.empty(0, dtype=np.float32)
        self.partner: NDArray[np.int32] = np.empty(0, dtype=np.int32)
        self.given: NDArray[np.float32] = np.empty(0, dtype=np.float32)

    def make_room(self, keyframes: int) -> None:
        """Know of so many keyframes."""
        more = max(keyframes - len(self.partner), 0)
        self.similarity = np.pad(self.similarity, (0, more), constant_values=NOTHING)
        self.partner = np.pad(self.partner, (0, more), constant_values=NOBODY)
        self.given = np.pad(self.given, (0, more), constant_values=NOTHING)


class ClosedPartners:
    """Best partners of closed logs' keyframes among those of this robot."""

    def __init__(self, similarity_threshold: float) -> None:
        self._similarity_threshold = similarity_threshold
        self._logs: dict[int, _Best] = {}

    def found(
        self, log: int, indices: NDArray[np.int32], similarities: NDArray[np.float32], own: int
    ) -> list[tuple[int, int, float]]:
        """Look at one keyframe of this robot's.

        Args:
            log: Number of the closed log.
            indices: Its keyframes (K,).
            similarities: Theirs (K,) with this robot's keyframe.
            own: Number of that keyframe in this robot's log.

        Returns:
            Keyframes of the closed log that this robot's way has just led on from, since `own` is less similar than
            their best partner: each with that partner and its similarity. A partner is given once, and a further one
            only where it is more similar.
        """
        best = self._logs.setdefault(log, _Best())
        if len(indices) and indices.max() >= len(best.partner):
            best.make_room(int(indices.max()) + 1)
        highest = best.similarity[indices]
        is_new = (highest >= self._similarity_threshold) & (highest > best.given[indices])
        left = indices[is_new & (similarities < highest)]
        best.given[left] = best.similarity[left]
        is_better = similarities > highest
        given = list(zip(left.tolist(), best.partner[left].tolist(), best.similarity[left].tolist(), strict=True))
        best.similarity[indices[is_better]] = similarities[is_better]
        best.partner[indices[is_better]] = own
        return given
