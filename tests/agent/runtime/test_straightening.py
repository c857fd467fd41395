"""A picture of a wide lens, once remapped, is the picture that a pinhole would have taken from there."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.lenses import CameraModel, LensKind
from flocc_agent.runtime.straightening import Straightener

LENSES = [
    CameraModel(400, 300, 200.0, 200.0, 199.5, 149.5, (0.03, -0.01, 0.004, -0.001), LensKind.EQUIDISTANT),
    CameraModel(400, 300, 160.0, 160.0, 199.5, 149.5, (), LensKind.DOUBLE_SPHERE, (-0.2, 0.59)),
    CameraModel(400, 300, 200.0, 200.0, 199.5, 149.5, (), LensKind.EUCM, (0.6, 1.1)),
    CameraModel(400, 300, 500.0, 500.0, 199.5, 149.5, (-0.1, 0.02, 0.001, 0.0), LensKind.OMNIDIRECTIONAL, (1.5,)),
    CameraModel(400, 300, 180.0, 180.0, 199.5, 149.5, (), LensKind.FOV, (0.9,)),
]


def brightness(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """A smooth world far away: its brightness in each direction (N, 3)."""
    x, y = (directions[..., k] / directions[..., 2] for k in (0, 1))
    return np.asarray(127 + 60 * np.sin(7 * x) * np.cos(5 * y) + 50 * np.sin(3 * x + 4 * y))


def pinhole_picture(camera: Camera) -> NDArray[np.float64]:
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(x.shape)]
    return brightness(np.stack(rays, axis=-1))


def wide_picture(model: CameraModel) -> NDArray[np.uint8]:
    """What the lens sees: each pixel's ray is found by iteration."""
    x, y = np.meshgrid(np.arange(model.width), np.arange(model.height))
    rays = np.stack([(x - model.cx) / model.fx, (y - model.cy) / model.fy, np.ones(x.shape)], axis=-1).reshape(-1, 3)
    wanted = np.stack([x.ravel(), y.ravel()], axis=1)
    for _ in range(60):
        pixels, _ = model.project(rays)
        rays[:, :2] += 0.7 * (wanted - pixels) / (model.fx, model.fy)
    return np.clip(brightness(rays).reshape(model.height, model.width), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("model", LENSES, ids=lambda model: model.kind.value)
def test_a_remapped_picture_is_a_pinholes(model: CameraModel) -> None:
    straightener = Straightener(model)
    assert straightener.is_needed
    found = straightener.apply(wide_picture(model)).astype(float)
    wanted = np.clip(pinhole_picture(straightener.camera), 0, 255)
    inner = (slice(8, -8), slice(8, -8))
    assert np.median(np.abs(found[inner] - wanted[inner])) < 1.0
    assert np.percentile(np.abs(found[inner] - wanted[inner]), 99) < 6.0


def test_colours_and_depth_are_kept() -> None:
    straightener = Straightener(LENSES[0])
    deep = np.full((300, 400, 3), 40000, np.uint16)
    assert straightener.apply(deep).dtype == np.uint16
    assert straightener.apply(deep).shape == (straightener.camera.height, straightener.camera.width, 3)


def test_all_coefficients_of_a_pinhole_are_used() -> None:
    """The corner (2, 2) of a rational model belongs to (4.9, 4.1); its first five coefficients would give (60, 45)."""
    distortion = (0.55, -2.6, 0.0007, -0.0003, 1.5, 0.43, -2.5, 1.46)
    model = CameraModel(160, 120, 150.5, 151.5, 80.0, 60.0, distortion)
    pixels = np.random.default_rng(1).integers(0, 255, (120, 160, 3)).astype(np.uint8)
    found = Straightener(model).apply(pixels)
    linear = cv2.undistort(pixels, model.K(), np.array(distortion))
    off = np.abs(found.astype(int) - linear)[4:-4, 4:-4]
    assert off.mean() < 0.5 * np.abs(pixels.astype(int) - linear)[4:-4, 4:-4].mean()
    place = cv2.undistortPoints(np.array([[[2.0, 2.0]]]), model.K(), np.array(model.distortion), P=model.K()).ravel()
    np.testing.assert_allclose(place, (4.88, 4.09), atol=0.01)


def test_four_coefficients_are_left_to_the_agent() -> None:
    straightener = Straightener(CameraModel(32, 24, 30.0, 30.0, 16.0, 12.0, (0.1, 0.0, 0.0, 0.0)))
    pixels = np.zeros((24, 32), np.uint8)
    assert straightener.apply(pixels) is pixels
    assert straightener.camera == Camera(32, 24, 30.0, 30.0, 16.0, 12.0, (0.1, 0.0, 0.0, 0.0))
