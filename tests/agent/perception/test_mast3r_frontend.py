"""Describer, Encoder and Registrar on keyed random weights: the whole path, and everything that goes wrong."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch, an optional extra, is not installed")

from tests.agent.perception.mast3r_examples import keyed_mast3r, picture  # noqa: E402

from flocc_agent.config import ConfigError, Mast3rConfig  # noqa: E402
from flocc_agent.core.interfaces import Camera, Image, OdometryPair  # noqa: E402
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure  # noqa: E402
from flocc_agent.geometry import inverse, se3_exp  # noqa: E402
from flocc_agent.perception.mast3r import build  # noqa: E402
from flocc_agent.perception.mast3r import device as device_module  # noqa: E402
from flocc_agent.perception.mast3r.device import (  # noqa: E402
    Compute,
    NotEnoughMemory,
    choose_compute,
    choose_dtype,
    require_memory,
)
from flocc_agent.perception.mast3r.engine import Engine, LatentOnDevice, batches  # noqa: E402
from flocc_agent.perception.mast3r.mast3r_frontend import Mast3rEncoder, Mast3rRegistrar  # noqa: E402
from flocc_agent.perception.mast3r.pair import mean_confidence  # noqa: E402
from flocc_agent.perception.mast3r.preprocess import BadImage  # noqa: E402
from flocc_agent.perception.mast3r.sizes import TINY  # noqa: E402
from flocc_agent.perception.mast3r.two_view_network import DenseView, Mast3r  # noqa: E402
from flocc_agent.perception.torch_device import DeviceError  # noqa: E402
from flocc_launch.setup.weight_files import synthesize  # noqa: E402

CPU = Compute(torch.device("cpu"), torch.float32, torch.float32)
T_NEIGHBOUR_QUERY = se3_exp(np.array([0.0, 0.02, 0.0, 0.5, 0.0, 0.1]))


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Mast3rConfig:
    paths = synthesize(tmp_path_factory.mktemp("weights"))
    return Mast3rConfig(
        weights=paths["mast3r"],
        place_weights=paths["cosplace"],
        network="tiny",
        dtype="fp32",
        image_size_px=224,
        device="cpu",
    )


def changed(config: Mast3rConfig, **values: Any) -> Mast3rConfig:
    return Mast3rConfig(**{**config.model_dump(), **values})


def test_describes_encodes_and_registers_keyed_pictures(config: Mast3rConfig) -> None:
    describer, encoder, registrar = build(config)
    descriptor = describer.describe(picture("a"))
    assert descriptor.shape == (describer.dimension,) == (64,)
    assert float(np.linalg.norm(descriptor)) == pytest.approx(1.0, abs=1e-5)
    a, b, c = (encoder.encode(picture(name)) for name in "abc")
    result = registrar.register(a, b, OdometryPair(c, T_NEIGHBOUR_QUERY, "c-a"))
    assert isinstance(result, (Registration, RegistrationFailed))
    assert result.odometry_correspondences > 0
    assert result.correspondences > 0


def test_the_same_payloads_give_the_same_result(config: Mast3rConfig) -> None:
    results = []
    for _ in range(2):
        _, encoder, registrar = build(config)
        results.append(registrar.register(encoder.encode(picture("a")), encoder.encode(picture("b")), None))
    assert results[0].correspondences == results[1].correspondences
    assert type(results[0]) is type(results[1])


@pytest.mark.parametrize("exchange", ["image", "auto"])
def test_a_sent_picture_is_encoded_by_the_receiver_once(config: Mast3rConfig, exchange: str) -> None:
    _, encoder, registrar = build(changed(config, exchange=exchange))
    a, b = encoder.encode(picture("a")), encoder.encode(picture("b"))
    assert isinstance(registrar, Mast3rRegistrar)
    registrar.register(a, b, None)
    assert len(registrar._encoded) == (2 if exchange == "image" else 0)


def test_a_batch_encodes_as_its_pictures_alone_and_keeps_their_order(config: Mast3rConfig) -> None:
    _, encoder, _ = build(changed(config, batch_max=2))
    assert isinstance(encoder, Mast3rEncoder)
    images = [picture("a"), picture("b", 120, 160), picture("c"), picture("d")]
    together = encoder.encode_batch(images)
    for image, payload in zip(images, together, strict=True):
        alone = encoder.encode(image)
        assert np.allclose(half_values(payload), half_values(alone), atol=2e-3)


def half_values(payload: bytes) -> Any:
    from flocc_agent.perception.latent import unpack

    return unpack(payload, "mast3r").arrays["latent"].astype(np.float32)


class Scripted(Engine):
    """An engine whose decoder knows the truth: a plane of random descriptors seen by two cameras."""

    def __init__(self, T_1_2: Any, spoil: str = "") -> None:
        super().__init__(keyed_mast3r(TINY), CPU)
        self.T_1_2 = T_1_2
        self.spoil = spoil
        self.decoded = 0

    def decode(self, pairs: Any) -> list[tuple[DenseView, DenseView]]:
        self.decoded += len(pairs)
        if self.spoil == "memory":
            raise NotEnoughMemory("memory ran out on cpu while running MASt3R")
        reversed_order = [k > 0 and second is pairs[0][0] for k, (_, second) in enumerate(pairs)]
        return [self._views(inverse(self.T_1_2) if back else self.T_1_2) for back in reversed_order]

    def _views(self, T_1_2: Any) -> tuple[DenseView, DenseView]:
        size, f, c = 224, 179.2, 112.0
        generator = torch.Generator().manual_seed(1)
        texture = torch.nn.functional.normalize(torch.randn(size, size, 24, generator=generator), dim=-1)
        v, u = np.mgrid[:size, :size].astype(float)
        z = 4.0 + 0.02 * u + 0.01 * v + np.random.default_rng(0).uniform(0, 2, u.shape)
        p_1 = np.stack([(u - c) / f * z, (v - c) / f * z, z], axis=-1)
        p_2 = p_1 @ inverse(T_1_2)[:3, :3].T + inverse(T_1_2)[:3, 3]
        u_2, v_2 = (np.rint(p_2[..., k] / p_2[..., 2] * f + c).astype(int) for k in (0, 1))
        seen = (u_2 >= 0) & (u_2 < size) & (v_2 >= 0) & (v_2 < size)
        desc_2 = torch.nn.functional.normalize(torch.randn(size, size, 24, generator=generator), dim=-1)
        desc_2[v_2[seen], u_2[seen]] = texture[torch.from_numpy(seen)]
        points = torch.from_numpy(p_1).float()[None]
        if self.spoil == "not finite":
            points = points * float("nan")
        ones = torch.ones(1, size, size)
        return DenseView(points, ones, texture[None], ones), DenseView(points, ones, desc_2[None], ones)


def scripted(config: Mast3rConfig, T_1_2: Any, spoil: str = "") -> tuple[Mast3rEncoder, Mast3rRegistrar, Scripted]:
    engine = Scripted(T_1_2, spoil)
    return Mast3rEncoder(engine, "mast3r-scripted", config), Mast3rRegistrar(engine, "mast3r-scripted", config), engine


def square(key: str) -> Image:
    """A picture whose input at 224 pixels has focal length 179.2 and centre 112."""
    pixels = picture(key, 224, 224).pixels
    return Image(pixels, Camera(224, 224, 179.2, 179.2, 112.0, 112.0))


def test_a_true_pose_is_found_with_its_counts_scale_and_covariance(config: Mast3rConfig) -> None:
    T_query_match = se3_exp(np.array([0.02, -0.05, 0.01, 0.4, -0.1, 0.2]))
    encoder, registrar, engine = scripted(config, T_query_match)
    a, b, c = (encoder.encode(square(name)) for name in "abc")
    result = registrar.register(a, b, OdometryPair(c, T_NEIGHBOUR_QUERY, "c-a"))
    assert isinstance(result, Registration), result
    assert np.allclose(result.T_query_match_unscaled, T_query_match, atol=0.02)
    assert result.correspondences > 100
    assert result.odometry_correspondences > 100
    expected = np.linalg.norm(T_NEIGHBOUR_QUERY[:3, 3]) / np.linalg.norm(T_query_match[:3, 3])
    assert result.scale_initial == pytest.approx(expected, rel=0.05)
    assert result.covariance is not None
    assert np.all(np.linalg.eigvalsh(result.covariance) > 0)
    assert engine.decoded == 2
    assert (result.confidence, result.odometry_confidence) == (1.0, 1.0)


def test_the_mean_confidence_is_that_of_both_views_points() -> None:
    nothing = torch.zeros(1, 2, 2)
    views = (DenseView(nothing, 2.0 + nothing, nothing, nothing), DenseView(nothing, 4.0 + nothing, nothing, nothing))
    assert mean_confidence(views) == 3.0


def test_the_odometry_pair_is_decoded_once_per_keyframe_and_the_cache_is_bounded(config: Mast3rConfig) -> None:
    encoder, registrar, engine = scripted(changed(config, odometry_pairs_max=2), np.eye(4))
    a, b, c = (encoder.encode(square(name)) for name in "abc")
    for key in ("1", "1", "2", "3"):
        registrar.register(a, b, OdometryPair(c, T_NEIGHBOUR_QUERY, key))
    assert engine.decoded == 4 + 3
    assert list(registrar._odometry_pairs) == ["2", "3"]


def test_without_an_odometry_pair_there_is_a_pose_and_no_scale(config: Mast3rConfig) -> None:
    encoder, registrar, _ = scripted(config, se3_exp(np.array([0, 0, 0, 0.3, 0, 0.0])))
    result = registrar.register(encoder.encode(square("a")), encoder.encode(square("b")), None)
    assert isinstance(result, Registration)
    assert (result.scale_initial, result.odometry_correspondences) == (None, 0)


def test_an_uncalibrated_robot_estimates_focal_lengths_from_a_second_decode(config: Mast3rConfig) -> None:
    T_query_match = se3_exp(np.array([0.02, -0.05, 0.01, 0.4, -0.1, 0.2]))
    encoder, registrar, engine = scripted(changed(config, calibrated=False), T_query_match)
    result = registrar.register(encoder.encode(square("a")), encoder.encode(square("b")), None)
    assert isinstance(result, Registration), result
    assert np.allclose(result.T_query_match_unscaled, T_query_match, atol=0.03)
    assert engine.decoded == 2


def test_two_decodes_that_disagree_reject_the_closure(config: Mast3rConfig) -> None:
    encoder, registrar, _ = scripted(changed(config, consistency_check=True), se3_exp(np.array([0, 0, 0, 0.5, 0, 0.0])))
    result = registrar.register(encoder.encode(square("a")), encoder.encode(square("b")), None)
    assert isinstance(result, RegistrationFailed)
    assert "disagree" in result.detail


@pytest.mark.parametrize(
    ("spoil", "failure"),
    [("memory", RegistrationFailure.OUT_OF_MEMORY), ("not finite", RegistrationFailure.NO_MODEL)],
)
def test_a_pair_that_fails_says_why(config: Mast3rConfig, spoil: str, failure: RegistrationFailure) -> None:
    encoder, registrar, _ = scripted(config, np.eye(4), spoil)
    result = registrar.register(encoder.encode(square("a")), encoder.encode(square("b")), None)
    assert isinstance(result, RegistrationFailed)
    assert result.failure is failure
    assert result.detail


def test_bad_latents_of_a_peer_fail_the_pair_and_nothing_else(config: Mast3rConfig) -> None:
    encoder, registrar, _ = scripted(config, np.eye(4))
    other = Mast3rEncoder(Engine(keyed_mast3r(TINY), CPU), "mast3r-other", config)
    good = encoder.encode(square("a"))
    for bad in (b"", good[:100], other.encode(square("a"))):
        for query, match in ((good, bad), (bad, good)):
            result = registrar.register(query, match, None)
            assert isinstance(result, RegistrationFailed)
            assert result.failure in (RegistrationFailure.BAD_LATENT, RegistrationFailure.OTHER_FRONT_END)
        result = registrar.register(good, good, OdometryPair(bad, np.eye(4), "bad"))
        assert isinstance(result, RegistrationFailed)


def test_an_encode_only_robot_encodes_and_says_that_it_does_not_decode(config: Mast3rConfig) -> None:
    _, encoder, registrar = build(changed(config, encode_only=True))
    latent = encoder.encode(picture("a"))
    result = registrar.register(latent, latent, None)
    assert isinstance(result, RegistrationFailed)
    assert "encoder only" in result.detail
    assert encoder.model == build(config)[1].model


@pytest.mark.parametrize(("width", "height"), [(1, 400), (3000, 20)])
def test_pictures_that_cannot_be_encoded_are_refused(config: Mast3rConfig, width: int, height: int) -> None:
    describer, encoder, _ = build(changed(config, image_size_px=512))
    image = Image(np.zeros((height, width, 3), np.uint8), Camera(width, height, 100.0, 100.0, 1.0, 1.0))
    with pytest.raises(BadImage):
        encoder.encode(image)
    if min(width, height) < 16:
        with pytest.raises(BadImage):
            describer.describe(image)


@pytest.mark.parametrize(("width", "height", "value"), [(160, 120, 127), (20, 30, 0), (120, 160, 255), (1500, 1100, 9)])
def test_one_colour_tiny_portrait_and_large_pictures_go_through(
    config: Mast3rConfig, width: int, height: int, value: int
) -> None:
    describer, encoder, registrar = build(config)
    image = Image(np.full((height, width, 3), value, np.uint8), Camera(width, height, 100.0, 100.0, 1.0, 1.0))
    assert np.all(np.isfinite(describer.describe(image)))
    latent = encoder.encode(image)
    assert isinstance(registrar.register(latent, latent, None), (Registration, RegistrationFailed))


def test_memory_that_runs_out_becomes_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def exhausted(self: Mast3r, images: Any) -> Any:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3 GiB")

    engine = Engine(keyed_mast3r(TINY), CPU)
    monkeypatch.setattr(Mast3r, "encode", exhausted)
    with pytest.raises(NotEnoughMemory, match="memory ran out on cpu"):
        engine.encode([np.zeros((1, 3, 32, 48), np.float32)])


def test_other_errors_of_the_network_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(self: Mast3r, images: Any) -> Any:
        raise RuntimeError("shapes do not fit")

    engine = Engine(keyed_mast3r(TINY), CPU)
    monkeypatch.setattr(Mast3r, "encode", wrong)
    with pytest.raises(RuntimeError, match="shapes"):
        engine.encode([np.zeros((1, 3, 32, 48), np.float32)])


def test_too_little_memory_is_said_before_anything_is_loaded() -> None:
    with pytest.raises(NotEnoughMemory, match=r"MASt3R needs 931322.6 GiB on cpu"):
        require_memory(10**15, torch.device("cpu"), "MASt3R")


def test_formats_follow_what_the_machine_can_do(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda = torch.device("cuda")
    known = {(9, 0): "bf16", (8, 0): "bf16", (7, 2): "fp16", (7, 0): "fp16", (6, 1): "fp32"}
    for capability, expected in known.items():
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _=None, found=capability: found)
        assert choose_dtype("auto", cuda) is device_module.DTYPES[expected]
    assert choose_dtype("auto", torch.device("mps")) is torch.float16
    for fast, expected in ((True, "bf16"), (False, "fp32")):
        monkeypatch.setattr(device_module, "cpu_has_fast_bf16", lambda found=fast: found)
        assert choose_dtype("auto", torch.device("cpu")) is device_module.DTYPES[expected]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_compute("cpu", "fp16").head_dtype is torch.float32
    with pytest.raises(DeviceError, match="'cuda' is not available"):
        choose_compute("cuda", "auto")


def test_heads_run_in_their_own_format() -> None:
    engine = Engine(keyed_mast3r(TINY), Compute(torch.device("cpu"), torch.bfloat16, torch.float32))
    network = engine._network
    assert network.enc_norm.weight.dtype == torch.bfloat16
    assert network.downstream_head2.dpt.head[0].weight.dtype == torch.float32
    size = (32, 48)
    latent = LatentOnDevice(engine.encode([np.zeros((1, 3, *size), np.float32)])[0], size)
    ((view_1, _),) = engine.decode([(latent, latent)])
    assert view_1.pts3d.dtype == torch.float32


def test_batches_hold_equal_sizes_and_at_most_so_many() -> None:
    assert batches(["a", "b", "a", "a", "b"], 2) == [[0, 2], [3], [1, 4]]


def test_missing_paths_and_files_are_named(tmp_path: Path, config: Mast3rConfig) -> None:
    with pytest.raises(ConfigError, match=r"perception\.mast3r\.weights is not set"):
        build(Mast3rConfig())
    from flocc_agent.perception.mast3r.checkpoint import BadCheckpoint

    with pytest.raises(BadCheckpoint, match=r"nothing\.pth"):
        build(changed(config, weights=tmp_path / "nothing.pth"))
