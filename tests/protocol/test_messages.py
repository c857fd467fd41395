"""Claims on messages: they read back, the largest legal ones fit, other versions are named."""

import math
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from tests.protocol import wire_sizes
from tests.protocol.wire_examples import (
    ALICE,
    BOB,
    ENVELOPES,
    IDENTITY,
    MESSAGES,
    TERM,
    descriptor,
    knots,
    largest_messages,
    log_ids,
    messages,
)

from flocc_protocol.arrays import Array
from flocc_protocol.codec import from_bytes, to_bytes
from flocc_protocol.digests import HASH_MAX
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import INDEX_MAX, TERM_COUNTER_MAX, LogId
from flocc_protocol.keys import Kind, broadcast_key, checked_kind
from flocc_protocol.log_corrections import KNOT_REQUESTS_MAX
from flocc_protocol.messages import (
    BATCHES_MAX,
    CORRECTIONS_MAX,
    KNOTS_MAX,
    LOGS_MAX,
    MESSAGE_BYTES_MAX,
    MESSAGE_KINDS,
    PROTOCOL_VERSION,
    RECORDS_BATCH_BYTES_MAX,
    RECORDS_BATCH_MAX,
    CorrectionBatch,
    CorrectionVersion,
    Digests,
    Election,
    Envelope,
    Heartbeat,
    KnotRequest,
    LogCorrection,
    LogDigest,
    LogPosition,
    Message,
    RecordBatch,
    RecordRequest,
    Records,
    TableState,
    UnknownVersion,
    decode,
    encode,
    kind_of,
    version_of,
)
from flocc_protocol.records import RECORD_BYTES_MAX, KeyframeRecord, encode_record

KNOTS = knots(6)
CORRECTION = LogCorrection(ALICE, TERM, 5, ALICE, IDENTITY, KNOTS)
KEYFRAME_BYTES = encode_record(KeyframeRecord(9, 1_700_000_000.0, IDENTITY, descriptor(512)))


@given(log_ids, messages)
def test_any_message_reads_back(sender: LogId, message: Message) -> None:
    data = encode(Envelope(sender, message))
    assert decode(data) == Envelope(sender, message)
    assert encode(decode(data)) == data


@pytest.mark.parametrize("message", MESSAGES, ids=kind_of)
def test_every_example_reads_back(message: Message) -> None:
    assert decode(encode(Envelope(BOB, message))) == Envelope(BOB, message)


@pytest.mark.parametrize("envelope", ENVELOPES, ids=lambda envelope: kind_of(envelope.message))
def test_plain_messagepack_reads_and_writes_the_same_bytes(envelope: Envelope) -> None:
    data = encode(envelope)
    read = msgpack.unpackb(data)
    assert read[:3] == [PROTOCOL_VERSION, kind_of(envelope.message), list(envelope.sender)]
    assert msgpack.packb(read) == data


def test_there_is_an_example_of_every_kind() -> None:
    assert {kind_of(message) for message in MESSAGES} == set(MESSAGE_KINDS)
    assert {kind_of(message) for message in largest_messages()} == set(MESSAGE_KINDS)


@pytest.mark.parametrize("message", largest_messages(), ids=kind_of)
def test_the_largest_legal_message_of_every_kind_fits(message: Message) -> None:
    envelope = Envelope(LogId("z" * 32, 2**53 - 1), message)
    data = encode(envelope)
    assert len(data) <= MESSAGE_BYTES_MAX
    assert decode(data) == envelope


def test_every_kind_is_a_chunk_of_the_key_grammar() -> None:
    assert sorted(MESSAGE_KINDS) == sorted(kind.value for kind in Kind)
    for kind in MESSAGE_KINDS:
        assert checked_kind(kind) in broadcast_key("swarm", "alice", kind)


# --- limits ----------------------------------------------------------------------------------------------------------


def test_a_batch_takes_as_many_records_as_one_message_holds() -> None:
    large = [bytes([k]) * RECORD_BYTES_MAX for k in range(64)]
    batch = RecordBatch.of(ALICE, 7, 0, large)
    assert batch.records == tuple(large[: RECORDS_BATCH_BYTES_MAX // RECORD_BYTES_MAX])
    small = [bytes([k]) for k in range(200)]
    assert RecordBatch.of(ALICE, 7, 0, small).records == tuple(small[:RECORDS_BATCH_MAX])
    assert len(encode(Envelope(BOB, Records((batch,))))) <= MESSAGE_BYTES_MAX


def test_a_batch_keeps_the_order_and_leaves_no_gap_for_a_small_record() -> None:
    records = [bytes(8000)] * 4 + [bytes(8000), b"small"]
    assert RecordBatch.of(ALICE, 0, 0, records).records == tuple(records[:4])


@pytest.mark.parametrize(
    "build",
    [
        lambda: RecordBatch(ALICE, 0, 0, (bytes(RECORD_BYTES_MAX),) * 64),
        lambda: RecordBatch(ALICE, 0, 0, (b"",) * (RECORDS_BATCH_MAX + 1)),
        lambda: RecordBatch(ALICE, INDEX_MAX, 0, (b"x",)),
        lambda: Records((RecordBatch(ALICE, 0, 0, (bytes(RECORD_BYTES_MAX),) * 3),) * 2),
        lambda: Records((RecordBatch(ALICE, 0, 0, ()),) * (BATCHES_MAX + 1)),
        lambda: CorrectionBatch((CORRECTION,) * (CORRECTIONS_MAX + 1)),
        lambda: CorrectionBatch((replace(CORRECTION, knots=knots(800)),) * 2),
        lambda: replace(CORRECTION, signature=b"short"),
        lambda: knots(KNOTS_MAX + 1),
        lambda: knots(0),
        lambda: replace(KNOTS, twists=Array.of(np.zeros((5, 6)), "f4")),
        lambda: replace(KNOTS, twists=Array.of(np.zeros((6, 7)), "f4")),
        lambda: replace(KNOTS, twists=Array.of(np.zeros((6, 6)), "f8")),
        lambda: replace(KNOTS, twists=Array.of(np.full((6, 6), 5.0), "f4")),
        lambda: replace(KNOTS, twists=Array.of(np.tile([0, 0, 0, 2e8, 0, 0], (6, 1)), "f4")),
        lambda: replace(KNOTS, keyframes=Array.of(np.array([1, 2, 3, 3, 4, 5]), "u4")),
        lambda: replace(KNOTS, keyframes=Array.of(np.array([1, 2, 4, 3, 5, 6]), "u4")),
        lambda: replace(KNOTS, keyframes=Array.of(np.array([1, 2, 3, 4, 5, 2**32 - 1]), "u4")),
        lambda: replace(KNOTS, keyframes=Array.of(np.arange(6), "u1")),
        lambda: replace(KNOTS, about_odom_m=Array.of(np.zeros(3), "f4")),
        lambda: replace(KNOTS, about_odom_m=Array.of(np.full(3, 1e8), "f8")),
        lambda: replace(KNOTS, covariance=Array.of(np.zeros(20))),
    ],
)
def test_what_does_not_fit_cannot_be_built(build: Any) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        build()


@pytest.mark.parametrize(
    "message",
    [
        Digests(0, 0, (LogDigest(ALICE, 0, 0),) * (LOGS_MAX + 1), 0, ()),
        Heartbeat(0, 0, 0, None, 0, 0, digests=TableState(HASH_MAX + 1, 0)),
        Heartbeat(0, 0, 10, None, 0, 0),
        Heartbeat(0, 0, 0, None, TERM_COUNTER_MAX + 1, 0),
        Election(TERM_COUNTER_MAX + 1),
        Election(-1),
        Records((RecordBatch(ALICE, 0, 2**32, ()),)),
        RecordRequest((LogPosition(ALICE, 0),) * (BATCHES_MAX + 1)),
        KnotRequest((CorrectionVersion(ALICE, TERM, 1),) * (KNOT_REQUESTS_MAX + 1)),
        CorrectionBatch((replace(CORRECTION, T_map_odom=(math.nan, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),)),
    ],
    ids=lambda message: kind_of(message),
)
def test_a_message_that_others_would_refuse_is_a_value_error_here(message: Message) -> None:
    with pytest.raises(ValueError, match=kind_of(message)):
        encode(Envelope(ALICE, message))


def test_knots_on_the_wire_are_in_order_and_finite() -> None:
    version, kind, sender, fields = from_bytes(
        encode(Envelope(ALICE, CorrectionBatch((CORRECTION,)))), MESSAGE_BYTES_MAX
    )
    correction = from_bytes(fields[0][0][0], MESSAGE_BYTES_MAX)
    for field, bad, told in (
        (2, ["u4", [6], np.array([1, 2, 3, 2, 5, 6], "<u4").tobytes(), 1.0], "order"),
        (3, ["f4", [6, 6], np.full(36, np.nan, "<f4").tobytes(), 1.0], "finite"),
    ):
        damaged = list(correction)
        damaged[-1] = [*correction[-1][:field], bad, *correction[-1][field + 1 :]]
        fields[0][0][0] = to_bytes(damaged)
        with pytest.raises(DecodeError, match=told):
            decode(to_bytes([version, kind, sender, fields]))


# --- versions and malformed messages ---------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [0, 1, 127])
@pytest.mark.parametrize("rest", [[], ["heartbeat"], [{"a": 1}, "other"], [[0] * 300]])
def test_another_version_is_named_whatever_else_it_changed(version: int, rest: list[Any]) -> None:
    data = to_bytes([version, *rest])
    with pytest.raises(UnknownVersion, match=f"version {version}, this robot speaks {PROTOCOL_VERSION}"):
        decode(data)
    assert version_of(data) == version


@pytest.mark.parametrize("version", [-1, 128, 2**63, 1.0, True, None, "1", [1], b"1"])
def test_what_is_no_version_is_a_decode_error(version: Any) -> None:
    with pytest.raises(DecodeError) as caught:
        decode(to_bytes([version, "election", ["a", 0], [1]]))
    assert not isinstance(caught.value, UnknownVersion)


@pytest.mark.parametrize(
    "value",
    [
        [2],
        [2, "election"],
        [2, "election", ["a", 0]],
        [2, "election", ["a", 0], [1], 0],
        [2, "election", ["a", 0], []],
        [2, "election", ["a", 0], [1, 2]],
        [2, "election", ["a", 0], [True]],
        [2, "election", ["a", 0], [1.0]],
        [2, "election", ["a", 0], None],
        [2, "election", ["a", 0], 1],
        [2, "election", ["A", 0], [1]],
        [2, "election", ["a", -1], [1]],
        [2, "election", ["a", True], [1]],
        [2, "election", "a", [1]],
        [2, "Election", ["a", 0], [1]],
        [2, b"election", ["a", 0], [1]],
        [2, ["election"], ["a", 0], [1]],
        [2, 3, ["a", 0], [1]],
        [2, "candidates", ["a", 0], [[[[["a", 0], 1], [["a", 0], 1]]], False]],
        [2, "candidates", ["a", 0], [[[[["b", 0], 1], [["a", 0], 1]]], False]],
        [2, "candidates", ["a", 0], [[], 0]],
    ],
)
def test_anything_else_is_a_decode_error(value: list[Any]) -> None:
    with pytest.raises(DecodeError):
        decode(to_bytes(value))


@pytest.mark.parametrize("envelope", ENVELOPES, ids=lambda envelope: kind_of(envelope.message))
def test_a_cut_or_lengthened_message_is_a_decode_error(envelope: Envelope) -> None:
    data = encode(envelope)
    for cut in range(len(data)):
        with pytest.raises(DecodeError):
            decode(data[:cut])
    with pytest.raises(DecodeError):
        decode(data + b"\x00")


def test_a_message_larger_than_its_limit_is_a_decode_error() -> None:
    with pytest.raises(DecodeError, match="more than"):
        decode(bytes([0x94, PROTOCOL_VERSION]) + bytes(MESSAGE_BYTES_MAX))


# --- sizes -----------------------------------------------------------------------------------------------------------


def test_a_heartbeat_of_however_many_logs_is_small() -> None:
    everything = TableState(HASH_MAX, INDEX_MAX)
    heartbeat = Heartbeat(10_000, 2**40, 5, None, 7, 3, 1000, 2**32 - 1, everything, everything)
    assert len(encode(Envelope(LogId("robot-01"), heartbeat))) < 90


def test_what_50_logs_hold_fits_two_datagrams_of_ethernet() -> None:
    logs = [LogId(f"robot-{k:02d}") for k in range(50)]
    digests = tuple(LogDigest(log, 1000, 2**32 - 1) for log in logs)
    versions = tuple(CorrectionVersion(log, TERM, 200) for log in logs)
    assert len(encode(Envelope(logs[0], Digests(2**40, 50_000, digests, 10_000, versions)))) < 2 * 1400


def test_a_keyframe_costs_less_than_700_bytes_in_a_batch() -> None:
    alone = len(encode(Envelope(ALICE, Records((RecordBatch.of(ALICE, 10_000, 2**32 - 1, [KEYFRAME_BYTES]),)))))
    batch = RecordBatch.of(ALICE, 10_000, 2**32 - 1, [KEYFRAME_BYTES] * RECORDS_BATCH_MAX)
    assert alone < 700
    assert len(encode(Envelope(ALICE, Records((batch,))))) / len(batch.records) < 650


def test_a_correction_of_as_many_knots_as_may_be_fits_one_message() -> None:
    correction = replace(CORRECTION, knots=knots(KNOTS_MAX, Array.of(np.ones(21))))
    assert len(encode(Envelope(ALICE, CorrectionBatch((correction,))))) < 43_000


def test_the_sizes_in_the_readme_are_those_of_today() -> None:
    assert wire_sizes.table() in wire_sizes.README.read_text(), "run `python -m tests.protocol.wire_sizes`"
