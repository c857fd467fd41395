"""The fit of a drift finds what was drawn."""

import numpy as np
import pytest

from flocc_agent.geometry import pose, so3_exp
from flocc_agent.runtime.trajectory import Trajectory
from flocc_lab.bench.odometry_drift import found_drift
from flocc_launch.datasets.drift import DriftSpec, drifted


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
