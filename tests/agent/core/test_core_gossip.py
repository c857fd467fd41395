"""Replicated logs: digests, pulls, relays, forks."""

from dataclasses import replace
from itertools import pairwise

from tests.agent.core.virtual_time import Robots, keyframe

from flocc_agent.core.effects import Effect, PersistRecord, Report, Unicast
from flocc_agent.core.gossip import LIVES_MAX, Gossip
from flocc_agent.core.parameters import GossipParameters
from flocc_agent.core.pulls import BACKOFF_MAX_S, REQUEST_PERIOD_S
from flocc_agent.core.reports import Fact, LogForked, PeerRefused
from flocc_protocol.ids import LogId
from flocc_protocol.messages import LogDigest, LogPosition, RecordBatch, RecordRequest, Records
from flocc_protocol.records import KeyframeRecord, RejectionRecord, encode_record

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")
PARAMETERS = GossipParameters()


def record(index: int, x_m: float = 0.0) -> KeyframeRecord:
    return KeyframeRecord(index, float(index), (x_m, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None)


def writer(own: LogId, count: int, x_m: float = 0.0) -> Gossip:
    gossip = Gossip(own, PARAMETERS)
    for index in range(count):
        gossip.append(record(index, x_m))
    return gossip


def batch(source: Gossip, log: LogId, first: int) -> Records:
    answers = source.on_request(LogId("asker"), RecordRequest((LogPosition(log, first),)))
    assert isinstance(answers[0], Unicast)
    assert isinstance(answers[0].message, Records)
    return answers[0].message


def requests(effects: list[Effect]) -> list[tuple[str, int]]:
    asked = [(e.to, e.message) for e in effects if isinstance(e, Unicast) and isinstance(e.message, RecordRequest)]
    return [(to, position.first) for to, message in asked for position in message.positions]


def facts(effects: list[Effect]) -> list[type[Fact]]:
    return [type(effect.fact) for effect in effects if isinstance(effect, Report)]


def test_a_longer_copy_elsewhere_is_asked_for_from_where_this_one_ends() -> None:
    reader = Gossip(R2, PARAMETERS)
    reader.on_records(R1, batch(writer(R1, 3), R1, 0), 0.0)
    assert requests(reader.on_digests(R1, writer(R1, 5).digests(), 1.0)) == [("r1", 3)]


def test_one_log_is_asked_of_one_peer_at_a_time() -> None:
    reader, digests = Gossip(R3, PARAMETERS), writer(R1, 5).digests()
    reader.on_digests(R1, digests, 0.0)
    assert reader.on_digests(R2, digests, 0.5) == []


def test_a_lost_answer_is_asked_of_another_peer() -> None:
    reader, digests = Gossip(R3, PARAMETERS), writer(R1, 5).digests()
    reader.on_digests(R1, digests, 0.0)
    assert requests(reader.on_digests(R2, digests, 1.0)) == [("r2", 0)]


def test_a_peer_that_does_not_deliver_is_asked_ever_more_rarely() -> None:
    reader, claims = Gossip(R3, PARAMETERS), (LogDigest(R1, 5, 77),)
    asked_s = [t / 10 for t in range(600) if requests(reader.on_digests(R2, claims, t / 10))]
    pauses_s = [b - a for a, b in pairwise(asked_s)]
    assert pauses_s[0] < 2.0
    assert max(pauses_s) >= BACKOFF_MAX_S
    assert len(asked_s) < 15


def test_a_repeated_or_late_batch_changes_nothing() -> None:
    reader, source = Gossip(R2, PARAMETERS), writer(R1, 5)
    reader.on_records(R1, batch(source, R1, 0), 0.0)
    before = reader.digests()
    assert reader.on_records(R1, batch(source, R1, 0), 1.0) == ([], [])
    assert reader.on_records(R1, batch(source, R1, 2), 1.0) == ([], [])
    assert reader.digests() == before


def test_a_gap_is_asked_for_at_once() -> None:
    reader = Gossip(R2, PARAMETERS)
    assert requests(reader.on_records(R1, batch(writer(R1, 5), R1, 3), 0.0)[1]) == [("r1", 0)]


def test_a_long_log_is_pulled_batch_after_batch() -> None:
    reader, source = Gossip(R2, PARAMETERS), writer(R1, 150)
    effects, now = reader.on_digests(R1, source.digests(), 0.0), 0.0
    while requests(effects):
        now += 0.01
        first = requests(effects)[0][1]
        effects = reader.on_records(R1, batch(source, R1, first), now)[1]
    assert reader.digests() == source.digests()
    assert now < 0.1


def test_new_records_are_persisted_in_order() -> None:
    reader = Gossip(R2, PARAMETERS)
    effects = reader.on_records(R1, batch(writer(R1, 3), R1, 0), 0.0)[1]
    assert [(e.log, e.number) for e in effects if isinstance(e, PersistRecord)] == [(R1, 0), (R1, 1), (R1, 2)]


def test_a_fork_is_reported_once_and_neither_side_is_damaged() -> None:
    reader = Gossip(R3, PARAMETERS)
    reader.on_records(R1, batch(writer(R1, 3), R1, 0), 0.0)
    before = reader.digests()
    other = writer(R1, 5, x_m=1.0)
    assert facts(reader.on_records(R2, batch(other, R1, 3), 1.0)[1]) == [LogForked]
    assert reader.on_records(R2, batch(other, R1, 3), 2.0) == ([], [])
    assert reader.on_digests(R2, other.digests(), 3.0) == []
    assert reader.digests() == before


def test_a_batch_that_contradicts_the_copy_within_it_is_refused_whole() -> None:
    reader = Gossip(R3, PARAMETERS)
    reader.on_records(R1, batch(writer(R1, 3), R1, 0), 0.0)
    new, effects = reader.on_records(R2, batch(writer(R1, 5, x_m=1.0), R1, 0), 1.0)
    assert (new, facts(effects)) == ([], [LogForked])
    assert len(reader.logs[R1]) == 3


def test_a_claim_about_the_own_log_is_followed_by_asking_for_its_records() -> None:
    robot = writer(R1, 2)
    claims = [LogDigest(R1, 4, 77), LogDigest(R1, 2, 77), LogDigest(R1, 1, 77)]
    for peer, claim, first in zip((R2, R3, LogId("r4")), claims, (2, 0, 0), strict=True):
        assert robot.on_digests(peer, (claim,), 0.0) == [Unicast(peer.robot, RecordRequest((LogPosition(R1, first),)))]
    assert robot.on_digests(R3, (LogDigest(R1, 2, 78),), 0.1) == []


def test_the_own_log_is_never_written_by_others() -> None:
    for first in (0, 1, 2):
        robot = writer(R1, 2)
        new, effects = robot.on_records(R2, batch(writer(R1, 4, x_m=float(first < 2)), R1, first), 0.0)
        assert (new, facts(effects)) == ([], [LogForked])
        assert len(robot.logs[R1]) == 2


def test_what_is_no_record_says_nothing_of_the_own_log() -> None:
    robot = writer(R1, 2)
    (good,) = batch(writer(R1, 4), R1, 2).batches
    for data in (b"", b"\x00", good.records[0][:-1], bytes(60)):
        effects = robot.on_records(R2, Records((replace(good, records=(data,)),)), 0.0)[1]
        assert LogForked not in facts(effects)


def test_an_old_contradiction_in_the_own_log_is_followed_to_where_it_began() -> None:
    robot, other = writer(R1, 200), writer(R1, 200, x_m=1.0)
    other_end = other.digests()
    asked = robot.on_digests(R2, other_end, 0.0)
    assert [effect.message.positions[0].first for effect in asked if isinstance(effect, Unicast)] == [136]  # type: ignore[union-attr]
    part = batch(other, R1, 136).batches[0]
    same = replace(part, records=tuple(robot.logs[R1].encoded[136:200]))
    (before,) = robot.on_records(R2, Records((same,)), 0.1)[1]
    assert before == Unicast("r2", RecordRequest((LogPosition(R1, 72),)))


def test_a_damaged_record_is_refused_and_what_came_before_it_kept() -> None:
    reader, good = Gossip(R2, PARAMETERS), batch(writer(R1, 3), R1, 0).batches[0]
    damaged = replace(good, records=(good.records[0], b"\x00", good.records[2]))
    new, effects = reader.on_records(R1, Records((damaged,)), 0.0)
    assert [entry.number for entry in new] == [0]
    assert facts(effects) == [PeerRefused]


def test_keyframes_are_numbered_without_gaps() -> None:
    reader = Gossip(R2, PARAMETERS)
    skipped = RecordBatch(R1, 0, 0, (encode_record(record(1)),))
    assert reader.on_records(R1, Records((skipped,)), 0.0)[0] == []


def test_logs_beyond_the_maximum_are_refused_without_asking() -> None:
    reader = Gossip(R1, GossipParameters(logs_max=2))
    reader.on_records(R2, batch(writer(R2, 1), R2, 0), 0.0)
    digests = writer(R3, 4).digests()
    assert facts(reader.on_digests(R3, digests, 0.0)) == [PeerRefused]
    assert reader.on_digests(R3, digests, 1.0) == []


def test_many_logs_of_one_robot_leave_room_for_others() -> None:
    reader, liar = Gossip(R1, PARAMETERS), LogId("r9")
    told: list[type[Fact]] = []
    for life in range(PARAMETERS.logs_max):
        log = LogId("r9", life)
        told += facts(reader.on_records(liar, batch(writer(log, 1), log, 0), 0.0)[1])
    assert len(reader.logs) == 1 + LIVES_MAX
    assert told == [PeerRefused]
    late = writer(R2, 3)
    assert requests(reader.on_digests(R2, late.digests(), 1.0)) == [("r2", 0)]
    reader.on_records(R2, batch(late, R2, 0), 1.0)
    assert len(reader.logs[R2]) == 3


def test_names_that_fill_their_places_leave_room_for_first_logs_of_others() -> None:
    parameters = GossipParameters(logs_max=64)
    reader, told = Gossip(R1, parameters), list[type[Fact]]()
    for name in range(6):
        for life in range(LIVES_MAX):
            log = LogId(f"rogue{name}", life)
            told += facts(reader.on_records(LogId(f"rogue{name}"), batch(writer(log, 1), log, 0), 0.0)[1])
    assert told
    for name in range(10):
        log = LogId(f"late{name}")
        reader.on_records(log, batch(writer(log, 2), log, 0), 1.0)
        assert len(reader.logs[log]) == 2
    assert len(reader.logs) <= parameters.logs_max


def test_claims_of_what_nobody_has_do_not_fill_the_memory() -> None:
    reader = Gossip(R1, PARAMETERS)
    for t in range(3000):
        reader.on_digests(R2, (LogDigest(LogId("r9", t), 5, 1),), float(t))
    assert all(size <= size_max for size, size_max in reader.sizes().values())
    assert reader.sizes()["ahead"] == (PARAMETERS.logs_max, PARAMETERS.logs_max)


def library(own: LogId, counts: dict[LogId, int]) -> Gossip:
    """A robot that holds copies of several logs."""
    gossip = Gossip(own, PARAMETERS)
    for log, count in counts.items():
        gossip.on_records(log, batch(writer(log, count), log, 0), 0.0)
    return gossip


def answer_to(source: Gossip, effects: list[Effect]) -> Records:
    (asked,) = [e.message for e in effects if isinstance(e, Unicast) and isinstance(e.message, RecordRequest)]
    (given,) = [e.message for e in source.on_request(LogId("asker"), asked) if isinstance(e, Unicast)]
    assert isinstance(given, Records)
    return given


def test_one_request_names_all_logs_that_a_peer_has_more_of_and_one_message_answers() -> None:
    source, reader = library(R3, {R1: 4, R2: 6}), Gossip(LogId("r4"), PARAMETERS)
    effects = reader.on_digests(R3, source.digests(), 0.0)
    assert requests(effects) == [("r3", 0), ("r3", 0)]
    reader.on_records(R3, answer_to(source, effects), 0.1)
    assert reader.digests() == source.digests()


def test_what_did_not_fit_an_answer_is_asked_for_at_once_until_all_is_here() -> None:
    logs = {LogId(f"w{k}"): 60 for k in range(30)}
    source, reader = library(R3, logs), Gossip(LogId("r4"), PARAMETERS)
    effects, answers = reader.on_digests(R3, source.digests(), 0.0), 0
    while requests(effects):
        effects = reader.on_records(R3, answer_to(source, effects), 0.1)[1]
        answers += 1
    assert reader.digests() == source.digests()
    assert 1 < answers < 30


def test_requests_that_heartbeats_call_for_have_a_least_pause() -> None:
    source, reader, asked = writer(R1, 1), Gossip(R2, PARAMETERS), []
    for t in range(20):
        source.append(record(len(source.logs[R1])))
        effects = reader.on_digests(R1, source.digests(), t / 10)
        if requests(effects):
            asked.append(t / 10)
            reader.on_records(R1, answer_to(source, effects), t / 10)
    assert min(b - a for a, b in pairwise(asked)) >= REQUEST_PERIOD_S
    assert len(asked) >= 4


def test_the_last_record_of_a_robot_in_range_is_left_to_its_own_broadcast_for_a_moment() -> None:
    reader = Gossip(R3, PARAMETERS, near=lambda robot, now: robot == "r1")
    source, relay = writer(R1, 5), library(R2, {R1: 6})
    reader.on_records(R1, batch(source, R1, 0), 0.0)
    assert requests(reader.on_digests(R2, relay.digests(), 1.0)) == []
    assert requests(reader.on_digests(R2, relay.digests(), 1.1)) == []
    assert requests(reader.on_digests(R2, relay.digests(), 1.3)) == [("r2", 5)]


def test_many_missing_records_are_asked_for_at_once() -> None:
    reader = Gossip(R3, PARAMETERS, near=lambda robot, now: True)
    assert requests(reader.on_digests(R2, library(R2, {R1: 6}).digests(), 1.0)) == [("r2", 0)]


def test_what_a_peer_out_of_range_was_to_send_is_asked_of_another_one_without_waiting() -> None:
    reader, digests = Gossip(R3, PARAMETERS), writer(R1, 5).digests()
    reader.on_digests(R1, digests, 0.0)
    reader.on_lost("r1")
    assert requests(reader.on_digests(R2, digests, 0.5)) == [("r2", 0)]


def test_records_cross_robots_that_never_meet() -> None:
    robots = Robots()
    for name in ("r1", "r2", "r3"):
        robots.add(name)
    robots.separate("r1", "r3")
    for k in range(5):
        robots.capture("r1", float(k), look=k)
    robots.run(5.0)
    assert len(robots.cores["r3"].gossip.logs[R1]) == 5


def test_records_are_carried_by_a_robot_that_moves_from_one_to_the_other() -> None:
    robots = Robots()
    for name in ("r1", "r2", "r3"):
        robots.add(name)
    robots.separate("r1 r2", "r3")
    for k in range(5):
        robots.capture("r1", float(k), look=k)
    robots.run(5.0)
    robots.separate("r1", "r2 r3")
    robots.run(5.0)
    assert len(robots.cores["r3"].gossip.logs[R1]) == 5


def test_everything_arrives_though_every_broadcast_of_records_is_lost() -> None:
    lost: list[object] = []

    def drops(sender: str, receiver: str, message: object) -> bool:
        lost.extend([message] if isinstance(message, Records) else [])
        return isinstance(message, Records) and len(lost) <= 6

    robots = Robots(drops=drops)
    robots.add("r1")
    robots.add("r2")
    for k in range(6):
        robots.capture("r1", float(k), look=k)
    robots.run(10.0)
    assert robots.cores["r2"].gossip.logs[R1].encoded == robots.cores["r1"].gossip.logs[R1].encoded


def test_rejections_travel_like_keyframes() -> None:
    source, reader = Gossip(R1, PARAMETERS), Gossip(R2, PARAMETERS)
    source.append(RejectionRecord(keyframe("r1/0"), keyframe("r2/0"), "few correspondences", 3, 9))
    new = reader.on_records(R1, batch(source, R1, 0), 0.0)[0]
    assert [entry.record for entry in new] == source.logs[R1].records
