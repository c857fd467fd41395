"""Claim: every Jacobian is the numerical derivative, at random states, near pi and near zero translation."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.backend import rotations
from flocc_agent.backend.edges import GAMMA_MIN, Edges, Residuals, State, jacobians, residuals, scales_at, state_of
from flocc_agent.geometry import pose, quaternions, so3_exp, so3_log

Float = NDArray[np.float64]

STEP = 1e-6
CASES = ("random", "near pi", "near zero translation", "identity")


def edge(rng: np.random.Generator, case: str, sigma: float, cluster: int, scale: float = 1.0) -> tuple[Edges, State]:
    """One edge and a state: two poses and one cluster scale."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    R_error = {"near pi": so3_exp(axis * (np.pi - 1e-3)), "identity": np.eye(3)}.get(case, so3_exp(rng.normal(size=3)))
    t_hat = rng.normal(size=3) * (1e-7 if case == "near zero translation" else 2.0)
    R_hat = so3_exp(rng.normal(size=3))
    T_i = pose(so3_exp(rng.normal(size=3)), rng.normal(size=3) * 3)
    offset = rng.normal(size=3) * (1e-7 if case == "near zero translation" else 1.0)
    T_ij = pose(R_hat @ R_error, t_hat * 1.5 + offset)
    A = rng.normal(size=(6, 6))
    covariance = A @ A.T + np.eye(6)
    d = np.concatenate([np.zeros(3), R_hat.T @ t_hat])
    L = np.linalg.inv(np.linalg.cholesky(covariance))
    wide = np.linalg.inv(np.linalg.cholesky(covariance + sigma**2 * np.outer(d, d)))
    edges = Edges(
        np.array([0]), np.array([1]), quaternions(R_hat[None]), d[None], L[None], wide[None],
        np.array([sigma]), np.array([cluster]), np.array([False]),
    )  # fmt: skip
    state = state_of(np.array([T_i, T_i @ T_ij]))
    return edges, State(state.q, state.t, np.array([scale]))


def stacked(at: Residuals) -> Float:
    return np.append(at.e[0], at.bound[0])


def numerical(edges: Edges, state: State, n: int) -> Float:
    delta = np.zeros(13)
    delta[n] = STEP
    forward, backward = (stacked(residuals(edges, state.retract(sign * delta))) for sign in (1.0, -1.0))
    return np.asarray((forward - backward) / (2 * STEP))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(("sigma", "cluster"), [(0.0, -1), (0.7, -1), (0.3, 0), (0.0, 0)])
@pytest.mark.parametrize("seed", range(5))
def test_jacobians_are_the_numerical_derivatives(case: str, sigma: float, cluster: int, seed: int) -> None:
    edges, state = edge(np.random.default_rng(seed), case, sigma, cluster)
    at = residuals(edges, state)
    jac = jacobians(edges, at)
    analytic = np.hstack([jac.A_i[0], jac.A_j[0], jac.a_scale[0][:, None]])
    measured = np.stack([numerical(edges, state, n)[:6] for n in range(13)], axis=1)
    np.testing.assert_allclose(analytic, measured, atol=2e-7 * max(1.0, float(np.abs(measured).max())))


@pytest.mark.parametrize("seed", range(5))
def test_jacobians_of_a_scale_that_divides_the_poses_are_the_numerical_derivatives(seed: int) -> None:
    edges, state = edge(np.random.default_rng(seed), "random", 0.0, 0, scale=1.2)
    edges = replace(edges, divides=np.array([True]))
    jac = jacobians(edges, residuals(edges, state))
    analytic = np.hstack([jac.A_i[0], jac.A_j[0], jac.a_scale[0][:, None]])
    measured = np.stack([numerical(edges, state, n)[:6] for n in range(13)], axis=1)
    np.testing.assert_allclose(analytic, measured, atol=2e-7 * max(1.0, float(np.abs(measured).max())))


@pytest.mark.parametrize("turned_rad", [0.0, 0.3, 1.2, 0.5 * np.pi, 1.8, 2.8])
@pytest.mark.parametrize("length_m", [0.05, 1.0, 20.0])
def test_jacobians_of_a_direction_are_the_numerical_derivatives(turned_rad: float, length_m: float) -> None:
    edges, state = direction(turned_rad, length_m)
    at = residuals(edges, state)
    jac = jacobians(edges, at)
    analytic = np.hstack([jac.A_i[0], jac.A_j[0]])
    measured = np.stack([numerical(edges, state, n)[:6] for n in range(12)], axis=1)
    np.testing.assert_allclose(analytic, measured, atol=1e-6 * max(1.0, float(np.abs(measured).max())))


def direction(turned_rad: float, length_m: float) -> tuple[Edges, State]:
    """An edge of which the length is not known, and poses so far apart, so far off the measured direction."""
    rng = np.random.default_rng(2)
    edges, state = edge(rng, "random", 5.0, -1)
    d = edges.d[0, 3:]
    side = np.cross(d, rng.normal(size=3))
    q = so3_exp(turned_rad * side / np.linalg.norm(side)) @ d / np.linalg.norm(d) * length_m
    R_world_hat = rotations.matrices(state.q[:1])[0] @ rotations.matrices(edges.q_hat)[0]
    t = np.array([state.t[0], state.t[0] + R_world_hat @ q])
    return replace(edges, divides=np.array([True])), State(state.q, t, np.ones(1))


def test_the_error_of_a_direction_is_its_angle_however_far_and_grows_up_to_half_a_turn() -> None:
    def error(turned_rad: float, length_m: float) -> float:
        edges, state = direction(turned_rad, length_m)
        edges = replace(edges, sqrt_information=np.diag([0.0] * 3 + [1.0] * 3)[None], sigma=np.array([1e9]))
        return float(np.sqrt(residuals(edges, state).squared()[0]) / np.linalg.norm(edges.d))

    for turned_rad in (0.1, 1.0, 2.0, 3.0):
        chord = 2.0 * np.sin(0.5 * turned_rad)
        assert error(turned_rad, 100.0) == pytest.approx(chord, rel=1e-3)
        assert error(turned_rad, 1000.0) == pytest.approx(chord, rel=1e-3)
        assert error(turned_rad, 1e-3) < 2e-3, "poses that coincide have no direction"


def test_directions_of_poses_that_meet_leave_the_system_regular() -> None:
    """The length's prior kept its size there while its direction turned: slopes of 1e7, and no covariances at all."""
    for turned_rad in (0.0, 0.5, 2.0):
        for length_m in (1e-3, 1e-6, 1e-9):
            assert jacobians_of(turned_rad, length_m) < 10.0 * jacobians_of(turned_rad, 1.0)


def jacobians_of(turned_rad: float, length_m: float) -> float:
    """The steepest slope of a direction's residual."""
    edges, state = direction(turned_rad, length_m)
    return float(np.abs(jacobians(edges, residuals(edges, state)).A_j).max())


def test_a_held_scale_pulls_at_its_cluster_and_not_at_its_poses_scale() -> None:
    rng = np.random.default_rng(3)
    edges, state = edge(rng, "random", 0.3, 0, scale=0.5)
    flipped = State(state.q, state.t - 2 * np.array([[0.0] * 3, state.t[1] - state.t[0]]), state.scale)
    at = residuals(edges, flipped)
    assert at.held[0]
    assert scales_at(edges, flipped)[0] == GAMMA_MIN
    slope = np.array([numerical(edges, flipped, 12)])[0]
    np.testing.assert_allclose(slope, np.append(np.zeros(6), -1.0 / edges.sigma[0]), atol=1e-6)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-7, np.pi])
def test_batched_quaternions_agree_with_the_logarithm(angle_rad: float) -> None:
    axis = np.array([0.6, -0.64, 0.48])
    R = so3_exp(angle_rad * axis)
    q = quaternions(R[None])
    np.testing.assert_allclose(rotations.matrices(q)[0], R, atol=1e-12)
    assert rotations.angles_rad(q)[0] == pytest.approx(float(np.linalg.norm(so3_log(R))), abs=1e-7)
    np.testing.assert_allclose(rotations.matrices(rotations.exponential(angle_rad * axis[None]))[0], R, atol=1e-12)
