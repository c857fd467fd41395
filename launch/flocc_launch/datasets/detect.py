"""Which data set a folder is, and the reader for it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from flocc_agent.runtime.trajectory import NEAR_S, Trajectory
from flocc_launch.datasets.bag_reader import is_bag
from flocc_launch.datasets.folders import (
    read_euroc,
    read_kitti,
    read_sevenscenes,
    read_tum_rgbd,
)
from flocc_launch.datasets.intrinsics import read_lens
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
    if (path / "mav0").is_dir() or (path / "cam0" / "data").is_dir():
        return "euroc"
    if any((path / name).is_dir() for name in ("image_0", "image_l", "image_2")):
        return "kitti"
    if any(path.glob("frame-*.color.*")):
        return "7scenes"
    if (path / "rgb.txt").exists() and (path / "groundtruth.txt").exists():
        return "tum"
    if is_bag(path):
        raise DatasetError(f"{path}: is a bag; make a recording of it first: flocc dataset convert")
    if is_plain(path):
        return "plain"
    raise DatasetError(
        f"{path}: is none of the known data sets ({', '.join(READERS)}); a plain one has images/, a trajectory "
        "(odometry.tum or groundtruth.tum) and camera.yaml"
    )


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
    return source if camera is None else replace(source, lens=read_lens(camera))


def check_times(source: Source, trajectory: Trajectory, where: Path | None = None) -> None:
    """See that a trajectory is of the images' time.

    Raises:
        DatasetError: No image lies within it; the sentence says which unit its stamps seem to be in.
    """
    first_s, last_s = float(trajectory.stamps_s[0]), float(trajectory.stamps_s[-1])
    if any(first_s - NEAR_S <= stamp_s <= last_s + NEAR_S for stamp_s, _ in source.images):
        return
    from_s, to_s = source.images[0][0], source.images[-1][0]
    unit = time_unit(last_s - first_s, to_s - from_s)
    seconds = unit in (None, "seconds")
    raise DatasetError(
        f"{where or source.path}: the trajectory is from {first_s:.6g} s to {last_s:.6g} s, but the images are from "
        f"{from_s:.6g} s to {to_s:.6g} s, so none of them has a pose; "
        + ("both must be of one clock" if seconds else f"the trajectory's stamps look like {unit}, not seconds")
    )
