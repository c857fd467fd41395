"""How far the clocks of pictures and odometry are apart: turns seen in the pictures are those of the trajectory.

How much the camera turned between two pictures is measured with tracked corners and the essential matrix. The
trajectory says how much it turned in any interval. Where the two go together best is the offset; that of both halves
is the drift.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import angle_rad
from flocc_agent.lenses import CameraModel
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.datasets.source import DatasetError

Float = NDArray[np.float64]
Grey = NDArray[np.uint8]

PAIRS_MAX = 400
APART_MIN_S = 0.2
STEP_S = 0.02
OFFSETS_MAX = 40_000
OVERLAP_MIN_RATIO = 0.5
CORRELATION_MIN = 0.5
AHEAD_MIN = 0.1
"""How much better the best offset must be than any that is over a second away."""
NEAR_S = 1.0
TURN_MAX_RAD = 0.8
"""Corners are not tracked over more; a larger turn is the wrong one of the four that an essential matrix has."""
WIDTH_PX = 320
CORNERS_MAX, CORNERS_MIN = 300, 20


@dataclass(frozen=True, slots=True)
class ClockFit:
    """What pictures and a trajectory say of each other's clock.

    Attributes:
        offset_s: To be added to the trajectory's stamps.
        drift_ratio: By how much it grows per second, or None where both halves agree as well as can be told.
        correlation: Of turns in both, at most 1.
    """

    offset_s: float
    drift_ratio: float | None
    correlation: float


def turns_of_pictures(files: Sequence[Path], lens: CameraModel) -> Float:
    """Angles between neighbouring pictures, radians; nan where too little could be tracked."""
    import cv2

    scale = WIDTH_PX / lens.width
    K = np.diag([scale, scale, 1.0]) @ np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    size = (WIDTH_PX, round(lens.height * scale))
    angles_rad: list[float] = []
    before: Grey | None = None
    for file in files:
        read = cv2.imdecode(np.fromfile(file, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
        grey = (
            None if read is None else np.asarray(cv2.resize(read, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        )
        if before is not None:
            angles_rad.append(_turn_rad(before, grey, K))
        before = grey
    return np.array(angles_rad)


def _turn_rad(before: Grey, after: Grey | None, K: Float) -> float:
    import cv2

    corners = None if after is None else cv2.goodFeaturesToTrack(before, CORNERS_MAX, 0.01, 7)
    if corners is None or after is None:
        return float("nan")
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.empty_like(corners))
    kept = found.ravel() == 1
    if np.count_nonzero(kept) < CORNERS_MIN:
        return float("nan")
    a, b = corners[kept].reshape(-1, 2), moved[kept].reshape(-1, 2)
    if np.median(np.linalg.norm(b - a, axis=1)) < 0.1:
        return 0.0
    E, inliers = cv2.findEssentialMat(a, b, K, cv2.RANSAC, 0.999, 1.0)
    if E is None or E.shape != (3, 3):
        return float("nan")
    turn_rad = angle_rad(np.asarray(cv2.recoverPose(E, a, b, K, mask=inliers)[1], dtype=float))
    return turn_rad if turn_rad <= TURN_MAX_RAD else float("nan")


def fit_clocks(stamps_s: Float, turns_rad: Float, trajectory: Trajectory) -> ClockFit | None:
    """Offset between the clock of pictures and that of a trajectory, or None where their turns do not tell.

    Args:
        stamps_s: (N,) of the pictures.
        turns_rad: (N - 1,) between neighbouring ones; nan where not known.
        trajectory: Of the body that carries the camera, by its own clock.
    """
    own_rad = turned_rad(trajectory)
    known = np.isfinite(turns_rad)
    if np.count_nonzero(known) < CORNERS_MIN:
        return None
    starts_s, ends_s, seen_rad = stamps_s[:-1][known], stamps_s[1:][known], turns_rad[known]
    offsets_s = _candidates_s(stamps_s, trajectory.stamps_s)
    scores = np.array([_score(starts_s, ends_s, seen_rad, trajectory.stamps_s, own_rad, o) for o in offsets_s])
    best = int(np.argmax(scores))
    others = scores[np.abs(offsets_s - offsets_s[best]) > NEAR_S]
    if scores[best] < CORRELATION_MIN or (len(others) and scores[best] - np.max(others) < AHEAD_MIN):
        return None
    halves = (slice(None, len(starts_s) // 2), slice(len(starts_s) // 2, None))
    near_s = offsets_s[best] + np.arange(-NEAR_S, NEAR_S, STEP_S / 2)
    ends = []
    for half in halves:
        part = [_score(starts_s[half], ends_s[half], seen_rad[half], trajectory.stamps_s, own_rad, o) for o in near_s]
        ends.append((float(np.mean(starts_s[half])), float(near_s[int(np.argmax(part))]), max(part)))
    told = all(score >= CORRELATION_MIN for _, _, score in ends) and ends[1][0] > ends[0][0]
    apart_s = ends[0][1] - ends[1][1]
    told = told and abs(apart_s) > float(np.median(ends_s - starts_s)) / 4
    drift = apart_s / (ends[1][0] - ends[0][0]) if told else None
    return ClockFit(-float(offsets_s[best]), drift, float(scores[best]))


def agreement(stamps_s: Float, turns_rad: Float, trajectory: Trajectory) -> float:
    """Correlation of turns in pictures with those of a trajectory as both are stamped, at most 1; -1 where unknown."""
    known = np.isfinite(turns_rad)
    parts = stamps_s[:-1][known], stamps_s[1:][known], turns_rad[known]
    return _score(*parts, trajectory.stamps_s, turned_rad(trajectory), 0.0)


def turned_rad(trajectory: Trajectory) -> Float:
    """(N,) radians by which the body has turned up to each pose, whatever the axes."""
    T = trajectory.T_fixed_body[:, :3, :3]
    traces = np.einsum("nij,nij->n", T[:-1], T[1:])
    return np.concatenate([[0.0], np.cumsum(np.arccos(np.clip((traces - 1) / 2, -1, 1)))])


def _candidates_s(stamps_s: Float, own_s: Float) -> Float:
    """Offsets at which the two overlap by half of the shorter one: what is added to a picture's stamp."""
    shared_s = OVERLAP_MIN_RATIO * min(stamps_s[-1] - stamps_s[0], own_s[-1] - own_s[0])
    low_s, high_s = own_s[0] - stamps_s[-1] + shared_s, own_s[-1] - stamps_s[0] - shared_s
    step_s = max(STEP_S, (high_s - low_s) / OFFSETS_MAX)
    return np.arange(low_s, high_s + step_s, step_s)


def _score(starts_s: Float, ends_s: Float, seen_rad: Float, own_s: Float, own_rad: Float, offset_s: float) -> float:
    """Correlation of turns in the pictures with those of the trajectory at an offset."""
    inside = (starts_s + offset_s >= own_s[0]) & (ends_s + offset_s <= own_s[-1])
    if np.count_nonzero(inside) < max(CORNERS_MIN, OVERLAP_MIN_RATIO * 0.5 * len(starts_s)):
        return -1.0
    at = [np.interp(stamps_s[inside] + offset_s, own_s, own_rad) for stamps_s in (starts_s, ends_s)]
    a, b = at[1] - at[0], seen_rad[inside]
    a, b = a - a.mean(), b - b.mean()
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0 else -1.0


def spaced(images: Sequence[tuple[float, Path]]) -> list[tuple[float, Path]]:
    """At most `PAIRS_MAX` pictures that follow each other, far enough apart for a turn to be seen between them."""
    kept: list[tuple[float, Path]] = []
    for stamp_s, file in images:
        if not kept or stamp_s - kept[-1][0] >= APART_MIN_S:
            kept.append((stamp_s, file))
        if len(kept) > PAIRS_MAX:
            break
    return kept


def measured(images: Sequence[tuple[float, Path]], lens: CameraModel | None, trajectory: Trajectory) -> ClockFit:
    """Measure the clocks of pictures and of a trajectory against each other.

    Raises:
        DatasetError: The intrinsics are missing, or the pictures do not turn enough to tell.
    """
    where = images[0][1].parent
    if lens is None:
        raise DatasetError(f"{where}: intrinsics are missing, without which turns cannot be measured (--camera)")
    kept = spaced(images)
    stamps_s = np.array([stamp_s for stamp_s, _ in kept])
    fit = fit_clocks(stamps_s, turns_of_pictures([file for _, file in kept], lens), trajectory)
    if fit is None:
        raise DatasetError(f"{where}: the camera turns too little or too evenly for its clock to be told by turns")
    return fit
