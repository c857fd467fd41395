"""Whom to ask for knots, and for whom: over robots that are ever nearer to the leader, and back the same way.

Rules: who is asked for knots that it does not hold remembers the asker for a few seconds and asks the robot next on the
way to the leader; what comes is passed on and kept. One log is asked for once at a time, so no question runs in
circles; a question that nobody answers is asked of another robot after a pause. What a robot needs for itself it asks
for until it comes: its correction may be the last one for hours.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

from flocc_agent.core.effects import Effect, Unicast
from flocc_agent.core.pulls import REMEMBERED_MAX, REQUEST_TIMEOUT_S, remember
from flocc_protocol.ids import LogId, Term
from flocc_protocol.log_corrections import KNOT_REQUESTS_MAX
from flocc_protocol.messages import CorrectionVersion, KnotRequest

GRACE_S = 0.3
"""A leader sends knots to owners in range with the correction itself; they are not asked for sooner than this."""
INTEREST_S = 5.0
"""Knots that come later than this are not passed on to who asked for them."""
PEERS_MAX = 16
ASKED_MAX = 6
"""Times that one version is asked for on behalf of others; they ask again."""
PAUSE_MAX_S = 30.0
"""What a robot needs itself is asked for until it comes, with pauses that double up to this."""


@dataclass(slots=True)
class _Question:
    """Knots that are wanted: which, for whom, how often asked for, and when again."""

    version: CorrectionVersion
    next_s: float
    for_itself: bool
    asked: int = 0
    peers: dict[str, float] = field(default_factory=dict)

    def was_asked(self, now: float) -> None:
        """Count a question; the next one is due after a pause."""
        self.asked += 1
        doublings = min(max(0, self.asked - ASKED_MAX), 16)
        self.next_s = now + min(REQUEST_TIMEOUT_S * 2**doublings, PAUSE_MAX_S)

    def is_due(self, now: float) -> bool:
        """Whether it is time to ask; on behalf of others only so often."""
        return self.next_s <= now and (self.for_itself or self.asked < ASKED_MAX)


class KnotRequests:
    """Questions for knots that are open at one robot."""

    def __init__(self, towards: Callable[[Term], list[str]]) -> None:
        """Start with none.

        Args:
            towards: Robots in range, those that are nearest to the leader of a term first.
        """
        self._towards = towards
        self._open: dict[LogId, _Question] = {}

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        longest = max((len(question.peers) for question in self._open.values()), default=0)
        return {"knot_questions": (len(self._open), REMEMBERED_MAX), "knot_askers": (longest, PEERS_MAX)}

    def want(self, version: CorrectionVersion, not_before_s: float) -> None:
        """This robot needs the knots of a correction, or of a later one of that log."""
        question = self._open.get(version.log)
        if question is None or question.version < version:
            peers = {} if question is None else question.peers
            remember(self._open, version.log, _Question(version, not_before_s, True, peers=peers))
        else:
            question.for_itself = True

    def on_interest(self, peer: str, version: CorrectionVersion, now: float) -> None:
        """Another robot needs them."""
        question = self._open.get(version.log)
        if question is None or question.version < version:
            peers, for_itself = ({}, False) if question is None else (question.peers, question.for_itself)
            question = _Question(version, now, for_itself, peers=peers)
            remember(self._open, version.log, question)
        if question.asked >= ASKED_MAX and question.next_s <= now:
            question.asked = 0
        remember(question.peers, peer, now + INTEREST_S, PEERS_MAX)

    def waits(self, log: LogId, now: float) -> bool:
        """Whether another robot waits for the knots of a log."""
        question = self._open.get(log)
        return question is not None and any(until_s > now for until_s in question.peers.values())

    def on_knots(self, version: CorrectionVersion, now: float) -> list[str]:
        """Knots came; to whom they are to be passed on."""
        question = self._open.get(version.log)
        if question is None:
            return []
        if version >= question.version:
            del self._open[version.log]
        return [peer for peer, until_s in sorted(question.peers.items()) if until_s > now]

    def ask(self, now: float) -> list[Effect]:
        """Ask for what is due, each of one robot in range; other robots in turn."""
        questions: dict[str, list[CorrectionVersion]] = {}
        for question in self._open.values():
            if not question.is_due(now):
                continue
            on_the_way = [peer for peer in self._towards(question.version.term) if peer not in question.peers]
            if not on_the_way:
                continue
            asked = questions.setdefault(on_the_way[question.asked % len(on_the_way)], [])
            if len(asked) < KNOT_REQUESTS_MAX:
                asked.append(question.version)
                question.was_asked(now)
        return [Unicast(peer, KnotRequest(tuple(versions))) for peer, versions in questions.items()]
