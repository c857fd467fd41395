"""Point scenes with known poses: features without images, so that geometry is tested apart from SIFT."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse, pose, so3_exp
from flocc_agent.perception.classical.features import Features

Float = NDArray[np.float64]

FOCAL_PX = 500.0


@dataclass(frozen=True)
class PointScene:
    """Points (N, 3) in the world, metres, and what each looks like."""

    points_m: Float
    descriptors: NDArray[np.uint8]


def box(rng: np.random.Generator, count: int = 300) -> PointScene:
    """Points in a box 4 to 10 m before the origin."""
    points = rng.uniform([-4, -3, 4], [4, 3, 10], (count, 3))
    return PointScene(points, rng.integers(0, 256, (count, 128), dtype=np.uint8))


def wall(rng: np.random.Generator, count: int = 300) -> PointScene:
    """Points on one slanted wall about 6 m before the origin."""
    xy = rng.uniform([-4, -3], [4, 3], (count, 2))
    points = np.column_stack([xy, 6.0 + 0.4 * xy[:, 0]])
    return PointScene(points, rng.integers(0, 256, (count, 128), dtype=np.uint8))


def camera_at(position_m: tuple[float, float, float], rotation_rad: tuple[float, float, float] = (0, 0, 0)) -> Float:
    """`T_world_camera` of a position and a rotation vector."""
    return pose(so3_exp(np.array(rotation_rad, float)), np.array(position_m, float))


def seen_from(
    scene: PointScene,
    T_world_camera: Float,
    rng: np.random.Generator,
    noise_px: float = 0.5,
    wrong_ratio: float = 0.0,
) -> Features:
    """Features of the scene's points, noisy; some of them moved to wrong places."""
    T = inverse(T_world_camera)
    p = scene.points_m @ T[:3, :3].T + T[:3, 3]
    visible = (p[:, 2] > 0.5) & (np.abs(p[:, 0] / p[:, 2]) < 1.0) & (np.abs(p[:, 1] / p[:, 2]) < 1.0)
    points = p[visible, :2] / p[visible, 2:] + rng.normal(0, noise_px / FOCAL_PX, (int(visible.sum()), 2))
    wrong = rng.uniform(size=len(points)) < wrong_ratio
    points[wrong] = rng.uniform(-0.6, 0.6, (int(wrong.sum()), 2))
    return Features(points.astype(np.float32), scene.descriptors[visible], FOCAL_PX)
