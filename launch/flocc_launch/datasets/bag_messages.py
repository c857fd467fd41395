"""ROS messages as what a recording holds: encoded images, poses, intrinsics."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from flocc_agent.runtime.picture_heads import SUFFIXES, PictureError, head_of
from flocc_agent.runtime.ros2.raw_images import camera_of, raw_pixels, refuse_depth
from flocc_agent.runtime.trajectory import QUATERNION_NORM_TOLERANCE
from flocc_launch.datasets.bag_reader import BagTopic
from flocc_launch.datasets.pixels import encoded_image
from flocc_launch.datasets.source import DatasetError, Lens

RAW_IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (RAW_IMAGE, COMPRESSED_IMAGE)
POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Path",
)
CAMERA_TYPE = "sensor_msgs/msg/CameraInfo"


def stamp_ns(header: Any) -> int:
    """Time of a header, nanoseconds."""
    stamp = header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def image_file(message: Any, topic: BagTopic, jpeg: bool) -> tuple[bytes, str]:
    """Bytes and suffix of an image message.

    A compressed image is passed on as it is; a raw one becomes PNM (fast, lossless) or JPEG (small), of 16 bits PNG.

    Raises:
        DatasetError: An encoding or compression that flocc does not read.
    """
    if topic.type == COMPRESSED_IMAGE:
        encoded = message.data.tobytes()
        try:
            refuse_depth(message)
            return encoded, SUFFIXES[head_of(encoded).format]
        except PictureError as error:
            raise DatasetError(
                f"topic {topic.name}: an image compressed as {message.format!r} cannot be read: {error}"
            ) from error
    try:
        pixels = raw_pixels(message)
    except ValueError as error:
        raise DatasetError(f"topic {topic.name}: {error}") from error
    if jpeg:
        return encoded_image(pixels, lossless=pixels.dtype != np.uint8)
    height, width = pixels.shape[:2]
    kind, suffix = (b"P6", ".ppm") if pixels.ndim == 3 else (b"P5", ".pgm")
    largest, values = (255, pixels) if pixels.dtype == np.uint8 else (65535, pixels.astype(">u2"))
    return b"%s\n%d %d\n%d\n%s" % (kind, width, height, largest, values.tobytes()), suffix


def poses(message: Any, topic: BagTopic) -> Iterator[tuple[int, tuple[float, ...]]]:
    """Yield stamps in nanoseconds and `tx ty tz qx qy qz qw` of a pose message; a path has many.

    Raises:
        DatasetError: A number is not finite, or a quaternion is not of unit length.
    """
    if topic.type == "nav_msgs/msg/Path":
        for posed in message.poses:
            yield stamp_ns(posed.header), _numbers(posed.pose, topic)
        return
    pose = message.pose if topic.type == "geometry_msgs/msg/PoseStamped" else message.pose.pose
    yield stamp_ns(message.header), _numbers(pose, topic)


def _numbers(pose: Any, topic: BagTopic) -> tuple[float, ...]:
    p, q = pose.position, pose.orientation
    return checked_numbers((p.x, p.y, p.z, q.x, q.y, q.z, q.w), topic)


def checked_numbers(numbers: tuple[float, ...], topic: BagTopic) -> tuple[float, ...]:
    """`tx ty tz qx qy qz qw` with a quaternion of unit length.

    Raises:
        DatasetError: A number is not finite, or the quaternion is not of about unit length.
    """
    x, y, z, qx, qy, qz, qw = numbers
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    if not math.isfinite(x + y + z + norm):
        raise DatasetError(f"topic {topic.name}: a pose has a number that is not finite")
    if abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE:
        raise DatasetError(f"topic {topic.name}: a pose is not rigid (its quaternion has length {norm:.4g}, not 1)")
    return x, y, z, qx / norm, qy / norm, qz / norm, qw / norm


def lens_of(message: Any, topic: BagTopic) -> Lens:
    """Intrinsics of a CameraInfo message; the camera is taken as the body.

    Raises:
        DatasetError: The camera is not calibrated, or of a model that flocc does not read.
    """
    try:
        return Lens(camera_of(message))
    except ValueError as error:
        raise DatasetError(f"topic {topic.name}: {error}") from error
