"""Accuracy of the MASt3R front end's relative pose on synthetic pointmaps: noise, outliers and a wrong focal length."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import angle_rad, inverse, pose, so3_exp
from flocc_agent.perception.mast3r.relative_pose import (
    PnpParameters,
    PoseFailed,
    RelativePose,
    relative_pose,
    reray,
    weiszfeld_focal,
)

Float = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL_PX = 512, 384, 420.0
DEPTH_MIN_M, DEPTH_MAX_M = 3.0, 15.0
DEPTH_NOISE_RATIO = 0.05
PIXEL_NOISE_PX = 1.0
ROTATION_MAX_RAD = 0.3
SPACING_PX = 16
OUTLIER_RATIOS = (0.3, 0.7)
FOCAL_ERRORS = (0.0, 0.05, 0.10, 0.20)
MODES = ("calibrated", "uncalibrated", "true K on the raw pointmap")


@dataclass(frozen=True, slots=True, eq=False)
class TableScene:
    """One synthetic decode and its matches.

    Attributes:
        pts3d: (H', W', 3) pointmap on a grid of every 16th pixel, in camera 1, with its own focal length.
        uv_1: (N, 2) pixels of that grid.
        uv_2: (N, 2) their matches in image 2, outliers included.
        T_1_2: (4, 4) truth; its translation has length one.
    """

    pts3d: Float
    uv_1: Float
    uv_2: Float
    T_1_2: Float


def true_K() -> Float:
    """Calibration of both cameras."""
    return np.array([[FOCAL_PX, 0.0, WIDTH / 2], [0.0, FOCAL_PX, HEIGHT / 2], [0.0, 0.0, 1.0]])


def draw_scene(rng: np.random.Generator, outlier_ratio: float, focal_error: float) -> TableScene:
    """Draw one pair: 5 % depth noise along the ray, 1 px at the match, |t| = 1 at depths of 3 to 15."""
    K = true_K()
    v, u = np.mgrid[SPACING_PX // 2 : HEIGHT : SPACING_PX, SPACING_PX // 2 : WIDTH : SPACING_PX]
    uv_1 = np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)
    z = rng.uniform(DEPTH_MIN_M, DEPTH_MAX_M, len(uv_1))
    direction = rng.standard_normal(3)
    axis = rng.standard_normal(3)
    R = so3_exp(axis / np.linalg.norm(axis) * rng.uniform(0.0, ROTATION_MAX_RAD))
    T_1_2 = pose(R, direction / np.linalg.norm(direction))
    p_2 = reray(z, uv_1, K) @ inverse(T_1_2)[:3, :3].T + inverse(T_1_2)[:3, 3]
    uv_2 = p_2[:, :2] / p_2[:, 2:] * FOCAL_PX + K[:2, 2] + rng.normal(0.0, PIXEL_NOISE_PX, (len(z), 2))
    wrong = rng.random(len(z)) < outlier_ratio
    uv_2[wrong] = rng.uniform([0, 0], [WIDTH, HEIGHT], (int(wrong.sum()), 2))
    map_K = np.diag([1 + focal_error, 1 + focal_error, 1.0]) @ (K - [[0, 0, WIDTH / 2], [0, 0, HEIGHT / 2], [0, 0, 0]])
    map_K[:2, 2] = K[:2, 2]
    noisy_z = z * (1 + DEPTH_NOISE_RATIO * rng.standard_normal(len(z)))
    return TableScene(reray(noisy_z, uv_1, map_K).reshape(*u.shape, 3), uv_1, uv_2, T_1_2)


def solve(scene: TableScene, mode: str) -> RelativePose | PoseFailed:
    """Estimate the pose the way a calibrated robot does, an uncalibrated one, or the trap."""
    points = scene.pts3d.reshape(-1, 3)
    K = true_K()
    if mode == "calibrated":
        points = reray(points[:, 2], scene.uv_1, K)
    elif mode == "uncalibrated":
        # The grid's own pixel pitch: a map of every 16th pixel has a 16th of the focal length.
        centre = ((WIDTH / 2 - SPACING_PX // 2) / SPACING_PX, (HEIGHT / 2 - SPACING_PX // 2) / SPACING_PX)
        focal = (weiszfeld_focal(scene.pts3d, centre) or 0.0) * SPACING_PX
        K = np.array([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return relative_pose(points, scene.uv_2, K, PnpParameters())


def errors_deg(T_true: Float, T: Float) -> tuple[float, float]:
    """Rotation error and angle between the translations' directions, degrees."""
    rotation = angle_rad(T_true[:3, :3].T @ T[:3, :3])
    cosine = T_true[:3, 3] @ T[:3, 3] / np.linalg.norm(T_true[:3, 3]) / max(float(np.linalg.norm(T[:3, 3])), 1e-12)
    return float(np.degrees(rotation)), float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def table(trials: int = 40, seed: int = 0, modes: tuple[str, ...] = MODES) -> list[dict[str, float | str | int]]:
    """Median and maximum errors for every mode, outlier ratio and focal error, the same scenes for each mode."""
    rows: list[dict[str, float | str | int]] = []
    for outlier_ratio in OUTLIER_RATIOS:
        for focal_error in FOCAL_ERRORS:
            rng = np.random.default_rng([seed, round(100 * outlier_ratio), round(100 * focal_error)])
            scenes = [draw_scene(rng, outlier_ratio, focal_error) for _ in range(trials)]
            rows += [row(mode, outlier_ratio, focal_error, scenes) for mode in modes]
    return rows


def row(mode: str, outlier_ratio: float, focal_error: float, scenes: list[TableScene]) -> dict[str, float | str | int]:
    """One row of the table; failures are counted, not averaged."""
    errors = []
    for scene in scenes:
        solved = solve(scene, mode)
        if not isinstance(solved, PoseFailed):
            errors.append(errors_deg(scene.T_1_2, solved.T_1_2_unscaled))
    rotations, directions = np.array(errors).reshape(-1, 2).T if errors else (np.array([np.nan]), np.array([np.nan]))
    return {
        "mode": mode,
        "outlier_ratio": outlier_ratio,
        "focal_error_ratio": focal_error,
        "trials": len(scenes),
        "failed": len(scenes) - len(errors),
        "rotation_median_deg": round(float(np.median(rotations)), 3),
        "rotation_max_deg": round(float(np.max(rotations)), 3),
        "direction_median_deg": round(float(np.median(directions)), 3),
        "direction_max_deg": round(float(np.max(directions)), 3),
    }
