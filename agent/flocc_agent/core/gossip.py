"""Replicated logs: every robot owns one, holds copies of all others, and pulls what its copies lack.

Rules: a log only grows, at its end, by its owner. Copies are prefixes. Heartbeats carry how long each copy is and
its chained checksum; whoever has less asks for the rest, of whomever it heard that from. There is no state per
neighbour about what was sent, so a lost, doubled, late or reordered message can do no lasting harm.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol, TypeVar

from flocc_agent.core.effects import Effect, PersistRecord, Report, Unicast
from flocc_agent.core.parameters import GossipParameters
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import LogId
from flocc_protocol.messages import (
    RECORDS_BATCH_BYTES_MAX,
    RECORDS_BATCH_MAX,
    LogDigest,
    RecordBatch,
    RecordRequest,
)
from flocc_protocol.records import KeyframeRecord, Record, chain, decode_record, encode_record

Key = TypeVar("Key")
Entry = TypeVar("Entry")

DECODED_MAX = 1024
REMEMBERED_MAX = 1024
"""Open requests, pauses and forks that are remembered; beyond this the oldest are forgotten."""


class Sealer(Protocol):
    """Proves who wrote a record, over any number of relays. Logs hold, send and persist sealed records."""

    def seal(self, log: LogId, number: int, record: bytes) -> bytes:
        """Add this robot's proof to a record of its own log."""
        ...

    def opened(self, log: LogId, number: int, sealed: bytes) -> bytes:
        """Give the record, once its proof is checked.

        Raises:
            DecodeError: It is not a record of that log at that number.
        """
        ...


@dataclass(slots=True)
class LogCopy:
    """A prefix of one robot's log: records, their bytes, and the chained checksum before each."""

    records: list[Record] = field(default_factory=list)
    encoded: list[bytes] = field(default_factory=list)
    checksums: list[int] = field(default_factory=lambda: [0])
    keyframes: int = 0

    def __len__(self) -> int:
        return len(self.records)

    def append(self, record: Record, data: bytes) -> None:
        """Add the next record."""
        self.records.append(record)
        self.encoded.append(data)
        self.checksums.append(chain(self.checksums[-1], data))
        self.keyframes += isinstance(record, KeyframeRecord)

    def continues(self, batch: RecordBatch) -> bool:
        """Whether a batch that starts within this copy agrees with it, as far as both go."""
        held = self.encoded[batch.first : batch.first + len(batch.records)]
        same_before = self.checksums[batch.first] == batch.checksum_before
        return same_before and held == list(batch.records[: len(held)])

    def accepts(self, record: Record) -> bool:
        """Whether the record can be next: keyframes are numbered without gaps."""
        return not isinstance(record, KeyframeRecord) or record.index == self.keyframes


@dataclass(frozen=True, slots=True)
class NewRecord:
    """A record that this robot did not hold before."""

    log: LogId
    number: int
    record: Record


@dataclass(slots=True)
class _Asked:
    """An open request for a missing range."""

    peer: str
    until_s: float


class Gossip:
    """All logs that one robot holds."""

    def __init__(self, own: LogId, parameters: GossipParameters, sealer: Sealer | None = None) -> None:
        self._own = own
        self._parameters = parameters
        self._sealer = sealer
        self.logs: dict[LogId, LogCopy] = {own: LogCopy()}
        self._asked: dict[LogId, _Asked] = {}
        self._pauses_s: dict[tuple[LogId, str], float] = {}
        self._not_before_s: dict[tuple[LogId, str], float] = {}
        self._forked: dict[tuple[LogId, str], None] = {}
        self._agreed: dict[LogId, LogDigest] = {}
        self._told: dict[tuple[str, str], None] = {}
        self._digests: tuple[LogDigest, ...] | None = None

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {
            "logs": (len(self.logs), self._parameters.logs_max),
            "asked": (len(self._asked), REMEMBERED_MAX),
            "paused": (len(self._not_before_s), REMEMBERED_MAX),
            "forked": (len(self._forked), REMEMBERED_MAX),
            "refused": (len(self._told), REMEMBERED_MAX),
            "agreed": (len(self._agreed), REMEMBERED_MAX),
        }

    def restore(self, log: LogId, data: bytes) -> NewRecord:
        """Put back a record that was read from disk, in order."""
        copy = self.logs.setdefault(log, LogCopy())
        record = decode_record(self._opened(log, len(copy), data))
        copy.append(record, data)
        self._digests = None
        return NewRecord(log, len(copy) - 1, record)

    def append(self, record: Record) -> tuple[NewRecord, list[Effect], RecordBatch]:
        """Add a record to the own log: persist it, then send the batch."""
        copy = self.logs[self._own]
        number, before = len(copy), copy.checksums[-1]
        data = encode_record(record)
        if self._sealer is not None:
            data = self._sealer.seal(self._own, number, data)
        assert copy.accepts(record), "own keyframes are numbered without gaps"
        copy.append(record, data)
        self._digests = None
        batch = RecordBatch(self._own, number, before, (data,))
        return NewRecord(self._own, number, record), [PersistRecord(self._own, number, data)], batch

    def digests(self) -> tuple[LogDigest, ...]:
        """What this robot holds, for its heartbeat."""
        if self._digests is None:
            self._digests = tuple(
                LogDigest(log, len(copy), copy.checksums[-1]) for log, copy in sorted(self.logs.items()) if len(copy)
            )
        return self._digests

    def on_digests(self, sender: LogId, digests: tuple[LogDigest, ...], now: float) -> list[Effect]:
        """Ask the sender for what it has more of."""
        effects: list[Effect] = []
        for digest in digests if digests != self._digests else ():
            if digest is self._agreed.get(digest.log):
                continue
            copy = self.logs.get(digest.log)
            held = len(copy) if copy else 0
            if digest.count > held:
                effects += self._behind(sender.robot, digest.log, held, now)
            elif copy is not None and copy.checksums[digest.count] != digest.checksum:
                effects += self._fork(sender.robot, digest.log, "two writers of one log")
            else:
                remember(self._agreed, digest.log, digest)
        return effects

    def _behind(self, peer: str, log: LogId, held: int, now: float) -> list[Effect]:
        """Another robot has more of a log: ask for it, unless only this robot can have written it."""
        if log == self._own:
            return self._fork(peer, log, "others hold more of this robot's own log")
        if log not in self.logs and len(self.logs) >= self._parameters.logs_max:
            return self._refused(peer, "too many logs")
        return self._ask(peer, log, held, now)

    def on_request(self, sender: LogId, request: RecordRequest) -> list[Effect]:
        """Send what follows, as much as fits a message."""
        copy = self.logs.get(request.log)
        if copy is None or request.first >= len(copy):
            return []
        following = copy.encoded[request.first : request.first + RECORDS_BATCH_MAX]
        batch = RecordBatch.of(request.log, request.first, copy.checksums[request.first], following)
        return [Unicast(sender.robot, batch)]

    def on_batch(self, sender: LogId, batch: RecordBatch, now: float) -> tuple[list[NewRecord], list[Effect]]:
        """Take over what is new; ask on for what still lacks."""
        if batch.log == self._own:
            return [], self._own_log_elsewhere(sender, batch)
        copy = self.logs.get(batch.log) or LogCopy()
        if batch.first > len(copy):
            return [], self._behind(sender.robot, batch.log, len(copy), now)
        if not copy.continues(batch):
            return [], self._fork(sender.robot, batch.log, "two writers of one log")
        if batch.log not in self.logs and len(self.logs) >= self._parameters.logs_max:
            return [], self._refused(sender.robot, "too many logs")
        new, effects = self._take(sender.robot, copy, batch)
        if new:
            self.logs[batch.log] = copy
            self._digests = None
        self._answered(sender.robot, batch, bool(new))
        if new and len(batch.records) > 1:
            effects += self._ask_on(sender, batch, now)
        return new, effects

    def _take(self, peer: str, copy: LogCopy, batch: RecordBatch) -> tuple[list[NewRecord], list[Effect]]:
        new: list[NewRecord] = []
        effects: list[Effect] = []
        for data in batch.records[len(copy) - batch.first :]:
            try:
                record = decoded(self._opened(batch.log, len(copy), data))
            except DecodeError as error:
                return new, [*effects, *self._refused(peer, f"bad record of {batch.log}: {error}")]
            if not copy.accepts(record) or len(copy) >= self._parameters.records_max:
                return new, [*effects, *self._refused(peer, f"record of {batch.log} out of place")]
            number = len(copy)
            copy.append(record, data)
            new.append(NewRecord(batch.log, number, record))
            effects.append(PersistRecord(batch.log, number, data))
        return new, effects

    def _opened(self, log: LogId, number: int, data: bytes) -> bytes:
        return data if self._sealer is None else self._sealer.opened(log, number, data)

    def _ask(self, peer: str, log: LogId, first: int, now: float) -> list[Effect]:
        """Ask one peer at a time for one log; a peer that did not deliver waits longer each time."""
        if (log, peer) in self._forked:
            return []
        asked = self._asked.get(log)
        if asked is not None and now < asked.until_s:
            return []
        if asked is not None:
            self._did_not_deliver(log, asked.peer, now)
        if now < self._not_before_s.get((log, peer), now):
            return []
        remember(self._asked, log, _Asked(peer, now + self._parameters.request_timeout_s))
        return [Unicast(peer, RecordRequest(log, first))]

    def _ask_on(self, sender: LogId, batch: RecordBatch, now: float) -> list[Effect]:
        """A full batch has a successor; ask for it without waiting for the next heartbeat."""
        size = sum(map(len, batch.records))
        if len(batch.records) < RECORDS_BATCH_MAX and size < RECORDS_BATCH_BYTES_MAX // 2:
            return []
        return self._ask(sender.robot, batch.log, len(self.logs[batch.log]), now)

    def _answered(self, peer: str, batch: RecordBatch, helped: bool) -> None:
        asked = self._asked.get(batch.log)
        if asked is not None and asked.peer == peer:
            del self._asked[batch.log]
        if helped:
            self._pauses_s.pop((batch.log, peer), None)
            self._not_before_s.pop((batch.log, peer), None)

    def _did_not_deliver(self, log: LogId, peer: str, now: float) -> None:
        del self._asked[log]
        pause = min(2 * self._pauses_s.get((log, peer), 0.125), self._parameters.backoff_max_s)
        remember(self._pauses_s, (log, peer), pause)
        remember(self._not_before_s, (log, peer), now + pause)

    def _own_log_elsewhere(self, sender: LogId, batch: RecordBatch) -> list[Effect]:
        """Only this robot writes its log; a copy that differs means a second writer."""
        own = self.logs[self._own]
        end = batch.first + len(batch.records)
        if end <= len(own) and tuple(own.encoded[batch.first : end]) == batch.records:
            return []
        return self._fork(sender.robot, batch.log, "others hold more of this robot's own log")

    def _fork(self, peer: str, log: LogId, reason: str) -> list[Effect]:
        """A copy that contradicts this one: keep this one, take nothing of it from that peer, say so once."""
        if (log, peer) in self._forked:
            return []
        remember(self._forked, (log, peer), None)
        return [Report("log_forked", {"peer": peer, "log": str(log), "reason": reason})]

    def _refused(self, peer: str, reason: str) -> list[Effect]:
        """Say once per peer and reason what was refused."""
        if (peer, reason) in self._told:
            return []
        remember(self._told, (peer, reason), None)
        return [Report("peer_refused", {"peer": peer, "reason": reason})]


def remember(entries: dict[Key, Entry], key: Key, entry: Entry, entries_max: int = REMEMBERED_MAX) -> None:
    """Note an entry and forget the oldest ones beyond the maximum: strangers must not fill the memory."""
    entries[key] = entry
    while len(entries) > entries_max:
        del entries[next(iter(entries))]


@lru_cache(maxsize=DECODED_MAX)
def decoded(data: bytes) -> Record:
    """A record, decoded once where several copies of a log live in one process."""
    return decode_record(data)
