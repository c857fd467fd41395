"""What travels of a keyframe: written, read, quantised, refused; and which part is sent over which link."""

import json
import struct
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch, an optional extra, is not installed")

from flocc_agent.perception.latent import BadLatent, pack, unpack
from flocc_agent.perception.mast3r.payload import (
    KIND,
    LatentDtype,
    PixelGeometry,
    jpeg_of,
    jpeg_size,
    read_payload,
    sooner_part,
    write_payload,
)
from flocc_agent.perception.mast3r.preprocess import plan_crop

MODEL = "mast3r-0123456789abcdef"
CHANNELS = 64


def geometry() -> PixelGeometry:
    crop = plan_crop(640, 480)
    return PixelGeometry(crop, crop.K(np.array([[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]])))


def latent(seed: int = 0) -> Any:
    values = np.random.default_rng(seed).standard_normal((geometry().patches(), CHANNELS)).astype(np.float32)
    values[:, 3] *= 25.0  # trained latents have channels that dwarf the others
    return values


def smooth_pixels() -> Any:
    y, x = np.mgrid[:384, :512]
    return np.stack([x // 2, y // 2, (x + y) // 4], axis=-1).astype(np.uint8)


def test_half_precision_comes_back_within_its_rounding_with_its_geometry() -> None:
    payload = read_payload(write_payload(MODEL, geometry(), latent()), MODEL, CHANNELS)
    assert payload.geometry.crop == geometry().crop
    assert np.allclose(payload.geometry.K, geometry().K)
    assert payload.latent is not None
    assert np.allclose(payload.latent, latent(), rtol=1e-3, atol=1e-6)


def test_int8_scales_each_channel_by_itself_and_halves_the_bytes() -> None:
    data = write_payload(MODEL, geometry(), latent(), "int8")
    payload = read_payload(data, MODEL, CHANNELS)
    assert payload.latent is not None
    assert np.all(np.abs(payload.latent - latent()) <= np.abs(latent()).max(axis=0) / 127 * 0.501)
    assert len(data) < 0.52 * len(write_payload(MODEL, geometry(), latent()))


def test_values_beyond_half_precision_stay_finite() -> None:
    values = latent() * 1e6
    payload = read_payload(write_payload(MODEL, geometry(), values), MODEL, CHANNELS)
    assert payload.latent is not None
    assert np.all(np.isfinite(payload.latent))


def test_a_picture_travels_instead_of_a_latent() -> None:
    data = write_payload(MODEL, geometry(), None, jpeg=jpeg_of(smooth_pixels(), 90))
    payload = read_payload(data, MODEL, CHANNELS)
    assert payload.latent is None
    assert payload.pixels is not None
    assert np.abs(payload.pixels.astype(int) - smooth_pixels()).mean() < 3
    assert len(data) < 60_000


def test_of_both_parts_the_one_that_reaches_the_decoder_sooner_is_sent() -> None:
    both = write_payload(MODEL, geometry(), latent(), jpeg=jpeg_of(smooth_pixels(), 90))
    fast, slow = sooner_part(both, 10_000_000), sooner_part(both, 1_000)
    assert set(unpack(fast, KIND).arrays) == set(unpack(sooner_part(both, None), KIND).arrays) == {"latent"}
    assert set(unpack(slow, KIND).arrays) == {"jpeg"}
    assert read_payload(slow, MODEL, CHANNELS).pixels is not None
    alone = write_payload(MODEL, geometry(), latent())
    assert sooner_part(alone, 1_000) == alone


@pytest.mark.parametrize(("dtype", "crossover_bits_per_s"), [("int8", 8.4e6), ("fp16", 17.4e6)])
def test_auto_changes_its_choice_where_the_specification_says(dtype: LatentDtype, crossover_bits_per_s: float) -> None:
    full_size = np.zeros((768, 1024), np.float32)
    both = write_payload(MODEL, geometry(), full_size, dtype, jpeg=np.zeros(54_000, np.uint8))
    for rate, expected in ((0.95, "jpeg"), (1.05, "latent")):
        carried_bytes = int(rate * crossover_bits_per_s * 0.7 / 8)
        assert expected in unpack(sooner_part(both, carried_bytes), KIND).arrays


def altered(change: dict[str, Any]) -> bytes:
    content = unpack(write_payload(MODEL, geometry(), latent()), KIND)
    return pack(KIND, {**content.header, **change}, content.arrays)


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (altered({"model": "mast3r-other"}), "is of model 'mast3r-other'"),
        (altered({"version": 2}), "version 2"),
        (altered({"crop": None}), "lacks its crop"),
        (altered({"crop": [640, 480, 512, 384, 0, 0, 512, 368]}), "its header says 736 patches"),
        (altered({"crop": [640, 480, 512, 384, 8, 0, 512, 384]}), "impossible crop"),
        (altered({"crop": [640, 480, 2**30, 384, 0, 0, 2**20, 384]}), "impossible crop"),
        (altered({"crop": [640, 480, 512, 384, 0, 0, True, 384]}), "lacks its crop"),
        (altered({"K": [0.0, 1.0, 2.0, 3.0]}), "impossible intrinsics"),
        (altered({"K": "none"}), "lacks its intrinsics"),
        (b"", "not a latent"),
        (write_payload(MODEL, geometry(), latent())[:-1], "ends inside"),
        (write_payload(MODEL, geometry(), latent()) + b"x", "more than its arrays need"),
        (write_payload(MODEL, geometry(), latent()[:, :32]), "768x32"),
        (pack("classical/sift-1", {}, {}), "is of kind"),
        (pack(KIND, {"version": 1, "model": MODEL, "crop": list(range(8)), "K": [1, 1, 1, 1]}, {}), "crop"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_reason(data: bytes, sentence: str) -> None:
    with pytest.raises(BadLatent, match=sentence):
        read_payload(data, MODEL, CHANNELS)


def test_not_a_number_in_a_latent_is_refused() -> None:
    spoiled = latent()
    spoiled[5, 7] = np.nan
    with pytest.raises(BadLatent, match="not finite"):
        read_payload(write_payload(MODEL, geometry(), spoiled), MODEL, CHANNELS)


@pytest.mark.parametrize("jpeg", [b"", b"\xff\xd8", b"no picture", bytes(200)])
def test_a_damaged_picture_is_refused(jpeg: bytes) -> None:
    data = write_payload(MODEL, geometry(), None, jpeg=np.frombuffer(jpeg, np.uint8))
    with pytest.raises(BadLatent, match="picture"):
        read_payload(data, MODEL, CHANNELS)


def test_a_picture_of_another_size_is_refused_before_it_is_decoded() -> None:
    huge = jpeg_of(np.zeros((4000, 3000, 3), np.uint8), 50)
    assert jpeg_size(huge.tobytes()) == (4000, 3000)
    with pytest.raises(BadLatent, match="no JPEG of 512x384"):
        read_payload(write_payload(MODEL, geometry(), None, jpeg=huge), MODEL, CHANNELS)


def test_random_changes_of_bytes_never_raise_anything_else() -> None:
    good = bytearray(write_payload(MODEL, geometry(), latent(), "int8", jpeg_of(smooth_pixels(), 60)))
    (length,) = struct.unpack_from("<I", good, 4)
    assert json.loads(good[8 : 8 + length])["kind"] == KIND
    rng = np.random.default_rng(7)
    refused = 0
    for _ in range(300):
        data = bytearray(good)
        for at in rng.integers(0, 8 + length + 40, 3):
            data[at] = int(rng.integers(0, 256))
        try:
            read_payload(bytes(data), MODEL, CHANNELS)
        except BadLatent:
            refused += 1
    assert refused > 150
