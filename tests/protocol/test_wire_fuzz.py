"""Claim: bytes from elsewhere are a valid message or record, or a DecodeError. More than 100,000 cases a run.

Three sources: noise, valid bytes with flipped, cut, doubled and spliced pieces, and valid msgpack in which some node
became a hostile value. A failure prints the seed's bytes in hex; add them to `REGRESSIONS`.
"""

from collections.abc import Callable

import msgpack
import numpy as np
import pytest
from tests.protocol.wire_examples import ENCODED, ENVELOPES
from tests.protocol.wire_mutations import MUTATIONS

from flocc_protocol.errors import DecodeError
from flocc_protocol.messages import MESSAGE_BYTES_MAX, decode, encode
from flocc_protocol.records import RECORD_BYTES_MAX, decode_record, encode_record

MESSAGE_BYTES = tuple(encode(envelope) for envelope in ENVELOPES)
SEEDS = range(8)
MESSAGE_CASES = 14_000
RECORD_CASES = 4_000

REGRESSIONS = (
    b"\xdd\x00\x00\xff\xff" * 1000,
    msgpack.packb([1, [0, 0.0, bytes(48) + bytes(8), ["f4", [0, 2**62], b"", 1.0]]]),
    msgpack.packb([4, [0, ["f4", [0, 2**62], b"", 1.0], ["i1", [9], bytes(9), 1e308]]]),
)


def refused(error: DecodeError) -> bool:
    """Refusals are one short sentence, whatever was sent: they are logged."""
    assert 0 < len(str(error)) < 200
    return False


def message_is_valid(data: bytes) -> bool:
    """Whether bytes decode; what decodes must encode to an equal message within the limits."""
    try:
        envelope = decode(data)
    except DecodeError as error:
        return refused(error)
    again = encode(envelope)
    assert decode(again) == envelope, data.hex()
    assert len(again) <= MESSAGE_BYTES_MAX
    return True


def record_is_valid(data: bytes) -> bool:
    """The same for records."""
    try:
        record = decode_record(data)
    except DecodeError as error:
        return refused(error)
    again = encode_record(record)
    assert decode_record(again) == record, data.hex()
    assert len(again) <= RECORD_BYTES_MAX
    return True


def fuzz(valid: Callable[[bytes], bool], examples: tuple[bytes, ...], seed: int, cases: int) -> int:
    """Try mutations of the examples; return how many of them were still valid."""
    rng = np.random.default_rng(seed)
    accepted = 0
    for case in range(cases):
        data = MUTATIONS[case % len(MUTATIONS)](rng, examples[case % len(examples)])
        try:
            accepted += valid(data)
        except Exception:
            print(f"seed {seed}, case {case}: {data[:2000].hex()}")
            raise
    return accepted


@pytest.mark.parametrize("seed", SEEDS)
def test_mutated_messages_are_valid_or_a_decode_error(seed: int) -> None:
    accepted = fuzz(message_is_valid, MESSAGE_BYTES, seed, MESSAGE_CASES)
    assert 0.02 * MESSAGE_CASES < accepted < 0.9 * MESSAGE_CASES


@pytest.mark.parametrize("seed", SEEDS)
def test_mutated_records_are_valid_or_a_decode_error(seed: int) -> None:
    accepted = fuzz(record_is_valid, ENCODED, seed, RECORD_CASES)
    assert 0.02 * RECORD_CASES < accepted < 0.9 * RECORD_CASES


def test_a_run_has_at_least_100_000_cases() -> None:
    assert len(SEEDS) * (MESSAGE_CASES + RECORD_CASES) >= 100_000


@pytest.mark.parametrize("data", REGRESSIONS, ids=range(len(REGRESSIONS)))
def test_bytes_that_once_broke_the_decoder_are_refused(data: bytes) -> None:
    assert not message_is_valid(data)
    assert not record_is_valid(data)
