"""What the numbers of publishers, and the middleware, say of messages that never came."""

from flocc_agent.runtime.ros2.missed import PUBLISHERS_MAX, Missing
from flocc_agent.runtime.ros2.topics import GID_BYTES, attachment, sender_of


def test_a_gap_is_counted_and_what_was_before_the_first_is_none() -> None:
    missed = Missing()
    assert [missed.heard(b"a", number) for number in (7, 8, 11, 12)] == [0, 0, 2, 0]


def test_publishers_are_numbered_apart() -> None:
    missed = Missing()
    told = [(b"a", 1), (b"b", 40), (b"a", 2), (b"b", 42)]
    assert [missed.heard(*each) for each in told] == [0, 0, 0, 1]


def test_a_number_that_comes_late_or_twice_is_no_gap() -> None:
    missed = Missing()
    assert [missed.heard(b"a", number) for number in (1, 5, 3, 5, 6)] == [0, 3, 0, 0, 0]


def test_without_numbers_nothing_is_known_to_be_missing() -> None:
    missed = Missing()
    assert [missed.heard(None, 3), missed.heard(b"a", None)] == [0, 0]


def test_no_stranger_fills_the_memory() -> None:
    missed = Missing()
    for k in range(2 * PUBLISHERS_MAX):
        missed.heard(str(k).encode(), 1)
    assert missed.heard(b"0", 3) == 1
    assert missed.heard(str(PUBLISHERS_MAX).encode(), 3) == 0
    assert len(missed._last) == PUBLISHERS_MAX


def test_what_the_middleware_says_was_lost_counts_before_the_first_and_behind_the_last_message() -> None:
    missed = Missing()
    assert [missed.lost(3), missed.heard(b"a", 4), missed.lost(3), missed.lost(5)] == [3, 0, 0, 2]
    assert [missed.heard(b"a", 9), missed.lost(6)] == [2, 0], "2 of 4 by a short queue"


def test_what_both_tell_counts_once_in_either_order() -> None:
    missed = Missing()
    assert [missed.heard(b"a", 1), missed.heard(b"a", 5), missed.lost(2), missed.lost(3)] == [0, 3, 0, 0]
    assert [missed.lost(5), missed.heard(b"a", 8), missed.lost(5)] == [2, 0, 0]


def test_an_attachment_says_who_published_and_the_number() -> None:
    gid = bytes(range(GID_BYTES))
    assert sender_of(attachment(9, 1, gid)) == (gid, 9)
    assert sender_of(b"short") == sender_of(None) == (None, None)
