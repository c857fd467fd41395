"""A correction laid over a log: at listed keyframes, between them, after them, and at any time."""

from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.core.corrected import CorrectedLog, RecordedOdometry
from flocc_agent.core.log_copy import LogCopy
from flocc_agent.geometry import Float, inverse, pose, pose7, se3_exp, twists_of_poses
from flocc_protocol.arrays import Array
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import Knots, LogCorrection
from flocc_protocol.records import KeyframeRecord, encode_record

R1 = LogId("r1")
TURN = se3_exp(np.array([0.0, 0.0, 0.4, 1.0, 2.0, 0.0]))
MOUNTING = pose(np.eye(3), np.array([0.2, 0.0, 0.1]))


def at(x_m: float) -> Float:
    return pose(np.eye(3), np.array([x_m, 0.0, 0.0]))


def recorded(copy: LogCopy, *indices: int) -> None:
    """Keyframes one metre and two seconds apart, with closures in between that are none of its business."""
    for index in indices:
        record = KeyframeRecord(index, 2.0 * index, pose7(at(float(index))), None)
        copy.append(encode_record(record))


def correction(first: int, step: int, *T_map_camera: Float) -> LogCorrection:
    """One whose knots put these keyframes of the recorded ones where they are to be."""
    numbers = first + step * np.arange(len(T_map_camera))
    T_map_odom = [T @ inverse(at(float(k))) for k, T in zip(numbers, T_map_camera, strict=True)]
    told = T_map_odom[-1]
    twists = Array.of(twists_of_poses(np.array([inverse(told) @ T for T in T_map_odom])), "f4")
    knots = Knots(None, Array.of(np.zeros(3), "f8"), Array.of(numbers, "u4"), twists)
    return LogCorrection(R1, Term(1, R1), 1, R1, pose7(told), knots)


def corrected(message: LogCorrection, keyframes: int, T_camera_body: Float | None = None) -> CorrectedLog:
    copy = LogCopy()
    recorded(copy, *range(keyframes))
    return CorrectedLog(message, RecordedOdometry(copy), T_camera_body)


def test_a_listed_keyframe_is_where_the_correction_says() -> None:
    log = corrected(correction(0, 2, at(0.1), TURN @ at(2.0)), 3)
    assert log.pose_of(0) == pytest.approx(at(0.1), abs=1e-6)
    assert log.pose_of(2) == pytest.approx(TURN @ at(2.0), abs=1e-6)


def test_between_two_listed_keyframes_the_correction_is_interpolated() -> None:
    half = se3_exp(np.array([0.0, 0.0, 0.2, 0.5, 1.0, 0.0]))
    log = corrected(correction(0, 2, at(0.0), TURN @ at(2.0)), 3)
    assert log.pose_of(1) == pytest.approx(half @ at(1.0), abs=1e-6)


def test_before_the_first_and_after_the_last_listed_keyframe_the_correction_stays() -> None:
    log = corrected(correction(1, 1, at(1.0), TURN @ at(2.0)), 5)
    assert log.pose_of(0) == pytest.approx(at(0.0), abs=1e-6)
    assert log.pose_of(4) == pytest.approx(TURN @ at(4.0), abs=1e-6)


def test_a_correction_in_short_moves_everything_with_the_odom_frame() -> None:
    log = corrected(replace(correction(0, 1, at(0.0), TURN @ at(1.0)), knots=None), 2)
    assert log.poses() == pytest.approx(np.array([TURN @ at(0.0), TURN @ at(1.0)]), abs=1e-6)


def test_knots_beyond_what_is_known_of_the_log_count_all_the_same() -> None:
    log = corrected(correction(0, 4, at(0.0), at(8.0)), 3)
    assert [log.poses()[k][0, 3] for k in range(3)] == pytest.approx([0.0, 2.0, 4.0], abs=1e-6)


def test_poses_are_the_bodys_where_its_mounting_is_known() -> None:
    log = corrected(correction(0, 1, TURN), 1, MOUNTING)
    assert log.pose_of(0) == pytest.approx(TURN @ MOUNTING, abs=1e-6)


def test_between_two_keyframes_a_time_has_a_pose_and_outside_it_has_none() -> None:
    log = corrected(correction(0, 1, at(0.0), at(1.5)), 2)
    assert log.pose_at(0.0) == pytest.approx(at(0.0), abs=1e-6)
    assert log.pose_at(0.5) == pytest.approx(at(0.375), abs=1e-6)
    assert log.pose_at(2.0) == pytest.approx(at(1.5), abs=1e-6)
    assert [log.pose_at(stamp_s) for stamp_s in (-0.01, 2.01)] == [None, None]


def test_there_is_no_pose_of_a_keyframe_that_is_not_known() -> None:
    log = corrected(correction(0, 1, at(0.0)), 1)
    assert [log.pose_of(index) for index in (-1, 1)] == [None, None]
    nothing = corrected(correction(0, 1, at(0.0)), 0)
    assert [nothing.last(), nothing.pose_at(0.0)] == [None, None]


def test_keyframes_that_come_later_move_with_the_end_until_more_is_known() -> None:
    copy = LogCopy()
    recorded(copy, 0, 1)
    log = CorrectedLog(correction(0, 1, at(0.0), at(1.0), TURN @ at(2.0)), RecordedOdometry(copy))
    assert len(log.poses()) == 2
    recorded(copy, 2, 3)
    assert log.pose_of(2) == pytest.approx(TURN @ at(2.0), abs=1e-6)
    assert log.last() == pytest.approx(TURN @ at(3.0), abs=1e-6)


def test_a_keyframe_keeps_its_number_behind_one_that_a_later_version_wrote() -> None:
    copy = LogCopy()
    recorded(copy, 0, 2)
    log = CorrectedLog(correction(0, 1, at(0.0), at(1.0), TURN @ at(2.0)), RecordedOdometry(copy))
    assert log.pose_of(2) == pytest.approx(TURN @ at(2.0), abs=1e-6)
    assert log.pose_of(3) is None
    assert log.pose_at(4.0) == pytest.approx(TURN @ at(2.0), abs=1e-6)
