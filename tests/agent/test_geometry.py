"""Conversions of many poses at a time are those of one."""

import numpy as np
import pytest

from flocc_agent.geometry import pose_from_tq, poses_from_tq, tq_from_pose, tq_from_poses


def rows(count: int) -> np.ndarray:
    """(count, 7) random poses; the first four are the half turns and the identity, where square roots vanish."""
    rng = np.random.default_rng(7)
    q_wxyz = rng.normal(size=(count, 4))
    q_wxyz[:4] = np.eye(4)
    q_wxyz /= np.linalg.norm(q_wxyz, axis=1, keepdims=True)
    return np.concatenate([rng.normal(size=(count, 3)), q_wxyz], axis=1)


def test_many_rows_become_the_poses_that_each_becomes() -> None:
    expected = [pose_from_tq(row) for row in rows(200)]
    np.testing.assert_allclose(poses_from_tq(rows(200)), expected, atol=1e-12)
    assert poses_from_tq(np.empty((0, 7))).shape == (0, 4, 4)


def test_many_poses_become_the_rows_that_each_becomes() -> None:
    poses = poses_from_tq(rows(200))
    np.testing.assert_allclose(tq_from_poses(poses), [tq_from_pose(T) for T in poses], atol=1e-12)
    assert tq_from_poses(np.empty((0, 4, 4))).shape == (0, 7)


def test_a_quaternion_without_direction_among_many_is_refused() -> None:
    broken = rows(5)
    broken[3, 3:] = 0.0
    with pytest.raises(ValueError, match="no direction"):
        poses_from_tq(broken)
