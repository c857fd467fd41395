"""The fit of a drift finds what was drawn."""

from pathlib import Path

import numpy as np
import pytest

from flocc_agent.geometry import pose, so3_exp
from flocc_agent.runtime.trajectory import Trajectory
from flocc_lab.bench.odometry_drift import found_drift, of_files
from flocc_launch.datasets.drift import DriftSpec, drifted


def graph(path: Path, edges: np.ndarray, vertices: np.ndarray) -> Path:
    """A planar graph: steps x, y and angle, or poses of vertices as `flocc optimise` writes them."""
    lines = [f"EDGE_SE2 {k} {k + 1} {x} {y} {a} 1 0 0 1 0 1" for k, (x, y, a) in enumerate(edges)]
    lines += [f"VERTEX_SE3:QUAT {k} {' '.join(map(str, row))}" for k, row in enumerate(vertices)]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_planar_graph_is_held_against_its_optimum(tmp_path: Path) -> None:
    turns = 0.02 * np.sin(np.arange(400) / 15)
    headings = np.concatenate([[0.0], np.cumsum(turns)])
    along = np.cumsum(0.5 * np.stack([np.cos(headings[:-1]), np.sin(headings[:-1])], 1), axis=0)
    places = np.concatenate([[[0.0, 0.0]], along])
    zero = np.zeros(len(headings))
    true = np.stack([*places.T, zero, zero, zero, np.sin(headings / 2), np.cos(headings / 2)], axis=1)
    steps = np.stack([np.full(400, 0.5 * 1.03), np.zeros(400), turns + 0.002 * 0.5], axis=1)
    odometry, optimum = (tmp_path / name for name in ("a.g2o", "optimised.g2o"))
    found = of_files(graph(odometry, steps, np.zeros((0, 7))), graph(optimum, np.zeros((0, 3)), true))
    assert found.heading_rate_rad_per_m == pytest.approx(0.002, rel=0.01)
    assert found.scale_ratio == pytest.approx(0.03, abs=0.001)


def loop(count: int = 4000) -> Trajectory:
    """Two kilometres of a road with curves."""
    T, poses = np.eye(4), []
    for k in range(count):
        poses.append(T)
        T = T @ pose(so3_exp(np.array([0.0, 0.0, 0.02 * np.sin(k / 150)])), np.array([0.5, 0.0, 0.0]))
    return Trajectory(np.linspace(0.0, 0.1 * (count - 1), count), np.array(poses))


def test_walks_and_constants_that_were_drawn_are_found() -> None:
    truth = loop()
    spec = DriftSpec(
        scale_sigma_ratio=0.02,
        translation_sigma_m_per_sqrt_m=0.05,
        heading_rate_sigma_rad_per_m=2e-4,
        heading_sigma_rad_per_sqrt_m=3e-3,
        tilt_ratio=0.0,
    )
    up = np.array([0.0, 0.0, 1.0])
    found = [
        found_drift(drifted(truth, spec, np.random.default_rng(seed)).T_fixed_body, truth.T_fixed_body, up)
        for seed in range(24)
    ]
    scales, walks = (np.array([getattr(f, k) for f in found]) for k in ("scale_ratio", "heading_rad_per_sqrt_m"))
    assert np.sqrt(np.mean(scales**2)) == pytest.approx(0.02, rel=0.5)
    assert np.mean(walks) == pytest.approx(3e-3, rel=0.25)
    rates = np.array([each.heading_rate_rad_per_m for each in found])
    assert np.sqrt(np.mean(rates**2)) == pytest.approx(2e-4, rel=0.5)


def test_noise_of_single_poses_is_no_walk() -> None:
    truth, rng = loop(), np.random.default_rng(4)
    noisy = np.array([T @ pose(so3_exp(rng.normal(0, 0.01, 3)), rng.normal(0, 0.05, 3)) for T in truth.T_fixed_body])
    found = found_drift(noisy, truth.T_fixed_body, np.array([0.0, 0.0, 1.0]))
    assert found.heading_rad_per_sqrt_m < 1e-3
    assert abs(found.scale_ratio) < 0.002


def test_a_path_of_some_metres_is_too_short() -> None:
    T = loop(20).T_fixed_body
    with pytest.raises(ValueError, match=r"the path of 9\.5 m is too short"):
        found_drift(T, T, np.array([0.0, 0.0, 1.0]))
