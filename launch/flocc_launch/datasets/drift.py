"""Drifting odometry from a true trajectory: what a robot's wheels or visual-inertial odometry would have said.

Errors grow with the distance, not with time: a scale error and a heading error per metre that a robot keeps for the
whole run (calibration), and random walks (noise). Roll and pitch drift less than heading, because gravity shows them.
"""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flocc_agent.config import Section
from flocc_agent.geometry import between, pose, so3_exp
from flocc_agent.runtime.trajectory import Trajectory

Float = NDArray[np.float64]

UP_Z = np.array([0.0, 0.0, 1.0])


class DriftSpec(Section):
    """How odometry departs from the truth. All zero: perfect odometry."""

    scale_sigma_ratio: float = Field(0.015, ge=0)
    """Standard deviation of a robot's constant scale error."""
    translation_sigma_m_per_sqrt_m: float = Field(0.01, ge=0)
    """Random walk of the position: standard deviation after one metre; grows with the root of the distance."""
    heading_rate_sigma_rad_per_m: float = Field(0.0015, ge=0)
    """Standard deviation of a robot's constant heading error per metre."""
    heading_sigma_rad_per_sqrt_m: float = Field(0.003, ge=0)
    """Random walk of the heading: standard deviation after one metre."""
    tilt_ratio: float = Field(0.1, ge=0)
    """Random walk of roll and pitch over that of the heading; small where an accelerometer shows gravity."""


HANDHELD_DRIFT = DriftSpec(
    scale_sigma_ratio=0.05,
    translation_sigma_m_per_sqrt_m=0.05,
    heading_rate_sigma_rad_per_m=0.03,
    heading_sigma_rad_per_sqrt_m=0.04,
    tilt_ratio=0.3,
)
"""A hand-held camera with a poor visual-inertial odometry in a small room: centimetres after a few metres."""


def drifted(truth: Trajectory, spec: DriftSpec, rng: np.random.Generator, up_fixed: Float = UP_Z) -> Trajectory:
    """Integrate the true motion with errors.

    Args:
        truth: `T_world_body`, densely sampled.
        spec: How much.
        rng: One robot's generator; the same state gives the same odometry.
        up_fixed: (3,) direction against gravity in the truth's fixed frame.

    Returns:
        `T_odom_body` at the same stamps, the identity at the first.
    """
    up_odom = truth.T_fixed_body[0, :3, :3].T @ (up_fixed / np.linalg.norm(up_fixed))
    scale = 1.0 + spec.scale_sigma_ratio * rng.standard_normal()
    heading_rate = spec.heading_rate_sigma_rad_per_m * rng.standard_normal()
    poses = [np.eye(4)]
    for T_before, T_after in zip(truth.T_fixed_body[:-1], truth.T_fixed_body[1:], strict=True):
        step = between(T_before, T_after)
        distance_m = float(np.linalg.norm(step[:3, 3]))
        noise = rng.standard_normal(7) * np.sqrt(distance_m)
        turned = noise[0] * up_odom + spec.tilt_ratio * (noise[1:4] - (noise[1:4] @ up_odom) * up_odom)
        error = heading_rate * distance_m * up_odom + spec.heading_sigma_rad_per_sqrt_m * turned
        t_m = scale * step[:3, 3] + spec.translation_sigma_m_per_sqrt_m * noise[4:7]
        T_odom = poses[-1] @ pose(step[:3, :3], t_m)
        poses.append(pose(so3_exp(error) @ T_odom[:3, :3], T_odom[:3, 3]))
    return Trajectory(truth.stamps_s, np.array(poses))
