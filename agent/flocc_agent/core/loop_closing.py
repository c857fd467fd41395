"""Loop closing: candidate pairs to registrations, each by one robot (Sec. III-B).

Who registers a pair: one of its two owners, by a checksum of the pair, so that both agree without talking and the
work is halved between them. A robot that has a neighbour of a higher compute class hands its pairs to it. Whoever
found a pair that is another's to register tells it so until the record shows. When the other is silent for
`takeover_s` and the latents are at hand, the finder registers the pair itself.

A latent out of reach is asked of relays: heartbeats carry what a robot wants, and neighbours that can reach the
owner fetch and hold it.
"""

import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from flocc_agent.core.effects import Effect, FetchLatent, Register, Report, Unicast
from flocc_agent.core.parameters import LoopClosingParameters
from flocc_agent.core.place_recognition import Candidate
from flocc_protocol.codec import Pose7
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import OFFERS_MAX, CandidateOffer, CandidatePair

OdometryPairOf = Callable[[KeyframeId], tuple[KeyframeId, Pose7] | None]
"""Gives a keyframe's neighbour in its log and `T_neighbour_query`, or None while it has none."""


@dataclass(slots=True)
class _Work:
    """A pair that this robot registers."""

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
    """A pair that another robot is to register."""

    candidate: Candidate
    to: str
    next_s: float
    since_s: float
    transferred: bool


@dataclass(slots=True)
class _Fetch:
    """The state of one wanted latent: in flight until then, or paused until then."""

    in_flight_until_s: float | None = None
    not_before_s: float = 0.0
    pause_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Range:
    """Who is in range now, as loop closing needs it.

    Attributes:
        names: Robots in range, sorted.
        compute_class: Of each robot in range.
        holds: Latents that each robot in range holds for others.
        load: Registrations that wait at each robot in range.
    """

    names: tuple[str, ...]
    compute_class: dict[str, int]
    holds: dict[str, tuple[KeyframeId, ...]]
    load: dict[str, int]


def registrar_of(pair: CandidatePair) -> LogId:
    """The owner that registers a pair, the same at both: by checksum, so that each does half."""
    return pair.low.log if zlib.crc32(f"{pair.low} {pair.high}".encode()) % 2 == 0 else pair.high.log


class LoopClosing:
    """Pairs, latents and registrations of one robot."""

    def __init__(
        self, own: LogId, compute_class: int, odometry_pair: OdometryPairOf, parameters: LoopClosingParameters
    ) -> None:
        self._own = own
        self._compute_class = compute_class
        self._odometry_pair = odometry_pair
        self._parameters = parameters
        self._work: dict[CandidatePair, _Work] = {}
        self._offers: dict[CandidatePair, _Offer] = {}
        self._resolved: set[CandidatePair] = set()
        self._held: set[KeyframeId] = set()
        self._fetches: dict[KeyframeId, _Fetch] = {}
        self._relayed: dict[KeyframeId, None] = {}
        self._range = Range((), {}, {}, {})
        self._ticked_s = float("-inf")
        self.dropped = 0

    @property
    def load(self) -> int:
        """Registrations that wait here."""
        return len(self._work)

    def open_pairs(self) -> list[CandidatePair]:
        """Pairs that this robot is to register, or waits for others to register; sorted."""
        return sorted({*self._work, *self._offers})

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Queues and tables with their maximum."""
        limits = self._parameters
        return {
            "candidates": (len(self._work), limits.candidates_max),
            "offers": (len(self._offers), limits.candidates_max),
            "relayed": (len(self._relayed), limits.relays_max),
            "fetches": (len(self._fetches), 3 * limits.candidates_max + limits.relays_max),
        }

    def on_candidates(self, candidates: Iterable[Candidate], now: float) -> list[Effect]:
        """Pairs that place recognition found here."""
        effects: list[Effect] = []
        for candidate in candidates:
            if candidate.pair in self._resolved or candidate.pair in self._work or candidate.pair in self._offers:
                continue
            facts = {
                "query": str(candidate.pair.low),
                "match": str(candidate.pair.high),
                "similarity": round(candidate.similarity, 4),
            }
            effects.append(Report("candidate", facts))  # type: ignore[arg-type]
            self._assign(candidate, now)
        return effects

    def on_offer(self, offer: CandidateOffer) -> None:
        """Pairs that another robot found and that this one is to register."""
        for pair in offer.pairs:
            if pair in self._resolved or pair in self._work:
                continue
            if offer.transferred or registrar_of(pair) == self._own:
                self._offers.pop(pair, None)
                self._add(Candidate(pair, 0.0))

    def on_resolved(self, pair: CandidatePair) -> None:
        """A record of this pair is in a log: nobody needs to register it."""
        self._resolved.add(pair)
        self._work.pop(pair, None)
        self._offers.pop(pair, None)

    def on_held(self, keyframe: KeyframeId) -> None:
        """A latent is in this robot's store."""
        self._held.add(keyframe)
        self._fetches.pop(keyframe, None)

    def on_latent_missing(self, pair: CandidatePair, keyframe: KeyframeId) -> list[Effect]:
        """The store evicted a latent; another robot's is fetched again, an own one is lost."""
        self._held.discard(keyframe)
        work = self._work.get(pair)
        if work is not None:
            work.registering_until_s = None
        if keyframe.log == self._own and work is not None:
            del self._work[pair]
            return [Report("latent_lost", {"keyframe": str(keyframe)})]
        return []

    def on_fetch_failed(self, keyframe: KeyframeId, now: float) -> None:
        """Wait before the next try, longer each time."""
        fetch = self._fetches.get(keyframe)
        if fetch is not None:
            fetch.in_flight_until_s = None
            doubled = max(2 * fetch.pause_s, self._parameters.retry_s)
            fetch.pause_s = min(doubled, self._parameters.retry_max_s)
            fetch.not_before_s = now + fetch.pause_s

    def on_registered(self, pair: CandidatePair) -> None:
        """A registration came to an end; its record follows through `on_resolved`."""
        self._work.pop(pair, None)

    def on_range(self, in_range: Range) -> None:
        """Who is in range changed; a latent of a robot that came back is tried at once."""
        for name in set(in_range.names) - set(self._range.names):
            for keyframe, fetch in self._fetches.items():
                if keyframe.log.robot == name and fetch.in_flight_until_s is None:
                    fetch.not_before_s, fetch.pause_s = 0.0, 0.0
        self._range = in_range

    def on_wants(self, wants: Iterable[KeyframeId]) -> None:
        """Latents that a neighbour cannot reach: hold them for it, newest wish last."""
        for keyframe in wants:
            if keyframe.log != self._own:
                self._relayed.pop(keyframe, None)
                self._relayed[keyframe] = None
        while len(self._relayed) > self._parameters.relays_max:
            del self._relayed[next(iter(self._relayed))]

    def wants(self) -> tuple[KeyframeId, ...]:
        """Latents this robot needs, or relays, and cannot reach."""
        needed = [k for work in self._sorted_work() for k in self._lacking(work)]
        missing = [k for k in [*needed, *self._relayed] if k not in self._held and self._holder(k) is None]
        return tuple(dict.fromkeys(missing))[: self._parameters.wants_max]

    def holds(self) -> tuple[KeyframeId, ...]:
        """Latents of others that this robot holds because somebody wanted them."""
        return tuple(k for k in self._relayed if k in self._held)[: self._parameters.relays_max]

    def tick(self, now: float) -> list[Effect]:
        """Do whatever can be done now: offers, fetches, registrations."""
        self._ticked_s = now
        self._give_up(now)
        return [*self._tell(now), *self._fetch(now), *self._register(now)]

    def deadline(self) -> float:
        """When `tick` is due next."""
        times = [offer.next_s for offer in self._offers.values()]
        times += [work.registering_until_s for work in self._work.values() if work.registering_until_s is not None]
        times += [fetch.in_flight_until_s or fetch.not_before_s for fetch in self._fetches.values()]
        return min((time for time in times if time > self._ticked_s), default=float("inf"))

    # Assignment

    def _assign(self, candidate: Candidate, now: float) -> None:
        owner = registrar_of(candidate.pair)
        if owner != self._own and self._own in (candidate.pair.low.log, candidate.pair.high.log):
            self._offers[candidate.pair] = _Offer(candidate, owner.robot, now, now, transferred=False)
            return
        stronger = self._stronger()
        if stronger is not None:
            self._offers[candidate.pair] = _Offer(candidate, stronger, now, now, transferred=True)
            return
        self._add(candidate)

    def _stronger(self) -> str | None:
        """The neighbour of the highest compute class above this robot's, the least loaded of several."""
        better = [
            (-self._range.compute_class[name], self._range.load[name], name)
            for name in self._range.names
            if self._range.compute_class[name] > self._compute_class
        ]
        return min(better)[2] if better else None

    def _add(self, candidate: Candidate) -> None:
        query, match = candidate.pair.low, candidate.pair.high
        if match.log == self._own:
            query, match = match, query
        self._work[candidate.pair] = _Work(candidate.pair, candidate.similarity, query, match)
        if len(self._work) > self._parameters.candidates_max:
            waiting = [work for work in self._work.values() if work.registering_until_s is None]
            del self._work[max(waiting, key=_Work.order).pair]
            self.dropped += 1

    # What is due

    def _tell(self, now: float) -> list[Effect]:
        """Tell robots in range what is theirs to register; take over from those that are gone."""
        due: dict[tuple[str, bool], list[CandidatePair]] = {}
        for pair, offer in sorted(self._offers.items()):
            if offer.to not in self._range.names:
                if self._may_take_over(offer, now):
                    del self._offers[pair]
                    self._add(offer.candidate)
                continue
            offer.since_s = now
            if offer.next_s <= now:
                due.setdefault((offer.to, offer.transferred), []).append(pair)
        effects: list[Effect] = []
        for (to, transferred), pairs in sorted(due.items()):
            for pair in pairs[:OFFERS_MAX]:
                self._offers[pair].next_s = now + self._parameters.offer_period_s
            effects.append(Unicast(to, CandidateOffer(tuple(pairs[:OFFERS_MAX]), transferred)))
        return effects

    def _may_take_over(self, offer: _Offer, now: float) -> bool:
        if offer.since_s + self._parameters.takeover_s > now:
            return False
        return offer.transferred or {offer.candidate.pair.low, offer.candidate.pair.high} <= self._held

    def _fetch(self, now: float) -> list[Effect]:
        in_flight = sum(fetch.in_flight_until_s is not None for fetch in self._fetches.values())
        effects: list[Effect] = []
        needed = self._needed()
        self._forget_fetches(needed)
        for keyframe in needed:
            if in_flight >= self._parameters.fetches_max:
                break
            fetch = self._fetches.setdefault(keyframe, _Fetch())
            holder = self._holder(keyframe)
            if fetch.in_flight_until_s is not None or fetch.not_before_s > now or holder is None:
                continue
            fetch.in_flight_until_s = now + self._parameters.fetch_timeout_s
            in_flight += 1
            effects.append(FetchLatent(keyframe, holder, self._parameters.fetch_timeout_s))
        return effects

    def _forget_fetches(self, needed: list[KeyframeId]) -> None:
        idle = [k for k, fetch in self._fetches.items() if fetch.in_flight_until_s is None]
        for keyframe in set(idle) - set(needed):
            del self._fetches[keyframe]

    def _register(self, now: float) -> list[Effect]:
        busy = sum(work.registering_until_s is not None for work in self._work.values())
        effects: list[Effect] = []
        for work in self._sorted_work():
            if busy >= self._parameters.registrations_max:
                break
            odometry = self._odometry_pair(work.query)
            if work.registering_until_s is not None or odometry is None or self._lacking(work):
                continue
            work.registering_until_s = now + self._parameters.registration_timeout_s
            busy += 1
            effects.append(Register(work.pair, work.query, work.match, *odometry))
        return effects

    def _give_up(self, now: float) -> None:
        """Forget what gave no answer, so that it is tried again."""
        for keyframe, fetch in self._fetches.items():
            if fetch.in_flight_until_s is not None and fetch.in_flight_until_s <= now:
                self.on_fetch_failed(keyframe, now)
        for work in self._work.values():
            if work.registering_until_s is not None and work.registering_until_s <= now:
                work.registering_until_s = None

    # Latents

    def _needed(self) -> list[KeyframeId]:
        """Latents to fetch, the most similar pair's first, relayed ones last."""
        needed = [k for work in self._sorted_work() for k in self._lacking(work)]
        return [k for k in dict.fromkeys([*needed, *self._relayed]) if k not in self._held]

    def _lacking(self, work: _Work) -> list[KeyframeId]:
        """Latents that a pair needs and the store does not hold."""
        odometry = self._odometry_pair(work.query)
        needed = [work.match, work.query, *([odometry[0]] if odometry else [])]
        return [k for k in needed if k not in self._held]

    def _holder(self, keyframe: KeyframeId) -> str | None:
        """Who in range can give a latent: its owner, or a robot that holds it."""
        if keyframe.log == self._own:
            return None
        if keyframe.log.robot in self._range.names:
            return keyframe.log.robot
        return next((name for name in self._range.names if keyframe in self._range.holds[name]), None)

    def _sorted_work(self) -> list[_Work]:
        return sorted(self._work.values(), key=_Work.order)
