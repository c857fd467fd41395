"""Drifting odometry from a true trajectory: what a robot's wheels or visual-inertial odometry would have said.

Errors grow with the distance, not with time: a scale error and a heading error per metre that a robot keeps for the
whole run (calibration), and random walks (noise). Roll and pitch drift less than heading, because gravity shows them.
"""

from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flocc_agent.config import Section
from flocc_agent.geometry import between, pose, so3_exp, so3_log
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.datasets.source import DatasetError

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


DriftKind = Literal["handheld", "wheeled", "car", "drone"]
DRIFTS: dict[DriftKind, DriftSpec] = {
    "handheld": DriftSpec(
        scale_sigma_ratio=0.05,
        translation_sigma_m_per_sqrt_m=0.05,
        heading_rate_sigma_rad_per_m=0.03,
        heading_sigma_rad_per_sqrt_m=0.04,
        tilt_ratio=0.3,
    ),
    "wheeled": DriftSpec(
        scale_sigma_ratio=0.02,
        translation_sigma_m_per_sqrt_m=0.01,
        heading_rate_sigma_rad_per_m=0.003,
        heading_sigma_rad_per_sqrt_m=0.01,
        tilt_ratio=0.0,
    ),
    "car": DriftSpec(
        scale_sigma_ratio=0.01,
        translation_sigma_m_per_sqrt_m=0.14,
        heading_rate_sigma_rad_per_m=1e-4,
        heading_sigma_rad_per_sqrt_m=1e-3,
        tilt_ratio=0.3,
    ),
    "drone": DriftSpec(
        scale_sigma_ratio=0.015,
        translation_sigma_m_per_sqrt_m=0.04,
        heading_rate_sigma_rad_per_m=8e-4,
        heading_sigma_rad_per_sqrt_m=4e-3,
        tilt_ratio=0.1,
    ),
}
"""What odometry of each kind is like: a hand-held camera with a poor visual-inertial odometry in a small room, wheels,
a car's stereo odometry, a drone's visual-inertial odometry. Those of the drone are fitted to three flights of EuRoC,
those of the car to one drive of KITTI (`flocc_lab.bench.odometry_drift`; docs/data-sets.md has the figures). The other
two are chosen: the heading of wheels is as in two graphs, a hand's is much worse than LiDAR's odometry."""
HEADING_END_MAX_RAD = 0.2
"""Standard deviation of the heading at the end of a robot's path; longer paths are given a better odometry."""
CAR_SPEED_MIN_M_PER_S = 4.0
LEVEL_SHARE_MIN = 0.98
KIND_OF_FORMAT: dict[str, DriftKind] = {
    "kitti": "car",
    "kitti-raw": "car",
    "euroc": "drone",
    "tum": "handheld",
    "7scenes": "handheld",
    "replica": "handheld",
    "colmap": "handheld",
    "transforms": "handheld",
}


def checked_kind(name: str | None) -> DriftKind | None:
    """A kind by its name, or None.

    Raises:
        DatasetError: There is no such kind.
    """
    found = next((kind for kind in DRIFTS if kind == name), None)
    if name is not None and found is None:
        raise DatasetError(f"--drift {name!r} is not known; there are {', '.join(DRIFTS)}")
    return found


def kind_of(format_name: str, truth: Trajectory) -> DriftKind:
    """What carried the camera: as its data set is known for, else by how it moved.

    Faster than a runner is a car; what turns about one axis only, as wheels do on a floor, is wheeled.
    """
    if format_name in KIND_OF_FORMAT:
        return KIND_OF_FORMAT[format_name]
    steps_m = np.linalg.norm(np.diff(truth.T_fixed_body[:, :3, 3], axis=0), axis=1)
    if len(steps_m) and float(np.median(steps_m / np.diff(truth.stamps_s))) > CAR_SPEED_MIN_M_PER_S:
        return "car"
    return "wheeled" if _turns_about_one_axis(truth) else "handheld"


def _turns_about_one_axis(truth: Trajectory) -> bool:
    turned = [so3_log(b[:3, :3] @ a[:3, :3].T) for a, b in pairwise(truth.T_fixed_body[:: max(1, len(truth) // 500)])]
    spread = np.linalg.eigvalsh(np.array(turned).T @ np.array(turned)) if turned else np.zeros(3)
    return bool(spread.sum() > 0 and spread[-1] >= LEVEL_SHARE_MIN * spread.sum())


def fitted(kind: DriftKind, length_m: float) -> DriftSpec:
    """Drift of a kind for a path of some length: its heading does not end further off than `HEADING_END_MAX_RAD`."""
    spec = DRIFTS[kind]
    if length_m <= 0:
        return spec
    return spec.model_copy(
        update={
            "heading_rate_sigma_rad_per_m": min(spec.heading_rate_sigma_rad_per_m, HEADING_END_MAX_RAD / length_m),
            "heading_sigma_rad_per_sqrt_m": min(spec.heading_sigma_rad_per_sqrt_m, HEADING_END_MAX_RAD / length_m**0.5),
        }
    )


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


def summary(spec: DriftSpec) -> str:
    """What a report says of odometry that was made."""
    heading = f"{spec.heading_rate_sigma_rad_per_m:.3g} rad/m and {spec.heading_sigma_rad_per_sqrt_m:.3g} rad/sqrt(m)"
    position = f"{spec.translation_sigma_m_per_sqrt_m:.3g} m/sqrt(m)"
    return (
        f"made of ground truth: scale {spec.scale_sigma_ratio:.3g}, heading {heading}, position {position}, "
        "one standard deviation each"
    )
