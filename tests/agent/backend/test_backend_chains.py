"""Keyframes that only odometry holds are eliminated before the solve and come back where they would have been."""

import numpy as np
import pytest

from flocc_agent.backend import chains
from flocc_agent.backend.chains import CHAIN_EDGES_MAX, chains_of, kept_numbers
from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig, Formulation
from flocc_agent.core.pose_graph import GraphSolution, PoseGraph, Trajectory, stretched
from flocc_agent.geometry import inverse
from flocc_lab.bench.generated_graph import GeneratedGraph, generate
from flocc_protocol.ids import KeyframeId, LogId

CONFIG = BackendConfig(weight_by_probability=False)
R00 = LogId("r00")


def graph_of(keyframes: int = 800, closures: int = 90, seed: int = 3, outlier_ratio: float = 0.1) -> GeneratedGraph:
    return generate(np.random.default_rng(seed), 3, keyframes, closures, outlier_ratio)


def solved(graph: PoseGraph, initial: GraphSolution | None = None, config: BackendConfig = CONFIG) -> GraphSolution:
    solution = optimise(graph, config, initial, [KeyframeId(R00, 333)])
    assert isinstance(solution, GraphSolution)
    return solution


def worst_m(a: GraphSolution, b: GraphSolution) -> float:
    of_b = {log: T for component in b.components for log, T in component.T_map_keyframe.items()}
    return max(
        float(np.linalg.norm((inverse(np.asarray(T)) @ of_b[log])[:, :3, 3], axis=1).max())
        for component in a.components
        for log, T in component.T_map_keyframe.items()
    )


def test_chains_give_the_solution_of_all_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = graph_of().graph
    short = solved(graph)
    monkeypatch.setattr(chains, "CHAINED_POSES_MIN", 10**9)
    whole = solved(graph)

    assert [c.state for c in short.closures] == [c.state for c in whole.closures]
    assert short.components[0].cost == pytest.approx(whole.components[0].cost, rel=1e-3)
    assert worst_m(short, whole) < 0.02
    for log, S in whole.components[0].covariance_map_odom.items():
        S_short = short.components[0].covariance_map_odom[log]
        assert S is not None
        assert S_short is not None
        np.testing.assert_allclose(S_short, S, rtol=0.02, atol=1e-3 * np.abs(S).max())
    asked = KeyframeId(R00, 333)
    S = whole.components[0].covariance_keyframe[asked]
    np.testing.assert_allclose(
        short.components[0].covariance_keyframe[asked], S, rtol=0.02, atol=1e-3 * np.abs(S).max()
    )


def test_a_round_goes_on_from_the_one_before_it() -> None:
    graph = graph_of().graph
    earlier = solved(PoseGraph(graph.trajectories, graph.closures[:-5]))
    assert worst_m(solved(graph, earlier), solved(graph)) < 0.02


def test_chains_that_are_bent_too_far_are_solved_with_all_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = graph_of().graph
    monkeypatch.setattr(chains, "STRAIN_RATIO_MAX", -1.0)
    resolved = solved(graph)
    monkeypatch.setattr(chains, "CHAINED_POSES_MIN", 10**9)
    assert worst_m(resolved, solved(graph)) < 1e-3


def test_the_size_of_a_map_whose_scales_are_only_ratios_is_that_of_all_keyframes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    generated = graph_of().graph
    ratios = dict(zip(sorted(generated.trajectories), (0.9, 1.0, 1.1), strict=True))
    longer = {log: stretched(Trajectory(t.T_odom_keyframe), ratios[log]) for log, t in generated.trajectories.items()}
    graph = PoseGraph(longer, generated.closures)
    monkeypatch.setattr(chains, "STRAIN_RATIO_MAX", -1.0)
    resolved = solved(graph)
    assert all(scale.is_applied and not scale.is_metric for scale in resolved.components[0].odometry_scales.values())
    monkeypatch.setattr(chains, "CHAINED_POSES_MIN", 10**9)
    assert worst_m(resolved, solved(graph)) < 0.5


def test_measurements_as_they_are_given_keep_every_keyframe() -> None:
    graph = graph_of().graph
    held = dict(enumerate(graph.closures))
    base = CONFIG.model_copy(update={"formulation": Formulation.BASE})
    assert chains_of(graph.trajectories, held, (), base) is None
    assert chains_of(graph.trajectories, held, (), CONFIG) is not None


def test_keyframes_between_come_back_where_odometry_has_them() -> None:
    graph = graph_of(outlier_ratio=0.0).graph
    found = chains_of(graph.trajectories, dict(enumerate(graph.closures)), (), CONFIG)
    assert found is not None
    odometry = {log: np.asarray(trajectory.T_odom_keyframe) for log, trajectory in graph.trajectories.items()}
    back = found.lengthened(found.shortened(odometry), {})
    for log, T in odometry.items():
        np.testing.assert_allclose(back[log], T, atol=1e-9)


def test_far_origins_lose_nothing() -> None:
    graph = graph_of(outlier_ratio=0.0).graph
    far = np.eye(4)
    far[:3, 3] = 500_000.0, 5_000_000.0, 0.0
    moved = {
        log: Trajectory(far @ np.asarray(trajectory.T_odom_keyframe), trajectory.edge_covariances)
        for log, trajectory in graph.trajectories.items()
    }
    closures = dict(enumerate(graph.closures))
    near, away = (chains_of(trajectories, closures, (), CONFIG) for trajectories in (graph.trajectories, moved))
    assert near is not None
    assert away is not None
    for log, trajectory in near.trajectories.items():
        of_far = np.asarray(away.trajectories[log].edge_covariances)
        np.testing.assert_allclose(of_far, np.asarray(trajectory.edge_covariances), rtol=1e-6, atol=1e-12)


def test_long_chains_are_cut_evenly() -> None:
    numbers = kept_numbers([7, 7, 8], 300)
    assert {0, 7, 8, 299} <= set(numbers.tolist())
    assert np.diff(numbers).max() <= CHAIN_EDGES_MAX
    assert kept_numbers([], 1).tolist() == [0]
