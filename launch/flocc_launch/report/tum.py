"""Trajectories in TUM format: `stamp_s tx ty tz qx qy qz qw`, as evo reads it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import pose_from_tq, tq_from_pose
from flocc_launch.run_folder import RunFolderError, read_text

Float = NDArray[np.float64]


def write_tum(path: Path, stamps_s: Float, poses: Float) -> None:
    """Write stamps (N,) and poses (N, 4, 4); every number so that reading gives it back exactly."""
    lines = []
    for stamp_s, T in zip(stamps_s, poses, strict=True):
        tx, ty, tz, qw, qx, qy, qz = tq_from_pose(T)
        lines.append(" ".join(repr(float(v)) for v in (stamp_s, tx, ty, tz, qx, qy, qz, qw)) + "\n")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(lines), encoding="utf-8")


def read_tum(path: Path) -> tuple[Float, Float]:
    """Read stamps (N,) and poses (N, 4, 4); lines that start with '#' are comments.

    Raises:
        RunFolderError: A line has not eight finite numbers, or its quaternion is zero.
    """
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            row = np.array([float(word) for word in line.replace(",", " ").split()])
        except ValueError as error:
            raise RunFolderError(f"{path}:{number}: is not numbers") from error
        if len(row) != 8 or not np.all(np.isfinite(row)) or np.linalg.norm(row[4:8]) < 1e-6:
            raise RunFolderError(f"{path}:{number}: is not 'stamp tx ty tz qx qy qz qw'")
        rows.append(row)
    poses = [pose_from_tq(row[[1, 2, 3, 7, 4, 5, 6]]) for row in rows]
    return np.array([row[0] for row in rows]), np.array(poses).reshape(-1, 4, 4)
