"""Whom to ask what changed in its tables: robots whose hashes are others than this robot's own.

Rules: equal hashes say that nothing is to be asked. Of each robot in range it is known up to which change it was heard,
and later ones only are asked for; so a new neighbour costs one exchange, and one that tells nothing new is asked ever
more rarely. Answers pay for the next question with a pause, so that logs that change all the time cost a bounded rate.
Where hashes go on to differ though nothing changes, everything is asked for again, rarely.
"""

from dataclasses import dataclass

from flocc_agent.core.effects import Effect, Unicast
from flocc_agent.core.pulls import remember
from flocc_protocol.messages import LOGS_MAX, DigestRequest, Digests, Heartbeat, TableState

PERIOD_S = 0.4
"""Least pause between two questions; below a heartbeat's period, so that none waits for two."""
PERIOD_PER_ENTRY_S = 0.02
"""Further pause for each entry of the last answer: some 20 bytes each, so about a kilobyte per second at most."""
PAUSE_MAX_S = 2.0
"""A robot whose answers tell nothing new is asked at most this rarely."""
AGAIN_S = 30.0
"""Where hashes differ and nothing changes, everything is asked for again after this time."""
ANSWER_PERIOD_S = 0.2
"""A robot that asks more often than this gets no answer."""


@dataclass(slots=True)
class _Known:
    """What is known of one robot's tables: up to which changes of which start, and when it may be asked again."""

    boot: int
    digests: int = 0
    versions: int = 0
    asked_s: float = float("-inf")
    pause_s: float = PERIOD_S


class Comparisons:
    """What this robot heard of the tables of robots in range."""

    def __init__(self, neighbours_max: int) -> None:
        self._neighbours_max = neighbours_max
        self._known: dict[str, _Known] = {}
        self._answered_s: dict[str, float] = {}
        self._next_s = float("-inf")

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {
            "compared": (len(self._known), self._neighbours_max),
            "answered": (len(self._answered_s), self._neighbours_max),
        }

    def on_lost(self, peer: str) -> None:
        """A robot is out of range."""
        self._known.pop(peer, None)
        self._answered_s.pop(peer, None)

    def on_heartbeat(
        self, peer: str, heartbeat: Heartbeat, digests: TableState, versions: TableState, now: float
    ) -> list[Effect]:
        """Ask a robot for what changed, where its hashes are not this robot's own `digests` and `versions`."""
        known = self._known.get(peer)
        new = known is None or known.boot != heartbeat.boot
        if known is None or new:
            known = _Known(heartbeat.boot, asked_s=float("-inf") if known is None else known.asked_s)
            remember(self._known, peer, known, self._neighbours_max)
        if heartbeat.digests.hash == digests.hash:
            known.digests = heartbeat.digests.changes
        if heartbeat.versions.hash == versions.hash:
            known.versions = heartbeat.versions.changes
        if (heartbeat.digests.hash, heartbeat.versions.hash) == (digests.hash, versions.hash):
            return []
        if (heartbeat.digests.changes, heartbeat.versions.changes) == (known.digests, known.versions):
            if now < known.asked_s + AGAIN_S:
                return []
            known.digests = known.versions = 0
        if now < known.asked_s + known.pause_s or (now < self._next_s and not new):
            return []
        known.asked_s = now
        self._next_s = max(self._next_s, now + PERIOD_S)
        return [Unicast(peer, DigestRequest(known.digests, known.versions))]

    def on_digests(self, peer: str, message: Digests, helped: bool, now: float) -> None:
        """A robot told what changed in its tables; whether that was news."""
        known = self._known.get(peer)
        if known is None or known.boot != message.boot:
            return
        known.digests, known.versions = message.digests_through, message.versions_through
        if max(len(message.digests), len(message.versions)) == LOGS_MAX:
            return  # the rest is asked for with the next heartbeat
        known.pause_s = PERIOD_S if helped else min(2 * known.pause_s, PAUSE_MAX_S)
        entries = len(message.digests) + len(message.versions)
        self._next_s = max(self._next_s, now + PERIOD_PER_ENTRY_S * entries)

    def may_answer(self, peer: str, now: float) -> bool:
        """Whether a robot that asks gets an answer: not when it had one just now."""
        if now < self._answered_s.get(peer, float("-inf")) + ANSWER_PERIOD_S:
            return False
        self._answered_s.pop(peer, None)
        remember(self._answered_s, peer, now, self._neighbours_max)
        return True
