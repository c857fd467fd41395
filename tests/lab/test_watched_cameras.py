"""The table of what the watch over cameras names: its cells, and that cached features are the encoder's own."""

from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.config import ClassicalConfig
from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.perception.classical.encoder import ClassicalEncoder, decode_features
from flocc_lab.bench.watched_cameras import CachedFeatures, Trouble, Watched, cell, counted, covered, zoomed
from flocc_lab.bench.watched_drives import drawn_town

CAMERA = Camera(640, 480, 500.0, 510.0, 320.0, 250.0, (-0.2, 0.05, 0.001, 0.0))
FOCAL = Trouble("f 0.8", "focal length")


def picture() -> Image:
    pixels = np.kron(np.random.default_rng(3).integers(0, 256, (60, 80, 3), dtype=np.uint8), np.ones((8, 8, 1)))
    return Image(pixels.astype(np.uint8), CAMERA)


@pytest.mark.parametrize("factor", [1.0, 0.8])
def test_cached_features_are_those_of_the_encoder_with_that_camera(factor: float) -> None:
    eyes, image = CachedFeatures(), picture()
    eyes.encode(image)
    wrong = replace(image, camera=zoomed(factor)(CAMERA))
    cached, own = (
        decode_features(eyes.encode(wrong)),
        decode_features(ClassicalEncoder(ClassicalConfig()).encode(wrong)),
    )
    assert len(own.points) > 50
    np.testing.assert_allclose(cached.points, own.points, atol=1e-4)
    np.testing.assert_array_equal(cached.descriptors, own.descriptors)
    assert cached.focal_px == pytest.approx(own.focal_px, rel=1e-4)


def test_a_cell_says_when_and_what_else() -> None:
    found = Watched(9, (("mounting", 6, 5.0), ("focal length", 9, 1.2)), 1.0)
    assert cell(found, FOCAL) == "9 [mounting at 6]"
    assert cell(Watched(40, (), 1.0), FOCAL) == "-"
    assert cell(Watched(40, (("overlay", 3, 0.1),), 1.0), Trouble("right", "")) == "[overlay at 3]"
    assert cell(Watched(40, (), 1.0), Trouble("right", "")) == ""


def test_late_and_wrong_names_are_counted_apart() -> None:
    found = [Watched(9, (("focal length", k, 1.2),), 1.0) for k in (6, 20, 21)]
    found += [Watched(40, (("mounting", 6, 5.0),), 1.0), Watched(40, (), 1.0)]
    assert counted(found, FOCAL) == "2 + 1 late, 1 otherwise"


def test_an_overlay_covers_its_share_and_is_the_same_each_time() -> None:
    pixels = picture().pixels
    cover = covered(0.3)(pixels)
    assert cover.shape == pixels.shape
    assert np.array_equal(cover[:336], pixels[:336])
    assert np.array_equal(cover[336:], covered(0.3)(255 - pixels)[336:])


def test_a_seed_draws_one_town_and_others_draw_others() -> None:
    assert drawn_town(1601) == drawn_town(1601)
    assert len({drawn_town(seed)[2] for seed in range(1601, 1613)}) == 12
