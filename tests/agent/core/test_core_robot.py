"""The whole robot: neighbours, names, restarts, deadlines."""

import math

import numpy as np
from tests.agent.core.virtual_time import Robots, answer, descriptor, keyframe

from flocc_agent.core.effects import Broadcast, Effect, Encode, PersistRecord, Register, Report, Unicast
from flocc_agent.core.events import Event, KeyframeEncoded, MessageReceived
from flocc_agent.core.neighbours import Neighbours
from flocc_agent.core.parameters import CoreParameters, NeighbourParameters
from flocc_agent.core.place_recognition import Candidate
from flocc_agent.core.reports import LogForked, NameTaken, NeighbourDown, NeighbourRestarted, NeighbourUp, PeerRefused
from flocc_agent.core.restored import Restored
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidateOffer, CandidatePair, Envelope, Heartbeat, Records
from flocc_protocol.records import KeyframeRecord

R1, R2 = LogId("r1"), LogId("r2")


def heartbeat(boot: int, sequence: int = 1) -> Heartbeat:
    return Heartbeat(sequence, boot, 0, None, 0, 0)


def two_of_whom_r1_walked() -> Robots:
    """r1 has three keyframes, of which r2 has heard."""
    robots = Robots()
    robots.add("r1")
    robots.add("r2")
    for k in range(3):
        robots.capture("r1", float(k), look=k)
    robots.run(3.0)
    return robots


def disk_of(robots: Robots, name: str) -> Restored:
    """What a robot has persisted."""
    written = [effect for effect in robots.effects(name, PersistRecord) if isinstance(effect, PersistRecord)]
    logs = sorted({effect.log for effect in written})
    records = tuple((log, tuple(e.data for e in written if e.log == log)) for log in logs)
    own = robots.cores[name].log
    latents = tuple(KeyframeId(own, k) for k in range(robots.cores[name].gossip.logs[own].keyframes))
    return Restored(records, latents)


def _is_batch(effect: Broadcast) -> bool:
    return isinstance(effect.message, Records)


def test_a_tick_always_moves_the_deadline_on() -> None:
    robots = Robots()
    for k, name in enumerate(("r1", "r2", "r3")):
        robots.add(name, compute_class=k)
        for place in range(4):
            robots.capture(name, float(place), look=place)
    robots.run(10.0)
    robots.separate("r1", "r2 r3")
    robots.run(40.0)
    robots.separate()
    robots.run(40.0)
    ticks = sum(isinstance(e, Broadcast) and isinstance(e.message, Heartbeat) for _, _, e in robots.done)
    assert ticks >= 3 * 175


def test_the_same_events_give_the_same_effects() -> None:
    runs = []
    for _ in range(2):
        robots = Robots()
        for name in ("r1", "r2", "r3"):
            robots.add(name)
            for place in range(4):
                robots.capture(name, float(place), look=place)
        robots.run(20.0)
        runs.append([repr(entry) for entry in robots.done])
    assert runs[0] == runs[1]


def test_a_late_tick_does_not_make_up_for_missed_heartbeats() -> None:
    robots = Robots()
    core = robots.add("r1")
    core.tick(200.0)
    beats = [e for e in core.tick(200.0) if isinstance(e, Broadcast) and isinstance(e.message, Heartbeat)]
    assert beats == []
    assert core.deadline() > 200.0


def test_a_silent_robot_is_out_of_range_after_the_timeout() -> None:
    robots = Robots()
    robots.add("r1")
    robots.add("r2")
    robots.run(1.0)
    robots.kill("r2")
    robots.run(3.1)
    assert robots.cores["r1"].neighbours.names() == []
    assert len(robots.facts("r1", NeighbourDown)) == 1


def test_a_restarted_robot_continues_its_numbering() -> None:
    robots = two_of_whom_r1_walked()
    disk = disk_of(robots, "r1")
    robots.kill("r1")
    robots.add("r1", restored=disk)
    robots.capture("r1", 3.0, look=3)
    robots.run(5.0)
    assert [e.keyframe.index for e in robots.effects("r1", Encode) if isinstance(e, Encode)] == [0, 1, 2, 3]
    assert robots.cores["r2"].gossip.logs[R1].encoded == robots.cores["r1"].gossip.logs[R1].encoded
    assert robots.facts("r2", LogForked) == []


def test_a_restarted_robot_registers_nothing_twice() -> None:
    robots = Robots()
    for name in ("r1", "r2"):
        robots.add(name)
        for k in range(3):
            robots.capture(name, float(k), look=k)
    robots.run(20.0)
    before = len([e for _, _, e in robots.done if isinstance(e, Register)])
    disk = disk_of(robots, "r1")
    robots.kill("r1")
    robots.add("r1", restored=disk)
    robots.run(20.0)
    assert len([e for _, _, e in robots.done if isinstance(e, Register)]) == before
    assert robots.cores["r1"].closing.open_pairs() == []


def test_a_restarted_robot_looks_for_no_other_partner_of_a_keyframe_that_had_one() -> None:
    """Live, r2/0 met only r1/0; after the restart r1/1 would be more like it."""

    def work(robots: Robots, name: str, effect: Effect) -> Event | None:
        if isinstance(effect, Encode):
            angle_rad = math.radians(effect.image)
            return KeyframeEncoded(
                effect.keyframe, Array.of(np.array([math.cos(angle_rad), math.sin(angle_rad)]), "f4")
            )
        return answer(effect)

    robots = Robots(work=work)
    robots.add("r1")
    robots.add("r2")
    for name, angle_deg in (("r1", 0), ("r2", 30), ("r2", 50), ("r1", 42)):
        robots.capture(name, 0.1 * angle_deg, look=angle_deg)
        robots.run(2.0)
    robots.run(5.0)
    before = robots.cores["r2"].assembly.closures
    disk = disk_of(robots, "r1")
    robots.kill("r1")
    robots.add("r1", restored=disk)
    robots.run(20.0)
    assert robots.cores["r2"].assembly.closures == before == 3


def test_a_robot_that_lost_its_disk_is_a_new_incarnation_and_its_old_log_stays() -> None:
    robots = two_of_whom_r1_walked()
    robots.kill("r1")
    robots.add("r1", incarnation=1)
    robots.capture("r1", 0.0, look=9)
    robots.run(10.0)
    logs = {str(log): copy.keyframes for log, copy in robots.cores["r2"].gossip.logs.items()}
    assert logs == {"r1": 3, "r1~1": 1, "r2": 0}
    assert robots.facts("r1", LogForked) == []


def test_keyframes_are_recorded_in_the_order_of_capture() -> None:
    robots = Robots(work=lambda robots, name, effect: None)
    robots.add("r1")
    for k in range(3):
        robots.capture("r1", float(k), look=k)
    for k in (2, 0, 1):
        robots.put("r1", KeyframeEncoded(keyframe(f"r1/{k}"), descriptor(k)))
    records = robots.cores["r1"].gossip.logs[R1].records
    assert [record.T_odom_camera[0] for record in records if isinstance(record, KeyframeRecord)] == [0.0, 1.0, 2.0]


def test_a_record_is_persisted_before_it_is_sent() -> None:
    robots = Robots()
    robots.add("r1")
    robots.capture("r1", 0.0, look=0)
    robots.run(1.0)
    first_sent = next(k for k, (_, _, e) in enumerate(robots.done) if isinstance(e, Broadcast) and _is_batch(e))
    first_written = next(k for k, (_, _, e) in enumerate(robots.done) if isinstance(e, PersistRecord))
    assert first_written < first_sent


def test_another_robot_with_this_robots_name_is_reported_once() -> None:
    robots = Robots()
    robots.add("r1")
    for k in range(3):
        robots.put("r1", MessageReceived(Envelope(R1, heartbeat(boot=5, sequence=k))))
    assert len(robots.facts("r1", NameTaken)) == 1


def test_two_robots_with_one_name_are_told_from_a_restart() -> None:
    neighbours = Neighbours(R1, 1, NeighbourParameters())
    found = []
    for t, boot in enumerate((5, 6, 6, 5, 6)):
        found += [type(e.fact) for e in neighbours.on_heartbeat(R2, heartbeat(boot), float(t)) if isinstance(e, Report)]
    assert found == [NeighbourUp, NeighbourRestarted, NameTaken]


def test_two_robots_with_one_name_corrupt_neither_log() -> None:
    robots = two_of_whom_r1_walked()
    kept = list(robots.cores["r2"].gossip.logs[R1].encoded)
    twin = Robots(now_s=robots.now_s)
    twin.add("r1")
    for k in range(5):
        twin.capture("r1", 100.0 + k, look=k)
    twin.run(1.0)
    batches = [e.message for e in twin.effects("r1", Broadcast) if isinstance(e, Broadcast)]
    for message in batches:
        robots.put("r2", MessageReceived(Envelope(R1, message)))
    robots.run(3.0)
    assert robots.cores["r2"].gossip.logs[R1].encoded == kept
    assert len(robots.facts("r2", LogForked)) == 1


def test_no_pair_is_handed_to_a_name_under_which_two_robots_run() -> None:
    robots = Robots()
    robot = robots.add("r1")
    for boot in (7, 8, 7):
        message = Heartbeat(boot, boot, 9, None, 0, 0)
        robots.put("r1", MessageReceived(Envelope(LogId("server", boot), message)))
    found = Candidate(CandidatePair.of(keyframe("r3/1"), keyframe("r4/1")), 0.9)
    robots.carry_out("r1", robot.closing.on_candidates([found], robots.now_s))
    robots.carry_out("r1", robot.closing.tick(robots.now_s))
    sent = [effect for _, _, effect in robots.done if isinstance(effect, Unicast)]
    assert not [effect for effect in sent if isinstance(effect.message, CandidateOffer)]
    assert robot.closing.roles(found.pair) is not None


def test_the_heartbeat_is_slower_in_a_crowd_and_never_too_slow_for_the_timeout() -> None:
    parameters = NeighbourParameters()
    assert [parameters.period_s(count) for count in (0, 8, 32, 48, 64, 512)] == [0.5, 0.5, 0.5, 0.75, 1.0, 1.0]
    assert 3 * parameters.period_s(512) <= parameters.timeout_s
    robots = Robots()
    robots.add("r1")
    for k in range(64):
        robots.put("r1", MessageReceived(Envelope(LogId(f"s{k:02d}"), heartbeat(1, k))))
    before = len(robots.effects("r1", Broadcast))
    robots.run(2.5)
    assert len(robots.effects("r1", Broadcast)) - before <= 4


def test_neighbours_beyond_the_maximum_are_refused() -> None:
    robots = Robots(CoreParameters(neighbours=NeighbourParameters(neighbours_max=2)))
    robots.add("r1")
    for k in range(5):
        robots.put("r1", MessageReceived(Envelope(LogId(f"x{k}"), heartbeat(boot=k))))
    assert len(robots.cores["r1"].neighbours.names()) == 2
    assert len(robots.facts("r1", PeerRefused)) == 3


def test_every_table_has_a_maximum() -> None:
    robots = Robots()
    robots.add("r1")
    assert all(size <= size_max for size, size_max in robots.cores["r1"].sizes().values())
