"""Claims on field codecs: the same checks in both directions, and nothing that a header announces is believed."""

import math
import struct
import tracemalloc
from typing import Any

import numpy as np
import pytest

from flocc_protocol import codec
from flocc_protocol.codec import Codec, from_bytes, to_bytes
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import INDEX_MAX, KeyframeId, LogId

WRONG_TYPES: tuple[Any, ...] = (None, True, 1.5, "1", b"1", [], [1], {})
LIMIT = 64 * 1024


@pytest.mark.parametrize(
    ("field", "good"),
    [
        (codec.integer(-3, 3), -3),
        (codec.real(), 0.5),
        (codec.text(3), "äöü"),
        (codec.blob(3), b"abc"),
        (codec.boolean(), False),
        (codec.optional(codec.integer(0, 3)), None),
        (codec.optional(codec.integer(0, 3)), 3),
        (codec.sequence(codec.integer(0, 3), 2), (1, 2)),
        (codec.POSE, (1e7, -1e7, 0.0, 0.0, 0.6, 0.0, 0.8)),
        (codec.LOG_ID, LogId("a", 1)),
        (codec.KEYFRAME_ID, KeyframeId(LogId("a", 1), INDEX_MAX)),
    ],
)
def test_a_field_reads_back(field: Codec[Any], good: Any) -> None:
    assert field.unpack(from_bytes(to_bytes(field.pack(good)), LIMIT)) == good


@pytest.mark.parametrize(
    ("field", "of_type"),
    [
        (codec.integer(0, 3), int),
        (codec.real(), float),
        (codec.text(3), str),
        (codec.blob(3), bytes),
        (codec.boolean(), bool),
        (codec.POSE, ()),
        (codec.ARRAY, ()),
        (codec.LOG_ID, ()),
        (codec.KEYFRAME_ID, ()),
        (codec.TERM, ()),
    ],
)
def test_a_field_takes_its_own_type_only(field: Codec[Any], of_type: type | tuple[()]) -> None:
    for value in WRONG_TYPES:
        if type(value) is not of_type:
            with pytest.raises(DecodeError):
                field.unpack(value)


@pytest.mark.parametrize(
    ("field", "bad"),
    [
        (codec.integer(0, 3), 4),
        (codec.integer(0, 3), -1),
        (codec.real(0.0, 1.0), 1.1),
        (codec.real(), math.nan),
        (codec.real(), math.inf),
        (codec.blob(3), b"abcd"),
        (codec.sequence(codec.integer(0, 3), 2), (1, 2, 3)),
        (codec.sequence(codec.integer(0, 3), 2), (1, 4)),
        (codec.POSE, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.1)),
        (codec.POSE, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
        (codec.POSE, (math.nan, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),
        (codec.POSE, (0.0, 0.0, 0.0, math.inf, 0.0, 0.0, 0.0)),
        (codec.POSE, (0.0, 0.0, 1.1e7, 1.0, 0.0, 0.0, 0.0)),
        (codec.POSE, (0.0, 0.0, 0.0, 1e200, 0.0, 0.0, 0.0)),
    ],
)
def test_what_is_refused_on_the_way_in_is_not_sent(field: Codec[Any], bad: Any) -> None:
    with pytest.raises(DecodeError):
        field.pack(bad)
    raw = struct.pack("<7d", *bad) if field is codec.POSE else list(bad) if isinstance(bad, tuple) else bad
    with pytest.raises(DecodeError):
        field.unpack(raw)


def test_numpy_numbers_are_sent_as_plain_numbers() -> None:
    count: Codec[Any] = codec.integer(0, 9)
    number: Codec[Any] = codec.real()
    assert count.pack(np.int64(3)) == 3
    assert type(count.pack(np.int64(3))) is int
    assert type(number.pack(np.float32(0.5))) is float


def test_a_float_is_not_sent_as_an_integer() -> None:
    count: Codec[Any] = codec.integer(0, 9)
    with pytest.raises(TypeError):
        count.pack(3.0)


def test_long_text_is_cut_before_it_is_sent() -> None:
    assert codec.text(3).pack("abcdef") == "abc"


@pytest.mark.parametrize(
    "array",
    [
        ["f4", [True], bytes(4), 1.0],
        ["f4", [1.0], bytes(4), 1.0],
        ["f4", [[1]], bytes(4), 1.0],
        ["f4", [1], "abcd", 1.0],
        ["f4", [1], bytes(4), 1],
        ["f4", [1], bytes(4)],
        ["f4", [1] * 256, bytes(4), 1.0],
        ["f4", [0, 2**60, 2**60], b"", 1.0],
        ["f4", [2**63, 2**63, 2**63], b"", 1.0],
        ["f4", [1], b"\x00\x00\xc0\x7f", 1.0],
        ["i1", [1], b"\x01", 1e308],
        [None, [1], b"\x01", 1.0],
    ],
)
def test_what_is_not_an_array_is_a_decode_error(array: list[Any]) -> None:
    with pytest.raises(DecodeError) as caught:
        codec.ARRAY.unpack(array)
    assert len(str(caught.value)) < 120


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\x01\x01",
        b"\xa1",
        b"\xa1\xff",
        b"\x81\x01\x01",
        b"\xd4\x05\x00",
        b"\xd6\xff\x00\x00\x00\x00",
        b"\xdd\xff\xff\xff\xff",
        b"\xdb\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xdc\x01\x01" + b"\x00" * 257,
        b"\x91" * 60_000,
        bytes(LIMIT + 1),
    ],
)
def test_what_is_not_one_small_msgpack_value_is_a_decode_error(data: bytes) -> None:
    with pytest.raises(DecodeError):
        from_bytes(data, LIMIT)


@pytest.mark.parametrize(
    "data",
    [
        b"\xdd\x00\x00\xff\xff" * 1000,
        b"\xdc\xff\xff" * 1000,
        b"\xdc\x01\x00" * 1000,
        b"\x92" * 1000,
        b"\xc6\x7f\xff\xff\xff",
    ],
)
def test_announced_sizes_reserve_little_memory(data: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(DecodeError):
            from_bytes(data, LIMIT)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 4 * 2**20
