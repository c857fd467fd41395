"""Pairs that other robots are to register: told to them again and again, and taken over from those that are gone.

Offers to one robot form a group with one due time, so that no step looks through all of them. A stronger robot is
handed no more pairs than it can begin with soon; of those that wait for that this robot may take some back.
"""

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from flocc_agent.core.effects import Effect, Unicast
from flocc_agent.core.latents import Latents, Reach
from flocc_agent.core.place_recognition import Candidate
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import OFFERS_MAX, CandidateOffer, CandidatePair

FAR_TAKEOVERS = 2
OFFER_PERIOD_S = 2.0
"""Candidates that another robot is to register are told to it this often until its record shows."""
TAKEOVER_S = 15.0
"""A robot that was silent for this long loses the pairs it was to register, where the latents are at hand: five times
the silence after which it is out of range, so that a short cut makes no work twice."""


@dataclass(frozen=True, slots=True)
class Recipient:
    """Who is to register a pair.

    Attributes:
        robot: Its name.
        log: The log that it must write; None for a stronger robot, to which a pair is transferred.
    """

    robot: str
    log: LogId | None

    def is_in(self, reach: Reach) -> bool:
        """Whether it is there; a robot that lost its disk writes another log."""
        return self.robot in reach if self.log is None else reach.writes(self.log)


@dataclass(slots=True)
class _Offer:
    """A pair that another robot is to register.

    Attributes:
        candidate: It.
        next_s: When it is to be told.
        since_s: When the other robot was last within reach, or it became an offer.
        told: The other robot may know it.
    """

    candidate: Candidate
    next_s: float
    since_s: float
    told: bool

    def is_due(self, now: float) -> bool:
        """Whether it is to be told once more."""
        return self.told and self.next_s <= now


@dataclass(slots=True)
class _Group:
    """The offers to one robot, and when one of them may be due."""

    offers: dict[CandidatePair, _Offer] = field(default_factory=dict)
    due_s: float = float("-inf")

    def waiting(self) -> Iterator[Candidate]:
        """Pairs that were not told yet."""
        return (offer.candidate for offer in self.offers.values() if not offer.told)


class Offers:
    """All such pairs."""

    def __init__(self, latents: Latents) -> None:
        self._latents = latents
        self._recipients: dict[CandidatePair, Recipient] = {}
        self._groups: dict[Recipient, _Group] = {}

    def __len__(self) -> int:
        return len(self._recipients)

    def __contains__(self, pair: CandidatePair) -> bool:
        return pair in self._recipients

    def __iter__(self) -> Iterator[CandidatePair]:
        return iter(self._recipients)

    def similarities(self, reach: Reach) -> dict[CandidatePair, float]:
        """Similarity of each pair that a robot in range is to register."""
        near = (group for recipient, group in self._groups.items() if recipient.is_in(reach))
        return {pair: offer.candidate.similarity for group in near for pair, offer in group.offers.items()}

    def add(self, candidate: Candidate, recipient: Recipient, now: float, told: bool) -> None:
        """Let another robot register a pair, of which it may have been told before."""
        self.remove(candidate.pair)
        self._recipients[candidate.pair] = recipient
        group = self._groups.setdefault(recipient, _Group())
        group.offers[candidate.pair] = _Offer(candidate, now, now, told)
        group.due_s = float("-inf")

    def remove(self, pair: CandidatePair) -> None:
        """A pair is done, or this robot's own."""
        recipient = self._recipients.pop(pair, None)
        if recipient is not None:
            group = self._groups[recipient]
            del group.offers[pair]
            if not group.offers:
                del self._groups[recipient]

    def drop_worst(self) -> None:
        """Forget the least similar pair."""
        offers = (offer.candidate for group in self._groups.values() for offer in group.offers.values())
        self.remove(max(offers, key=_most_similar).pair)

    def using(self, keyframe: KeyframeId) -> list[CandidatePair]:
        """Pairs of a keyframe."""
        return sorted(pair for pair in self._recipients if keyframe in (pair.low, pair.high))

    def on_peer(self, robot: str) -> None:
        """A robot came into range, or writes another log."""
        for recipient, group in self._groups.items():
            if recipient.robot == robot:
                group.due_s = float("-inf")

    def waits_for(self, robot: str) -> bool:
        """Whether a pair waits until a stronger robot has room."""
        group = self._groups.get(Recipient(robot, None))
        return group is not None and any(True for _ in group.waiting())

    def take_back(self, reach: Reach) -> Candidate | None:
        """The best pair that can be done of those that wait for a stronger robot which has more than enough to do."""
        full = (group for recipient, group in self._groups.items() if reach.is_full(recipient.robot))
        waiting = (c for group in full for c in group.waiting() if self._can_be_had(c.pair, reach))
        best = min(waiting, key=_most_similar, default=None)
        if best is not None:
            self.remove(best.pair)
        return best

    def _can_be_had(self, pair: CandidatePair, reach: Reach) -> bool:
        return not any(self._latents.is_out_of_reach(keyframe, reach) for keyframe in (pair.low, pair.high))

    def on_lost(self, robot: str, now: float) -> None:
        """A robot is out of range; the pairs that it was to register wait for `TAKEOVER_S`."""
        for recipient, group in self._groups.items():
            if recipient.robot == robot:
                group.due_s = float("-inf")
                for offer in group.offers.values():
                    offer.since_s = now

    def due_s(self) -> float:
        """When something is to be said or taken over."""
        return min((group.due_s for group in self._groups.values()), default=float("inf"))

    def tell(self, reach: Reach, now: float, spares: Callable[[Candidate], bool] = lambda _: False) -> list[Effect]:
        """Tell robots in range what is theirs to register.

        Args:
            reach: Robots in range.
            now: The time.
            spares: Whether a pair is not to be registered any more; asked before it is told.
        """
        effects: list[Effect] = []
        for recipient in sorted(self._groups, key=lambda recipient: (recipient.robot, recipient.log is not None)):
            group = self._groups[recipient]
            if group.due_s > now or not recipient.is_in(reach):
                continue
            due = [pair for pair in sorted(group.offers) if group.offers[pair].is_due(now)]
            needless = {pair for pair in due if spares(group.offers[pair].candidate)}
            for pair in needless:
                self.remove(pair)
            pairs = [pair for pair in due if pair not in needless]
            pairs = [*pairs, *_handed(recipient, group, reach)][:OFFERS_MAX]
            for pair in pairs:
                group.offers[pair].next_s, group.offers[pair].told = now + OFFER_PERIOD_S, True
            next_s = min((offer.next_s for offer in group.offers.values() if offer.told), default=float("inf"))
            group.due_s = max(next_s, now + OFFER_PERIOD_S / 8)  # sooner where some are left over
            if pairs:
                offer = CandidateOffer(tuple(pairs), transferred=recipient.log is None)
                effects.append(Unicast(recipient.robot, offer))
        return effects

    def taken_over(self, reach: Reach, now: float) -> list[Candidate]:
        """Pairs of robots that are gone, which this robot may register itself; they are no offers any more."""
        candidates: list[Candidate] = []
        for recipient in sorted(self._groups, key=lambda recipient: (recipient.robot, recipient.log is not None)):
            group = self._groups[recipient]
            if group.due_s > now or recipient.is_in(reach):
                continue
            at_s = {pair: self._takeover_at_s(recipient, offer, reach) for pair, offer in group.offers.items()}
            due = sorted(pair for pair in at_s if at_s[pair] <= now)
            candidates += [group.offers[pair].candidate for pair in due]
            group.due_s = min((time for time in at_s.values() if time > now), default=float("inf"))
        for candidate in candidates:
            self.remove(candidate.pair)
        return candidates

    def _takeover_at_s(self, recipient: Recipient, offer: _Offer, reach: Reach) -> float:
        """When the finder may register a pair itself; later where it takes others to bring the latents.

        At once where the robot was never told of it, or is here and writes another log: nobody writes the pair's log.
        """
        if recipient.robot in reach or not offer.told:
            return offer.since_s
        pair = offer.candidate.pair
        at_hand = recipient.log is None or (pair.low in self._latents and pair.high in self._latents)
        return offer.since_s + TAKEOVER_S * (1 if at_hand else FAR_TAKEOVERS)


def _handed(recipient: Recipient, group: _Group, reach: Reach) -> list[CandidatePair]:
    """The most similar pairs for which a stronger robot has room; they count as handed."""
    best = heapq.nsmallest(min(reach.room(recipient.robot), OFFERS_MAX), group.waiting(), key=_most_similar)
    reach.on_handed(recipient.robot, len(best))
    return [candidate.pair for candidate in best]


def _most_similar(candidate: Candidate) -> tuple[float, CandidatePair]:
    return -candidate.similarity, candidate.pair
