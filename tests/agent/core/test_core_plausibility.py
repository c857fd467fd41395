"""What a correction may do to a robot's odometry: what was measured on both sides, and nothing else."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.core.closure_rows import Tie
from flocc_agent.core.correction_evidence import Placed
from flocc_agent.core.knots import Track, knots_of
from flocc_agent.core.plausibility import BENT, TORN, UNTIED, contradiction
from flocc_agent.core.pose_graph import WORLD, MeasuredFactor, landmark
from flocc_agent.geometry import pose
from flocc_protocol.ids import KeyframeId, LogId, Term
from flocc_protocol.messages import LogCorrection

OWN, OTHER = LogId("r2"), LogId("r1")
STEP_M = 0.5
Float = NDArray[np.float64]


class _Held:
    """A robot whose odometry leads along x, and another one that was where the first one is said to have been."""

    def __init__(self, way_m: float, T_map: Float | None = None, met: Sequence[int] = (), fixed: Sequence[int] = ()):
        self.T_odom = np.tile(np.eye(4), (round(way_m / STEP_M) + 1, 1, 1))
        self.T_odom[:, 0, 3] = STEP_M * np.arange(len(self.T_odom))
        self.T_map = self.T_odom if T_map is None else T_map
        self._met, self._fixed = met, fixed

    def odometry(self, log: LogId) -> Float:
        return self.T_odom if log == OWN else self.T_map

    def ties(self, log: LogId, ties_max: int) -> Sequence[Tie]:
        return [Tie(k, KeyframeId(OTHER, k), 0.0) for k in self._met]

    def measured(self, log: LogId) -> Sequence[MeasuredFactor]:
        ends = [KeyframeId(OWN, k) for k in self._fixed]
        at = [pose(np.eye(3), self.T_map[end.index, :3, 3] + 1e3) for end in ends]
        return [MeasuredFactor("fix", e, landmark(WORLD), e, T, np.eye(3)) for e, T in zip(ends, at, strict=True)]

    def joined(self, log: LogId, other: LogId) -> bool:
        return True

    def judged(self, T_map_camera: Float) -> str | None:
        T_map_odom, knots = knots_of(Track(self.T_odom, T_map_camera, np.eye(4), None))
        own = LogCorrection(OWN, Term(1, OWN), 1, OTHER, T_map_odom, knots)
        if not len(self.T_map):
            return contradiction(Placed(own, {}), None, self)
        there = LogCorrection(OTHER, Term(1, OWN), 1, OTHER, *knots_of(Track(self.T_map, self.T_map, np.eye(4), None)))
        return contradiction(Placed(own, {OTHER: there}), None, self)


def ridden(way_m: float, *ride_m: float) -> Float:
    """Where a robot was that was carried sideways, in equal parts of its way."""
    T_map = _Held(way_m).T_odom.copy()
    for k, part in enumerate(ride_m):
        T_map[len(T_map) * (k + 1) // (len(ride_m) + 1) :, 1, 3] += part
    return T_map


@pytest.mark.parametrize("rides", [(20.0,), (50.0, -30.0), (40.0, 40.0, -50.0, 30.0, 50.0)])
@pytest.mark.parametrize("by", ["closures", "fixes"])
def test_rides_that_were_measured_on_both_sides_are_no_lies(rides: tuple[float, ...], by: str) -> None:
    T_map = ridden(60.0, *rides)
    seen = range(0, len(T_map), 7)
    held = _Held(60.0, T_map, seen, ()) if by == "closures" else _Held(60.0, T_map, (), seen)
    assert held.judged(T_map) is None


@pytest.mark.parametrize("met", [(), (0, 5, 10)])
def test_a_ride_after_the_last_measurement_is_a_lie(met: tuple[int, ...]) -> None:
    assert _Held(60.0, met=met).judged(ridden(60.0, 20.0)) == BENT


def test_a_map_whose_anchor_is_not_here_yet_is_waited_for() -> None:
    """Seed 99200016: the closure was here before the anchor's keyframes, and a liar moved the robot by 1,000 km."""
    held = _Held(60.0, met=(5,))
    assert held.judged(held.T_map) is None
    odometry = held.T_map
    held.T_map = np.empty((0, 4, 4))
    assert held.judged(odometry + 1e6 * np.eye(4, k=3)) == UNTIED


def test_a_ride_that_measurements_deny_is_a_lie() -> None:
    held = _Held(60.0, met=range(0, 121, 7))
    assert held.judged(ridden(60.0, 14.0, -14.0, 14.0)) == BENT
    assert held.judged(ridden(60.0, 40.0)) == TORN


def test_odometry_that_is_torn_in_many_places_is_one() -> None:
    held = _Held(100.0)
    T_map_camera = held.T_odom.copy()
    T_map_camera[1::2, 1, 3] += 8.0
    assert held.judged(T_map_camera) == BENT


def test_what_grows_by_little_each_round_is_not_believed_for_ever() -> None:
    held = _Held(60.0, met=range(0, 121, 7))
    believed_m = 0.0
    for metres in range(100):
        T_map = held.T_odom.copy()
        T_map[:, 1, 3] += metres
        believed_m = metres if held.judged(T_map) is None else believed_m
    assert believed_m <= 15.0
