"""From a camera's image to the picture that is searched for features, and from its pixels to rays."""

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera

Float = NDArray[np.float64]


def reduced_to(image: NDArray[np.uint8], pixels_max: int, side_max: int | None = None) -> NDArray[np.uint8]:
    """Shrink an image (H, W) or (H, W, 3) to at most this many pixels and sides of this length; a smaller one stays."""
    height, width = image.shape[:2]
    factor = float(np.sqrt(pixels_max / (height * width)))
    if side_max is not None:
        factor = min(factor, side_max / max(height, width))
    if factor >= 1.0:
        return image
    size = max(round(width * factor), 1), max(round(height * factor), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def undistorted(pixels: Float, camera: Camera) -> Float:
    """Turn pixels (N, 2) into x/z and y/z (N, 2) in the camera frame, without distortion."""
    distortion = np.array(camera.distortion)
    if not np.any(distortion) or len(pixels) == 0:
        return (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    points = cv2.undistortPoints(pixels[:, None, :], camera.K(), distortion)
    return np.asarray(points, np.float64).reshape(-1, 2)


def distorted(points: Float, camera: Camera) -> Float:
    """Turn x/z and y/z (N, 2) in the camera frame into pixels (N, 2): what `undistorted` takes back."""
    if len(points) == 0:
        return points
    rays = np.column_stack([points, np.ones(len(points))])
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K(), np.array(camera.distortion))
    return np.asarray(pixels, np.float64).reshape(-1, 2)


def at_pixels(mask: NDArray[np.bool_], pixels: NDArray[np.floating]) -> NDArray[np.bool_]:
    """What a mask (H, W) says at pixels (N, 2); beyond its border what it says there."""
    height, width = mask.shape
    columns, rows = np.clip(np.rint(pixels).astype(np.intp), 0, [width - 1, height - 1]).T
    return np.asarray(mask[rows, columns])


def rays_of(pixels: Float, size_px: tuple[int, int], camera: Camera) -> tuple[Float, float]:
    """Rays (N, 2) of pixels in a picture that was made from a camera's image, and the focal length in its pixels."""
    factors = np.array([camera.width / size_px[0], camera.height / size_px[1]])
    focal_px = float(np.mean(np.array([camera.fx, camera.fy]) / factors))
    return undistorted((pixels + 0.5) * factors - 0.5, camera), focal_px
