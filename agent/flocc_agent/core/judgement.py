"""Judgement: whether a registration becomes a loop closure, by the ratio of Eq. (1) (Sec. III-B)."""

from flocc_agent.core.parameters import LoopClosingParameters
from flocc_agent.core.prospects import UNLIKELY
from flocc_agent.core.registration import Registration, RegistrationFailed, match_ratio
from flocc_agent.core.reports import ClosureAccepted, ClosureRejected
from flocc_agent.geometry import is_rigid, pose7, upper_triangle
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import (
    SCALE_INITIAL_MAX,
    SCALE_INITIAL_MIN,
    ClosureRecord,
    RejectionRecord,
    encode_record,
)


def judged(
    query: KeyframeId, match: KeyframeId, result: Registration | RegistrationFailed, limits: LoopClosingParameters
) -> ClosureRecord | RejectionRecord:
    """Accept a registration whose match ratio reaches R_thr, or that its front end judged; else say why not."""
    counts = (result.correspondences, result.odometry_correspondences)
    if isinstance(result, RegistrationFailed):
        return RejectionRecord(query, match, result.failure.value, *counts)
    if result.judged_ratio is not None:
        return _recorded(query, match, result, result.judged_ratio)
    ratio = match_ratio(*counts)
    if result.correspondences < limits.correspondences_min:
        return RejectionRecord(query, match, f"fewer than {limits.correspondences_min} correspondences", *counts)
    if ratio < limits.match_ratio_threshold:
        return RejectionRecord(query, match, f"match ratio below {limits.match_ratio_threshold}", *counts)
    return _recorded(query, match, result, ratio)


def _recorded(
    query: KeyframeId, match: KeyframeId, result: Registration, ratio: float
) -> ClosureRecord | RejectionRecord:
    """The record of an accepted registration, or of why no log may hold it."""
    try:
        return _closure(query, match, result, ratio)
    except ValueError as error:
        counts = (result.correspondences, result.odometry_correspondences)
        return RejectionRecord(query, match, f"no closure: {error}", *counts)


def _closure(query: KeyframeId, match: KeyframeId, result: Registration, ratio: float) -> ClosureRecord:
    """The record of an accepted registration; a scale that no record can hold counts as none.

    Raises:
        ValueError: The registration makes no sense; a log must never hold it.
    """
    if not is_rigid(result.T_query_match_unscaled):
        raise ValueError("the relative pose is not rigid")
    scale = result.scale_initial
    if scale is not None and not SCALE_INITIAL_MIN <= scale <= SCALE_INITIAL_MAX:
        scale = None
    covariance = None if result.covariance is None else upper_triangle(result.covariance)
    counts = (result.correspondences, result.odometry_correspondences)
    record = ClosureRecord(query, match, pose7(result.T_query_match_unscaled), *counts, ratio, scale, covariance)
    encode_record(record)
    return record


def told(record: ClosureRecord | RejectionRecord, by: LogId) -> ClosureAccepted | ClosureRejected:
    """An accepted or refused registration, for people; `by` is the log that its record stands in."""
    if isinstance(record, RejectionRecord) and record.reason == UNLIKELY:
        return ClosureRejected(query=record.query, match=record.match, by=by.robot, reason=record.reason)
    if isinstance(record, RejectionRecord):
        ratio = round(match_ratio(record.correspondences, record.odometry_correspondences), 4)
        return ClosureRejected(
            query=record.query,
            match=record.match,
            correspondences=record.correspondences,
            odometry_correspondences=record.odometry_correspondences,
            ratio=ratio,
            by=by.robot,
            reason=record.reason,
        )
    return ClosureAccepted(
        query=record.query,
        match=record.match,
        correspondences=record.correspondences,
        odometry_correspondences=record.odometry_correspondences,
        ratio=round(record.match_ratio, 4),
        by=by.robot,
        scale_initial=record.scale_initial,
    )
