"""Which leaders are not followed: those whose signed correction cannot be true.

Others may have applied what such a leader said, so a robot that leads itself goes above its terms now and then.
"""

from dataclasses import replace

from flocc_agent.core.peer_budgets import Muted
from flocc_protocol.ids import LogId
from flocc_protocol.messages import Heartbeat

DISTRUSTED_FIRST_S, DISTRUSTED_MAX_S = 60.0, 3600.0
"""How long a leader whose signed correction cannot be true is not followed: the first time, and at most. In distributed
mode, how long neighbours are not heard with whom a robot came apart, or whose word its own log contradicts."""
OVERTAKEN_PERIOD_S = 1.0


class Distrust:
    """Leaders that are not followed, and until when."""

    def __init__(self) -> None:
        self._muted = Muted(DISTRUSTED_FIRST_S, DISTRUSTED_MAX_S)
        self._overtaken_s = float("-inf")

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return self._muted.sizes("distrusted")

    def holds(self, leader: LogId, now: float) -> bool:
        """Whether a leader is not followed now."""
        return self._muted.is_muted(leader.robot, leader.robot, now)

    def on_lie(self, leader: LogId, now: float) -> None:
        """A correction that a leader signed cannot be true."""
        self._muted.on_failed(leader.robot, leader.robot, now)

    def on_confirmed(self, leader: LogId) -> None:
        """An own solution says the same as the leader."""
        self._muted.forgive(leader.robot, leader.robot)

    def believed(self, heartbeat: Heartbeat, now: float) -> Heartbeat:
        """A heartbeat as the election hears it: without a leader that is not followed."""
        advert = heartbeat.leader
        distrusted = advert is not None and self.holds(advert.term.leader, now)
        return replace(heartbeat, leader=None) if distrusted else heartbeat

    def may_overtake(self, now: float) -> bool:
        """Whether it is time to lead above the terms of such a leader; True at most once a period."""
        if now < self._overtaken_s + OVERTAKEN_PERIOD_S:
            return False
        self._overtaken_s = now
        return True
