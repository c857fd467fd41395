"""Replicated logs: every robot owns one, holds copies of all others, and pulls what its copies lack.

Rules: a log only grows, at its end, by its owner. Copies are prefixes. Heartbeats carry one hash of how long all copies
are and of their chained checksums; whoever has another hash asks what changed, and whoever has less of a log asks for
the rest, of whomever it heard that from. There is no state per neighbour about what was sent, so a lost, doubled, late
or reordered message can do no lasting harm.
What is said of this robot's own log is only a reason to ask for the records; a record that this robot did not write
is what shows that somebody else writes its log.
"""

from collections.abc import Callable, Collection, Iterable
from typing import NamedTuple, Protocol

from flocc_agent.core.announcing import Announcer
from flocc_agent.core.claims import RecordClaim
from flocc_agent.core.cold_storage import ColdPieces
from flocc_agent.core.effects import Effect, PersistRecord, Report, Unicast
from flocc_agent.core.log_copy import LogCopy, decoded
from flocc_agent.core.parameters import GossipParameters
from flocc_agent.core.pulls import REMEMBERED_MAX, REQUEST_TIMEOUT_S, Pulls, remember
from flocc_agent.core.reports import LogForked, PeerRefused
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import LogId
from flocc_protocol.messages import (
    LOGS_MAX,
    RECORDS_BATCH_BYTES_MAX,
    RECORDS_BATCH_MAX,
    LogDigest,
    LogPosition,
    RecordBatch,
    RecordRequest,
    Records,
    TableState,
)
from flocc_protocol.records import Record, decode_record, encode_record

RECORDS_MAX = 200_000
"""Records that are kept of one log: a keyframe and a closure each second for a day. Further ones are refused."""
LIVES_MAX = 16
"""Logs that are kept of one robot name: as often may it lose its disk while the swarm remembers it."""
FIRST_LIVES_RATIO = 0.25
"""Share of all places that only names have which hold none yet: some that fill theirs keep no further robot out."""


class Sealer(Protocol):
    """Proves who wrote a record or made a correction, over any number of relays.

    Logs hold, send and persist sealed records; a correction carries its leader's signature.
    """

    def seal(self, log: LogId, number: int, record: bytes) -> bytes:
        """Add this robot's proof to a record of its own log."""
        ...

    def opened(self, log: LogId, number: int, sealed: bytes) -> bytes:
        """Give the record, once its proof is checked.

        Raises:
            DecodeError: It is not a record of that log at that number.
        """
        ...

    def sign_correction(self, correction: bytes) -> bytes:
        """This robot's signature of a correction that it made as a leader."""
        ...

    def check_correction(self, leader: LogId, correction: bytes, signature: bytes) -> None:
        """Check who made a correction.

        Raises:
            DecodeError: It is not that leader's.
        """
        ...


class NewRecord(NamedTuple):
    """A record that this robot did not hold before."""

    log: LogId
    number: int
    record: Record


class Gossip:
    """All logs that one robot holds.

    Attributes:
        logs: Its copies, and its own.
        failed_signers: Robots whose records the swarm's keys did not open, until somebody clears it.
        wanting_room: A log that was not taken in since there is no room for it, until somebody clears it.
        given_up: Logs that made room for others; they are taken in again once their writer is heard.
    """

    def __init__(
        self,
        own: LogId,
        parameters: GossipParameters,
        sealer: Sealer | None = None,
        near: Callable[[str, float], bool] = lambda robot, now: False,  # noqa: ARG005
        cold: ColdPieces | None = None,
    ) -> None:
        """Start with an empty log.

        Args:
            own: The log that this robot writes.
            parameters: Limits and times.
            sealer: Signs and checks records, where the swarm has keys.
            near: Whether a robot of this name was in range when it wrote what it broadcasts at that time.
            cold: Where old blocks of records go; None: all stay in memory.
        """
        self._cold = cold
        self._own = own
        self._parameters = parameters
        self._sealer = sealer
        self.failed_signers: set[str] = set()
        self.logs: dict[LogId, LogCopy] = {own: LogCopy(cold)}
        self._pulls = Pulls(self._held, near, parameters)
        self._forked: dict[tuple[LogId, str], None] = {}
        self._told: dict[tuple[str, str], None] = {}
        self._announcer: Announcer[LogDigest] = Announcer()
        self._doubted_until_s: dict[str, float] = {}
        self.wanting_room: LogId | None = None
        self.given_up: dict[LogId, None] = {}
        self._grown_s: dict[LogId, float] = {}

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {
            "logs": (len(self.logs), self._parameters.logs_max),
            **self._pulls.sizes(),
            "forked": (len(self._forked), REMEMBERED_MAX),
            "refused": (len(self._told), REMEMBERED_MAX),
            **({} if self._cold is None else {"warm_record_blocks": self._cold.size()}),
            "doubted": (len(self._doubted_until_s), REMEMBERED_MAX),
            "given_up": (len(self.given_up), REMEMBERED_MAX),
        }

    def restore(self, log: LogId, data: bytes) -> NewRecord:
        """Put back a record that was read from disk, in order.

        Raises:
            DecodeError: It is none, or the swarm's keys do not open it.
        """
        opened = self._opened(log, self._held(log), data)
        record = decode_record(opened)
        copy = self.logs.setdefault(log, LogCopy(self._cold))
        copy.append(data, len(data) - len(opened))
        self._announce(log, copy)
        return NewRecord(log, len(copy) - 1, record)

    def append(self, record: Record) -> tuple[NewRecord, list[Effect], RecordBatch]:
        """Add a record to the own log: persist it, then send the batch."""
        copy = self.logs[self._own]
        number, before = len(copy), copy.checksum
        encoded = encode_record(record)
        data = encoded if self._sealer is None else self._sealer.seal(self._own, number, encoded)
        assert copy.accepts(record), "own keyframes are numbered without gaps"
        copy.append(data, len(data) - len(encoded))
        self._announce(self._own, copy)
        batch = RecordBatch(self._own, number, before, (data,))
        return NewRecord(self._own, number, record), [PersistRecord(self._own, number, data)], batch

    def digests(self) -> tuple[LogDigest, ...]:
        """What this robot holds."""
        return self._announcer.all()

    def state(self) -> TableState:
        """All of that, as a heartbeat says it."""
        return self._announcer.state()

    def digests_since(self, changes: int) -> tuple[int, tuple[LogDigest, ...]]:
        """What of it changed after so many changes, as far as one message tells, and up to which change that is."""
        return self._announcer.since(changes, LOGS_MAX)

    def has_news(self, digests: tuple[LogDigest, ...]) -> bool:
        """Whether somebody holds more than this robot."""
        return any(digest.count > self._held(digest.log) for digest in digests if digest.log not in self.given_up)

    def forget(self, log: LogId) -> None:
        """Hold nothing more of another robot's log, nor take it from those who do."""
        assert log != self._own
        del self.logs[log]
        self._grown_s.pop(log, None)
        self._announcer.remove(log)
        self._pulls.forget(log)
        remember(self.given_up, log, None)

    def held_otherwise_by(self, peer: str) -> list[LogId]:
        """Other robots' logs of which a peer was seen to hold another version, which neither of the two takes."""
        return sorted(log for log, other in self._forked if other == peer and log != self._own)

    def silent_s(self, log: LogId, now: float) -> float:
        """For how long nothing new of a log came; counted from the first question where that is not known."""
        return now - self._grown_s.setdefault(log, now)

    def on_lost(self, peer: str) -> None:
        """A robot is out of range."""
        self._pulls.on_lost(peer)

    def on_digests(
        self, sender: LogId, digests: tuple[LogDigest, ...], now: float, at_once: bool = False
    ) -> list[Effect]:
        """Ask for what others have more of; at once where the digests were asked for."""
        if sender in self.given_up and any(digest.log == sender for digest in digests):
            del self.given_up[sender]
        effects = [effect for digest in digests for effect in self._on_digest(sender.robot, digest, now)]
        return effects + self._pulls.ask(now, at_once)

    def _on_digest(self, peer: str, digest: LogDigest, now: float) -> list[Effect]:
        log, count, checksum = digest
        copy = self.logs.get(log)
        if copy is None or count > len(copy):
            return self._behind(peer, log, count) if count else []
        self._pulls.on_level(peer, log)
        if copy.checksum_at(count) != checksum:
            if log == self._own:
                return self._doubt(peer, count, now)
            return self._fork(peer, log, "two writers of one log")
        return []

    def _behind(self, peer: str, log: LogId, count: int) -> list[Effect]:
        """Another robot has more of a log, or says so: note whom to ask."""
        if log in self.given_up:
            return []
        refusal = self._no_room(log)
        if refusal is not None:
            self.wanting_room = log
            return self._refused(peer, refusal)
        if (log, peer) not in self._forked:
            self._pulls.on_ahead(peer, log, count)
        return []

    def _no_room(self, log: LogId) -> str | None:
        """Why a log cannot be taken in; None when it can, or is here. No robot takes the room of all others."""
        if log in self.logs:
            return None
        if may_hold(self.logs, log, self._parameters.logs_max):
            return None
        return "too many logs of one robot" if lives(self.logs, log.robot) else "too many logs"

    def on_request(self, sender: LogId, request: RecordRequest) -> list[Effect]:
        """Send what follows, as much of all logs as fits a message."""
        batches: list[RecordBatch] = []
        room = RECORDS_BATCH_BYTES_MAX
        for log, first in request.positions:
            copy = self.logs.get(log)
            if copy is None or first >= len(copy):
                continue
            following = copy.encoded[first : first + RECORDS_BATCH_MAX]
            batch = RecordBatch.of(log, first, copy.checksum_at(first), following, room)
            if not batch.records:
                break
            room -= batch.size_bytes
            batches.append(batch)
        return [Unicast(sender.robot, Records(tuple(batches)))] if batches else []

    def on_records(self, sender: LogId, message: Records, now: float) -> tuple[list[NewRecord], list[Effect]]:
        """Take over what is new; ask on for what still lacks."""
        new: list[NewRecord] = []
        effects: list[Effect] = []
        for batch in message.batches:
            news, more = self._on_batch(sender, batch, now)
            new += news
            effects += more
        gap = any(batch.first > self._held(batch.log) for batch in message.batches)
        left_out = bool(new) and _is_full(message)
        if gap or left_out:
            effects += self._pulls.ask_on(sender.robot, now, left_out)
        return new, effects

    def claims(self, batch: RecordBatch) -> list[RecordClaim]:
        """Records of a batch whose signatures `on_records` would check: those that could be taken in."""
        copy = self.logs.get(batch.log)
        known = [] if copy is None else copy.encoded[batch.first : batch.first + len(batch.records)]
        if batch.log != self._own:
            is_gap = batch.first > self._held(batch.log)
            if is_gap or batch.log in self.given_up or self._no_room(batch.log) is not None:
                return []
            if copy is not None and not copy.agrees(batch.first, batch.checksum_before, batch.records):
                return []
        new = [k for k, data in enumerate(batch.records) if k >= len(known) or known[k] != data]
        return [RecordClaim(batch.log, batch.first + k, batch.records[k]) for k in new]

    def _on_batch(self, sender: LogId, batch: RecordBatch, now: float) -> tuple[list[NewRecord], list[Effect]]:
        peer = sender.robot
        if batch.log == self._own:
            return [], self._own_log_elsewhere(peer, batch, now)
        copy = self.logs.get(batch.log)
        if copy is None:
            copy = LogCopy(self._cold)
        if batch.first > len(copy):
            return [], self._behind(peer, batch.log, batch.first + len(batch.records))
        if not copy.agrees(batch.first, batch.checksum_before, batch.records):
            self._pulls.on_level(peer, batch.log)
            return [], self._fork(peer, batch.log, "two writers of one log")
        if batch.log in self.given_up:
            return [], []
        refusal = self._no_room(batch.log)
        if refusal is not None:
            self.wanting_room = batch.log
            return [], self._refused(peer, refusal)
        new, effects = self._take(peer, copy, batch)
        if new:
            self.logs[batch.log] = copy
            self._grown_s[batch.log] = now
            self._announce(batch.log, copy)
        self._pulls.on_answer(peer, batch.log, bool(new))
        return new, effects

    def _take(self, peer: str, copy: LogCopy, batch: RecordBatch) -> tuple[list[NewRecord], list[Effect]]:
        log, new = batch.log, list[NewRecord]()
        effects: list[Effect] = []
        held = len(copy)
        for number, data in enumerate(batch.records[held - batch.first :], held):
            try:
                opened = data if self._sealer is None else self._opened(log, number, data)
                record = decoded(opened)
            except DecodeError as error:
                return new, [*effects, *self._refused(peer, f"bad record of {log}: {error}")]
            if not copy.accepts(record) or number >= RECORDS_MAX:
                return new, [*effects, *self._refused(peer, f"record of {log} out of place")]
            copy.append(data, len(data) - len(opened))
            new.append(NewRecord(log, number, record))
            effects.append(PersistRecord(log, number, data))
        return new, effects

    def _held(self, log: LogId) -> int:
        copy = self.logs.get(log)
        return 0 if copy is None else len(copy)

    def _announce(self, log: LogId, copy: LogCopy) -> None:
        self._announcer.put(log, LogDigest(log, len(copy), copy.checksum))

    def _opened(self, log: LogId, number: int, data: bytes) -> bytes:
        if self._sealer is None:
            return data
        try:
            return self._sealer.opened(log, number, data)
        except DecodeError:
            self.failed_signers.add(log.robot)
            raise

    def _doubt(self, peer: str, end: int, now: float) -> list[Effect]:
        """Ask for a peer's copy of the own log before this number, which it says is another one."""
        if self._doubted_until_s.get(peer, now) > now or (self._own, peer) in self._forked:
            return []
        remember(self._doubted_until_s, peer, now + REQUEST_TIMEOUT_S)
        return [Unicast(peer, RecordRequest((LogPosition(self._own, max(0, end - RECORDS_BATCH_MAX)),)))]

    def _own_log_elsewhere(self, peer: str, batch: RecordBatch, now: float) -> list[Effect]:
        """Only this robot writes its log; a record that it did not write, and that is sound, means a second writer."""
        own = self.logs[self._own]
        for number, data in enumerate(batch.records, batch.first):
            if number < len(own) and own.encoded[number] == data:
                continue
            try:
                decode_record(self._opened(self._own, number, data))
            except DecodeError as error:
                return self._refused(peer, f"bad record of {self._own}: {error}")
            return self._fork(peer, self._own, "others hold records of this robot's log that it did not write")
        if 0 < batch.first <= len(own) and own.checksum_at(batch.first) != batch.checksum_before:
            self._doubted_until_s.pop(peer, None)
            return self._doubt(peer, batch.first, now)
        return []

    def _fork(self, peer: str, log: LogId, reason: str) -> list[Effect]:
        """A copy that contradicts this one: keep this one, take nothing of it from that peer, say so once."""
        if (log, peer) in self._forked:
            return []
        remember(self._forked, (log, peer), None)
        return [Report(LogForked(peer=peer, log=log, reason=reason))]

    def _refused(self, peer: str, reason: str) -> list[Effect]:
        """Say once per peer and reason what was refused."""
        if (peer, reason) in self._told:
            return []
        remember(self._told, (peer, reason), None)
        return [Report(PeerRefused(peer=peer, reason=reason))]


def lives(logs: Iterable[LogId], robot: str) -> int:
    """How many of these logs are of one robot name."""
    return sum(log.robot == robot for log in logs)


def may_hold(logs: Collection[LogId], log: LogId, logs_max: int) -> bool:
    """Whether there is room for one more log: the last places are for names that hold none."""
    held = lives(logs, log.robot)
    if not held:
        return len(logs) < logs_max
    return held < LIVES_MAX and len(logs) < (1.0 - FIRST_LIVES_RATIO) * logs_max


def _is_full(message: Records) -> bool:
    """Whether something may have been left out because a message holds no more."""
    sizes = [batch.size_bytes for batch in message.batches]
    many = any(len(batch.records) == RECORDS_BATCH_MAX for batch in message.batches)
    return many or sum(sizes) >= RECORDS_BATCH_BYTES_MAX // 2
