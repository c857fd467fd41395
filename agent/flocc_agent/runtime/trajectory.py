"""Stamped poses of one frame in another: read and written as TUM text, interpolated in between.

A TUM line is `stamp_s tx ty tz qx qy qz qw`; lines that start with `#` are comments.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse, is_rigid, pose, q_wxyz_from_R, so3_exp, so3_log
from flocc_protocol.errors import FloccError

Float = NDArray[np.float64]

QUATERNION_NORM_TOLERANCE = 1e-2
GAP_MAX_S = 2.0
NEAR_S = 0.02


class RecordingError(FloccError):
    """A recording that cannot be used; the message names the file and, where there is one, the line."""


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


def pose_from_tum(values: Sequence[float], where: str) -> Float:
    """Pose of `tx ty tz qx qy qz qw`.

    Raises:
        RecordingError: A number is not finite, or the quaternion is not of unit length.
    """
    t, q_xyzw = np.asarray(values[:3], dtype=float), np.asarray(values[3:7], dtype=float)
    norm = float(np.linalg.norm(q_xyzw))
    if not (np.all(np.isfinite(t)) and np.isfinite(norm)):
        raise RecordingError(f"{where}: the pose has a number that is not finite")
    if abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE:
        raise RecordingError(f"{where}: the pose is not rigid (its quaternion has length {norm:.4g}, not 1)")
    x, y, z, w = q_xyzw / norm
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return pose(R, t)


def tum_line(stamp_s: float, T_fixed_body: Float) -> str:
    """One TUM line, without the line end."""
    w, x, y, z = q_wxyz_from_R(T_fixed_body[:3, :3])
    tx, ty, tz = T_fixed_body[:3, 3]
    return f"{stamp_s:.9f} {tx:.9f} {ty:.9f} {tz:.9f} {x:.12f} {y:.12f} {z:.12f} {w:.12f}"


def number_lines(path: Path, count: int) -> Iterator[tuple[int, list[float]]]:
    """Yield (line number, numbers) of a text table, without comments; commas separate as well.

    Raises:
        RecordingError: The file cannot be read, or a line has fewer than `count` numbers.
    """
    for line, text in text_lines(path):
        words = text.replace(",", " ").split()
        try:
            values = [float(word) for word in words]
        except ValueError as error:
            raise RecordingError(f"{path}:{line}: {str(error).split(': ')[-1]} is not a number") from None
        if len(values) < count:
            raise RecordingError(f"{path}:{line}: {count} numbers are needed, {len(values)} were found")
        yield line, values


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (line number, text) of a text file, without comments and empty lines.

    Raises:
        RecordingError: The file cannot be read as text.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    for line, text in enumerate(lines, start=1):
        if text.strip() and not text.lstrip().startswith("#"):
            yield line, text.strip()


def read_tum(path: Path) -> Trajectory:
    """Read a TUM trajectory; a line that repeats the stamp before it is left out.

    Raises:
        RecordingError: Unreadable, empty, time going backwards, or a broken pose.
    """
    stamps_s: list[float] = []
    poses: list[Float] = []
    for line, values in number_lines(path, 8):
        where = f"{path}:{line}"
        if not np.isfinite(values[0]):
            raise RecordingError(f"{where}: the stamp is not finite")
        if stamps_s and values[0] < stamps_s[-1]:
            raise RecordingError(f"{where}: time goes backwards, from {stamps_s[-1]:.6f} s to {values[0]:.6f} s")
        T = pose_from_tum(values[1:8], where)
        if not stamps_s or values[0] > stamps_s[-1]:
            stamps_s.append(values[0])
            poses.append(T)
    if not poses:
        raise RecordingError(f"{path}: holds no pose")
    return Trajectory(np.array(stamps_s), np.array(poses))


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory; stamps with 9 decimals, quaternions x y z w."""
    lines = [tum_line(s, T) for s, T in zip(trajectory.stamps_s, trajectory.T_fixed_body, strict=True)]
    path.write_text("".join(line + "\n" for line in lines), encoding="utf-8")
