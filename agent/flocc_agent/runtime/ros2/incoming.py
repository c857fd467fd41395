"""A robot's messages as an agent takes them: intrinsics, stamped odometry, images."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.runtime.ros2.pixels import camera_of, compressed_pixels, raw_pixels, rectified_camera_of
from flocc_agent.runtime.ros2.static_frames import pose_of_numbers
from flocc_agent.runtime.ros2.types import COMPRESSED_IMAGE, BadMessage, checked_stamp_ns

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Lens:
    """Intrinsics, and a third radial coefficient that an agent's camera has no place for."""

    camera: Camera
    k3: float = 0.0


def lens_of(message: Any, rectified: bool) -> Lens:
    """Intrinsics of a CameraInfo message.

    Raises:
        BadMessage: The camera is not calibrated, or of a model that flocc does not take.
    """
    try:
        return Lens(rectified_camera_of(message)) if rectified else Lens(*camera_of(message))
    except ValueError as error:
        raise BadMessage(str(error)) from error


def image_of(message: Any, lens: Lens) -> Image:
    """The image of an Image or CompressedImage message, undistorted where its lens has a third radial coefficient.

    Raises:
        BadMessage: It cannot be read, or is of another size than the intrinsics.
    """
    try:
        pixels = compressed_pixels(message) if message.__msgtype__ == COMPRESSED_IMAGE else raw_pixels(message)
    except ValueError as error:
        raise BadMessage(str(error)) from error
    camera = lens.camera
    if pixels.shape[:2] != (camera.height, camera.width):
        seen = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise BadMessage(f"an image is {seen}, but the intrinsics are for {camera.width}x{camera.height}")
    colour = np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels
    return _straight(np.ascontiguousarray(colour), lens)


def _straight(pixels: NDArray[np.uint8], lens: Lens) -> Image:
    """Take the distortion out where an agent's camera cannot say it."""
    if lens.k3 == 0.0:
        return Image(pixels, lens.camera)
    import cv2

    c = lens.camera
    straight = cv2.undistort(pixels, c.K(), np.array([*c.distortion, lens.k3]))
    return Image(np.asarray(straight, dtype=np.uint8), Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy))


def odometry_of(message: Any, odom_frame: str, base_frame: str) -> tuple[int, Float]:
    """Time (nanoseconds) and `T_odom_body` of an Odometry message.

    Raises:
        BadMessage: Its frames are others than configured, or its pose is none.
    """
    parent, child = message.header.frame_id.lstrip("/"), message.child_frame_id.lstrip("/")
    if (parent, child) != (odom_frame, base_frame):
        raise BadMessage(
            f"odometry is of {child!r} in {parent!r}, but the configuration says {base_frame!r} in {odom_frame!r}"
        )
    p, q = message.pose.pose.position, message.pose.pose.orientation
    stamp = message.header.stamp
    T_odom_body = pose_of_numbers((p.x, p.y, p.z, q.x, q.y, q.z, q.w), "odometry")
    return checked_stamp_ns(stamp.sec, stamp.nanosec), T_odom_body
