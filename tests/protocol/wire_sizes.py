"""Prints the sizes table of protocol/README.md: `python -m tests.protocol.wire_sizes` in the repository's root."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tests.protocol.wire_examples import IDENTITY, descriptor, knots, largest_messages

from flocc_protocol.arrays import Array
from flocc_protocol.digests import HASH_MAX
from flocc_protocol.ids import KeyframeId, LogId, Term
from flocc_protocol.messages import (
    Answer,
    CandidateOffer,
    CandidatePair,
    Coordinator,
    CorrectionBatch,
    CorrectionRequest,
    CorrectionVersion,
    DigestRequest,
    Digests,
    Election,
    Envelope,
    Handover,
    Heartbeat,
    KnotRequest,
    LeaderAdvert,
    LogCorrection,
    LogDigest,
    LogPosition,
    Message,
    RecordBatch,
    RecordRequest,
    Records,
    TableState,
    encode,
    kind_of,
)
from flocc_protocol.records import ClosureRecord, FixRecord, KeyframeRecord, Record, RejectionRecord, encode_record

README = Path(__file__).parents[2] / "protocol" / "README.md"
LOGS = tuple(LogId(f"robot-{k:02d}") for k in range(50))
TERM = Term(7, LOGS[0])
ADVERT = LeaderAdvert(TERM, 5, 10_000, 1)
QUERY, MATCH = KeyframeId(LOGS[0], 1000), KeyframeId(LOGS[1], 1000)
STAMP_S = 1_700_000_000.25
COVARIANCE = Array.of(np.ones(21))
CHECKSUM = 2**32 - 1


def heartbeat(logs: int) -> Heartbeat:
    """A heartbeat of a robot that holds that many logs of 1,000 records and a correction of each."""
    digests, versions = TableState(HASH_MAX, 1000 * logs), TableState(HASH_MAX, 200 * logs)
    return Heartbeat(10_000, 2**52, 5, ADVERT, 7, 3, 1000, CHECKSUM, digests, versions)


def digests(logs: int) -> Digests:
    """All that such a robot holds, as it tells a new neighbour."""
    held = tuple(LogDigest(log, 1000, CHECKSUM) for log in LOGS[:logs])
    versions = tuple(CorrectionVersion(log, TERM, 200) for log in LOGS[:logs])
    return Digests(2**52, 1000 * logs, held, 200 * logs, versions)


def keyframe(place: Array | None) -> KeyframeRecord:
    """The thousandth keyframe, with a descriptor."""
    return KeyframeRecord(1000, STAMP_S, IDENTITY, place)


def records() -> Iterator[tuple[str, Record]]:
    """Records, by what the table calls them."""
    values = np.random.default_rng(0).normal(size=512)
    yield "keyframe, descriptor of 512 in int8", keyframe(descriptor(512))
    yield "keyframe, descriptor of 512 in fp16", keyframe(Array.of(values, "f2"))
    yield "keyframe, descriptor of 2048 in int8", keyframe(descriptor(2048))
    yield "keyframe without descriptor", keyframe(None)
    yield "closure", ClosureRecord(QUERY, MATCH, IDENTITY, 480, 510, 480 / 510, 1.7)
    yield "closure with covariance", ClosureRecord(QUERY, MATCH, IDENTITY, 480, 510, 480 / 510, 1.7, COVARIANCE)
    yield "rejection", RejectionRecord(QUERY, MATCH, "match ratio below 0.3", 12, 510)
    yield "fix", FixRecord(1000, Array.of(np.ones(3), "f8"), Array.of(np.ones(9), "f8"))


def correction(count: int) -> CorrectionBatch:
    """A correction of a log, with so many knots; in short with none."""
    told = knots(count, Array.of(np.ones(21), "f2")) if count else None
    return CorrectionBatch((LogCorrection(LOGS[1], TERM, 200, LOGS[0], IDENTITY, told),))


def messages() -> Iterator[tuple[str, Message]]:
    """Messages, by what the table calls them."""
    data = encode_record(keyframe(descriptor(512)))
    yield "heartbeat, 3 logs", heartbeat(3)
    yield "heartbeat, 50 logs", heartbeat(50)
    yield "digests, 3 logs", digests(3)
    yield "digests, 50 logs", digests(50)
    yield "want-digests", DigestRequest(40_000, 10_000)
    yield "election", Election(7)
    yield "answer", Answer(7)
    yield "coordinator", Coordinator(ADVERT)
    yield "handover", Handover(TERM)
    yield "records, one keyframe (int8, 512)", Records((RecordBatch.of(LOGS[1], 1000, CHECKSUM, [data]),))
    yield "records, as many such keyframes as fit", Records((RecordBatch.of(LOGS[1], 1000, CHECKSUM, [data] * 100),))
    yield "want-records, 1 log", RecordRequest((LogPosition(LOGS[1], 1000),))
    yield "want-records, 50 logs", RecordRequest(tuple(LogPosition(log, 1000) for log in LOGS))
    yield "correction, in short", correction(0)
    yield "correction, 30 knots", correction(30)
    yield "correction, 1500 knots", correction(1500)
    yield "want-correction", CorrectionRequest(LOGS[1:2])
    yield "want-knots", KnotRequest((CorrectionVersion(LOGS[1], TERM, 200),))
    yield "candidates, 1 pair", CandidateOffer((CandidatePair(QUERY, MATCH),))


def table() -> str:
    """The sizes table in Markdown."""
    rows = [("record: " + name, len(encode_record(record))) for name, record in records()]
    rows += [(name, len(encode(Envelope(LOGS[0], message)))) for name, message in messages()]
    longest = LogId("z" * 32, 2**53 - 1)
    largest: dict[str, int] = {}
    for message in largest_messages():
        kind = kind_of(message)
        largest[kind] = max(largest.get(kind, 0), len(encode(Envelope(longest, message))))
    rows += [(f"largest legal {kind}", size) for kind, size in largest.items()]
    return "\n".join(["| what | bytes |", "| --- | ---: |", *(f"| {name} | {size:,} |" for name, size in rows)])


if __name__ == "__main__":
    sys.stdout.write(table() + "\n")
