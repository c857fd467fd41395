"""Candidate pairs, and who is asked to register them."""

from dataclasses import dataclass
from typing import NamedTuple

from flocc_protocol.codec import KEYFRAME_ID, Kinds, boolean, sequence, struct
from flocc_protocol.ids import KeyframeId

OFFERS_MAX = 64


@dataclass(frozen=True, slots=True)
class CandidateOffer:
    """Candidate pairs that the sender found and that the receiver is to register.

    Attributes:
        pairs: (query of the receiver, match of the sender) and so on, each pair sorted.
        transferred: The sender gives up a pair that was its own; it waits for the receiver's record.
    """

    pairs: tuple["CandidatePair", ...]
    transferred: bool = False


class _PairFields(NamedTuple):
    low: KeyframeId
    high: KeyframeId


class CandidatePair(_PairFields):
    """Two keyframes of different robots that may show one place; `low < high`."""

    __slots__ = ()

    def __new__(cls, low: KeyframeId, high: KeyframeId) -> "CandidatePair":
        """Check the order.

        Raises:
            ValueError: They are not sorted, or the same.
        """
        if not low < high:
            raise ValueError("a candidate pair is sorted and joins two keyframes")
        return tuple.__new__(cls, (low, high))

    def other(self, end: KeyframeId) -> KeyframeId:
        """The end that is not the given one."""
        return self.high if end == self.low else self.low

    @classmethod
    def of(cls, a: KeyframeId, b: KeyframeId) -> "CandidatePair":
        """Sort two keyframes into a pair."""
        return tuple.__new__(cls, (a, b)) if a < b else cls(b, a)


PAIR = struct(CandidatePair, low=KEYFRAME_ID, high=KEYFRAME_ID)


CODECS: Kinds = {
    "candidates": (
        CandidateOffer,
        struct(CandidateOffer, pairs=sequence(PAIR, OFFERS_MAX), transferred=boolean()),
    )
}
