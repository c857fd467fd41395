"""A robot's messages as an agent takes them: intrinsics, stamped odometry, images."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Image
from flocc_agent.lenses import CameraModel
from flocc_agent.runtime.pictures import Levels, levels_of
from flocc_agent.runtime.ros2.raw_images import camera_of, compressed_pixels, raw_pixels, rectified_camera_of
from flocc_agent.runtime.ros2.static_frames import pose_of_numbers
from flocc_agent.runtime.ros2.types import COMPRESSED_IMAGE, BadMessage, checked_stamp_ns
from flocc_agent.runtime.straightening import Straightener

Float = NDArray[np.float64]


class Eye:
    """One live camera: brings its messages to what an agent takes.

    Attributes:
        model: How its pictures are taken.
    """

    def __init__(self, model: CameraModel, view_rad: float | None = None) -> None:
        """Prepare.

        Raises:
            BadMessage: The lens does not see as much as is wanted of it.
        """
        self.model = model
        self._size = (model.width, model.height)
        self._levels: Levels | None = None
        try:
            self._straightener = Straightener(model, view_rad)
        except ValueError as error:
            raise BadMessage(str(error)) from error

    def image(self, message: Any) -> Image:
        """The image of an Image or CompressedImage message, without the distortion that an agent's camera cannot say.

        Raises:
            BadMessage: It cannot be read, or is of another size than the intrinsics.
        """
        try:
            compressed = message.__msgtype__ == COMPRESSED_IMAGE
            pixels = compressed_pixels(message, self._size) if compressed else raw_pixels(message)
        except ValueError as error:
            raise BadMessage(str(error)) from error
        if pixels.shape[1::-1] != self._size:
            seen = f"{pixels.shape[1]}x{pixels.shape[0]}"
            raise BadMessage(f"an image is {seen}, but the intrinsics are for {self._size[0]}x{self._size[1]}")
        eight = self._eight_bits(pixels) if pixels.dtype == np.uint16 else pixels
        colour = np.repeat(eight[..., None], 3, axis=2) if eight.ndim == 2 else eight
        straight = self._straightener.apply(np.ascontiguousarray(colour))
        return Image(np.ascontiguousarray(straight, dtype=np.uint8), self._straightener.camera)

    def _eight_bits(self, pixels: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """Levels begin with the first image and only widen: what comes later is not known yet."""
        own = levels_of([pixels])
        known = self._levels or own
        self._levels = Levels(min(known.black, own.black), max(known.white, own.white))
        return self._levels.eight_bits(pixels)


def model_of(message: Any, rectified: bool) -> CameraModel:
    """Intrinsics of a CameraInfo message.

    Raises:
        BadMessage: The camera is not calibrated, or of a model that flocc does not read.
    """
    try:
        return rectified_camera_of(message) if rectified else camera_of(message)
    except ValueError as error:
        raise BadMessage(str(error)) from error


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
