"""The table of what the watch over cameras names: its cells, and that cached features are the encoder's own."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from flocc_agent.config import ClassicalConfig
from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.perception.classical.encoder import ClassicalEncoder, decode_features
from flocc_lab.bench.drawn_overlays import KINDS, overlay
from flocc_lab.bench.overlaid_recording import main, touched
from flocc_lab.bench.watched_cameras import CachedFeatures, Trouble, WatchedDrive, cell, counted, zoomed
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
    found = WatchedDrive(9, (("mounting", 6, 5.0), ("focal length", 9, 1.2)), 1.0)
    assert cell(found, FOCAL) == "9 [mounting at 6]"
    assert cell(WatchedDrive(40, (), 1.0), FOCAL) == "-"
    assert cell(WatchedDrive(40, (("overlay", 3, 0.1),), 1.0), Trouble("right", "")) == "[overlay at 3]"
    assert cell(WatchedDrive(40, (), 1.0), Trouble("right", "")) == ""


def test_late_and_wrong_names_are_counted_apart() -> None:
    found = [WatchedDrive(9, (("focal length", k, 1.2),), 1.0) for k in (6, 20, 21)]
    found += [WatchedDrive(40, (("mounting", 6, 5.0),), 1.0), WatchedDrive(40, (), 1.0)]
    assert counted(found, FOCAL) == "2 + 1 late, 1 otherwise"


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_an_overlay_touches_about_its_share_and_a_seed_is_a_drawing(kind: str) -> None:
    cover = overlay(kind, (640, 480), 0.3, 1)
    assert 0.1 < np.mean(touched(cover, (640, 480))) < 0.6
    pixels = picture().pixels
    assert cover(pixels, 3).shape == pixels.shape
    assert np.array_equal(cover(pixels, 3), overlay(kind, (640, 480), 0.3, 1)(pixels, 3))
    changes = not np.array_equal(cover(pixels, 3), cover(pixels, 4))
    assert changes == (kind in {"clock", "propeller"})


def test_overlaid_robots_keep_all_but_their_pictures_lower_part(tmp_path: Path) -> None:
    for robot in ("r1", "r2"):
        folder = tmp_path / "data" / robot
        (folder / "images").mkdir(parents=True)
        (folder / "odometry.txt").write_text("0 0 0 0 0 0 0 1\n")
        cv2.imwrite(str(folder / "images" / "0.png"), picture().pixels)
    main([str(tmp_path / "data"), str(tmp_path / "out"), "--share", "0.5", "--moved", "--mask"])
    seen = [np.asarray(cv2.imread(str(tmp_path / "out" / robot / "images" / "0.png"))) for robot in ("r1", "r2")]
    mask = cv2.imread(str(tmp_path / "out" / "r1" / "mask.png"), cv2.IMREAD_GRAYSCALE)
    assert mask is not None
    assert np.array_equal(np.flatnonzero(np.any(seen[0] != picture().pixels, axis=(1, 2))), np.arange(240, 480))
    assert np.mean(mask[240:] == 0) > 0.95
    assert mask[:240].all()
    assert np.array_equal(seen[0][240:, :600], seen[1][240:, 12:612])
    assert (tmp_path / "out" / "r1" / "odometry.txt").read_text() == "0 0 0 0 0 0 0 1\n"


def test_a_seed_draws_one_town_and_others_draw_others() -> None:
    assert drawn_town(1601) == drawn_town(1601)
    assert len({drawn_town(seed)[2] for seed in range(1601, 1613)}) == 12
