"""Loop closing: candidate pairs to registrations, each by one robot (Sec. III-B).

Who registers a pair: one of its two owners, by a checksum of the pair, so that both agree without talking and the
work is halved between them. A robot that has a neighbour of a higher compute class hands its pairs to it. Whoever
found a pair that is another's to register tells it so until the record shows. When the other is out of range for
`takeover_s`, the finder registers the pair itself, if need be with latents that relays bring. A pair whose latent
exists no more is rejected, by a record like any other.
"""

import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from flocc_agent.core.candidate_order import SpectralOrder
from flocc_agent.core.effects import Effect, Register, Report, Unicast
from flocc_agent.core.latents import Latents, Peer, Reach
from flocc_agent.core.parameters import LoopClosingParameters
from flocc_agent.core.place_recognition import Candidate
from flocc_protocol.codec import Pose7
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import OFFERS_MAX, CandidateOffer, CandidatePair

OdometryPairOf = Callable[[KeyframeId], tuple[KeyframeId, Pose7] | None]
"""Gives a keyframe's neighbour in its log and `T_neighbour_query`, or None while it has none."""

FAR_TAKEOVERS = 2


@dataclass(slots=True)
class _Work:
    """A pair that this robot registers; the query is its own keyframe, or the one that has an odometry pair."""

    pair: CandidatePair
    similarity: float
    query: KeyframeId
    match: KeyframeId
    registering_until_s: float | None = None

    def order(self) -> tuple[float, CandidatePair]:
        """The most similar first."""
        return (-self.similarity, self.pair)


@dataclass(slots=True)
class _Offer:
    """A pair that another robot is to register; `since_s`: when it was last within reach, or became an offer."""

    candidate: Candidate
    to: str
    next_s: float
    since_s: float
    transferred: bool


def registrar_of(pair: CandidatePair) -> LogId:
    """The owner that registers a pair, the same at both: by checksum, so that each does half."""
    return pair.low.log if zlib.crc32(f"{pair.low} {pair.high}".encode()) % 2 == 0 else pair.high.log


class LoopClosing:
    """Pairs and registrations of one robot."""

    def __init__(
        self,
        own: LogId,
        compute_class: int,
        odometry_pair: OdometryPairOf,
        parameters: LoopClosingParameters,
        spectral: SpectralOrder | None = None,
    ) -> None:
        """Start without pairs.

        Args:
            own: The log that this robot writes.
            compute_class: 0 (small) to 9.
            odometry_pair: Gives the neighbour of a keyframe.
            parameters: Limits and times.
            spectral: Orders pairs by what they add to the pose graph; None: by similarity.
        """
        self.latents = Latents(own, parameters)
        self._spectral = spectral
        self.dropped = 0
        self._own = own
        self._compute_class = compute_class
        self._odometry_pair = odometry_pair
        self._parameters = parameters
        self._reach = Reach()
        self._work: dict[CandidatePair, _Work] = {}
        self._order: list[_Work] | None = None
        self._offers: dict[CandidatePair, _Offer] = {}
        self._resolved: set[CandidatePair] = set()
        self._load = 0
        self._changed = True
        self._due_s = float("inf")

    @property
    def load(self) -> int:
        """Registrations that wait here and can be done, with latents that are here or can be had."""
        return self._load

    def open_pairs(self) -> list[CandidatePair]:
        """Pairs that this robot is to register, or waits for others to register; sorted."""
        return sorted({*self._work, *self._offers})

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Queues and tables with their maximum."""
        candidates_max = self._parameters.candidates_max
        return {
            "candidates": (len(self._work), candidates_max),
            "offers": (len(self._offers), candidates_max),
            **self.latents.sizes(),
        }

    # Pairs

    def on_candidates(self, candidates: Iterable[Candidate], now: float) -> list[Effect]:
        """Pairs that place recognition found here."""
        effects: list[Effect] = []
        for candidate in candidates:
            if self._knows(candidate.pair):
                continue
            facts = {
                "query": str(candidate.pair.low),
                "match": str(candidate.pair.high),
                "similarity": round(candidate.similarity, 4),
            }
            effects.append(Report("candidate", facts))  # type: ignore[arg-type]
            self._assign(candidate, now)
        return effects

    def on_offer(self, offer: CandidateOffer, now: float) -> None:
        """Pairs that another robot found and that this one is to register."""
        for pair in offer.pairs:
            if offer.transferred and pair not in self._resolved and pair not in self._work:
                self._remove(pair)
                self._add(Candidate(pair, 0.0))
            elif registrar_of(pair) == self._own and not self._knows(pair):
                self._assign(Candidate(pair, 0.0), now)

    def roles(self, pair: CandidatePair) -> tuple[KeyframeId, KeyframeId] | None:
        """Query and match of a pair whose registration is waited for, None if it is not."""
        work = self._work.get(pair)
        return (work.query, work.match) if work else None

    def on_resolved(self, pair: CandidatePair) -> None:
        """A record of this pair is in a log: nobody needs to register it."""
        self._resolved.add(pair)
        self._remove(pair)

    def on_closure(self, pair: CandidatePair) -> None:
        """A record of this pair is in a log, and it is a closure."""
        if self._spectral is not None:
            self._spectral.on_closure(pair)
        self.on_resolved(pair)

    def on_keyframe(self, log: LogId) -> None:
        """A log grew: a keyframe may have got the neighbour that it lacked."""
        if self._spectral is not None:
            self._spectral.on_keyframe(log)
        self._changed = True

    # Latents

    def on_held(self, keyframe: KeyframeId) -> None:
        """A latent is in this robot's store."""
        self.latents.add(keyframe)
        self._changed = True

    def on_latent_missing(self, pair: CandidatePair, keyframe: KeyframeId) -> list[CandidatePair]:
        """The store evicted a latent; another robot's is fetched again, an own one is lost. Pairs to reject."""
        self.latents.remove(keyframe)
        self._changed = True
        work = self._work.get(pair)
        if work is not None:
            work.registering_until_s = None
        return self.on_latent_lost(keyframe) if keyframe.log == self._own else []

    def on_latent_lost(self, keyframe: KeyframeId) -> list[CandidatePair]:
        """A latent exists no more: the pairs that need it, which are to be rejected."""
        offered = [pair for pair in sorted(self._offers) if keyframe in (pair.low, pair.high)]
        return [*(work.pair for work in self._sorted_work() if keyframe in self._needs(work)), *offered]

    def on_fetch_failed(self, keyframe: KeyframeId, now: float) -> None:
        """A fetch ended without the latent."""
        self.latents.on_failed(keyframe, now)
        self._changed = True

    def on_wants(self, wants: Iterable[KeyframeId]) -> None:
        """Latents that a neighbour cannot reach."""
        self._changed |= self.latents.on_wants(wants)

    def wants(self, now: float) -> tuple[KeyframeId, ...]:
        """Latents this robot needs, or relays, and cannot reach."""
        return self.latents.wants(self._lacking_all(), self._reach, now)

    def holds(self) -> tuple[KeyframeId, ...]:
        """Latents of others that this robot holds because somebody wanted them."""
        return self.latents.holds()

    # Range

    def on_peer(self, name: str, peer: Peer) -> None:
        """A robot in range said how it is; one that comes into range is tried at once."""
        if name not in self._reach:
            self.latents.on_reached(name)
            self._order = None
        self._changed |= self._reach.update(name, peer)

    def on_lost(self, name: str, now: float) -> None:
        """A robot is out of range; the pairs that it was to register wait for `takeover_s`."""
        self._reach.remove(name)
        self.latents.on_lost(name)
        for offer in self._offers.values():
            if offer.to == name:
                offer.since_s = now
        self._order, self._changed = None, True

    # Time

    def tick(self, now: float) -> list[Effect]:
        """Do whatever can be done now: offers, fetches, registrations."""
        if not self._changed and now < self._due_s:
            return []
        self._give_up(now)
        effects = [*self._tell(now), *self.latents.fetch(self._lacking_all(), self._reach, now), *self._register(now)]
        self._changed = False
        self._load = sum(self._can_be_done(work) for work in self._work.values())
        self._due_s = self._next_due_s(now)
        return effects

    def deadline(self) -> float:
        """When `tick` is due next."""
        return self._due_s

    def _next_due_s(self, now: float) -> float:
        times = [self._offer_due_s(offer) for offer in self._offers.values()]
        times += [work.registering_until_s for work in self._work.values() if work.registering_until_s is not None]
        return min((time for time in (*times, self.latents.due_s(now)) if time > now), default=float("inf"))

    def _offer_due_s(self, offer: _Offer) -> float:
        return offer.next_s if self._in_reach(offer) else self._takeover_at_s(offer)

    def _in_reach(self, offer: _Offer) -> bool:
        return offer.to in self._reach if offer.transferred else self._reach.writes(registrar_of(offer.candidate.pair))

    def _takeover_at_s(self, offer: _Offer) -> float:
        """When the finder may register a pair itself; later where it takes others to bring the latents.

        At once where the robot is here and writes another log: nobody writes the pair's log any more.
        """
        if offer.to in self._reach:
            return offer.since_s
        pair = offer.candidate.pair
        at_hand = offer.transferred or (pair.low in self.latents and pair.high in self.latents)
        return offer.since_s + self._parameters.takeover_s * (1 if at_hand else FAR_TAKEOVERS)

    # Assignment

    def _knows(self, pair: CandidatePair) -> bool:
        return pair in self._resolved or pair in self._work or pair in self._offers

    def _assign(self, candidate: Candidate, now: float) -> None:
        owner = registrar_of(candidate.pair)
        if owner != self._own and self._own in (candidate.pair.low.log, candidate.pair.high.log):
            self._offer(_Offer(candidate, owner.robot, now, now, transferred=False))
            return
        stronger = self._reach.stronger(self._compute_class)
        if stronger is not None:
            self._offer(_Offer(candidate, stronger, now, now, transferred=True))
            return
        self._add(candidate)

    def _offer(self, offer: _Offer) -> None:
        self._offers[offer.candidate.pair] = offer
        self._changed = True
        if len(self._offers) > self._parameters.candidates_max:
            del self._offers[max(self._offers, key=lambda pair: (-self._offers[pair].candidate.similarity, pair))]
            self.dropped += 1

    def _add(self, candidate: Candidate) -> None:
        query, match = candidate.pair.low, candidate.pair.high
        if match.log == self._own:
            query, match = match, query
        self._work[candidate.pair] = _Work(candidate.pair, candidate.similarity, query, match)
        self._order, self._changed = None, True
        if len(self._work) > self._parameters.candidates_max:
            waiting = [work for work in self._work.values() if work.registering_until_s is None]
            self._remove(max(waiting, key=_Work.order).pair)
            self.dropped += 1

    def _remove(self, pair: CandidatePair) -> None:
        if self._work.pop(pair, None) is not None:
            self._order, self._changed = None, True
        self._offers.pop(pair, None)

    # What is due

    def _tell(self, now: float) -> list[Effect]:
        """Tell robots in range what is theirs to register; take over from those that are gone."""
        due: dict[tuple[str, bool], list[CandidatePair]] = {}
        for pair, offer in sorted(self._offers.items()) if self._offers else ():
            if self._in_reach(offer):
                if offer.next_s <= now:
                    due.setdefault((offer.to, offer.transferred), []).append(pair)
            elif self._takeover_at_s(offer) <= now:
                del self._offers[pair]
                self._add(offer.candidate)
        effects: list[Effect] = []
        for (to, transferred), pairs in sorted(due.items()):
            for pair in pairs[:OFFERS_MAX]:
                self._offers[pair].next_s = now + self._parameters.offer_period_s
            effects.append(Unicast(to, CandidateOffer(tuple(pairs[:OFFERS_MAX]), transferred)))
        return effects

    def _register(self, now: float) -> list[Effect]:
        busy = sum(work.registering_until_s is not None for work in self._work.values())
        effects: list[Effect] = []
        for work in self._sorted_work():
            if busy >= self._parameters.registrations_max:
                break
            odometry = self._odometry_of(work)
            if work.registering_until_s is not None or odometry is None or self._lacking(work):
                continue
            work.registering_until_s = now + self._parameters.registration_timeout_s
            busy += 1
            effects.append(Register(work.pair, work.query, work.match, *odometry))
        return effects

    def _give_up(self, now: float) -> None:
        """Forget what gave no answer, so that it is tried again."""
        self.latents.give_up(now)
        for work in self._work.values():
            if work.registering_until_s is not None and work.registering_until_s <= now:
                work.registering_until_s = None

    def _odometry_of(self, work: _Work) -> tuple[KeyframeId, Pose7] | None:
        """The query's odometry pair; where a log has one keyframe only, the pair is taken the other way round."""
        odometry = self._odometry_pair(work.query)
        if odometry is None and work.registering_until_s is None:
            odometry = self._odometry_pair(work.match)
            if odometry is not None:
                work.query, work.match = work.match, work.query
        return odometry

    def _needs(self, work: _Work) -> list[KeyframeId]:
        """Latents that a pair needs: of the match, the query and the query's neighbour."""
        odometry = self._odometry_of(work)
        return [work.match, work.query, *([odometry[0]] if odometry else [])]

    def _lacking(self, work: _Work) -> list[KeyframeId]:
        """Latents that a pair needs and the store does not hold."""
        return [k for k in self._needs(work) if k not in self.latents]

    def _can_be_done(self, work: _Work) -> bool:
        in_reach = all(self._reach.holder(keyframe) is not None for keyframe in self._lacking(work))
        return in_reach and self._odometry_of(work) is not None

    def _lacking_all(self) -> Iterator[KeyframeId]:
        """Latents to fetch, the first pair's first."""
        return (k for work in self._sorted_work() for k in self._lacking(work))

    def _sorted_work(self) -> list[_Work]:
        """All work: the few pairs that were chosen for the pose graph, then the most similar ones."""
        if self._order is None:
            self._order = sorted(self._work.values(), key=_Work.order)
            if self._spectral is not None:
                similarities = {work.pair: work.similarity for work in self._order}
                chosen = self._spectral.chosen(similarities, lambda pair: self._can_be_done(self._work[pair]))
                rest = (work for work in self._order if work.pair not in chosen)
                self._order = [*(self._work[pair] for pair in chosen), *rest]
        return self._order
