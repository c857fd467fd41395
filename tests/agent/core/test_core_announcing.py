"""What heartbeats say of tables: everything while it is little, else changes and turns; a new listener gets it all."""

from flocc_agent.core.announcing import REPEATS, TURN, Announcer
from flocc_protocol.ids import LogId


def filled(count: int) -> Announcer[int]:
    announcer: Announcer[int] = Announcer()
    for k in range(count):
        announcer.put(LogId(f"r{k:03d}"), k)
    for _ in range(REPEATS):
        announcer.next()
    return announcer


def test_a_short_table_is_said_whole_in_the_order_of_the_logs() -> None:
    announcer = filled(TURN)
    assert announcer.next() == announcer.all() == tuple(range(TURN))


def test_a_change_is_said_in_the_next_heartbeats_however_long_the_table() -> None:
    announcer = filled(200)
    announcer.put(LogId("r150"), 1000)
    assert all(1000 in announcer.next() for _ in range(REPEATS))


def test_of_a_long_table_everything_has_its_turn() -> None:
    announcer = filled(200)
    said = [announcer.next() for _ in range(-(-200 // TURN))]
    assert {entry for heartbeat in said for entry in heartbeat} == set(range(200))
    assert max(map(len, said)) == TURN


def test_a_new_listener_is_told_everything_once() -> None:
    announcer = filled(200)
    announcer.say_all()
    assert set(announcer.next()) == set(range(200))
    assert len(announcer.next()) < 200
