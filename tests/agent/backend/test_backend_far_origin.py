"""Claim: where odometry has its origin changes nothing; UTM coordinates are solved like those of a room."""

import numpy as np
import pytest

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import GraphSolution, PoseGraph, Trajectory
from flocc_agent.geometry import adjoint, inverse, pose, so3_exp
from flocc_lab.bench.generated_graph import generate
from flocc_protocol.ids import KeyframeId, LogId

CONFIG = BackendConfig(weight_by_probability=False)
ASKED = KeyframeId(LogId("r01"), 40)


def moved(graph: PoseGraph, T_far: dict[LogId, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]) -> PoseGraph:
    return PoseGraph(
        {
            log: Trajectory(T_far[log] @ np.asarray(trajectory.T_odom_keyframe), trajectory.edge_covariances)
            for log, trajectory in graph.trajectories.items()
        },
        graph.closures,
    )


def solved(graph: PoseGraph, initial: GraphSolution | None = None) -> GraphSolution:
    solution = optimise(graph, CONFIG, initial, [ASKED])
    assert isinstance(solution, GraphSolution)
    return solution


@pytest.mark.parametrize("keyframes", [100, 800], ids=["all keyframes", "chains"])
def test_odometry_in_utm_coordinates_is_solved_like_any_other(keyframes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flocc_agent.backend.chains.CHAINED_POSES_MIN", 2000)
    graph = generate(np.random.default_rng(3), 3, keyframes, 90, 0.1).graph
    T_far = {
        log: pose(so3_exp(np.array([0.0, 0.0, 0.7 * k])), np.array([5e5, 5e6 + 1e4 * k, 500.0]))
        for k, log in enumerate(sorted(graph.trajectories))
    }
    near, far = solved(graph), solved(moved(graph, T_far))

    assert [c.logs for c in far.components] == [c.logs for c in near.components]
    assert [c.state for c in far.closures] == [c.state for c in near.closures]
    (a,), (b,) = near.components, far.components
    assert b.cost == pytest.approx(a.cost, rel=1e-3)
    T_maps = T_far[a.anchor]
    for log in a.logs:
        apart = inverse(T_maps @ a.T_map_keyframe[log]) @ b.T_map_keyframe[log]
        assert np.linalg.norm(apart[:, :3, 3], axis=1).max() < 0.02
        S, S_near = b.covariance_map_odom[log], a.covariance_map_odom[log]
        assert S is not None
        assert S_near is not None
        Ad = adjoint(T_far[log])
        S_far = Ad @ S_near @ Ad.T
        np.testing.assert_allclose(S, S_far, rtol=0.02, atol=1e-3 * np.abs(S_far).max())
    S_asked = a.covariance_keyframe[ASKED]
    np.testing.assert_allclose(b.covariance_keyframe[ASKED], S_asked, rtol=0.02, atol=1e-3 * np.abs(S_asked).max())
    again = solved(moved(graph, T_far), far)
    assert again.components[0].cost == pytest.approx(b.cost, rel=1e-3)
    assert again.iterations < far.iterations
