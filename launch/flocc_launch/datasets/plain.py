"""A plain folder: images, a TUM trajectory, intrinsics; the form in which people have data of their own.

Names vary, so several are taken; what was looked for is said where nothing fits.
"""

import re
from itertools import pairwise
from pathlib import Path

from flocc_agent.runtime.trajectory import Trajectory, read_tum
from flocc_launch.datasets.files import camera_file, image_files, listed_images, some, unequal
from flocc_launch.datasets.source import DatasetError, Source

Stamped = tuple[tuple[float, Path], ...]

ODOMETRY_STEMS = ("odometry", "trajectory", "poses", "vio")
TRUTH_STEMS = ("groundtruth", "gt", "ground_truth")
LISTINGS = ("images.txt", "rgb.txt")
UNITS_S = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
DIGITS = {"seconds": range(9, 12), "milliseconds": range(12, 15), "microseconds": range(15, 18)}
DIGITS_MAX = 20


def is_plain(path: Path) -> bool:
    """Whether a folder holds images of its own: in `images/`, in a list, or beside a trajectory."""
    if (path / "images").is_dir() or (path / "images.txt").exists():
        return True
    return path.is_dir() and bool(image_files(path)) and (_odometry(path) or _truth(path)) is not None


def read_plain(path: Path) -> Source:
    """Read a folder of images with a TUM trajectory and intrinsics.

    Stamps come from `images.txt` (or `rgb.txt`), else from file names, else from the trajectory where it has as many
    poses as there are images. In a name the last number is the stamp: seconds with a decimal point, and otherwise by
    its digits, as times since 1970 have them: 9 to 11 are seconds, 12 to 14 milliseconds, 15 to 17 microseconds, 18 to
    20 nanoseconds.
    """
    odometry, truth = _odometry(path), _truth(path)
    listing = next((path / name for name in LISTINGS if (path / name).exists()), None)
    if listing is not None:
        images, faults = listed_images(listing)
    else:
        images, faults = _stamped_by_name(path, odometry or truth)
    return Source(path, "plain", images, camera_file(path), odometry=odometry, truth=truth, faults=faults)


def expected_files(path: Path) -> str:
    """What a trajectory would have been called, for an error's sentence."""
    return f"{', '.join((*ODOMETRY_STEMS, *TRUTH_STEMS))} (.tum or .txt) was looked for in {path}"


def time_unit(duration_s: float, reference_s: float) -> str | None:
    """The unit that a duration in wrong seconds seems to be in, given a true one of about the same length."""
    if reference_s <= 0 or duration_s <= 0:
        return None
    close = (name for name, unit_s in UNITS_S.items() if 1 / 3 < duration_s * unit_s / reference_s < 3)
    return next(close, None)


def _odometry(path: Path) -> Trajectory | None:
    return _first_trajectory(path, ODOMETRY_STEMS)


def _truth(path: Path) -> Trajectory | None:
    return _first_trajectory(path, TRUTH_STEMS)


def _first_trajectory(path: Path, stems: tuple[str, ...]) -> Trajectory | None:
    names = [f"{stem}{suffix}" for stem in stems for suffix in (".tum", ".txt")]
    file = next((path / name for name in names if (path / name).exists()), None)
    return read_tum(file) if file is not None else None


def _stamped_by_name(path: Path, trajectory: Trajectory | None) -> tuple[Stamped, tuple[str, ...]]:
    folder = path / "images" if (path / "images").is_dir() else path
    files = sorted(image_files(folder), key=_natural)
    some(tuple(files), folder)
    stamps_s = [_stamp_of_name(file.stem) for file in files]
    if all(stamp_s is not None for stamp_s in stamps_s):
        pairs = sorted((stamp_s, file) for stamp_s, file in zip(stamps_s, files, strict=True) if stamp_s is not None)
        twins = next((b for a, b in pairwise(pairs) if a[0] == b[0]), None)
        if twins is not None:
            raise DatasetError(f"{twins[1]}: has the stamp of another image, {twins[0]:.6f} s")
        return tuple(pairs), ()
    if trajectory is None:
        raise DatasetError(
            f"{folder}: the images have no stamps ({files[0].name}): name them by seconds, or list them in "
            f"{path / 'images.txt'} with lines 'stamp_s relative/path'"
        )
    images = tuple(zip((float(stamp_s) for stamp_s in trajectory.stamps_s), files, strict=False))
    faults = unequal(folder, len(files), path, len(files), len(trajectory))
    return images, tuple(f"{fault}; name images by their stamps to say which belongs to which" for fault in faults)


def _natural(file: Path) -> tuple[object, ...]:
    """Order in which frame2 comes before frame10."""
    return tuple((0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", file.stem))


def _stamp_of_name(stem: str) -> float | None:
    """Seconds that a file's name says, or None where its number is only a number."""
    numbers = re.findall(r"\d+\.\d+|\d+", stem)
    if not numbers:
        return None
    if "." in numbers[-1]:
        return float(numbers[-1])
    digits = len(numbers[-1])
    if not DIGITS["seconds"].start <= digits <= DIGITS_MAX:
        return None
    unit = next((name for name, lengths in DIGITS.items() if digits in lengths), "nanoseconds")
    return int(numbers[-1]) * UNITS_S[unit]
