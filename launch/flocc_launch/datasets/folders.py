"""Readers of published data sets in folders: TUM RGB-D, EuRoC ASL, KITTI odometry, 7-Scenes.

Each reader takes what is good and lists what is wrong as faults; it raises only where nothing can be used.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse
from flocc_agent.lenses import CameraModel
from flocc_agent.runtime.pose_limits import spikes
from flocc_agent.runtime.row_order import DAMAGED_RATIO_MAX
from flocc_agent.runtime.text_tables import RecordingError, number_lines, text_lines
from flocc_agent.runtime.trajectory import Trajectory, checked_pose
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.files import (
    camera_file,
    camera_files,
    image_files,
    image_numbers,
    image_rows,
    increasing_stamps_s,
    listed_images,
    natural,
    some,
    unequal,
)
from flocc_launch.datasets.intrinsics import mounting_of, read_lens
from flocc_launch.datasets.kitti_raw import rectified, rectified_lens
from flocc_launch.datasets.pixels import Stamped, image_size
from flocc_launch.datasets.plain import TRUTH_STEMS, taken_file, trajectories_beside
from flocc_launch.datasets.source import DatasetError, Lens, Source

Float = NDArray[np.float64]

SEVENSCENES_RATE_HZ = 30.0
SEVENSCENES_FOCAL, SEVENSCENES_SIZE = 585.0, (640, 480)
KITTI_RATE_HZ = 10.0
EUROC_TRUTHS = ("state_groundtruth_estimate0", "mocap0", "gt0", "vicon0")
NAME_APART_MAX_S = 1e-4
UP_CAMERA = np.array([0.0, -1.0, 0.0])

# Published calibrations of the TUM RGB-D colour cameras: fx fy cx cy, k1 k2 p1 p2, k3
TUM_CAMERAS = {
    "freiburg1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026), 1.1633),
    "freiburg2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001), 0.9172),
    "freiburg3": ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0), 0.0),
}


def read_tum_rgbd(path: Path) -> Source:
    """Read a TUM RGB-D sequence: `rgb.txt`, `groundtruth.txt`; the body is the colour camera."""
    images, faults = listed_images(path / "rgb.txt")
    lens = camera_file(path, images)
    for name, ((fx, fy, cx, cy), distortion, k3) in TUM_CAMERAS.items():
        if lens is None and re.search(rf"{name}(?!\d)", path.resolve().name):
            lens = Lens(CameraModel(640, 480, fx, fy, cx, cy, (*distortion, k3)))
    truth, notes = read_trajectory(path / "groundtruth.txt", otherwise="tum")
    calibrations = tuple(camera_files(path))
    return Source(path, "tum", images, lens, truth=truth, faults=faults, notes=notes, calibrations=calibrations)


def read_euroc(path: Path) -> Source:
    """Read an EuRoC ASL sequence's left camera: `mav0/cam0`, ground truth of the IMU body."""
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    images, faults, image_notes = _euroc_images(mav / "cam0")
    sensor = mav / "cam0" / "sensor.yaml"
    lens = read_lens(sensor) if sensor.exists() else camera_file(path, images) or camera_file(path / "dso", images)
    calibrations = (*([sensor] if sensor.exists() else []), *camera_files(path), *camera_files(path / "dso"))
    odometry, truth, notes = trajectories_beside(path)
    file = next((mav / name / "data.csv" for name in EUROC_TRUTHS if (mav / name / "data.csv").exists()), None)
    if file is not None:
        truth, truth_notes = read_trajectory(file, otherwise="euroc")
        truth = _of_body(truth, file.with_name("sensor.yaml"))
        beside = taken_file(path, TRUTH_STEMS)
        told = () if beside is None else (f"{file}: was taken as the ground truth, not {beside.name}",)
        notes = (*notes, *truth_notes, *told)
    notes = (*image_notes, *notes)
    return Source(
        path, "euroc", images, lens, odometry=odometry, truth=truth, faults=faults, notes=notes,
        calibrations=calibrations,
    )  # fmt: skip


def _of_body(truth: Trajectory, sensor: Path) -> Trajectory:
    """Poses of the body, of those of a sensor that its file places on the body.

    Raises:
        DatasetError: The file's `T_BS` is no pose.
    """
    T_body_sensor = mounting_of(sensor) if sensor.exists() else None
    if T_body_sensor is None:
        return truth
    return Trajectory(truth.stamps_s, truth.T_fixed_body @ inverse(T_body_sensor))


def _euroc_images(cam: Path) -> tuple[Stamped, tuple[str, ...], tuple[str, ...]]:
    """Images that are named by nanoseconds, or as data.csv lists them; faults, and a note on those left out."""
    folder, listing = cam / "data", cam / "data.csv"
    files = some(tuple(image_files(folder)), folder)
    stamped = tuple((int(file.stem) * 1e-9, file) for file in files if len(file.stem) > 9 and file.stem.isdecimal())
    if stamped and (apart_s := _apart_s(stamped, listing)) > NAME_APART_MAX_S:
        note = (
            f"{listing}: says other stamps than the names of the images (up to {apart_s:.3f} s apart); its stamps count"
        )
        return *listed_images(listing, folder), (note,)
    if stamped:
        odd = [file for file in files if not (len(file.stem) > 9 and file.stem.isdecimal())]
        note = f"{folder}: {len(odd)} of {len(files)} images were left out, as {{}} is no stamp in nanoseconds"
        return stamped, (), (note.format(odd[0].name),) if odd else ()
    if listing.exists():
        return *listed_images(listing, folder), ()
    raise DatasetError(
        f"{folder}: the names of the images are no stamps in nanoseconds ({files[0].name}): name them so, or list them "
        f"in {listing} with lines 'stamp_ns,name'"
    )


def _apart_s(stamped: Stamped, listing: Path) -> float:
    """How far stamps of a list are from those in the names of its images, at most; 0 where there is none."""
    named = {file.name: stamp_s for stamp_s, file in stamped}
    rows = [re.split(r"[\s,;]+", text, maxsplit=1) for _, text in text_lines(listing)] if listing.exists() else []
    listed = [(row[0], row[1].strip()) for row in rows if len(row) > 1 and row[0].isdecimal()]
    return max((abs(int(stamp) * 1e-9 - named[name]) for stamp, name in listed if name in named), default=0.0)


def read_kitti(path: Path) -> Source:
    """Read a KITTI odometry sequence's left grey (or colour) camera; poses stand in the folder or in `poses/XX.txt`."""
    folder = next((path / name for name in ("image_0", "image_l", "image_2") if (path / name).is_dir()), None)
    if folder is None:
        raise DatasetError(f"{path}: has no folder image_0")
    files = image_files(folder)
    times = path / "times.txt"
    poses, poses_file = _kitti_poses(path)
    numbers = image_numbers(files)
    last = max(numbers) + 1 if numbers else 0
    stamps_s = increasing_stamps_s(times) if times.exists() else _rate_stamps_s(max(len(files), len(poses), last))
    by_number = not times.exists() and last > len(files)
    stamps = len(stamps_s) if times.exists() or by_number else len(files)
    count = min(len(poses), len(stamps_s))
    posed_s = [stamps_s[number] for number in numbers] if by_number and len(poses) == len(files) else stamps_s[:count]
    truth, notes = posed(posed_s, poses[:count], poses_file) if count and poses_file else (None, ())
    fault = f"{poses_file}: has {len(poses)} poses, but the sequence has {stamps} images or stamps"
    faults = (fault,) if poses_file is not None and len(poses) not in (stamps, len(posed_s)) else ()
    if by_number:
        told = f"numbers of images have gaps and there is no times.txt; number N was taken at N/{KITTI_RATE_HZ:g} s"
        notes = (*notes, f"{folder}: {told}")
    of_images = len(files) if truth is None else min(count, stamps)
    if not by_number or (poses and len(poses) != len(files)):
        faults = (*faults, *unequal(folder, len(files), times if times.exists() else path, stamps, of_images))
    rows = numbers if by_number else image_rows(files, len(stamps_s))
    images = tuple((stamps_s[row], file) for row, file in zip(rows, files, strict=True) if row < len(stamps_s))
    own = rectified(path / "calib.txt", "2" if folder.name == "image_2" else "0")
    has_own = (path / "calib.txt").exists() and bool(files)
    lens = camera_file(path, images)
    if lens is None and has_own:
        lens = rectified_lens(own, files[0])
    shown = some(images, folder)
    calibrations = (*camera_files(path), *([own] if has_own else []))
    return Source(
        path, "kitti", shown, lens, truth=truth, up_world=UP_CAMERA, faults=faults, notes=notes, is_posed_by_image=True,
        calibrations=calibrations,
    )  # fmt: skip


def posed(stamps_s: list[float], poses: list[Float], file: Path) -> tuple[Trajectory, tuple[str, ...]]:
    """Stamped poses without those that jump away from both sides, which are counted."""
    stamps, T = np.array(stamps_s), np.array(poses)
    odd = spikes(T[:, :3, 3])
    first = int(np.argmax(odd)) + 1
    told = f"{np.count_nonzero(odd)} of {len(T)} poses jump away from those on both sides and were left out"
    return Trajectory(stamps[~odd], T[~odd]), (f"{file}:{first}: {told}",) if np.any(odd) else ()


def _rate_stamps_s(count: int) -> list[float]:
    return [k / KITTI_RATE_HZ for k in range(count)]


def _kitti_poses(path: Path) -> tuple[list[Float], Path | None]:
    candidates = [path / "poses.txt", path.parent.parent / "poses" / f"{path.name}.txt", path / f"{path.name}.txt"]
    file = next((candidate for candidate in candidates if candidate.exists()), None)
    if file is None:
        return [], None
    poses = []
    for line, values in number_lines(file, 12):
        T = np.vstack([np.array(values[:12]).reshape(3, 4), [0, 0, 0, 1]])
        poses.append(checked_pose(T, f"{file}:{line}"))
    return poses, file


def read_sevenscenes(path: Path) -> Source:
    """Read a 7-Scenes sequence: numbered colour images with 4x4 poses beside them, stamped at 30 Hz by their number."""
    images, poses, damaged = [], [], []
    for file in sorted(path.glob("frame-*.color.*"), key=natural):
        number = file.name[6:].partition(".")[0]
        pose_file = path / f"frame-{number}.pose.txt"
        try:
            poses.append(_sevenscenes_pose(pose_file))
            images.append((int(number) / SEVENSCENES_RATE_HZ, file))
        except RecordingError as error:
            damaged.append(str(error))
    if not images and damaged:
        raise DatasetError(damaged[0])
    some(tuple(images), path)
    said = (f"{damaged[0]} ({len(damaged)} images have no usable pose, and were left out)",) if damaged else ()
    few = len(damaged) <= DAMAGED_RATIO_MAX * (len(images) + len(damaged))
    notes, faults = (said, ()) if few else ((), said)
    orphans = len(list(path.glob("frame-*.pose.txt"))) - len(images) - len(damaged)
    if orphans > 0:
        faults = (*faults, f"{path}: has {orphans} poses more than images")
    truth = Trajectory(np.array([stamp_s for stamp_s, _ in images]), np.array(poses))
    own = next((path / name for name in SEVENSCENES_LENSES if (path / name).exists()), None)
    lens = camera_file(path, images) or _sevenscenes_lens(own, images[0][1])
    return Source(
        path,
        "7scenes",
        tuple(images),
        lens,
        truth=truth,
        up_world=UP_CAMERA,
        faults=faults,
        notes=notes,
        is_posed_by_image=True,
        calibrations=(*camera_files(path), *([own] if own is not None else [])),
    )


def _sevenscenes_pose(path: Path) -> Float:
    rows = [values[:4] for _, values in number_lines(path, 4)]
    if len(rows) != 4:
        raise RecordingError(f"{path}: has {len(rows)} rows, a pose has 4")
    return checked_pose(np.array(rows), str(path))


SEVENSCENES_LENSES = ("camera-intrinsics.txt", "_info.txt")
"""Where 7-Scenes and BundleFusion, which names its files alike, say the intrinsics."""


def _sevenscenes_lens(file: Path | None, image: Path) -> Lens | None:
    """Intrinsics of a file, else the published ones for images of their shape, scaled to their size."""
    width, height = image_size(image)
    if file is None:
        if width * SEVENSCENES_SIZE[1] != height * SEVENSCENES_SIZE[0]:
            return None
        focal = SEVENSCENES_FOCAL * width / SEVENSCENES_SIZE[0]
        return Lens(CameraModel(width, height, focal, focal, width / 2, height / 2))
    return read_lens(file, (width, height))
