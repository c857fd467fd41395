"""Between the core and the store: what a robot keeps, and what it finds when it starts."""

from collections.abc import Iterable

from flocc_agent.core.effects import PersistCorrection, PersistRecord, PersistTerm
from flocc_agent.core.robot import Restored
from flocc_agent.runtime.store import Store, StoredRecord
from flocc_agent.runtime.stored_correction import correction_in, stored
from flocc_protocol.ids import LogId
from flocc_protocol.messages import LogCorrection

Persist = PersistRecord | PersistTerm | PersistCorrection

FRAME_CHANGED = "frame_changed"
"""Fact: the kept correction, or one that was about to be kept, changed the map frame."""


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
            case PersistRecord():
                pass


def restore(store: Store) -> Restored:
    """Read everything back; of another robot's log as far as it has no gap."""
    own = store.identity.log
    return Restored(
        records=tuple((log, _prefix(store, log)) for log in store.logs()),
        latents=tuple(store.latent_keyframes()),
        term_counter=store.term_counter(),
        correction=_correction(store, own),
        frame_changed=store.fact(FRAME_CHANGED) == b"1",
    )


def _correction(store: Store, own: LogId) -> LogCorrection | None:
    """The correction that was applied last, unless an earlier incarnation wrote it."""
    kept = store.correction(own.robot)
    correction = None if kept is None else correction_in(kept)
    return correction if correction is not None and correction.log == own else None


def _prefix(store: Store, log: LogId) -> tuple[bytes, ...]:
    records = store.records(log)
    whole = [record.data for position, record in enumerate(records) if record.number == position]
    return tuple(whole)
