"""Which data set a folder is, and the reader for it."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from flocc_agent.runtime.columns import UNITS_S
from flocc_agent.runtime.trajectory import NEAR_S, Trajectory
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.bag_reader import is_bag
from flocc_launch.datasets.camera_clock import of_pictures, told
from flocc_launch.datasets.folders import (
    read_euroc,
    read_kitti,
    read_sevenscenes,
    read_tum_rgbd,
)
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.kitti_raw import image_folder, read_kitti_raw
from flocc_launch.datasets.names import robot_name
from flocc_launch.datasets.other_kinds import kind_of_file, kind_of_folder, marked_kind
from flocc_launch.datasets.pixels import size_of, usable_images
from flocc_launch.datasets.plain import (
    BESIDE_READ,
    TRUTH_STEMS,
    has_trajectory,
    is_plain,
    odometry_stems,
    read_plain,
    trajectory_files,
)
from flocc_launch.datasets.reconstructions import (
    colmap_folder,
    read_colmap,
    read_replica,
    read_transforms,
)
from flocc_launch.datasets.said_twice import see_one_camera, see_one_trajectory
from flocc_launch.datasets.source import DatasetError, Source
from flocc_launch.datasets.video import files_beside, is_video

CLOCKS_DIFFER = (
    "both must be of one clock: flocc dataset clock measures how far they are apart, and --time-offset mends it"
)
INSIDE_MAX = 200
"""Entries of a folder that is none of the known data sets that are looked at for what its owner may have meant."""
UNREAD_SUFFIXES = (
    ".heic", ".heif", ".avif", ".gif", ".jp2", ".j2k", ".jxl", ".exr", ".hdr", ".dng", ".cr2", ".cr3", ".nef", ".arw",
    ".raf", ".orf", ".rw2", ".gpr", ".insp", ".raw",
)  # fmt: skip
"""Pictures that flocc does not read."""
READERS: dict[str, Callable[[Path], Source]] = {
    "euroc": read_euroc,
    "kitti": read_kitti,
    "kitti-raw": read_kitti_raw,
    "7scenes": read_sevenscenes,
    "tum": read_tum_rgbd,
    "colmap": read_colmap,
    "transforms": read_transforms,
    "replica": read_replica,
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
    marked = marked_kind(path) if known == "plain" and not has_trajectory(path) else None
    if marked is not None:
        raise DatasetError(f"{path}: {marked}")
    if known is not None:
        return known
    if is_bag(path):
        raise DatasetError(f"{path}: is a bag; make a recording of it first: flocc dataset convert")
    if is_video(path):
        raise DatasetError(f"{path}: is a video; make a recording of it first: flocc dataset convert")
    other = kind_of_folder(path) if path.is_dir() else kind_of_file(path)
    if other is not None:
        raise DatasetError(f"{path}: {other}")
    inside = _taken_inside(path)
    raise DatasetError(
        f"{path}: is none of the known data sets ({', '.join(READERS)}); a plain one has images/, a trajectory "
        f"(odometry.tum or groundtruth.tum) and camera.yaml; {_what_is_there(path)}"
        + (f"; inside of it, {', '.join(inside[:8])} would be" if inside else "")
    )


def _taken_inside(path: Path) -> list[str]:
    """What of a folder would be taken by itself, else of its folders (KITTI's `sequences/00`)."""
    for pattern in ("*", "*/*"):
        entries = sorted(islice(path.glob(pattern), INSIDE_MAX)) if path.is_dir() else []
        found = [entry for entry in entries if _is_taken(entry)]
        if found:
            return [str(entry.relative_to(path)) for entry in found]
    return []


def _what_is_there(path: Path) -> str:
    """What a folder holds, so that its owner sees what was not found in it."""
    if not path.is_dir():
        return f"this is a file of type {path.suffix or 'nothing known'}"
    names = [entry.name + "/" * entry.is_dir() for entry in sorted(path.iterdir())]
    more = f" and {len(names) - 6} more" if len(names) > 6 else ""
    return f"there is {', '.join(names[:6])}{more}" if names else "it is empty"


def is_dataset(path: Path) -> bool:
    """Whether a reader knows what a folder is."""
    return path.is_dir() and _known_format(path) is not None


def team_folder(path: Path) -> dict[str, Path]:
    """Data sets, bags and videos in a folder that is none itself, by the robot's name; empty where it is one.

    A robot's folder that is none itself may hold one.

    Raises:
        DatasetError: Two would have one name.
    """
    if not path.is_dir() or is_bag(path) or is_dataset(path) or marked_kind(path) is not None:
        return {}
    found: dict[str, Path] = {}
    for entry in _entries(path):
        taken = [entry] if _is_taken(entry) else _only_taken(entry)
        if not taken:
            continue
        name = robot_name(entry.stem if entry.is_file() else entry.name)
        if name in found:
            raise DatasetError(f"{entry}: its robot would be called {name}, as that of {found[name]}")
        found[name] = taken[0]
    return found


def not_taken(path: Path, team: dict[str, Path]) -> list[str]:
    """What lies in a team's folder and belongs to none of its robots."""
    beside = {file for entry in team.values() if is_video(entry) for file in files_beside(entry)}
    used = {*team.values(), *(entry.parent for entry in team.values()), *beside}
    return [entry.name for entry in _entries(path) if entry not in used]


def _entries(path: Path) -> list[Path]:
    return sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))


def _is_taken(entry: Path) -> bool:
    return is_bag(entry) or is_dataset(entry) or is_video(entry)


def _only_taken(folder: Path) -> list[Path]:
    """The one data set, bag or video of a robot's folder; nothing where it holds several, or is of a known kind."""
    if not folder.is_dir() or marked_kind(folder) is not None:
        return []
    found = [entry for entry in islice(_entries(folder), INSIDE_MAX) if _is_taken(entry)]
    return found if len(found) == 1 else []


def _known_format(path: Path) -> str | None:
    if (path / "mav0").is_dir() or (path / "cam0" / "data").is_dir():
        return "euroc"
    if any((path / name).is_dir() for name in ("image_0", "image_l", "image_2")):
        return "kitti"
    if any(path.glob("frame-*.color.*")):
        return "7scenes"
    if image_folder(path) is not None:
        return "kitti-raw"
    if colmap_folder(path) is not None:
        return "colmap"
    if (path / "transforms.json").exists():
        return "transforms"
    if (path / "results").is_dir() and (path / "traj.txt").exists():
        return "replica"
    if (path / "rgb.txt").exists() and (path / "groundtruth.txt").exists():
        return "tum"
    return "plain" if not is_bag(path) and is_plain(path) else None


def read_source(
    path: Path,
    format_name: str | None = None,
    camera: Path | None = None,
    form: str | None = None,
    time_offset_s: float | None = 0.0,
    odometry: Path | None = None,
) -> Source:
    """Read one robot's data set.

    Args:
        path: The folder.
        format_name: One of `READERS`; None detects it.
        camera: Intrinsics, where the folder has none or others are wanted.
        form: Of the trajectories of a plain folder (`trajectory_text.FORMS`); None finds out.
        time_offset_s: Added to the stamps of trajectories; None leaves them as they are and unchecked.
        odometry: A file that counts in place of the folder's, which then need not agree; it is not read here.

    Raises:
        DatasetError: Unknown, nothing in it can be used, or its files contradict each other.
    """
    name = format_name or detect_format(path)
    if name not in READERS:
        raise DatasetError(f"{path}: the format {name!r} is not known; there are {', '.join(READERS)}")
    source = _read(path, name, form)
    if odometry is None:
        source = _with_odometry_beside(source, form)
    stamps_s = [stamp_s for stamp_s, _ in source.images]
    see_one_trajectory(source.truth, trajectory_files(path, TRUTH_STEMS), form, stamps_s, way_out="")
    if camera is None:
        source = replace(source, notes=(*source.notes, *see_one_camera(source)))
    lens = source.lens if camera is None else read_lens(camera, size_of(source.images))
    source = _of_body_clock(replace(source, lens=lens))
    if time_offset_s:
        moved, truth = (t.later(time_offset_s) if t is not None else None for t in (source.odometry, source.truth))
        source = replace(source, odometry=moved, truth=truth)
    for trajectory in (source.odometry, source.truth):
        if trajectory is not None and time_offset_s is not None:
            check_times(source, trajectory)
    return _usable(source)


def _with_odometry_beside(source: Source, form: str | None) -> Source:
    """The source with the odometry that stands in its folder, whatever data set it is.

    Raises:
        DatasetError: Two files of odometry tell different motions.
    """
    files = trajectory_files(source.path, odometry_stems(source.format))
    stamps_s = [stamp_s for stamp_s, _ in source.images]
    if source.odometry is None and source.format not in BESIDE_READ and files:
        odometry, notes = read_trajectory(files[0], form, stamps_s)
        source = replace(source, odometry=odometry, notes=(*source.notes, *notes))
    see_one_trajectory(source.odometry, files, form, stamps_s)
    return source


def _of_body_clock(source: Source) -> Source:
    """The source with stamps of the body's clock, where the calibration says how far the camera's is off."""
    shift_s = source.lens.time_shift_s if source.lens else 0.0
    if shift_s == 0.0:
        return source
    stamps_s = [stamp_s for stamp_s, _ in source.images]
    trajectories = [each for each in (source.odometry, source.truth) if each is not None]
    of_camera = source.is_posed_by_image or any(of_pictures(each.stamps_s.tolist(), stamps_s) for each in trajectories)
    notes = (*source.notes, f"{source.path}: {told(shift_s, not of_camera)}")
    if of_camera:
        return replace(source, notes=notes)
    images = tuple((stamp_s + shift_s, file) for stamp_s, file in source.images)
    return replace(source, images=images, notes=notes)


def _usable(source: Source) -> Source:
    """The source without images that cannot be used, which are counted in a note."""
    lens = source.lens
    size = None if lens is None else (lens.camera.width, lens.camera.height)
    images, notes, levels = usable_images(source.images, size)
    told = (*source.notes, *(lens.notes if lens else ()), *notes, *_unread(source.images[0][1].parent))
    return replace(source, images=images, notes=told, levels=levels)


def _unread(folder: Path) -> tuple[str, ...]:
    """What of a folder of images is a picture of a kind that is not read, counted."""
    try:
        kinds = Counter(file.suffix.lower() for file in folder.iterdir())
    except OSError:  # its files can be read, it cannot be listed
        return ()
    unread = ((suffix, count) for suffix, count in sorted(kinds.items()) if suffix in UNREAD_SUFFIXES)
    return tuple(
        f"{folder}: {count} {suffix} files were left out: flocc does not read them" for suffix, count in unread
    )


def _read(path: Path, name: str, form: str | None) -> Source:
    """Call a reader; what it did not foresee in a file is said as a fault of the folder."""
    try:
        return read_plain(path, form) if name == "plain" else READERS[name](path)
    except OSError as error:
        raise DatasetError(f"{error.filename or path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise DatasetError(f"{path}: cannot be read as {name}: {error}") from error


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
    unit = _time_unit(float(np.sum(steps_s)), source.images[-1][0] - source.images[0][0])
    known = unit not in (None, "seconds")
    return f"the trajectory's stamps look like {unit}, not seconds" if known else CLOCKS_DIFFER


def _time_unit(duration_s: float, reference_s: float) -> str | None:
    """The unit that a duration in wrong seconds seems to be in, given a true one of about the same length."""
    if reference_s <= 0 or duration_s <= 0:
        return None
    close = (name for name, unit_s in UNITS_S.items() if 1 / 3 < duration_s * unit_s / reference_s < 3)
    return next(close, None)
