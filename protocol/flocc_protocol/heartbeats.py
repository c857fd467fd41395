"""Heartbeats: who is there, what it holds, whom it follows. They repeat, and what they say repairs the rest."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

from flocc_protocol.codec import (
    COUNT,
    KEYFRAME_ID,
    LOG_ID,
    LOGS_MAX,
    REPEATED_MAX,
    Codec,
    Kinds,
    integer,
    optional,
    sequence,
    struct,
)
from flocc_protocol.elections import ADVERT, BEAT, COMPUTE_CLASS, TERM_COUNTER, LeaderAdvert
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import INCARNATION_MAX, INDEX_MAX, KeyframeId, LogId
from flocc_protocol.log_corrections import VERSION, CorrectionVersion
from flocc_protocol.record_batches import CHECKSUM, CHECKSUM_MAX

WANTS_MAX = 16


class LogDigest(NamedTuple):
    """How much of one log the sender holds, with the chained checksum of those records."""

    log: LogId
    count: int  # type: ignore[assignment]  # tuples have a method of this name, which nobody needs here
    checksum: int


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
        digests: What the sender holds of some logs: those that grew lately, and the others in turn.
        corrections: Which corrections the sender holds, of some logs in the same way.
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
    digests: tuple[LogDigest, ...]
    corrections: tuple[CorrectionVersion, ...] = ()
    wants: tuple[KeyframeId, ...] = ()
    holds: tuple[KeyframeId, ...] = ()
    lost: tuple[KeyframeId, ...] = ()


_ANY_DIGEST = struct(LogDigest, log=LOG_ID, count=COUNT, checksum=CHECKSUM)


@lru_cache(maxsize=REPEATED_MAX)
def _digest(raw: Any) -> LogDigest:
    """Heartbeats repeat most of what they say: the same digest comes back as the same object, checked once."""
    assert _ANY_DIGEST.build is not None
    return _ANY_DIGEST.build(raw)


def _pack_digest(value: LogDigest) -> LogDigest:
    """A digest is a tuple as it is on the wire."""
    log, count, checksum = value
    if not 0 <= count <= INDEX_MAX or not 0 <= checksum <= CHECKSUM_MAX:
        raise DecodeError(f"digest of {log} is out of range")
    return value


_DIGEST = Codec(_pack_digest, _ANY_DIGEST.wire, _digest)


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
            digests=sequence(_DIGEST, LOGS_MAX),
            corrections=sequence(VERSION, LOGS_MAX),
            wants=sequence(KEYFRAME_ID, WANTS_MAX),
            holds=sequence(KEYFRAME_ID, WANTS_MAX),
            lost=sequence(KEYFRAME_ID, WANTS_MAX),
        ),
    )
}
