"""A robot's recording as a plain folder: images with stamps, odometry, intrinsics, optional ground truth.

    RECORDING/images.txt        lines `stamp_s relative/path`, sorted by time
    RECORDING/images/*.jpg|png
    RECORDING/odometry.tum      T_odom_body at the images' stamps or denser
    RECORDING/groundtruth.tum   T_world_body, optional
    RECORDING/camera.toml       [camera] width height fx fy cx cy distortion T_body_camera, a model if no pinhole
    RECORDING/mask.png          black where pictures show what moves with the camera, optional
    RECORDING/measurements.jsonl  what else was measured, optional (`measurement_file`)

Odometry is interpolated to the images' stamps. Images outside of the odometry's time are left out. Pixels are read
when they are asked for.
"""

import logging
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import ConfigError, read_toml
from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.core.measurements import OdometryCovariance
from flocc_agent.lenses import CameraModel, LensKind
from flocc_agent.lenses.lens_names import READ, kind_of
from flocc_agent.lenses.models import DISTORTION_COUNTS
from flocc_agent.runtime.measurement_file import NAME as MEASUREMENTS
from flocc_agent.runtime.measurement_file import NOTHING, RecordedMeasurements, read_measurements
from flocc_agent.runtime.pictures import FULL, Levels, PictureError, good_pictures, read_picture
from flocc_agent.runtime.pose_limits import MOUNT_MAX_M, position_fault
from flocc_agent.runtime.straightening import Straightener
from flocc_agent.runtime.text_tables import RecordingError, text_lines
from flocc_agent.runtime.trajectory import GAP_MAX_S, Trajectory, checked_pose
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_agent.runtime.unmeasured_steps import pauses, together, unmeasured

__all__ = ["Frame", "Recording", "RecordingError", "read_camera", "read_image_list", "write_camera"]

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]

MASK = "mask.png"
MASK_LEVEL = 128
"""Darker pixels of a mask are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image and where odometry says it was taken.

    Attributes:
        stamp_s: When, seconds.
        image_path: The image file.
        T_odom_body: (4, 4) pose of the body in the robot's odometry frame, metres.
    """

    stamp_s: float
    image_path: Path
    T_odom_body: Float


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """One robot's images and odometry.

    Attributes:
        path: The folder.
        camera: Intrinsics of every image, once it is straightened.
        T_body_camera: (4, 4) pose of the camera in the body, metres.
        frames: Images that odometry covers, in order of time; at least one.
        truth: Ground truth `T_world_body` where the recording has one.
        levels: How images of 16 bits are brought to 8.
        measurements: What else was measured.
        hidden: (H, W) pixels that move with the camera; None where the recording does not say.
        straightener: Takes out of images what `camera` cannot say; None: they are taken as they are.
    """

    path: Path
    camera: Camera
    T_body_camera: Float
    frames: tuple[Frame, ...]
    truth: Trajectory | None
    levels: Levels = FULL
    measurements: RecordedMeasurements = NOTHING
    hidden: NDArray[np.bool_] | None = None
    straightener: Straightener | None = None

    @property
    def model(self) -> Camera | CameraModel:
        """Intrinsics of the images as they are stored."""
        return self.camera if self.straightener is None else self.straightener.model

    @classmethod
    def open(cls, path: Path | str) -> "Recording":
        """Read everything but the pixels; an image that is cut off, or of another size, is left out and said.

        Raises:
            RecordingError: A file is missing or broken, many images cannot be used, or none lies within the odometry's
                time.
        """
        path = Path(path)
        if not path.is_dir():
            raise RecordingError(f"{path}: is not a folder")
        if not (path / "camera.toml").exists():
            raise RecordingError(
                f"{path}: has no camera.toml, no recording in flocc's own form; `flocc dataset convert {path} OUT` "
                "writes one of a data set or a bag"
            )
        model, T_body_camera = read_camera(path / "camera.toml")
        straightener = _straightener(model, path / "camera.toml")
        odometry = read_tum(path / "odometry.tum")
        frames = _frames(path, odometry)
        truth_path = path / "groundtruth.tum"
        truth = read_tum(truth_path) if truth_path.exists() else None
        try:
            looked = good_pictures([frame.image_path for frame in frames], (model.width, model.height))
        except PictureError as error:
            raise RecordingError(f"{error}; the intrinsics are in {path / 'camera.toml'}") from error
        if looked.fault is not None:
            logger.warning("%s", looked.fault)
        good = tuple(frames[k] for k in looked.good)
        frames_s = [frame.stamp_s for frame in good]
        measurements = read_measurements(path / MEASUREMENTS, frames_s)
        measurements = measurements.with_steps(_unmeasured(path / "odometry.tum", odometry, frames_s))
        hidden = read_mask(path / MASK, straightener)
        camera, needed = straightener.camera, straightener if straightener.is_needed else None
        return cls(path, camera, T_body_camera, good, truth, looked.levels, measurements, hidden, needed)

    def ground_truth(self, stamp_s: float) -> Float | None:
        """True (4, 4) pose `T_world_body` at a time, or None where there is none."""
        return None if self.truth is None else self.truth.at(stamp_s)

    def load_image(self, frame: Frame) -> Image:
        """Read a frame's pixels, (H, W, 3) uint8 RGB.

        Raises:
            RecordingError: The image cannot be read, or its size is not that of the intrinsics.
        """
        try:
            encoded = frame.image_path.read_bytes()
            pixels = read_picture(encoded, (self.model.width, self.model.height), self.levels)
        except OSError as error:
            raise RecordingError(f"{frame.image_path}: cannot be read: {error.strerror or error}") from error
        except PictureError as error:
            raise RecordingError(f"{frame.image_path}: {error}") from error
        return Image(pixels if self.straightener is None else self.straightener.apply(pixels), self.camera)


def _straightener(model: CameraModel, path: Path) -> Straightener:
    try:
        return Straightener(model)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error


def read_mask(path: Path, straightener: Straightener) -> NDArray[np.bool_] | None:
    """Read which pixels (H, W) move with the camera: the black ones; None where there is no such file.

    It is of the images as they are stored, and straightened as they are.

    Raises:
        RecordingError: It cannot be read, is of another size than the images, or leaves nothing of them.
    """
    if not path.exists():
        return None
    try:
        model = straightener.model
        pixels = straightener.apply(read_picture(path.read_bytes(), (model.width, model.height), FULL))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except PictureError as error:
        raise RecordingError(f"{path}: {error}; a mask is as large as the images") from error
    hidden = np.asarray(pixels.max(axis=2) < MASK_LEVEL)
    if hidden.all():
        raise RecordingError(f"{path}: is black all over and leaves nothing of the images: black is what is left out")
    return hidden


def read_image_list(path: Path) -> list[tuple[float, Path]]:
    """Read `images.txt`: stamps and paths, which are relative to its folder.

    Raises:
        RecordingError: Unreadable, empty, a malformed line, time going backwards, or an image that is missing.
    """
    images: list[tuple[float, Path]] = []
    for line, text in text_lines(path):
        stamp, _, name = text.partition(" ")
        try:
            stamp_s = float(stamp)
        except ValueError:
            stamp_s = float("nan")
        if not np.isfinite(stamp_s) or not name.strip():
            raise RecordingError(f"{path}:{line}: must be 'stamp_s relative/path', not {text[:80]!r}")
        if images and stamp_s <= images[-1][0]:
            raise RecordingError(f"{path}:{line}: time goes backwards, from {images[-1][0]:.6f} s to {stamp_s:.6f} s")
        image = path.parent / name.strip()
        if not image.is_file():
            raise RecordingError(f"{path}:{line}: the image {image} does not exist")
        images.append((stamp_s, image))
    if not images:
        raise RecordingError(f"{path}: lists no image")
    return images


def read_camera(path: Path) -> tuple[CameraModel, Float]:
    """Read `camera.toml`: intrinsics, and `T_body_camera` (identity where it is missing).

    Raises:
        RecordingError: Unreadable, a key is missing or unknown, or a value cannot be.
    """
    try:
        table = read_toml(path)
    except ConfigError as error:
        raise RecordingError(str(error)) from error
    camera = table.get("camera")
    if not isinstance(camera, dict):
        raise RecordingError(f"{path}: the table [camera] is missing")
    values = {**camera, **{key: value for key, value in table.items() if key != "camera"}}
    T_body_camera = values.pop("T_body_camera", None)
    return _camera(values, path), _extrinsics(T_body_camera, path)


def write_camera(path: Path, camera: Camera, T_body_camera: Float) -> None:
    """Write `camera.toml`."""
    rows = ",\n    ".join("[" + ", ".join(f"{value:.12g}" for value in row) + "]" for row in T_body_camera)
    distortion = ", ".join(f"{value:.12g}" for value in camera.distortion)
    path.write_text(
        "# Pinhole, pixels; distortion k1 k2 p1 p2.\n"
        "# T_body_camera: camera (x right, y down, z forward) in the body, metres.\n"
        f"[camera]\nwidth = {camera.width}\nheight = {camera.height}\n"
        f"fx = {camera.fx:.12g}\nfy = {camera.fy:.12g}\ncx = {camera.cx:.12g}\ncy = {camera.cy:.12g}\n"
        f"distortion = [{distortion}]\nT_body_camera = [\n    {rows},\n]\n",
        encoding="utf-8",
    )


def _unmeasured(path: Path, odometry: Trajectory, frames_s: Sequence[float]) -> dict[float, OdometryCovariance]:
    """How exact odometry is up to those frames before which nobody measured it, by their stamps."""
    found: dict[float, OdometryCovariance] = {}
    paused = pauses(odometry.stamps_s)
    for k, step in unmeasured(odometry.stamps_s, odometry.T_fixed_body, paused).items():
        after = bisect_left(frames_s, float(odometry.stamps_s[k]))
        if 0 < after < len(frames_s):
            stamp_s = frames_s[after]
            found[stamp_s] = together([found[stamp_s], step]) if stamp_s in found else step
    if len(paused):
        from_s, to_s = odometry.stamps_s[paused[0] - 1], odometry.stamps_s[paused[0]]
        more = f" (and in {len(paused) - 1} other pauses)" if len(paused) > 1 else ""
        logger.warning(
            "%s: says nothing from %.3f s to %.3f s%s; loop closures decide where the robot went meanwhile",
            *(path, from_s, to_s, more),
        )
    return found


def _frames(path: Path, odometry: Trajectory) -> tuple[Frame, ...]:
    images = read_image_list(path / "images.txt")
    posed = [(stamp_s, image, odometry.at(stamp_s)) for stamp_s, image in images]
    far = [fault for _, _, T in posed if T is not None and (fault := position_fault(T[:3, 3])) is not None]
    if len(far) == len(images):
        raise RecordingError(f"{path / 'odometry.tum'}: {far[0]}")
    if far:
        logger.warning("%s: %d of %d images were left out: of the first, %s", path, len(far), len(images), far[0])
    frames = tuple(
        Frame(stamp_s, image, T) for stamp_s, image, T in posed if T is not None and position_fault(T[:3, 3]) is None
    )
    if not frames:
        first_s, last_s = odometry.stamps_s[0], odometry.stamps_s[-1]
        raise RecordingError(
            f"{path / 'odometry.tum'}: is from {first_s:.3f} s to {last_s:.3f} s, and has no pose (or a gap of over "
            f"{GAP_MAX_S:g} s) where the images of {path / 'images.txt'} are, from {images[0][0]:.3f} s to "
            f"{images[-1][0]:.3f} s"
        )
    if outside := sum(T is None for _, _, T in posed):
        logger.warning("%s: %d of %d images lie outside of the odometry", path, outside, len(images))
    return frames


SHAPES = {
    LensKind.FOV: ("omega",),
    LensKind.OMNIDIRECTIONAL: ("xi",),
    LensKind.DOUBLE_SPHERE: ("xi", "alpha"),
    LensKind.EUCM: ("alpha", "beta"),
}
"""Keys of a wide lens's shape, in the order of `CameraModel.shape`."""


def _camera(values: dict[str, object], path: Path) -> CameraModel:
    sizes = {key: _number(values, key, path) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    uneven = next((key for key in ("width", "height") if sizes[key] != np.round(sizes[key])), None)
    if uneven is not None:
        raise RecordingError(f"{path}: camera.{uneven} must be a whole number, not {sizes[uneven]}")
    name = values.pop("model", "pinhole")
    kind = kind_of(name) if isinstance(name, str) else None
    if kind is None:
        raise RecordingError(f"{path}: camera.model is {name!r}; flocc reads {READ}")
    shape = tuple(_number(values, key, path) for key in SHAPES.get(kind, ()))
    distortion = _distortion(values, kind, path)
    if values:
        raise RecordingError(f"{path}: the key 'camera.{next(iter(values))}' does not exist")
    focal = (sizes["fx"], sizes["fy"], sizes["cx"], sizes["cy"])
    try:
        return CameraModel(int(sizes["width"]), int(sizes["height"]), *focal, distortion, kind, shape)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error


def _distortion(values: dict[str, object], kind: LensKind, path: Path) -> tuple[float, ...]:
    """Coefficients in the order of `CameraModel.distortion`, none where a pinhole has no such key."""
    counts = DISTORTION_COUNTS[kind]
    distortion = values.pop("distortion", [] if 0 in counts else None)
    is_list = isinstance(distortion, list) and all(
        isinstance(k, int | float) and not isinstance(k, bool) for k in distortion
    )
    if not isinstance(distortion, list) or not is_list or len(distortion) not in counts:
        order = "[k1, k2, k3, k4]" if kind is LensKind.EQUIDISTANT else "[k1, k2, p1, p2, ...] in OpenCV's order"
        many = " or ".join(map(str, counts))
        raise RecordingError(f"{path}: camera.distortion of the {kind} model must be {order}, {many} numbers")
    return tuple(map(float, distortion))


def _number(values: dict[str, object], key: str, path: Path) -> float:
    if key not in values:
        raise RecordingError(f"{path}: the key 'camera.{key}' is missing")
    value = values.pop(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise RecordingError(f"{path}: camera.{key} must be a number, not {value!r}")
    return value


def _extrinsics(rows: object, path: Path) -> Float:
    if rows is None:
        return np.eye(4)
    try:
        T = np.array(rows, dtype=float)
    except (TypeError, ValueError):
        T = np.empty(0)
    if T.shape != (4, 4):
        raise RecordingError(f"{path}: camera.T_body_camera must be four rows of four numbers")
    T = checked_pose(T, f"{path}: camera.T_body_camera")
    if float(np.linalg.norm(T[:3, 3])) > MOUNT_MAX_M:
        raise RecordingError(f"{path}: camera.T_body_camera: the camera sits over {MOUNT_MAX_M:g} m from the body")
    return T
