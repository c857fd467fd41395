"""Which data set a folder is, and the reader for it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from flocc_agent.runtime.trajectory import NEAR_S, Trajectory
from flocc_launch.datasets.bag_reader import is_bag
from flocc_launch.datasets.folders import (
    read_euroc,
    read_kitti,
    read_sevenscenes,
    read_tum_rgbd,
)
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.pixels import size_of, usable_images
from flocc_launch.datasets.plain import is_plain, read_plain, time_unit
from flocc_launch.datasets.source import DatasetError, Source

READERS: dict[str, Callable[[Path], Source]] = {
    "euroc": read_euroc,
    "kitti": read_kitti,
    "7scenes": read_sevenscenes,
    "tum": read_tum_rgbd,
    "plain": read_plain,
}


def detect_format(path: Path) -> str:
    """Name the format of a data set by the files that it has.

    Raises:
        DatasetError: Nothing is there, or nothing that a reader knows.
    """
    if not path.exists():
        raise DatasetError(f"{path}: does not exist")
    known = _known_format(path)
    if known is not None:
        return known
    if is_bag(path):
        raise DatasetError(f"{path}: is a bag; make a recording of it first: flocc dataset convert")
    inside = [entry.name for entry in sorted(path.iterdir()) if is_dataset(entry)] if path.is_dir() else []
    raise DatasetError(
        f"{path}: is none of the known data sets ({', '.join(READERS)}); a plain one has images/, a trajectory "
        "(odometry.tum or groundtruth.tum) and camera.yaml"
        + (f"; inside of it, {', '.join(inside[:8])} would be" if inside else "")
    )


def is_dataset(path: Path) -> bool:
    """Whether a reader knows what a folder is."""
    return path.is_dir() and _known_format(path) is not None


def _known_format(path: Path) -> str | None:
    if (path / "mav0").is_dir() or (path / "cam0" / "data").is_dir():
        return "euroc"
    if any((path / name).is_dir() for name in ("image_0", "image_l", "image_2")):
        return "kitti"
    if any(path.glob("frame-*.color.*")):
        return "7scenes"
    if (path / "rgb.txt").exists() and (path / "groundtruth.txt").exists():
        return "tum"
    return "plain" if not is_bag(path) and is_plain(path) else None


def read_source(path: Path, format_name: str | None = None, camera: Path | None = None) -> Source:
    """Read one robot's data set.

    Args:
        path: The folder.
        format_name: One of `READERS`; None detects it.
        camera: Intrinsics, where the folder has none or others are wanted.

    Raises:
        DatasetError: Unknown, or nothing in it can be used.
    """
    name = format_name or detect_format(path)
    if name not in READERS:
        raise DatasetError(f"{path}: the format {name!r} is not known; there are {', '.join(READERS)}")
    source = READERS[name](path)
    for trajectory in (source.odometry, source.truth):
        if trajectory is not None:
            check_times(source, trajectory)
    lens = source.lens if camera is None else read_lens(camera, size_of(source.images))
    return _usable(replace(source, lens=lens))


def _usable(source: Source) -> Source:
    """The source without images that cannot be used, which are counted in a note."""
    lens = source.lens
    size = None if lens is None else (lens.camera.width, lens.camera.height)
    images, notes, levels = usable_images(source.images, size)
    told = (*source.notes, *(lens.notes if lens else ()), *notes)
    return replace(source, images=images, notes=told, levels=levels)


def check_times(source: Source, trajectory: Trajectory, where: Path | None = None) -> None:
    """See that a trajectory is of the images' time.

    Raises:
        DatasetError: No image lies within it; the sentence says which unit its stamps seem to be in.
    """
    first_s, last_s = float(trajectory.stamps_s[0]), float(trajectory.stamps_s[-1])
    if any(first_s - NEAR_S <= stamp_s <= last_s + NEAR_S for stamp_s, _ in source.images):
        return
    from_s, to_s = source.images[0][0], source.images[-1][0]
    raise DatasetError(
        f"{where or source.path}: the trajectory is from {first_s:.3f} s to {last_s:.3f} s, but the images are from "
        f"{from_s:.3f} s to {to_s:.3f} s, so none of them has a pose; " + _what_stamps_look_like(source, trajectory)
    )


def _what_stamps_look_like(source: Source, trajectory: Trajectory) -> str:
    steps_s = np.diff(trajectory.stamps_s)
    if len(trajectory) >= len(source.images) and np.all(steps_s == 1.0):
        return "the trajectory's stamps look like numbers of images, not seconds"
    unit = time_unit(float(np.sum(steps_s)), source.images[-1][0] - source.images[0][0])
    known = unit not in (None, "seconds")
    return f"the trajectory's stamps look like {unit}, not seconds" if known else "both must be of one clock"
