"""A plain folder: images, a TUM trajectory, intrinsics; the form in which people have data of their own.

Names vary, so several are taken; what was looked for is said where nothing fits.
"""

from itertools import pairwise
from pathlib import Path

from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.files import camera_file, image_files, listed_images, some, unequal
from flocc_launch.datasets.source import DatasetError, Source
from flocc_launch.datasets.stamped_names import stamps_of_names

Stamped = tuple[tuple[float, Path], ...]

ODOMETRY_STEMS = ("odometry", "trajectory", "poses", "vio")
TRUTH_STEMS = ("groundtruth", "gt", "ground_truth")
LISTINGS = ("images.txt", "rgb.txt")
IMAGE_FOLDERS = ("images", "rgb", "image", "color", "cam0", "left")
TRAJECTORY_SUFFIXES = (".tum", ".txt", ".csv")
UNUSUAL = ("dates, read as UTC", "seconds and their fraction")
"""Readings of names that a note tells."""


def is_plain(path: Path) -> bool:
    """Whether a folder holds images of its own: in `images/`, in a list, or beside a trajectory."""
    if (path / "images").is_dir() or (path / "images.txt").exists():
        return True
    return path.is_dir() and (bool(image_files(path)) or _image_folder(path) != path) and _has_trajectory(path)


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
    lens = camera_file(path, images)
    notes = (*read_how, *notes)
    return Source(
        path, "plain", images, lens, odometry=odometry, truth=truth, faults=faults, notes=notes,
        is_posed_by_image=by_order,
    )  # fmt: skip


def trajectories_beside(
    path: Path, form: str | None = None, stamps_s: list[float] | None = None
) -> tuple[Trajectory | None, Trajectory | None, tuple[str, ...]]:
    """Odometry and ground truth of a folder under one of the plain names, and what was left out of them."""
    odometry, notes = _first_trajectory(path, ODOMETRY_STEMS, form, stamps_s)
    truth, truth_notes = _first_trajectory(path, TRUTH_STEMS, form, stamps_s)
    return odometry, truth, (*notes, *truth_notes)


def expected_files(path: Path) -> str:
    """What a trajectory would have been called, for an error's sentence."""
    return f"{', '.join((*ODOMETRY_STEMS, *TRUTH_STEMS))} (.tum, .txt or .csv) was looked for in {path}"


def taken_file(path: Path, stems: tuple[str, ...]) -> Path | None:
    """The trajectory that is read of a folder under one of the names, or None."""
    return next(iter(_trajectory_files(path, stems)), None)


def _has_trajectory(path: Path) -> bool:
    return any(_trajectory_files(path, stems) for stems in (ODOMETRY_STEMS, TRUTH_STEMS))


def _trajectory_files(path: Path, stems: tuple[str, ...]) -> list[Path]:
    """Files of one of the names, whatever their capitals; a link to nowhere is one, and its reader says so."""
    there = {entry.name.lower(): entry for entry in sorted(path.iterdir())} if path.is_dir() else {}
    names = [f"{stem}{suffix}" for stem in stems for suffix in TRAJECTORY_SUFFIXES]
    return [there[name] for name in names if name in there and not there[name].is_dir()]


def _first_trajectory(
    path: Path, stems: tuple[str, ...], form: str | None, stamps_s: list[float] | None
) -> tuple[Trajectory | None, tuple[str, ...]]:
    files = _trajectory_files(path, stems)
    if not files:
        return None, ()
    trajectory, notes = read_trajectory(files[0], form, stamps_s)
    others = ", ".join(file.name for file in files[1:])
    return trajectory, (*notes, f"{files[0]}: was taken as the {stems[0]}, not {others}") if others else notes


def _image_folder(path: Path) -> Path:
    """Where the images are: in a folder of a usual name, or in the only folder inside of it (images/cam0)."""
    folder = next((path / name for name in IMAGE_FOLDERS if (path / name).is_dir()), path)
    if folder == path or image_files(folder):
        return folder
    inside = [entry for entry in folder.iterdir() if entry.is_dir()]
    return inside[0] if len(inside) == 1 else folder


def _named_images(path: Path) -> tuple[Stamped | None, tuple[str, ...], str]:
    """Images with the stamps that their names say, or None where names only count."""
    folder = _image_folder(path)
    files = some(tuple(image_files(folder)), folder)
    stamps_s, how = stamps_of_names([file.stem for file in files], folder)
    if stamps_s is None:
        return None, (), how
    pairs = sorted(zip(stamps_s, files, strict=True))
    twins = next((b for a, b in pairwise(pairs) if a[0] == b[0]), None)
    if twins is not None:
        raise DatasetError(
            f"{twins[1]}: has the stamp of another image, {twins[0]:.6f} s; a folder holds the images of one camera"
        )
    return tuple(pairs), (), how


def _stamped_by_order(path: Path, trajectory: Trajectory | None) -> tuple[Stamped, tuple[str, ...]]:
    """Numbered images, with the stamps of as many poses."""
    folder = _image_folder(path)
    files = image_files(folder)
    if trajectory is None:
        raise DatasetError(
            f"{folder}: the images have no stamps ({files[0].name}): name them by seconds, or list them in "
            f"{path / 'images.txt'} with lines 'stamp_s relative/path'"
        )
    images = tuple(zip((float(stamp_s) for stamp_s in trajectory.stamps_s), files, strict=False))
    faults = unequal(folder, len(files), path, len(files), len(trajectory))
    return images, tuple(f"{fault}; name images by their stamps to say which belongs to which" for fault in faults)
