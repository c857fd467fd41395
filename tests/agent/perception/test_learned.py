import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.agent.perception.classical_scenes import camera_at
from tests.agent.perception.learned_examples import MODELS, SMALL, front_end, textures, view

from flocc_agent.config import LearnedConfig
from flocc_agent.core.interfaces import Camera, Image, OdometryPair
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.extras import to_install
from flocc_agent.geometry import angle_rad, between
from flocc_agent.perception.latent import BadLatent, pack
from flocc_agent.perception.learned.keypoints import read_features, write_features
from flocc_agent.perception.learned.weight_sources import ALIKED_N16ROT, BadWeights, checked

NEIGHBOUR = camera_at((-0.4, 0.05, 0.0), (0.0, 0.02, 0.0))
QUERY = camera_at((0.0, 0.0, 0.0))
MATCH = camera_at((0.5, -0.1, 0.2), (0.02, -0.05, 0.03))
CAMERA_FIELDS = [160, 120, 140.0, 140.0, 79.5, 59.5, 0.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("model", MODELS)
def test_small_pictures_are_registered_with_their_metric_length(model: str) -> None:
    _, encoder, registrar = front_end(model)
    walls = textures(5)
    neighbour, query, match = (encoder.encode(view(walls, T)) for T in (NEIGHBOUR, QUERY, MATCH))

    result = registrar.register(query, match, OdometryPair(neighbour, between(NEIGHBOUR, QUERY), "n-q"))

    assert isinstance(result, Registration)
    assert (result.judged_ratio or 0.0) >= 1.0
    assert result.scale_initial is not None
    T = result.T_query_match_unscaled
    assert np.degrees(angle_rad(T[:3, :3].T @ MATCH[:3, :3])) < 2.0  # a pixel is 0.4 degrees
    np.testing.assert_allclose(result.scale_initial * T[:3, 3], MATCH[:3, 3], atol=0.1)


@pytest.mark.parametrize("model", MODELS)
def test_another_place_is_refused_and_looks_less_alike(model: str) -> None:
    describer, encoder, registrar = front_end(model)
    here, near, elsewhere = view(textures(3), QUERY), view(textures(3), MATCH), view(textures(4), QUERY)

    result = registrar.register(encoder.encode(here), encoder.encode(elsewhere), None)

    assert isinstance(result, RegistrationFailed)
    descriptors = [describer.describe(image) for image in (here, near, elsewhere)]
    assert [len(d) for d in descriptors] == [describer.dimension] * 3
    np.testing.assert_allclose([np.linalg.norm(d) for d in descriptors], 1.0, atol=1e-5)
    assert descriptors[0] @ descriptors[1] > descriptors[0] @ descriptors[2]


@pytest.mark.parametrize("model", MODELS)
def test_the_same_image_gives_the_same_bytes(model: str) -> None:
    _, encoder, _ = front_end(model)
    image = view(textures(5), QUERY)
    again = Image(image.pixels.copy(), image.camera)

    assert encoder.encode(image) == encoder.encode(again)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(("width", "height", "kind"), [(160, 120, "grey"), (160, 120, "line"), (24, 16, "noise")])
def test_pictures_without_enough_features_are_described_and_not_registered(
    model: str, width: int, height: int, kind: str
) -> None:
    describer, encoder, registrar = front_end(model)
    pixels = np.full((height, width, 3), 128, np.uint8)
    if kind == "line":
        pixels[height // 2] = 255
    if kind == "noise":
        pixels = np.random.default_rng(1).integers(0, 256, pixels.shape, dtype=np.uint8)
    image = Image(pixels, Camera(width, height, 100.0, 100.0, width / 2, height / 2))

    latent = encoder.encode(image)
    result = registrar.register(latent, latent, None)

    assert np.all(np.isfinite(describer.describe(image)))
    assert isinstance(result, RegistrationFailed)
    assert result.failure is not RegistrationFailure.BAD_LATENT


@pytest.mark.parametrize("model", MODELS)
def test_turning_on_the_spot_and_identical_pictures_end_in_a_verdict(model: str) -> None:
    _, encoder, registrar = front_end(model)
    walls = textures(6)
    query, turned = (encoder.encode(view(walls, T)) for T in (QUERY, camera_at((0, 0, 0), (0.0, 0.15, 0.0))))

    for match in (query, turned):
        result = registrar.register(query, match, None)
        assert isinstance(result, RegistrationFailed)
        assert result.failure in (
            RegistrationFailure.DEGENERATE,
            RegistrationFailure.UNCONVINCING,
            RegistrationFailure.FEW_CORRESPONDENCES,  # what stays at its pixel between two robots is left out
        )


def test_a_latent_of_the_other_model_is_refused() -> None:
    _, encoder, _ = front_end(MODELS[0])
    _, _, registrar = front_end(MODELS[1])
    latent = encoder.encode(view(textures(3), QUERY))

    result = registrar.register(latent, latent, None)

    assert isinstance(result, RegistrationFailed)
    assert result.failure is RegistrationFailure.OTHER_FRONT_END
    assert MODELS[0] in result.detail


def test_large_pictures_are_shrunk_and_their_latents_stay_small() -> None:
    _, encoder, _ = front_end(MODELS[1])
    camera = Camera(1280, 360, 700.0, 700.0, 639.5, 179.5)
    noise = np.random.default_rng(2).integers(0, 256, (360, 1280, 3), dtype=np.uint8)

    latent = encoder.encode(Image(noise, camera))
    features = read_features(latent, encoder.model, 64)

    assert features.size_px[0] * features.size_px[1] <= 307_200
    assert len(latent) < 71_000
    assert features.focal_px == pytest.approx(700.0 * features.size_px[0] / 1280, rel=0.01)


def test_features_survive_the_latent_to_a_64th_of_a_pixel_and_a_127th_of_their_range() -> None:
    rng = np.random.default_rng(1)
    pixels = rng.uniform(0, [159, 119], (50, 2)).astype(np.float32)
    descriptors = rng.standard_normal((50, 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)

    read = read_features(write_features("m", pixels, descriptors, (160, 120), SMALL), "m", 64)

    np.testing.assert_allclose(read.pixels, pixels, atol=0.5 / 64 + 1e-6)
    assert np.min((read.descriptors * descriptors).sum(axis=1)) > 0.999
    expected = (pixels - [79.5, 59.5]) / 140.0
    np.testing.assert_allclose(read.points, expected, atol=1e-4)


@pytest.mark.parametrize(
    ("header", "steps", "length", "sentence"),
    [
        ({}, (9, 2), 64, "how large"),
        ({"size_px": [0, 120], "camera": CAMERA_FIELDS}, (9, 2), 64, "impossible"),
        ({"size_px": [160, 120], "camera": [1, 2]}, (9, 2), 64, "camera"),
        ({"size_px": [160, 120], "camera": [160, 120, -1.0, *CAMERA_FIELDS[3:]]}, (9, 2), 64, "camera"),
        ({"size_px": [160, 120], "camera": CAMERA_FIELDS}, (8, 2), 64, "fit together"),
        ({"size_px": [160, 120], "camera": CAMERA_FIELDS}, (9, 2), 128, "fit together"),
    ],
)
def test_a_bad_latent_is_told(header: dict[str, object], steps: tuple[int, int], length: int, sentence: str) -> None:
    arrays: dict[str, NDArray[Any]] = {
        "pixels": np.zeros(steps, np.uint16),
        "descriptors": np.zeros((9, length), np.int8),
    }

    with pytest.raises(BadLatent, match=sentence):
        read_features(pack("m", header, arrays), "m", 64)


def test_a_weight_file_of_another_hash_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(BadWeights, match="flocc weights get learned"):
        checked(ALIKED_N16ROT, tmp_path)
    (tmp_path / ALIKED_N16ROT.name).write_bytes(b"something else")

    with pytest.raises(BadWeights, match=r"aliked-n16rot\.pth: its SHA-256 is"):
        checked(ALIKED_N16ROT, tmp_path)


@pytest.mark.parametrize("missing", ["torch", "kornia"])
def test_without_the_extra_one_sentence_says_what_to_install(missing: str) -> None:
    code = (
        f"import sys; sys.modules[{missing!r}] = None\n"
        "from flocc_agent.config import LearnedConfig\n"
        "from flocc_agent.perception.learned import build, LearnedMissing\n"
        "try:\n    build(LearnedConfig())\n"
        "except LearnedMissing as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert done.stdout.strip() == f"the learned front end needs torch and kornia: {to_install('learned')}"


def test_the_configuration_names_the_models() -> None:
    assert LearnedConfig().model == MODELS[0]
    assert json.loads(LearnedConfig.model_validate({"model": MODELS[1]}).model_dump_json())["model"] == MODELS[1]
