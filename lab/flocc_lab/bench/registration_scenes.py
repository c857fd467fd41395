"""Image sets with known poses for judging perception.

Recordings of several robots, and the research sets of `../shared/data`, which are never copied into the project.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import KeyframeConfig
from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.geometry import inverse, pose, pose_from_tq
from flocc_agent.runtime.keyframes import KeyframeSelector
from flocc_agent.runtime.recording import Recording
from flocc_launch.datasets.detect import read_source
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.pixels import agents_camera, decoded, read_bytes
from flocc_launch.datasets.source import DatasetError

Float = NDArray[np.float64]

FOUNTAIN_REDUCTION = 0.25
"""The fountain's images are a quarter of the size that its calibration is for."""
CORRIDOR_TOLERANCE = 2
"""Frames of the two passes correspond by number; this many beside count as right (the set's own ground truth)."""
SEVENSCENES_KEYFRAMES = KeyframeConfig(distance_m=0.1, rotation_rad=float(np.radians(10.0)))
LOOP_PAIRS_BODY_POSES = (
    "0.338337 0.608466 -0.535476 0.478082 1.573832 2.023348 1.738755",
    "0.478634 0.415595 -0.700197 0.328505 1.872115 1.786064 1.586159",
    "0.3394 -0.672895 -0.492724 -0.435018 -0.662997 -0.495046 1.347300",
    "0.39266 -0.590667 -0.58023 -0.400326 -0.345638 -0.501712 1.320441",
)
"""Quaternion w x y z and position of the body in loop_pairs, from its README."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneView:
    """One image, who took it and from where.

    Attributes:
        robot: Whose it is; pairs of different robots are registered.
        file: The image.
        camera: Its intrinsics.
        T_world_camera: (4, 4) true pose, metres.
        T_odom_camera: (4, 4) pose by the robot's odometry, metres; the true one where the set has no odometry.
    """

    robot: str
    file: Path
    camera: Camera
    T_world_camera: Float
    T_odom_camera: Float

    def image(self) -> Image:
        """Read the pixels.

        Raises:
            DatasetError: The image cannot be read.
        """
        return Image(decoded(read_bytes(self.file), str(self.file)), self.camera)


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationScene:
    """Views in order of time, robot by robot.

    Attributes:
        name: For tables.
        views: All images.
        place_distance_m: Cameras nearer than this, which look the same way, see the same place.
        place_angle_rad: Largest angle between viewing directions at one place.
        position_error_max_m: A registration with a larger error, its length made the true one, is wrong.
    """

    name: str
    views: tuple[SceneView, ...]
    place_distance_m: float
    place_angle_rad: float
    position_error_max_m: float


def sevenscenes(folder: Path, robots: int = 3) -> RegistrationScene:
    """The handheld room of sevenscenes: keyframes every 0.1 m or 10 degrees, cut by time into robots."""
    source = read_source(folder)
    if source.lens is None or source.truth is None:
        raise DatasetError(f"{folder}: has no intrinsics or no poses")
    selector = KeyframeSelector(SEVENSCENES_KEYFRAMES)
    kept: list[tuple[Path, Float]] = []
    for stamp_s, file in source.images:
        T = source.truth.at(stamp_s)
        if T is not None and selector.wants(T):
            selector.took(T)
            kept.append((file, T))
    names = [f"r{1 + k * robots // len(kept)}" for k in range(len(kept))]
    camera = agents_camera(source.lens)
    views = tuple(SceneView(name, file, camera, T, T) for name, (file, T) in zip(names, kept, strict=True))
    return RegistrationScene(folder.name, views, 0.4, float(np.radians(30.0)), 0.2)


def fountain(folder: Path) -> RegistrationScene:
    """Strecha's fountain-P11, surveyed by lidar; every image is a robot's, so that all pairs are registered."""
    files = sorted((folder / "images").glob("*.jpg"))
    views = []
    for k, file in enumerate(files):
        numbers = np.array((folder / "gt_dense_cameras" / f"{file.name}.camera").read_text().split(), np.float64)
        K, T = numbers[:9].reshape(3, 3), pose(numbers[12:21].reshape(3, 3), numbers[21:24])
        width, height = (round(size * FOUNTAIN_REDUCTION) for size in numbers[24:26])
        fx, fy, cx, cy = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) * FOUNTAIN_REDUCTION
        views.append(SceneView(f"r{k:02d}", file, Camera(width, height, fx, fy, cx, cy), T, T))
    return RegistrationScene(folder.name, tuple(views), 4.0, float(np.radians(30.0)), 1.0)


def robots_beside(folder: Path, place_distance_m: float) -> RegistrationScene:
    """A folder with a plain data set per robot, such as street or herz_jesu."""
    views = [view for robot in sorted(folder.iterdir()) if robot.is_dir() for view in _plain_views(robot)]
    return RegistrationScene(folder.name, tuple(views), place_distance_m, float(np.radians(40.0)), 1.0)


def _plain_views(folder: Path) -> Iterator[SceneView]:
    """A robot's images that have a true pose."""
    source = read_source(folder)
    if source.lens is None or source.truth is None:
        raise DatasetError(f"{folder}: has no intrinsics or no ground truth")
    for stamp_s, file in source.images:
        T = source.truth.at(stamp_s)
        T_odom = T if source.odometry is None else source.odometry.at(stamp_s)
        if T is not None and T_odom is not None:
            yield SceneView(folder.name, file, agents_camera(source.lens), T, T_odom)


def kitti(folder: Path) -> RegistrationScene:
    """A drive as two robots that took turns, four images (5 m) each."""
    views = [replace(view, robot=f"r{1 + k // 4 % 2}") for k, view in enumerate(_plain_views(folder))]
    return RegistrationScene(folder.parent.name, tuple(views), 10.0, float(np.radians(40.0)), 1.0)


def loop_pairs(folder: Path) -> tuple[tuple[SceneView, ...], tuple[SceneView, ...]]:
    """Four stereo pairs of EuRoC: the left views, and the right ones, which stand in for odometry's neighbours."""
    sides = []
    for side in ("left", "right"):
        lens = read_lens(folder / f"sensor{side.capitalize()}.yaml")
        views = []
        for k, numbers in enumerate(LOOP_PAIRS_BODY_POSES):
            q_and_t = np.array(numbers.split(), np.float64)
            T_world_body = pose_from_tq(np.concatenate([q_and_t[4:], q_and_t[:4]]))
            T = T_world_body @ lens.T_body_camera
            views.append(SceneView(f"r{k}", folder / f"{side}_img_{k}.png", agents_camera(lens), T, T))
        sides.append(tuple(views))
    return sides[0], sides[1]


def stereo_revisits(folder: Path) -> RegistrationScene:
    """The views of loop_pairs as four robots, each with its right image before its left one."""
    left, right = loop_pairs(folder)
    views = tuple(view for pair in zip(right, left, strict=True) for view in pair)
    return RegistrationScene(folder.name, views, 1.0, float(np.radians(60.0)), 0.3)


def corridor(folder: Path) -> tuple[list[Image], list[Image], list[set[int]]]:
    """Two passes of a corridor: query images, reference images, and the right references of each query."""
    query, reference = ([_uncalibrated(file) for file in _jpegs(folder / part)] for part in ("query", "ref"))
    right = [{j for j in range(len(reference)) if abs(i - j) <= CORRIDOR_TOLERANCE} for i in range(len(query))]
    return query, reference, right


def from_recordings(
    folders: list[Path], keyframes: KeyframeConfig, position_error_max_m: float = 1.0
) -> RegistrationScene:
    """Keyframes of several robots' recordings with ground truth, such as the generated world's."""
    views = [view for k, folder in enumerate(folders) for view in _keyframes(f"r{k + 1}", folder, keyframes)]
    name = folders[0].parent.name if folders else "recordings"
    return RegistrationScene(name, tuple(views), 3.0, float(np.radians(40.0)), position_error_max_m)


def _keyframes(robot: str, folder: Path, keyframes: KeyframeConfig) -> Iterator[SceneView]:
    """Views of a recording's keyframes."""
    recording = Recording.open(folder)
    selector = KeyframeSelector(keyframes)
    for frame in recording.frames:
        T_world_body = recording.ground_truth(frame.stamp_s)
        if T_world_body is None or not selector.wants(frame.T_odom_body):
            continue
        selector.took(frame.T_odom_body)
        T_world_camera = T_world_body @ recording.T_body_camera
        T_odom_camera = frame.T_odom_body @ recording.T_body_camera
        yield SceneView(robot, frame.image_path, recording.camera, T_world_camera, T_odom_camera)


def relative(T_world_a: Float, T_world_b: Float) -> Float:
    """Pose of b in a."""
    return np.asarray(inverse(T_world_a) @ T_world_b)


def _jpegs(folder: Path) -> list[Path]:
    files = sorted(folder.glob("*.jpg"))
    if not files:
        raise DatasetError(f"{folder}: has no images")
    return files


def _uncalibrated(file: Path) -> Image:
    """An image whose intrinsics do not matter."""
    pixels = decoded(read_bytes(file), str(file))
    height, width = pixels.shape[:2]
    return Image(pixels, Camera(width, height, width, width, width / 2, height / 2))
