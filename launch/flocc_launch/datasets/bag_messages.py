"""ROS messages as what a recording holds: encoded images, poses, intrinsics."""

import math
import re
from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np

from flocc_agent.runtime.picture_heads import SUFFIXES, PictureError, head_of
from flocc_agent.runtime.pictures import FULL, SAMPLE_MAX, Levels, levels_of
from flocc_agent.runtime.ros2.raw_images import (
    camera_of,
    compressed_pixels,
    raw_pixels,
    rectified_camera_of,
    refuse_depth,
)
from flocc_agent.runtime.trajectory import QUATERNION_NORM_TOLERANCE
from flocc_launch.datasets.bag_reader import Bag, BagTopic
from flocc_launch.datasets.pixels import encoded_image, pnm
from flocc_launch.datasets.source import DatasetError, Lens

RAW_IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (RAW_IMAGE, COMPRESSED_IMAGE)
POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Path",
)
TRANSFORMS_TYPE = "tf2_msgs/msg/TFMessage"
TRANSFORMS_TYPES = (TRANSFORMS_TYPE, "tf/msg/tfMessage")
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
        pixels = raw_pixels(message, is_picture=DEPTH_NAME.search(topic.name) is None)
    except ValueError as error:
        raise DatasetError(f"topic {topic.name}: {error}") from error
    if jpeg:
        return encoded_image(pixels, lossless=pixels.dtype != np.uint8)
    return pnm(pixels)


def sampled_levels(bag: Bag, topic: BagTopic) -> Levels:
    """How a topic's images of 16 bits are brought to 8, by a sample over the whole bag."""
    first = bag.first(topic.name)
    is_picture = DEPTH_NAME.search(topic.name) is None
    if first is None or _deep_pixels(first[1], is_picture) is None:
        return FULL
    deep = (_deep_pixels(message, is_picture) for message in _spread(bag, topic))
    return levels_of(pixels for pixels in deep if pixels is not None)


def _spread(bag: Bag, topic: BagTopic) -> Iterator[Any]:
    """Messages at even distances of bag time, or the first ones of a bag that cannot be searched."""
    if bag.start_ns is None or bag.end_ns is None:
        sample: Iterator[tuple[BagTopic, int, bytes]] = islice(bag.raw([topic.name]), SAMPLE_MAX)
    else:
        times_ns = np.linspace(bag.start_ns, bag.end_ns, SAMPLE_MAX, endpoint=False)
        sample = (found for t in times_ns if (found := next(bag.raw([topic.name], int(t)), None)) is not None)
    for _, _, raw in sample:
        try:
            yield bag.decoded(raw, topic)
        except DatasetError:
            continue


def _deep_pixels(message: Any, is_picture: bool) -> Any:
    """Pixels of an image of 16 bits; None of others, and of what cannot be read."""
    try:
        compressed = hasattr(message, "format")
        pixels = compressed_pixels(message) if compressed else raw_pixels(message, is_picture)
    except ValueError:
        return None
    return pixels if pixels.dtype == np.uint16 else None


def poses(message: Any, topic: BagTopic) -> Iterator[tuple[int, tuple[float, ...]]]:
    """Yield stamps in nanoseconds and `tx ty tz qx qy qz qw` of a pose message; a path has many.

    Raises:
        DatasetError: A number is not finite, or a quaternion is not of unit length.
    """
    if topic.type == "nav_msgs/msg/Path":
        for posed in _stamped_poses(message):
            yield stamp_ns(posed.header) or stamp_ns(message.header), _numbers(posed.pose, topic)
        return
    if topic.type == "geometry_msgs/msg/TransformStamped":
        yield stamp_ns(message.header), transform_numbers(message.transform, topic)
        return
    pose = message.pose if topic.type == "geometry_msgs/msg/PoseStamped" else message.pose.pose
    yield stamp_ns(message.header), _numbers(pose, topic)


def _stamped_poses(path: Any) -> Any:
    """Poses of a path that say when they were; only the last one, the present, where all have one stamp or none."""
    stamps_ns = {stamp_ns(posed.header) for posed in path.poses}
    return path.poses[-1:] if len(stamps_ns) == 1 else path.poses


def header_ns(message: Any) -> int:
    """When a message's content was, nanoseconds; of a path, its last pose."""
    posed = getattr(message, "poses", None)
    last = stamp_ns(posed[-1].header) if posed is not None and len(posed) else 0
    return last or stamp_ns(message.header)


def transform_numbers(transform: Any, topic: BagTopic) -> tuple[float, ...]:
    """`tx ty tz qx qy qz qw` of a transform.

    Raises:
        DatasetError: As `checked_numbers`.
    """
    t, q = transform.translation, transform.rotation
    return checked_numbers((t.x, t.y, t.z, q.x, q.y, q.z, q.w), topic)


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
    if norm < QUATERNION_NORM_TOLERANCE:
        raise DatasetError(f"topic {topic.name}: odometry gives no pose (its quaternion is zero), as where it is lost")
    if abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE:
        raise DatasetError(f"topic {topic.name}: a pose is not rigid (its quaternion has length {norm:.4g}, not 1)")
    return x, y, z, qx / norm, qy / norm, qz / norm, qw / norm


DEPTH_NAME = re.compile(r"depth|disparity|range|distance", re.IGNORECASE)
"""In the names of topics whose values of 16 bits are no grey."""
RECTIFIED = re.compile(r"(?:^|[/_])rect(?:ified)?(?:[/_]|$)")
"""In the names of topics of images that were undistorted, as image_proc and camera drivers publish them."""


def lens_of(message: Any, topic: BagTopic, images: BagTopic) -> Lens:
    """Intrinsics of a CameraInfo message; the camera is taken as the body.

    Of images that are rectified, by their topic's name, the projection matrix counts and there is no distortion.

    Raises:
        DatasetError: The camera is not calibrated, or of a model that flocc does not read.
    """
    try:
        return Lens((rectified_camera_of if RECTIFIED.search(images.name) else camera_of)(message))
    except ValueError as error:
        raise DatasetError(f"topic {topic.name}: {error}") from error
