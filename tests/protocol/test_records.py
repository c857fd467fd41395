"""Claims on log records: they read back, fit their limits, and no log can hold one that others would refuse."""

import math
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.protocol.wire_examples import ALICE, BOB, ENCODED, IDENTITY, RECORDS, descriptor, records

from flocc_protocol.arrays import Array
from flocc_protocol.codec import from_bytes, to_bytes
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import KeyframeId
from flocc_protocol.records import (
    DESCRIPTOR_DIMENSION_MAX,
    REASON_LENGTH_MAX,
    RECORD_BYTES_MAX,
    ClosureRecord,
    FixRecord,
    KeyframeRecord,
    Record,
    RejectionRecord,
    UnknownRecord,
    chain,
    decode_record,
    encode_record,
    int8_descriptor,
)

KEYFRAME = KeyframeRecord(0, 0.0, IDENTITY, None)
CLOSURE = ClosureRecord(KeyframeId(ALICE, 3), KeyframeId(BOB, 8), IDENTITY, 480, 510, 0.9)


@given(records)
def test_any_record_reads_back(record: Record) -> None:
    data = encode_record(record)
    assert decode_record(data) == record
    assert encode_record(decode_record(data)) == data


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: type(record).__name__)
def test_every_example_reads_back(record: Record) -> None:
    assert decode_record(encode_record(record)) == record


@pytest.mark.parametrize("dtype", ["f2", "i1"])
def test_the_longest_descriptor_fits_as_half_floats_and_int8(dtype: str) -> None:
    values = np.random.default_rng(0).normal(size=DESCRIPTOR_DIMENSION_MAX)
    array = Array.int8(values) if dtype == "i1" else Array.of(values, dtype)
    assert len(encode_record(replace(KEYFRAME, descriptor=array))) <= RECORD_BYTES_MAX


def test_a_descriptor_too_long_for_a_record_is_refused_before_it_is_logged() -> None:
    array = Array.of(np.zeros(DESCRIPTOR_DIMENSION_MAX), "f4")
    with pytest.raises(ValueError, match="larger than 8192"):
        encode_record(replace(KEYFRAME, descriptor=array))


@pytest.mark.parametrize(
    "record",
    [
        replace(KEYFRAME, stamp_s=math.nan),
        replace(KEYFRAME, stamp_s=1e13),
        replace(KEYFRAME, index=-1),
        replace(KEYFRAME, index=2**31),
        replace(KEYFRAME, T_odom_camera=(math.nan, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),
        replace(KEYFRAME, T_odom_camera=(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.5)),
        replace(CLOSURE, match_ratio=math.inf),
        replace(CLOSURE, match_ratio=-0.1),
        replace(CLOSURE, scale_initial=0.0),
        replace(CLOSURE, correspondences=-1),
    ],
    ids=repr,
)
def test_a_record_that_others_would_refuse_is_a_value_error_here(record: Record) -> None:
    with pytest.raises(ValueError, match="Record: "):
        encode_record(record)


@pytest.mark.parametrize(
    "build",
    [
        lambda: replace(KEYFRAME, descriptor=Array.of(np.zeros((2, 2)))),
        lambda: replace(KEYFRAME, descriptor=Array.of(np.zeros(0))),
        lambda: replace(KEYFRAME, descriptor=Array.of(np.zeros(DESCRIPTOR_DIMENSION_MAX + 1))),
        lambda: replace(CLOSURE, match=CLOSURE.query),
        lambda: RejectionRecord(CLOSURE.query, CLOSURE.query, "", 0, 0),
        lambda: FixRecord(0, Array.of(np.array([0, 0, 2e7]), "f8"), Array.of(np.zeros(9))),
        lambda: replace(CLOSURE, covariance=Array.of(np.eye(6))),
        lambda: FixRecord(0, Array.of(np.zeros(2)), Array.of(np.zeros(9))),
        lambda: FixRecord(0, Array.of(np.zeros(3)), Array.of(np.zeros((3, 3)))),
    ],
)
def test_shapes_are_checked_at_construction(build: Any) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        build()


@pytest.mark.parametrize("dtype", ["f2", "u1", "f4"])
def test_the_same_shapes_are_checked_on_the_wire(dtype: str) -> None:
    code, fields = from_bytes(encode_record(replace(KEYFRAME, descriptor=descriptor(4))), RECORD_BYTES_MAX)
    fields[3] = [dtype, [2, 2], bytes(4 * Array.of(np.zeros(1), dtype).numpy().itemsize), 1.0]
    with pytest.raises(DecodeError):
        decode_record(to_bytes([code, fields]))


@pytest.mark.parametrize(
    "value", [[], [0, []], [-1, []], [128, []], [1, []], [True, []], [1], [1, [], []], [99], 1, None, "x", [1, None]]
)
def test_anything_else_is_a_decode_error(value: Any) -> None:
    with pytest.raises(DecodeError):
        decode_record(to_bytes(value))


@pytest.mark.parametrize("data", ENCODED)
def test_a_cut_or_lengthened_record_is_a_decode_error(data: bytes) -> None:
    for cut in range(len(data)):
        with pytest.raises(DecodeError):
            decode_record(data[:cut])
    with pytest.raises(DecodeError):
        decode_record(data + b"\x00")


def test_a_record_larger_than_its_limit_is_a_decode_error() -> None:
    with pytest.raises(DecodeError, match="more than"):
        decode_record(bytes(RECORD_BYTES_MAX + 1))


def test_a_long_reason_is_cut() -> None:
    record = RejectionRecord(KeyframeId(ALICE, 0), KeyframeId(BOB, 0), "x" * 1000, 0, 0)
    assert decode_record(encode_record(record)) == replace(record, reason="x" * REASON_LENGTH_MAX)


@given(st.lists(st.sampled_from(ENCODED), max_size=8), st.lists(st.sampled_from(ENCODED), max_size=8))
def test_logs_that_differ_have_other_checksums(one: list[bytes], other: list[bytes]) -> None:
    def checksum(log: list[bytes]) -> int:
        value = 0
        for data in log:
            value = chain(value, data)
        return value

    assert (checksum(one) == checksum(other)) == (one == other)
    assert checksum([]) == 0


def test_a_keyframe_with_an_int8_descriptor_of_512_is_below_700_bytes() -> None:
    record = KeyframeRecord(100_000, 1_700_000_000.25, (1.5, -2.0, 0.25, 0.5, 0.5, -0.5, 0.5), descriptor(512))
    assert len(encode_record(record)) < 700


@pytest.mark.parametrize("data", [to_bytes([99, [1, "two"]]), b"\x92\x63\xc1 what a later version may write"])
def test_a_record_of_an_unknown_code_is_kept_byte_for_byte(data: bytes) -> None:
    record = decode_record(data)
    assert record == UnknownRecord(99, data)
    assert encode_record(record) == data


@pytest.mark.parametrize("data", ENCODED)
def test_a_record_with_more_fields_than_known_is_kept_byte_for_byte(data: bytes) -> None:
    code, fields = from_bytes(data, RECORD_BYTES_MAX)
    longer = to_bytes([code, [*fields, "more"]])
    assert decode_record(longer) == UnknownRecord(code, longer)
    assert encode_record(decode_record(longer)) == longer


@pytest.mark.parametrize("data", ENCODED)
def test_plain_messagepack_reads_and_writes_the_same_bytes(data: bytes) -> None:
    assert msgpack.packb(msgpack.unpackb(data)) == data


def test_a_record_whose_fields_have_a_long_header_is_read_all_the_same() -> None:
    data = ENCODED[0]
    for header in (b"\xdc\x00\x04", b"\xdd\x00\x00\x00\x04"):
        assert data[2] == 0x94
        assert decode_record(data[:2] + header + data[3:]) == decode_record(data)


def test_an_integer_is_no_float_and_nan_is_no_number() -> None:
    code, fields = from_bytes(ENCODED[0], RECORD_BYTES_MAX)
    for stamp in (1, math.nan, math.inf):
        with pytest.raises(DecodeError, match="finite number"):
            decode_record(to_bytes([code, [fields[0], stamp, *fields[2:]]]))


def test_a_record_with_fewer_fields_than_known_is_a_decode_error() -> None:
    code, fields = from_bytes(ENCODED[0], RECORD_BYTES_MAX)
    with pytest.raises(DecodeError, match="of length 4, got 3"):
        decode_record(to_bytes([code, fields[:-1]]))


@pytest.mark.parametrize("index", [0, 127, 128, 70_000])
@pytest.mark.parametrize("dimension", [1, 127, 128, 255, 256, DESCRIPTOR_DIMENSION_MAX])
def test_a_descriptor_of_int8_is_found_in_its_record(index: int, dimension: int) -> None:
    array = Array.int8(np.random.default_rng(dimension).standard_normal(dimension))
    for seal in (b"", bytes(64)):
        data = encode_record(replace(KEYFRAME, index=index, descriptor=array)) + seal
        place = int8_descriptor(data)
        assert place is not None
        assert data[place] == array.data


def test_other_records_have_no_descriptor_of_int8() -> None:
    floats = replace(KEYFRAME, descriptor=Array.of(np.ones(8)))
    for record in (
        replace(KEYFRAME, descriptor=None),
        floats,
        *(each for each in RECORDS if not isinstance(each, KeyframeRecord)),
    ):
        assert int8_descriptor(encode_record(record)) is None
    data = encode_record(replace(KEYFRAME, descriptor=Array.int8(np.ones(8))))
    for end in range(3, len(data)):
        place = int8_descriptor(data[:end])
        assert place is None or place.stop <= end
