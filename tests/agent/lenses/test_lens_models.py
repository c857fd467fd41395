"""Each model images rays where its publication says, and a wide lens becomes a pinhole that its picture fills."""

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.lenses import CameraModel, LensKind, pixel_map, straight_camera

Float = NDArray[np.float64]

SIZE_AND_FOCAL = (640, 480, 300.0, 310.0, 321.0, 238.0)
RAYS = np.random.default_rng(1).normal(size=(200, 3)) * (1, 1, 0.3) + (0, 0, 1.2)


def model(kind: LensKind, shape: tuple[float, ...] = (), distortion: tuple[float, ...] = ()) -> CameraModel:
    return CameraModel(*SIZE_AND_FOCAL, distortion, kind, shape)


def pinhole_pixels(rays: Float) -> Float:
    return np.asarray(rays[:, :2] / rays[:, 2:] * (300.0, 310.0) + (321.0, 238.0))


def test_equidistant_is_opencvs_fisheye() -> None:
    fisheye = model(LensKind.EQUIDISTANT, distortion=(0.05, -0.02, 0.01, -0.003))
    pixels, valid = fisheye.project(RAYS)
    wanted, _ = cv2.fisheye.projectPoints(
        RAYS[:, None], np.zeros(3), np.zeros(3), fisheye.K(), np.array(fisheye.distortion)
    )
    assert valid.all()
    np.testing.assert_allclose(pixels, wanted[:, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "shape"),
    [(LensKind.OMNIDIRECTIONAL, (0.0,)), (LensKind.DOUBLE_SPHERE, (0.0, 0.0)), (LensKind.EUCM, (0.0, 1.0))],
)
def test_spheres_without_shape_are_pinholes(kind: LensKind, shape: tuple[float, ...]) -> None:
    pixels, _ = model(kind, shape).project(RAYS)
    np.testing.assert_allclose(pixels, pinhole_pixels(RAYS), rtol=1e-9)


def test_the_unified_model_is_a_case_of_all_three_spheres() -> None:
    """Mei's xi is the double sphere's with alpha 0, and EUCM's alpha / (1 - alpha) with beta 1 and a longer focus."""
    xi, alpha = 0.8, 0.8 / 1.8
    unified, _ = model(LensKind.OMNIDIRECTIONAL, (xi,)).project(RAYS)
    double, _ = model(LensKind.DOUBLE_SPHERE, (xi, 0.0)).project(RAYS)
    extended, _ = model(LensKind.EUCM, (alpha, 1.0)).project(RAYS)
    np.testing.assert_allclose(double, unified, rtol=1e-9)
    centre = np.array([321.0, 238.0])
    np.testing.assert_allclose((extended - centre) * (1 - alpha), unified - centre, rtol=1e-9, atol=1e-9)


def test_mei_bends_the_plane_as_opencv_does() -> None:
    distortion = (-0.2, 0.05, 0.001, -0.002)
    rays = RAYS[np.hypot(*RAYS[:, :2].T) < RAYS[:, 2]]
    pixels, _ = model(LensKind.OMNIDIRECTIONAL, (0.0,), distortion).project(rays)
    wanted, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), model(LensKind.PINHOLE).K(), np.array(distortion))
    np.testing.assert_allclose(pixels, wanted[:, 0], rtol=1e-9)


def test_fov_grows_by_the_arc_tangent_of_its_paper() -> None:
    omega = 0.9
    pixels, _ = model(LensKind.FOV, (omega,)).project(np.array([[0.5, 0.0, 1.0]]))
    assert pixels[0, 0] - 321.0 == pytest.approx(300.0 * math.atan(2 * 0.5 * math.tan(omega / 2)) / omega)


def test_what_lies_behind_is_not_imaged() -> None:
    behind = np.array([[0.1, 0.0, -1.0]])
    shapes = {LensKind.OMNIDIRECTIONAL: (0.9,), LensKind.DOUBLE_SPHERE: (-0.2, 0.6), LensKind.EUCM: (0.6, 1.1)}
    for kind, shape in shapes.items():
        assert not model(kind, shape).project(behind)[1][0]
    folding = model(LensKind.EQUIDISTANT, distortion=(-0.5, 0.0, 0.0, 0.0))
    assert folding.project(np.array([[0.5, 0.0, 1.0], [3.0, 0.0, 1.0]]))[1].tolist() == [True, False]


@pytest.mark.parametrize(
    ("kind", "shape", "distortion", "said"),
    [
        (LensKind.PINHOLE, (), (0.1, 0.2, 0.3), "has 0, 4, 5, 8, 12, 14 distortion coefficients, not 3"),
        (LensKind.DOUBLE_SPHERE, (0.1,), (), "has 2 shape parameters"),
        (LensKind.DOUBLE_SPHERE, (0.1, 1.5), (), "alpha must be between 0 and 1"),
        (LensKind.EUCM, (0.5, -1.0), (), "beta positive"),
        (LensKind.FOV, (0.0,), (), "omega is 0"),
        (LensKind.OMNIDIRECTIONAL, (float("nan"),), (), "must be finite"),
    ],
)
def test_a_model_that_cannot_be_is_refused(
    kind: LensKind, shape: tuple[float, ...], distortion: tuple[float, ...], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        model(kind, shape, distortion)


def test_zeros_behind_the_last_coefficient_do_not_matter() -> None:
    long = model(LensKind.PINHOLE, distortion=(0.1, 0.2, 0.3, 0.4, 0.0, 0.0, 0.0, 0.0))
    assert long == model(LensKind.PINHOLE, distortion=(0.1, 0.2, 0.3, 0.4))
    assert long.agent_camera() == Camera(*SIZE_AND_FOCAL, (0.1, 0.2, 0.3, 0.4))
    assert model(LensKind.PINHOLE, distortion=(0.1, 0.2, 0.3, 0.4, 0.5)).agent_camera() is None


WIDE = [
    CameraModel(512, 512, 190.97, 190.97, 254.9, 256.9, (0.0034, 0.0007, -0.002, 0.0002), LensKind.EQUIDISTANT),
    CameraModel(752, 480, 200.0, 200.0, 376.0, 240.0, (), LensKind.DOUBLE_SPHERE, (-0.2, 0.59)),
    CameraModel(752, 480, 250.0, 250.0, 370.0, 245.0, (), LensKind.EUCM, (0.6, 1.1)),
    CameraModel(752, 480, 600.0, 600.0, 370.0, 245.0, (-0.2, 0.02, 0.0, 0.0), LensKind.OMNIDIRECTIONAL, (1.5,)),
    CameraModel(640, 480, 260.0, 260.0, 320.0, 240.0, (), LensKind.FOV, (0.9,)),
]


@pytest.mark.parametrize("wide", WIDE, ids=lambda wide: wide.kind.value)
def test_a_wide_picture_fills_its_pinhole_to_the_corners(wide: CameraModel) -> None:
    camera = straight_camera(wide)
    assert camera.distortion == (0.0, 0.0, 0.0, 0.0)
    x, y = pixel_map(wide, camera)
    assert x.shape == (camera.height, camera.width)
    assert x.min() >= 0
    assert x.max() <= wide.width - 1
    assert y.min() >= 0
    assert y.max() <= wide.height - 1
    assert 2 * math.degrees(math.atan(camera.width / 2 / camera.fx)) > 60


@pytest.mark.parametrize("wide", WIDE, ids=lambda wide: wide.kind.value)
def test_a_pinhole_has_the_angular_resolution_of_the_middle_of_its_lens(wide: CameraModel) -> None:
    camera = straight_camera(wide)
    pixels, _ = wide.project(np.array([[0.0, 0.0, 1.0], [1e-3, 0.0, 1.0]]))
    assert camera.fx == pytest.approx((pixels[1, 0] - pixels[0, 0]) / 1e-3, rel=1e-3)


def test_the_field_of_view_is_as_chosen_or_refused() -> None:
    camera = straight_camera(WIDE[0], math.radians(80.0))
    assert 2 * math.degrees(math.atan(camera.width / 2 / camera.fx)) == pytest.approx(80.0, abs=0.3)
    with pytest.raises(ValueError, match=r"fills a pinhole of \d+ degrees at most, not of 150"):
        straight_camera(WIDE[4], math.radians(150.0))
    with pytest.raises(ValueError, match="only be chosen for a wide lens"):
        straight_camera(model(LensKind.PINHOLE), 1.0)
