"""Claims about whole solutions: what is right is found, what is wrong is named, and what cannot be solved stands."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.backend.consistency import inconsistent
from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import (
    ClosureState,
    GraphSolution,
    LoopClosure,
    MeasuredFactor,
    OptimisationFailed,
    PoseGraph,
    Trajectory,
    landmark,
)
from flocc_agent.geometry import between, inverse, pose, se3_exp, so3_exp
from flocc_lab.bench.generated_graph import GeneratedGraph, Noise, generate
from flocc_launch.graph_files.graph_file import ate_m
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

A, B, C = LogId("a"), LogId("b"), LogId("c")
PLAIN: dict[str, Any] = {"weight_by_probability": False}


def solved(
    graph: PoseGraph, config: BackendConfig, initial: GraphSolution | None = None, **wanted: Any
) -> GraphSolution:
    solution = optimise(graph, config, initial, **wanted)
    assert isinstance(solution, GraphSolution)
    return solution


def error_m(generated: GeneratedGraph, solution: GraphSolution) -> float:
    estimate = {log: T[:, :3, 3] for c in solution.components for log, T in c.T_map_keyframe.items()}
    ate = ate_m(estimate, generated.truth_m())
    assert ate is not None
    return ate


def circle(log_start: float, n: int = 30) -> Float:
    angles = log_start + 0.2 * np.arange(n)
    return np.array([pose(so3_exp(np.array([0.0, 0.0, a])), 5 * np.array([np.cos(a), np.sin(a), 0.0])) for a in angles])


WORLD = {A: circle(0.0), B: circle(1.0), C: circle(2.0)}
ODOMETRY = {log: Trajectory(np.array([between(T[0], T_k) for T_k in T])) for log, T in WORLD.items()}


def closure(a: LogId, i: int, b: LogId, j: int, metric: bool = False, **fields: Any) -> LoopClosure:
    T = between(WORLD[a][i], WORLD[b][j])
    if not metric:
        T[:3, 3] /= np.linalg.norm(T[:3, 3])
    return replace(LoopClosure(KeyframeId(a, i), KeyframeId(b, j), T, metric=metric), **fields)


def pair_closures(a: LogId = A, b: LogId = B) -> list[LoopClosure]:
    return [closure(a, k, b, (k * 7) % 30) for k in range(0, 30, 3)]


@pytest.mark.parametrize("solver", list(Solver))
@pytest.mark.parametrize("formulation", [Formulation.INDEPENDENT, Formulation.SMOOTHED])
def test_perfect_measurements_give_the_truth_in_the_anchors_frame(formulation: Formulation, solver: Solver) -> None:
    solution = solved(
        PoseGraph(ODOMETRY, [*pair_closures(), *pair_closures(B, C)]),
        BackendConfig(formulation=formulation, solver=solver),
    )
    (component,) = solution.components
    assert component.map_frame == "map/a"
    for log in (A, B, C):
        expected = between(WORLD[A][0], WORLD[log][0])
        np.testing.assert_allclose(component.T_map_keyframe[log], inverse(WORLD[A][0]) @ WORLD[log], atol=0.06)
        np.testing.assert_allclose(component.T_map_odom[log], expected, atol=0.06)
    assert all(result.state is ClosureState.USED for result in solution.closures)


def test_recovered_scales_are_the_true_lengths() -> None:
    closures = pair_closures()
    solution = solved(PoseGraph(ODOMETRY, closures), BackendConfig())
    for c, result in zip(closures, solution.closures, strict=True):
        length_m = float(np.linalg.norm(between(WORLD[A][c.query.index], WORLD[B][c.match.index])[:3, 3]))
        assert result.scale == pytest.approx(length_m, rel=0.02)


def test_the_anchor_starts_at_its_own_odometry_pose() -> None:
    moved = {**ODOMETRY, A: Trajectory(se3_exp(np.array([0.1, 0.2, 0.3, 4.0, 5.0, 6.0])) @ ODOMETRY[A].T_odom_keyframe)}
    (component,) = solved(PoseGraph({log: moved[log] for log in (A, B)}, pair_closures()), BackendConfig()).components
    np.testing.assert_allclose(component.T_map_keyframe[A][0], moved[A].T_odom_keyframe[0], atol=1e-12)
    np.testing.assert_allclose(component.T_map_odom[A], np.eye(4), atol=0.01)


def test_disconnected_logs_are_components_of_their_own_and_keep_odometry() -> None:
    solution = solved(PoseGraph(ODOMETRY, pair_closures()), BackendConfig())
    assert [component.logs for component in solution.components] == [(A, B), (C,)]
    np.testing.assert_array_equal(solution.components[1].T_map_keyframe[C], ODOMETRY[C].T_odom_keyframe)


@pytest.mark.parametrize("ratio", [0.1, 0.5])
def test_the_default_stays_within_twice_the_outlier_free_error(ratio: float) -> None:
    config = BackendConfig(covariances=False, **PLAIN)
    for seed in (1, 3):
        clean = generate(np.random.default_rng(seed), 3, 150, 300)
        dirty = generate(np.random.default_rng(seed), 3, 150, 300, outlier_ratio=ratio)
        limit_m = 2.0 * error_m(clean, solved(clean.graph, config))
        assert error_m(dirty, solved(dirty.graph, config)) <= limit_m, f"seed {seed}"


def test_an_outlier_is_rejected_or_held_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = replace(
        closure(A, 4, B, 4), T_query_match_unscaled=pose(so3_exp(np.array([0.0, 0.0, 2.0])), np.array([0.0, 0.0, 1.0]))
    )
    graph = PoseGraph(ODOMETRY, [*pair_closures(), wrong])
    held = solved(graph, BackendConfig())
    assert [r.state for r in held.closures] == [ClosureState.USED] * 10 + [ClosureState.EXCLUDED]
    assert held.closures[-1].reason.startswith(f"closure {wrong.query} - {wrong.match}: held until another one agrees")
    monkeypatch.setattr("flocc_agent.backend.optimiser.held_closures", lambda *_: {})
    solution = solved(graph, BackendConfig())
    assert [r.state for r in solution.closures] == [ClosureState.USED] * 10 + [ClosureState.REJECTED]
    assert solution.closures[-1].weight == 0.0


def test_a_round_that_adds_closures_takes_fewer_solves_and_ends_at_the_same_place() -> None:
    generated = generate(np.random.default_rng(4), 3, 120, 150)
    config = BackendConfig(covariances=False, **PLAIN)
    before = solved(replace(generated.graph, closures=generated.graph.closures[:-10]), config)
    full = solved(generated.graph, config)
    warm = solved(generated.graph, config, before)
    assert warm.iterations < full.iterations
    assert error_m(generated, warm) == pytest.approx(error_m(generated, full), abs=0.05)


def test_marginal_covariances_are_gtsams() -> None:
    closures = [closure(A, k, B, k, metric=True, covariance=0.01 * np.eye(6)) for k in range(0, 30, 5)]
    config = BackendConfig(formulation=Formulation.BASE, solver=Solver.LM, **PLAIN)
    graph = PoseGraph({log: ODOMETRY[log] for log in (A, B)}, closures)
    solution = solved(graph, config, covariance_of=[KeyframeId(B, 7)])
    (component,) = solution.components
    reference = gtsam_marginal(component.T_map_keyframe, closures, config, ord("b") + 7 * 1000)
    np.testing.assert_allclose(component.covariance_keyframe[KeyframeId(B, 7)], reference, rtol=1e-3, atol=1e-9)
    assert component.covariance_map_odom[A] is not None


def gtsam_marginal(T: Any, closures: Sequence[LoopClosure], config: BackendConfig, key: int) -> Float:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    sigmas = [config.odometry_rotation_sigma_rad] * 3 + [config.odometry_translation_sigma_m] * 3
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas))
    for log in (A, B):
        for k in range(30):
            values.insert(ord(str(log)) + k * 1000, gtsam.Pose3(T[log][k]))
        for k in range(29):
            step = gtsam.Pose3(between(T[log][k], T[log][k + 1]))
            graph.add(gtsam.BetweenFactorPose3(ord(str(log)) + k * 1000, ord(str(log)) + (k + 1) * 1000, step, noise))
    for c in closures:
        i, j = (ord(str(side.log)) + side.index * 1000 for side in (c.query, c.match))
        loop = gtsam.Pose3(between(T[c.query.log][c.query.index], T[c.match.log][c.match.index]))
        graph.add(gtsam.BetweenFactorPose3(i, j, loop, gtsam.noiseModel.Gaussian.Covariance(np.asarray(c.covariance))))
    graph.add(gtsam.PriorFactorPose3(ord("a"), gtsam.Pose3(T[A][0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-7)))
    return np.asarray(gtsam.Marginals(graph, values).marginalCovariance(key))


def test_fixes_of_a_world_frame_take_drift_away() -> None:
    rng = np.random.default_rng(8)
    generated = generate(rng, 1, 300, 0, noise=Noise(odometry=(0.01, 0.02)))
    (log,) = generated.graph.trajectories
    T = generated.T_world_keyframe[log]
    at = [KeyframeId(log, k) for k in range(4, 300, 5)]
    fixes = [
        MeasuredFactor("fix", k, landmark("world"), k, pose(np.eye(3), T[k.index][:3, 3]), 0.01 * np.eye(3)) for k in at
    ]
    without, with_fixes = (solved(replace(generated.graph, measured=f), BackendConfig()) for f in ((), fixes))
    assert error_m(generated, with_fixes) < 0.5 * error_m(generated, without)
    (component,) = with_fixes.components
    assert component.T_map_world is not None
    moved = component.T_map_world @ np.append(T[50][:3, 3], 1.0)
    np.testing.assert_allclose(moved[:3], component.T_map_keyframe[log][50][:3, 3], atol=0.5)


def test_intra_robot_closures_take_drift_away() -> None:
    drifted = Trajectory(
        np.array(
            [T @ pose(np.eye(3), np.array([0.0, 0.0, 0.05 * k])) for k, T in enumerate(ODOMETRY[A].T_odom_keyframe)]
        )
    )
    loops = [closure(A, k, A, k + 20, metric=True) for k in range(0, 10, 2)]
    (component,) = solved(PoseGraph({A: drifted}, loops), BackendConfig(solver=Solver.LM)).components
    gap = component.T_map_keyframe[A][25][2, 3] - component.T_map_keyframe[A][5][2, 3]
    assert abs(gap) < 0.3 * abs(drifted.T_odom_keyframe[25][2, 3] - drifted.T_odom_keyframe[5][2, 3])


BAD_CLOSURES = {
    "not finite": lambda c: replace(c, T_query_match_unscaled=np.full((4, 4), np.nan)),
    "not a rigid pose": lambda c: replace(c, T_query_match_unscaled=c.T_query_match_unscaled * 2.0),
    "not positive definite": lambda c: replace(c, covariance=-np.eye(6)),
    "no direction to scale": lambda c: replace(
        c, T_query_match_unscaled=pose(c.T_query_match_unscaled[:3, :3], np.zeros(3))
    ),
    "is not there": lambda c: replace(c, match=KeyframeId(B, 4711)),
    "has no odometry": lambda c: replace(c, match=KeyframeId(LogId("nobody"), 0)),
    "with itself": lambda c: replace(c, match=c.query),
    "is not a ratio": lambda c: replace(c, match_ratio=float("nan")),
    "is not positive": lambda c: replace(c, scale_initial=0.0),
}


@pytest.mark.parametrize("complaint", BAD_CLOSURES)
def test_a_bad_closure_is_excluded_with_its_name_and_reason(complaint: str) -> None:
    bad = BAD_CLOSURES[complaint](closure(A, 2, B, 9))
    solution = solved(PoseGraph({log: ODOMETRY[log] for log in (A, B)}, [*pair_closures(), bad]), BackendConfig())
    result = solution.closures[-1]
    assert result.state is ClosureState.EXCLUDED
    assert complaint in result.reason
    assert str(bad.query) in result.reason
    assert result.reason in solution.warnings
    assert np.isfinite(solution.components[0].T_map_keyframe[B]).all()


def test_of_duplicates_the_best_is_kept() -> None:
    good, again = closure(A, 1, B, 2, match_ratio=0.9), closure(A, 1, B, 2, match_ratio=0.5)
    other = replace(
        closure(B, 2, A, 1, match_ratio=0.4), T_query_match_unscaled=pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    )
    solution = solved(PoseGraph(ODOMETRY, [*pair_closures(), again, good, other]), BackendConfig())
    kept, repeats, contradicts = solution.closures[-2], solution.closures[-3], solution.closures[-1]
    assert kept.state is ClosureState.USED
    assert "repeats" in repeats.reason
    assert "contradicts" in contradicts.reason


@pytest.mark.parametrize("broken", [np.full((5, 4, 4), np.nan), np.zeros((0, 4, 4)), np.zeros((5, 4, 4))])
def test_a_robot_with_broken_odometry_is_left_out_by_name(broken: Float) -> None:
    solution = solved(
        PoseGraph({**ODOMETRY, C: Trajectory(broken)}, [*pair_closures(), closure(A, 1, C, 1)]), BackendConfig()
    )
    assert [component.logs for component in solution.components] == [(A, B)]
    assert any("robot c" in warning for warning in solution.warnings)


def test_no_odometry_at_all_is_a_failure_and_not_an_exception() -> None:
    assert isinstance(optimise(PoseGraph({}, ()), BackendConfig()), OptimisationFailed)


def test_a_bad_odometry_covariance_is_replaced_and_named() -> None:
    covariances = np.tile(np.eye(6) * 0.01, (29, 1, 1))
    covariances[3] = 0.0
    graph = PoseGraph({A: replace(ODOMETRY[A], edge_covariances=covariances), B: ODOMETRY[B]}, pair_closures())
    assert any("edge 3" in warning for warning in solved(graph, BackendConfig()).warnings)


def test_a_scale_that_nothing_fixes_is_named() -> None:
    single = [closure(A, 5, B, 5)]
    solution = solved(PoseGraph({log: ODOMETRY[log] for log in (A, B)}, single), BackendConfig(closures_to_join_min=1))
    assert any("not observable" in warning and "a/5 - b/5" in warning for warning in solution.warnings)
    assert np.isfinite(solution.components[0].T_map_keyframe[B]).all()


def test_a_collapsed_scale_is_named() -> None:
    closures = pair_closures()
    backwards = closure(A, 5, B, 5, match_ratio=0.2)
    T = np.array(backwards.T_query_match_unscaled)
    T[:3, 3] *= -1
    solution = solved(
        PoseGraph({log: ODOMETRY[log] for log in (A, B)}, [*closures, replace(backwards, T_query_match_unscaled=T)]),
        BackendConfig(solver=Solver.LM),
    )
    assert any("collapsed" in warning and "a/5 - b/5" in warning for warning in solution.warnings)
    assert all(result.scale is None or result.scale > 0 for result in solution.closures)


def test_the_same_graph_gives_the_same_solution() -> None:
    generated = generate(np.random.default_rng(4), 3, 60, 80, outlier_ratio=0.3)
    first, second = (solved(generated.graph, BackendConfig()) for _ in range(2))
    for a, b in zip(first.components, second.components, strict=True):
        for log in a.logs:
            np.testing.assert_array_equal(a.T_map_keyframe[log], b.T_map_keyframe[log])


def test_pairwise_consistency_clears_the_way_for_least_squares() -> None:
    dirty = generate(np.random.default_rng(1), 3, 120, 150, outlier_ratio=0.5)
    config = BackendConfig(solver=Solver.LM, pairwise_consistency=True, covariances=False, **PLAIN)
    states = [result.state for result in solved(dirty.graph, config).closures]
    wrong = [state for state, right in zip(states, dirty.is_right, strict=True) if not right]
    assert wrong.count(ClosureState.REJECTED) >= 0.95 * len(wrong)
    assert [s for s, right in zip(states, dirty.is_right, strict=True) if right].count(ClosureState.REJECTED) <= 3


def test_pairwise_consistency_judges_closures_within_a_robot() -> None:
    log, lap, turns_rad = LogId("r00"), 20, np.arange(60) * 2.0 * np.pi / 20
    T = np.array(
        [pose(so3_exp(np.array([0.0, 0.0, a])), 5.0 * np.array([np.cos(a), np.sin(a), 0.1])) for a in turns_rad]
    )
    ends = [(k, k + lap) if k % 2 else (k + lap, k) for k in range(lap)]
    right = {
        n: LoopClosure(KeyframeId(log, i), KeyframeId(log, j), between(T[i], T[j]), metric=True)
        for n, (i, j) in enumerate(ends)
    }
    away = pose(np.eye(3), np.array([0.0, 4.0, 0.0]))
    wrong = {n: replace(right[n], T_query_match_unscaled=away @ right[n].T_query_match_unscaled) for n in (3, 8, 15)}
    assert set(inconsistent({log: Trajectory(T)}, {**right, **wrong}, BackendConfig())) == set(wrong)
