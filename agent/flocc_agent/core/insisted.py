"""Pairs that another robot waits for though a record of them is here, in a version of a log that it never takes.

Where a disk that went back made two versions of a log, everybody keeps the one that he heard first, so that what one
version says of a pair stays unknown to whoever holds the other. Such a robot offers the pair again and again; it is
then registered once more, and its record is in a log that both hold.
"""

from collections.abc import Collection, Iterable, Mapping

from flocc_agent.core.log_copy import LogCopy
from flocc_agent.core.pulls import remember
from flocc_protocol.ids import LogId
from flocc_protocol.messages import CandidatePair

INSISTS_S = 10.0
"""Who offers a pair for so long after its record was here did not miss a message: it takes no such record."""
OFFERED_MAX = 1024


class Insisted:
    """What is offered though it is settled here."""

    def __init__(self) -> None:
        self._since_s: dict[CandidatePair, float] = {}
        self._next_s = float("-inf")

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {"insisted": (len(self._since_s), OFFERED_MAX)}

    def among(self, offered: Iterable[CandidatePair], now: float) -> set[CandidatePair]:
        """Which of these settled pairs were offered for long; none soon after others were, since logs are then read."""
        for pair in offered:
            if pair not in self._since_s:
                remember(self._since_s, pair, now, OFFERED_MAX)
        insisted = {pair for pair in offered if self._since_s.get(pair, now) + INSISTS_S <= now}
        if not insisted or now < self._next_s:
            return set()
        self._next_s = now + INSISTS_S
        for pair in insisted:
            del self._since_s[pair]
        return insisted


def said_only_in(
    versions: Collection[LogId], own: LogId, logs: Mapping[LogId, LogCopy], pairs: set[CandidatePair]
) -> set[CandidatePair]:
    """Of some pairs those of which these logs have a record and the own log has none."""
    there = {pair for log in versions if log in logs for pair in _judged(logs[log], pairs)}
    return there - _judged(logs[own], there) if there else there


def _judged(copy: LogCopy, pairs: set[CandidatePair]) -> set[CandidatePair]:
    return pairs & {CandidatePair.of(record.query, record.match) for _, record in copy.judgements()}
