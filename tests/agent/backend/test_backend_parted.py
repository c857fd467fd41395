"""Few closures between two maps whose errors are larger than stated join them, where all of them agree."""

from collections.abc import Sequence

import numpy as np
import pytest

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import Float, between, inverse, pose, se3_exp, so3_exp
from flocc_launch.graph_files.graph_file import unit_length
from flocc_protocol.ids import KeyframeId, LogId

R1, R2 = LogId("r1"), LogId("r2")
CONFIG = BackendConfig(weight_by_probability=False)
STATED = np.diag([0.02**2] * 3 + [0.05**2] * 3)
TURN_RAD = 0.17


def walk(aside_m: float) -> Float:
    """Poses (N, 4, 4) along a gentle curve, a metre a step."""
    headings = 0.05 * np.arange(30)
    steps = np.stack([np.cos(headings), np.sin(headings), 0.0 * headings], axis=1)
    at = np.array([0.0, aside_m, 0.0]) + np.cumsum(steps, axis=0)
    return np.array([pose(so3_exp(np.array([0.0, 0.0, h])), t) for h, t in zip(headings, at, strict=True)])


WORLD = {R1: walk(0.0), R2: walk(3.0)}
EXACT = np.broadcast_to(np.diag([0.001**2] * 3 + [0.005**2] * 3), (29, 6, 6))
ODOMETRY = {log: Trajectory(np.array([between(T[0], each) for each in T]), EXACT) for log, T in WORLD.items()}


def turned(k: int, turn_rad: float, covariance: Float | None = STATED) -> LoopClosure:
    """A metric closure between the k-th keyframes that is off by a turn."""
    T = between(WORLD[R1][k], WORLD[R2][k]) @ se3_exp(np.array([0.0, 0.0, turn_rad, 0.0, 0.0, 0.0]))
    return LoopClosure(KeyframeId(R1, k), KeyframeId(R2, k), T, covariance=covariance, metric=True)


def solved(closures: Sequence[LoopClosure]) -> GraphSolution:
    solution = optimise(PoseGraph(ODOMETRY, closures), CONFIG)
    assert isinstance(solution, GraphSolution)
    return solution


def test_two_closures_that_agree_only_with_larger_errors_join_two_maps_and_it_is_said() -> None:
    found = solved([turned(2, TURN_RAD), turned(26, -TURN_RAD)])
    (component,) = found.components
    assert [c.state for c in found.closures] == [ClosureState.USED, ClosureState.USED]
    T_r1_r2 = inverse(component.T_map_keyframe[R1][14]) @ component.T_map_keyframe[R2][14]
    np.testing.assert_allclose(T_r1_r2[:3, 3], between(WORLD[R1][14], WORLD[R2][14])[:3, 3], atol=0.6)
    assert any("larger than stated" in sentence for sentence in found.warnings)


FITTING = (turned(2, TURN_RAD), turned(26, -TURN_RAD))


@pytest.mark.parametrize(
    "closures",
    [
        (*FITTING, turned(14, 1.0)),
        (FITTING[0], turned(26, -6.0 * TURN_RAD)),
        (FITTING[0], turned(26, -3.0 * TURN_RAD, covariance=None)),
    ],
    ids=["one does not fit", "they are too far apart", "one states no errors"],
)
def test_they_join_nothing_otherwise(closures: tuple[LoopClosure, ...]) -> None:
    found = solved(closures)
    assert len(found.components) == 2
    assert not any("larger than stated" in sentence for sentence in found.warnings)


def test_of_closures_without_a_length_there_must_be_one_more() -> None:
    """Two wrong ones may agree by chance within larger errors: four robots were once joined 10 m off by them."""
    third = turned(14, 0.0)
    assert len(solved([unit_length(c) for c in FITTING]).components) == 2
    assert len(solved([unit_length(c) for c in (FITTING[0], third, FITTING[1])]).components) == 1
