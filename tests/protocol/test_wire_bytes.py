"""Claim: the bytes of a protocol version never change. Each has a file here with one example of everything.

A change that breaks this needs a new protocol version; then write a new file beside the old ones:
`python -m tests.protocol.test_wire_bytes > tests/protocol/wire_v6.txt`.
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


def lines_of(version: int) -> list[list[str]]:
    """Name and bytes of every example of a version."""
    return [line.split() for line in (Path(__file__).parent / f"wire_v{version}.txt").read_text().splitlines()]


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


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_messages_of_an_older_version_are_named_as_such(version: int) -> None:
    for name, data in lines_of(version):
        if name in MESSAGE_KINDS:
            with pytest.raises(UnknownVersion, match=f"protocol version {version}"):
                decode(bytes.fromhex(data))


def test_the_records_of_version_2_are_read_as_ever() -> None:
    """Stores hold them; records have no version, and a change of their bytes is a new code."""
    older = [data for name, data in lines_of(2) if name[0].isupper()]
    read = [decode_record(bytes.fromhex(data)) for data in older]
    assert read == list(RECORDS[: len(older)])


if __name__ == "__main__":
    sys.stdout.write("\n".join(today()) + "\n")
