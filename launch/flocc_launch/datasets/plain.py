"""A plain folder: images, a TUM trajectory, intrinsics; the form in which people have data of their own.

Names vary, so several are taken; what was looked for is said where nothing fits.
"""

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from flocc_agent.runtime.columns import UNITS_S
from flocc_agent.runtime.stamp_units import are_counted, plausible_units
from flocc_agent.runtime.text_tables import is_number, text_lines
from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.files import camera_file, camera_files, image_files, listed_images, some, unequal
from flocc_launch.datasets.source import DatasetError, Lens, Source
from flocc_launch.datasets.stamped_names import stamps_of_names

Stamped = tuple[tuple[float, Path], ...]

NAMED_ODOMETRY = ("odometry", "odom", "vio")
"""Names of files that say that they are odometry: those count before a trajectory or poses, which may be anything."""
ODOMETRY_STEMS = (
    *NAMED_ODOMETRY, "trajectory", "poses", "camera_poses", "arcore_poses", "arkit_poses", "arcore", "arkit",
    "arposes",
)  # fmt: skip
TRUTH_STEMS = ("groundtruth", "gt", "ground_truth")
LISTINGS = ("images.txt", "rgb.txt")
IMAGE_FOLDERS = (
    "images", "rgb", "image", "color", "cam0", "left", "frames", "photos", "pictures", "img", "imgs", "dcim", "camera",
)  # fmt: skip
TIMES = ("times.txt", "timestamps.txt", "times.csv", "timestamps.csv")
"""Stamps of images whose names only count, one a line, or behind the image's number or before or behind its name."""
STAMPS_APART_MAX_S = 1e-3
OF_PHONES = ("arcore", "arkit", "arposes")
PHONE_AXES = "T_body_camera = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]"
BESIDE_READ = ("plain", "euroc", "kitti-raw")
"""Data sets whose reader takes any trajectory beside them; of others only what is called odometry counts."""
TRAJECTORY_SUFFIXES = (".tum", ".txt", ".csv")
BY_ORDER = "the names of the images were taken to count them only: each has the stamp of the pose in the same place"
UNUSUAL = ("dates, read as UTC", "seconds and their fraction", *(f"{name} gives them" for name in TIMES))
"""Readings of names that a note tells."""


def is_plain(path: Path) -> bool:
    """Whether a folder holds images of its own: in `images/`, in a list, or beside a trajectory."""
    if (path / "images").is_dir() or (path / "images.txt").exists():
        return True
    return path.is_dir() and (bool(image_files(path)) or _image_folder(path) != path) and has_trajectory(path)


def read_plain(path: Path, form: str | None = None) -> Source:
    """Read a folder of images with a trajectory and intrinsics.

    Stamps come from `images.txt` (or `rgb.txt`), else from file names (`stamped_names`), else from the trajectory where
    it has as many poses as there are images. A trajectory without stamps (KITTI's matrices) takes those of the images.

    Args:
        path: The folder.
        form: Of its trajectories; None finds out.
    """
    listing = next((path / name for name in LISTINGS if (path / name).exists()), None)
    images, faults, how = _named_images(path) if listing is None else (*listed_images(listing), "")
    stamps_s = [stamp_s for stamp_s, _ in images] if images else None
    odometry, truth, notes = trajectories_beside(path, form, stamps_s)
    by_order = images is None
    if images is None:
        images, faults = _stamped_by_order(path, odometry or truth)
    read_how = (f"{path}: the names of the images say their stamps as {how}",) if how in UNUSUAL else ()
    read_how = (f"{path}: {BY_ORDER}",) if by_order else read_how
    lens = camera_file(path, images)
    _see_phone_axes(path, lens)
    notes = (*read_how, *notes)
    return Source(
        path, "plain", images, lens, odometry=odometry, truth=truth, faults=faults, notes=notes,
        is_posed_by_image=by_order, calibrations=tuple(camera_files(path)),
    )  # fmt: skip


def _see_phone_axes(path: Path, lens: Lens | None) -> None:
    """See that the axes of a phone's camera are said, which are those of OpenGL.

    Raises:
        DatasetError: The trajectory is ARCore's or ARKit's by its name, and the calibration says no mounting.
    """
    file = taken_file(path, ODOMETRY_STEMS)
    if file is None or lens is None or not file.stem.lower().startswith(OF_PHONES):
        return
    if np.array_equal(lens.T_body_camera, np.eye(4)):
        raise DatasetError(
            f"{file}: poses of ARCore and ARKit are of a camera whose y points up and z backwards; write {PHONE_AXES} "
            f"into the calibration, or call the file odometry{file.suffix} if it has other axes"
        )


def trajectories_beside(
    path: Path, form: str | None = None, stamps_s: list[float] | None = None
) -> tuple[Trajectory | None, Trajectory | None, tuple[str, ...]]:
    """Odometry and ground truth of a folder under one of the plain names, and what was left out of them."""
    odometry, notes = _first_trajectory(path, ODOMETRY_STEMS, form, stamps_s)
    truth, truth_notes = _first_trajectory(path, TRUTH_STEMS, form, stamps_s)
    return odometry, truth, (*notes, *truth_notes)


def odometry_stems(format_name: str) -> tuple[str, ...]:
    """Names of files that are taken as odometry beside a data set of a format."""
    return ODOMETRY_STEMS if format_name in BESIDE_READ else NAMED_ODOMETRY


def expected_files(path: Path) -> str:
    """What a trajectory would have been called, for an error's sentence."""
    return f"{', '.join((*ODOMETRY_STEMS, *TRUTH_STEMS))} (.tum, .txt or .csv) was looked for in {path}"


def taken_file(path: Path, stems: tuple[str, ...]) -> Path | None:
    """The trajectory that is read of a folder under one of the names, or None."""
    return next(iter(trajectory_files(path, stems)), None)


def has_trajectory(path: Path) -> bool:
    """Whether a trajectory of one of the plain names stands in a folder."""
    return any(trajectory_files(path, stems) for stems in (ODOMETRY_STEMS, TRUTH_STEMS))


def trajectory_files(path: Path, stems: tuple[str, ...]) -> list[Path]:
    """Files of one of the names, whatever their capitals; a link to nowhere is one, and its reader says so."""
    there = {entry.name.lower(): entry for entry in sorted(path.iterdir())} if path.is_dir() else {}
    names = [f"{stem}{suffix}" for stem in stems for suffix in TRAJECTORY_SUFFIXES]
    return [there[name] for name in names if name in there and not there[name].is_dir()]


def _first_trajectory(
    path: Path, stems: tuple[str, ...], form: str | None, stamps_s: list[float] | None
) -> tuple[Trajectory | None, tuple[str, ...]]:
    files = trajectory_files(path, stems)
    if not files:
        return None, ()
    trajectory, notes = read_trajectory(files[0], form, stamps_s)
    others = ", ".join(file.name for file in files[1:])
    return trajectory, (*notes, f"{files[0]}: was taken as the {stems[0]}, not {others}") if others else notes


def _image_folder(path: Path) -> Path:
    """Where the images are: in a folder of a usual name, or in the only folder inside of it (images/cam0).

    Capitals do not matter (`DCIM/Camera`, `RGB`); hidden folders (`DCIM/.thumbnails`) are none.
    """
    there = {entry.name.lower(): entry for entry in sorted(path.iterdir()) if entry.is_dir()} if path.is_dir() else {}
    folder = next((there[name] for name in IMAGE_FOLDERS if name in there), path)
    if folder == path or image_files(folder):
        return folder
    inside = [entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith(".")]
    return inside[0] if len(inside) == 1 else folder


def _named_images(path: Path) -> tuple[Stamped | None, tuple[str, ...], str]:
    """Images with the stamps that their names say, or None where names only count."""
    folder = _image_folder(path)
    files = some(tuple(image_files(folder)), folder)
    stamps_s, how = stamps_of_names([file.stem for file in files], folder)
    times = [path / name for name in TIMES if (path / name).is_file()]
    if stamps_s is None and times:
        stamps_s, how = stamps_of_times(times[0], files), f"{times[0].name} gives them"
        _see_one_time(times, stamps_s, files)
    if stamps_s is None:
        return None, (), how
    pairs = sorted(zip(stamps_s, files, strict=True))
    twins = next((b for a, b in pairwise(pairs) if a[0] == b[0]), None)
    if twins is not None:
        raise DatasetError(
            f"{twins[1]}: has the stamp of another image, {twins[0]:.6f} s; a folder holds the images of one camera"
        )
    return tuple(pairs), (), how


def _see_one_time(times: Sequence[Path], stamps_s: Sequence[float], files: Sequence[Path]) -> None:
    """See that other files of stamps that are as many say the same.

    Raises:
        DatasetError: One does not.
    """
    for other in times[1:]:
        try:
            said_s = stamps_of_times(other, files)
        except DatasetError:  # of something else: it is told that it was not used
            continue
        if not np.allclose(said_s, stamps_s, rtol=0.0, atol=STAMPS_APART_MAX_S):
            raise DatasetError(
                f"{times[0]} and {other.name} give the images different stamps, {stamps_s[0]:.6f} s and "
                f"{said_s[0]:.6f} s to the first: keep the one that counts"
            )


def stamps_of_times(path: Path, files: Sequence[Path]) -> list[float]:
    """Seconds of images whose names only count, by a file with a line for each.

    A line is a stamp, or holds one beside the image's number or name; what is behind (an exposure) is not used.

    Raises:
        DatasetError: Lines are of another form, not as many as images, time goes backwards, or their unit is not clear.
    """
    rows = [re.split(r"[\s,;]+", text.strip(",; ")) for _, text in text_lines(path)]
    if rows and not any(map(is_number, rows[0])):
        rows = rows[1:]
    if len(rows) != len(files):
        raise DatasetError(
            f"{path}: has {len(rows)} stamps, but {files[0].parent} has {len(files)} images; list them in images.txt "
            "with lines 'stamp_s relative/path'"
        )
    names = [{file.name, _number(file.stem)} for file in files]
    named = next((k for k in (0, 1) if _is_of_names([row[k : k + 1] for row in rows], names)), None)
    column = 0 if named is None or len(rows[0]) == 1 else 1 - named
    if not all(len(row) > column and is_number(row[column]) for row in rows) or (named is None and len(rows[0]) > 1):
        raise DatasetError(f"{path}: its lines must be stamps, or stamps beside the numbers or names of the images")
    stamps = np.array([float(row[column]) for row in rows])
    units = plausible_units(stamps)
    if len(units) != 1 or are_counted(stamps):
        readings = " or ".join(units) or "no unit of time"
        raise DatasetError(f"{path}: stamps can be {readings}; list the images in images.txt with seconds")
    if np.any(np.diff(stamps) <= 0):
        line = int(np.argmax(np.diff(stamps) <= 0)) + 2
        raise DatasetError(f"{path}:{line}: time goes backwards or stands still")
    per_s = round(1 / UNITS_S[units[0]])
    return [float(row[column]) / per_s for row in rows]


def _is_of_names(cells: Sequence[Sequence[str]], names: Sequence[set[str]]) -> bool:
    """Whether a column holds the numbers or names of images; a counting column is one of each image's number."""
    return all(cell and _number(cell[0].rpartition("/")[2]) in name for cell, name in zip(cells, names, strict=True))


def _number(word: str) -> str:
    """A number without leading zeros; any other word as it is."""
    return str(int(word)) if word.isdecimal() else word


def _stamped_by_order(path: Path, trajectory: Trajectory | None) -> tuple[Stamped, tuple[str, ...]]:
    """Numbered images, with the stamps of as many poses."""
    folder = _image_folder(path)
    files = image_files(folder)
    if trajectory is None:
        raise DatasetError(
            f"{folder}: the images have no stamps ({files[0].name}): name them by seconds, or list them in "
            f"{path / 'images.txt'} with lines 'stamp_s relative/path'"
        )
    shapes = sorted({re.sub(r"\d+", "#", file.stem) for file in files})
    if len(shapes) > 1:
        raise DatasetError(
            f"{folder}: the names of the images neither say stamps that flocc reads nor count alike "
            f"({files[0].name}, {files[-1].name}), so that nothing says which pose is of which; list them in "
            f"{path / 'images.txt'} with lines 'stamp_s relative/path'"
        )
    images = tuple(zip((float(stamp_s) for stamp_s in trajectory.stamps_s), files, strict=False))
    faults = unequal(folder, len(files), path, len(files), len(trajectory))
    return images, tuple(f"{fault}; name images by their stamps to say which belongs to which" for fault in faults)
