"""Claims about the published protocol for distributed back ends: its numbers hold in what is drawn."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.backend.optimiser import optimise
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, LoopClosure
from flocc_agent.geometry import inverse, se3_log, umeyama
from flocc_lab.graph_family.methods import settings
from flocc_lab.graph_family.team_walks import (
    BETWEEN_RANGE_M,
    BETWEEN_STEPS,
    OWN_APART_STEPS,
    OWN_PROBABILITY,
    OWN_RANGE_M,
    PRIOR_SIGMA,
    STEP_SIGMA,
    TEAM_CLOSURE_SIGMA,
    TURN_PROBABILITY,
    TeamGraph,
    TeamSpec,
    team_graph,
)
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]


@pytest.fixture(scope="module")
def team() -> TeamGraph:
    return team_graph(TeamSpec(seed=1, robots=6))


def true_between(team: TeamGraph, closure: LoopClosure) -> Float:
    T_query, T_match = (team.T_world_keyframe[k.log][k.index] for k in (closure.query, closure.match))
    return np.asarray(inverse(T_query) @ T_match)


def errors(team: TeamGraph, is_of: Callable[[LoopClosure], bool]) -> Float:
    return np.array(
        [se3_log(inverse(true_between(team, c)) @ c.T_query_match_unscaled) for c in team.graph.closures if is_of(c)]
    )


def assert_spread(found: Float, sigma: tuple[float, float]) -> None:
    """Zero-mean noise of the stated standard deviations, within four standard errors."""
    count = len(found)
    for k, expected in enumerate(np.repeat(sigma, 3)):
        assert abs(found[:, k].mean()) < 4 * expected / np.sqrt(count)
        assert abs(found[:, k].std() / expected - 1.0) < 4 / np.sqrt(2 * count)


def test_every_step_is_a_metre_forward_or_a_quarter_turn(team: TeamGraph) -> None:
    for T in team.T_world_keyframe.values():
        steps = inverse(T[:-1]) @ T[1:]
        moved = np.linalg.norm(steps[:, :3, 3], axis=1)
        turned = np.array([np.linalg.norm(se3_log(step)[:3]) for step in steps])
        assert set(np.round(moved, 9)) == {0.0, 1.0}
        np.testing.assert_allclose(steps[moved > 0.5, 0, 3], 1.0, atol=1e-9)
        np.testing.assert_allclose(turned, np.where(moved > 0.5, 0.0, np.pi / 2), atol=1e-9)
        assert abs(np.mean(moved < 0.5) - TURN_PROBABILITY) < 0.1
        np.testing.assert_allclose(np.linalg.det(T[:, :3, :3]), 1.0)


def test_odometry_closures_and_priors_have_the_published_noise(team: TeamGraph) -> None:
    steps = []
    for log, T in team.T_world_keyframe.items():
        odometry = team.graph.trajectories[log].T_odom_keyframe
        measured, true = (inverse(way[:-1]) @ way[1:] for way in (odometry, T))
        steps += [se3_log(inverse(a) @ b) for a, b in zip(true, measured, strict=True)]
    assert_spread(np.array(steps), STEP_SIGMA)
    assert_spread(errors(team, lambda c: c.query.log == c.match.log), TEAM_CLOSURE_SIGMA)
    assert_spread(errors(team, lambda c: c.query.log != c.match.log), TEAM_CLOSURE_SIGMA)
    teams = [team_graph(TeamSpec(seed, 6, poses=20)) for seed in range(20)]
    begun = [se3_log(inverse(t.T_world_keyframe[log][0]) @ T) for t in teams for log, T in t.T_world_odom.items()]
    assert_spread(np.array(begun), PRIOR_SIGMA)


def test_the_sigmas_are_the_published_ones() -> None:
    published = [(0.1, 0.01), (1.0, 0.05), (1.0, 0.1)]
    drawn = [(np.rad2deg(a), b) for a, b in (PRIOR_SIGMA, STEP_SIGMA, TEAM_CLOSURE_SIGMA)]
    np.testing.assert_allclose(drawn, published)
    for closure in team_graph(TeamSpec(3, 3, 50)).graph.closures[:3]:
        np.testing.assert_allclose(np.diag(closure.covariance), np.repeat(np.square(TEAM_CLOSURE_SIGMA), 3))  # type: ignore[arg-type]


def test_own_closures_are_near_and_as_frequent_as_stated(team: TeamGraph) -> None:
    own = [c for c in team.graph.closures if c.query.log == c.match.log]
    assert max(np.linalg.norm(true_between(team, c)[:3, 3]) for c in own) <= OWN_RANGE_M
    assert min(c.query.index - c.match.index for c in own) >= OWN_APART_STEPS
    could = 0
    for T in team.T_world_keyframe.values():
        p = T[:, :3, 3]
        could += sum(
            bool(np.any(np.linalg.norm(p[: k - OWN_APART_STEPS + 1] - p[k], axis=1) <= OWN_RANGE_M))
            for k in range(OWN_APART_STEPS, len(p))
        )
    assert abs(len(own) / could - OWN_PROBABILITY) < 4 * np.sqrt(OWN_PROBABILITY * (1 - OWN_PROBABILITY) / could)


def test_robots_within_range_measure_each_other_every_fifth_step(team: TeamGraph) -> None:
    found = {(c.query, c.match) for c in team.graph.closures if c.query.log != c.match.log}
    assert all(a.index == b.index and a.index % BETWEEN_STEPS == 0 for a, b in found)
    points = np.stack([T[::BETWEEN_STEPS, :3, 3] for T in team.T_world_keyframe.values()])
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    assert len(found) == (np.count_nonzero(apart <= BETWEEN_RANGE_M) - apart.shape[0] * apart.shape[2]) // 2
    single = team_graph(replace(team.spec, all_pairs=False))
    count = sum(c.query.log != c.match.log for c in single.graph.closures)
    assert 0.5 * points.shape[0] * points.shape[1] * 0.9 < count <= points.shape[0] * points.shape[1]


def test_a_seed_names_one_team_and_a_part_of_it_is_its_beginning(team: TeamGraph) -> None:
    again, other = team_graph(team.spec), team_graph(replace(team.spec, seed=2))
    assert [c.query for c in again.graph.closures] == [c.query for c in team.graph.closures]
    assert [c.query for c in other.graph.closures] != [c.query for c in team.graph.closures]
    part = team.until(100)
    assert {len(t) for t in part.graph.trajectories.values()} == {100}
    assert list(part.graph.closures) == list(team.graph.closures[: len(part.graph.closures)])
    assert team.graph.closures[len(part.graph.closures)].query.index >= 100
    assert len(part.is_right) == len(part.graph.closures) > 0


def test_without_lengths_only_directions_between_robots_are_left(team: TeamGraph) -> None:
    for metric, closure in zip(team.graph.closures, team.without_lengths().graph.closures, strict=True):
        if metric.query.log == metric.match.log:
            assert closure is metric
            continue
        t, unit = (c.T_query_match_unscaled[:3, 3] for c in (metric, closure))
        length_m = np.linalg.norm(t)
        np.testing.assert_allclose(unit, t / length_m)
        assert not closure.metric
        assert closure.covariance is not None
        np.testing.assert_allclose(np.sqrt(np.diag(closure.covariance))[3:] * length_m, TEAM_CLOSURE_SIGMA[1])


def test_a_share_of_closures_is_wrong_where_asked(team: TeamGraph) -> None:
    assert team.is_right.all()
    bad = team_graph(replace(team.spec, outlier_ratio=0.3))
    assert abs(np.mean(~bad.is_right) - 0.3) < 0.06
    off = np.array(
        [np.linalg.norm(se3_log(inverse(true_between(bad, c)) @ c.T_query_match_unscaled)) for c in bad.graph.closures]
    )
    assert off[bad.is_right].max() < 0.6 < np.median(off[~bad.is_right])


def test_a_direction_keeps_its_uncertainty_as_an_angle(team: TeamGraph) -> None:
    for metric, unit in zip(team.graph.closures, team.without_lengths().graph.closures, strict=True):
        if unit.metric:
            continue
        assert metric.covariance is not None
        assert unit.covariance is not None
        length_m = np.linalg.norm(metric.T_query_match_unscaled[:3, 3])
        np.testing.assert_allclose(np.diag(unit.covariance), np.diag(metric.covariance) / [1, 1, 1, *[length_m**2] * 3])


def test_lengths_that_nobody_knows_cost_little_and_shrink_nothing() -> None:
    """With the error of a direction in metres a map costs less the smaller it is: 0.5 m instead of 0.13 here."""
    team = team_graph(TeamSpec(seed=2000, robots=6, poses=60))
    found = {}
    for name, graph in (("metric", team.graph), ("unknown", team.without_lengths().graph)):
        solution = optimise(graph, settings())
        assert isinstance(solution, GraphSolution)
        assert all(c.state is ClosureState.USED for c in solution.closures)
        (component,) = solution.components
        found[name], moved = aligned(component.T_map_keyframe, team.T_world_keyframe)
        assert moved == pytest.approx(1.0, abs=0.01)
    assert found["unknown"] < 1.6 * found["metric"] + 0.02


def aligned(found: Mapping[LogId, Float], truth: Mapping[LogId, Float]) -> tuple[float, float]:
    """ATE in metres, and how many times too small the map is."""
    p, q = (np.concatenate([poses[log][:, :3, 3] for log in sorted(truth)]) for poses in (found, truth))
    scale, _ = umeyama(p, q, with_scale=True)
    _, T = umeyama(p, q)
    return float(np.sqrt(np.mean(np.sum((p @ T[:3, :3].T + T[:3, 3] - q) ** 2, axis=1)))), scale
