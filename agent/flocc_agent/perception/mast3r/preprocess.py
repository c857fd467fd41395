"""Pixels to network input, bit for bit as the reference does it with Pillow, and where each pixel came from.

MASt3R's input is resized to 512 (or 224) pixels, then cut to multiples of 16; the intrinsics follow. CosPlace's
input follows its official test code, or Swarm-SLAM's. Distortion is removed before either.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.perception.mast3r.sizes import PATCH_PX
from flocc_protocol.errors import FloccError

Float = NDArray[np.float64]
Pixels = NDArray[np.uint8]
InputSize = Literal[512, 224]
PlaceInput = Literal["native", "shorter-side", "swarm-slam"]

IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)
PIXELS_MAX = 64_000_000
SIDE_MIN_PX = 2


class BadImage(FloccError):
    """A picture that the networks cannot take."""


@dataclass(frozen=True, slots=True)
class Crop:
    """How a picture became the network's input: resized to a size, then cut at an offset.

    Attributes:
        source_width: Width of the picture, pixels.
        source_height: Height of the picture.
        resized_width: Width after resizing.
        resized_height: Height after resizing.
        x0: First column kept.
        y0: First row kept.
        width: Columns kept, a multiple of 16.
        height: Rows kept, a multiple of 16.
    """

    source_width: int
    source_height: int
    resized_width: int
    resized_height: int
    x0: int
    y0: int
    width: int
    height: int

    def scale(self) -> tuple[float, float]:
        """Resized over source size, along x and y; not exactly equal because sizes are rounded."""
        return self.resized_width / self.source_width, self.resized_height / self.source_height

    def K(self, K_source: Float) -> Float:
        """Calibration matrix of the network's input from the picture's; pixel centres are at whole numbers."""
        sx, sy = self.scale()
        K = K_source.copy()
        K[0, 0], K[1, 1] = K_source[0, 0] * sx, K_source[1, 1] * sy
        K[0, 2] = (K_source[0, 2] + 0.5) * sx - 0.5 - self.x0
        K[1, 2] = (K_source[1, 2] + 0.5) * sy - 0.5 - self.y0
        return K

    def to_source(self, uv: Float) -> Float:
        """Map (N, 2) pixels of the network's input to the picture's pixels."""
        offset = np.array([self.x0, self.y0]) + 0.5
        return np.asarray((uv + offset) / np.array(self.scale()) - 0.5)


def plan_crop(width: int, height: int, size: InputSize = 512, square_ok: bool = False) -> Crop:
    """Decide the resizing and cut for a picture size.

    Raises:
        BadImage: The picture is too small, too large or too elongated to leave 16 pixels a side.
    """
    if min(width, height) < SIDE_MIN_PX or width * height > PIXELS_MAX:
        raise BadImage(f"image of {width}x{height} pixels is outside {SIDE_MIN_PX} px to {PIXELS_MAX // 10**6} Mpx")
    long_edge = size if size == 512 else round(224 * max(width / height, height / width))
    longest = max(width, height)
    w, h = (round(side * long_edge / longest) for side in (width, height))
    cx, cy = w // 2, h // 2
    if size == 224:
        half = min(cx, cy)
        half_w, half_h = half, half
    else:
        half_w, half_h = (2 * cx) // PATCH_PX * (PATCH_PX // 2), (2 * cy) // PATCH_PX * (PATCH_PX // 2)
        if w == h and not square_ok:
            half_h = 3 * half_w // 4
    if min(half_w, half_h) < PATCH_PX // 2:
        raise BadImage(f"image of {width}x{height} pixels is too elongated: {w}x{h} leaves no {PATCH_PX} px a side")
    return Crop(width, height, w, h, cx - half_w, cy - half_h, 2 * half_w, 2 * half_h)


def resized(pixels: Pixels, crop: Crop) -> Pixels:
    """The network's picture (H, W, 3) uint8: Lanczos where it shrinks, bicubic where it grows."""
    picture = Pillow.fromarray(pixels)
    shrinks = max(crop.source_width, crop.source_height) > max(crop.resized_width, crop.resized_height)
    method = Pillow.Resampling.LANCZOS if shrinks else Pillow.Resampling.BICUBIC
    picture = picture.resize((crop.resized_width, crop.resized_height), method)
    box = (crop.x0, crop.y0, crop.x0 + crop.width, crop.y0 + crop.height)
    return np.asarray(picture.crop(box))


def mast3r_input(pixels: Pixels) -> NDArray[np.float32]:
    """(1, 3, H, W) float32 in [-1, 1] of an (H, W, 3) uint8 picture that fits the network."""
    scaled = pixels.astype(np.float32) / np.float32(255)
    return np.ascontiguousarray(((scaled - np.float32(0.5)) / np.float32(0.5)).transpose(2, 0, 1)[None])


def place_input(pixels: Pixels, kind: PlaceInput, side_px: int = 512) -> NDArray[np.float32]:
    """CosPlace's input (1, 3, H, W) float32.

    Args:
        pixels: (H, W, 3) uint8.
        kind: native: as it is; shorter-side: that side resized to `side_px`; swarm-slam: the central 376 px
            square resized to 224.
        side_px: For shorter-side.
    """
    picture = Pillow.fromarray(pixels)
    if kind == "swarm-slam":
        picture = center_cropped(picture, 376).resize((224, 224), Pillow.Resampling.BICUBIC)
    elif kind == "shorter-side":
        w, h = picture.size
        size = (side_px, int(side_px * h / w)) if w <= h else (int(side_px * w / h), side_px)
        picture = picture.resize(size, Pillow.Resampling.BILINEAR)
    scaled = np.asarray(picture).astype(np.float32) / np.float32(255)
    return np.ascontiguousarray(((scaled - IMAGENET_MEAN) / IMAGENET_STD).transpose(2, 0, 1)[None])


def center_cropped(picture: Pillow.Image, side: int) -> Pillow.Image:
    """Cut the central square, with black borders where the picture is smaller."""
    left, top = round((picture.width - side) / 2), round((picture.height - side) / 2)
    return picture.crop((left, top, left + side, top + side))


def without_distortion(image: Image) -> Image:
    """Remove lens distortion; the camera keeps its calibration matrix."""
    camera = image.camera
    if not any(camera.distortion):
        return image
    pixels = cv2.undistort(image.pixels, camera.K(), np.array(camera.distortion))
    pinhole = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return Image(np.asarray(pixels, np.uint8), pinhole)
