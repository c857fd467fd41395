"""Honest corrections that surprise: a robot that was carried farther than its odometry says."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.core.knots import Track, knots_of
from flocc_agent.core.plausibility import BENT, Placed, contradiction
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import LogCorrection
from flocc_protocol.records import ClosureRecord

OWN = LogId("r2")
STEP_M = 0.5


class _Held:
    """A robot that knows its own odometry alone, along x."""

    def __init__(self, way_m: float) -> None:
        self.T_odom = np.tile(np.eye(4), (round(way_m / STEP_M) + 1, 1, 1))
        self.T_odom[:, 0, 3] = STEP_M * np.arange(len(self.T_odom))

    def odometry(self, log: LogId) -> NDArray[np.float64]:
        return self.T_odom if log == OWN else np.empty((0, 4, 4))

    def ties(self, log: LogId, ties_max: int) -> Sequence[ClosureRecord]:
        return ()

    def joined(self, log: LogId, other: LogId) -> bool:
        return True


def judged(held: _Held, T_map_camera: NDArray[np.float64]) -> str | None:
    T_map_odom, knots = knots_of(Track(held.T_odom, T_map_camera, np.eye(4), None))
    return contradiction(Placed(LogCorrection(OWN, Term(1, OWN), 1, OWN, T_map_odom, knots), {}), None, held)


@pytest.mark.parametrize(("ride_m", "way_m"), [(20.0, 20.0), (50.0, 100.0), (100.0, 300.0)])
def test_a_ride_that_odometry_missed_is_no_lie(ride_m: float, way_m: float) -> None:
    held = _Held(way_m)
    T_map_camera = held.T_odom.copy()
    T_map_camera[len(T_map_camera) // 2 :, 1, 3] += ride_m
    assert judged(held, T_map_camera) is None


def test_odometry_that_is_torn_in_many_places_is_one() -> None:
    held = _Held(100.0)
    T_map_camera = held.T_odom.copy()
    T_map_camera[1::2, 1, 3] += 8.0
    assert judged(held, T_map_camera) == BENT
