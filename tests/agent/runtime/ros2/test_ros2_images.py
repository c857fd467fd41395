"""Images and intrinsics of ROS messages: every encoding, padding, byte order; what is refused, and how."""

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.agent.runtime.ros2 import cdr_by_hand

from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.lenses import CameraModel, LensKind
from flocc_agent.runtime.ros2.incoming import Eye, model_of
from flocc_agent.runtime.ros2.types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, BadMessage, MessageTypes
from flocc_agent.runtime.straightening import Straightener

TYPES = MessageTypes()
STAMP = (12, 34)
HEIGHT, WIDTH = 6, 8
CAMERA = Camera(WIDTH, HEIGHT, 5.0, 6.0, 4.0, 3.0)
MODEL = CameraModel.of_camera(CAMERA)
RGB = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
GREY = RGB[..., 0]
K = (5.0, 0.0, 4.0, 0.0, 6.0, 3.0, 0.0, 0.0, 1.0)
P = (7.0, 0.0, 4.5, 0.0, 0.0, 8.0, 3.5, 0.0, 0.0, 0.0, 1.0, 0.0)


def read(encoding: str, pixels: NDArray[Any], padding: int = 0, big: int = 0) -> Image:
    """What comes out of rows that are padded with junk."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(HEIGHT, -1)
    padded = np.concatenate([rows, np.full((HEIGHT, padding), 77, np.uint8)], axis=1)
    payload = cdr_by_hand.image(STAMP, "cam", (HEIGHT, WIDTH), encoding, padded.tobytes(), padded.shape[1], big)
    return Eye(MODEL).image(TYPES.read(payload, IMAGE))


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("8UC3", RGB[..., ::-1]),
        ("rgba8", np.dstack([RGB, GREY])),
        ("bgra8", np.dstack([RGB[..., ::-1], GREY])),
    ],
)
def test_colours_come_out_as_rgb(encoding: str, pixels: NDArray[np.uint8], padding: int) -> None:
    image = read(encoding, pixels, padding)
    np.testing.assert_array_equal(image.pixels, RGB)
    assert image.camera == CAMERA


@pytest.mark.parametrize("padding", [0, 4])
@pytest.mark.parametrize(
    ("encoding", "pixels", "big"),
    [
        ("mono8", GREY, 0),
        ("8UC1", GREY, 0),
        ("mono16", (GREY.astype("<u2") << 8) + 200, 0),
        ("mono16", ((GREY.astype("<u2") << 8) + 200).astype(">u2"), 1),
    ],
)
def test_grey_comes_out_in_all_three_channels(encoding: str, pixels: NDArray[Any], big: int, padding: int) -> None:
    np.testing.assert_array_equal(read(encoding, pixels, padding, big).pixels, np.dstack([GREY] * 3))


def test_a_colour_filter_is_interpolated() -> None:
    mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
    mosaic[0::2, 0::2] = 200  # red of rggb
    image = read("bayer_rggb8", mosaic)
    assert image.pixels[2, 4].tolist() == [200, 0, 0]


@pytest.mark.parametrize(
    ("encoding", "said"),
    [
        ("16UC1", "images are encoded as '16UC1', which is how depth is published; a grey camera publishes mono16"),
        ("yuv444", "encoded as 'yuv444'; flocc reads mono8, 8UC1, mono16, rgb8, bgr8"),
        ("32FC1", "encoded as '32FC1'"),
        ("", "encoded as ''"),
    ],
)
def test_an_encoding_that_is_not_read_is_refused_by_name(encoding: str, said: str) -> None:
    with pytest.raises(BadMessage, match=said):
        read(encoding, RGB)


def test_an_image_with_fewer_bytes_than_its_size_is_refused() -> None:
    payload = cdr_by_hand.image(STAMP, "cam", (HEIGHT, WIDTH), "rgb8", bytes(10), 3 * WIDTH)
    with pytest.raises(BadMessage, match="an image has 10 bytes, too few for its size"):
        Eye(MODEL).image(TYPES.read(payload, IMAGE))
    short_step = cdr_by_hand.image(STAMP, "cam", (HEIGHT, WIDTH), "rgb8", bytes(3 * WIDTH * HEIGHT), WIDTH)
    with pytest.raises(BadMessage, match="too few"):
        Eye(MODEL).image(TYPES.read(short_step, IMAGE))


def test_an_image_without_pixels_is_refused() -> None:
    for encoding in ("mono8", "bayer_rggb8"):
        payload = cdr_by_hand.image(STAMP, "cam", (0, WIDTH), encoding, b"", WIDTH)
        with pytest.raises(BadMessage, match="an image has no pixels"):
            Eye(MODEL).image(TYPES.read(payload, IMAGE))


def test_an_image_of_another_size_than_the_intrinsics_is_refused() -> None:
    payload = cdr_by_hand.image(STAMP, "cam", (2, 2), "mono8", bytes(4), 2)
    with pytest.raises(BadMessage, match="an image is 2x2, but the intrinsics are for 8x6"):
        Eye(MODEL).image(TYPES.read(payload, IMAGE))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_compressed_images_are_read(suffix: str) -> None:
    smooth = cv2.resize(RGB[:2, :2], (WIDTH, HEIGHT))
    encoded = cv2.imencode(suffix, smooth[..., ::-1])[1].tobytes()
    payload = cdr_by_hand.compressed_image(STAMP, "cam", "rgb8; jpeg compressed bgr8", encoded)
    image = Eye(MODEL).image(TYPES.read(payload, COMPRESSED_IMAGE))
    np.testing.assert_allclose(image.pixels.astype(int), smooth.astype(int), atol=0 if suffix == ".png" else 40)


@pytest.mark.parametrize("data", [b"", b"no image", b"\xff\xd8\xff"])
def test_a_damaged_compressed_image_is_refused(data: bytes) -> None:
    payload = cdr_by_hand.compressed_image(STAMP, "cam", "h264", data)
    with pytest.raises(BadMessage, match="compressed as 'h264' cannot be read: the image is"):
        Eye(MODEL).image(TYPES.read(payload, COMPRESSED_IMAGE))


def lens(
    D: tuple[float, ...] = (),
    rectified: bool = False,
    model: str = "plumb_bob",
    k: tuple[float, ...] = K,
    size: tuple[int, int] = (HEIGHT, WIDTH),
) -> CameraModel:
    payload = cdr_by_hand.camera_info(STAMP, "cam", size, k, D, P, model)
    return model_of(TYPES.read(payload, CAMERA_INFO), rectified)


def test_intrinsics_are_read_for_raw_and_for_rectified_images() -> None:
    assert lens((0.1, 0.2, 0.3, 0.4, 0.0)) == CameraModel(WIDTH, HEIGHT, 5.0, 6.0, 4.0, 3.0, (0.1, 0.2, 0.3, 0.4))
    assert lens((0.1, 0.2, 0.3, 0.4, 0.5), rectified=True) == CameraModel(WIDTH, HEIGHT, 7.0, 8.0, 4.5, 3.5)


def test_a_third_radial_coefficient_is_taken_out_of_the_image() -> None:
    big = CameraModel(80, 60, 50.0, 50.0, 40.0, 30.0, (0.1, 0.0, 0.0, 0.0, -0.2))
    pixels = cv2.resize(RGB, (80, 60))
    payload = cdr_by_hand.image(STAMP, "cam", (60, 80), "rgb8", pixels.tobytes(), 240)
    image = Eye(big).image(TYPES.read(payload, IMAGE))
    expected = cv2.undistort(pixels, big.K(), np.array([0.1, 0.0, 0.0, 0.0, -0.2]))
    off = np.abs(image.pixels.astype(int) - expected)[4:-4, 4:-4]  # OpenCV rounds its map
    assert off.mean() < 1.5
    assert np.abs(pixels.astype(int) - expected)[4:-4, 4:-4].mean() > 2 * off.mean()
    assert image.camera == Camera(80, 60, 50.0, 50.0, 40.0, 30.0)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"model": "equidistant"}, "'equidistant' has 4 coefficients, but there are 0"),
        ({"model": "inverse_brown"}, "the distortion model is 'inverse_brown'; flocc reads plumb_bob"),
        ({"D": (0.1,) * 8}, "'plumb_bob' has 0 or 4 or 5 coefficients, but there are 8"),
        ({"k": (0.0,) * 9}, "focal lengths positive"),
        ({"k": (float("nan"),) * 9}, "must be finite"),
        ({"k": (5.0, 0.5, 4.0, 0.0, 6.0, 3.0, 0.0, 0.0, 1.0)}, "K has a skew of 0.5 pixels"),
    ],
)
def test_intrinsics_that_cannot_be_used_are_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(BadMessage, match=said):
        lens(**changes)


@pytest.mark.parametrize(
    ("encoding", "stored", "wanted"),
    [
        ("rgb16", RGB.astype("<u2") << 8, RGB),
        ("bgr16", (RGB[..., ::-1].astype("<u2") << 8), RGB),
        ("rgba16", (np.dstack([RGB, GREY]).astype("<u2") << 8), RGB),
        ("8UC4", np.dstack([RGB[..., ::-1], GREY]), RGB),
    ],
)
def test_deep_colours_come_out_as_rgb(encoding: str, stored: NDArray[Any], wanted: NDArray[np.uint8]) -> None:
    bright = stored.copy()
    np.testing.assert_allclose(read(encoding, bright).pixels.astype(int), wanted.astype(int), atol=1)


@pytest.mark.parametrize(
    ("encoding", "code", "channels"),
    [("yuv422", "UYVY", 2), ("uyvy", "UYVY", 2), ("yuv422_yuy2", "YUYV", 2), ("yuyv", "YUYV", 2)],
)
def test_yuv_is_brought_to_rgb(encoding: str, code: str, channels: int) -> None:
    """Chroma in the middle is grey, and luma is where the layout says."""
    luma = np.full((HEIGHT, WIDTH), 126, np.uint8)
    pair = [luma, np.full_like(luma, 128)]
    stored = np.dstack(pair if code == "YUYV" else pair[::-1])
    found = read(encoding, stored).pixels
    assert np.ptp(found) <= 1
    assert abs(int(found[0, 0, 0]) - round((126 - 16) * 255 / 219)) <= 1


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_planes_of_luma_and_chroma_are_put_together(encoding: str) -> None:
    planes = np.concatenate([np.full((HEIGHT, WIDTH), 126, np.uint8), np.full((HEIGHT // 2, WIDTH), 128, np.uint8)])
    payload = cdr_by_hand.image(STAMP, "cam", (HEIGHT, WIDTH), encoding, planes.tobytes(), WIDTH, 0)
    found = Eye(MODEL).image(TYPES.read(payload, IMAGE)).pixels
    assert found.shape == (HEIGHT, WIDTH, 3)
    assert np.ptp(found) <= 1


def test_a_colour_filter_of_sixteen_bits_is_interpolated() -> None:
    mosaic = np.zeros((HEIGHT, WIDTH), "<u2")
    mosaic[0::2, 0::2] = 200 << 8
    assert read("bayer_rggb16", mosaic).pixels[2, 4].tolist() == [200, 0, 0]


def test_a_sensor_of_twelve_bits_is_not_black_and_levels_only_widen() -> None:
    eye = Eye(MODEL)

    def seen(pixels: NDArray[Any]) -> NDArray[np.uint8]:
        payload = cdr_by_hand.image(STAMP, "cam", (HEIGHT, WIDTH), "mono16", pixels.tobytes(), 2 * WIDTH, 0)
        return eye.image(TYPES.read(payload, IMAGE)).pixels[..., 0]

    ramp = np.linspace(0, 4080, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype("<u2")
    np.testing.assert_array_equal(seen(ramp), (ramp >> 4).astype(np.uint8))
    np.testing.assert_array_equal(seen((ramp << 4).astype("<u2")), ((ramp << 4) >> 8).astype(np.uint8))
    np.testing.assert_array_equal(seen(ramp), (ramp >> 8).astype(np.uint8))


def test_a_live_wide_lens_is_remapped_to_a_pinhole() -> None:
    model = lens(
        (0.01, 0.0, 0.0, 0.0), model="equidistant", k=(50.0, 0.0, 40.0, 0.0, 50.0, 30.0, 0.0, 0.0, 1.0), size=(60, 80)
    )
    assert model.kind is LensKind.EQUIDISTANT
    pixels = cv2.resize(RGB, (80, 60))
    payload = cdr_by_hand.image(STAMP, "cam", (60, 80), "rgb8", pixels.tobytes(), 240)
    image = Eye(model).image(TYPES.read(payload, IMAGE))
    straightener = Straightener(model)
    assert image.camera == straightener.camera
    assert image.camera.width != 80
    np.testing.assert_array_equal(image.pixels, straightener.apply(pixels))
    narrow = Eye(model, np.radians(40.0)).image(TYPES.read(payload, IMAGE)).camera
    assert 2 * np.degrees(np.arctan(narrow.width / 2 / narrow.fx)) == pytest.approx(40.0, abs=1.0)
    with pytest.raises(BadMessage, match="the lens fills a pinhole of"):
        Eye(model, np.radians(150.0))


def test_eight_coefficients_of_a_rational_model_are_all_used() -> None:
    D = (0.55, -2.6, 0.0007, -0.0003, 1.5, 0.43, -2.5, 1.46)
    assert lens(D, model="rational_polynomial").distortion == D


@pytest.mark.parametrize(
    ("form", "expected"),
    [
        ("bayer_rggb8; png compressed ", (200, 60, 20)),
        ("bayer_rggb8; png compressed bgr8", (60, 60, 60)),
        ("mono8; png compressed ", (60, 60, 60)),
    ],
)
def test_a_mosaic_that_was_compressed_as_it_is_gets_its_colours(form: str, expected: tuple[int, ...]) -> None:
    mosaic = np.tile(np.array([[200, 60], [60, 20]], dtype=np.uint8), (HEIGHT // 2, WIDTH // 2))
    encoded = cv2.imencode(".png", mosaic)[1].tobytes()
    image = Eye(MODEL).image(TYPES.read(cdr_by_hand.compressed_image(STAMP, "cam", form, encoded), COMPRESSED_IMAGE))
    assert tuple(image.pixels[2, 3]) == expected
