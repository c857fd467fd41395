"""Recorded perception: exactly the recorded pairs look alike, and what is registered is what the file says."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flocc_agent.config import RecordedConfig
from flocc_agent.core.registration import Registration, RegistrationFailed
from flocc_agent.geometry import inverse, pose, so3_exp, tq_from_pose
from flocc_agent.perception.recorded import BadRecordedFile, RecordedPerception, name_image

T = pose(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([3.0, 0.0, 4.0]))
NAMES = ["a/0", "a/1", "a/2", "b/0", "b/1", "b/2"]


def entry(query: str, match: str, **changes: Any) -> dict[str, Any]:
    fields = {"query": query, "match": match, "T_query_match": list(tq_from_pose(T)), "covariance": [0.0] * 21}
    return {**fields, **changes}


def perception(tmp_path: Path, scale: str = "removed", **changes: Any) -> RecordedPerception:
    content = {"format": "flocc-recorded/1", "keyframes": NAMES, "pairs": [entry("a/0", "b/1"), entry("a/0", "b/2")]}
    path = tmp_path / "registrations.json"
    path.write_text(json.dumps({**content, **changes}))
    return RecordedPerception(RecordedConfig.model_validate({"file": path, "scale": scale}))


def test_only_recorded_pairs_look_alike(tmp_path: Path) -> None:
    seen = perception(tmp_path)
    vectors = {name: seen.describe(name_image(name)) for name in NAMES}
    alike = {(p, q) for p in NAMES for q in NAMES if p < q and vectors[p] @ vectors[q] > 1e-6}
    assert alike == {("a/0", "b/1"), ("a/0", "b/2")}
    assert all(np.linalg.norm(vector) == pytest.approx(1.0) for vector in vectors.values())


def test_a_pair_is_found_in_both_directions_with_scale_or_without(tmp_path: Path) -> None:
    for scale, length, known in (("removed", 1.0, None), ("kept", 5.0, 1.0)):
        seen = perception(tmp_path, scale)
        a, b = (seen.encode(name_image(name)) for name in ("a/0", "b/1"))
        there, back = seen.register(a, b, None), seen.register(b, a, None)
        assert isinstance(there, Registration)
        assert isinstance(back, Registration)
        assert np.linalg.norm(there.T_query_match_unscaled[:3, 3]) == pytest.approx(length)
        assert np.allclose(back.T_query_match_unscaled, inverse(there.T_query_match_unscaled))
        assert there.scale_initial == back.scale_initial == known


def test_a_covariance_is_in_the_unit_of_its_pose(tmp_path: Path) -> None:
    covariance = np.diag([1.0, 1.0, 1.0, 4.0, 4.0, 4.0]) + 0.5 * (np.eye(6, k=3) + np.eye(6, k=-3))
    told = entry("a/0", "b/1", covariance=covariance[np.triu_indices(6)].tolist())
    for scale, unit_m in (("removed", 5.0), ("kept", 1.0)):
        seen = perception(tmp_path, scale, pairs=[told])
        a, b = (seen.encode(name_image(name)) for name in ("a/0", "b/1"))
        found = seen.register(a, b, None)
        assert isinstance(found, Registration)
        assert found.covariance is not None
        units = np.diag([1.0] * 3 + [unit_m] * 3)
        np.testing.assert_allclose(units @ found.covariance @ units, covariance)


def test_a_pair_that_was_not_recorded_is_no_registration(tmp_path: Path) -> None:
    seen = perception(tmp_path)
    a, b = (seen.encode(name_image(name)) for name in ("a/1", "b/1"))
    found = seen.register(a, b, None)
    assert isinstance(found, RegistrationFailed)
    assert isinstance(seen.register(b"nonsense", b, None), RegistrationFailed)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"format": "other"}, "is not a file of recorded registrations"),
        ({"pairs": [{"query": "a/0"}]}, "damaged entry"),
        ({"pairs": [entry("a/0", "b/1", T_query_match=[0.0] * 7)]}, "damaged entry"),
        ({"pairs": [entry("a/0", f"b/{k}") for k in range(2049)]}, "more than 2048"),
    ],
)
def test_a_file_that_cannot_be_used_is_named(tmp_path: Path, changes: dict[str, Any], why: str) -> None:
    with pytest.raises(BadRecordedFile, match=f"registrations.json: .*{why}"):
        perception(tmp_path, **changes)


def test_no_file_and_an_unknown_keyframe_are_said(tmp_path: Path) -> None:
    with pytest.raises(BadRecordedFile, match="names no file"):
        RecordedPerception(RecordedConfig())
    with pytest.raises(BadRecordedFile, match="'c/9' is not in the file"):
        perception(tmp_path).describe(name_image("c/9"))
