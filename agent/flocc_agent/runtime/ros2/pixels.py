"""Pixels and intrinsics of ROS messages, as flocc takes them; what it cannot take is said in one sentence."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera

Pixels = NDArray[np.uint8]

PINHOLE_MODELS = ("", "pinhole", "radtan", "radial-tangential", "plumb_bob", "none")
"""Names of the camera model that flocc takes: pinhole, with radial-tangential distortion."""

_BYTES = {"mono8": 1, "8UC1": 1, "mono16": 2, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4}
_BAYER = {"bayer_rggb8": "BG", "bayer_bggr8": "RG", "bayer_gbrg8": "GR", "bayer_grbg8": "GB"}


def raw_pixels(message: Any) -> Pixels:
    """Pixels of an Image message: RGB (H, W, 3) or grey (H, W); padding at the ends of rows is left out.

    Raises:
        ValueError: An encoding that flocc does not read, or fewer bytes than the size needs.
    """
    import cv2

    encoding = str(message.encoding)
    pixel_bytes = 1 if encoding in _BAYER else _BYTES.get(encoding)
    if pixel_bytes is None:
        raise ValueError(f"images are encoded as {encoding!r}; flocc reads {', '.join([*_BYTES, *_BAYER])}")
    if message.width * message.height == 0:
        raise ValueError("an image has no pixels")
    width_bytes = message.width * pixel_bytes
    if len(message.data) < message.height * message.step or message.step < width_bytes:
        raise ValueError(f"an image has {len(message.data)} bytes, too few for its size")
    rows = np.asarray(message.data[: message.height * message.step]).reshape(message.height, message.step)
    rows = rows[:, :width_bytes]
    if encoding in _BAYER:
        code = getattr(cv2, f"COLOR_Bayer{_BAYER[encoding]}2RGB")
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows), code), dtype=np.uint8)
    if encoding == "mono16":
        return rows[:, 0::2] if message.is_bigendian else rows[:, 1::2]
    if pixel_bytes == 1:
        return rows
    pixels = rows.reshape(message.height, message.width, -1)[..., :3]
    return pixels if encoding.startswith("rgb") else pixels[..., ::-1]


def compressed_pixels(message: Any) -> Pixels:
    """Pixels of a CompressedImage message, RGB (H, W, 3).

    Raises:
        ValueError: The image is damaged, or of a format that OpenCV does not read.
    """
    import cv2

    pixels = cv2.imdecode(message.data, cv2.IMREAD_COLOR) if len(message.data) else None
    if pixels is None:
        raise ValueError(f"an image compressed as {message.format!r} cannot be read; flocc reads JPEG and PNG")
    return np.asarray(pixels[..., ::-1], dtype=np.uint8)


def camera_of(message: Any) -> tuple[Camera, float]:
    """Intrinsics of a CameraInfo message (ROS 1 or 2) for the image as it was taken, and the third radial coefficient.

    Raises:
        ValueError: The camera is not calibrated, or of another model than pinhole with radial-tangential distortion.
    """
    if message.distortion_model not in PINHOLE_MODELS:
        raise ValueError(f"the distortion model is {message.distortion_model!r}; flocc takes plumb_bob")
    K, D = (message.k, message.d) if "k" in message.__dataclass_fields__ else (message.K, message.D)
    k1, k2, p1, p2, k3 = ([*map(float, D), 0.0, 0.0, 0.0, 0.0, 0.0])[:5]
    fx, cx, fy, cy = (float(K[i]) for i in (0, 2, 4, 5))
    return Camera(message.width, message.height, fx, fy, cx, cy, (k1, k2, p1, p2)), k3


def rectified_camera_of(message: Any) -> Camera:
    """Intrinsics of a CameraInfo message (ROS 2) for the rectified image, which has no distortion.

    Raises:
        ValueError: The camera is not calibrated.
    """
    fx, cx, fy, cy = (float(message.p[i]) for i in (0, 2, 5, 6))
    return Camera(message.width, message.height, fx, fy, cx, cy)
