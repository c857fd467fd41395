"""What one peer may cost: bytes of answers, and signatures that fail."""

import pytest
from tests.agent.core.virtual_time import descriptor

from flocc_agent.core.effects import Unicast
from flocc_agent.core.events import MessageReceived
from flocc_agent.core.gossip import Gossip
from flocc_agent.core.parameters import CoreParameters, GossipParameters
from flocc_agent.core.peer_budgets import (
    ANSWER_BURST_BYTES,
    ANSWER_BYTES_PER_S,
    FORGIVEN_S,
    MUTED_FIRST_S,
    MUTED_MAX_S,
    AnswerBudget,
    Muted,
)
from flocc_agent.core.robot import Robot
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import LogId
from flocc_protocol.messages import Envelope, LogPosition, RecordBatch, RecordRequest, Records
from flocc_protocol.records import KeyframeRecord

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")


class Counting:
    """A sealer that believes nothing of r3, and counts what it was asked."""

    checked = 0

    def seal(self, log: LogId, number: int, record: bytes) -> bytes:
        return record

    def opened(self, log: LogId, number: int, sealed: bytes) -> bytes:
        self.checked += 1
        if log == R3:
            raise DecodeError("not signed by r3")
        return sealed

    def sign_correction(self, correction: bytes) -> bytes:
        return b""

    def check_correction(self, leader: LogId, correction: bytes, signature: bytes) -> None:
        return None


def written(log: LogId) -> RecordBatch:
    record = KeyframeRecord(0, 0.0, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), descriptor(1))
    return Gossip(log, GossipParameters()).append(record)[2]


def test_a_request_of_a_few_bytes_draws_no_more_than_its_budget() -> None:
    budget, answer = AnswerBudget(), Unicast("r2", Records((written(R1),)))
    size = written(R1).size_bytes
    many = [answer] * (int(ANSWER_BURST_BYTES) // size + 10)
    assert len(budget.within("r2", list(many), 0.0)) == int(ANSWER_BURST_BYTES) // size
    assert budget.within("r2", [answer], 0.0) == []
    assert budget.within("r3", [answer], 0.0) == [answer]
    assert len(budget.within("r2", list(many), 1.0)) == pytest.approx(ANSWER_BYTES_PER_S / size, abs=2)


def test_a_peer_is_muted_for_longer_each_time_and_forgiven() -> None:
    muted, now, pauses = Muted(), 0.0, []
    for _ in range(9):
        muted.on_failed("r2", "r3", now)
        pause_s = next(s for s in range(1, 200) if not muted.is_muted("r2", "r3", now + s))
        pauses.append(pause_s)
        now += pause_s
    assert pauses == [1, 2, 4, 8, 16, 32, 64, 64, 64]
    assert not muted.is_muted("r2", "r1", now - 1)
    muted.on_failed("r2", "r3", now + FORGIVEN_S)
    assert muted.is_muted("r2", "r3", now + FORGIVEN_S + MUTED_FIRST_S / 2)
    assert not muted.is_muted("r2", "r3", now + FORGIVEN_S + MUTED_FIRST_S)
    assert max(pauses) == MUTED_MAX_S


def test_a_flood_of_badly_signed_records_is_checked_a_few_times_only_and_others_records_are_taken() -> None:
    sealer = Counting()
    robot = Robot(R1, 0, 7, CoreParameters(), 0.0, sealer=sealer)
    for k in range(5340):
        robot.handle(MessageReceived(Envelope(R2, Records((written(R3),)))), k / 534)
    assert sealer.checked <= 5
    robot.handle(MessageReceived(Envelope(R2, Records((written(R2),)))), 10.0)
    assert len(robot.gossip.logs[R2]) == 1


def test_a_robot_answers_one_name_within_its_budget() -> None:
    robot = Robot(R1, 0, 7, CoreParameters(), 0.0)
    robot.handle(MessageReceived(Envelope(R2, Records((written(R2),)))), 0.0)
    asked = MessageReceived(Envelope(R3, RecordRequest((LogPosition(R2, 0),) * 64)))
    answers = [e for _ in range(3000) for e in robot.handle(asked, 0.0) if isinstance(e, Unicast)]
    sizes = [sum(b.size_bytes for b in e.message.batches) for e in answers if isinstance(e.message, Records)]
    assert 0 < sum(sizes) <= ANSWER_BURST_BYTES
    assert len(answers) < 3000
