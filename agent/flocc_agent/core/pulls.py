"""Whom to ask for records that this robot's copies lack.

Rules: one peer at a time is asked for one log; one request names all logs that a peer is to send; requests that a
heartbeat calls for have a least pause between them, so that news of many logs are fetched together. A peer that did
not deliver what it claims is asked ever more rarely. Answers go on until everything is here, without a pause. The last
few records of a robot in range are not asked of others as long as its own broadcast may still come.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from flocc_agent.core.effects import Effect, Unicast
from flocc_agent.core.parameters import GossipParameters
from flocc_protocol.ids import LogId
from flocc_protocol.messages import BATCHES_MAX, LogPosition, RecordRequest

Key = TypeVar("Key")
Entry = TypeVar("Entry")

REMEMBERED_MAX = 1024
"""Open requests and pauses that are remembered; beyond this the oldest are forgotten."""
PEERS_MAX = 128
BROADCAST_RECORDS = 3
BROADCAST_S = 0.2
"""A robot in range sends its last few records itself; others who heard them sooner are asked only after this time."""
FIRST_PAUSE_S = 0.25
BACKOFF_MAX_S = 8.0
"""A peer that does not deliver what it claims is asked at most this rarely, so that it costs nobody else's news."""
REQUEST_PERIOD_S = 0.4
"""Least pause between requests for news that heartbeats tell of; below a heartbeat's period, so none waits for two."""
REQUEST_TIMEOUT_S = 1.0
"""A missing range is asked for again, of anybody, after this time: a round trip under load and one lost message."""


@dataclass(slots=True)
class _Asked:
    """An open request for a log's missing records, from a number on."""

    peer: str
    until_s: float
    first: int


class Pulls:
    """What others hold beyond this robot's copies, and what was asked of them."""

    def __init__(
        self, held: Callable[[LogId], int], near: Callable[[str, float], bool], parameters: GossipParameters
    ) -> None:
        """Start with nothing to ask for.

        Args:
            held: How many records of a log this robot holds.
            near: Whether a robot of this name was in range when it wrote what it broadcasts at that time.
            parameters: Limits and times.
        """
        self._held = held
        self._near = near
        self._parameters = parameters
        self._ahead: dict[str, dict[LogId, int]] = {}
        self._noticed: dict[LogId, tuple[int, float]] = {}
        self._asked: dict[LogId, _Asked] = {}
        self._pauses_s: dict[tuple[LogId, str], float] = {}
        self._not_before_s: dict[tuple[LogId, str], float] = {}
        self._next_s = float("-inf")

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        longest = max(map(len, self._ahead.values()), default=0)
        return {
            "ahead": (longest, self._parameters.logs_max),
            "peers_ahead": (len(self._ahead), PEERS_MAX),
            "noticed": (len(self._noticed), REMEMBERED_MAX),
            "asked": (len(self._asked), REMEMBERED_MAX),
            "paused": (len(self._not_before_s), REMEMBERED_MAX),
        }

    def on_ahead(self, peer: str, log: LogId, count: int) -> None:
        """A peer holds so many records of a log, more than this robot."""
        if peer not in self._ahead:
            remember(self._ahead, peer, {}, PEERS_MAX)
        remember(self._ahead[peer], log, count, self._parameters.logs_max)

    def on_level(self, peer: str, log: LogId) -> None:
        """A peer has nothing more of a log, or nothing that can be used."""
        ahead = self._ahead.get(peer)
        if ahead is not None and ahead.pop(log, None) is not None and not ahead:
            del self._ahead[peer]

    def forget(self, log: LogId) -> None:
        """A log is of no interest any more."""
        for peer in list(self._ahead):
            self.on_level(peer, log)

    def on_lost(self, peer: str) -> None:
        """A peer is out of range; what it was to send may be asked of others at once."""
        self._ahead.pop(peer, None)
        for log in [log for log, asked in self._asked.items() if asked.peer == peer]:
            del self._asked[log]

    def on_answer(self, peer: str, log: LogId, helped: bool) -> None:
        """A peer sent records of a log, new ones or others."""
        asked = self._asked.get(log)
        if asked is not None and asked.peer == peer:
            del self._asked[log]
        if helped:
            self._pauses_s.pop((log, peer), None)
            self._not_before_s.pop((log, peer), None)

    def ask(self, now: float, at_once: bool = False) -> list[Effect]:
        """Ask whoever is ahead, those with the most first, unless that was done just now or it is to be at once."""
        if not self._ahead or (now < self._next_s and not at_once):
            return []
        effects: list[Effect] = []
        for peer in sorted(self._ahead, key=lambda peer: (-len(self._ahead[peer]), peer)):
            effects += self._request(peer, now, again=False)
        if effects:
            self._next_s = now + REQUEST_PERIOD_S
        return effects

    def ask_on(self, peer: str, now: float, left_out: bool) -> list[Effect]:
        """A peer's answer was as long as a message may be, or shows a gap: ask at once for what lacks.

        What was asked of it already is asked again only where the answer left logs out, so that many records behind
        one gap call for one request.
        """
        return self._request(peer, now, again=True, repeats=left_out)

    def _request(self, peer: str, now: float, again: bool, repeats: bool = False) -> list[Effect]:
        positions: list[LogPosition] = []
        for log, count in sorted(self._ahead.get(peer, {}).items()):
            held = self._held(log)
            if count <= held:
                self.on_level(peer, log)
            elif not again and self._is_on_its_way(log, held, count, now):
                continue
            elif len(positions) < BATCHES_MAX and self._may_ask(peer, log, now, again, repeats):
                remember(self._asked, log, _Asked(peer, now + REQUEST_TIMEOUT_S, held))
                positions.append(LogPosition(log, held))
        return [Unicast(peer, RecordRequest(tuple(positions)))] if positions else []

    def _is_on_its_way(self, log: LogId, held: int, count: int, now: float) -> bool:
        """Whether the records may still come from their writer, who broadcasts them."""
        if count - held > BROADCAST_RECORDS or not self._near(log.robot, now):
            return False
        noticed = self._noticed.get(log)
        if noticed is None or noticed[0] != held:
            noticed = (held, now)
            remember(self._noticed, log, noticed)
        return noticed[1] + BROADCAST_S > now

    def _may_ask(self, peer: str, log: LogId, now: float, again: bool, repeats: bool) -> bool:
        """Whether nobody else is to send the log, and the peer did not disappoint just now."""
        asked = self._asked.get(log)
        if asked is not None:
            if asked.until_s > now:
                return again and asked.peer == peer and (repeats or self._held(log) > asked.first)
            self._did_not_deliver(log, asked.peer, now)
        return self._not_before_s.get((log, peer), now) <= now

    def _did_not_deliver(self, log: LogId, peer: str, now: float) -> None:
        del self._asked[log]
        pause_s = min(2 * self._pauses_s.get((log, peer), FIRST_PAUSE_S / 2), BACKOFF_MAX_S)
        remember(self._pauses_s, (log, peer), pause_s)
        remember(self._not_before_s, (log, peer), now + pause_s)


def remember(entries: dict[Key, Entry], key: Key, entry: Entry, entries_max: int = REMEMBERED_MAX) -> None:
    """Note an entry and forget the oldest ones beyond the maximum: strangers must not fill the memory."""
    entries[key] = entry
    while len(entries) > entries_max:
        del entries[next(iter(entries))]
