"""KITTI's raw recordings as downloaded: a drive's `image_02/data` and `timestamps.txt`, and the calibration of its day.

The calibration stands in the drive's folder or in the one above.
"""

from pathlib import Path

from flocc_agent.runtime.text_tables import numbered_lines
from flocc_launch.datasets.files import camera_file, camera_files, image_files, image_rows, some, unequal
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.pixels import image_size
from flocc_launch.datasets.plain import trajectories_beside
from flocc_launch.datasets.source import DatasetError, Lens, Source
from flocc_launch.datasets.stamped_names import date_s

CAMERAS = ("image_00", "image_02", "image_01", "image_03")
CALIBRATION = "calib_cam_to_cam.txt"


def image_folder(path: Path) -> Path | None:
    """The first of KITTI's camera folders that is there, or None."""
    return next((path / name for name in CAMERAS if (path / name / "data").is_dir()), None)


def read_kitti_raw(path: Path) -> Source:
    """Read the left grey (or colour) camera of a raw drive; a trajectory stands beside it under one of the plain names.

    Raises:
        DatasetError: No camera folder or image is there, or a stamp is no date.
    """
    folder = image_folder(path)
    if folder is None:
        raise DatasetError(f"{path}: has none of {', '.join(CAMERAS)} with a folder data")
    files = image_files(folder / "data")
    stamps_s = _stamps_s(folder / "timestamps.txt")
    rows = image_rows(files, len(stamps_s))
    images = tuple((stamps_s[row], file) for row, file in zip(rows, files, strict=True) if row < len(stamps_s))
    some(images, folder / "data")
    faults = unequal(folder / "data", len(files), folder / "timestamps.txt", len(stamps_s), len(files))
    odometry, truth, notes = trajectories_beside(path, None, [stamp_s for stamp_s, _ in images])
    if (path / "oxts").is_dir():
        notes = (*notes, f"{path}: oxts (GPS and inertial) is not read; convert it to odometry.tum or groundtruth.tum")
    own = _calibration(path, folder.name)
    lens = camera_file(path) or (rectified_lens(own, files[0]) if own is not None and files else None)
    calibrations = (*camera_files(path), *([own] if own is not None else []))
    return Source(
        path, "kitti-raw", images, lens, odometry=odometry, truth=truth, faults=faults, notes=notes,
        calibrations=calibrations,
    )  # fmt: skip


def _stamps_s(path: Path) -> list[float]:
    """Seconds since 1970 of lines `2011-09-26 13:02:25.951199337`, read as UTC."""
    stamps_s: list[float] = []
    for line, text in numbered_lines(path):
        stamp_s = date_s(text)
        if stamp_s is None:
            raise DatasetError(
                f"{path}:{line}: must be a date such as 2011-09-26 13:02:25.951199337, not {text[:60]!r}"
            )
        if stamps_s and stamp_s <= stamps_s[-1]:
            raise DatasetError(f"{path}:{line}: time goes backwards or stands still at {text[:60]}")
        stamps_s.append(stamp_s)
    return stamps_s


def _calibration(path: Path, camera: str) -> Path | None:
    """The rectified camera of the day, from the drive's folder or the one above."""
    file = next((p for p in (path / CALIBRATION, path.parent / CALIBRATION) if p.exists()), None)
    return None if file is None else rectified(file, camera[-2:])


def rectified(file: Path, number: str) -> Path:
    """A calibration of KITTI's and its row `P_rect_NN`, or `PN`."""
    return file.with_name(f"{file.name}#P{int(number)}")


def rectified_lens(calibration: Path, image: Path) -> Lens:
    """Intrinsics of a row of a calibration (`rectified`), and where that camera is in camera 0.

    Raises:
        DatasetError: There is no such row of 12 numbers.
    """
    return read_lens(calibration, image_size(image))
