"""Whether robots that optimise together come apart: how far neighbours disagree, contact by contact.

A step says of each neighbour that it heard how far both are from each other (`own_part.Apart`). Two things bound that:
what the covariances of both allow, and what odometry can have drifted, since robots that nothing holds say of
themselves that they may be anywhere. Robots that agree bring it down, whatever they began with; those that come apart
throw each other farther at each contact. So what counts is not one disagreement, but one that lasts and does not
shrink. While there is any, a robot gives itself no correction: the last one stands, on which it agreed with others.
"""

from collections.abc import Iterable, Mapping

from flocc_agent.core.own_part import Apart
from flocc_protocol.ids import LogId

CONTACTS = 5
"""So many in a row beyond what is allowed, of which the last is not clearly smaller than the first.

Good teams had at most 3 in a row, shrinking; broken ones (`ANCHORING_FLOATING` of 1e-3) 16 to 33
(docs/distributed-mode.md)."""
SHRUNK_RATIO = 0.5
NEAR_M, DRIFTED_RATIO = 2.0, 0.1
"""How far two robots may be apart, and against both ways: several times what odometry drifts. Good teams were at most
1.5 of it apart, and that for three contacts."""
SILENT_S = 30.0
"""After so long without a word of a neighbour it does not matter how far it was."""


def beyond(apart: Apart, ways_m: float) -> float:
    """How far two robots are from each other, over what is allowed, squared.

    Args:
        apart: It.
        ways_m: Length of both ways together.
    """
    return max(apart.strain, (apart.m / (NEAR_M + DRIFTED_RATIO * ways_m)) ** 2)


class ComingApart:
    """Disagreements with neighbours that are beyond what is allowed, in the order of contacts."""

    def __init__(self) -> None:
        self._strains: dict[LogId, list[float]] = {}
        self._heard_s: dict[LogId, float] = {}

    def on_contacts(self, shares: Mapping[LogId, float], now: float) -> list[LogId]:
        """Take in how far neighbours were that a step heard.

        Args:
            shares: Disagreements over what is allowed; above 1 one is beyond that.
            now: Time, s.

        Returns:
            Those with whom this robot comes apart.
        """
        for log, share in shares.items():
            self._heard_s[log] = now
            self._strains[log] = [*self._strains.get(log, [])[1 - CONTACTS :], share] if not share <= 1.0 else []
        apart = sorted(log for log in shares if _does_not_shrink(self._strains[log]))
        self.forget(apart)
        return apart

    def forget(self, logs: Iterable[LogId]) -> None:
        """They are not heard any more."""
        for log in logs:
            self._strains.pop(log, None)
            self._heard_s.pop(log, None)

    def until_s(self) -> float:
        """Until then it disagrees with somebody beyond what is allowed, unless a contact says else."""
        strained = (self._heard_s[log] + SILENT_S for log, strains in self._strains.items() if strains)
        return max(strained, default=float("-inf"))


def _does_not_shrink(strains: list[float]) -> bool:
    return len(strains) == CONTACTS and not strains[-1] < SHRUNK_RATIO * strains[0]
