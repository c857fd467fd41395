"""The arithmetic behind the registration experiment, against values worked out by hand."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flocc_agent.config import ConfigError
from flocc_agent.core.registration import closure_probability
from flocc_lab.experiments.experiment import ExperimentError, Verdict
from flocc_lab.experiments.folder import ExperimentFolder, configuration_of
from flocc_lab.experiments.formulation_claims import MeasuredClaim, formulation_findings
from flocc_lab.experiments.logistic import fit_logistic
from flocc_lab.experiments.overlap import joined
from flocc_lab.experiments.precision_recall import curve
from flocc_lab.experiments.registration_data import RegistrationSettings
from flocc_lab.experiments.registration_quality import REGISTRATION, summarise
from flocc_lab.experiments.scale_graphs import ScaleSettings, draw_graph
from flocc_lab.experiments.steepness import learned, with_steepness, write_steepness


def test_precision_and_recall_of_every_threshold_with_ties_accepted_together() -> None:
    found = curve([0.9, 0.8, 0.8, 0.3, 0.1], [True, True, False, False, True])
    assert found is not None
    assert found.thresholds.tolist() == [0.9, 0.8, 0.3, 0.1]
    assert found.precision.tolist() == pytest.approx([1.0, 2 / 3, 2 / 4, 3 / 5])
    assert found.recall.tolist() == pytest.approx([1 / 3, 2 / 3, 2 / 3, 1.0])
    assert found.average_precision == pytest.approx(1 / 3 + 2 / 9 + 1 / 5)
    assert found.right_share == pytest.approx(0.6)
    assert found.thresholds[found.best()] == 0.1  # F1 of 3/4 against 2/3 at 0.8
    assert found.first_with_precision(0.65) == 1
    assert found.first_with_precision(1.1) is None


def test_the_area_under_roc_is_the_share_of_pairs_in_order() -> None:
    rng = np.random.default_rng(4)
    right = rng.random(60) < 0.6
    scores = np.round(right + rng.normal(0.0, 0.8, 60), 1)
    found = curve(scores, right)
    assert found is not None
    pairs = [(a, b) for a in scores[right] for b in scores[~right]]
    expected = np.mean([1.0 if a > b else 0.5 if a == b else 0.0 for a, b in pairs])
    assert found.roc_auc == pytest.approx(expected)


@pytest.mark.parametrize("right", [[True, True], [False, False]])
def test_without_right_and_wrong_ones_there_is_no_curve_and_no_fit(right: list[bool]) -> None:
    assert curve([0.1, 0.2], right) is None
    assert fit_logistic([0.1, 0.2], right) is None


def drawn(steepness: float, count: int = 20_000) -> tuple[list[float], list[bool]]:
    """Ratios up to 2, right with the probability of Eq. (2)."""
    rng = np.random.default_rng(2)
    ratios = [float(r) for r in rng.uniform(0.0, 2.0, count)]
    return ratios, [bool(rng.random() < closure_probability(r, steepness)) for r in ratios]


def test_the_fit_finds_the_steepness_that_made_the_data() -> None:
    fit = fit_logistic(*drawn(6.0))
    assert fit is not None
    assert fit.steepness == pytest.approx(6.0, rel=0.05)
    assert fit.free_steepness == pytest.approx(6.0, rel=0.05)
    assert fit.free_midpoint == pytest.approx(1.0, abs=0.02)
    assert fit.free_log_loss <= fit.log_loss


def test_right_registrations_with_small_ratios_have_no_steepness() -> None:
    fit = fit_logistic([0.1, 0.2, 0.3, 0.4, 0.5, 0.25], [False, True, True, True, True, False])
    assert fit is not None
    assert fit.steepness is None
    assert fit.log_loss == pytest.approx(np.log(2.0))
    assert fit.free_midpoint is not None
    assert 0.1 < fit.free_midpoint < 0.3


def outcome(ratio: float, similarity: float, inlier: bool, confidence: float | None = None) -> dict[str, Any]:
    return {
        "similarity": similarity,
        "confidence": confidence,
        "confidence_ratio": None if confidence is None else confidence / 2.0,
        "correspondences": int(100 * ratio),
        "ratio": ratio,
        "inlier": inlier,
    }


def row(outcomes: list[dict[str, Any]], scene: str = "s") -> dict[str, Any]:
    return {"cell": scene, "error": None, "scene": scene, "distance_m": 10.0, "error_max_m": 2.0, "outcomes": outcomes}


def outcomes_in_which_the_ratio_is_right(count: int = 40) -> list[dict[str, Any]]:
    rng = np.random.default_rng(1)
    return [outcome(1.5 if k % 2 else 0.1 + 0.001 * k, float(rng.random()), bool(k % 2)) for k in range(count)]


def test_a_ratio_that_knows_beats_a_similarity_that_guesses() -> None:
    summary = summarise(RegistrationSettings(), [row(outcomes_in_which_the_ratio_is_right())])
    assert summary.findings[0].verdict is Verdict.CONFIRMED
    assert {line["metric"] for line in summary.table} == {
        "similarity",
        "correspondences",
        "correspondence ratio, Eq. (1)",
    }
    assert any("n/a: only MASt3R gives confidences" in note for note in summary.notes)


def test_a_similarity_that_knows_contradicts_the_paper() -> None:
    swapped = [
        {**each, "similarity": each["ratio"], "ratio": each["similarity"]}
        for each in outcomes_in_which_the_ratio_is_right(400)
    ]
    assert summarise(RegistrationSettings(), [row(swapped)]).findings[0].verdict is Verdict.CONTRADICTED


def test_confidences_are_compared_where_the_method_gives_them() -> None:
    with_confidence = [outcome(0.5, 0.5, k % 2 == 0, 2.0 + (k % 2)) for k in range(8)]
    metrics = [line["metric"] for line in summarise(RegistrationSettings(), [row(with_confidence)]).table]
    assert metrics[1:3] == ["mean confidence", "confidence ratio"]


def test_where_no_pair_has_a_pose_the_counts_stand_and_nothing_is_claimed() -> None:
    nothing = [{**outcome(0.5, 0.5, False), "inlier": None} for _ in range(3)]
    summary = summarise(RegistrationSettings(), [row(nothing)])
    assert [(line["pairs"], line["with_pose"], line["average_precision"]) for line in summary.table] == [(3, 0, None)]
    assert summary.findings[0].verdict is Verdict.NOT_SHOWN
    assert any("No pair has a pose" in note for note in summary.notes)


def finished(path: Path, outcomes: list[dict[str, Any]]) -> Path:
    folder = ExperimentFolder.start(path, configuration_of(REGISTRATION.name, {}, 1))
    folder.append(row(outcomes))
    folder.write_state(1, 1, 0)
    return path


def test_a_learned_steepness_is_written_and_the_rest_of_the_file_stays(tmp_path: Path) -> None:
    ratios, right = drawn(5.0, 3000)
    found = learned(finished(tmp_path / "run", [outcome(r, 0.5, y) for r, y in zip(ratios, right, strict=True)]))
    assert found.steepness == pytest.approx(5.0, rel=0.1)
    config = tmp_path / "agent.toml"
    config.write_text(
        'name = "r1"  # mine\n\n[backend]\nsolver = "lm"\nsteepness = 4.0  # old\n[core]\n', encoding="utf-8"
    )
    write_steepness(config, found.steepness)
    text = config.read_text(encoding="utf-8")
    assert text == f'name = "r1"  # mine\n\n[backend]\nsolver = "lm"\nsteepness = {found.steepness:g}  # old\n[core]\n'


@pytest.mark.parametrize(
    "text",
    ["", 'name = "r1"\n', '[backend]\nsolver = "lm"\n[core]\n', "[core]\nx = 1\n[backend]\n", "[ backend ] # here\n"],
)
def test_the_key_is_added_where_it_is_missing(text: str) -> None:
    before = tomllib.loads(text)
    after = tomllib.loads(with_steepness(text, 3.5))
    assert after == {**before, "backend": {**before.get("backend", {}), "steepness": 3.5}}


@pytest.mark.parametrize("text", ['backend = {solver = "lm"}\n', "backend.steepness = 2.0\n"])
def test_a_file_written_in_another_way_is_left_alone(text: str, tmp_path: Path) -> None:
    config = tmp_path / "agent.toml"
    config.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"could not be changed safely; set steepness = 3 in \[backend\] by hand"):
        write_steepness(config, 3.0)
    assert config.read_text(encoding="utf-8") == text


def test_no_steepness_is_learned_from_a_partial_experiment_or_where_none_fits(tmp_path: Path) -> None:
    small = [outcome(0.1 * (1 + k % 4), 0.5, k % 4 > 0) for k in range(20)]
    with pytest.raises(ExperimentError, match="no k > 0 fits"):
        learned(finished(tmp_path / "small", small))
    folder = ExperimentFolder.start(tmp_path / "part", configuration_of(REGISTRATION.name, {}, 1))
    folder.append(row(small))
    folder.write_state(2, 1, 0)
    with pytest.raises(ExperimentError, match="the experiment is partial"):
        learned(tmp_path / "part")
    other = ExperimentFolder.start(tmp_path / "other", configuration_of("faults", {}, 1))
    other.write_state(1, 1, 0)
    with pytest.raises(ExperimentError, match="is no registration experiment"):
        learned(tmp_path / "other")


@pytest.mark.parametrize(
    ("plain_m", "robust_m", "verdicts"),
    [
        ((3.0, 1.0, 1.0), (3.0, 1.0, 1.0), [Verdict.CONFIRMED, Verdict.CONFIRMED, Verdict.CONFIRMED]),
        ((1.0, 1.02, 0.99), (1.0, 3.0, 0.5), [Verdict.NOT_SHOWN, Verdict.CONTRADICTED, Verdict.CONTRADICTED]),
        ((90.0, 50.0, 40.0), (9.0, 1.0, 1.0), [Verdict.NOT_SHOWN, Verdict.CONFIRMED, Verdict.CONTRADICTED]),
        ((90.0, 50.0, 40.0), (90.0, 50.0, 40.0), [Verdict.NOT_SHOWN, Verdict.NOT_SHOWN, Verdict.NOT_SHOWN]),
    ],
)
def test_nothing_is_claimed_of_errors_that_are_the_same_or_worse_than_odometry(
    plain_m: tuple[float, ...], robust_m: tuple[float, ...], verdicts: list[Verdict]
) -> None:
    of = {
        (name, solver): MeasuredClaim(ate_m, seconds)
        for solver, errors_m, seconds in (("lm", plain_m, 1.0), ("gnc-tls", robust_m, 3.0))
        for name, ate_m in zip(("base", "independent", "smoothed"), errors_m, strict=True)
    }
    assert [f.verdict for f in formulation_findings("here", of, odometry_m=10.0)] == [*verdicts, Verdict.CONFIRMED]


def test_generated_graphs_join_all_robots_and_robots_that_cannot_meet_are_said() -> None:
    for seed in range(3):
        graph = draw_graph(ScaleSettings(keyframes=60), "generated", False, seed).graph
        pairs = {(c.query.log, c.match.log) for c in graph.closures}
        assert joined(graph.trajectories, pairs) == set(graph.trajectories)
    with pytest.raises(ExperimentError, match="2 robots of 20 keyframes do not all meet in 100 draws"):
        draw_graph(ScaleSettings(robots=2, keyframes=20, closures=4), "generated", False, 1)
