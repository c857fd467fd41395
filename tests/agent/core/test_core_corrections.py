"""Corrections are fenced by (term, round), passed on, and asked for."""

from dataclasses import replace

import numpy as np
import pytest
from tests.agent.core.virtual_time import Robots
from tests.protocol.wire_examples import knots

from flocc_agent.core.corrections import ASKED_MAX, KNOTS_PAUSE_PER_LOG_S, TOLD_MAX, Corrections
from flocc_agent.core.effects import Broadcast, Deliver, Effect, PersistCorrection, Report, Unicast
from flocc_agent.core.election import FIRST_COUNTER_MAX
from flocc_agent.core.events import MessageReceived
from flocc_agent.core.gossip import LIVES_MAX, Sealer
from flocc_agent.core.knot_requests import GRACE_S
from flocc_agent.core.parameters import CoreParameters, GossipParameters
from flocc_agent.core.peer_budgets import MUTED_FIRST_S
from flocc_agent.core.pose_graph import Component, GraphSolution
from flocc_agent.core.pulls import REMEMBERED_MAX
from flocc_agent.core.reports import CorrectionApplied, PeerRefused
from flocc_agent.core.restored import Restored
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import Float, pose, pose7
from flocc_protocol.arrays import Array
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import TERM_COUNTER_MAX, LogId, Term
from flocc_protocol.messages import (
    CorrectionBatch,
    CorrectionRequest,
    CorrectionVersion,
    Digests,
    Envelope,
    KnotRequest,
    Knots,
    LogCorrection,
)
from flocc_protocol.records import SIGNATURE_BYTES

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")


def corrections(own: LogId = R1) -> Corrections:
    return Corrections(own, GossipParameters())


def correction(term: Term, number: int, log: LogId = R1, anchor: LogId = R1) -> LogCorrection:
    """With one knot: all of the odometry moves as one."""
    return LogCorrection(log, term, number, anchor, pose7(np.eye(4)), knots(1))


def short(message: LogCorrection) -> LogCorrection:
    """As everybody but its owner gets it."""
    return replace(message, knots=None)


def line(keyframes: int) -> Float:
    """Odometry along x."""
    return np.array([pose(np.eye(3), np.array([float(k), 0.0, 0.0])) for k in range(keyframes)])


def leader(
    own: LogId = R1, near: tuple[str, ...] = (), sealer: Sealer | None = None, keyframes: int = 3
) -> Corrections:
    """With as long an odometry of every log."""
    return Corrections(own, GossipParameters(), sealer, lambda log: line(keyframes), near.__contains__)


def delivered(effects: list[Effect]) -> list[tuple[int, int, bool]]:
    found = [e for e in effects if isinstance(e, Deliver)]
    return [(e.correction.term.counter, e.correction.round, e.frame_changed) for e in found]


def solution(shift_m: float = 0.0, keyframes: int = 3) -> GraphSolution:
    poses = np.array([pose(np.eye(3), np.array([k + shift_m, 0.0, 0.0])) for k in range(keyframes)])
    component = Component((R1,), {R1: poses}, {R1: pose(np.eye(3), np.array([shift_m, 0.0, 0.0]))}, {R1: None})
    return GraphSolution((component,), ())


def test_a_newer_correction_is_applied_and_persisted_first() -> None:
    effects = corrections().on_message("r2", correction(Term(1, R2), 1))
    kinds = [type(effect) for effect in effects]
    assert delivered(effects) == [(1, 1, False)]
    assert kinds.index(PersistCorrection) < kinds.index(Deliver)


def test_an_older_or_equal_correction_is_not_applied() -> None:
    machine = corrections()
    machine.on_message("r2", correction(Term(2, R2), 5))
    for late in (correction(Term(2, R2), 5), correction(Term(2, R2), 4), correction(Term(1, R3), 9)):
        assert machine.on_message("r2", late) == []


def test_of_one_counter_the_higher_leader_log_is_newer() -> None:
    machine = corrections()
    machine.on_message("r2", correction(Term(2, R3), 1))
    assert machine.on_message("r2", correction(Term(2, R2), 9)) == []


def test_a_jump_of_the_frame_is_told() -> None:
    machine = corrections(R2)
    machine.on_message("r2", correction(Term(1, R2), 1, log=R2, anchor=R2))
    assert delivered(machine.on_message("r2", correction(Term(1, R2), 2, log=R2, anchor=R1))) == [(1, 2, True)]


def test_what_was_applied_before_a_restart_still_fences() -> None:
    machine = corrections()
    machine.restore(correction(Term(4, R2), 3), frame_changed=False)
    assert machine.on_message("r2", correction(Term(4, R2), 2)) == []
    assert delivered(machine.on_message("r2", correction(Term(4, R2), 4, anchor=R2))) == [(4, 4, True)]


def test_a_restarted_robot_bids_above_what_it_applied() -> None:
    assert Restored(term_counter=2, correction=correction(Term(9, R3), 1)).counter_max() == 9


def test_another_robots_correction_is_kept_and_passed_on() -> None:
    machine, message = corrections(R1), correction(Term(1, R2), 1, log=R3)
    assert machine.on_message("r2", message) == []
    assert machine.on_request("r3", CorrectionRequest((R3,))) == [Unicast("r3", CorrectionBatch((short(message),)))]


def test_a_newer_version_elsewhere_is_asked_for_once_per_timeout() -> None:
    machine, versions = corrections(), (CorrectionVersion(R1, Term(1, R2), 1),)
    assert machine.on_versions("r2", versions, 0.0) == [Unicast("r2", CorrectionRequest((R1,)))]
    assert machine.on_versions("r2", versions, 0.5) == []
    assert machine.on_versions("r2", versions, 1.0) == [Unicast("r2", CorrectionRequest((R1,)))]


def test_another_peer_is_asked_for_it_when_the_first_was_not_heard_again() -> None:
    machine, versions = corrections(), (CorrectionVersion(R1, Term(1, R2), 1),)
    machine.on_versions("r2", versions, 0.0)
    assert machine.on_versions("r3", versions, 1.0) == []
    assert machine.ask("r3", 2.0) == [Unicast("r3", CorrectionRequest((R1,)))]


def test_what_somebody_says_to_hold_and_nobody_sends_is_given_up() -> None:
    machine, questions = corrections(), 0
    machine.on_versions("r2", (CorrectionVersion(R1, Term(1, R2), 1),), 0.0)
    for second in range(1, 60):
        questions += len(machine.ask("r2", float(second)))
    assert questions == ASKED_MAX - 1
    assert machine.sizes()["wanted_corrections"][0] == 0


def test_versions_of_strangers_do_not_fill_the_memory() -> None:
    machine = corrections()
    for t in range(2000):
        machine.on_versions("r2", (CorrectionVersion(LogId("r9", t), Term(1, R2), 1),), 0.0)
    assert machine.sizes()["wanted_corrections"] == (REMEMBERED_MAX, REMEMBERED_MAX)


def test_what_did_not_move_is_not_sent_again_in_one_term() -> None:
    machine = leader()
    first = machine.publish(Term(1, R1), 1, solution())
    assert isinstance(first[0], Broadcast)
    assert machine.publish(Term(1, R1), 2, solution()) == []
    assert delivered(machine.publish(Term(1, R1), 3, solution(shift_m=0.5))) == [(1, 3, False)]
    assert delivered(machine.publish(Term(2, R1), 1, solution(shift_m=0.5))) == [(2, 1, False)]


class Seals:
    """Signatures that name their signer."""

    def __init__(self, robot: str) -> None:
        self._robot = robot

    def seal(self, log: LogId, number: int, record: bytes) -> bytes:
        return record

    def opened(self, log: LogId, number: int, sealed: bytes) -> bytes:
        return sealed

    def sign_correction(self, correction: bytes) -> bytes:
        return self._robot.encode().ljust(SIGNATURE_BYTES, b".")

    def check_correction(self, leader: LogId, correction: bytes, signature: bytes) -> None:
        if signature.rstrip(b".") != leader.robot.encode():
            raise DecodeError("forged")


def test_a_jump_in_whose_middle_the_robot_died_is_told_after_the_restart() -> None:
    machine = corrections()
    machine.on_message("r2", correction(Term(1, R2), 1, anchor=R2))
    (kept,) = [e for e in machine.on_message("r2", correction(Term(1, R2), 2)) if isinstance(e, PersistCorrection)]
    assert kept.frame_changed
    again = corrections()
    again.restore(kept.correction, kept.frame_changed)
    assert delivered(again.on_message("r2", correction(Term(1, R2), 3))) == [(1, 3, True)]
    assert delivered(again.on_message("r2", correction(Term(1, R2), 4))) == [(1, 4, False)]


def test_corrections_of_many_logs_of_one_robot_leave_room_for_others() -> None:
    machine = corrections()
    for life in range(2 * GossipParameters().logs_max):
        machine.on_message("r9", correction(Term(1, R2), 1, log=LogId("r9", life)))
    assert machine.sizes()["corrections"][0] == LIVES_MAX
    assert delivered(machine.on_message("r2", correction(Term(1, R2), 1))) == [(1, 1, False)]


def test_a_relay_cannot_forge_a_correction() -> None:
    machine = Corrections(R1, GossipParameters(), Seals("r1"))
    genuine = replace(correction(Term(1, R2), 1), signature=Seals("r2").sign_correction(b""))
    for forged in (replace(genuine, signature=b""), replace(genuine, term=Term(9, R3))):
        effects = machine.on_message("r3", forged)
        assert effects == [Report(PeerRefused(peer="r3", reason="correction without its leader's signature"))]
    assert delivered(machine.on_message("r3", genuine)) == [(1, 1, False)]


def test_a_leader_signs_what_it_publishes() -> None:
    machine = leader(R2, sealer=Seals("r2"))
    (sent,) = [e.message for e in machine.publish(Term(1, R2), 1, solution()) if isinstance(e, Broadcast)]
    assert isinstance(sent, CorrectionBatch)
    assert [c.signature.rstrip(b".") for c in sent.corrections] == [b"r2"]


def test_a_correction_of_an_absurd_term_is_refused() -> None:
    robots = Robots()
    robots.add("r1")
    hostile = correction(Term(TERM_COUNTER_MAX, R2), 1)
    robots.put("r1", MessageReceived(Envelope(R2, CorrectionBatch((hostile,)))))
    assert robots.effects("r1", Deliver) == []
    assert len(robots.facts("r1", PeerRefused)) == 1


def test_a_forged_correction_raises_no_counter() -> None:
    robot = Robot(R1, 0, 1, CoreParameters(), 0.0, sealer=Seals("r1"))
    forged = replace(correction(Term(900, R2), 1), signature=Seals("r3").sign_correction(b""))
    robot.handle(MessageReceived(Envelope(R3, CorrectionBatch((forged,)))), 0.1)
    assert robot.election.counter_max == 0
    genuine = replace(forged, signature=Seals("r2").sign_correction(b""))
    effects = robot.handle(MessageReceived(Envelope(R3, CorrectionBatch((genuine,)))), 0.1 + MUTED_FIRST_S)
    assert robot.election.counter_max == 900
    assert delivered(effects) == [(900, 1, False)]


def test_versions_that_nobody_holds_raise_no_counter() -> None:
    robot = Robot(R1, 0, 1, CoreParameters(), 0.0)
    lie = Digests(7, 0, (), 1, (CorrectionVersion(R2, Term(900, R2), 1),))
    robot.handle(MessageReceived(Envelope(R2, lie)), 0.1)
    assert robot.election.counter_max == 0


def test_a_lost_correction_is_repaired_by_heartbeats() -> None:
    lost = {"count": 0}

    def drops(sender: str, receiver: str, message: object) -> bool:
        lost["count"] += isinstance(message, CorrectionBatch)
        return isinstance(message, CorrectionBatch) and lost["count"] <= 4

    robots = Robots(drops=drops)
    robots.add("r1")
    robots.add("r2")
    robots.capture("r2", 0.0, look=1)
    robots.run(12.0)
    assert robots.frames() == {"r2": "map/r2"}


def test_a_robot_without_closures_gets_a_frame_of_its_own() -> None:
    robots = Robots()
    for k, name in enumerate(("r1", "r2")):
        robots.add(name)
        robots.capture(name, 0.0, look=k)
    robots.run(8.0)
    assert robots.frames() == {"r1": "map/r1", "r2": "map/r2"}


def test_robots_that_meet_end_in_the_frame_of_the_lowest_log() -> None:
    robots = Robots()
    for name in ("r1", "r2", "r3"):
        robots.add(name)
        for k in range(3):
            robots.capture(name, float(k), look=k)
    robots.run(15.0)
    assert robots.frames() == {"r1": "map/r1", "r2": "map/r1", "r3": "map/r1"}
    assert len({str(core.corrections.applied and core.corrections.applied.term) for core in robots.cores.values()}) == 1


def test_after_a_merge_a_follower_of_the_other_leader_applies_the_common_leaders_corrections() -> None:
    robots = Robots()
    for name in ("r1", "r2", "r3", "r4"):
        robots.add(name)
    robots.separate("r1 r2", "r3 r4")
    for name in robots.cores:
        for k in range(3):
            robots.capture(name, float(k), look=k)
    robots.run(15.0)
    assert robots.frames() == {"r1": "map/r1", "r2": "map/r1", "r3": "map/r3", "r4": "map/r3"}
    robots.separate()
    robots.run(15.0)
    assert set(robots.frames().values()) == {"map/r1"}
    changes = [fact.map_frame for fact in robots.facts("r4", CorrectionApplied) if fact.frame_changed]
    assert changes == ["map/r1"]


def test_people_are_told_some_keyframes_of_a_correction_and_the_last_one() -> None:
    twists = Array.of(np.array([[0.0, 0.0, 0.0, 8.0, 0.0, 0.0], [0.0] * 6]), "f4")
    told_knots = Knots(None, Array.of(np.zeros(3), "f8"), Array.of(np.array([0, 80]), "u4"), twists)
    message = LogCorrection(R1, Term(1, R2), 1, R2, pose7(np.eye(4)), told_knots)
    (told,) = (e.fact for e in leader(keyframes=90).on_message("r2", message) if isinstance(e, Report))
    assert isinstance(told, CorrectionApplied)
    assert len(told.knots) <= TOLD_MAX
    assert told.knots[-1] == 80
    assert [T[0] for T in told.T_map_body] == pytest.approx([k + 8.0 * (1 - k / 80) for k in told.knots])
    (told,) = (e.fact for e in corrections().on_message("r2", message) if isinstance(e, Report))
    assert isinstance(told, CorrectionApplied)
    assert (told.knots, told.T_map_body) == ((), ())


def test_everybody_is_told_in_short_and_an_owner_in_range_all() -> None:
    both = replace(solution().components[0], logs=(R1, R2), T_map_keyframe={R1: line(3), R2: line(3)})
    both = replace(both, T_map_odom={R1: np.eye(4), R2: np.eye(4)}, covariance_map_odom={R1: None, R2: None})
    effects = leader(near=("r2",)).publish(Term(1, R1), 1, GraphSolution((both,), ()))
    (told,) = [e.message for e in effects if isinstance(e, Broadcast)]
    assert isinstance(told, CorrectionBatch)
    assert [(c.log, c.knots) for c in told.corrections] == [(R1, None), (R2, None)]
    (sent,) = [e for e in effects if isinstance(e, Unicast)]
    assert sent.to == "r2"
    assert isinstance(sent.message, CorrectionBatch)
    assert [(c.log, c.knots is None) for c in sent.message.corrections] == [(R2, False)]


def test_a_covariance_that_changed_by_a_tenth_is_sent_though_nothing_moved() -> None:
    machine = leader()
    sure = [replace(solution().components[0], covariance_map_odom={R1: c * np.eye(6)}) for c in (1.0, 1.05, 1.3)]
    rounds = [machine.publish(Term(1, R1), k, GraphSolution((c,), ())) for k, c in enumerate(sure, 1)]
    assert [bool(effects) for effects in rounds] == [True, False, True]


def test_knots_that_were_lost_are_asked_for_on_the_way_to_the_leader_and_passed_back() -> None:
    """r1 leads; r3 hears only r2, and r2 only them."""
    owner = Corrections(R3, GossipParameters(), towards=lambda term: ["r2"])
    relay = Corrections(R2, GossipParameters(), towards=lambda term: ["r1", "r3"])
    source, message = leader(), correction(Term(1, R1), 1, log=R3)
    source._take_own(message, short(message))
    assert relay.on_message("r1", short(message), 0.0) == []
    assert owner.on_message("r2", short(message), 0.4) == [Unicast("r2", KnotRequest((message.version,)))]
    assert owner.ask_knots(0.5) == []
    assert relay.on_knot_request("r3", KnotRequest((message.version,)), 0.5) == [
        Unicast("r1", KnotRequest((message.version,)))
    ]
    assert relay.on_knot_request("r3", KnotRequest((message.version,)), 0.6) == []
    assert source.on_knot_request("r2", KnotRequest((message.version,)), 0.7) == [
        Unicast("r2", CorrectionBatch((message,)))
    ]
    assert relay.on_message("r1", message, 0.8) == [Unicast("r3", CorrectionBatch((message,)))]
    assert delivered(owner.on_message("r2", message, 0.9)) == [(1, 1, False)]
    assert relay.on_message("r1", message, 1.0) == []


def test_knots_that_a_leader_in_range_sends_by_itself_are_not_asked_for_at_once() -> None:
    gossip, message = GossipParameters(), correction(Term(1, R1), 1, log=R3)
    owner = Corrections(R3, gossip, near=lambda robot: robot == "r1", towards=lambda term: ["r1"])
    assert owner.on_message("r1", short(message), 0.0) == []
    assert owner.ask_knots(GRACE_S) == [Unicast("r1", KnotRequest((message.version,)))]
    assert owner.ask_knots(GRACE_S) == []


@pytest.mark.parametrize("logs", [2, 50])
def test_after_knots_came_the_next_are_asked_for_after_a_pause_that_grows_with_the_team(logs: int) -> None:
    owner = Corrections(R1, GossipParameters(), towards=lambda term: ["r2"])
    for k in range(2, logs + 1):
        owner.on_message("r2", short(correction(Term(1, R2), 1, log=LogId(f"r{k}"))), 0.0)
    owner.on_message("r2", correction(Term(1, R2), 1), 10.0)
    message, pause_s = correction(Term(1, R2), 2), KNOTS_PAUSE_PER_LOG_S * logs
    assert owner.on_message("r2", short(message), 10.0) == []
    assert owner.ask_knots(10.0 + 0.9 * pause_s) == []
    assert owner.ask_knots(10.0 + pause_s) == [Unicast("r2", KnotRequest((message.version,)))]


def test_knots_of_others_that_nobody_waits_for_are_not_kept() -> None:
    machine, message = corrections(R1), correction(Term(1, R2), 1, log=R3)
    assert machine.on_message("r2", message) == []
    assert machine.of(R3) == short(message)
    machine.follow_all()
    assert machine.on_message("r2", message) == []
    assert machine.of(R3) == message


def test_questions_for_knots_are_bounded() -> None:
    machine = Corrections(R1, GossipParameters(), towards=lambda term: ["r2"])
    asked = 0
    for k in range(3000):
        version = CorrectionVersion(LogId("r9", k), Term(1, R2), 1)
        asked += len(machine.on_knot_request(f"r{k}", KnotRequest((version,)), 0.0))
        machine.on_knot_request(f"r{k}", KnotRequest((CorrectionVersion(R3, Term(1, R2), 1),)), 0.0)
    assert all(size <= size_max for size, size_max in machine.sizes().values())
    answers = sum(len(machine.ask_knots(float(second))) for second in range(100))
    assert answers < 200


def test_a_newcomer_that_believed_a_false_correction_is_won_back() -> None:
    robots = Robots()
    for name in ("r1", "r2", "r3"):
        if name == "r3":
            robots.run(4.0)
        robots.add(name)
        for k in range(3):
            robots.capture(name, float(k), look=k)
    liar = LogId("r9")
    lie = correction(Term(FIRST_COUNTER_MAX, liar), 1, log=R3)
    robots.put("r3", MessageReceived(Envelope(liar, CorrectionBatch((lie,)))))
    robots.run(80.0)
    assert robots.frames() == {"r1": "map/r1", "r2": "map/r1", "r3": "map/r1"}
    applied = robots.cores["r3"].corrections.applied
    assert applied is not None
    assert applied.term == Term(FIRST_COUNTER_MAX + 1, R1)
