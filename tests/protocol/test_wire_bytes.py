"""Claim: the bytes of a protocol version never change. Each has a file here with one example of everything.

A change that breaks this needs a new protocol version; then write a new file beside the old ones:
`python -m tests.protocol.test_wire_bytes > tests/protocol/wire_v3.txt`.
"""

import sys
from pathlib import Path

import pytest
from tests.protocol.wire_examples import ENCODED, ENVELOPES, RECORDS

from flocc_protocol.messages import MESSAGE_KINDS, PROTOCOL_VERSION, UnknownVersion, decode, encode, kind_of
from flocc_protocol.records import decode_record

NAMES = [kind_of(e.message) for e in ENVELOPES] + [type(record).__name__ for record in RECORDS]
LINES = (Path(__file__).parent / f"wire_v{PROTOCOL_VERSION}.txt").read_text().splitlines()
FIRST_RECORD = len(ENVELOPES)


def today() -> list[str]:
    """Every example as `name hex`."""
    data = [*map(encode, ENVELOPES), *ENCODED]
    return [f"{name} {one.hex()}" for name, one in zip(NAMES, data, strict=True)]


@pytest.mark.parametrize("number", range(len(NAMES)), ids=NAMES)
def test_an_example_is_written_as_ever(number: int) -> None:
    assert today()[number] == LINES[number]


@pytest.mark.parametrize("number", range(len(NAMES)), ids=NAMES)
def test_an_example_is_read_as_ever(number: int) -> None:
    data = bytes.fromhex(LINES[number].split()[1])
    if number < FIRST_RECORD:
        assert decode(data) == ENVELOPES[number]
    else:
        assert decode_record(data) == RECORDS[number - FIRST_RECORD]


def test_messages_of_version_1_are_named_as_such() -> None:
    older = [line.split() for line in (Path(__file__).parent / "wire_v1.txt").read_text().splitlines()]
    for name, data in older:
        if name in MESSAGE_KINDS:
            with pytest.raises(UnknownVersion, match="protocol version 1"):
                decode(bytes.fromhex(data))


if __name__ == "__main__":
    sys.stdout.write("\n".join(today()) + "\n")
