"""Sec. III-C of the paper, sentence by sentence: the base, independent and smoothed cost functions, and Eq. (6).

Letters as in the paper: alpha is the query, beta the match.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from flocc_agent.backend.clusters import cluster_labels
from flocc_agent.backend.edges import State, residuals, scales_at, state_of
from flocc_agent.backend.problem import Problem, build, closure_covariances
from flocc_agent.config import BackendConfig, Formulation, ScaleInitial
from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_agent.core.registration import closure_probability, odometry_scale
from flocc_agent.geometry import inverse, pose, se3_exp, se3_log, so3_exp
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

ALPHA, BETA = LogId("alpha"), LogId("beta")


def closure(i: int, j: int, T: Float, **fields: Any) -> LoopClosure:
    return replace(LoopClosure(KeyframeId(ALPHA, i), KeyframeId(BETA, j), T), **fields)


def straight(length: int = 40) -> Trajectory:
    return Trajectory(np.array([pose(np.eye(3), np.array([float(k), 0.0, 0.0])) for k in range(length)]))


def problem(closures: list[LoopClosure], **config: Any) -> Problem:
    trajectories = {ALPHA: straight(), BETA: straight()}
    settings = BackendConfig(**config)
    return build(trajectories, dict(enumerate(closures)), settings)


def test_the_probability_multiplies_the_information_matrix() -> None:
    sure, unsure = (closure(1, 1, np.eye(4), metric=True, match_ratio=r) for r in (1.6, 0.4))
    config = BackendConfig()
    informations = np.linalg.inv(closure_covariances([sure, unsure], np.ones(2), config))
    ratio = closure_probability(1.6, config.steepness) / closure_probability(0.4, config.steepness)
    np.testing.assert_allclose(informations[0], ratio * informations[1])


def test_the_residual_agrees_with_the_logarithm_to_third_order() -> None:
    rng = np.random.default_rng(0)
    T_bar = pose(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    one = problem([closure(3, 5, T_bar, metric=True, covariance=np.eye(6))], weight_by_probability=False)
    xi = 0.01 * rng.normal(size=6)
    T = np.concatenate([straight().T_odom_keyframe, straight().T_odom_keyframe])
    T[40 + 5] = T[3] @ T_bar @ se3_exp(xi)
    e = residuals(one.edges, state_of(T)).e[one.closure_rows][0]
    logarithm = se3_log(inverse(T_bar) @ inverse(T[3]) @ T[45])
    np.testing.assert_allclose(e[:3], logarithm[:3], atol=float(np.linalg.norm(xi[:3])) ** 3)
    np.testing.assert_allclose(e[3:], logarithm[3:], atol=float(np.linalg.norm(xi[:3]) * np.linalg.norm(xi[3:])))


def test_the_scaled_pose_keeps_the_rotation_and_scales_the_translation() -> None:
    t_bar = np.array([0.6, 0.0, 0.8])
    one = problem([closure(3, 5, pose(np.eye(3), t_bar))], formulation=Formulation.INDEPENDENT)
    T = np.concatenate([straight().T_odom_keyframe, straight().T_odom_keyframe])
    for s in (0.5, 1.0, 7.0):
        T[45] = T[3] @ pose(np.eye(3), s * t_bar)
        state = state_of(T)
        assert residuals(one.edges, state).squared()[one.closure_rows][0] < 1.0
        assert scales_at(one.edges, state)[one.closure_rows][0] == pytest.approx(s, abs=0.01)


def test_an_independent_scale_is_a_between_factor_whose_covariance_grows_along_the_direction() -> None:
    """Eliminating `s ~ N(1, sigma^2)` is exact: the widened residual is the least over all scales."""
    rng = np.random.default_rng(1)
    covariance = np.diag(rng.uniform(0.01, 0.1, 6))
    T = pose(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    measured = closure(3, 5, T, covariance=covariance, scale_initial=1.0)
    one = problem([measured], formulation=Formulation.INDEPENDENT, weight_by_probability=False)
    state = state_of(np.concatenate([straight().T_odom_keyframe, straight().T_odom_keyframe]))
    row, sigma = one.closure_rows.start, float(one.edges.sigma[one.closure_rows.start])
    edges = one.edges
    fixed = replace(edges, sqrt_information_wide=edges.sqrt_information, sigma=np.zeros(len(edges)))
    zero = np.where(np.arange(len(edges)) == row, 0, edges.cluster)

    def cost(s: float) -> float:
        at = residuals(replace(fixed, cluster=zero), State(state.q, state.t, np.array([s])))
        return float(at.squared()[row] + ((s - 1.0) / sigma) ** 2)

    best = float(minimize_scalar(cost, bracket=(-1.0, 1.0)).fun)
    assert residuals(edges, state, hold=False).squared()[row] == pytest.approx(best, rel=1e-5)


def test_closures_fewer_than_ten_keyframes_apart_on_both_sides_are_one_cluster() -> None:
    at = [(0, 0), (9, 9), (0, 10), (30, 30), (39, 21), (30, 20)]
    labels = cluster_labels([closure(i, j, np.eye(4)) for i, j in at], keyframes_max=10)
    assert labels.tolist() == [0, 0, 0, 1, 1, 2] or labels.tolist() == [0, 0, 0, 1, 1, 1]
    far = cluster_labels([closure(i, j, np.eye(4)) for i, j in [(0, 0), (10, 0), (0, 10)]], keyframes_max=10)
    assert far.tolist() == [0, 1, 2]


def test_smoothed_scales_of_a_cluster_pull_at_one_another() -> None:
    """A closure that has no say about its scale (its covariance is huge) takes its neighbour's."""
    t = np.array([0.0, 1.0, 0.0])
    vague = closure(4, 4, pose(np.eye(3), t), scale_initial=1.0, covariance=1e6 * np.eye(6))
    clear = closure(3, 3, pose(np.eye(3), t), scale_initial=1.0, covariance=1e-4 * np.eye(6))
    pair = problem([clear, vague], formulation=Formulation.SMOOTHED, weight_by_probability=False)
    T = np.concatenate([straight().T_odom_keyframe, straight().T_odom_keyframe])
    T[40:, 1, 3] = 2.0
    scales = scales_at(pair.edges, State(state_of(T).q, state_of(T).t, np.array([2.0])))[pair.closure_rows]
    np.testing.assert_allclose(scales, [2.0, 2.0], atol=1e-3)
    assert pair.clusters == 1


def test_shared_formulation_has_one_scale_for_all() -> None:
    closures = [closure(k, k, pose(np.eye(3), np.array([0.0, 1.0, 0.0]))) for k in (0, 20, 39)]
    assert problem(closures, formulation=Formulation.SHARED).clusters == 1
    assert problem(closures, formulation=Formulation.INDEPENDENT).clusters == 0
    assert problem(closures, formulation=Formulation.BASE).clusters == 0


def test_equation_6_starts_a_scale_at_the_ratio_of_the_odometry_pair() -> None:
    s = odometry_scale(np.array([0.0, 0.0, 1.2]), np.array([0.0, 0.3, 0.0]))
    assert s == pytest.approx(4.0)
    started = closure(1, 1, pose(np.eye(3), np.array([1.0, 0.0, 0.0])), scale_initial=s)
    assert problem([started]).scale_initial.tolist() == [4.0]
    assert problem([started], scale_initial=ScaleInitial.RAW).scale_initial.tolist() == [1.0]
