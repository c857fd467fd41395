"""Between the core and the store: what a robot keeps, and what it finds when it starts."""

import asyncio
import logging
from collections.abc import Iterable, Mapping
from typing import assert_never

from flocc_agent.core.effects import DropLog, PersistCorrection, PersistRecord, PersistTerm
from flocc_agent.core.gossip import Sealer
from flocc_agent.core.restored import Restored
from flocc_agent.runtime.map_folder import BadMap, MapFolder, longer_copy
from flocc_agent.runtime.store import Store, StoredRecord
from flocc_agent.runtime.stored_correction import correction_in, stored
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import LogId
from flocc_protocol.messages import BATCHES_MAX, RECORDS_BATCH_MAX, LogCorrection, encode_correction
from flocc_protocol.records import decode_record

logger = logging.getLogger(__name__)

Persist = PersistRecord | PersistTerm | PersistCorrection | DropLog

FRAME_CHANGED = "frame_changed"
"""Fact: the kept correction, or one that was about to be kept, changed the map frame."""
COPIES_MAX = 256
COPIES_PERIOD_S = 0.5
"""Copies of others' records are written so many, and what one message adds, or so long at a time."""


class DiskQueue:
    """What is to be kept and is not on the disk yet.

    What the robot itself says must be there before anybody hears of it; copies of others' records may wait and be
    written many at a time, since what a crash loses of them comes again.
    """

    def __init__(self, store: Store, now_s: float) -> None:
        self._store = store
        self._waiting: list[Persist] = []
        self._due_s = now_s

    def __len__(self) -> int:
        return len(self._waiting)

    def size(self) -> tuple[int, int]:
        """How much waits, and at most."""
        return len(self), COPIES_MAX + BATCHES_MAX * RECORDS_BATCH_MAX

    def due_s(self) -> float:
        """When what waits is to be written."""
        return self._due_s if self._waiting else float("inf")

    def put(self, copy: PersistRecord) -> None:
        """Let a copy of another robot's record wait."""
        self._waiting.append(copy)

    async def write(self, kept: list[Persist]) -> None:
        """Bring these, and what waits before them, onto the disk, and empty the list."""
        if kept:
            self._waiting += kept
            kept.clear()
            await self.flush()

    async def write_due(self, now_s: float) -> None:
        """Write what waits when it is due."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + COPIES_PERIOD_S
        if self._waiting:
            await self.flush()

    async def write_full(self) -> None:
        """Write what waits when it is much."""
        if len(self._waiting) >= COPIES_MAX:
            await self.flush()

    async def flush(self) -> None:
        """Write whatever waits."""
        batch, self._waiting = self._waiting, []
        await asyncio.to_thread(write, self._store, batch)


def write(store: Store, effects: Iterable[Persist]) -> None:
    """Bring a batch onto the disk; own records are safe when this returns."""
    batch = list(effects)
    records = [StoredRecord(e.log, e.number, e.data) for e in batch if isinstance(e, PersistRecord)]
    if records:
        store.put_records(records)
    for effect in batch:
        match effect:
            case PersistTerm(counter):
                store.put_term_counter(counter)
            case PersistCorrection(correction, frame_changed):
                if frame_changed:
                    store.put_fact(FRAME_CHANGED, b"1")
                store.put_correction(correction.log.robot, stored(correction))
                if not frame_changed and store.fact(FRAME_CHANGED) == b"1":
                    store.put_fact(FRAME_CHANGED, b"0")
            case DropLog(log):
                store.drop_log(log)
            case PersistRecord():
                pass
            case _:
                assert_never(effect)


def restore(
    store: Store, sealer: Sealer | None = None, opened: MapFolder | None = None, fixed: bool = False
) -> Restored:
    """Read everything back; of another robot's log as far as it has no gap. The logs of an opened map come with it.

    A log that the swarm does not take any more is set aside: of a robot that is no member, or signed with other keys or
    with none. Where it is the robot's own, the robot begins another one.
    """
    read = {log: _prefix(store, log) for log in store.logs()}
    for log, records in list(read.items()):
        fault = _fault(log, records if log == store.identity.log else records[:1], sealer)
        if fault is not None:
            del read[log]
            store.set_aside(log)
            logger.warning("%s: its %d records on the disk are set aside: %s", log, len(records), fault)
    latents = set(store.latent_keyframes())
    own = store.identity.log
    journeys = frozenset(k.log for k in latents if k.log.robot == own.robot and k.log != own and k.log in read)
    if opened is not None:
        read |= joined_logs(opened, read, own, sealer)
        latents |= set(opened.latent_keyframes())
    return Restored(
        records=tuple(read.items()),
        latents=tuple(sorted(latents)),
        term_counter=store.term_counter(),
        correction=_correction(store, store.identity.log, sealer),
        frame_changed=store.fact(FRAME_CHANGED) == b"1",
        saved=None if opened is None else opened.saved(fixed),
        journeys=journeys,
    )


def joined_logs(
    opened: MapFolder, held: Mapping[LogId, tuple[bytes, ...]], own: LogId | None, sealer: Sealer | None
) -> dict[LogId, tuple[bytes, ...]]:
    """The logs of a map, each with what the store holds beyond it.

    Raises:
        BadMap: The swarm has other keys, this robot writes one of its logs, or the store has another log of that name.
    """
    opened.check_keys(sealer)
    found: dict[LogId, tuple[bytes, ...]] = {}
    for log, records in opened.records.items():
        if log == own:
            raise BadMap(
                f"{opened.path}: holds the log {log}, which robot {log.robot} goes on writing: "
                "begin a new journey (--new-journey), or give another folder"
            )
        joined = longer_copy(held.get(log, ()), records)
        if joined is None:
            raise BadMap(f"{opened.path}: holds another log {log} than the robot's own folder")
        found[log] = joined
    return found


def _fault(log: LogId, records: Iterable[bytes], sealer: Sealer | None) -> str | None:
    """Why the swarm would refuse these records; others' signatures were checked when they came, so one is enough."""
    try:
        for number, data in enumerate(records):
            decode_record(data if sealer is None else sealer.opened(log, number, data))
    except DecodeError as error:
        return str(error)
    return None


def _correction(store: Store, own: LogId, sealer: Sealer | None) -> LogCorrection | None:
    """The correction that was applied last, unless for an earlier incarnation, or of a leader nobody would believe."""
    kept = store.correction(own.robot)
    correction = None if kept is None else correction_in(kept)
    if correction is None or correction.log != own:
        return None
    try:
        if sealer is not None:
            sealer.check_correction(correction.term.leader, encode_correction(correction), correction.signature)
    except DecodeError as error:
        logger.warning("%s: the correction on the disk is forgotten: %s", own, error)
        return None
    return correction


def _prefix(store: Store, log: LogId) -> tuple[bytes, ...]:
    records = store.records(log)
    whole = [record.data for position, record in enumerate(records) if record.number == position]
    return tuple(whole)
