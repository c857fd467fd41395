"""Whether a registration becomes a closure."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.agent.core.virtual_time import keyframe

from flocc_agent.core.judgement import judged, told
from flocc_agent.core.parameters import LoopClosingParameters
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.core.reports import ClosureAccepted, ClosureRejected
from flocc_protocol.ids import LogId
from flocc_protocol.records import ClosureRecord, RejectionRecord

QUERY, MATCH = keyframe("r1/3"), keyframe("r2/5")
LIMITS = LoopClosingParameters(match_ratio_threshold=0.3, correspondences_min=20)
GOOD = Registration(np.eye(4), 60, 100, 0.5)


def reason(result: Registration | RegistrationFailed) -> str | None:
    record = judged(QUERY, MATCH, result, LIMITS)
    return record.reason if isinstance(record, RejectionRecord) else None


def test_a_ratio_at_the_threshold_is_accepted_with_its_ratio_and_scale() -> None:
    record = judged(QUERY, MATCH, replace(GOOD, correspondences=30), LIMITS)
    assert isinstance(record, ClosureRecord)
    assert (record.query, record.match, record.match_ratio, record.scale_initial) == (QUERY, MATCH, 0.3, 0.5)


def test_a_lower_ratio_is_refused() -> None:
    assert reason(replace(GOOD, correspondences=29)) == "match ratio below 0.3"


def test_few_correspondences_are_refused_whatever_their_ratio() -> None:
    assert reason(replace(GOOD, correspondences=19, odometry_correspondences=20)) == "fewer than 20 correspondences"


def test_what_its_front_end_judged_needs_no_ratio() -> None:
    few = replace(GOOD, correspondences=18, judged_ratio=1.2)

    record = judged(QUERY, MATCH, few, LIMITS)

    assert isinstance(record, ClosureRecord)
    assert (record.match_ratio, record.correspondences) == (1.2, 18)


def test_a_failed_registration_is_refused_with_its_reason() -> None:
    failed = RegistrationFailed(RegistrationFailure.DEGENERATE, correspondences=7)
    assert reason(failed) == RegistrationFailure.DEGENERATE.value


@pytest.mark.parametrize("T", [np.full((4, 4), np.nan), np.diag([2.0, 2.0, 2.0, 1.0])])
def test_a_pose_that_makes_no_sense_is_refused(T: NDArray[np.float64]) -> None:
    assert reason(replace(GOOD, T_query_match_unscaled=T)) is not None


def test_a_scale_that_no_record_can_hold_counts_as_none() -> None:
    record = judged(QUERY, MATCH, replace(GOOD, scale_initial=1e30), LIMITS)
    assert isinstance(record, ClosureRecord)
    assert record.scale_initial is None


def test_people_are_told_of_both() -> None:
    accepted = told(judged(QUERY, MATCH, GOOD, LIMITS), LogId("r1"))
    refused = told(judged(QUERY, MATCH, replace(GOOD, correspondences=5), LIMITS), LogId("r1"))
    assert isinstance(accepted, ClosureAccepted)
    assert (accepted.ratio, accepted.by) == (0.6, "r1")
    assert isinstance(refused, ClosureRejected)
    assert refused.reason == "fewer than 20 correspondences"
