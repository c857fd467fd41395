"""Walks without images: robots go round blocks of a town whose streets they share, with drifting odometry."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import pose
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.datasets.drift import DriftSpec, drifted
from flocc_launch.scenarios.scenario import TracksScenario

Float = NDArray[np.float64]

STREETS = 5
STEP_M = 0.25
CORNER_M = 2.0
HEIGHT_M = 1.5

T_BODY_CAMERA: Float = pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""A camera that looks ahead: its z is the body's x, its y points down."""


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """One robot's way: where it truly went, `T_world_body`, and what its odometry says, `T_odom_body`."""

    truth: Trajectory
    odometry: Trajectory


def walks(scenario: TracksScenario, drift: DriftSpec | None = None) -> list[Walk]:
    """Draw the walks of all robots; a robot's own does not depend on how many there are."""
    return [
        _walk(scenario, robot, drift or DriftSpec(), np.random.default_rng([scenario.seed, robot]))
        for robot in range(scenario.robots)
    ]


def _walk(scenario: TracksScenario, robot: int, drift: DriftSpec, rng: np.random.Generator) -> Walk:
    route_m = scenario.routes_m.get(f"r{robot + 1}")
    points_m = _round_a_block(scenario, rng) if route_m is None else _along(np.array(route_m, dtype=np.float64))
    ahead = np.diff(points_m, axis=0)
    heading_rad = np.arctan2(ahead[:, 1], ahead[:, 0])
    stamps_s = np.arange(len(ahead), dtype=np.float64) * (STEP_M / scenario.speed_m_s)
    truth = Trajectory(stamps_s, np.array([_standing(p, h) for p, h in zip(points_m, heading_rad, strict=False)]))
    return Walk(truth, drifted(truth, drift, rng))


def _along(corners_m: Float) -> Float:
    """Points (N, 2) along given corners (K, 2), the corners rounded, both ends kept."""
    sides = [_side(a, b) for a, b in pairwise(corners_m)]
    way_m = np.concatenate([*sides, corners_m[-1:]])
    margin = min(round(CORNER_M / STEP_M) // 2, len(way_m) // 4)
    padded_m = np.pad(way_m, ((margin, margin), (0, 0)), mode="reflect", reflect_type="odd")
    windows = np.lib.stride_tricks.sliding_window_view(padded_m, 2 * margin + 1, axis=0)
    return np.asarray(windows.mean(axis=2))


def _round_a_block(scenario: TracksScenario, rng: np.random.Generator) -> Float:
    """Points (N, 2) of a drawn walk, from anywhere on its block."""
    ring_m = _rounded(_block(scenario, rng))
    steps = max(2, round(scenario.length_m / STEP_M))
    start = int(rng.integers(len(ring_m)))
    return np.asarray(ring_m[(start + np.arange(steps + 1)) % len(ring_m)])


def _block(scenario: TracksScenario, rng: np.random.Generator) -> Float:
    """Points (N, 2) every `STEP_M` round a rectangle of streets, either way."""
    spacing_m = scenario.area_m / (STREETS - 1)
    x = np.sort(rng.choice(STREETS, size=2, replace=False)) * spacing_m
    y = np.sort(rng.choice(STREETS, size=2, replace=False)) * spacing_m
    corners = np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]])
    corners = corners if rng.integers(2) else corners[::-1]
    sides = [_side(a, b) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    return np.concatenate(sides)


def _side(a: Float, b: Float) -> Float:
    """Points (N, 2) from a to just before b."""
    count = max(2, round(float(np.linalg.norm(b - a)) / STEP_M))
    return np.asarray(a + (b - a) * (np.arange(count) / count)[:, None])


def _rounded(ring_m: Float) -> Float:
    """Round the corners of a closed way (N, 2) by a moving mean."""
    width = min(max(1, round(CORNER_M / STEP_M)), len(ring_m) // 4)
    shifted = [np.roll(ring_m, k - width // 2, axis=0) for k in range(width)]
    return np.asarray(np.mean(shifted, axis=0), dtype=np.float64)


def _standing(point_m: Float, heading_rad: float) -> Float:
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return pose(R, np.array([point_m[0], point_m[1], HEIGHT_M]))
