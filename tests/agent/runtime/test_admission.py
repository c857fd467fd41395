"""What is taken in of peers, and what is said of the rest."""

import msgpack
from tests.protocol.wire_examples import ENVELOPES

from flocc_agent.runtime.admission import DETAIL_MAX, Refusal, admitted
from flocc_protocol.messages import encode, kind_of

ENVELOPE = ENVELOPES[0]
KIND, SENDER = kind_of(ENVELOPE.message), ENVELOPE.sender.robot


def test_a_message_under_its_own_key_is_taken_in() -> None:
    assert admitted(SENDER, KIND, encode(ENVELOPE)) == ENVELOPE


def test_who_writes_a_malformed_message_learns_what_is_wrong_with_it() -> None:
    version, kind, _, fields = msgpack.unpackb(encode(ENVELOPE))
    refusal = admitted(SENDER, KIND, msgpack.packb([version, kind, SENDER, fields]))
    assert isinstance(refusal, Refusal)
    assert refusal.reason == "malformed message"  # one for all, so that they are counted together
    assert KIND in refusal.detail
    assert "got `str`" in refusal.detail
    assert len(refusal.detail) <= DETAIL_MAX


def test_nobody_writes_for_another_robot() -> None:
    refusal = admitted("stranger", KIND, encode(ENVELOPE))
    assert isinstance(refusal, Refusal)
    assert "another robot" in refusal.reason
