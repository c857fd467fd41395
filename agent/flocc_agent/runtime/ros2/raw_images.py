"""Pixels and intrinsics of ROS messages, as flocc takes them; what it cannot take is said in one sentence."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.lenses import CameraModel
from flocc_agent.lenses.lens_names import with_distortion
from flocc_agent.runtime.pictures import PictureError, Size, decoded

Pixels = NDArray[Any]
"""uint8 or uint16: RGB (H, W, 3), or grey (H, W)."""


@dataclass(frozen=True, slots=True)
class _Layout:
    """How an encoding stores a pixel.

    Attributes:
        channels: Values per pixel.
        order: "rgb", "bgr", "grey", or an OpenCV conversion's name without `COLOR_`.
        value: Type of a value without its byte order.
    """

    channels: int
    order: str
    value: str = "u1"


_ENCODINGS = {
    "mono8": _Layout(1, "grey"),
    "8UC1": _Layout(1, "grey"),
    "mono16": _Layout(1, "grey", "u2"),
    "rgb8": _Layout(3, "rgb"),
    "bgr8": _Layout(3, "bgr"),
    "8UC3": _Layout(3, "bgr"),
    "rgba8": _Layout(4, "rgb"),
    "bgra8": _Layout(4, "bgr"),
    "8UC4": _Layout(4, "bgr"),
    "rgb16": _Layout(3, "rgb", "u2"),
    "bgr16": _Layout(3, "bgr", "u2"),
    "16UC3": _Layout(3, "bgr", "u2"),
    "rgba16": _Layout(4, "rgb", "u2"),
    "bgra16": _Layout(4, "bgr", "u2"),
    "yuv422": _Layout(2, "YUV2RGB_UYVY"),
    "uyvy": _Layout(2, "YUV2RGB_UYVY"),
    "yuv422_yuy2": _Layout(2, "YUV2RGB_YUYV"),
    "yuyv": _Layout(2, "YUV2RGB_YUYV"),
    **{f"bayer_{name}{bits}": _Layout(1, f"Bayer{opencv}2RGB", f"u{bits // 8}")
       for bits in (8, 16)
       for name, opencv in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB"))},
}  # fmt: skip
_PLANES = {"nv21": "YUV2RGB_NV21", "nv12": "YUV2RGB_NV12"}
"""4:2:0 in two planes: one and a half times as many rows as the picture has."""
_DEPTH = ("16UC1", "32FC1")


def raw_pixels(message: Any, is_picture: bool = False) -> Pixels:
    """Pixels of an Image message, with their own depth; padding at the ends of rows is left out.

    Args:
        message: The message.
        is_picture: Whether values of 16 bits without a meaning are grey, as thermal cameras publish them.

    Raises:
        ValueError: An encoding that flocc does not read, or fewer bytes than the size needs.
    """
    encoding = "mono16" if is_picture and message.encoding == _DEPTH[0] else str(message.encoding)
    if encoding in _DEPTH:
        raise ValueError(
            f"images are encoded as {encoding!r}, which is how depth is published; a grey camera publishes mono16"
        )
    layout = _ENCODINGS.get(encoding, _Layout(1, _PLANES[encoding]) if encoding in _PLANES else None)
    if layout is None:
        raise ValueError(f"images are encoded as {encoding!r}; flocc reads {', '.join([*_ENCODINGS, *_PLANES])}")
    if message.width * message.height == 0:
        raise ValueError("an image has no pixels")
    rows = _rows(message, layout, message.height * 3 // 2 if encoding in _PLANES else message.height)
    return _in_order(rows, layout)


def _rows(message: Any, layout: _Layout, height: int) -> Pixels:
    """Values as they are stored, (H, W) or (H, W, channels), in the machine's byte order."""
    value = np.dtype(f"{'>' if message.is_bigendian else '<'}{layout.value}")
    width_bytes = message.width * layout.channels * value.itemsize
    if len(message.data) < height * message.step or message.step < width_bytes:
        raise ValueError(f"an image has {len(message.data)} bytes, too few for its size")
    rows = np.asarray(message.data[: height * message.step]).reshape(height, message.step)[:, :width_bytes]
    values = np.ascontiguousarray(rows).view(value).astype(value.newbyteorder("="), copy=False)
    return values if layout.channels == 1 else values.reshape(height, message.width, layout.channels)


def _in_order(values: Pixels, layout: _Layout) -> Pixels:
    import cv2

    if layout.order == "grey":
        return values
    if layout.order in ("rgb", "bgr"):
        return values[..., :3] if layout.order == "rgb" else values[..., 2::-1]
    try:
        return np.asarray(cv2.cvtColor(values, getattr(cv2, f"COLOR_{layout.order}")))
    except cv2.error:
        raise ValueError(f"an image of {values.shape[1]}x{values.shape[0]} values is no {layout.order}") from None


def compressed_pixels(message: Any, size: Size | None = None) -> Pixels:
    """Pixels of a CompressedImage message, RGB (H, W, 3), with their own depth.

    Args:
        message: The message.
        size: Of the intrinsics, for a picture that EXIF says is to be turned.

    Raises:
        ValueError: The image is damaged, is depth, or of a format that flocc does not read.
    """
    refuse_depth(message)
    try:
        pixels = decoded(bytes(message.data), size)
    except ValueError as error:
        raise ValueError(f"an image compressed as {message.format!r} cannot be read: {error}") from error
    return _demosaiced(pixels, str(message.format))


def _demosaiced(pixels: Pixels, form: str) -> Pixels:
    """Colours of a mosaic that was compressed as it is; image_transport then names the mosaic and no target format."""
    taken_as, _, compressed_as = form.partition(";")
    layout = _ENCODINGS.get(taken_as.strip())
    is_mosaic = layout is not None and layout.order.startswith("Bayer") and compressed_as.strip().endswith("compressed")
    is_grey = bool((pixels == pixels[..., :1]).all())
    return _in_order(np.ascontiguousarray(pixels[..., 0]), layout) if layout and is_mosaic and is_grey else pixels


def refuse_depth(message: Any) -> None:
    """See that a CompressedImage message is no depth.

    Raises:
        PictureError: Its format says that it is.
    """
    form = str(message.format)
    if any(name in form for name in (*_DEPTH, "compressedDepth")):
        raise PictureError(f"images are compressed as {form!r}, which is how depth is published, not a camera's images")


def camera_of(message: Any) -> CameraModel:
    """Intrinsics of a CameraInfo message (ROS 1 or 2) for the image as it was taken, after its binning and region.

    Raises:
        ValueError: The camera is not calibrated, or of a model that flocc does not read.
    """
    K, D = (message.k, message.d) if "k" in message.__dataclass_fields__ else (message.K, message.D)
    size, place = _region(message)
    if abs(K[1]) > SKEW_RATIO_MAX * abs(K[0]):
        raise ValueError(f"K has a skew of {K[1]:g} pixels, which flocc does not read")
    focal = _cropped((float(K[0]), float(K[4]), float(K[2]), float(K[5])), place)
    return with_distortion(str(message.distortion_model) or None, [float(value) for value in D], size, focal)


SKEW_RATIO_MAX = 1e-3
Place = tuple[int, int, int, int]


def _region(message: Any) -> tuple[Size, Place]:
    """Size of the images, and where they lie on the sensor: x, y, and how many pixels became one, across and down."""
    roi, across, down = message.roi, max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    width, height = (roi.width, roi.height) if roi.width and roi.height else (message.width, message.height)
    return (int(width) // across, int(height) // down), (int(roi.x_offset), int(roi.y_offset), across, down)


def _cropped(focal: tuple[float, float, float, float], place: Place) -> tuple[float, float, float, float]:
    """Fx fy cx cy of a part of the sensor; a pixel of several has its centre between theirs."""
    (fx, fy, cx, cy), (x, y, across, down) = focal, place
    return fx / across, fy / down, (cx - x + 0.5) / across - 0.5, (cy - y + 0.5) / down - 0.5


def rectified_camera_of(message: Any) -> CameraModel:
    """Intrinsics of a CameraInfo message (ROS 1 or 2) for the rectified image, which has no distortion.

    Raises:
        ValueError: The camera is not calibrated.
    """
    P = message.p if "p" in message.__dataclass_fields__ else message.P
    size, place = _region(message)
    return CameraModel(*size, *_cropped((float(P[0]), float(P[5]), float(P[2]), float(P[6])), place))
