"""Loop closing: candidate pairs to registrations, each by one robot (Sec. III-B).

Who registers a pair: one of its two owners, by a checksum of the pair, so that both agree without talking and the
work is halved between them. A robot that has a neighbour of a higher compute class hands its pairs to it. Whoever
found a pair that is another's to register tells it so until the record shows. When the other is out of range for
`TAKEOVER_S`, the finder registers the pair itself, if need be with latents that relays bring. A pair whose latent
exists no more is rejected, by a record like any other; so is one that is hardly worth its latent (`prospects.py`).
One that tells nothing new is left where it is, without a record (`spared.py`).
A robot that comes back does not know what it handed over before: it listens who is there before it decides about any
pair.

Robots of closed logs (an opened map's, and this robot's own earlier journeys) register nothing: the other owner does.
Nor are their keyframes queries, so that of their latents only the matching one is needed.
"""

import zlib
from collections.abc import Iterable, Iterator, Sequence

from flocc_agent.core.candidate_order import SpectralOrder
from flocc_agent.core.effects import Effect, Register, Report
from flocc_agent.core.front_ends import FrontEnds
from flocc_agent.core.known_sets import PairSet
from flocc_agent.core.latents import WANTS_MAX, WANTS_TURN_S, Latents, OffersHeard, Peer, Reach, ToldNowAndThen
from flocc_agent.core.offers import Offers, Recipient
from flocc_agent.core.parameters import LoopClosingParameters
from flocc_agent.core.place_recognition import Candidate
from flocc_agent.core.prospects import UNLIKELY, Agreement, Prospect, Prospects
from flocc_agent.core.pulls import remember
from flocc_agent.core.reports import CandidateFound
from flocc_agent.core.spared import HeldClosures, NoClosures, Spared
from flocc_agent.core.work import OdometryPairOf, Order, WorkTable
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidateOffer, CandidatePair

REGISTRATION_TIMEOUT_S = 120.0
"""A registration that gave no answer for this long is tried again; networks on a CPU need much of it."""
ASLEEP_S = 10.0
"""A robot that was not woken for so long slept, and so did its workers: registrations have so much more time."""
ASKED_AT_ONCE = 4
ASKED_ORDER = 1.0
"""A pair that is asked for comes before all others, however alike it is."""
UNLIKELY_AT_ONCE_MAX = 16
"""Pairs that are refused unseen in one step: each is a record, and a burst of them would hold up others."""


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
        closed: frozenset[LogId] = frozenset(),
        listens_until_s: float = float("-inf"),
        agreement: Agreement = lambda _: None,
        held: HeldClosures | None = None,
    ) -> None:
        """Start without pairs.

        Args:
            own: The log that this robot writes.
            compute_class: 0 (small) to 9.
            odometry_pair: Gives the neighbour of a keyframe.
            parameters: Limits and times.
            spectral: Orders pairs by what they add to the pose graph; None: by similarity.
            closed: Logs that nobody writes any more, and whose latents are here.
            listens_until_s: Pairs wait undecided until then.
            agreement: How well the surroundings of a pair agree.
            held: Closures that are known; None: no pair is spared because of them.
        """
        self.latents = Latents(own, parameters)
        self.dropped = 0
        self._own = own
        self._closed = closed
        self._compute_class = compute_class
        self._parameters = parameters
        self._reach = Reach()
        self._work = WorkTable(own, self.latents, lambda k: None if k.log in closed else odometry_pair(k))
        self._offers = Offers(self.latents)
        self._spectral = spectral
        self._front_ends = FrontEnds()
        self._prospects = Prospects(agreement)
        self._unlikely: list[CandidatePair] = []
        self._spared = Spared(held or NoClosures(), parameters.closures_enough, parameters.sparing_logs_min)
        self._told: list[CandidatePair] = []
        self._chosen: list[CandidatePair] | None = None
        self._resolved = PairSet()
        self._undecided: dict[CandidatePair, Candidate] = {}
        self._listens_until_s = listens_until_s
        self._wanted: tuple[KeyframeId, ...] = ()
        self._wishes_told = ToldNowAndThen()
        self._offers_told = ToldNowAndThen()
        self._offers_heard = OffersHeard()
        self._turn = -1
        self._changed = True
        self._due_s = float("inf")
        self._ticked_s = float("inf")
        self._outdated: set[CandidatePair] = set()
        """Registrations under way with latents that were made anew since."""

    @property
    def load(self) -> int:
        """Registrations that wait here and can be done, with latents that are here or can be had."""
        return self._work.load(self._reach)

    def open_pairs(self) -> list[CandidatePair]:
        """Pairs that this robot is to register, or waits for others to register; sorted."""
        return sorted([*self._work.pairs(), *self._offers, *self._undecided])

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Queues and tables with their maximum."""
        candidates_max = self._parameters.candidates_max
        return {
            "candidates": (len(self._work), candidates_max),
            "offers": (len(self._offers), candidates_max),
            "undecided": (len(self._undecided), candidates_max),
            **self.latents.sizes(),
            **self._prospects.sizes(),
            **self._spared.sizes(),
        }

    # Pairs

    def on_candidates(self, candidates: Iterable[Candidate], now: float) -> list[Effect]:
        """Pairs that place recognition found here."""
        effects: list[Effect] = []
        for candidate in candidates:
            if self._knows(candidate.pair) or self._front_ends.are_apart(candidate.pair):
                continue
            similarity = round(candidate.similarity, 4)
            fact = CandidateFound(query=candidate.pair.low, match=candidate.pair.high, similarity=similarity)
            effects.append(Report(fact))
            self._assign(candidate, now)
        return effects

    def on_asked(self, candidates: Iterable[Candidate], now: float) -> list[Effect]:
        """Pairs that would tell whether two ways are joined rightly: a few come before all others, each once."""
        effects: list[Effect] = []
        candidates = list(candidates)
        asked = [candidate.pair for candidate in candidates if self._prospects.was_asked(candidate.pair)]
        waiting = sum(pair not in self._resolved and pair not in self._spared for pair in asked)
        for candidate in candidates:
            if waiting >= ASKED_AT_ONCE:
                break
            pair, similarity = candidate.pair, candidate.similarity
            if self._front_ends.are_apart(pair) or not self._prospects.ask(pair):
                continue
            if self._prospects.was_refused_unseen(pair):
                self._reopen(pair)
            if self._is_due_anyway(pair):
                self._spared.remove(pair)
            if not self._knows(pair):
                fact = CandidateFound(query=pair.low, match=pair.high, similarity=round(similarity, 4))
                effects.append(Report(fact))
                self._assign(Candidate(pair, ASKED_ORDER), now)
            waiting += pair not in self._resolved and pair not in self._spared
        return effects

    def on_offer(self, offer: CandidateOffer, now: float) -> None:
        """Pairs that another robot found and that this one is to register."""
        for pair in offer.pairs:
            if pair in self._spared and not self._spared.is_told(pair):
                self._spared.remove(pair)  # keyframes without closures came since, so that its stretch is weak now
            if offer.transferred and not (pair in self._resolved or pair in self._work or pair in self._spared):
                self._offers.remove(pair)
                self._undecided.pop(pair, None)
                if not self._spares(Candidate(pair, 0.0)):
                    self._add(Candidate(pair, 0.0))
            elif self._owner(pair) == self._own and not self._knows(pair):
                self._assign(Candidate(pair, 0.0), now)

    def settled(self, pairs: Iterable[CandidatePair]) -> list[CandidatePair]:
        """Those of some pairs of which a record is here."""
        return [pair for pair in pairs if pair in self._resolved]

    def do_again(self, pair: CandidatePair) -> None:
        """What is recorded of a pair does not reach whoever waits for it: it is registered once more, and here.

        A stronger robot may hold the same record, and would not begin.
        """
        self._reopen(pair)
        self._spared.need(pair)
        self._add(Candidate(pair, 0.0))

    def _reopen(self, pair: CandidatePair) -> None:
        self._prospects.on_settled(pair)
        self._resolved.discard(pair)

    def roles(self, pair: CandidatePair) -> tuple[KeyframeId, KeyframeId] | None:
        """Query and match of a pair whose registration is waited for, None if it is not."""
        work = self._work.get(pair)
        return (work.query, work.match) if work else None

    def is_outdated(self, pair: CandidatePair) -> bool:
        """Whether a registration that ended is to be done again: a latent was made anew meanwhile. Told once."""
        if pair not in self._outdated:
            return False
        self._outdated.discard(pair)
        self._work.stop(pair)
        self._changed = True
        return True

    def on_withdrawal(self, log: LogId, first: int, end: int) -> None:
        """Latents of a stretch of a log were made anew."""
        for keyframe in (KeyframeId(log, index) for index in range(first, end)):
            pairs = {pair for pair in self._work.using(keyframe) if keyframe in (pair.low, pair.high)}
            self._outdated |= pairs & self._work.under_way
            if log != self._own and log not in self._closed:
                self.latents.on_withdrawn(keyframe)
                self._work.on_evicted(keyframe)
        self._chosen, self._changed = None, True

    def on_withdrawn(self, pair: CandidatePair, now: float) -> None:
        """The closure of a pair does not count: it is registered once more."""
        self._resolved.discard(pair)
        if not self._knows(pair) and self._concerns(pair):
            self._assign(Candidate(pair, 0.0), now)
        for other, similarity in self._spared.on_gone(pair):
            self._assign(Candidate(other, similarity), now)

    def on_resolved(self, pair: CandidatePair) -> None:
        """A record of this pair is in a log: nobody needs to register it."""
        self._resolved.add(pair)
        self._prospects.on_resolved(pair)
        self._spared.remove(pair)
        self._undecided.pop(pair, None)
        self._outdated.discard(pair)
        if pair in self._work or pair in self._offers:
            self._work.remove(pair)
            self._offers.remove(pair)
            self._chosen, self._changed = None, True

    def forget(self, log: LogId) -> None:
        """A log is held no more: its pairs wait for nothing."""
        for pair in self.open_pairs():
            if log in (pair.low.log, pair.high.log):
                self.on_resolved(pair)
                self._resolved.discard(pair)
        self.latents.names.forget(log)

    def is_written(self, log: LogId) -> bool:
        """Whether the writer of a log is in range."""
        return self._reach.writes(log)

    def on_closure(self, pair: CandidatePair, now: float) -> None:
        """A record of this pair is in a log, and it is a closure; what was refused unseen beside it has a chance."""
        if self._spectral is not None:
            self._spectral.on_closure(pair)
        self._front_ends.on_closure(pair)
        is_own = self._concerns(pair)
        self.on_resolved(pair)
        self._changed |= is_own
        for other in self._prospects.on_judged(pair, is_closure=True, is_own=is_own):
            self._resolved.discard(other)
            if self._owner(other) == self._own:
                self._assign(Candidate(other, 0.0), now)
        self._spare_beside(pair)
        for other, similarity in self._spared.on_closure(pair, is_own):
            self._assign(Candidate(other, similarity), now)

    def on_rejection(self, pair: CandidatePair, reason: str, was_seen: bool = True) -> bool:
        """A record of this pair is in a log, and it is none; whether its logs' front ends turned out to differ.

        Args:
            pair: Of keyframes.
            reason: Why.
            was_seen: Whether a registration says so, whose odometry pair had correspondences.
        """
        is_own = self._concerns(pair)
        was_resolved = pair in self._resolved
        self.on_resolved(pair)
        if reason == UNLIKELY:
            self._prospects.on_unlikely(pair, was_resolved)
        else:
            self._prospects.on_settled(pair)
        if was_seen and reason != UNLIKELY:
            self._prospects.on_judged(pair, is_closure=False, is_own=is_own)
        if not self._front_ends.on_rejection(pair, reason):
            return False
        for other in filter(self._front_ends.are_apart, self.open_pairs()):
            self._undecided.pop(other, None)
            self._work.remove(other)
            self._offers.remove(other)
        self._chosen, self._changed = None, True
        return True

    def on_keyframe(self, log: LogId) -> None:
        """A log grew: a keyframe may have got the neighbour that it lacked."""
        if self._spectral is not None:
            self._spectral.on_keyframe(log)
        self._changed |= self._work.on_keyframe(log)

    # Latents

    def on_fetched(self, keyframe: KeyframeId, now: float) -> None:
        """A fetch brought a latent; an old one is fetched again."""
        if self.latents.is_outdated(keyframe):
            self.on_fetch_failed(keyframe, now)
        else:
            self.on_held(keyframe)

    def on_held(self, keyframe: KeyframeId) -> None:
        """A latent is in this robot's store."""
        self.latents.add(keyframe)
        self._work.on_held(keyframe)
        self._changed = True

    def on_latent_missing(self, pair: CandidatePair, keyframe: KeyframeId) -> list[CandidatePair]:
        """The store evicted a latent; another robot's is fetched again, an own one is lost. Pairs to reject."""
        self.latents.remove(keyframe)
        self._outdated.discard(pair)
        self._work.on_evicted(keyframe)
        self._work.stop(pair)
        self._changed = True
        is_lost = keyframe.log == self._own or keyframe.log in self._closed
        return self._using(keyframe) if is_lost else []

    def on_latent_lost(self, keyframe: KeyframeId, now: float) -> list[CandidatePair]:
        """A latent exists no more: the pairs that need it, which are to be rejected; relays pass it on."""
        self.latents.on_gone(keyframe, now)
        return self._using(keyframe)

    def own_lost(self) -> list[KeyframeId]:
        """Own latents that a pair needs and that the disk did not bring back; nobody else has them."""
        of_own = self._work.lacking.get(self._own.robot)
        return sorted(k for k in of_own if k.log == self._own) if of_own else []

    def on_lost_elsewhere(self, lost: Iterable[KeyframeId], now: float) -> list[tuple[KeyframeId, CandidatePair]]:
        """A neighbour knows of latents that exist no more; believed where nobody in range has them. Pairs to reject."""
        gone = [k for k in lost if self.latents.is_out_of_reach(k, self._reach)]
        return [(keyframe, pair) for keyframe in gone for pair in self.on_latent_lost(keyframe, now)]

    def on_fetch_failed(self, keyframe: KeyframeId, now: float) -> None:
        """A fetch ended without the latent."""
        self.latents.on_failed(keyframe, now)
        self._changed = True

    def on_false_latent(self, keyframe: KeyframeId, holder: str) -> None:
        """What a robot served is not what the keyframe's owner made."""
        self._reach.on_false(holder, keyframe)
        self._chosen = None

    def on_wants(self, peer: str, wants: Sequence[KeyframeId], now: float) -> None:
        """Latents that a neighbour cannot reach."""
        if wants:
            self._changed |= self.latents.on_wants(peer, wants, now)

    def wants(self, now: float) -> tuple[KeyframeId, ...]:
        """Latents this robot needs, or relays, and cannot reach, as far as that is to be told now.

        They are looked for anew when some were got.
        """
        turn = int(now // WANTS_TURN_S)
        still = tuple(k for k in self._wanted if self.latents.is_out_of_reach(k, self._reach))
        if turn != self._turn or len(still) < WANTS_MAX:
            still = still if turn == self._turn else ()
            self._turn = turn
            still = self.latents.wants(self._out_of_reach(), self._reach, now, still)
        self._wanted = still
        return self._wishes_told.due(still, now)

    def holds(self, now: float) -> tuple[KeyframeId, ...]:
        """Latents of others that this robot holds because somebody wanted them, as far as that is to be told now."""
        return self._offers_told.due(self.latents.holds(now), now)

    def held_by(self, name: str, told: Sequence[KeyframeId], now: float) -> tuple[KeyframeId, ...]:
        """Latents that a robot in range holds for others, of which it told these just now."""
        return self._offers_heard.hear(name, told, now)

    def lost(self, now: float) -> tuple[KeyframeId, ...]:
        """Latents that neighbours want and that exist no more."""
        return self.latents.lost(now)

    # Range

    def on_peer(self, name: str, peer: Peer) -> None:
        """A robot in range said how it is; one that comes into range is tried at once."""
        if name not in self._reach:
            self.latents.on_reached(name)
            self._wishes_told.on_reached()
            self._offers_told.on_reached()
        if self._reach.update(name, peer):
            self._offers.on_peer(name)
            self._chosen, self._changed = None, True
        elif self._offers.waits_for(name):
            self._offers.on_peer(name)
            self._changed = True

    def on_lost(self, name: str, now: float) -> None:
        """A robot is out of range; the pairs that it was to register wait for `TAKEOVER_S`."""
        self._reach.remove(name)
        self._offers_heard.on_lost(name)
        self.latents.on_lost(name)
        self._offers.on_lost(name, now)
        self._chosen, self._changed = None, True

    # Time

    def tick(self, now: float) -> list[Effect]:
        """Do whatever can be done now: offers, fetches, registrations."""
        if now - self._ticked_s > ASLEEP_S:
            self._work.wait_longer(now - self._ticked_s)
        self._ticked_s = now
        if not self._changed and now < self._due_s:
            return []
        self._give_up(now)
        if self._undecided and self._listens_until_s <= now:
            self._decide(now)
        for candidate in self._offers.taken_over(self._reach, now):
            if not self._spares(candidate):
                self._hand_on_or_add(candidate, now)
        effects = self._offers.tell(self._reach, now, self._spares)
        self._take_back()
        if self.latents.free() > 0:
            effects += self.latents.fetch(self._worth_fetching(now), self._reach, now)
        effects += self._register(now)
        self._changed = bool(self._unlikely)
        heard_s = self._listens_until_s if self._undecided else float("inf")
        held_s = self._prospects.due_s(now)
        self._due_s = min(self._offers.due_s(), self._work.due_s(), self.latents.due_s(now), heard_s, held_s)
        return effects

    def deadline(self) -> float:
        """When `tick` is due next."""
        return self._due_s

    def take_unlikely(self) -> list[CandidatePair]:
        """Pairs that are to be refused unseen, each given once."""
        unlikely, self._unlikely = self._unlikely, []
        return unlikely

    def take_told(self) -> list[CandidatePair]:
        """Pairs that are spared because closures beside them tell what they would, each given once."""
        told, self._told = self._told, []
        return told

    # Assignment

    def _knows(self, pair: CandidatePair) -> bool:
        known = pair in self._resolved or pair in self._work or pair in self._offers or pair in self._undecided
        return known or pair in self._spared

    def _spares(self, candidate: Candidate) -> bool:
        """Whether a pair tells nothing new; then nobody waits for it."""
        if self._is_due_anyway(candidate.pair) or not self._spared.is_told(candidate.pair):
            return False
        self._spared.add(candidate.pair, candidate.similarity)
        self._told.append(candidate.pair)
        return True

    def _is_due_anyway(self, pair: CandidatePair) -> bool:
        """Whether a pair is asked for and to be registered here; another robot does not know that it is asked for."""
        if not self._prospects.was_asked(pair) or self._owner(pair) != self._own:
            return False
        return self._reach.stronger(self._compute_class) is None

    def _spare_beside(self, closure: CandidatePair) -> None:
        """Spare pairs beside a new closure that nobody began to register here."""
        if self._spared.is_any():
            self._spare_told(self._work.beside(closure))

    def _spare_told(self, waiting: Iterable[Order]) -> None:
        for similarity, pair in waiting:
            if self._spares(Candidate(pair, -similarity)):
                self._work.remove(pair)
                self._chosen, self._changed = None, True

    def _concerns(self, pair: CandidatePair) -> bool:
        """Whether a pair is of this robot's keyframes, or registered here."""
        return self._own in (pair.low.log, pair.high.log) or pair in self._work

    def _decide(self, now: float) -> None:
        """Listening is over: assign what was found meanwhile."""
        undecided, self._undecided = self._undecided, {}
        for candidate in undecided.values():
            self._assign(candidate, now, told=True)  # by this robot's last life, perhaps

    def _assign(self, candidate: Candidate, now: float, told: bool = False) -> None:
        if now < self._listens_until_s:
            remember(self._undecided, candidate.pair, candidate, self._parameters.candidates_max)
            self._changed = True
            return
        if self._spares(candidate):
            return
        owner = self._owner(candidate.pair)
        if owner != self._own and self._own in (candidate.pair.low.log, candidate.pair.high.log):
            self._offer(candidate, Recipient(owner.robot, owner), now, told=True)
            return
        self._hand_on_or_add(candidate, now, told)

    def _hand_on_or_add(self, candidate: Candidate, now: float, told: bool = False) -> None:
        """A pair that is this robot's goes to a stronger one, where one is in range."""
        stronger = self._reach.stronger(self._compute_class)
        if stronger is not None:
            self._offer(candidate, Recipient(stronger, None), now, told)
            return
        self._add(candidate)

    def _take_back(self) -> None:
        """While a stronger robot has more than enough to do, a robot that has nothing to do helps."""
        for _ in range(self.load, self._parameters.registrations_max + self._parameters.fetches_max):
            candidate = self._offers.take_back(self._reach)
            if candidate is not None and not self._spares(candidate):
                self._add(candidate)

    def _owner(self, pair: CandidatePair) -> LogId:
        """Which of its owners registers a pair: one that is there."""
        if pair.low.log in self._closed:
            return pair.high.log
        return pair.low.log if pair.high.log in self._closed else registrar_of(pair)

    def _offer(self, candidate: Candidate, recipient: Recipient, now: float, told: bool) -> None:
        self._offers.add(candidate, recipient, now, told)
        self._changed = True
        if len(self._offers) > self._parameters.candidates_max:
            self._offers.drop_worst()
            self.dropped += 1

    def _add(self, candidate: Candidate) -> None:
        self._work.add(candidate)
        self._chosen, self._changed = None, True
        if len(self._work) > self._parameters.candidates_max:
            self._work.drop_worst()
            self.dropped += 1

    # What is due

    def _register(self, now: float) -> list[Effect]:
        effects: list[Effect] = []
        while self._work.registering < self._parameters.registrations_max:
            work = self._work.start_next(now + REGISTRATION_TIMEOUT_S, self._choice())
            if work is None:
                break
            if self._spares(Candidate(work.pair, -work.order[0])):
                self._work.remove(work.pair)
                self._chosen = None
                continue
            assert work.odometry is not None
            effects.append(Register(work.pair, work.query, work.match, *work.odometry))
        return effects

    def _give_up(self, now: float) -> None:
        """Forget what gave no answer, so that it is tried again."""
        self.latents.give_up(now)
        for pair in self._work.overdue(now):
            self._outdated.discard(pair)
            self._work.stop(pair)

    def _using(self, keyframe: KeyframeId) -> list[CandidatePair]:
        return [*self._work.using(keyframe), *self._offers.using(keyframe)]

    def _choice(self) -> list[CandidatePair]:
        """The few pairs that are due because they strengthen the pose graph most; all others wait for their turn."""
        if self._spectral is None or not len(self._work):
            return []
        if self._chosen is None:
            similarities = {work.pair: -work.order[0] for work in self._work}
            self._chosen = self._spectral.chosen(
                similarities, self._can_be_done, lambda: self._offers.similarities(self._reach)
            )
        return self._chosen

    def _can_be_done(self, pair: CandidatePair) -> bool:
        work = self._work.get(pair)
        if work is None or work.odometry is None:
            return False
        return all(self._reach.holder(keyframe) is not None for keyframe in work.lacking)

    def _fetchable(self) -> list[KeyframeId]:
        """Latents that can be had and that a pair lacks, the first pair's first."""
        chosen = [keyframe for pair in self._choice() if (work := self._work.get(pair)) for keyframe in work.lacking]
        return chosen or self._fetchable_by_similarity()

    def _worth_fetching(self, now: float) -> Iterator[KeyframeId]:
        """The same without those of which no pair is likely; pairs that stay so are to be refused, a few at a time."""
        for keyframe in self._fetchable():
            if self._spared.is_any():
                self._spare_told(self._work.waiting(keyframe))
            prospects = {pair: self._prospects.of(pair, now) for pair in self._work.using(keyframe)}
            if keyframe.log == self._own or Prospect.LIKELY in prospects.values():
                yield keyframe
                continue
            if len(self._unlikely) >= UNLIKELY_AT_ONCE_MAX:
                return
            unlikely = (pair for pair, prospect in prospects.items() if prospect is Prospect.UNLIKELY)
            self._unlikely += [pair for pair in unlikely if pair not in self._unlikely]

    def _fetchable_by_similarity(self) -> list[KeyframeId]:
        lacking = self._work.lacking
        found = [(order, k) for name in self._reach for k, order in lacking.get(name, {}).items()]
        for keyframe in self._reach.held_for_others():
            order = lacking.get(keyframe.log.robot, {}).get(keyframe)
            if order is not None and keyframe.log.robot not in self._reach:
                found.append((order, keyframe))
        return [keyframe for _, keyframe in sorted(found)]

    def _out_of_reach(self) -> list[KeyframeId]:
        """Latents that a pair lacks and whose owner is out of range, the most similar pair's first."""
        lacking = self._work.lacking
        found = [(order, k) for name in lacking if name not in self._reach for k, order in lacking[name].items()]
        return [keyframe for _, keyframe in sorted(found)]
