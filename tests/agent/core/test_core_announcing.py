"""What is said of tables: one hash that equal tables share, and what changed since a number."""

from itertools import permutations

from flocc_agent.core.announcing import Announcer
from flocc_protocol.ids import LogId
from flocc_protocol.messages import LogDigest


def digest(number: int, count: int = 1) -> LogDigest:
    return LogDigest(LogId(f"r{number:03d}"), count, 77)


def filled(*digests: LogDigest) -> Announcer[LogDigest]:
    announcer: Announcer[LogDigest] = Announcer()
    for each in digests:
        announcer.put(each.log, each)
    return announcer


def test_equal_tables_have_equal_hashes_in_whatever_order_they_came_to_be() -> None:
    entries = [digest(1), digest(2, 5), digest(3)]
    hashes = {filled(*order).state().hash for order in permutations(entries)}
    assert len(hashes) == 1
    assert hashes == {filled(digest(2, 1), digest(1), digest(3), digest(2, 5)).state().hash}


def test_tables_that_differ_in_anything_have_other_hashes() -> None:
    tables = [
        (),
        (digest(1),),
        (digest(2),),
        (digest(1, 2),),
        (digest(1)._replace(checksum=78),),
        (digest(1), digest(2)),
    ]
    assert len({filled(*table).state().hash for table in tables}) == len(tables)


def test_an_entry_that_is_removed_leaves_no_trace_in_the_hash() -> None:
    announcer = filled(digest(1), digest(2))
    announcer.remove(digest(2).log)
    assert announcer.state().hash == filled(digest(1)).state().hash
    assert announcer.state().changes == 3


def test_what_changed_since_a_number_is_told_once_and_the_oldest_change_first() -> None:
    announcer = filled(*(digest(k) for k in range(200)))
    known = announcer.state().changes
    announcer.put(digest(150).log, digest(150, 2))
    announcer.put(digest(20).log, digest(20, 2))
    announcer.put(digest(150).log, digest(150, 3))
    assert announcer.since(known, 256) == (203, (digest(20, 2), digest(150, 3)))
    assert announcer.since(203, 256) == (203, ())


def test_a_table_that_one_message_does_not_hold_is_told_in_parts() -> None:
    announcer = filled(*(digest(k) for k in range(600)))
    heard: list[LogDigest] = []
    through = 0
    for _ in range(3):
        through, told = announcer.since(through, 256)
        assert len(told) <= 256
        heard += told
        if len(heard) == 256:
            announcer.put(digest(0).log, digest(0, 2))
    assert set(heard) == set(announcer.all()) | {digest(0)}
    assert through == announcer.state().changes


def test_everything_is_told_in_the_order_of_the_logs() -> None:
    assert filled(digest(2), digest(1)).all() == (digest(1), digest(2))
