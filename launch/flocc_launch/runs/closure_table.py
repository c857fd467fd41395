"""Candidate pairs of keyframes and what became of each, over all robots and counted once."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from flocc_agent.core.reports import CandidateFound, ClosureAccepted, ClosureRejected, ClosureWithdrawn, Fact
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.robot_result import RobotResult
from flocc_protocol.ids import KeyframeId

PairFact = CandidateFound | ClosureAccepted | ClosureRejected | ClosureWithdrawn
WITHDRAWN = "its robot took back a keyframe that showed what is not the scene"


@dataclass(frozen=True, slots=True)
class Pair:
    """Two keyframes that may show one place.

    Attributes:
        query: As registered; the lower of both for a pair that was not.
        match: The other keyframe.
        similarity: Best cosine similarity that a robot found, None where none was reported.
        ratio: Match ratio of Eq. (1), None where registration gave none.
        probability: Of Eq. (2), for accepted pairs.
        accepted: Whether some robot accepted it, and it counts.
        reason: Why it was rejected last, None where it was not.
        at_s: When it was accepted or rejected first, None where neither.
        used: Whether the last solution used it; None where it is not known (no scales are estimated).
    """

    query: KeyframeId
    match: KeyframeId
    similarity: float | None = None
    ratio: float | None = None
    probability: float | None = None
    accepted: bool = False
    reason: str | None = None
    at_s: float | None = None
    used: bool | None = None

    @property
    def rejected(self) -> bool:
        """Whether it was rejected and never accepted."""
        return self.reason is not None and not self.accepted

    @property
    def inter_robot(self) -> bool:
        """Whether it joins two robots."""
        return self.query.log.robot != self.match.log.robot


def pairs_of(events: Iterable[Reported[Fact]], results: Iterable[RobotResult]) -> list[Pair]:
    """Every pair that any robot found, registered or holds in its logs at the end; sorted."""
    pairs: dict[tuple[KeyframeId, KeyframeId], Pair] = {}
    for event in events:
        if isinstance(event.fact, PairFact):
            query, match = event.fact.query, event.fact.match
            key = (min(query, match), max(query, match))
            pairs[key] = updated(pairs.get(key, Pair(query, match)), event.fact, event.t)
    closures = [closure for result in results for closure in result.closures]
    scales_known = any(closure.scale is not None for closure in closures)
    for closure in closures:
        query, match = KeyframeId.parse(closure.query), KeyframeId.parse(closure.match)
        key = (min(query, match), max(query, match))
        known = pairs.get(key, Pair(query, match, ratio=closure.match_ratio))
        used = (known.used or closure.scale is not None) if scales_known else None
        pairs[key] = replace(known, accepted=True, used=used)
    return [pairs[key] for key in sorted(pairs)]


def updated(pair: Pair, fact: PairFact, t: float) -> Pair:
    """The pair after one more fact; an acceptance stands until a robot takes its keyframe back."""
    if isinstance(fact, CandidateFound):
        return replace(pair, similarity=max(fact.similarity, pair.similarity or -1.0))
    if isinstance(fact, ClosureWithdrawn):
        return replace(pair, accepted=False, reason=WITHDRAWN)
    if pair.accepted:
        return pair
    if isinstance(fact, ClosureRejected):
        return replace(pair, ratio=fact.ratio, reason=fact.reason, at_s=t if pair.at_s is None else pair.at_s)
    return replace(
        pair,
        query=fact.query,
        match=fact.match,
        ratio=fact.ratio,
        probability=fact.probability,
        accepted=True,
        at_s=t,
    )
