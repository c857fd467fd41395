"""Readers of published data sets in folders: TUM RGB-D, EuRoC ASL, KITTI odometry, 7-Scenes.

Each reader takes what is good and lists what is wrong as faults; it raises only where nothing can be used.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import pose_from_tq
from flocc_agent.lenses import CameraModel
from flocc_agent.runtime.trajectory import Trajectory, checked_pose, number_lines, read_tum, text_lines
from flocc_launch.datasets.files import camera_file, image_files, listed_images, some, unequal
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.pixels import image_size
from flocc_launch.datasets.source import DatasetError, Lens, Source

Float = NDArray[np.float64]

SEVENSCENES_RATE_HZ = 30.0
KITTI_RATE_HZ = 10.0
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
    lens = camera_file(path)
    for name, ((fx, fy, cx, cy), distortion, k3) in TUM_CAMERAS.items():
        if lens is None and name in path.resolve().name:
            lens = Lens(CameraModel(640, 480, fx, fy, cx, cy, (*distortion, k3)))
    truth = _optional(path / "groundtruth.txt", read_tum)
    return Source(path, "tum", images, lens, truth=truth, faults=faults)


def read_euroc(path: Path) -> Source:
    """Read an EuRoC ASL sequence's left camera: `mav0/cam0`, ground truth of the IMU body."""
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    folder = mav / "cam0" / "data"
    images = tuple((int(file.stem) * 1e-9, file) for file in image_files(folder) if file.stem.isdigit())
    lens = read_lens(mav / "cam0" / "sensor.yaml") if (mav / "cam0" / "sensor.yaml").exists() else None
    truth = _optional(mav / "state_groundtruth_estimate0" / "data.csv", _read_euroc_truth)
    return Source(path, "euroc", some(images, folder), lens, truth=truth)


def _read_euroc_truth(path: Path) -> Trajectory:
    rows = np.array([values[:8] for _, values in number_lines(path, 8)])
    if len(rows) == 0:
        raise DatasetError(f"{path}: holds no pose")
    poses = np.array([checked_pose(pose_from_tq(row[1:8]), f"{path}: row {i + 1}") for i, row in enumerate(rows)])
    keep = np.concatenate([[True], np.diff(rows[:, 0]) > 0])
    return Trajectory(rows[keep, 0] * 1e-9, poses[keep])


def read_kitti(path: Path) -> Source:
    """Read a KITTI odometry sequence's left grey (or colour) camera; poses stand in the folder or in `poses/XX.txt`."""
    folder = next((path / name for name in ("image_0", "image_l", "image_2") if (path / name).is_dir()), None)
    if folder is None:
        raise DatasetError(f"{path}: has no folder image_0")
    files = image_files(folder)
    times = path / "times.txt"
    stamps_s = (
        [v[0] for _, v in number_lines(times, 1)] if times.exists() else [i / KITTI_RATE_HZ for i in range(len(files))]
    )
    truth, faults = _kitti_truth(path, stamps_s)
    count = len(files) if truth is None else len(truth)
    faults = (*faults, *unequal(folder, len(files), times if times.exists() else path, len(stamps_s), count))
    images = tuple(zip(stamps_s, files, strict=False))
    lens = camera_file(path) or _kitti_lens(path / "calib.txt", "P2" if folder.name == "image_2" else "P0", files)
    return Source(path, "kitti", some(images, folder), lens, truth=truth, up_world=UP_CAMERA, faults=faults)


def _kitti_truth(path: Path, stamps_s: list[float]) -> tuple[Trajectory | None, tuple[str, ...]]:
    candidates = [path / "poses.txt", path.parent.parent / "poses" / f"{path.name}.txt", path / f"{path.name}.txt"]
    file = next((candidate for candidate in candidates if candidate.exists()), None)
    if file is None:
        return None, ()
    poses = []
    for line, values in number_lines(file, 12):
        T = np.vstack([np.array(values[:12]).reshape(3, 4), [0, 0, 0, 1]])
        poses.append(checked_pose(T, f"{file}:{line}"))
    count = min(len(poses), len(stamps_s))
    fault = f"{file}: has {len(poses)} poses, but the sequence has {len(stamps_s)} images or stamps"
    truth = Trajectory(np.array(stamps_s[:count]), np.array(poses[:count])) if count else None
    return truth, (fault,) if len(poses) != len(stamps_s) else ()


def _kitti_lens(path: Path, name: str, files: list[Path]) -> Lens | None:
    if not path.exists() or not files:
        return None
    rows: dict[str, list[float]] = {}
    for _, text in text_lines(path):
        key, _, numbers = text.partition(":") if ":" in text else ("", "", text)
        rows[key or f"P{len(rows)}"] = [float(number) for number in numbers.split()]
    P = rows.get(name)
    if P is None or len(P) != 12:
        raise DatasetError(f"{path}: has no row {name} of 12 numbers")
    width, height = image_size(files[0])
    return Lens(CameraModel(width, height, P[0], P[5], P[2], P[6]))


def read_sevenscenes(path: Path) -> Source:
    """Read a 7-Scenes sequence: numbered colour images with 4x4 poses beside them, stamped at 30 Hz by their number."""
    images, poses, stamps_s, faults = [], [], [], []
    for file in sorted(path.glob("frame-*.color.*")):
        number = int(file.name[6:12])
        pose_file = path / f"frame-{number:06d}.pose.txt"
        if not pose_file.exists():
            faults.append(f"{pose_file}: is missing beside {file.name}")
            continue
        rows = [values[:4] for _, values in number_lines(pose_file, 4)]
        if len(rows) != 4:
            raise DatasetError(f"{pose_file}: has {len(rows)} rows, a pose has 4")
        poses.append(checked_pose(np.array(rows), str(pose_file)))
        stamps_s.append(number / SEVENSCENES_RATE_HZ)
        images.append((stamps_s[-1], file))
    some(tuple(images), path)
    orphans = len(list(path.glob("frame-*.pose.txt"))) - len(images)
    if orphans > 0:
        faults.append(f"{path}: has {orphans} poses more than images")
    truth = Trajectory(np.array(stamps_s), np.array(poses))
    lens = camera_file(path) or _sevenscenes_lens(path, images[0][1])
    return Source(path, "7scenes", tuple(images), lens, truth=truth, up_world=UP_CAMERA, faults=tuple(faults))


def _sevenscenes_lens(path: Path, image: Path) -> Lens:
    width, height = image_size(image)
    file = path / "camera-intrinsics.txt"
    if not file.exists():
        return Lens(CameraModel(width, height, 585.0, 585.0, width / 2, height / 2))
    K = [values for _, values in number_lines(file, 3)]
    return Lens(CameraModel(width, height, K[0][0], K[1][1], K[0][2], K[1][2]))


def _optional(path: Path, read: Callable[[Path], Trajectory]) -> Trajectory | None:
    return read(path) if path.exists() else None
