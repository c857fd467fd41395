"""The classical front end on generated images: descriptors, features, latents and the codebook."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.config import ClassicalConfig
from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.core.registration import Registration, RegistrationFailed
from flocc_agent.perception.classical import ClassicalDescriber, ClassicalEncoder, classical_registrar
from flocc_agent.perception.classical.codebook import load_codebook, save_codebook
from flocc_agent.perception.classical.encoder import decode_features
from flocc_agent.perception.classical.matching import mutual_matches
from flocc_agent.perception.classical.patches import dense_patches
from flocc_agent.perception.multiview.picture import undistorted
from flocc_agent.perception.multiview.two_view import TwoView, two_view
from flocc_agent.perception.multiview.view_parameters import Geometry
from flocc_lab.codebook.procedural import HEIGHT, WIDTH, random_scene, random_view
from flocc_lab.codebook.training import train

CAMERA = Camera(WIDTH, HEIGHT, 300.0, 300.0, WIDTH / 2, HEIGHT / 2)


def rgb(grey: NDArray[np.uint8], camera: Camera = CAMERA) -> Image:
    return Image(np.ascontiguousarray(np.repeat(grey[:, :, None], 3, axis=2)), camera)


def views(scenes: int, seed: int) -> list[tuple[Image, Image]]:
    rng = np.random.default_rng(seed)
    return [(rgb(random_view(s, rng)), rgb(random_view(s, rng))) for s in (random_scene(rng) for _ in range(scenes))]


def test_views_of_one_scene_are_more_similar_than_views_of_two() -> None:
    describer = ClassicalDescriber(ClassicalConfig())
    pairs = views(10, seed=99)  # the codebook was learnt with another seed

    first, second = (np.array([describer.describe(pair[k]) for pair in pairs]) for k in (0, 1))
    similarity = first @ second.T

    own, others = np.diag(similarity), similarity[~np.eye(len(pairs), dtype=bool)]
    assert np.mean(similarity.argmax(axis=1) == np.arange(len(pairs))) > 0.8
    assert np.median(own) > np.percentile(others, 95)


def test_a_descriptor_has_unit_length_and_at_most_512_numbers() -> None:
    describer = ClassicalDescriber(ClassicalConfig())

    descriptor = describer.describe(views(1, seed=1)[0][0])

    assert descriptor.shape == (describer.dimension,)
    assert descriptor.dtype == np.float32
    assert describer.dimension <= 512
    assert np.linalg.norm(descriptor) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("size", [(480, 640), (1, 1), (1500, 30), (30, 1500)])
def test_an_image_of_one_colour_is_described_and_encoded_without_features(size: tuple[int, int]) -> None:
    height, width = size
    image = rgb(np.full(size, 128, np.uint8), Camera(width, height, 300.0, 300.0, width / 2, height / 2))

    descriptor = ClassicalDescriber(ClassicalConfig()).describe(image)
    latent = ClassicalEncoder(ClassicalConfig()).encode(image)

    assert np.linalg.norm(descriptor) == pytest.approx(1.0, abs=1e-5)
    assert len(decode_features(latent).points) == 0


def test_a_latent_has_136_bytes_per_feature_and_a_small_header() -> None:
    image = views(1, seed=2)[0][0]

    latent = ClassicalEncoder(ClassicalConfig(features_max=200)).encode(image)

    count = len(decode_features(latent).points)
    assert 50 < count <= 200
    assert 136 * count < len(latent) < 136 * count + 400


def test_the_same_image_gives_the_same_bytes() -> None:
    image = views(1, seed=3)[0][0]

    first, second = (ClassicalEncoder(ClassicalConfig()).encode(image) for _ in range(2))

    assert first == second


def test_features_are_free_of_the_lens_distortion() -> None:
    camera = Camera(752, 480, 458.7, 457.3, 367.2, 248.4, (-0.283, 0.074, 0.0002, 0.00002))
    ideal = np.random.default_rng(4).uniform([-0.6, -0.4], [0.6, 0.4], (50, 2))
    points = np.column_stack([ideal, np.ones(50)])
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K(), np.array(camera.distortion))

    found = undistorted(np.asarray(pixels, np.float64).reshape(-1, 2), camera)

    np.testing.assert_allclose(found, ideal, atol=1e-3)


def test_features_keep_their_place_where_the_image_is_shrunk() -> None:
    grey = random_view(random_scene(np.random.default_rng(16)), np.random.default_rng(17))
    image = rgb(
        np.asarray(cv2.resize(grey, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_CUBIC), np.uint8),
        Camera(2 * WIDTH, 2 * HEIGHT, 600.0, 600.0, WIDTH, HEIGHT),
    )
    full = ClassicalEncoder(ClassicalConfig(pixels_max=10**9)).encode(image)
    shrunk = ClassicalEncoder(ClassicalConfig(pixels_max=150_000)).encode(image)

    first, second = decode_features(full), decode_features(shrunk)
    result = two_view(first, second, mutual_matches(first.descriptors, second.descriptors, 0.8), Geometry())

    assert isinstance(result, TwoView)
    moved_px = np.median(decode_features(full).points[result.query_indices] - result.view.observed, axis=0) * 600.0
    assert np.abs(moved_px).max() < 0.2


def test_a_turned_camera_is_recognised_as_no_translation() -> None:
    grey = random_view(random_scene(np.random.default_rng(6)), np.random.default_rng(7))
    angle_rad = 0.15
    R = np.array([[np.cos(angle_rad), 0, np.sin(angle_rad)], [0, 1, 0], [-np.sin(angle_rad), 0, np.cos(angle_rad)]])
    H = CAMERA.K() @ R @ np.linalg.inv(CAMERA.K())
    turned = np.asarray(cv2.warpPerspective(grey, H, (WIDTH, HEIGHT)), np.uint8)
    encoder = ClassicalEncoder(ClassicalConfig())

    result = classical_registrar(ClassicalConfig(acceptance="ratio")).register(
        encoder.encode(rgb(grey)), encoder.encode(rgb(turned)), None
    )

    assert isinstance(result, RegistrationFailed)
    assert "rotation only" in result.detail


def test_two_scenes_do_not_register() -> None:
    encoder, registrar = ClassicalEncoder(ClassicalConfig()), classical_registrar(ClassicalConfig(acceptance="ratio"))
    latents = [encoder.encode(pair[0]) for pair in views(5, seed=8)]

    results = [registrar.register(a, b, None) for i, a in enumerate(latents) for b in latents[i + 1 :]]

    assert not any(isinstance(result, Registration) for result in results)


def test_a_codebook_learnt_again_describes_alike_after_a_round_trip(tmp_path: Path) -> None:
    patches = dense_patches(random_view(random_scene(np.random.default_rng(1)), np.random.default_rng(2)))
    codebook = train(scenes=8, seed=1, words_count=4, dimension=16)
    save_codebook(codebook, tmp_path / "codebook.npz")

    read = load_codebook(tmp_path / "codebook.npz")

    assert read.dimension == codebook.dimension
    assert read.describe(patches) @ codebook.describe(patches) > 0.999
    assert codebook.words.shape == (4, 48)
