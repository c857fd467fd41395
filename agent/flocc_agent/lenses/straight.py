"""The pinhole camera that a model's pictures are remapped to, and the map.

A pinhole whose distortion an agent's camera cannot say keeps its matrix and size. A wide lens becomes a pinhole of the
same angular resolution at its centre; its field of view is what was asked for, or the largest up to `WIDE_VIEW_MAX_RAD`
that the picture fills to its corners: black corners would look like features.
"""

import math

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.lenses.models import CameraModel, LensKind

Float = NDArray[np.float64]
Map = NDArray[np.float32]

WIDE_VIEW_MAX_RAD = math.radians(100.0)
"""A pinhole picture's corners stretch: at 100 degrees a pixel there sees 0.34 of what one in the middle sees."""
VIEW_LIMIT_RAD = math.radians(160.0)
SIDE_MAX_PX = 8192
_STEPS = 100


def straight_camera(model: CameraModel, view_rad: float | None = None) -> Camera:
    """The camera of a model's pictures once they are remapped; the model's own where that needs no remapping.

    Args:
        model: How the pictures were taken.
        view_rad: Horizontal field of view of the remapped pictures; None takes as much as there is.

    Raises:
        ValueError: The lens does not see so much, or the field of view is asked of a pinhole.
    """
    if model.kind is LensKind.PINHOLE:
        if view_rad is not None:
            raise ValueError("a field of view can only be chosen for a wide lens, not for a pinhole")
        plain = Camera(model.width, model.height, model.fx, model.fy, model.cx, model.cy)
        return model.agent_camera() or plain
    fx, fy = _central_focal(model)
    if view_rad is None:
        return _largest(model, fx, fy)
    if not 0 < view_rad < VIEW_LIMIT_RAD:
        raise ValueError(f"a pinhole's field of view is between 0 and {math.degrees(VIEW_LIMIT_RAD):g} degrees")
    largest = _largest(model, fx, fy, VIEW_LIMIT_RAD)
    half = math.tan(view_rad / 2)
    ratio = largest.height / fy / (largest.width / fx)
    wanted = _camera(fx, fy, half, half * ratio)
    if not _filled(model, wanted):
        seen = math.degrees(2 * math.atan(largest.width / 2 / fx))
        raise ValueError(f"the lens fills a pinhole of {seen:.0f} degrees at most, not of {math.degrees(view_rad):.0f}")
    return wanted


def pixel_map(model: CameraModel, camera: Camera) -> tuple[Map, Map]:
    """Where each pixel of a remapped picture is found in the picture of a wide lens.

    Returns:
        x and y, each (height, width) float32 of `camera`; -1 where the lens sees nothing.
    """
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels, valid = model.project(_rays(camera, x.ravel(), y.ravel()))
    pixels[~valid] = -1.0
    shape = (camera.height, camera.width)
    return pixels[:, 0].reshape(shape).astype(np.float32), pixels[:, 1].reshape(shape).astype(np.float32)


def _central_focal(model: CameraModel) -> tuple[float, float]:
    """Pixels per radian in the middle, along x and y."""
    step = 1e-4
    pixels, _ = model.project(np.array([[0.0, 0.0, 1.0], [step, 0.0, 1.0], [0.0, step, 1.0]]))
    return float((pixels[1, 0] - pixels[0, 0]) / step), float((pixels[2, 1] - pixels[0, 1]) / step)


def _largest(model: CameraModel, fx: float, fy: float, view_max_rad: float = WIDE_VIEW_MAX_RAD) -> Camera:
    half_max = math.tan(view_max_rad / 2)
    half_x, half_y = (_reach(model, axis, half_max) for axis in (0, 1))
    for step in range(_STEPS):
        camera = _camera(fx, fy, half_x * (1 - step / _STEPS), half_y * (1 - step / _STEPS))
        if _filled(model, camera):
            return camera
    raise ValueError("the lens model does not image what is in front of the camera")


def _reach(model: CameraModel, axis: int, half_max: float) -> float:
    """Tangent of the angle up to which the picture reaches to both sides along an axis."""
    tangents = half_max * np.arange(1, 1001) / 1000
    reach = half_max
    for side in (-1.0, 1.0):
        rays = np.zeros((len(tangents), 3))
        rays[:, axis], rays[:, 2] = side * tangents, 1.0
        seen = _inside(model, rays)
        reach = min(reach, float(tangents[np.argmin(seen) - 1]) if not seen.all() else half_max)
    return reach


def _camera(fx: float, fy: float, half_x: float, half_y: float) -> Camera:
    width, height = (min(max(round(2 * f * half), 2), SIDE_MAX_PX) for f, half in ((fx, half_x), (fy, half_y)))
    return Camera(width, height, fx, fy, (width - 1) / 2, (height - 1) / 2)


def _filled(model: CameraModel, camera: Camera) -> bool:
    """Whether the border of a remapped picture lies inside of the lens's picture."""
    x, y = np.arange(camera.width), np.arange(camera.height)
    right, below = camera.width - 1, camera.height - 1
    sides = [(x, 0 * x), (x, 0 * x + below), (0 * y, y), (0 * y + right, y)]
    return all(bool(_inside(model, _rays(camera, *side)).all()) for side in sides)


def _inside(model: CameraModel, rays: Float) -> NDArray[np.bool_]:
    pixels, valid = model.project(rays)
    across = (pixels[:, 0] >= 0) & (pixels[:, 0] <= model.width - 1)
    return np.asarray(valid & across & (pixels[:, 1] >= 0) & (pixels[:, 1] <= model.height - 1))


def _rays(camera: Camera, x: NDArray[np.int_], y: NDArray[np.int_]) -> Float:
    return np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(len(x))], axis=1)
