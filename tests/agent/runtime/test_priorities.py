"""Claim: what the transport knows of kinds are the kinds of real messages; heartbeats go before everything."""

import zenoh

from flocc_agent.runtime.inbox import URGENT_FIRST
from flocc_agent.runtime.zenoh_transport import EXPRESS, PRIORITY
from flocc_protocol.messages import MESSAGE_KINDS


def test_every_kind_of_message_has_a_priority_and_a_queue() -> None:
    assert set(PRIORITY) == set(MESSAGE_KINDS)
    assert set(URGENT_FIRST) == set(MESSAGE_KINDS)


def test_heartbeats_alone_have_the_highest_priority() -> None:
    assert [kind for kind in MESSAGE_KINDS if PRIORITY[kind] == zenoh.Priority.REAL_TIME] == ["heartbeat"]
    assert URGENT_FIRST[0] == "heartbeat"


def test_heartbeats_and_elections_are_not_batched() -> None:
    assert {"heartbeat", "election", "answer", "coordinator", "handover"} == EXPRESS
