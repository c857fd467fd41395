"""A smoothed picture is less sharp than its own."""

from pathlib import Path

import cv2
import numpy as np

from flocc_agent.core.interfaces import Camera
from flocc_agent.runtime.recording import write_camera
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_lab.bench.picture_sharpness import sharpness


def write_recording(path: Path, blur: int) -> Path:
    (path / "images").mkdir(parents=True)
    pixels = np.random.default_rng(3).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    cv2.imwrite(str(path / "images" / "0.png"), cv2.blur(pixels, (blur, blur)))
    (path / "images.txt").write_text("0.0 images/0.png\n")
    write_tum(path / "odometry.tum", Trajectory(np.array([0.0, 1.0]), np.repeat(np.eye(4)[None], 2, axis=0)))
    write_camera(path / "camera.toml", Camera(64, 48, 60.0, 60.0, 32.0, 24.0), np.eye(4))
    return path


def test_a_smoothed_picture_is_less_sharp(tmp_path: Path) -> None:
    own, smooth = (sharpness(write_recording(tmp_path / str(blur), blur)) for blur in (1, 3))
    assert smooth["laplacian_variance"] < 0.5 * own["laplacian_variance"]
    assert own["size"] == [64, 48]
