"""Heartbeats: who is there, what it holds, whom it follows. They repeat, and what they say repairs the rest."""

from dataclasses import dataclass

from flocc_protocol.codec import COUNT, KEYFRAME_ID, Kinds, integer, optional, sequence, struct
from flocc_protocol.digests import TABLE_STATE, TableState
from flocc_protocol.elections import ADVERT, BEAT, COMPUTE_CLASS, TERM_COUNTER, LeaderAdvert
from flocc_protocol.ids import INCARNATION_MAX, KeyframeId
from flocc_protocol.record_batches import CHECKSUM

WANTS_MAX = 16
NOTHING_HELD = TableState(0, 0)


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Who is there, what it holds, whom it follows.

    Attributes:
        sequence: Counts this boot's heartbeats.
        boot: Random per start; two boots that are heard alternately share one name by mistake.
        compute_class: 0 (small) to 9 (server with a GPU).
        leader: The followed leader, None while there is none.
        term_counter_max: Highest term counter the sender knows of; hearsay, which nobody acts on.
        load: Registrations waiting at the sender.
        records: How many records the sender's own log has.
        checksum: Their chained checksum.
        digests: All that the sender holds of logs, as one hash.
        versions: All corrections that it holds, as one hash.
        wants: Latents the sender needs and cannot reach, for relays.
        holds: Latents the sender holds for a neighbour that wanted them.
        lost: Latents that a neighbour wanted, and that exist no more as the sender knows from their owner.
    """

    sequence: int
    boot: int
    compute_class: int
    leader: LeaderAdvert | None
    term_counter_max: int
    load: int
    records: int = 0
    checksum: int = 0
    digests: TableState = NOTHING_HELD
    versions: TableState = NOTHING_HELD
    wants: tuple[KeyframeId, ...] = ()
    holds: tuple[KeyframeId, ...] = ()
    lost: tuple[KeyframeId, ...] = ()


CODECS: Kinds = {
    "heartbeat": (
        Heartbeat,
        struct(
            Heartbeat,
            sequence=BEAT,
            boot=integer(0, INCARNATION_MAX),
            compute_class=COMPUTE_CLASS,
            leader=optional(ADVERT),
            term_counter_max=TERM_COUNTER,
            load=COUNT,
            records=COUNT,
            checksum=CHECKSUM,
            digests=TABLE_STATE,
            versions=TABLE_STATE,
            wants=sequence(KEYFRAME_ID, WANTS_MAX),
            holds=sequence(KEYFRAME_ID, WANTS_MAX),
            lost=sequence(KEYFRAME_ID, WANTS_MAX),
        ),
    )
}
