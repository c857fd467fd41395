"""What the readers of folders share: lists of images, the files in a folder, a camera beside them."""

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from flocc_agent.runtime.columns import UNITS_S
from flocc_agent.runtime.stamp_units import since_1970
from flocc_agent.runtime.text_tables import is_number, number_lines, text_lines
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.pixels import size_of
from flocc_launch.datasets.source import DatasetError, Lens

T = TypeVar("T")

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".pnm", ".bmp", ".tif", ".tiff", ".webp")
CAMERA_FILES = (
    "camera.toml", "camera.yaml", "camera.yml", "calibration.yaml", "calibration.yml", "intrinsics.yaml",
    "intrinsics.yml", "sensor.yaml", "camera_info.yaml", "camchain.yaml", "ost.yaml", "camera.json", "calibration.json",
    "intrinsics.json", "cameras.txt", "camera.txt", "intrinsics.txt", "calibration.txt", "ost.txt", "camera_matrix.csv",
)  # fmt: skip
CAMERA_SUFFIXES = (".yaml", ".yml", ".json", ".txt", ".xml", ".toml", ".cfg", ".ini", ".conf")
PERHAPS_CAMERA = re.compile(r"calib|camera|intrin|^cam\d*$|^k$|sensors?$|^ost$")


def unequal(folder: Path, images: int, stamps_file: Path, stamps: int, poses: int) -> tuple[str, ...]:
    """Faults of a folder whose images, stamps and poses are not equally many; none where they are."""
    if images == poses == stamps:
        return ()
    if images == stamps:
        return (f"{folder}: has {images} images, but the trajectory has {poses} poses",)
    return (f"{folder}: has {images} images, but {stamps_file} has {stamps} stamps",)


def listed_images(path: Path, folder: Path | None = None) -> tuple[tuple[tuple[float, Path], ...], tuple[str, ...]]:
    """Images of a list with lines `stamp_s relative/path`, and a fault where some are missing.

    Args:
        path: The list.
        folder: What names are relative to; None is that of the list.

    Raises:
        DatasetError: A line is of another form, time goes backwards, or no image is there.
    """
    images: list[tuple[float, Path]] = []
    missing = []
    for line, text in text_lines(path):
        try:
            stamp, name = re.split(r"[\s,;]+", text, maxsplit=1)
            stamp_s, file = seconds_of(float(stamp)), listed_file(folder or path.parent, name.strip())
        except ValueError:
            raise DatasetError(f"{path}:{line}: must be 'stamp_s relative/path', not {text[:80]!r}") from None
        if images and stamp_s <= images[-1][0]:
            raise DatasetError(f"{path}:{line}: time goes backwards, from {images[-1][0]:.6f} s to {stamp_s:.6f} s")
        if file is not None:
            images.append((stamp_s, file))
        else:
            missing.append(f"{path}:{line}: the image {(folder or path.parent) / name.strip()} does not exist")
    faults = tuple(missing[:1]) if len(missing) < 2 else (f"{missing[0]} (and {len(missing) - 1} others)",)
    if faults and not images:
        raise DatasetError(faults[0])
    return some(tuple(images), path), faults


def seconds_of(stamp: float) -> float:
    """A stamp of a list in seconds; one since 1970 may be in another unit, which its size says."""
    return stamp * UNITS_S[since_1970(stamp) or "seconds"]


def increasing_stamps_s(path: Path) -> list[float]:
    """Seconds of a file with one stamp a line.

    Raises:
        DatasetError: Time goes backwards or stands still, so that nobody knows which image is of which time.
    """
    stamps_s: list[float] = []
    for line, values in number_lines(path, 1):
        if stamps_s and not values[0] > stamps_s[-1]:
            raise DatasetError(f"{path}:{line}: time goes backwards or stands still at {values[0]:.6f} s")
        stamps_s.append(values[0])
    return stamps_s


def image_files(folder: Path) -> list[Path]:
    """Image files of a folder, in the order of the numbers in their names.

    Raises:
        DatasetError: It is no folder.
    """
    if not folder.is_dir():
        raise DatasetError(f"{folder}: is not a folder")
    files = (f for f in folder.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES and not f.name.startswith("."))
    return sorted(files, key=natural)


def natural(file: Path) -> tuple[object, ...]:
    """Order in which frame2 comes before frame10."""
    parts = re.split(r"(\d+)", str(file.with_suffix("")))
    return (*((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts), (1, 0, file.suffix))


def image_numbers(files: Sequence[Path]) -> list[int]:
    """Numbers that are the names of images; empty where not all names are numbers."""
    numbers = [int(file.stem) for file in files if file.stem.isdecimal()]
    return numbers if len(numbers) == len(files) else []


def image_rows(files: Sequence[Path], rows: int) -> Sequence[int]:
    """Which row of a table each image belongs to: that of its number where images are missing, else one by one."""
    numbers = image_numbers(files)
    by_number = 0 < len(numbers) < rows and max(numbers) < rows
    return numbers if by_number else range(len(files))


def listed_file(folder: Path, name: str) -> Path | None:
    """A file that a list names, also as Windows, macOS or an association of colour and depth write it."""
    words = name.split()
    names = [name, name.replace("\\", "/"), *(unicodedata.normalize(form, name) for form in ("NFC", "NFD"))]
    names += words[:1] if len(words) == 3 and is_number(words[1]) else []
    return next((file for each in names if (file := folder / each).is_file()), None)


def some(images: tuple[T, ...], where: Path) -> tuple[T, ...]:
    """The images, of which there is at least one.

    Raises:
        DatasetError: There is none.
    """
    if not images:
        raise DatasetError(f"{where}: no image was found{_what_is_there(where)}")
    return images


def _what_is_there(where: Path) -> str:
    """What a folder without images holds, and what an image would be."""
    if not where.is_dir():
        return ""
    entries = [entry for entry in sorted(where.iterdir()) if not entry.name.startswith(".")]
    kinds = Counter(entry.suffix or "nameless" for entry in entries if entry.is_file())
    told = [f"{count} {kind} file{'s' * (count > 1)}" for kind, count in kinds.most_common(4)]
    told += [f"{entry.name}/" for entry in entries if entry.is_dir()][:4]
    read = ", ".join(IMAGE_SUFFIXES)
    return f"; there is {', '.join(told) or 'nothing'}, but images are {read}: convert them to JPEG or PNG"


def camera_files(path: Path) -> list[Path]:
    """Files of a folder that describe a camera, by their names; the first is taken."""
    chains = sorted(path.glob("*camchain*.yaml"), key=_says_less) if path.is_dir() else []
    files = [path / name for name in CAMERA_FILES if os.path.lexists(path / name)]
    of_kalibr = [file for file in files if file in chains]
    at = files.index(of_kalibr[0]) if of_kalibr else len(files)
    return [*files[:at], *chains, *(file for file in files[at:] if file not in chains)]


def _says_less(chain: Path) -> tuple[bool, str]:
    """Order of Kalibr's chains: those of cameras and IMU say where the cameras sit, those of cameras alone do not."""
    return "imu" not in chain.name.lower(), chain.name


def perhaps_cameras(path: Path) -> list[str]:
    """Names of at most three files of a folder that may describe a camera, though no camera is looked for there."""
    texts = sorted(file for file in path.iterdir() if file.suffix.lower() in CAMERA_SUFFIXES) if path.is_dir() else []
    return [file.name for file in texts if PERHAPS_CAMERA.search(file.stem.lower())][:3]


def camera_file(
    path: Path, images: Sequence[tuple[float, Path]] = (), size: tuple[int, int] | None = None
) -> Lens | None:
    """The camera that a file in a folder describes, or None; a file without a size takes that of the images."""
    files = camera_files(path)
    if not files:
        return None
    lens = read_lens(files[0], size_of(images) if images else size)
    others = ", ".join(file.name for file in files[1:])
    return replace(lens, notes=(*lens.notes, f"{files[0]}: was taken as the camera, not {others}")) if others else lens
