"""Covariances of whole ways, as ROS has them, taken apart into those of the steps that they were made of."""

import numpy as np
import pytest

from flocc_agent.geometry import Float, hat, pose, so3_exp
from flocc_agent.runtime.ros2.odometry_covariance import StepCovariances, step_covariance


def moved(rng: np.random.Generator, scale: float = 1.0) -> Float:
    """A drawn step."""
    return pose(so3_exp(scale * rng.normal(size=3) * 0.3), scale * rng.normal(size=3))


def drawn(rng: np.random.Generator) -> Float:
    """A drawn covariance, rotation first, in the tangent of a step's end."""
    root = rng.normal(size=(6, 6))
    return np.asarray(1e-4 * (root @ root.T + np.eye(6)))


def composed(T_before: Float, way: Float, T_after: Float, step: Float) -> Float:
    """Covariance of the longer way, by moving both errors to its end: translation first, about the axes of odom."""
    R, r = T_after[:3, :3], T_after[:3, 3] - T_before[:3, 3]
    of_way = np.block([[np.eye(3), -hat(r)], [np.zeros((3, 3)), np.eye(3)]])
    of_step = np.block([[np.zeros((3, 3)), R], [R, np.zeros((3, 3))]])
    return np.asarray(of_way @ way @ of_way.T + of_step @ step @ of_step.T)


@pytest.mark.parametrize("seed", range(10))
def test_a_step_has_the_covariance_that_it_was_given(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, way = moved(rng, 5.0), 10.0 * drawn(rng)
    T_after, step = T @ moved(rng), drawn(rng)
    told = step_covariance(T, way, T_after, composed(T, way, T_after, step))
    assert told is not None
    np.testing.assert_allclose(told, step, atol=1e-12)


def test_it_is_that_of_drawn_errors() -> None:
    """Errors drawn on both steps, composed as poses are; the recovered covariance is that of the second step's."""
    rng = np.random.default_rng(5)
    first, second = pose(so3_exp(np.array([0, 0, 0.8])), np.array([3.0, 1.0, 0.0])), moved(rng)
    root = 1e-3 * np.linalg.cholesky(np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))
    samples = []
    for _ in range(4000):
        ends, T = [], np.eye(4)
        for step in (first, second):
            e = root @ rng.normal(size=6)
            T = T @ step @ pose(so3_exp(e[:3]), e[3:])
            ends.append(T)
        samples.append(ends)
    true = [first, first @ second]
    ways = [np.cov(np.array([ros_error(true[k], ends[k]) for ends in samples]).T) for k in (0, 1)]
    told = step_covariance(true[0], ways[0], true[1], ways[1])
    assert told is not None
    np.testing.assert_allclose(np.diag(told), np.diag(root @ root.T), rtol=0.35)


def ros_error(true: Float, seen: Float) -> Float:
    """Error of a pose as ROS counts it."""
    turned = seen[:3, :3] @ true[:3, :3].T
    rotation = 0.5 * np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    return np.concatenate([seen[:3, 3] - true[:3, 3], rotation])


@pytest.mark.parametrize(
    "after", [np.zeros((6, 6)), 1e-2 * np.eye(6), np.full((6, 6), np.nan), np.diag([1.0] * 5 + [0])]
)
def test_a_covariance_that_does_not_grow_says_nothing(after: Float) -> None:
    before = after if np.isfinite(after).all() else np.eye(6)
    assert step_covariance(np.eye(4), before, pose(np.eye(3), np.array([1.0, 0.0, 0.0])), after) is None


def test_steps_go_from_keyframe_to_keyframe() -> None:
    known, T = StepCovariances(), np.eye(4)
    assert known.of_keyframe(5, T) is None
    for k in range(1, 8):
        known.add(10 * k, k * 1e-4 * np.eye(6))
    assert known.of_keyframe(12, T) is None, "the first keyframe has no step before it"
    told = known.of_keyframe(45, T)
    assert told is not None
    np.testing.assert_allclose(told.covariance, 3e-4 * np.eye(6), atol=1e-12)
    assert known.of_keyframe(49, T) is None, "no newer sample, so no growth"
    told = known.of_keyframe(70, T)
    assert told is not None
    np.testing.assert_allclose(told.covariance, 3e-4 * np.eye(6), atol=1e-12)
