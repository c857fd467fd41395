"""What the pages' commands find in their folder: small data of a user's own, a bag, and a run.

A camera walks along two painted walls, one behind the other, three times; rendered in a second, and good enough for the
classical front end to find its way.
"""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tests.launch.bag_fixtures import ZERO_NS, BagScript

from flocc_agent.geometry import pose, so3_exp
from flocc_agent.runtime.trajectory import Trajectory, write_tum

Float = NDArray[np.float64]
Pixels = NDArray[np.uint8]

WIDTH, HEIGHT, FOCAL = 320, 240, 260.0
K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
WALLS_M = (5.0, 3.0)
PIXELS_PER_M = 100.0
LENGTH_M, PASSES, IMAGES, RATE_HZ = 3.0, 3, 14, 4.0


def write_own_data(folder: Path) -> Path:
    """A plain folder as users have it: images named by their stamps, a TUM trajectory, intrinsics in YAML."""
    (folder / "images").mkdir(parents=True)
    stamps_s, poses = walk()
    for stamp_s, image in zip(stamps_s, photographs(poses), strict=True):
        cv2.imwrite(str(folder / "images" / f"{stamp_s:.6f}.jpg"), image)
    write_tum(folder / "groundtruth.txt", Trajectory(stamps_s, poses))
    (folder / "camera.yaml").write_text(
        f"width: {WIDTH}\nheight: {HEIGHT}\nfx: {FOCAL}\nfy: {FOCAL}\ncx: {WIDTH / 2}\ncy: {HEIGHT / 2}\n"
    )
    return folder


def write_bag(path: Path) -> Path:
    """A ROS 1 bag with one camera, its intrinsics, and odometry."""
    script = BagScript(True)
    script.camera_info("/camera/camera_info", ZERO_NS)
    for k in range(4):
        script.odometry("/odom", ZERO_NS + k * 10**9, float(k))
        script.compressed("/camera/image_raw", ZERO_NS + k * 10**9)
    return script.write(path)


def walk() -> tuple[Float, Float]:
    """Stamps and poses of the camera: there, back, and there again, a little off each time."""
    along_m = np.concatenate([np.linspace(0, LENGTH_M, IMAGES)[:: 1 - 2 * (k % 2)] for k in range(PASSES)])
    stamps_s = 1700000000.0 + np.arange(len(along_m)) / RATE_HZ
    poses = [
        pose(
            so3_exp(np.array([0.0, 0.1 * np.sin(k / 5), 0.0])), np.array([x, 0.1 * np.sin(k / 7), 0.1 * np.cos(k / 9)])
        )
        for k, x in enumerate(along_m)
    ]
    return stamps_s, np.array(poses)


def photographs(poses: Float) -> list[Pixels]:
    """What a camera sees at each pose; the far wall first, the near one where it is painted."""
    rng = np.random.default_rng(0)
    walls = [_painted(rng, distance_m) for distance_m in WALLS_M]
    return [_photograph(T_world_camera, walls) for T_world_camera in poses]


def _photograph(T_world_camera: Float, walls: list[tuple[Float, Pixels, Pixels]]) -> Pixels:
    image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    R_camera_world = T_world_camera[:3, :3].T
    for corner_m, paint, mask in walls:
        columns = [[1 / PIXELS_PER_M, 0, 0], [0, 1 / PIXELS_PER_M, 0], corner_m - T_world_camera[:3, 3]]
        H = K @ R_camera_world @ np.array(columns).T
        seen = cv2.warpPerspective(mask, H, (WIDTH, HEIGHT), flags=cv2.INTER_NEAREST) > 0
        image[seen] = cv2.warpPerspective(paint, H, (WIDTH, HEIGHT))[seen]
    return image


def _painted(rng: np.random.Generator, distance_m: float) -> tuple[Float, Pixels, Pixels]:
    """Upper left corner, paint and mask of a wall; the nearest wall is only posters."""
    width, height = int((LENGTH_M + 9.0) * PIXELS_PER_M), int(7.0 * PIXELS_PER_M)
    rough = rng.integers(40, 200, (height // 40, width // 40, 3), dtype=np.uint8)
    paint = np.asarray(cv2.resize(rough, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    near = distance_m == min(WALLS_M)
    mask = np.full((height, width), 0 if near else 1, dtype=np.uint8)
    for _ in range(60 if near else 900):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        side = int(rng.integers(20, 60) if near else rng.integers(6, 40))
        cv2.rectangle(mask, (x, y), (x + side, y + side), 1, -1)
        cv2.rectangle(paint, (x, y), (x + side, y + side), rng.integers(0, 256, 3).tolist(), -1)
        letter, ink = chr(int(rng.integers(33, 126))), rng.integers(0, 256, 3).tolist()
        cv2.putText(paint, letter, (x, y + side), cv2.FONT_HERSHEY_SIMPLEX, side / 25, ink, 2, cv2.LINE_AA)
    return np.array([-4.5, -3.5, distance_m]), paint, mask
