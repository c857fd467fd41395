"""Copies of logs: blocks of bytes that give back every record and checksum, shared within a process."""

import zlib
from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.core.log_copy import BLOCK_RECORDS, EncodedRecords, LogCopy
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import KeyframeRecord, RejectionRecord, UnknownRecord, chain, decode_record, encode_record

COUNT = 2 * BLOCK_RECORDS + 3
SEAL = bytes(64)


def keyframe(index: int, described: bool = True) -> KeyframeRecord:
    descriptor = Array("i1", (4,), bytes([1, 2, 3, index % 100]), 0.5) if described else None
    return KeyframeRecord(index, 0.5 * index, (float(index), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), descriptor)


DATA = [encode_record(keyframe(k)) for k in range(COUNT)]


def copied(data: list[bytes], seal_bytes: int = 0) -> LogCopy:
    copy = LogCopy()
    for each in data:
        copy.append(each, seal_bytes)
    return copy


def test_records_come_back_as_they_were_whatever_part_is_asked_for() -> None:
    encoded = copied(DATA).encoded
    assert list(encoded) == DATA
    assert [encoded[k] for k in range(-COUNT, COUNT)] == DATA + DATA
    for part in (slice(60, 70), slice(126, None), slice(-3, None), slice(None, None, 50), slice(200, 300)):
        assert encoded[part] == DATA[part]
    with pytest.raises(IndexError):
        encoded[COUNT]


def test_the_checksum_of_every_prefix_is_known() -> None:
    copy, checksum = copied(DATA), 0
    for count, data in enumerate(DATA):
        assert copy.checksum_at(count) == checksum
        checksum = chain(checksum, data)
    assert copy.checksum == copy.checksum_at(COUNT) == checksum


def test_what_records_say_is_decoded_without_descriptors() -> None:
    copy = copied(DATA)
    assert copy.records == [keyframe(k, described=False) for k in range(COUNT)]
    assert copy.keyframes == COUNT


def test_what_is_no_keyframe_is_found_without_decoding_the_others() -> None:
    rejection = RejectionRecord(KeyframeId(LogId("r1"), 0), KeyframeId(LogId("r2"), 0), "no", 0, 0)
    copy = copied([*DATA[:70], encode_record(rejection), *DATA[70:]])
    assert list(copy.other_records()) == [rejection]
    assert [list(copy.judgements(first)) for first in (0, 70, 71)] == [[(70, rejection)], [(70, rejection)], []]


def test_a_reader_sees_a_prefix_while_the_log_grows() -> None:
    encoded = EncodedRecords()
    reading = iter(encoded)
    for number, data in enumerate(DATA):
        encoded.append(data)
        assert list(encoded) == DATA[: number + 1]
    assert list(reading) == DATA


def test_a_seal_is_kept_and_not_read() -> None:
    copy = copied([data + SEAL for data in DATA], len(SEAL))
    assert copy.encoded[COUNT - 1] == DATA[-1] + SEAL
    assert copy.records[70] == keyframe(70, described=False)


def test_keyframes_of_a_later_version_count_and_other_records_do_not() -> None:
    rejection = encode_record(RejectionRecord(KeyframeId(LogId("r1"), 0), KeyframeId(LogId("r2"), 0), "no", 0, 0))
    later = b"\x92\x01\x9f" + b"\xc0" * 15
    copy = copied([rejection, later])
    assert copy.keyframes == 1
    assert copy.records[1] == UnknownRecord(1, b"")


def test_two_copies_of_one_log_share_their_full_blocks() -> None:
    one, other = EncodedRecords(DATA), EncodedRecords(bytes(bytearray(data)) for data in DATA)
    assert [a is b for a, b in zip(one._full, other._full, strict=True)] == [True, True]


@pytest.mark.parametrize("count", [0, 1, BLOCK_RECORDS - 1, BLOCK_RECORDS, BLOCK_RECORDS + 1, COUNT])
def test_a_disk_that_lost_its_end_goes_on_from_there(count: int) -> None:
    encoded = EncodedRecords(DATA)
    encoded.truncate(count)
    assert encoded == DATA[:count]
    encoded.append(b"new")
    assert encoded == [*DATA[:count], b"new"]


@pytest.mark.parametrize("first", [0, 5, BLOCK_RECORDS, COUNT - 1, COUNT])
def test_records_agree_only_where_bytes_and_checksum_do(first: int) -> None:
    copy = copied(DATA)
    before = copy.checksum_at(first)
    assert copy.agrees(first, before, [*DATA[first:], b"more"])
    assert not copy.agrees(first, before + 1, DATA[first:])
    assert first == COUNT or not copy.agrees(first, before, [b"other"])


def test_descriptors_stand_apart_and_records_come_back_whole() -> None:
    """Also where some keyframes have none, or one of floats or of another length, and between other records."""
    others = (None, Array.of(np.ones(4)), Array.int8(np.ones(300)))
    rejection = RejectionRecord(KeyframeId(LogId("r1"), 0), KeyframeId(LogId("r2"), 0), "no", 0, 0)
    data, index = list[bytes](), 0
    for k in range(COUNT):
        if k % 5 == 4:
            data.append(encode_record(rejection))
            continue
        described = keyframe(index)
        data.append(encode_record(described if k % 3 else replace(described, descriptor=others[k % 9 // 3])))
        index += 1
    for seal in (b"", SEAL):
        sealed = [each + seal for each in data]
        copy = copied(sealed, len(seal))
        assert list(copy.encoded) == sealed
        assert [copy.checksum_at(n) for n in range(0, COUNT, 7)] == [
            zlib.crc32(b"".join(sealed[:n])) for n in range(0, COUNT, 7)
        ]
        for block in range(2):
            indices, rows = copy.descriptors(block)
            expected = [
                (record.index, record.descriptor.data)
                for each in data[block * BLOCK_RECORDS : (block + 1) * BLOCK_RECORDS]
                if isinstance(record := decode_record(each), KeyframeRecord)
                and record.descriptor is not None
                and record.descriptor.shape == (4,)
                and record.descriptor.dtype == "i1"
            ]
            assert [(index, row.tobytes()) for index, row in zip(indices, rows, strict=True)] == expected
