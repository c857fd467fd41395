"""Claims: a map is placed on Earth by its robots' fixes, and not where they leave open how it is turned."""

from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.core.corrected import CorrectedLog, RecordedOdometry
from flocc_agent.core.earth_frame import T_earth_map
from flocc_agent.core.geodesy import Place, T_earth_enu, place_of
from flocc_agent.core.log_copy import LogCopy
from flocc_agent.geometry import Float, inverse, pose, pose7, se3_exp
from flocc_protocol.arrays import Array
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import Knots, LogCorrection
from flocc_protocol.records import GeodeticFixRecord, KeyframeRecord, encode_record

R1 = LogId("r1")
SIGMA_M = 0.5
T_EARTH_MAP = T_earth_enu(Place(48.1, 11.5, 500.0)) @ se3_exp(np.array([0.02, -0.01, 1.2, 30.0, -20.0, 3.0]))
T_MAP_ODOM = se3_exp(np.array([0.0, 0.1, 0.5, 5.0, 6.0, 7.0]))
BENT = np.array([[min(k, 20), max(0, k - 20), 0.1 * (k % 3)] for k in range(41)], dtype=float)
STRAIGHT = np.array([[k, 0.0, 0.0] for k in range(41)], dtype=float)


def log_of(cameras_m: Float, wrong_m: dict[int, float] | None = None, seed: int = 1) -> CorrectedLog:
    """A robot at places (N, 3) of its odometry, with a fix at each that is off as its covariance says, or far off."""
    copy, rng = LogCopy(), np.random.default_rng(seed)
    for k, camera_m in enumerate(cameras_m):
        keyframe = KeyframeRecord(k, float(k), pose7(pose(np.eye(3), camera_m)), None)
        off_m = rng.normal(0.0, SIGMA_M, 3) + np.array([(wrong_m or {}).get(k, 0.0), 0.0, 0.0])
        place = place_of((T_EARTH_MAP @ T_MAP_ODOM @ [*camera_m, 1.0])[:3] + off_m)
        fix = GeodeticFixRecord(k, *place, Array.of(SIGMA_M**2 * np.eye(3).ravel(), "f4"))
        for record in (keyframe, fix):
            copy.append(encode_record(record))
    knots = Knots(None, Array.of(np.zeros(3), "f8"), Array.of(np.array([0]), "u4"), Array.of(np.zeros((1, 6)), "f4"))
    return CorrectedLog(LogCorrection(R1, Term(1, R1), 1, R1, pose7(T_MAP_ODOM), knots), RecordedOdometry(copy))


def error(found: Float | None) -> tuple[float, float]:
    """Metres at the middle of the way, and radians."""
    assert found is not None
    T = inverse(T_EARTH_MAP) @ found
    middle = T_MAP_ODOM @ [10.0, 10.0, 0.0, 1.0]
    angle_rad = np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return float(np.linalg.norm((T @ middle - middle)[:3])), float(angle_rad)


@pytest.mark.parametrize("seed", range(5))
def test_fixes_place_the_map_as_exactly_as_they_are(seed: int) -> None:
    off_m, off_rad = error(T_earth_map([log_of(BENT, seed=seed)]))
    assert off_m < 4 * SIGMA_M / np.sqrt(len(BENT))
    assert off_rad < np.radians(5.0)


def test_wrong_fixes_count_little() -> None:
    wrong_m = dict.fromkeys(range(3, 41, 7), 80.0)
    off_m, off_rad = error(T_earth_map([log_of(BENT, wrong_m)]))
    assert off_m < 1.0
    assert off_rad < np.radians(5.0)


def test_robots_on_straight_ways_place_it_together_and_none_alone() -> None:
    ways = [STRAIGHT, STRAIGHT[:, [1, 0, 2]]]
    assert [T_earth_map([log_of(way)]) for way in ways] == [None, None]
    assert error(T_earth_map([log_of(ways[0]), log_of(ways[1], seed=2)]))[0] < 1.0


def test_without_fixes_or_with_few_it_is_not_known() -> None:
    assert T_earth_map([]) is None
    assert T_earth_map([log_of(BENT[:3])]) is None


def test_a_robot_of_which_only_the_end_is_known_says_nothing() -> None:
    log = log_of(BENT)
    short = CorrectedLog(replace(log._correction, knots=None), log._odometry)
    assert T_earth_map([short]) is None
