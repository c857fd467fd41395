"""Sec. III-B of the paper, Eqs. (1) and (2): how sure a registration is, and that everybody reads the same number."""

import math
from itertools import pairwise

import numpy as np
import pytest

from flocc_agent.core.judgement import judged, told
from flocc_agent.core.parameters import LoopClosingParameters
from flocc_agent.core.registration import Registration, closure_probability, match_ratio
from flocc_agent.core.reports import ClosureAccepted, ClosureRejected
from flocc_agent.runtime.evidence import PairEvidence
from flocc_launch.runs.heard import Heard
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import ClosureRecord, RejectionRecord

ALPHA, BETA = KeyframeId(LogId("alpha"), 4), KeyframeId(LogId("beta"), 7)


def test_equation_1_is_loop_correspondences_over_odometry_correspondences() -> None:
    assert match_ratio(150, 300) == 0.5
    assert match_ratio(0, 300) == 0.0
    assert match_ratio(450, 300) == 1.5


@pytest.mark.parametrize("odometry", [0, 1, 19, 20])
def test_a_denominator_below_20_counts_as_20(odometry: int) -> None:
    assert match_ratio(6, odometry) == 6 / 20


def test_above_20_the_denominator_is_the_count() -> None:
    assert match_ratio(6, 21) == 6 / 21


@pytest.mark.parametrize("counts", [(-1, 5), (5, -1)])
def test_counts_are_not_negative(counts: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="negative"):
        match_ratio(*counts)


@pytest.mark.parametrize("k", [0.5, 4.0, 12.0])
def test_equation_2_is_a_logistic_around_one(k: float) -> None:
    assert closure_probability(1.0, k) == 0.5
    for ratio in (0.0, 0.3, 0.9, 1.4):
        assert closure_probability(ratio, k) == pytest.approx(1 / (1 + math.exp(-k * (ratio - 1))), rel=1e-12)
        assert closure_probability(ratio, k) + closure_probability(2 - ratio, k) == pytest.approx(1)


def test_a_larger_steepness_trusts_good_ratios_more_and_bad_ones_less() -> None:
    assert all(closure_probability(1.5, a) < closure_probability(1.5, b) for a, b in pairwise([1.0, 4.0, 9.0]))
    assert all(closure_probability(0.5, a) > closure_probability(0.5, b) for a, b in pairwise([1.0, 4.0, 9.0]))


@pytest.mark.parametrize("ratio", [-0.1, math.inf, math.nan])
def test_a_probability_of_no_ratio_is_refused(ratio: float) -> None:
    with pytest.raises(ValueError, match="match ratio"):
        closure_probability(ratio, 4.0)


def judgement(loop: int, odometry: int) -> ClosureRecord | RejectionRecord:
    registered = Registration(np.eye(4), loop, odometry, None)
    return judged(ALPHA, BETA, registered, LoopClosingParameters(match_ratio_threshold=1.1, correspondences_min=1))


@pytest.mark.parametrize(("loop", "odometry"), [(21, 3), (12, 0), (30, 60), (400, 300), (8, 20)])
def test_judge_log_evidence_event_and_page_read_one_ratio(loop: int, odometry: int) -> None:
    """A pair of 21 over 3 correspondences was "rejected, best ratio 7" by R_thr 1.1: Eq. (1) says 21 / 20."""
    expected, record = match_ratio(loop, odometry), judgement(loop, odometry)
    assert isinstance(record, ClosureRecord) is (expected >= 1.1)
    assert told(record, LogId("alpha")).ratio == round(expected, 4)
    heard = Heard(4.0).record(LogId("alpha"), record, 1.0)
    assert heard is not None
    assert isinstance(heard.fact, ClosureAccepted | ClosureRejected)
    assert heard.fact.ratio == round(expected, 4)
    if isinstance(record, ClosureRecord):
        assert record.match_ratio == expected
        return
    evidence = PairEvidence()
    evidence.reject(record)
    assert evidence.best_ratio == expected < 1.1
