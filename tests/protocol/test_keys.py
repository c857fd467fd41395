"""Claims on the key grammar: what is built is read back, anything else is a DecodeError."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flocc_protocol import keys
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import BadName, KeyframeId, LogId

NAMES = st.from_regex(r"\A[a-z0-9][a-z0-9_-]{0,31}\Z")
KINDS = st.from_regex(r"\A[a-z][a-z0-9_-]{0,15}\Z").filter(lambda kind: kind not in keys.RESERVED)


@given(NAMES, NAMES, KINDS)
def test_reads_back_a_broadcast(swarm: str, sender: str, kind: str) -> None:
    address = keys.parse_message_key(keys.broadcast_key(swarm, sender, kind))
    assert address == keys.Address(swarm, sender, kind)


@given(NAMES, NAMES, NAMES, KINDS)
def test_reads_back_a_unicast(swarm: str, sender: str, receiver: str, kind: str) -> None:
    address = keys.parse_message_key(keys.unicast_key(swarm, sender, receiver, kind))
    assert address == keys.Address(swarm, sender, kind, receiver)


@given(NAMES, NAMES, NAMES, st.integers(0, 2**53 - 1), st.integers(0, 2**31 - 1))
def test_reads_back_the_latent_of_any_keyframe(
    swarm: str, holder: str, robot: str, incarnation: int, index: int
) -> None:
    latent = str(KeyframeId(LogId(robot, incarnation), index))
    assert keys.parse_latent_key(keys.latent_key(swarm, holder, latent)) == (holder, latent)


@given(st.text(max_size=300) | st.from_regex(r"\Aflocc/v2/[a-z*$/]{0,60}\Z"))
def test_any_other_text_is_a_decode_error_or_an_address(text: str) -> None:
    for parse in (keys.parse_message_key, keys.parse_latent_key, keys.parse_alive_key, keys.parse_admin_key):
        try:
            parse(text)
        except DecodeError:
            continue


def test_writes_the_documented_keys() -> None:
    assert keys.broadcast_key("field", "r1", keys.Kind.HEARTBEAT) == "flocc/v2/field/r1/heartbeat"
    assert keys.unicast_key("field", "r1", "r2", "pull") == "flocc/v2/field/r1/to/r2/pull"
    assert keys.latent_key("field", "r1", "r1~5/7") == "flocc/v2/field/r1/latent/r1~5/7"
    assert keys.admin_key("field", "*", keys.Admin.STATUS) == "flocc/v2/field/*/status"
    assert keys.alive_key("field", "r1", "0f") == "flocc/v2/field/r1/alive/0f"


@given(NAMES, NAMES, st.sampled_from(keys.Admin))
def test_reads_back_who_answers_an_operator(swarm: str, robot: str, admin: keys.Admin) -> None:
    assert keys.parse_admin_key(keys.admin_key(swarm, robot, admin)) == robot


def test_names_the_version_of_a_foreign_key() -> None:
    with pytest.raises(DecodeError, match="protocol version 'v1'"):
        keys.parse_message_key("flocc/v1/field/r1/hb")


def test_recognises_a_stranger_of_another_version_by_its_token() -> None:
    assert keys.parse_alive_key("flocc/v1/farm/r9/alive/ab") == keys.Presence("v1", "farm", "r9", "ab")


@pytest.mark.parametrize("name", ["", "R1", "r 1", "r*", "r/1", "a" * 33])
def test_refuses_a_name_that_is_no_chunk(name: str) -> None:
    with pytest.raises(BadName):
        keys.broadcast_key("field", name, "hb")


@pytest.mark.parametrize("kind", ["", "to", "latent", "alive", "status", "h/b", "HB", "h*"])
def test_refuses_a_kind_that_the_grammar_reserves(kind: str) -> None:
    with pytest.raises(ValueError, match="kind"):
        keys.broadcast_key("field", "r1", kind)
