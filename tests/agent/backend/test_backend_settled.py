"""Rounds rest on what the last whole one chose, move everything, and are whole where new closures demand it."""

from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.backend import settled
from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import inverse, pose, se3_exp, so3_exp
from flocc_lab.bench.generated_graph import GeneratedGraph, generate
from flocc_protocol.ids import KeyframeId, LogId

CONFIG = BackendConfig(weight_by_probability=False)
WHOLE, LATER = 800, 815
R00, R01 = LogId("r00"), LogId("r01")
FALSE = pose(so3_exp(np.array([0.0, 0.0, 2.0])), np.array([2.0, -3.0, 0.0]))


@pytest.fixture(scope="module")
def drawn() -> GeneratedGraph:
    return generate(np.random.default_rng(10), 3, 820, 400)


@pytest.fixture(scope="module")
def first(drawn: GeneratedGraph) -> GraphSolution:
    return solved(at(drawn, WHOLE))


def at(drawn: GeneratedGraph, keyframes: int, *more: LoopClosure) -> PoseGraph:
    """The graph as it was when each robot had so many keyframes."""
    closures = [c for c in drawn.graph.closures if max(c.query.index, c.match.index) < keyframes]
    cut = {
        log: Trajectory(
            t.T_odom_keyframe[:keyframes], None if (S := t.edge_covariances) is None else S[: keyframes - 1]
        )
        for log, t in drawn.graph.trajectories.items()
    }
    return PoseGraph(cut, (*closures, *more))


def solved(graph: PoseGraph, initial: GraphSolution | None = None) -> GraphSolution:
    solution = optimise(graph, CONFIG, initial)
    assert isinstance(solution, GraphSolution)
    return solution


def closure(i: int, j: int, T: np.ndarray) -> LoopClosure:
    return LoopClosure(KeyframeId(R00, i), KeyframeId(R01, j), T, metric=True)


def between_true(drawn: GeneratedGraph, i: int, j: int) -> np.ndarray:
    return np.asarray(inverse(drawn.T_world_keyframe[R00][i]) @ drawn.T_world_keyframe[R01][j])


def test_a_round_that_rests_on_the_one_before_ends_where_a_whole_one_does(
    drawn: GeneratedGraph, first: GraphSolution
) -> None:
    graph = at(drawn, LATER)
    assert len(graph.closures) > len(first.closures)
    found, whole = solved(graph, first), solved(graph)
    assert found.whole is first
    (component,), (of_whole,) = found.components, whole.components
    for log, T in component.T_map_keyframe.items():
        apart_m = np.linalg.norm(T[:, :3, 3] - of_whole.T_map_keyframe[log][:, :3, 3], axis=1)
        assert len(T) == LATER
        assert apart_m.max() < 0.005
        S, S_whole = component.covariance_map_odom[log], of_whole.covariance_map_odom[log]
        assert S is not None
        assert S_whole is not None
        np.testing.assert_allclose(S, S_whole, rtol=0.05, atol=0.01 * np.abs(S_whole).max())
    assert [c.state for c in found.closures] == [c.state for c in whole.closures]
    assert component.cost == pytest.approx(of_whole.cost, rel=1e-3)


def test_one_false_closure_is_turned_away_and_a_second_beside_it_opens_the_map(
    drawn: GeneratedGraph, first: GraphSolution, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(settled, "held_closures", lambda *_: {})
    T = between_true(drawn, 810, 400)
    lone = closure(810, 400, T @ FALSE)
    found = solved(at(drawn, LATER, lone), first)
    assert found.whole is first
    assert found.closures[-1].state is ClosureState.REJECTED
    other = closure(812, 402, between_true(drawn, 812, 402) @ FALSE)
    again = solved(at(drawn, LATER, lone, other), found)
    assert again.whole is None


def test_closures_that_agree_and_pull_move_what_is_old(drawn: GeneratedGraph, first: GraphSolution) -> None:
    rng = np.random.default_rng(1)
    near = [(a, b) for a in range(100, 700, 30) for b in range(100, 700)
            if np.linalg.norm(between_true(drawn, a, b)[:3, 3]) < 6.0]  # fmt: skip
    aside = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.65, 0.0]))
    S = np.diag([0.03**2] * 3 + [0.15**2] * 3)
    pulling = [
        replace(closure(a, b, between_true(drawn, a, b) @ aside @ se3_exp(rng.normal(0.0, 0.01, 6))), covariance=S)
        for a, b in near[:: len(near) // 6][:6]
    ]
    graph = at(drawn, LATER, *pulling)
    found, whole = solved(graph, first), solved(graph, replace(first, iterations=0))
    assert found.whole is first
    assert whole.whole is None
    (component,), (of_whole,), (before,) = found.components, whole.components, first.components
    assert not any(scale.is_applied for scale in of_whole.odometry_scales.values())
    moved_m, apart_m = (
        max(
            float(np.linalg.norm(component.T_map_keyframe[log][:700, :3, 3] - T[:700, :3, 3], axis=1).max())
            for log, T in other.T_map_keyframe.items()
        )
        for other in (before, of_whole)
    )
    assert moved_m > 0.05
    assert apart_m < 0.1 * moved_m


def test_a_robot_that_one_closure_alone_joins_stays_apart(drawn: GeneratedGraph) -> None:
    alone = Trajectory(drawn.graph.trajectories[R01].T_odom_keyframe[:100])
    lone = LoopClosure(KeyframeId(R00, WHOLE - 1), KeyframeId(LogId("r09"), 90), np.eye(4), metric=True)
    before, after = (at(drawn, keyframes, lone) for keyframes in (WHOLE, LATER))
    before, after = (replace(g, trajectories={**g.trajectories, LogId("r09"): alone}) for g in (before, after))
    first = solved(before)
    found = solved(after, first)
    assert found.whole is first
    assert [component.logs for component in found.components] == [component.logs for component in first.components]
    assert found.closures[-1].state is not ClosureState.USED


def test_a_new_robot_and_much_that_is_new_are_solved_whole(drawn: GeneratedGraph, first: GraphSolution) -> None:
    graph = at(drawn, LATER)
    more = {**graph.trajectories, LogId("r09"): Trajectory(np.eye(4)[None])}
    assert solved(replace(graph, trajectories=more), first).whole is None
    started = replace(first, closures=(), iterations=0)
    assert solved(replace(graph, closures=graph.closures[:20]), started).whole is None


def test_a_closure_that_counted_and_is_doubted_now_opens_the_map(drawn: GeneratedGraph, first: GraphSolution) -> None:
    graph = at(drawn, LATER)
    used = {(r.query, r.match) for r in first.closures if r.state is ClosureState.USED}
    n = next(n for n, c in enumerate(graph.closures) if (c.query, c.match) in used)
    closures = [replace(c, doubt="it may be a twin") if k == n else c for k, c in enumerate(graph.closures)]
    assert solved(graph, first).whole is first
    assert solved(PoseGraph(graph.trajectories, closures), first).whole is None
