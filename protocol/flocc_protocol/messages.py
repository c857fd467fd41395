"""Messages between robots, versioned and checked on decode: the envelope, and the one door to every kind of message.

Everything but latents is a message. Latents are fetched by key (see `keys`), in chunks, for candidates only.
Every message but a heartbeat may be lost: heartbeats repeat, and what they say repairs the rest. A kind stands in the
module that is named after what it says; a new one is listed in `Message`, and its module in `_CODECS`.
"""

from dataclasses import dataclass
from typing import Any

import msgspec

from flocc_protocol import (
    candidate_pairs,
    digests,
    elections,
    heartbeats,
    log_corrections,
    record_batches,
    shared_poses,
)
from flocc_protocol.candidate_pairs import OFFERS_MAX, CandidateOffer, CandidatePair
from flocc_protocol.codec import LOG_ID, LOGS_MAX, MESSAGE_BYTES_MAX, Codec, Reader, listed, packed
from flocc_protocol.digests import DigestRequest, Digests, LogDigest, TableState
from flocc_protocol.elections import (
    COMPUTE_CLASS_MAX,
    COUNTER_MAX,
    HOPS_MAX,
    Answer,
    Coordinator,
    Election,
    Handover,
    LeaderAdvert,
)
from flocc_protocol.errors import DecodeError
from flocc_protocol.heartbeats import WANTS_MAX, Heartbeat
from flocc_protocol.ids import LogId
from flocc_protocol.log_corrections import (
    CORRECTIONS_KEPT_MAX,
    CORRECTIONS_MAX,
    KNOTS_MAX,
    CorrectionBatch,
    CorrectionRequest,
    CorrectionVersion,
    KnotRequest,
    Knots,
    LogCorrection,
    encode_correction,
)
from flocc_protocol.record_batches import (
    BATCHES_MAX,
    CHECKSUM_MAX,
    RECORDS_BATCH_BYTES_MAX,
    RECORDS_BATCH_MAX,
    LogPosition,
    RecordBatch,
    RecordRequest,
    Records,
)
from flocc_protocol.shared_poses import SHARED_MAX, SharedPoses

__all__ = [
    "Answer",
    "BATCHES_MAX",
    "CHECKSUM_MAX",
    "COMPUTE_CLASS_MAX",
    "CORRECTIONS_KEPT_MAX",
    "CORRECTIONS_MAX",
    "COUNTER_MAX",
    "CandidateOffer",
    "CandidatePair",
    "Coordinator",
    "CorrectionBatch",
    "CorrectionRequest",
    "CorrectionVersion",
    "DigestRequest",
    "Digests",
    "Election",
    "Envelope",
    "HOPS_MAX",
    "Handover",
    "Heartbeat",
    "KNOTS_MAX",
    "KnotRequest",
    "Knots",
    "LOGS_MAX",
    "LeaderAdvert",
    "LogCorrection",
    "LogDigest",
    "LogPosition",
    "MESSAGE_BYTES_MAX",
    "MESSAGE_KINDS",
    "Message",
    "OFFERS_MAX",
    "PROTOCOL_VERSION",
    "RECORDS_BATCH_BYTES_MAX",
    "RECORDS_BATCH_MAX",
    "RecordBatch",
    "RecordRequest",
    "Records",
    "SHARED_MAX",
    "SharedPoses",
    "TableState",
    "UnknownVersion",
    "WANTS_MAX",
    "decode",
    "encode",
    "encode_correction",
    "kind_of",
    "version_of",
]

PROTOCOL_VERSION = 5
VERSION_MAX = 127


class UnknownVersion(DecodeError):
    """The sender speaks another version of this protocol."""


Message = (
    Heartbeat
    | Digests
    | DigestRequest
    | Election
    | Answer
    | Coordinator
    | Handover
    | Records
    | RecordRequest
    | CorrectionBatch
    | CorrectionRequest
    | KnotRequest
    | CandidateOffer
    | SharedPoses
)


@dataclass(frozen=True, slots=True)
class Envelope:
    """A message with its sender's log."""

    sender: LogId
    message: Message


_CODECS: dict[str, tuple[type[Message], Codec[Any]]] = {
    **heartbeats.CODECS,
    **digests.CODECS,
    **elections.CODECS,
    **record_batches.CODECS,
    **log_corrections.CODECS,
    **candidate_pairs.CODECS,
    **shared_poses.CODECS,
}
_KINDS: dict[type[Message], str] = {cls: kind for kind, (cls, _) in _CODECS.items()}
_READERS = {kind: Reader(codec, MESSAGE_BYTES_MAX) for kind, (_, codec) in _CODECS.items()}
MESSAGE_KINDS: tuple[str, ...] = tuple(_CODECS)


def _envelope(raw: tuple[int, str, tuple[str, int], msgspec.Raw]) -> Envelope:
    _, kind, sender, fields = raw
    read = _READERS.get(kind)
    if read is None or LOG_ID.build is None:
        raise DecodeError("a message is of a known kind")
    return Envelope(LOG_ID.build(sender), read(fields))


_read: Reader[Envelope] = Reader(
    Codec(packed, listed(int, str, LOG_ID.wire, msgspec.Raw), _envelope), MESSAGE_BYTES_MAX
)


def kind_of(message: Message) -> str:
    """Name of a message's kind, as accounting and key expressions use it."""
    return _KINDS[type(message)]


def encode(envelope: Envelope) -> bytes:
    """Serialise a message: version, kind, sender, fields.

    Raises:
        ValueError: A field is outside its limits, so that every receiver would refuse the message.
    """
    kind = kind_of(envelope.message)
    try:
        body = _CODECS[kind][1].pack(envelope.message)
    except DecodeError as error:
        raise ValueError(f"{kind}: {error}") from error
    data = packed([PROTOCOL_VERSION, kind, LOG_ID.pack(envelope.sender), body])
    assert len(data) <= MESSAGE_BYTES_MAX, f"{kind} of {len(data)} bytes is larger than a message may be"
    return data


def version_of(data: bytes) -> int:
    """Read the protocol version of a message, whatever else that version changed: its second byte.

    Raises:
        DecodeError: Not a message of any version: a short msgpack array that starts with 0 to 127.
    """
    if len(data) < 2 or data[0] & 0xF0 != 0x90 or data[1] > VERSION_MAX:
        raise DecodeError("a message starts with its version")
    return data[1]


def decode(data: bytes) -> Envelope:
    """Parse and check a message.

    Raises:
        UnknownVersion: The sender speaks another version.
        DecodeError: The bytes are anything else.
    """
    version = version_of(data)
    if version != PROTOCOL_VERSION:
        raise UnknownVersion(f"protocol version {version}, this robot speaks {PROTOCOL_VERSION}")
    return _read(data)
