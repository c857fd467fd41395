"""Claims on histograms and the stopwatch of stages."""

import threading

import numpy as np
import pytest

from flocc_agent.stages import BOUNDS_S, STAGES_MAX, Histogram, StageTimes, stage, timed


def test_buckets_are_spaced_by_one_two_five_from_a_tenth_of_a_millisecond_to_a_hundred_seconds() -> None:
    assert BOUNDS_S[:4] == (1e-4, 2e-4, 5e-4, 1e-3)
    assert BOUNDS_S[-2:] == (50.0, 100.0)
    assert list(BOUNDS_S) == sorted(BOUNDS_S)


def test_a_time_on_the_edge_of_a_bucket_is_in_it_and_a_longer_one_in_the_next() -> None:
    histogram = Histogram()
    for lasted_s in (0.0, 1e-4, 1.1e-4, 100.0, 1000.0):
        histogram.observe(lasted_s)
    assert (histogram.counts[0], histogram.counts[1], histogram.counts[-2], histogram.counts[-1]) == (2, 1, 1, 1)
    assert (histogram.count, histogram.max_s) == (5, 1000.0)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_quantile_is_right_within_its_bucket(share: float) -> None:
    times_s = np.random.default_rng(3).lognormal(-3.0, 1.0, 2000)
    histogram = Histogram()
    for time_s in times_s:
        histogram.observe(float(time_s))
    true_s = float(np.quantile(times_s, share))
    k = int(np.searchsorted(BOUNDS_S, true_s))
    assert BOUNDS_S[k - 1] <= histogram.quantile_s(share) <= BOUNDS_S[k]
    assert histogram.total_s == pytest.approx(times_s.sum())


def test_quantiles_never_exceed_the_longest_and_are_zero_where_there_is_nothing() -> None:
    histogram = Histogram()
    assert histogram.quantile_s(0.9) == 0.0
    histogram.observe(0.6)
    assert histogram.quantile_s(1.0) == 0.6


def test_histograms_of_two_starts_add_up() -> None:
    one, two = Histogram(), Histogram()
    one.observe(0.01)
    two.observe(3.0)
    one.add(two.counts, two.total_s, two.max_s)
    assert (one.count, one.total_s, one.max_s) == (2, 3.01, 3.0)


def test_memory_is_bounded_however_many_stages_there_are() -> None:
    times = StageTimes()
    for k in range(3 * STAGES_MAX):
        times.observe(f"stage{k}", 0.1)
    assert len(times.snapshot()) == STAGES_MAX


def test_marked_stages_are_collected_added_up_and_forgotten_after_the_task() -> None:
    def work() -> int:
        for _ in range(2):
            with stage("match"):
                threading.Event().wait(0.002)
        with stage("pose"):
            return 7

    done = timed(work)
    assert done.value == 7
    assert set(done.laps_s) == {"match", "pose"}
    assert 0.004 <= done.laps_s["match"] <= done.lasted_s
    assert timed(lambda: None).laps_s == {}


def test_a_mark_outside_of_a_timed_task_does_nothing() -> None:
    with stage("match"):
        pass
