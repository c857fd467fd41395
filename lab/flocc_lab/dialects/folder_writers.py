"""Data sets as they are downloaded or exported, written small; the table in docs/data-sets.md lists these forms."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse, pose, q_wxyz_from_R, so3_exp
from flocc_agent.runtime.trajectory import Trajectory
from flocc_lab.dialects.trajectory_writers import EUROC_HEADER, line, ns, rows_of, wxyz, xyzw

Float = NDArray[np.float64]

COUNT = 6
ZERO_S = 1_305_031_102.0
WIDTH, HEIGHT = 32, 24
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, slots=True)
class FolderForm:
    """How one data set lies on disk.

    Attributes:
        reader: Name of the reader that takes it.
        write: Writes it into a folder and returns what is to be given to flocc.
        is_odometry: Whether its poses are odometry, not ground truth.
    """

    reader: str
    write: Callable[[Path], Path]
    is_odometry: bool = False


def drawn(zero_s: float = ZERO_S, step_s: float = 0.1) -> Trajectory:
    """Poses that start away from the identity, drive on and turn."""
    poses = [pose(so3_exp(np.array([0.1, 0.0, 0.1 * k])), np.array([5.0 + k, 2.0, 0.5])) for k in range(COUNT)]
    return Trajectory(zero_s + step_s * np.arange(float(COUNT)), np.array(poses))


def picture(path: Path, k: int) -> None:
    """One small image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    grey = cv2.resize(np.random.default_rng(k).integers(0, 256, (6, 8), dtype=np.uint8), (WIDTH, HEIGHT))
    path.write_bytes(cv2.imencode(path.suffix, cv2.merge([grey] * 3))[1].tobytes())


def _text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _camera(folder: Path) -> None:
    _text(folder / "camera.yaml", "width: 32\nheight: 24\nfx: 30\nfy: 30\ncx: 16\ncy: 12\n")


def _tum_lines(trajectory: Trajectory) -> str:
    return "".join(line([row[0], *xyzw(row)]) for row in rows_of(trajectory))


def _plain(path: Path) -> Path:
    for k, stamp_s in enumerate(drawn().stamps_s):
        picture(path / "images" / f"{stamp_s:.6f}.png", k)
    _text(path / "odometry.tum", _tum_lines(drawn()))
    _camera(path)
    return path


def _tum(path: Path) -> Path:
    names = [f"{stamp_s:.6f}" for stamp_s in drawn().stamps_s]
    for k, name in enumerate(names):
        picture(path / "rgb" / f"{name}.png", k)
    _text(path / "rgb.txt", "# color images\n" + "".join(f"{name} rgb/{name}.png\n" for name in names))
    _text(path / "groundtruth.txt", "# timestamp tx ty tz qx qy qz qw\n" + _tum_lines(drawn()))
    _camera(path)
    return path


def _asl(path: Path, truth: str, camera: bool) -> Path:
    for k, stamp_s in enumerate(drawn().stamps_s):
        picture(path / "mav0" / "cam0" / "data" / f"{ns(stamp_s)}.png", k)
    rows = "".join(line([ns(row[0]), *wxyz(row), *[0.5] * 9], ",") for row in rows_of(drawn()))
    _text(path / "mav0" / truth / "data.csv", f"{EUROC_HEADER}\n{rows}")
    if not camera:
        _text(
            path / "dso" / "camchain.yaml",
            "cam0:\n  T_cam_imu:\n  - [1.0, 0.0, 0.0, 0.1]\n  - [0.0, 1.0, 0.0, 0.0]\n  - [0.0, 0.0, 1.0, 0.0]\n"
            "  - [0.0, 0.0, 0.0, 1.0]\n  camera_model: pinhole\n  distortion_coeffs: [0.003, 0.0007, -0.002, 0.0002]\n"
            "  distortion_model: equidistant\n  intrinsics: [30.0, 30.0, 16.0, 12.0]\n  resolution: [32, 24]\n",
        )
    else:
        _text(
            path / "mav0" / "cam0" / "sensor.yaml",
            "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
            "  data: [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
            "rate_hz: 20\nresolution: [32, 24]\ncamera_model: pinhole\nintrinsics: [30, 30, 16, 12]\n"
            "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n",
        )
    return path


def _matrices(trajectory: Trajectory, rows: int) -> str:
    return "".join(line(T[:rows].ravel().tolist()) for T in trajectory.T_fixed_body)


def _kitti(path: Path) -> Path:
    for k in range(COUNT):
        picture(path / "sequences" / "05" / "image_0" / f"{k:06d}.png", k)
    _text(path / "sequences" / "05" / "times.txt", "".join(f"{0.1 * k:e}\n" for k in range(COUNT)))
    _text(path / "sequences" / "05" / "calib.txt", "P0: 30 0 16 0 0 30 12 0 0 0 1 0\n")
    _text(path / "poses" / "05.txt", _matrices(drawn(), 3))
    return path / "sequences" / "05"


def _kitti_raw(path: Path) -> Path:
    drive = path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    for k in range(COUNT):
        picture(drive / "image_02" / "data" / f"{k:010d}.png", k)
    stamps = "".join(f"2011-09-26 13:02:25.{k}00000000\n" for k in range(COUNT))
    _text(drive / "image_02" / "timestamps.txt", stamps)
    calibration = "calib_time: 09-Jan-2012 13:57:47\nS_rect_02: 32 24\nP_rect_02: 30 0 16 0 0 30 12 0 0 0 1 0\n"
    _text(path / "2011_09_26" / "calib_cam_to_cam.txt", calibration)
    _text(drive / "groundtruth.txt", "# timestamp tx ty tz qx qy qz qw\n" + _tum_lines(drawn(1_317_042_145.0)))
    return drive


def _sevenscenes(path: Path) -> Path:
    for k, T in enumerate(drawn().T_fixed_body):
        picture(path / f"frame-{k:06d}.color.png", k)
        _text(path / f"frame-{k:06d}.pose.txt", "".join(line(row.tolist(), "\t") for row in T))
    return path


def _colmap(path: Path) -> Path:
    lines = ["# Image list with two lines of data per image:\n"]
    for k, T in enumerate(drawn().T_fixed_body):
        picture(path / "images" / f"{k:04d}.jpg", k)
        T_camera_world = inverse(T)
        numbers = [*q_wxyz_from_R(T_camera_world[:3, :3]).tolist(), *T_camera_world[:3, 3].tolist()]
        lines += [f"{k + 1} {line(numbers)[:-1]} 1 {k:04d}.jpg\n", "10.5 11.5 -1 12.5 13.5 7\n"]
    _text(path / "sparse" / "0" / "images.txt", "".join(lines))
    _text(path / "sparse" / "0" / "cameras.txt", "# Camera list\n1 PINHOLE 32 24 30 30 16 12\n")
    return path


def _transforms(path: Path) -> Path:
    frames = []
    for k, T in enumerate(drawn().T_fixed_body):
        picture(path / "images" / f"frame_{k:05d}.png", k)
        frames.append({"file_path": f"images/frame_{k:05d}.png", "transform_matrix": (T @ OPENGL).tolist()})
    camera = {"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0}
    _text(path / "transforms.json", json.dumps({**camera, "frames": frames}))
    return path


def _replica(path: Path) -> Path:
    for k in range(COUNT):
        picture(path / "office0" / "results" / f"frame{k:06d}.jpg", k)
        (path / "office0" / "results" / f"depth{k:06d}.png").write_bytes(b"")
    _text(path / "office0" / "traj.txt", _matrices(drawn(), 4))
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 30.0, "fy": 30.0, "cx": 16.0, "cy": 12.0, "scale": 6553.5}
    _text(path / "cam_params.json", json.dumps({"camera": camera}))
    return path / "office0"


def _rtabmap(path: Path) -> Path:
    lines = ["#timestamp x y z qx qy qz qw id\n"]
    for k, row in enumerate(rows_of(drawn())):
        picture(path / "rgb" / f"{row[0]:.6f}.jpg", k)
        lines.append(line([row[0], *xyzw(row), k + 1]))
    _text(path / "poses.txt", "".join(lines))
    _camera(path)
    return path


FOLDERS: dict[str, FolderForm] = {
    "own folder": FolderForm("plain", _plain, is_odometry=True),
    "TUM RGB-D": FolderForm("tum", _tum),
    "EuRoC": FolderForm("euroc", lambda path: _asl(path, "state_groundtruth_estimate0", True)),
    "TUM-VI": FolderForm("euroc", lambda path: _asl(path, "mocap0", False)),
    "KITTI odometry": FolderForm("kitti", _kitti),
    "KITTI raw": FolderForm("kitti-raw", _kitti_raw),
    "7-Scenes": FolderForm("7scenes", _sevenscenes),
    "COLMAP, text": FolderForm("colmap", _colmap),
    "nerfstudio, instant-ngp": FolderForm("transforms", _transforms),
    "Replica": FolderForm("replica", _replica),
    "RTAB-Map's export": FolderForm("plain", _rtabmap, is_odometry=True),
}
