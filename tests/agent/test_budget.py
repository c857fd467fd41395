"""Claims on the budget of latents."""

import pytest

from flocc_agent.budget import BURST_S, Budget

RATE = 1000.0


def test_a_piece_may_go_until_the_burst_is_used_and_the_next_waits_until_it_is_made_up() -> None:
    budget = Budget(RATE)
    assert budget.pause_s(0, 0.0) == 0.0
    assert budget.pause_s(int(RATE * BURST_S), 0.0) == 0.0
    assert budget.pause_s(int(RATE * BURST_S) + 500, 0.0) == pytest.approx(0.5)
    assert budget.pause_s(int(RATE * BURST_S) + 500, 0.2) == pytest.approx(0.3)
    assert budget.pause_s(int(RATE * BURST_S) + 500, 0.5) == pytest.approx(0.0)


def test_pieces_as_large_as_they_like_keep_the_rate() -> None:
    budget, now_s, used = Budget(RATE), 0.0, 0
    for _ in range(50):
        pause_s = budget.pause_s(used, now_s)
        now_s += pause_s
        used += 4000
    assert used / now_s == pytest.approx(RATE, rel=0.06)


def test_messages_take_what_they_need_and_latents_the_rest() -> None:
    budget, now_s, used, latents = Budget(RATE), 0.0, 0, 0
    while now_s < 100.0:
        pause_s = budget.pause_s(used, now_s)
        if pause_s == 0.0:
            used, latents = used + 500, latents + 500
        now_s += 0.1
        used += 80  # messages, never delayed
    assert latents / now_s == pytest.approx(RATE - 800, rel=0.1)


def test_an_idle_budget_is_not_saved_up() -> None:
    budget = Budget(RATE)
    budget.pause_s(0, 0.0)
    assert budget.pause_s(0, 1000.0) == 0.0
    assert budget.pause_s(int(RATE * BURST_S) + 100, 1000.0) == pytest.approx(0.1)


def test_a_pause_that_was_kept_is_over() -> None:
    budget, now_s, used = Budget(RATE / 3), 1e6, 0
    for _ in range(1000):
        used += 777
        now_s += budget.pause_s(used, now_s)
        assert budget.pause_s(used, now_s) == 0.0
