"""What turns out to move with the camera is taken out of the latents that were encoded before that was known."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.config import ClassicalConfig, PerceptionConfig, StoreConfig
from flocc_agent.core.events import Withdrawn
from flocc_agent.core.interfaces import Camera, Image, KeyframeLook
from flocc_agent.perception.backends import build_perception
from flocc_agent.perception.classical import ClassicalEncoder
from flocc_agent.perception.classical.encoder import decode_features
from flocc_agent.perception.multiview.picture import distorted, undistorted
from flocc_agent.runtime.jobs import hide_in_earlier, keep_fetched, withdrawn_by
from flocc_agent.runtime.store import Store
from flocc_protocol.ids import KeyframeId, LogId

BENT = Camera(160, 120, 130.0, 131.0, 80.0, 60.0, (-0.2, 0.05, 0.001, 0.002))
LOG = LogId("r1")


def picture(seed: int = 1) -> Image:
    return Image(np.random.default_rng(seed).integers(0, 255, (120, 160, 3), np.uint8), BENT)


def right_half() -> NDArray[np.bool_]:
    hidden = np.zeros((120, 160), np.bool_)
    hidden[:, 80:] = True
    return hidden


def test_rays_become_the_pixels_that_they_came_from() -> None:
    pixels = np.array([[0.0, 0.0], [159.0, 0.0], [80.0, 60.0], [20.0, 110.0]])
    assert distorted(undistorted(pixels, BENT), BENT) == pytest.approx(pixels, abs=0.05)


def test_features_at_hidden_pixels_go_and_the_others_stay_as_they_are() -> None:
    encoder = ClassicalEncoder(ClassicalConfig())
    latent = encoder.encode(picture())
    before, after = decode_features(latent), decode_features(encoder.without(latent, right_half()))
    columns = distorted(before.points.astype(float), BENT)[:, 0]
    left = np.rint(columns) < 80
    assert 0 < left.sum() < len(left)
    assert np.array_equal(after.points, before.points[left])
    assert np.array_equal(after.descriptors, before.descriptors[left])


def test_an_encoder_that_cannot_leaves_the_latent() -> None:
    synthetic = build_perception(PerceptionConfig(method="synthetic"))
    assert synthetic.without(b"as it is", right_half()) == b"as it is"


def test_earlier_latents_of_the_same_log_lose_what_is_hidden(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "r1", StoreConfig())
    kept = {index: b"%d and more" % index for index in (0, 1, 5, 70)}
    for index, latent in kept.items():
        store.put_latent(KeyframeId(LOG, index), latent)
    store.put_latent(KeyframeId(LogId("r2"), 1), b"of another")
    looked = KeyframeLook(None, None, hidden=right_half(), withdrawn=64)
    made_anew = hide_in_earlier(KeyframeId(LOG, 69), looked, lambda latent, _: latent[:2], store)
    left = {index: store.latent(KeyframeId(LOG, index)) for index in kept}
    assert made_anew == [b"5 ", *[b""] * 63]
    assert withdrawn_by(looked, ()) == Withdrawn(64)
    assert hide_in_earlier(KeyframeId(LOG, 69), KeyframeLook(None, None), lambda latent, _: latent, store) == []
    assert left == {0: kept[0], 1: kept[1], 5: b"5 ", 70: kept[70]}
    assert store.latent(KeyframeId(LogId("r2"), 1)) == b"of another"
    keep_fetched(KeyframeId(LogId("r2"), 1), b"made anew by the other", store)
    keep_fetched(KeyframeId(LogId("r2"), 2), b"new", store)
    assert store.latent(KeyframeId(LogId("r2"), 1)) == b"made anew by the other"
    assert store.latent(KeyframeId(LogId("r2"), 2)) == b"new"
    store.close()
