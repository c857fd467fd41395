"""Traps in what readers do not look for: a column, a map beside that of the camera, names that count in another way.

What nobody reads may change what is read. Its name is drawn, and so is whether it says something; only then a refusal
is right, and otherwise what was not used must be told.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from flocc_agent.geometry import q_wxyz_from_R
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_lab.dialects.folder_writers import HEIGHT, WIDTH, picture
from flocc_lab.dialects.trap_parts import CAMERA, Rng, Trap, moving, unlike, written
from flocc_launch.datasets.detect import read_source
from flocc_launch.datasets.intrinsics import read_lens

ZERO_S = 1_700_000_000
COUNT = 12
STATES = (("OK", "LOST"), ("TRACKING", "SEARCHING", "LOST"), ("True", "False"), ("1", "0"), ("vio", "imu"))
STATE_NAMES = ("tracking_state", "valid", "is_lost", "status", "Okay", "etat", "flag2", "mission-id", "solution_type")
QUIET_NAMES = ("vel_x", "cov_xx", "bias_gx", "temperature", "num_inliers", "reproj_error")


def spare_column(rng: Rng, folder: Path) -> Trap:
    """A column beside poses that says which of them count, or a measurement of something else."""
    T = moving(rng, COUNT)
    says = bool(rng.integers(2))
    states = STATES[rng.integers(len(STATES))]
    at = np.sort(rng.integers(0, len(states), COUNT)) if rng.integers(2) else np.arange(COUNT) % len(states)
    at[: len(states)] = np.arange(len(states))
    name = str(rng.choice(STATE_NAMES if says else QUIET_NAMES))
    place = int(rng.integers(0, 9))
    values = [states[k] if says else f"{x:.4f}" for k, x in zip(at, rng.normal(0, 1, COUNT), strict=True)]

    def row(fields: list[str], value: str) -> str:
        return ",".join([*fields[:place], value, *fields[place:]])

    lines = [row(["timestamp", "x", "y", "z", "qw", "qx", "qy", "qz"], name)]
    for k, pose in enumerate(T):
        numbers = [*pose[:3, 3], *q_wxyz_from_R(pose[:3, :3])]
        lines.append(row([f"{ZERO_S + 0.1 * k:.1f}", *(f"{number:.9f}" for number in numbers)], values[k]))
    path = written(folder / "poses.csv", "\n".join(lines) + "\n")

    def look() -> str | None:
        trajectory, notes = read_trajectory(path)
        untold = None if any(name in note for note in notes) else f"{name} is not told"
        return untold or unlike(trajectory.T_fixed_body, T, "the trajectory")

    return Trap(look, must_be_refused=says)


def beside_the_camera(rng: Rng, folder: Path) -> Trap:
    """A calibration whose camera is a map, beside another map: its mounting, its distortion, or settings."""
    kinds = {
        "extrinsic": f"  pitch: 0.03\n  x: {rng.uniform(0.5, 2):.3f}\n",
        "distortion": f"  k1: {-rng.uniform(0.1, 0.3):.3f}\n  k2: 0.05\n  p1: 0.0\n  p2: 0.0\n",
        "where": f"  centre: {np.round(rng.uniform(0.1, 1, 3), 3).tolist()}\n",
        "Matching": f"  threshold: {rng.uniform(0, 1):.2f}\n  levels: 8\n",
    }
    beside = str(rng.choice(list(kinds)))
    camera = "intrinsic:\n" + "".join(f"  {line}\n" for line in CAMERA.splitlines())
    other = f"{beside}:\n{kinds[beside]}"
    path = written(folder / "camera.yaml", other + camera if rng.integers(2) else camera + other)

    def look() -> str | None:
        lens = read_lens(path, (WIDTH, HEIGHT))
        return None if any(beside in note for note in lens.notes) else f"{beside} is not told"

    return Trap(look, must_be_refused=beside != "Matching")


def names_in_another_base(rng: Rng, folder: Path) -> Trap:
    """Images named by stamps in hexadecimal, or by words, and a trajectory with as many poses."""
    root, T = folder / "data", moving(rng, COUNT)
    step = int(rng.integers(10, 200)) * 1_000_000
    for k in range(COUNT):
        picture(root / "images" / f"{ZERO_S * 10**9 + k * step:x}.png", k)
    rows = (f"{ZERO_S + 0.1 * k:.1f} {' '.join(f'{x:.6f}' for x in pose[:3, 3])} 0 0 0 1" for k, pose in enumerate(T))
    written(root / "odometry.tum", "\n".join(rows) + "\n")
    written(root / "camera.yaml", CAMERA)
    return Trap(lambda: f"{len(read_source(root).images)} images were taken as they stand", must_be_refused=True)


UNREAD_TRAPS: dict[str, Callable[[Rng, Path], Trap]] = {
    "a column beside poses": spare_column,
    "a map beside the camera": beside_the_camera,
    "names in another base": names_in_another_base,
}
