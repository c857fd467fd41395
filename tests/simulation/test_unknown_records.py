"""Claims: robots whose record kinds differ run in one swarm; what they do not know they keep and pass on."""

from tests.agent.core.virtual_time import Robots

from flocc_agent.core.reports import LogForked, PeerRefused
from flocc_agent.core.restored import Restored
from flocc_agent.core.robot import Robot
from flocc_protocol.codec import to_bytes
from flocc_protocol.ids import LogId
from flocc_protocol.records import ClosureRecord, Record, UnknownRecord, encode_record


def later(number: int) -> UnknownRecord:
    """A record as a later version may write it: another code, or a closure with one more field."""
    if number % 2:
        return UnknownRecord(77, to_bytes([77, {"number": number}]))
    return UnknownRecord(2, to_bytes([2, [number, 0, 0, 0, 0, 0, 0, 0, "one more"]]))


def write(robots: Robots, name: str, record: Record) -> None:
    """Let a robot of a later version append a record of its own kind."""
    robots.carry_out(name, robots.cores[name].own_log.append(record, robots.now_s))


def logs(robot: Robot) -> dict[str, tuple[int, int]]:
    return {str(log): (len(copy), copy.checksum) for log, copy in robot.gossip.logs.items()}


def closures(robot: Robot) -> int:
    return robot.assembly.closures


def meeting() -> Robots:
    """r3 is of a later version; r1 and r3 never hear each other, r2 relays; all three see the same places."""
    robots = Robots()
    for name in ("r1", "r2", "r3"):
        robots.add(name)
    robots.separate("r1", "r3")
    for k in range(6):
        for name in ("r1", "r2", "r3"):
            robots.capture(name, 1.0 * k, look=k)
        robots.run(1.0)
        write(robots, "r3", later(k))
    robots.run(20.0)
    return robots


def test_records_of_a_later_version_travel_byte_for_byte_and_closures_are_unharmed() -> None:
    robots = meeting()
    r1, r2, r3 = (robots.cores[name] for name in ("r1", "r2", "r3"))
    assert logs(r1) == logs(r2) == logs(r3)
    theirs = r1.gossip.logs[LogId("r3")]
    assert [
        data for record, data in zip(theirs.records, theirs.encoded, strict=True) if isinstance(record, UnknownRecord)
    ] == [encode_record(later(k)) for k in range(6)]
    assert closures(r1) == closures(r2) == closures(r3) >= 12
    assert robots.frames() == {"r1": "map/r1", "r2": "map/r1", "r3": "map/r1"}
    assert robots.facts("r1", PeerRefused) == []
    assert robots.facts("r1", LogForked) == []


def test_a_robot_starts_again_with_records_of_a_later_version_on_its_disk() -> None:
    robots = meeting()
    r3 = robots.cores["r3"]
    held = tuple((log, tuple(copy.encoded)) for log, copy in sorted(r3.gossip.logs.items()))
    before, closed = logs(r3), closures(r3)
    robots.kill("r3")
    robots.add("r3", restored=Restored(records=held))
    robots.run(5.0)
    assert logs(robots.cores["r3"]) == before
    assert closures(robots.cores["r3"]) == closed
    robots.capture("r3", 7.0, look=-1)
    robots.run(5.0)
    assert robots.cores["r3"].gossip.logs[LogId("r3")].keyframes == 7


def test_a_keyframe_of_a_later_version_keeps_its_number_and_nothing_is_tied_to_it() -> None:
    robots = Robots()
    for name in ("r1", "r2"):
        robots.add(name)
    robots.capture("r1", 0.0, look=0)
    robots.run(1.0)
    write(robots, "r1", UnknownRecord(1, to_bytes([1, [1, 2.0, b"pose", None, "and a depth image"]])))
    for k in (2, 3):
        robots.capture("r1", 1.0 * k, look=k)
    for k in range(4):
        robots.capture("r2", 1.0 * k, look=k)
    robots.run(20.0)
    r1, r2 = robots.cores["r1"], robots.cores["r2"]
    assert logs(r1) == logs(r2)
    assert r2.gossip.logs[LogId("r1")].keyframes == 4
    graph = r2.assembly.graph()
    assert [len(graph.trajectories[LogId(name)]) for name in ("r1", "r2")] == [4, 4]
    tied = {closure.match.index for closure in graph.closures} | {closure.query.index for closure in graph.closures}
    assert tied
    records = [
        record for copy in r2.gossip.logs.values() for record in copy.records if isinstance(record, ClosureRecord)
    ]
    assert all(1 not in (k.index for k in (r.query, r.match) if k.log == LogId("r1")) for r in records)
