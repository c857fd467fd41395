"""Covariances that are orders of magnitude too small are made larger and said; true and threefold ones are not."""

from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.backend import chains
from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.understated import widened
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, PoseGraph, Trajectory
from flocc_lab.bench.generated_graph import Noise, generate

CONFIG = BackendConfig(weight_by_probability=False)
NOISE = Noise()


def graph_with(factor: float) -> PoseGraph:
    """Three robots whose measured variances are the true ones times a factor."""
    graph = generate(np.random.default_rng(5), 3, 120, 90, 0.1).graph
    odometry, closure = (np.diag(np.repeat(np.square(sigmas), 3)) for sigmas in (NOISE.odometry, NOISE.closure))
    ways = {
        log: Trajectory(t.T_odom_keyframe, np.broadcast_to(factor * odometry, (len(t) - 1, 6, 6)).copy())
        for log, t in graph.trajectories.items()
    }
    return PoseGraph(ways, [replace(c, covariance=factor * closure) for c in graph.closures])


@pytest.mark.parametrize("factor", [1e-6, 1e-12])
def test_covariances_that_are_a_millionth_are_widened_and_closures_are_used(factor: float) -> None:
    solution = optimise(graph_with(factor), CONFIG)
    assert isinstance(solution, GraphSolution)
    used = sum(c.state is ClosureState.USED for c in solution.closures)
    assert used > 60
    assert "stated standard deviations are too small" in solution.warnings[0]
    assert all(S is not None for c in solution.components for S in c.covariance_map_odom.values())


def test_with_chains_and_without_the_same_closures_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = graph_with(1e-9)
    states = []
    for poses_min in (100, 10**9):
        monkeypatch.setattr(chains, "CHAINED_POSES_MIN", poses_min)
        solution = optimise(graph, CONFIG)
        assert isinstance(solution, GraphSolution)
        states.append([c.state for c in solution.closures])
    assert sum(a is not b for a, b in zip(*states, strict=True)) <= 2


@pytest.mark.parametrize("factor", [1.0, 1.0 / 9.0, 100.0])
def test_covariances_that_are_near_the_truth_are_taken_as_they_are(factor: float) -> None:
    graph = graph_with(factor)
    assert widened(graph.trajectories, dict(enumerate(graph.closures)), CONFIG).warnings == ()


def test_closures_that_have_nothing_in_common_are_not_explained_by_noise() -> None:
    graph, rng = graph_with(1.0), np.random.default_rng(1)
    shuffled = rng.permutation([c.T_query_match_unscaled for c in graph.closures])
    closures = {k: replace(c, T_query_match_unscaled=shuffled[k]) for k, c in enumerate(graph.closures)}
    assert widened(graph.trajectories, closures, CONFIG).warnings == ()
