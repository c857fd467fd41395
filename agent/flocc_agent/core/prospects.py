"""Pairs that are hardly worth their latents: others whose surroundings agree better were all refused.

Two keyframes at one place have neighbours at one place: along the two ways, in the same or in opposite directions,
descriptors agree in order (as in SeqSLAM, Milford and Wyeth 2012). How much, costs nothing: descriptors are here. What
agreement is worth, this swarm's registrations tell: a pair is unlikely where the `REFUSED_MIN` registered pairs that
agree just a bit better were all refused, so that no threshold depends on place or descriptor. Such a pair is held for
`HOLD_S`, since later keyframes may agree, and then refused by a record. Nothing is cut for good: one unlikely pair in
`PROBED_EVERY` is registered all the same, and what lies beside a closure is taken up again. A pair whose latents are
here is registered in any case, and so is one that would tell whether two ways are joined rightly
(`second_places.py`).
"""

import zlib
from bisect import bisect_left, insort
from collections.abc import Callable
from enum import Enum
from itertools import product

from flocc_agent.core.known_sets import PairSet, PairTable
from flocc_agent.core.pulls import remember
from flocc_protocol.ids import KeyframeId
from flocc_protocol.messages import CandidatePair

UNLIKELY = "pairs that agree better were refused"
"""Reason in the record of a pair that was refused unseen."""
REFUSED_MIN = 4
"""Chosen with `PROBED_EVERY` on street and the demo's town, each alone: docs/bandwidth.md has what 4 to 12 cost."""
PROBED_EVERY = 32
HOLD_S = 5.0
"""A walking robot takes the next keyframes of a run within this time."""
BESIDE = 2
"""Keyframes to either side that lie beside a closure."""
JUDGED_MAX = 512
TAUGHT_BY_OTHERS_MAX = 128
"""Pairs of others teach as long as fewer are known; then own ones do, so that a robot's work does not grow with the
pairs of its team."""
UNLIKELY_MAX = 4000
ASKED_MAX = 1000

Agreement = Callable[[CandidatePair], float | None]
"""How well the surroundings of two keyframes agree, -1 to 1; None where too little is known of them."""
Judged = tuple[float, CandidatePair, bool]
"""Agreement of a registered pair, and whether it became a closure."""


class Prospect(Enum):
    """What is to be done about a pair."""

    LIKELY = "fetch its latents"
    HELD = "wait for later keyframes"
    UNLIKELY = "refuse it"


class Prospects:
    """What one robot knows of pairs that were registered, and of those that were refused unseen."""

    def __init__(self, agreement: Agreement) -> None:
        self._agreement = agreement
        self._found: dict[CandidatePair, float | None] = {}
        self._fresh: dict[CandidatePair, bool] = {}
        self._judged: dict[CandidatePair, Judged] = {}
        self._order: list[Judged] = []
        self._closures = PairSet()
        self._unlikely: PairTable[bool] = PairTable(UNLIKELY_MAX)
        self._held_since_s: dict[CandidatePair, float] = {}
        self._asked: PairTable[bool] = PairTable(ASKED_MAX)

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {
            "agreements": (len(self._found), UNLIKELY_MAX),
            "judged": (len(self._fresh) + len(self._judged), 2 * JUDGED_MAX),
            "unlikely": self._unlikely.size(),
            "held": (len(self._held_since_s), UNLIKELY_MAX),
            "asked": self._asked.size(),
        }

    def on_judged(self, pair: CandidatePair, is_closure: bool, is_own: bool = True) -> list[CandidatePair]:
        """A pair was registered; those refused unseen that lie beside it and are to be taken up again.

        Args:
            pair: Of keyframes.
            is_closure: What became of it.
            is_own: Whether it is of this robot's keyframes, or was registered here.
        """
        self.on_settled(pair)
        if is_own or len(self._fresh) + len(self._judged) < TAUGHT_BY_OTHERS_MAX:
            remember(self._fresh, pair, is_closure, JUDGED_MAX)
        if not is_closure:
            return []
        self._closures.add(pair)
        again = sorted(other for other in self._unlikely.beside(pair, BESIDE) if other != pair)
        for other in again:
            self._unlikely.pop(other)
        return again

    def on_unlikely(self, pair: CandidatePair, was_resolved: bool = False) -> None:
        """A pair was refused unseen; another record of it may say more."""
        if pair in self._unlikely or not was_resolved:
            self._unlikely.put(pair, True)

    def on_settled(self, pair: CandidatePair) -> None:
        """A record says more of a pair than that it was refused unseen."""
        self._unlikely.pop(pair)

    def on_resolved(self, pair: CandidatePair) -> None:
        """A record says what became of a pair."""
        self._held_since_s.pop(pair, None)
        self._found.pop(pair, None)

    def ask(self, pair: CandidatePair) -> bool:
        """A pair is to be registered in any case; False where that was said before. One refused unseen has a chance."""
        if pair in self._asked:
            return False
        self._asked.put(pair, True)
        self._held_since_s.pop(pair, None)
        return True

    def was_asked(self, pair: CandidatePair) -> bool:
        """Whether a pair was to be registered in any case."""
        return pair in self._asked

    def was_refused_unseen(self, pair: CandidatePair) -> bool:
        """Whether no record says more of a pair than that it was refused unseen."""
        return pair in self._unlikely

    def due_s(self, now: float) -> float:
        """When the next pair has been held long enough."""
        return next((s + HOLD_S for s in self._held_since_s.values() if s + HOLD_S > now), float("inf"))

    def of(self, pair: CandidatePair, now: float) -> Prospect:
        """What is to be done about a pair that lacks a latent."""
        if not self._is_unlikely(pair):
            self._held_since_s.pop(pair, None)
            return Prospect.LIKELY
        if pair not in self._held_since_s:
            remember(self._held_since_s, pair, now, UNLIKELY_MAX)
        if now < self._held_since_s[pair] + HOLD_S:
            return Prospect.HELD
        self._found.pop(pair, None)
        return Prospect.UNLIKELY if self._is_unlikely(pair) else Prospect.LIKELY

    def _is_unlikely(self, pair: CandidatePair) -> bool:
        if pair in self._asked or is_probe(pair):
            return False
        if pair not in self._found:
            remember(self._found, pair, self._rounded(pair), UNLIKELY_MAX)
        agreement = self._found[pair]
        if agreement is None:
            return False
        self._learn()
        first = bisect_left(self._order, agreement, key=lambda judged: judged[0])
        better = self._order[first : first + REFUSED_MIN]
        if len(better) < REFUSED_MIN or any(is_closure for _, _, is_closure in better):
            return False
        return not any(other in self._closures for other in beside(pair))

    def _learn(self) -> None:
        """Put pairs that were judged meanwhile into their order; only now is everything of their surroundings here."""
        for pair, is_closure in self._fresh.items():
            agreement = self._rounded(pair)
            if agreement is not None and pair not in self._judged:
                self._judged[pair] = judged = (agreement, pair, is_closure)
                insort(self._order, judged)
        self._fresh.clear()
        while len(self._judged) > JUDGED_MAX:
            oldest = self._judged.pop(next(iter(self._judged)))
            del self._order[bisect_left(self._order, oldest)]

    def _rounded(self, pair: CandidatePair) -> float | None:
        agreement = self._agreement(pair)
        return None if agreement is None else round(agreement, 4)


def is_probe(pair: CandidatePair) -> bool:
    """Whether a pair is registered however unlikely it is; by other bits than those that say which owner does it."""
    return (zlib.crc32(f"{pair.low} {pair.high}".encode()) >> 8) % PROBED_EVERY == 0


def beside(pair: CandidatePair) -> list[CandidatePair]:
    """Pairs of keyframes up to `BESIDE` before or after a pair's."""
    steps = range(-BESIDE, BESIDE + 1)
    low, high = pair.low, pair.high
    ends = (
        (KeyframeId(low.log, low.index + i), KeyframeId(high.log, high.index + j))
        for i, j in product(steps, steps)
        if (i, j) != (0, 0) and low.index + i >= 0 and high.index + j >= 0
    )
    return [CandidatePair(one, other) for one, other in ends if one < other]
