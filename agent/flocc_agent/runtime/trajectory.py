"""Stamped poses of one frame in another: interpolated, and written as TUM text (`trajectory_text` reads).

A TUM line is `stamp_s tx ty tz qx qy qz qw`; lines that start with `#` are comments.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse, is_rigid, pose, q_wxyz_from_R, so3_exp, so3_log
from flocc_agent.runtime.text_tables import RecordingError

Float = NDArray[np.float64]

QUATERNION_NORM_TOLERANCE = 1e-2
GAP_MAX_S = 2.0
NEAR_S = 0.02
HEADER = "# timestamp[s] tx ty tz qx qy qz qw\n"


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of a body in a fixed frame, sorted by time.

    Attributes:
        stamps_s: (N,) strictly increasing, seconds.
        T_fixed_body: (N, 4, 4) poses, metres.
    """

    stamps_s: Float
    T_fixed_body: Float

    def __post_init__(self) -> None:
        if self.T_fixed_body.shape != (len(self.stamps_s), 4, 4):
            raise ValueError(f"{len(self.stamps_s)} stamps do not fit poses {self.T_fixed_body.shape}")
        if np.any(np.diff(self.stamps_s) <= 0):
            raise ValueError("stamps of a trajectory must increase")

    def __len__(self) -> int:
        return len(self.stamps_s)

    def at(self, stamp_s: float, gap_max_s: float = GAP_MAX_S) -> Float | None:
        """Interpolate the pose at a time: rotation by SLERP, translation linearly.

        Args:
            stamp_s: When, seconds.
            gap_max_s: Longer intervals between two poses are not bridged.

        Returns:
            (4, 4), or None outside of the trajectory (by more than 20 ms) and inside of a long gap.
        """
        after = int(np.searchsorted(self.stamps_s, stamp_s))
        for near in (after, after - 1):
            if 0 <= near < len(self) and abs(self.stamps_s[near] - stamp_s) < 1e-9:
                return np.array(self.T_fixed_body[near])
        if 0 < after < len(self) and self.stamps_s[after] - self.stamps_s[after - 1] <= gap_max_s:
            return self._between(after - 1, stamp_s)
        near = min(max(after if self._closer(after, stamp_s) else after - 1, 0), len(self) - 1)
        return np.array(self.T_fixed_body[near]) if abs(self.stamps_s[near] - stamp_s) <= NEAR_S else None

    def _closer(self, after: int, stamp_s: float) -> bool:
        if after == 0 or after == len(self):
            return after == 0
        return bool(self.stamps_s[after] - stamp_s < stamp_s - self.stamps_s[after - 1])

    def _between(self, index: int, stamp_s: float) -> Float:
        before, after = self.T_fixed_body[index], self.T_fixed_body[index + 1]
        ratio = (stamp_s - self.stamps_s[index]) / (self.stamps_s[index + 1] - self.stamps_s[index])
        R = before[:3, :3] @ so3_exp(ratio * so3_log(before[:3, :3].T @ after[:3, :3]))
        return pose(R, (1 - ratio) * before[:3, 3] + ratio * after[:3, 3])

    def relative_to_first(self) -> "Trajectory":
        """The same motion in the frame of its first pose."""
        return Trajectory(self.stamps_s, inverse(self.T_fixed_body[0]) @ self.T_fixed_body)

    def later(self, offset_s: float) -> "Trajectory":
        """The same motion with other stamps."""
        return Trajectory(self.stamps_s + offset_s, self.T_fixed_body)

    def length_m(self) -> float:
        """Distance travelled, metres."""
        return float(np.linalg.norm(np.diff(self.T_fixed_body[:, :3, 3], axis=0), axis=1).sum())


def checked_pose(T: Float, where: str) -> Float:
    """Return a (4, 4) pose with its rotation made exact, or say where a pose is broken.

    Raises:
        RecordingError: A number is not finite, or the rotation is not one.
    """
    if not np.all(np.isfinite(T)):
        raise RecordingError(f"{where}: the pose has a number that is not finite")
    if not is_rigid(T, tolerance=1e-2):
        raise RecordingError(f"{where}: the pose is not rigid (its rotation is not a rotation)")
    U, _, Vt = np.linalg.svd(T[:3, :3])
    return pose(U @ Vt, T[:3, 3])


def tum_line(stamp_s: float, T_fixed_body: Float) -> str:
    """One TUM line, without the line end."""
    w, x, y, z = q_wxyz_from_R(T_fixed_body[:3, :3])
    tx, ty, tz = T_fixed_body[:3, 3]
    return f"{stamp_s:.9f} {tx:.9f} {ty:.9f} {tz:.9f} {x:.12f} {y:.12f} {z:.12f} {w:.12f}"


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory with a line that names its columns; stamps with 9 decimals, quaternions x y z w."""
    lines = [tum_line(s, T) for s, T in zip(trajectory.stamps_s, trajectory.T_fixed_body, strict=True)]
    path.write_text(HEADER + "".join(line + "\n" for line in lines), encoding="utf-8")
