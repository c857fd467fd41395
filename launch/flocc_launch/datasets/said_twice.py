"""What a folder says twice: calibrations beside each other, trajectories beside each other. They must agree.

Which of two is meant, nobody but their owner knows: the one that was forgotten there, or the one that was made anew. A
reader that takes the first in silence gives a wrong camera, or the motion of another estimator.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse
from flocc_agent.lenses import CameraModel, LensKind
from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.pixels import size_of
from flocc_launch.datasets.plain import NAMED_ODOMETRY, ODOMETRY_STEMS, TRUTH_STEMS
from flocc_launch.datasets.source import DatasetError, Float, Lens, Source
from flocc_protocol.errors import FloccError

APART_MAX_RATIO = 1 / 640
"""How far apart two calibrations may draw one point, of the image's longer side: rounded digits do."""
MOUNTED_APART_MAX_M, MOUNTED_APART_MAX = 2e-3, 2e-3
SHIFTS_APART_MAX_S = 1e-3
GRID, GRID_REACH, GRID_TAN_MAX = 7, 0.9, 1.7
"""Rays in which two cameras are compared: so many a side, over this part of the image, at most 60 degrees off."""
MOVED_APART_MAX_M, MOVED_APART_RATIO, TURNED_APART_MAX = 0.02, 0.01, 0.02
"""Two files of one motion differ by rounded digits and interpolation, at most; in metres, of the path, in sines."""
SAMPLED_MAX = 200


def see_one_camera(source: Source) -> tuple[str, ...]:
    """See that all calibrations of a folder that can be read describe one camera; returns what cannot be, and why.

    Raises:
        DatasetError: Two do not.
    """
    if source.lens is None or len(source.calibrations) < 2:
        return ()
    first, *others = source.calibrations
    taken, passed_over = read_lens(first, size_of(source.images)), []
    for file in others:
        try:
            lens = read_lens(file, size_of(source.images))
        except FloccError as error:
            passed_over.append(f"{error}; it was passed over, {first.name} was taken")
            continue
        if (how := cameras_differ(taken, lens)) is not None:
            raise DatasetError(
                f"{first} and {file.name} describe different cameras ({how}): keep the one that counts, or name it "
                "with --camera"
            )
    return tuple(passed_over)


def cameras_differ(taken: Lens, other: Lens) -> str | None:
    """How another calibration contradicts the one that is taken, or says more than it; None where it does neither."""
    a, b = taken.camera, other.camera
    if (a.width, a.height) != (b.width, b.height):
        return f"of {a.width}x{a.height} and of {b.width}x{b.height} pixels"
    apart_px = _drawn_apart_px(a, b)
    if not apart_px <= APART_MAX_RATIO * max(a.width, a.height):
        said = (("", str(a.kind), str(b.kind)), ("fx ", f"{a.fx:g}", f"{b.fx:g}"), ("fy ", f"{a.fy:g}", f"{b.fy:g}"))
        unlike = [f"{name}{one} and {two}" for name, one, two in said if one != two] or ["other centres or distortion"]
        return f"{', '.join(unlike)}; they draw points up to {apart_px:.2g} pixels apart"
    apart = taken.T_body_camera - other.T_body_camera
    is_apart = np.abs(apart[:3, 3]).max() > MOUNTED_APART_MAX_M or np.abs(apart[:3, :3]).max() > MOUNTED_APART_MAX
    if is_apart and not np.array_equal(other.T_body_camera, np.eye(4)):
        return "they place it differently on the body (T_body_camera)"
    if other.time_shift_s and abs(taken.time_shift_s - other.time_shift_s) > SHIFTS_APART_MAX_S:
        return f"their clocks are {taken.time_shift_s:g} s and {other.time_shift_s:g} s off the body's"
    return None


def _drawn_apart_px(a: CameraModel, b: CameraModel) -> float:
    """How far apart two cameras draw a point at most, in rays that the first one sees as far as both can draw them."""
    tan = min(GRID_TAN_MAX, GRID_REACH * a.width / 2 / a.fx), min(GRID_TAN_MAX, GRID_REACH * a.height / 2 / a.fy)
    x, y = np.meshgrid(np.linspace(-tan[0], tan[0], GRID), np.linspace(-tan[1], tan[1], GRID))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(GRID * GRID)], axis=1)
    (first, drawn), (second, drawn_too) = _drawn(a, rays), _drawn(b, rays)
    both = drawn & drawn_too
    return float(np.abs(first - second)[both].max()) if both.any() else float("inf")


def _drawn(camera: CameraModel, rays: Float) -> tuple[Float, NDArray[np.bool_]]:
    """Pixels (N, 2) in which a camera draws rays (N, 3), and whether it draws them at all (N,)."""
    import cv2

    if camera.kind is not LensKind.PINHOLE:
        return camera.project(rays)
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K(), np.array(camera.distortion))
    return np.asarray(pixels[:, 0], dtype=float), np.ones(len(rays), dtype=bool)


def see_one_trajectory(
    taken: Trajectory | None,
    files: Sequence[Path],
    form: str | None,
    stamps_s: Sequence[float],
    way_out: str = ", or name it with flocc dataset convert --odometry",
) -> None:
    """See that trajectories of one name and meaning tell one motion.

    Args:
        taken: What was read of the first file.
        files: That one and the others, in the order in which they count.
        form: Of the files; None finds out.
        stamps_s: Of the images, for poses that have no stamps.
        way_out: What the sentence ends in.

    Raises:
        DatasetError: One tells another motion.
    """
    if taken is None or len(files) < 2:
        return
    for file in files[1:]:
        if _rank(file) != _rank(files[0]):
            continue
        try:
            other, _ = read_trajectory(file, form, stamps_s)
        except FloccError:  # it is told that it was not taken
            continue
        if (how := motions_differ(taken, other)) is not None:
            raise DatasetError(
                f"{files[0]} and {file.name} tell different motions ({how}): keep the one that counts{way_out}"
            )


def _rank(file: Path) -> str:
    """What a file's name says of it: names of one rank mean the same thing, and one of another rank is told."""
    stem = file.stem.lower()
    return "odometry" if stem in NAMED_ODOMETRY else "perhaps" if stem in (*ODOMETRY_STEMS, *TRUTH_STEMS) else stem


def motions_differ(taken: Trajectory, other: Trajectory) -> str | None:
    """How two trajectories differ as motions from their first common time on, or None where they tell one motion."""
    chosen = sorted({round(k) for k in np.linspace(0, len(other) - 1, SAMPLED_MAX)})
    pairs = [
        (float(other.stamps_s[k]), T, other.T_fixed_body[k])
        for k in chosen
        if (T := taken.at(float(other.stamps_s[k]))) is not None
    ]
    if len(pairs) < 2:
        return "they have no time in common"
    (first_s, T_taken, T_other), length_m = pairs[0], taken.length_m()
    for stamp_s, T_a, T_b in pairs[1:]:
        a, b = inverse(T_taken) @ T_a, inverse(T_other) @ T_b
        moved_m = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
        turned = float(np.abs(a[:3, :3] - b[:3, :3]).max())
        if moved_m > MOVED_APART_MAX_M + MOVED_APART_RATIO * length_m or turned > TURNED_APART_MAX:
            degrees = np.degrees(np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1, 1)))
            return f"{moved_m:.2f} m and {degrees:.0f} degrees apart after {stamp_s - first_s:.1f} s"
    return None
