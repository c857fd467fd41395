"""Whom to ask for knots, and for whom: over robots that are ever nearer to the leader, and back the same way.

Rules: who is asked for knots that it does not hold remembers the asker for a few seconds and asks the robot next on the
way to the leader; what comes is passed on and kept. One log is asked for once at a time, so no question runs in
circles; a question that nobody answers is asked of another robot after a pause.
"""

from collections.abc import Callable, Container
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
"""Times that one version is asked for quickly; a robot that needs it goes on every `RARELY_S`: no other may come."""
RARELY_S = 8.0


@dataclass(slots=True)
class _Question:
    """Knots that are wanted: which, for whom, how often asked for, and when again."""

    version: CorrectionVersion
    next_s: float
    own: bool = False
    asked: int = 0
    peers: dict[str, float] = field(default_factory=dict)

    def is_given_up(self) -> bool:
        """Whether it was asked for often enough, for others."""
        return self.asked >= ASKED_MAX and not self.own

    def waiting(self, now: float) -> list[str]:
        """Robots that asked not long ago; these do not have the knots. Who asked before may have them by now."""
        return [peer for peer, until_s in sorted(self.peers.items()) if until_s > now]


class KnotRequests:
    """Questions for knots that are open at one robot."""

    def __init__(self, towards: Callable[[Term], list[str]]) -> None:
        """Start with none.

        Args:
            towards: Robots in range, those that are nearest to the leader of a term first.
        """
        self._towards = towards
        self._open: dict[LogId, _Question] = {}
        self._due_s = float("-inf")

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        longest = max((len(question.peers) for question in self._open.values()), default=0)
        return {"knot_questions": (len(self._open), REMEMBERED_MAX), "knot_askers": (longest, PEERS_MAX)}

    def want(self, version: CorrectionVersion, not_before_s: float) -> None:
        """This robot needs the knots of a correction, or of a later one of that log."""
        question = self._open.get(version.log)
        if question is not None and question.version >= version and question.own:
            return
        self._due_s = float("-inf")
        if question is None or question.version < version:
            peers = {} if question is None else question.peers
            remember(self._open, version.log, _Question(version, not_before_s, own=True, peers=peers))
        else:
            question.own = True

    def keep(self, logs: Container[LogId]) -> None:
        """This robot itself needs the knots of no other logs than these."""
        for log, question in list(self._open.items()):
            question.own &= log in logs
            if not (question.own or question.peers):
                del self._open[log]

    def on_interest(self, peer: str, version: CorrectionVersion, now: float) -> None:
        """Another robot needs them."""
        question = self._open.get(version.log)
        if question is None or question.version < version:
            peers = {} if question is None else question.peers
            question = _Question(version, now, own=question is not None and question.own, peers=peers)
            remember(self._open, version.log, question)
        if question.asked >= ASKED_MAX and question.next_s <= now:
            question.asked = 0
        self._due_s = float("-inf")
        remember(question.peers, peer, now + INTEREST_S, PEERS_MAX)

    def waits(self, log: LogId, now: float) -> bool:
        """Whether another robot waits for the knots of a log."""
        question = self._open.get(log)
        return question is not None and bool(question.waiting(now))

    def on_knots(self, version: CorrectionVersion, now: float) -> list[str]:
        """Knots came; to whom they are to be passed on."""
        question = self._open.get(version.log)
        if question is None:
            return []
        if version >= question.version:
            del self._open[version.log]
        return question.waiting(now)

    def ask(self, now: float) -> list[Effect]:
        """Ask for what is due, each of one robot in range; other robots in turn."""
        if now < self._due_s:
            return []
        questions: dict[str, list[CorrectionVersion]] = {}
        for question in self._open.values():
            if question.next_s > now or question.is_given_up():
                continue
            waiting = question.waiting(now)
            on_the_way = [peer for peer in self._towards(question.version.term) if peer not in waiting]
            if not on_the_way:
                continue
            asked = questions.setdefault(on_the_way[question.asked % len(on_the_way)], [])
            if len(asked) < KNOT_REQUESTS_MAX:
                asked.append(question.version)
                question.asked += 1
                question.next_s = now + (REQUEST_TIMEOUT_S if question.asked < ASKED_MAX else RARELY_S)
        open_ = (question.next_s for question in self._open.values() if not question.is_given_up())
        self._due_s = min(open_, default=float("inf"))
        return [Unicast(peer, KnotRequest(tuple(versions))) for peer, versions in questions.items()]
