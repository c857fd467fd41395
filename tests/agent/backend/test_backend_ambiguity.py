"""What data cannot decide is said: two places with as many votes. Half turns, where a cost has no slope, are left."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import adjoint, inverse, pose, so3_exp, so3_log
from flocc_lab.graph_family.family_spec import drawn
from flocc_lab.graph_family.graphs import made
from flocc_lab.graph_family.methods import settings
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
A, B, C = LogId("a"), LogId("b"), LogId("c")
KEYFRAMES = 9
COVARIANCE = np.diag([1e-3] * 3 + [1e-2] * 3)


def turned(yaw_rad: float, x_m: float = 0.0, y_m: float = 0.0) -> Float:
    return pose(so3_exp(np.array([0.0, 0.0, yaw_rad])), np.array([x_m, y_m, 0.0]))


def bend() -> Float:
    """A way (9, 4, 4) that bends more and more, so that no motion maps it onto itself."""
    T = [np.eye(4)]
    for k in range(KEYFRAMES - 1):
        T.append(T[-1] @ turned(0.05, 1.0, 0.1 * k))
    return np.array(T)


WAY = bend()


def saying(T_a_b: Float, pairs: list[tuple[int, int]], a: LogId = A, b: LogId = B) -> list[LoopClosure]:
    """Metric closures that agree that robot b's way begins at a pose in robot a's."""
    return [
        LoopClosure(
            KeyframeId(a, i), KeyframeId(b, j), inverse(WAY[i]) @ T_a_b @ WAY[j], covariance=COVARIANCE, metric=True
        )
        for i, j in pairs
    ]


def solved(closures: list[LoopClosure]) -> GraphSolution:
    edges = np.broadcast_to(COVARIANCE, (KEYFRAMES - 1, 6, 6)).copy()
    logs = sorted({end.log for closure in closures for end in (closure.query, closure.match)})
    graph = PoseGraph({log: Trajectory(WAY, edges) for log in logs}, closures)
    solution = optimise(graph, BackendConfig())
    assert isinstance(solution, GraphSolution)
    return solution


IN_FRONT = saying(turned(0.0, 5.0), [(k, k + 1) for k in range(4)])
BEHIND = saying(turned(np.pi, -5.0), [(k + 1, k) for k in range(4)])
SCATTERED = [
    c for k in range(3) for c in saying(turned(1.0 + k, 3.0 * k, -7.0 + 9.0 * k), [(2 * k + 1, (5 * k + 2) % 8)])
]


@pytest.mark.parametrize("closures", [IN_FRONT + BEHIND, BEHIND + IN_FRONT])
def test_two_places_with_as_many_closures_are_named(closures: list[LoopClosure]) -> None:
    (sentence,) = [w for w in solved(closures).warnings if "look the same" in w]
    assert sentence.startswith("robots a and b: 4 closures agree on the place that was taken, and 4 others on another")
    assert "180 degrees away" in sentence
    assert "jumps" not in sentence  # keyframes of both places lie between each other


@pytest.mark.parametrize("robot", ["a", "b"])
def test_a_jump_of_odometry_is_named_where_keyframes_before_and_after_it_say_two_places(robot: str) -> None:
    before, after = [(k, k + 1) for k in range(4)], [(k + 5, k) for k in range(4)]
    if robot == "b":
        before, after = [(j, i) for i, j in before], [(j, i) for i, j in after]
    closures = saying(turned(0.0, 5.0), before) + saying(turned(0.1, 35.0), after)
    (sentence,) = [w for w in solved(closures).warnings if "look the same" in w]
    assert f"and so does odometry of robot {robot} that jumps between 3 and 5, and nothing here tells" in sentence


def test_one_closure_more_on_one_side_is_a_tie_too_and_nothing_is_held_for_it() -> None:
    solution = solved(saying(turned(0.0, 5.0), [(k, k + 1) for k in range(5)]) + BEHIND)
    assert [w for w in solution.warnings if "held until" in w] == []
    (sentence,) = [w for w in solution.warnings if "look the same" in w]
    assert sentence.startswith("robots a and b: 5 closures agree on the place that was taken, and 4 others on another")


@pytest.mark.parametrize("last_first", [False, True])
def test_a_robot_that_two_others_put_in_two_places_is_named(last_first: bool) -> None:
    pairs = [(2 * k, 2 * k + 1) for k in range(4)]
    by_a = saying(turned(0.3, 5.0, 30.0), pairs, A, C)
    by_b = saying(turned(-0.9, 20.0, -40.0), pairs, B, C)
    both = by_b + by_a if last_first else by_a + by_b
    firm = saying(turned(0.0, 5.0), [(k, k) for k in range(KEYFRAMES)])
    (sentence,) = [w for w in solved(firm + both).warnings if "look the same" in w]
    said = r"robot c: 4 closures with [ab] agree on the place that was taken, and 4 others with [ab] on another"
    assert re.match(said, sentence)
    assert "jumps" not in sentence


@pytest.mark.parametrize("closures", [IN_FRONT, IN_FRONT + BEHIND[:1], IN_FRONT + SCATTERED])
def test_closures_that_agree_on_no_other_place_are_no_tie(closures: list[LoopClosure]) -> None:
    assert [w for w in solved(closures).warnings if "look the same" in w] == []


@pytest.mark.parametrize("seed", [3032, 3037, 3040])
def test_closures_that_are_only_inexact_and_few_that_agree_by_chance_are_no_tie(seed: int) -> None:
    """Drawn graphs: the rejected agree half a metre away, and eight of hundreds agree somewhere."""
    solution = optimise(made(drawn(seed)).graph, settings())
    assert isinstance(solution, GraphSolution)
    assert any(result.state is ClosureState.REJECTED for result in solution.closures)
    assert [w for w in solution.warnings if "look the same" in w] == []


@pytest.mark.parametrize("drift_deg", [170.0, 179.9, 180.0, -180.0, 180.0 - 1e-7])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_heading_that_is_off_by_half_a_turn_is_shared_by_all_steps(drift_deg: float, backwards: bool) -> None:
    """By hand: 25 equal edges on the spot, each takes a 25th of the error."""
    steps = 24
    T_odom = np.array([turned(k * np.radians(drift_deg) / steps) for k in range(steps + 1)])
    covariance = np.diag([1.0] * 3 + [1e-6] * 3)
    ends = KeyframeId(A, 0), KeyframeId(A, steps)
    query, match = reversed(ends) if backwards else ends
    closure = LoopClosure(query, match, np.eye(4), covariance=covariance, metric=True)
    graph = PoseGraph({A: Trajectory(T_odom, np.broadcast_to(covariance, (steps, 6, 6)).copy())}, [closure])
    solution = optimise(
        graph, BackendConfig(formulation=Formulation.BASE, solver=Solver.LM, weight_by_probability=False)
    )
    assert isinstance(solution, GraphSolution)
    last = solution.components[0].T_map_keyframe[A][-1]
    assert abs(so3_log(last[:3, :3])[2]) == pytest.approx(np.radians(abs(drift_deg)) / 25, rel=0.01)


def test_coordinates_in_utm_lose_nothing() -> None:
    """Odometry whose origin is far away: shapes are those without the offset, to a tenth of a millimetre."""
    edges = np.broadcast_to(COVARIANCE, (KEYFRAMES - 1, 6, 6)).copy()
    far = {A: turned(0.3, 4.5e5, 5.4e6), B: turned(-1.0, 4.51e5, 5.39e6)}
    wrong_m = saying(turned(0.1, 5.3), [(7, 1)])
    shapes = []
    for offsets in ({A: np.eye(4), B: np.eye(4)}, far):
        trajectories = {log: Trajectory(offsets[log] @ WAY, edges) for log in (A, B)}
        solution = optimise(PoseGraph(trajectories, IN_FRONT + wrong_m), BackendConfig())
        assert isinstance(solution, GraphSolution)
        (component,) = solution.components
        first = component.T_map_keyframe[A][0]
        shapes.append(inverse(first) @ np.concatenate([component.T_map_keyframe[log] for log in (A, B)]))
    assert np.abs(shapes[0] - shapes[1]).max() < 1e-4


@pytest.mark.parametrize("seed", [66_000_002, 66_000_008])
def test_drawn_graphs_are_solved_alike_in_utm(seed: int) -> None:
    """Maps, closures and covariances are those without the offset: a frame's origin is nothing that is measured."""
    graph = made(drawn(seed)).graph
    moves = {log: turned(0.0, 6.9e5 + 100.0 * k, 5.3e6) for k, log in enumerate(sorted(graph.trajectories))}
    far = replace(
        graph,
        trajectories={
            log: replace(each, T_odom_keyframe=moves[log] @ each.T_odom_keyframe)
            for log, each in graph.trajectories.items()
        },
    )
    asked = [KeyframeId(log, len(each.T_odom_keyframe) - 1) for log, each in sorted(graph.trajectories.items())]
    one, other = (optimise(each, BackendConfig(), covariance_of=asked) for each in (graph, far))
    assert isinstance(one, GraphSolution)
    assert isinstance(other, GraphSolution)
    again = optimise(far, BackendConfig(), other)
    assert isinstance(again, GraphSolution)
    assert [each.state for each in one.closures] == [each.state for each in other.closures]
    assert [each.logs for each in one.components] == [each.logs for each in other.components]
    for near, away, warm in zip(one.components, other.components, again.components, strict=True):
        for log in near.logs:
            T = moves[near.anchor] @ near.T_map_keyframe[log]
            assert np.abs(away.T_map_keyframe[log] - T).max() < 1e-3
            assert np.linalg.norm(warm.T_map_keyframe[log][-1] - T[-1]) < 0.05
            back = away.T_map_odom[log] @ far.trajectories[log].T_odom_keyframe[-1]
            assert np.abs(back - away.T_map_keyframe[log][-1]).max() < 1e-3
            covariance = near.covariance_map_odom[log]
            if covariance is not None:
                J = adjoint(moves[log])
                assert away.covariance_map_odom[log] == pytest.approx(J @ covariance @ J.T, rel=1e-3, abs=1e-6)
        for keyframe, covariance in near.covariance_keyframe.items():
            assert away.covariance_keyframe[keyframe] == pytest.approx(covariance, rel=1e-3, abs=1e-9)
