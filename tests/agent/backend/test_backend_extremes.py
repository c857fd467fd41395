"""Claim: whatever a log may hold, the optimiser answers with finite poses; one absurd record stops nobody."""

from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.knots import Track, knots_of, strays
from flocc_agent.core.pose_graph import (
    WORLD,
    ClosureState,
    GraphSolution,
    LoopClosure,
    MeasuredFactor,
    PoseGraph,
    Trajectory,
    landmark,
)
from flocc_protocol.ids import KeyframeId, LogId, Term
from flocc_protocol.messages import LogCorrection

A, B = LogId("a"), LogId("b")


def translated(*t_m: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    T = np.eye(4)
    T[:3, 3] = t_m
    return T


def trajectory(jump_m: float = 0.0) -> Trajectory:
    """Eight keyframes along x, with a jump after the fourth."""
    return Trajectory(np.array([translated(k + (jump_m if k >= 4 else 0.0), 0.0, 0.0) for k in range(8)]))


def closure(k: int, y_m: float = 1.0, scale: float = 1.0) -> LoopClosure:
    return LoopClosure(KeyframeId(A, k), KeyframeId(B, k), translated(0.0, y_m, 0.0), 0.9, scale)


def fix(x_m: float, y_m: float) -> MeasuredFactor:
    at = KeyframeId(A, 2)
    return MeasuredFactor("fix", at, landmark(WORLD), at, translated(x_m, y_m, 0.0), 0.1 * np.eye(3))


GOOD = tuple(closure(k) for k in (1, 3, 5, 6))
PLAIN = PoseGraph({A: trajectory(), B: trajectory()}, GOOD)
EXTREMES = {
    "a closure over 10,000 km": replace(PLAIN, closures=(*GOOD, closure(4, y_m=1e7))),
    "a closure of scale 1e9": replace(PLAIN, closures=(*GOOD, closure(4, scale=1e9))),
    "a closure of scale 1e-9": replace(PLAIN, closures=(*GOOD, closure(4, scale=1e-9))),
    "a fix in UTM coordinates": replace(PLAIN, measured=(fix(5e5, 5e6),)),
    "odometry that jumps 5,000 km": replace(PLAIN, trajectories={A: trajectory(5e6), B: trajectory()}),
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("solver", [Solver.LM, Solver.GNC_TLS])
@pytest.mark.parametrize("formulation", list(Formulation))
@pytest.mark.parametrize("name", EXTREMES)
def test_an_absurd_record_does_not_stop_the_optimiser(name: str, formulation: Formulation, solver: Solver) -> None:
    solution = optimise(EXTREMES[name], BackendConfig(formulation=formulation, solver=solver), None)
    assert isinstance(solution, GraphSolution)
    assert sorted(log for component in solution.components for log in component.logs) == [A, B]
    for component in solution.components:
        for log in component.logs:
            track = Track(
                EXTREMES[name].trajectories[log].T_odom_keyframe,
                component.T_map_keyframe[log],
                component.T_map_odom[log],
                component.covariance_map_odom[log],
            )
            worst = strays(LogCorrection(log, Term(1, A), 1, A, *knots_of(track)), track)
            assert worst <= (100.0 if "5,000 km" in name else 1.0)


def test_the_plain_graph_has_covariances() -> None:
    solution = optimise(PLAIN, BackendConfig(), None)
    assert isinstance(solution, GraphSolution)
    assert all(S is not None for component in solution.components for S in component.covariance_map_odom.values())


@pytest.mark.parametrize("name", ["a closure over 10,000 km", "a closure of scale 1e9"])
def test_a_closure_longer_than_any_registration_is_refused_by_name(name: str) -> None:
    solution = optimise(EXTREMES[name], BackendConfig(formulation=Formulation.BASE, solver=Solver.LM), None)
    assert isinstance(solution, GraphSolution)
    assert [c.state for c in solution.closures] == [*[ClosureState.USED] * 4, ClosureState.EXCLUDED]
    assert "closure a/4 - b/4" in solution.closures[4].reason
    assert "is longer than" in solution.closures[4].reason
