"""Judging perception back-ends: the tables' arithmetic, and the classical front end's figures on the research sets."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flocc_agent.config import PerceptionConfig
from flocc_agent.core.interfaces import Camera, Perception
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.geometry import pose, so3_exp
from flocc_agent.perception.backends import build_perception
from flocc_lab.bench import perception_quality as evaluation
from flocc_lab.bench.perception_quality import (
    PairOutcome,
    ScoredPair,
    best_matches,
    chosen,
    outcome,
    ratio_row,
    recall_at_one,
)
from flocc_lab.bench.registration_scenes import RegistrationScene, SceneView, fountain, sevenscenes

SHARED = Path(os.environ.get("FLOCC_SHARED", Path(__file__).resolve().parents[3] / "shared")) / "data"
CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)


def research_set(name: str) -> Path:
    """Folder of a research set, or a skip with the reason."""
    if not (SHARED / name).is_dir():
        pytest.skip(f"the recordings are not at {SHARED / name}")
    return SHARED / name


@pytest.fixture(scope="module")
def classical() -> Perception:
    # The tables ask for every match ratio, so the verdict stays with Eq. (1).
    return build_perception(PerceptionConfig.model_validate({"classical": {"acceptance": "ratio"}}))


def line_of(*robots: str) -> RegistrationScene:
    """Views 1 m apart along x, looking along z."""
    views = []
    for k, robot in enumerate(robots):
        T = pose(np.eye(3), np.array([float(k), 0.0, 0.0]))
        views.append(SceneView(robot, Path(f"{k}.jpg"), CAMERA, T, T))
    return RegistrationScene("line", tuple(views), 1.5, 0.5, 0.2)


def test_a_registration_is_held_against_the_truth_with_its_length_made_the_true_one() -> None:
    T = pose(so3_exp(np.array([0.0, 0.1, 0.0])), np.array([4.0, 0.0, 0.0]))

    found = outcome(line_of("r1", "r2"), ScoredPair(0, 1, 0.5, True), Registration(T, 30, 60, 0.5))

    assert found.rotation_error_deg == pytest.approx(np.degrees(0.1))
    assert (found.direction_error_deg, found.position_error_m) == (0.0, 0.0)
    assert found.scale_ratio == pytest.approx(2.0)  # 4 units of half a metre, 1 m in truth
    assert found.ratio == pytest.approx(0.5)
    assert found.correct


@pytest.mark.parametrize(("angle_rad", "y"), [(0.2, 0.0), (0.0, 0.3)])
def test_a_wrong_rotation_or_direction_is_not_correct(angle_rad: float, y: float) -> None:
    T = pose(so3_exp(np.array([0.0, angle_rad, 0.0])), np.array([1.0, y, 0.0]))

    assert not outcome(line_of("r1", "r2"), ScoredPair(0, 1, 0.5, True), Registration(T, 30, 60, None)).correct


def test_best_matches_are_those_of_each_view_and_other_robot() -> None:
    scene = line_of("r1", "r1", "r2", "r3")
    similarities = {(0, 2): 0.9, (0, 3): 0.2, (1, 2): 0.1, (1, 3): 0.3, (2, 3): 0.5}
    pairs = [ScoredPair(i, j, similarity, False) for (i, j), similarity in similarities.items()]

    best = best_matches(pairs, scene)

    assert best == {(0, 2), (0, 3), (1, 2), (1, 3), (2, 3)}
    assert best_matches([replace(pair, similarity=0.4 * (pair.query == 0)) for pair in pairs], scene) >= {
        (0, 2),
        (0, 3),
    }


def test_recall_at_one_counts_views_that_another_robot_saw_the_place_of() -> None:
    scene = line_of("r1", "r1", "r2")
    pairs = [ScoredPair(0, 2, 0.3, False), ScoredPair(1, 2, 0.2, True)]

    assert recall_at_one(pairs, scene) == pytest.approx(0.5)  # right for view 1, wrong for view 2, view 0 has no place


def test_large_scenes_keep_best_matches_and_a_repeatable_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "PAIRS_MAX", 20)
    pairs = [ScoredPair(0, k, 0.0, k % 2 == 0) for k in range(1, 101)]

    kept = chosen(pairs, {(0, 77)})

    assert kept == chosen(pairs, {(0, 77)})
    assert pairs[76] in kept
    assert sum(pair.same_place for pair in kept) == 10
    assert len(kept) == 21


def test_precision_and_recall_count_accepted_and_correct() -> None:
    def at(ratio: float, correct: bool, failure: str | None = None) -> PairOutcome:
        return PairOutcome(0, 1, 0.5, True, 40, ratio, failure, 1.0, 2.0, 0.1, 1.1, correct)

    outcomes = [at(0.5, True), at(0.4, True), at(0.3, False), at(0.1, True), at(0.9, False, "few correspondences")]

    row = ratio_row(outcomes, 0.2)

    assert (row["accepted"], row["correct"], row["with_scale"]) == (3, 2, 3)
    assert row["precision"] == pytest.approx(2 / 3)
    assert row["recall"] == pytest.approx(2 / 3)
    assert row["scale_error_median_ratio"] == pytest.approx(0.1)


def test_a_failure_has_counts_and_a_reason() -> None:
    result = RegistrationFailed(RegistrationFailure.FEW_CORRESPONDENCES, "", 7, 70)

    found = outcome(line_of("r1", "r2"), ScoredPair(0, 1, 0.5, True), result)

    assert (found.failure, found.correspondences, found.correct) == ("few correspondences", 7, False)
    assert found.ratio == pytest.approx(0.1)


@pytest.mark.data
def test_loop_pairs_accept_the_revisits_and_reject_the_rest(classical: Perception) -> None:
    rows = evaluation.judge_loop_pairs(research_set("loop_pairs"), classical)

    registered = {(row["query"], row["match"]): row for row in rows if row["failure"] is None}
    assert set(registered) == {(0, 1), (2, 3)}
    for row in registered.values():
        assert row["ratio"] > 0.3
        assert row["rotation_error_deg"] < 4.0
        assert row["scale_ratio"] == pytest.approx(1.0, abs=0.15)
    revisits = [row["similarity"] for row in rows if (row["query"], row["match"]) in registered]
    assert min(revisits) > 1.5 * max(row["similarity"] for row in rows if row["failure"])


@pytest.mark.data
def test_fountain_pairs_are_as_accurate_as_the_survey(classical: Perception) -> None:
    scene = fountain(research_set("strecha_fountain") / "fountain-P11")
    judged = evaluation.judge(scene, classical)

    row = next(row for row in judged["all_pairs"] if row["match_ratio_min"] == 0.1)
    assert row["accepted"] >= 30
    assert row["precision"] == 1.0
    assert row["rotation_error_median_deg"] < 0.3
    assert row["direction_error_median_deg"] < 0.5
    assert row["with_scale"] >= 25
    assert row["scale_error_median_ratio"] < 0.02


@pytest.mark.data
def test_corridor_images_are_recognised(classical: Perception) -> None:
    found = evaluation.judge_corridor(research_set("vpr_corridor"), classical.describer)

    assert found["recall_at_1"] > 0.7
    assert found["recall_at_5"] > 0.9


@pytest.mark.data
@pytest.mark.slow
def test_best_matches_in_the_small_room_register_with_scale(classical: Perception) -> None:
    scene = sevenscenes(research_set("sevenscenes"))
    descriptors, latents, _ = evaluation.encoded(scene, classical)
    pairs = evaluation.cross_pairs(scene, np.array(descriptors))
    best = best_matches(pairs, scene)

    outcomes, _ = evaluation.registered(scene, [p for p in pairs if (p.query, p.match) in best], latents, classical)

    row = ratio_row(outcomes, 0.15)
    assert row["accepted"] >= 50
    assert row["precision"] > 0.95
    assert row["rotation_error_median_deg"] < 3.0  # the set's own poses are 1 to 3 degrees off
    assert row["direction_error_median_deg"] < 8.0
    assert row["with_scale"] > 0.8 * row["accepted"]
    assert row["scale_error_median_ratio"] < 0.15
