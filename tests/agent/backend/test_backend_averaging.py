"""The start at averaged rotations: exact where nothing is noisy, whatever the odometry said."""

import numpy as np
import pytest

from flocc_agent.backend.averaging import averaged, nearest_rotations
from flocc_agent.backend.edges import state_of
from flocc_agent.backend.problem import plain_edges
from flocc_agent.geometry import inverse, pose, so3_exp


@pytest.mark.parametrize("fixed", [0, 7])
def test_exact_measurements_give_exact_poses_from_any_start(fixed: int) -> None:
    rng = np.random.default_rng(3)
    T = np.array([pose(so3_exp(rng.normal(size=3)), 5.0 * rng.normal(size=3)) for _ in range(20)])
    i, j = np.concatenate([np.arange(19), rng.integers(0, 20, 15)]), np.concatenate([np.arange(1, 20), np.arange(15)])
    kept = i != j
    i, j = i[kept], j[kept]
    edges = plain_edges(i, j, inverse(T[i]) @ T[j], np.tile(np.eye(6), (len(i), 1, 1)))
    start = T.copy()
    start[np.arange(20) != fixed] = np.eye(4)
    found = averaged(edges, state_of(start), fixed)
    assert found is not None
    np.testing.assert_allclose(found.poses(), T, atol=1e-9)


def test_poses_that_nothing_joins_have_no_averaged_start() -> None:
    ends = np.array([0]), np.array([1])
    edges = plain_edges(*ends, np.eye(4)[None], np.eye(6)[None])
    assert averaged(edges, state_of(np.tile(np.eye(4), (4, 1, 1))), 0) is None


def test_the_nearest_rotation_of_a_reflection_is_a_rotation() -> None:
    rng = np.random.default_rng(1)
    X = np.array([so3_exp(rng.normal(size=3)) + 0.3 * rng.normal(size=(3, 3)) for _ in range(50)])
    X[::5] = X[::5] @ np.diag([1.0, 1.0, -0.8])
    R = nearest_rotations(X)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (50, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-9)
    tried = np.array([[R_k @ so3_exp(1e-3 * rng.normal(size=3)) for _ in range(20)] for R_k in R])
    best = np.linalg.norm(R - X, axis=(1, 2))
    assert np.all(np.linalg.norm(tried - X[:, None], axis=(2, 3)) >= best[:, None] - 1e-12)
