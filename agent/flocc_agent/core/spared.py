"""Pairs that are not registered, because closures beside them tell already what they would.

Two robots that drive along one road have a candidate at every keyframe, and each closure is learnt by the whole team.
Where `closures_enough` closures between the same stretches of both ways agree, one more tells nothing new: odometry
carries what they say to every keyframe of the stretch, with less error than a registration has. So a stretch is
`STRETCH` keyframes to either side of a pair, at both of its ends, and a later visit is another one. What two closures
say by way of a third robot counts like one (`foretelling.py`): in a large team each pair of robots has few closures,
and many by way of others.

A stretch is weak, and its pairs are registered, where it has few closures in all, where these have no length, where
odometry is not here or tears them apart, and where some contradict: each of those takes `CONTRADICTED` that agree.
Each closure costs as much as there are robots that learn it: in a small team all pairs are registered.
Nothing is written of a spared pair. Whether it is follows from records, so that all robots which hold the same ones
spare the same; it is taken up again when a later closure contradicts.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.known_sets import PairTable
from flocc_agent.core.pulls import remember
from flocc_protocol.ids import KeyframeId
from flocc_protocol.messages import CandidatePair

Float = NDArray[np.float64]

TOLD = "closures beside it tell it already"
"""Why a pair was spared, for people."""
STRETCH = 5
"""Keyframes to either side of both ends."""
TIED_MIN = 1.0
"""Ends of closures for each keyframe of both stretches, with whatever other keyframes: each closure has two ends. Where
a graph is thinner each closure makes it better, also where others say nearly the same (docs/scaling.md)."""
CONTRADICTED = 2
"""Closures that must agree for each one that does not, besides those that are enough."""
AGREE_RAD = np.deg2rad(10.0)
AGREE_LENGTHS = 0.3
"""How far two closures may differ, against how far apart their cameras are: scales by Eq. (6) differ as much."""
AGREE_RATIO = 0.1
"""The same against the way that odometry carries them."""
AGREE_STEPS = 0.5
"""The same against the robots' steps."""
SPARED_MAX = 4000
LOOKED_MAX = 4000


@dataclass(frozen=True, slots=True, eq=False)
class Foretold:
    """What closures beside a pair say that a registration of it would find.

    Attributes:
        T_low_high: (K, 4, 4) pose of the later keyframe in the earlier one, metric.
        may_m: (K,) how far off each may be.
        is_whole: Whether the keyframes of all closures there were known.
    """

    T_low_high: Float
    may_m: Float
    is_whole: bool = True

    @classmethod
    def nothing(cls, is_whole: bool = True) -> "Foretold":
        """No closure says anything."""
        return cls(np.empty((0, 4, 4)), np.empty(0), is_whole)


class HeldClosures(Protocol):
    """Closures that a robot knows."""

    def logs(self) -> int:
        """How many logs closures are of."""
        ...

    def mark(self, keyframe: KeyframeId, reach: int) -> int:
        """A number of the closures of a stretch that is another one when these change."""
        ...

    def density(self, keyframe: KeyframeId, reach: int) -> float:
        """Ends of closures for each keyframe of a stretch, whatever keyframes are at their other ends."""
        ...

    def foretold(self, pair: CandidatePair, reach: int, least: int = 1) -> Foretold:
        """What closures of two stretches say of a pair there; nothing where fewer do than the least that matters."""
        ...


class NoClosures:
    """What a robot knows that spares no pair."""

    def logs(self) -> int:
        """None."""
        return 0

    def mark(self, keyframe: KeyframeId, reach: int) -> int:  # noqa: ARG002
        """None."""
        return 0

    def density(self, keyframe: KeyframeId, reach: int) -> float:  # noqa: ARG002
        """None."""
        return 0.0

    def foretold(self, pair: CandidatePair, reach: int, least: int = 1) -> Foretold:  # noqa: ARG002
        """Nothing."""
        return Foretold.nothing()


class Spared:
    """Pairs that one robot found, or was offered, and that are not to be registered."""

    def __init__(self, held: HeldClosures, enough: int, logs_min: int = 0) -> None:
        """Start without any.

        Args:
            held: Closures.
            enough: So many that agree; 0: no pair is spared.
            logs_min: With closures of fewer logs no pair is spared either.
        """
        self._held = held
        self._enough = enough
        self._logs_min = logs_min
        self._similarities: PairTable[float] = PairTable(SPARED_MAX)
        self._weak: dict[CandidatePair, tuple[int, int]] = {}
        """What was known of pairs that were not told."""
        self._needed: dict[CandidatePair, None] = {}

    def __contains__(self, pair: CandidatePair) -> bool:
        return pair in self._similarities

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        looked = {"weak": (len(self._weak), LOOKED_MAX), "needed": (len(self._needed), LOOKED_MAX)}
        return {"spared": self._similarities.size(), **looked}

    def is_any(self) -> bool:
        """Whether pairs are spared at all, with the closures that are known."""
        return self._enough > 0 and self._held.logs() >= self._logs_min

    def is_told(self, pair: CandidatePair) -> bool:
        """Whether closures beside a pair tell what it would."""
        if not self.is_any() or pair in self._needed:
            return False
        if min(self._held.density(pair.low, STRETCH), self._held.density(pair.high, STRETCH)) < TIED_MIN:
            return False
        marks = self._held.mark(pair.low, STRETCH), self._held.mark(pair.high, STRETCH)
        if self._weak.get(pair) == marks:
            return False
        foretold = self._held.foretold(pair, STRETCH, self._enough)
        agreeing = agreeing_of(foretold)
        if agreeing - CONTRADICTED * (len(foretold.may_m) - agreeing) >= self._enough:
            return True
        self._weak.pop(pair, None)
        if foretold.is_whole:
            remember(self._weak, pair, marks, LOOKED_MAX)
        return False

    def need(self, pair: CandidatePair) -> None:
        """Somebody waits for a pair whose records do not reach it: whatever is known here does not tell it."""
        remember(self._needed, pair, None, LOOKED_MAX)

    def add(self, pair: CandidatePair, similarity: float) -> None:
        """A pair is not to be registered for now."""
        self._weak.pop(pair, None)
        self._similarities.put(pair, similarity)

    def remove(self, pair: CandidatePair) -> None:
        """A record tells of a pair."""
        self._weak.pop(pair, None)
        self._similarities.pop(pair)

    def on_closure(self, pair: CandidatePair, is_own: bool = True) -> list[tuple[CandidatePair, float]]:
        """A closure became known; pairs that it makes weak again, with their similarity. They are spared no more.

        It is held against what others foretell of it. One of two other robots says something of pairs between the same
        stretches alone: those two look at what else it contradicts.
        """
        if not self._enough or not len(self._similarities):
            return []
        near = self._near(pair) if is_own else self._similarities.beside(pair, STRETCH)
        return [] if not near or self._agrees(pair) else self._weak_again(near)

    def on_gone(self, pair: CandidatePair) -> list[tuple[CandidatePair, float]]:
        """The same of a closure that counts no more."""
        return self._weak_again(self._near(pair))

    def _near(self, pair: CandidatePair) -> list[CandidatePair]:
        return self._similarities.near(pair, STRETCH)

    def _weak_again(self, near: list[CandidatePair]) -> list[tuple[CandidatePair, float]]:
        again = [other for other in near if not self.is_told(other)]
        return [(other, self._similarities.pop(other) or 0.0) for other in again]

    def _agrees(self, closure: CandidatePair) -> bool:
        """Whether all closures beside one agree with it; one whose keyframes are not known says nothing yet."""
        foretold = self._held.foretold(closure, STRETCH)
        return agreeing_of(foretold) == len(foretold.may_m)


def agreeing_of(foretold: Foretold) -> int:
    """The most closures that agree with one of them."""
    if not len(foretold.may_m):
        return 0
    R, t_m = foretold.T_low_high[:, :3, :3], foretold.T_low_high[:, :3, 3]
    cosines = (np.einsum("kij,lij->kl", R, R) - 1.0) / 2.0
    apart_m = np.linalg.norm(t_m[:, None] - t_m[None, :], axis=2)
    agree = (cosines >= np.cos(AGREE_RAD)) & (apart_m <= foretold.may_m[:, None] + foretold.may_m[None, :])
    return int(agree.sum(axis=1).max())
