"""Preparation of pictures: bit for bit as the reference, with the calibration carried along."""

import hashlib

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch, an optional extra, is not installed")

from tests.agent.perception.mast3r_examples import golden

from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.perception.mast3r.preprocess import (
    BadImage,
    mast3r_input,
    plan_crop,
    resized,
    without_distortion,
)


@pytest.mark.golden
def test_sizes_of_all_golden_pictures_are_the_references() -> None:
    for record in golden("pre.pt")["recs"]:
        crop = plan_crop(record["W"], record["H"], record["size"])
        assert [[crop.height, crop.width]] == record["true_shape"].tolist()


@pytest.mark.golden
def test_pixels_of_the_full_golden_pictures_are_bit_exact() -> None:
    records = [record for record in golden("pre.pt")["recs"] if "inp" in record]
    assert len(records) == 3
    for record in records:
        pixels = resized(record["inp"].numpy(), plan_crop(record["W"], record["H"], record["size"]))
        assert np.array_equal(pixels.transpose(2, 0, 1), record["out_u8"].numpy())
        assert hashlib.sha256(pixels.tobytes()).hexdigest() == record["sha"]
        network_input = mast3r_input(pixels)
        expected = (pixels.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255) - np.float32(0.5)) / 0.5
        assert np.array_equal(network_input, expected.astype(np.float32))


@pytest.mark.parametrize(
    ("width", "height", "expected"),
    [(752, 480, (512, 320)), (1224, 1024, (512, 416)), (1241, 376, (512, 144)), (480, 640, (384, 512))],
)
def test_named_cameras_get_their_input_size(width: int, height: int, expected: tuple[int, int]) -> None:
    crop = plan_crop(width, height)
    assert (crop.width, crop.height) == expected


def test_a_point_lands_on_the_same_pixel_through_calibration_and_through_the_crop() -> None:
    K = np.array([[400.0, 0, 370.5], [0, 410.0, 250.25], [0, 0, 1]])
    crop = plan_crop(752, 480)
    p = np.array([0.3, -0.2, 1.7])
    of_input = (crop.K(K) @ p)[:2] / p[2]
    assert np.allclose(crop.to_source(of_input[None])[0], (K @ p)[:2] / p[2])


def test_resizing_maps_pixel_centres_as_the_calibration_says() -> None:
    ramp = np.repeat(np.arange(240, dtype=np.uint8)[None, :], 180, axis=0)
    crop = plan_crop(240, 180)
    row = resized(np.repeat(ramp[:, :, None], 3, axis=2), crop)[100, :, 0].astype(float)
    u = np.arange(40, 470)
    source = crop.to_source(np.stack([u, np.full_like(u, 100)], axis=1).astype(float))[:, 0]
    assert np.abs(row[u] - source).max() < 1.0


def test_distortion_is_removed_and_the_calibration_kept() -> None:
    camera = Camera(160, 120, 120.0, 120.0, 80.0, 60.0, (-0.3, 0.1, 0.0, 0.0))
    pixels = np.zeros((120, 160, 3), np.uint8)
    pixels[:, 20:22] = 255
    straight = without_distortion(Image(pixels, camera))
    assert straight.camera == Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
    columns = straight.pixels[:, :60, 0].argmax(axis=1)
    assert columns[5] != columns[60]


@pytest.mark.parametrize("size", [(1, 500), (4000, 40), (20_000, 20_000)])
def test_pictures_that_leave_no_input_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(BadImage, match="pixels"):
        plan_crop(*size)


@pytest.mark.parametrize("size", [(2, 3), (8000, 6000), (40, 30)])
def test_tiny_and_huge_pictures_fit(size: tuple[int, int]) -> None:
    crop = plan_crop(*size)
    assert min(crop.width, crop.height) >= 16
    assert max(crop.width, crop.height) == 512
