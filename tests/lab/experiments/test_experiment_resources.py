"""Reduced latents and descriptors, and what split computation counts."""

import numpy as np
import pytest

from flocc_agent.core.reports import ClosureAccepted, ClosureRejected, Fact, KeyframeTaken
from flocc_agent.runtime.event_lines import Reported
from flocc_lab.experiments.experiment import ExperimentError, Verdict
from flocc_lab.experiments.reductions import Basis, keypoint_forms, latent_forms, reduced_descriptors, unit
from flocc_lab.experiments.split_compute import SplitComputeSettings, counts, summarise
from flocc_protocol.ids import KeyframeId, LogId

POSE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def flat_data(count: int = 60, dimension: int = 40, rank: int = 5) -> np.ndarray:
    """Samples that truly lie in few dimensions."""
    rng = np.random.default_rng(3)
    return rng.normal(size=(count, rank)) @ rng.normal(size=(rank, dimension)) + 2.0


def test_a_basis_restores_what_lies_in_its_first_directions() -> None:
    data = flat_data()
    basis = Basis.of(data[:30])
    assert np.allclose(basis.restore(basis.reduce(data, 5)), data)
    assert not np.allclose(basis.restore(basis.reduce(data, 4)), data, atol=0.1)


def test_a_basis_has_no_more_directions_than_its_samples_tell() -> None:
    descriptors = unit(flat_data(count=50, dimension=128, rank=90)).astype(np.float32)
    basis = Basis.of(descriptors.astype(np.float64))
    assert len(basis.directions) == 49
    assert [name for name in reduced_descriptors(descriptors, basis) if name.startswith("pca")] == ["pca-32 int8"]


def test_reduced_descriptors_say_how_many_bytes_travel_and_keep_unit_length() -> None:
    descriptors = unit(flat_data(count=100, dimension=128, rank=90)).astype(np.float32)
    forms = reduced_descriptors(descriptors, Basis.of(descriptors))
    assert {name: size for name, (size, _) in forms.items()} == {
        "fp32": 512, "fp16": 256, "int8": 128, "pca-64 int8": 64, "pca-32 int8": 32,
    }  # fmt: skip
    for _, values in forms.values():
        assert np.allclose(np.linalg.norm(values, axis=1), 1.0)
    assert np.abs(forms["int8"][1] - forms["fp32"][1]).max() < 0.01


def test_a_latent_of_low_rank_survives_and_bytes_are_those_of_what_is_sent() -> None:
    rng = np.random.default_rng(1)
    latent = (rng.normal(size=(48, 4)) @ rng.normal(size=(4, 32))).astype(np.float32)
    forms = latent_forms(latent)
    errors = {
        name: float(np.linalg.norm(values - latent) / np.linalg.norm(latent)) for name, (_, values) in forms.items()
    }
    assert forms["fp32"][0] == 4 * 48 * 32
    assert forms["int8"][0] == 48 * 32 + 4 * 32
    assert forms["rank-8"][0] == 2 * 8 * (48 + 32)
    assert errors["fp32"] == 0.0
    assert errors["fp16"] < 1e-3
    assert errors["rank-8"] < 2e-3
    assert errors["int8"] < 0.01
    assert errors["half the tokens"] > 0.3
    assert set(forms) == {"fp32", "fp16", "int8", "rank-16", "rank-8", "rank-4", "half the tokens"}


def test_a_token_that_is_not_sent_is_its_left_neighbours() -> None:
    latent = np.arange(8, dtype=np.float32)[:, None] * np.ones((1, 16), np.float32)
    assert latent_forms(latent)["half the tokens"][1][:, 0].tolist() == [0, 0, 2, 2, 4, 4, 6, 6]


def test_fewer_keypoints_are_the_strongest_ones() -> None:
    features_module = pytest.importorskip("flocc_agent.perception.classical.features")
    rng = np.random.default_rng(5)
    features = features_module.Features(
        rng.normal(size=(8, 2)).astype(np.float32), rng.integers(0, 255, (8, 128)).astype(np.uint8), 500.0
    )
    forms = keypoint_forms(Basis.of(rng.integers(0, 255, (200, 128))))
    sizes = {name: reduce(features)[0] for name, reduce in forms.items()}
    assert sizes == {
        "all": 8 * 136, "fp16 points": 8 * 132, "half": 4 * 136, "quarter": 2 * 136, "pca-64": 8 * 72, "pca-32": 8 * 40,
    }  # fmt: skip
    assert np.array_equal(forms["half"](features)[1].points, features.points[:4])
    assert forms["pca-64"](features)[1].descriptors.shape == (8, 128)


def registered(robot: str, query: str, match: str, reason: str | None = None) -> Reported[Fact]:
    first, second = KeyframeId.parse(query), KeyframeId.parse(match)
    if reason is not None:
        return Reported(1.0, robot, ClosureRejected(query=first, match=second, reason=reason))
    return Reported(
        1.0,
        robot,
        ClosureAccepted(query=first, match=second, ratio=0.5, correspondences=50, odometry_correspondences=100),
    )


def test_every_registration_counts_once_and_a_lost_latent_none() -> None:
    keyframes = [
        Reported(0.0, log.robot, KeyframeTaken(keyframe=KeyframeId(log, k), stamp_s=0.0, T_odom_body=POSE))
        for log in (LogId("r1"), LogId("r2"))
        for k in range(3)
    ]
    pairs = [
        registered("r1", "r1/0", "r2/0"),
        registered("r1", "r1/0", "r2/1", "few correspondences"),
        registered("r2", "r2/2", "r1/2", "a latent was lost"),
    ]
    assert counts([*keyframes, *pairs]) == {
        "keyframes": 6, "registrations": 2, "keyframes_registered": 3, "odometry_pairs": 1,
    }  # fmt: skip
    with pytest.raises(ExperimentError, match="no pair was registered in this run"):
        counts(keyframes)


def counted(registrations: int) -> dict[str, object]:
    return {
        "part": "counts", "similarity": 0.1, "keyframes": 100, "registrations": registrations,
        "keyframes_registered": 60, "odometry_pairs": 20,
    }  # fmt: skip


@pytest.mark.parametrize(("registrations", "verdict"), [(300, Verdict.CONFIRMED), (40, Verdict.CONTRADICTED)])
def test_encoding_once_pays_when_candidates_are_many(registrations: int, verdict: Verdict) -> None:
    settings = SplitComputeSettings(network="none", device="Jetson", device_encode_s=2.0, device_decode_s=1.0)
    summary = summarise(settings, [counted(registrations)])
    assert summary.findings[0].verdict is verdict
    (line,) = summary.table
    decodes = registrations + 20
    assert line["Jetson: once, s"] == 100 * 2.0 + decodes
    assert line["Jetson: per candidate, s"] == 2 * registrations * 2.0 + decodes


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"device_encode_s": 1.0}, "give both device_encode_s and device_decode_s"),
        ({"network": "none"}, "without a network, device_encode_s and device_decode_s must be given"),
    ],
)
def test_a_device_needs_both_of_its_times(fields: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        SplitComputeSettings.model_validate(fields)
