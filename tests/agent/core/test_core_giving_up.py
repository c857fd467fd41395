"""A log to which nothing refers makes room for another one after an hour; nothing else does."""

import numpy as np
import pytest

from flocc_agent.core.effects import DropLog, Effect, Report, Unicast
from flocc_agent.core.events import MessageReceived
from flocc_agent.core.giving_up import LOOK_PERIOD_S, SILENT_S
from flocc_agent.core.gossip import LIVES_MAX, Gossip
from flocc_agent.core.parameters import CoreParameters, GossipParameters
from flocc_agent.core.reports import LogGivenUp
from flocc_agent.core.restored import Restored
from flocc_agent.core.robot import Robot
from flocc_protocol.arrays import Array
from flocc_protocol.digests import Digests, LogDigest
from flocc_protocol.heartbeats import Heartbeat
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import Envelope, Message, RecordBatch, RecordRequest, Records
from flocc_protocol.records import ClosureRecord, KeyframeRecord, Record

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")
LOGS_MAX = 20


def lives_of(name: str, count: int) -> list[LogId]:
    return [LogId(name, 100 + k) for k in range(count)]


def keyframe(index: int, look: int) -> KeyframeRecord:
    return KeyframeRecord(index, float(index), (float(index), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), Array.int8(look_of(look)))


def look_of(place: int) -> np.ndarray:
    return np.random.default_rng(place).standard_normal(64).astype(np.float32)


def batch(log: LogId, *records: Record) -> RecordBatch:
    source = Gossip(log, GossipParameters())
    batches = [source.append(record)[2] for record in records]
    return RecordBatch(log, 0, 0, tuple(data for each in batches for data in each.records))


def closure(query: LogId, match: LogId) -> ClosureRecord:
    return ClosureRecord(
        query=KeyframeId(query, 0),
        match=KeyframeId(match, 0),
        T_query_match_unscaled=(1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        scale_initial=1.0,
        match_ratio=1.0,
        correspondences=100,
        odometry_correspondences=100,
    )


class Holder:
    """Robot r1, what it is told and what comes of it."""

    def __init__(self, logs_max: int = LOGS_MAX, restored: Restored | None = None) -> None:
        parameters = CoreParameters(gossip=GossipParameters(logs_max=logs_max))
        self.robot = Robot(R1, 0, 7, parameters, 0.0, restored)

    def told(self, sender: LogId, message: Message, now: float) -> list[Effect]:
        return self.robot.handle(MessageReceived(Envelope(sender, message)), now)

    def given(self, now: float, *batches: RecordBatch) -> list[LogId]:
        """Records come from a relay; which logs are given up for that."""
        dropped: list[LogId] = []
        for each in batches:
            effects = self.told(R3, Records((each,)), now)
            dropped += [effect.log for effect in effects if isinstance(effect, DropLog)]
            assert [e.fact.log for e in effects if isinstance(e, Report) and isinstance(e.fact, LogGivenUp)] == [
                effect.log for effect in effects if isinstance(effect, DropLog)
            ]
        return dropped

    @property
    def logs(self) -> set[LogId]:
        return set(self.robot.gossip.logs)


def filled() -> Holder:
    """A robot that holds as many logs of r2 as one name may have."""
    holder = Holder(logs_max=512)
    holder.given(0.0, *(batch(log, keyframe(0, k), keyframe(1, 90 + k)) for k, log in enumerate(lives_of("r2", 16))))
    assert len(holder.logs) == 1 + LIVES_MAX
    return holder


def test_a_robot_that_lost_its_disk_too_often_is_heard_again_after_an_hour() -> None:
    holder, lives = filled(), lives_of("r2", 16)
    again = batch(R2, keyframe(0, 50))
    assert holder.given(SILENT_S - 1.0, again) == []
    assert holder.given(SILENT_S + LOOK_PERIOD_S, again) == [max(lives)]
    holder.given(SILENT_S + LOOK_PERIOD_S + 1.0, again)
    assert holder.logs == {R1, R2, *lives} - {max(lives)}


def test_nothing_is_left_of_a_log_that_made_room() -> None:
    holder, gone = filled(), max(lives_of("r2", 16))
    robot = holder.robot
    rows, keyframes = robot.recognition.rows, robot.assembly.keyframes
    holder.given(SILENT_S, batch(R2, keyframe(0, 50)))
    assert robot.recognition.rows == rows - 2
    assert robot.assembly.keyframes == keyframes - 2
    assert gone not in robot.assembly.graph().trajectories
    assert gone not in {digest.log for digest in robot.gossip.digests()}
    assert not [pair for pair in robot.closing.open_pairs() if gone in (pair.low.log, pair.high.log)]


def test_it_is_not_taken_from_others_again_but_from_its_writer() -> None:
    holder, gone = filled(), max(lives_of("r2", 16))
    holder.given(SILENT_S, batch(R2, keyframe(0, 50)))
    now = SILENT_S + 60.0
    assert holder.given(now, batch(gone, keyframe(0, 15))) == []
    others = holder.told(R3, Digests(7, 1, (LogDigest(gone, 2, 9),), 0, ()), now)
    assert not [e for e in others if isinstance(e, Unicast) and isinstance(e.message, RecordRequest)]
    assert gone not in holder.logs
    holder = Holder(logs_max=3)
    holder.given(0.0, batch(LogId("s1"), keyframe(0, 1)), batch(LogId("s2"), keyframe(0, 2)))
    assert holder.given(SILENT_S, batch(LogId("s3"), keyframe(0, 3))) == [LogId("s2")]
    holder.told(LogId("s2"), Heartbeat(1, 7, 0, None, 0, 0, records=2, checksum=5), SILENT_S + 1.0)
    assert holder.given(SILENT_S + 2.0, batch(LogId("s2"), keyframe(0, 2))) == []
    assert LogId("s2") in holder.logs


@pytest.mark.parametrize("reason", ["a closure", "its writer is near", "news"])
def test_what_somebody_needs_stays(reason: str) -> None:
    holder, lives = filled(), lives_of("r2", 16)
    now = SILENT_S
    if reason == "a closure":
        holder.given(1.0, batch(R3, keyframe(0, 70), *(closure(R3, log) for log in lives)))
    elif reason == "news":
        for k, log in enumerate(lives):
            whole = batch(log, keyframe(0, k), keyframe(1, 90 + k), keyframe(2, 200 + k))
            holder.given(now - 5.0, whole)
    else:
        holder.told(lives[0], Heartbeat(1, 7, 0, None, 0, 0, records=2, checksum=5), now - 1.0)
        assert lives[0] not in holder.given(now, batch(R2, keyframe(0, 50)))
        return
    assert holder.given(now, batch(R2, keyframe(0, 50))) == []
    assert holder.logs >= {R1, *lives}


def test_an_old_log_of_a_full_robot_makes_room_for_a_new_name_and_one_look_is_enough_for_ten_seconds() -> None:
    holder = Holder(logs_max=3)
    holder.given(0.0, batch(LogId("s1"), keyframe(0, 1)), batch(LogId("s2"), keyframe(0, 2)))
    wanted = [batch(LogId(f"w{k}"), keyframe(0, 10 + k)) for k in range(2)]
    assert holder.given(SILENT_S, wanted[0], wanted[0]) == [LogId("s2")]
    assert holder.given(SILENT_S + LOOK_PERIOD_S / 2, wanted[1]) == []
    assert holder.given(SILENT_S + 2 * LOOK_PERIOD_S, wanted[1], wanted[1]) == [LogId("s1")]
    assert holder.logs == {R1, LogId("w0"), LogId("w1")}


def test_rows_that_were_lent_are_given_up_too() -> None:
    holder, writer = Holder(logs_max=3), Gossip(LogId("s1"), GossipParameters())
    for index in range(200):
        holder.given(0.0, writer.append(keyframe(index, index))[2])
    holder.given(SILENT_S, batch(LogId("s2"), *(keyframe(k, 300 + k) for k in range(3))))
    robot = holder.robot
    (rows,) = robot.recognition._others.values()
    assert robot.recognition.rows == 203
    assert len(rows._lent) == 3
    kept = [rows._row(place).copy() for place in rows.places(1).tolist()]
    assert holder.given(SILENT_S, batch(LogId("s3"), keyframe(0, 900))) == [LogId("s1")]
    assert rows._lent == []
    assert rows.numbers == [1]
    np.testing.assert_array_equal([rows._row(place) for place in rows.places(1).tolist()], kept)
