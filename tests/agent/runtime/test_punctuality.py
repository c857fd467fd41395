"""The longest time between two heartbeats."""

from flocc_agent.runtime.punctuality import LATELY_S, PEERS_MAX, LongestGap


def test_the_longest_gap_of_any_name_counts() -> None:
    gap = LongestGap()
    for name, now_s in [("r2", 0.0), ("r3", 0.4), ("r2", 0.5), ("r3", 1.6), ("r2", 2.0)]:
        gap.mark(name, now_s)
    assert gap.longest_s(2.0) == 1.5


def test_a_gap_is_forgotten_after_a_while() -> None:
    gap = LongestGap()
    for now_s in (0.0, 2.0, 2.5):
        gap.mark("r2", now_s)
    assert gap.longest_s(LATELY_S) == 2.0
    gap.mark("r2", LATELY_S + 2.0)
    assert gap.longest_s(2 * LATELY_S) == LATELY_S - 0.5
    assert gap.longest_s(4 * LATELY_S) == 0.0


def test_a_robot_that_was_away_is_not_late() -> None:
    gap = LongestGap()
    gap.mark("r2", 0.0)
    gap.forget("r2")
    gap.mark("r2", 9.0)
    assert gap.longest_s(9.0) == 0.0


def test_strangers_do_not_fill_the_memory() -> None:
    gap = LongestGap()
    for number in range(2 * PEERS_MAX):
        gap.mark(f"r{number}", 0.0)
        gap.mark(f"r{number}", 1.0)
    assert len(gap._marked_s) == PEERS_MAX
