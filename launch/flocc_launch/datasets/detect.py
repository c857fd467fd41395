"""Which data set a folder is, and the reader for it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from flocc_launch.datasets.bag_reader import is_bag
from flocc_launch.datasets.folders import (
    read_euroc,
    read_kitti,
    read_plain,
    read_sevenscenes,
    read_tum_rgbd,
)
from flocc_launch.datasets.intrinsics import read_lens
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
    if (path / "mav0").is_dir() or (path / "cam0" / "data").is_dir():
        return "euroc"
    if any((path / name).is_dir() for name in ("image_0", "image_l", "image_2")):
        return "kitti"
    if any(path.glob("frame-*.color.*")):
        return "7scenes"
    if (path / "rgb.txt").exists() and (path / "groundtruth.txt").exists():
        return "tum"
    if (path / "images").is_dir() or (path / "images.txt").exists():
        return "plain"
    if is_bag(path):
        raise DatasetError(f"{path}: is a bag; make a recording of it first: flocc dataset convert")
    raise DatasetError(f"{path}: is none of the known data sets ({', '.join(READERS)})")


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
    return source if camera is None else replace(source, lens=read_lens(camera))
