"""What the numbers of publishers say of messages that never came."""

from flocc_agent.runtime.ros2.missed import PUBLISHERS_MAX, SequenceGaps
from flocc_agent.runtime.ros2.topics import GID_BYTES, attachment, sender_of


def test_a_gap_is_counted_and_what_was_before_the_first_is_none() -> None:
    gaps = SequenceGaps()
    assert [gaps.missing_before(b"a", number) for number in (7, 8, 11, 12)] == [0, 0, 2, 0]


def test_publishers_are_numbered_apart() -> None:
    gaps = SequenceGaps()
    told = [(b"a", 1), (b"b", 40), (b"a", 2), (b"b", 42)]
    assert [gaps.missing_before(*each) for each in told] == [0, 0, 0, 1]


def test_a_number_that_comes_late_or_twice_is_no_gap() -> None:
    gaps = SequenceGaps()
    assert [gaps.missing_before(b"a", number) for number in (1, 5, 3, 5, 6)] == [0, 3, 0, 0, 0]


def test_without_numbers_nothing_is_known_to_be_missing() -> None:
    gaps = SequenceGaps()
    assert [gaps.missing_before(None, 3), gaps.missing_before(b"a", None)] == [0, 0]


def test_no_stranger_fills_the_memory() -> None:
    gaps = SequenceGaps()
    for k in range(2 * PUBLISHERS_MAX):
        gaps.missing_before(str(k).encode(), 1)
    assert gaps.missing_before(b"0", 3) == 1
    assert gaps.missing_before(str(PUBLISHERS_MAX).encode(), 3) == 0
    assert len(gaps._last) == PUBLISHERS_MAX


def test_an_attachment_says_who_published_and_the_number() -> None:
    gid = bytes(range(GID_BYTES))
    assert sender_of(attachment(9, 1, gid)) == (gid, 9)
    assert sender_of(b"short") == sender_of(None) == (None, None)
