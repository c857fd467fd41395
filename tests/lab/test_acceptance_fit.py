"""Rules for closures, fitted on rows whose truth is known."""

from pathlib import Path

import numpy as np
import pytest

from flocc_agent.perception.multiview.acceptance import Evidence, OdometryNeighbour

fit = pytest.importorskip("flocc_lab.bench.acceptance_fit")
rows_module = pytest.importorskip("flocc_lab.bench.acceptance_rows")
Row = rows_module.AcceptanceRow


def rows(scene: str, seed: int, wrong_up_to: int = 40) -> list[object]:
    """Right pairs of all counts; wrong ones of few correspondences, uncertain or contradicted by the neighbour."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(200):
        is_right = bool(rng.uniform() < 0.7)
        count = int(rng.integers(15, 200) if is_right else rng.integers(15, wrong_up_to))
        word = OdometryNeighbour.AGREES if is_right else OdometryNeighbour.CONTRADICTS
        evidence = Evidence(count, count / 400, bool(k % 2), 0.006 if is_right else 0.012, word)
        made.append(Row(scene, k, k + 1, True, float(rng.uniform(0, 150)), count, 400, evidence, is_right))
    return made


def test_a_rule_that_separates_keeps_all_right_and_no_wrong_pair() -> None:
    found = fit.report(rows("a", 1) + rows("b", 2), fit.rule_in_use("classical"))

    assert found["pairs"] == 400
    for scene in ("a", "b"):
        for key in ("fitted", "left_out"):
            entry = found["scenes"][scene][key]
            assert (entry["right"], entry["wrong"]) == (entry["possible"], 0)
    assert sum(entry["fitted"]["possible"] for entry in found["angles"].values()) == sum(
        entry["fitted"]["possible"] for entry in found["scenes"].values()
    )
    assert "left_out" in fit.text("toy", found)


def test_a_rule_of_the_other_scenes_is_what_judges_a_scene() -> None:
    easy = [row for row in rows("easy", 3) if row.is_right]  # type: ignore[attr-defined]
    hard = rows("hard", 4, wrong_up_to=150)

    found = fit.report(easy + hard, fit.rule_in_use("xfeat-lighterglue"))["scenes"]

    assert found["hard"]["left_out"]["wrong"] > 0  # the easy scene has no wrong pair to learn from
    assert found["hard"]["fitted"]["wrong"] == 0


def test_a_pair_of_which_less_is_known_needs_no_less() -> None:
    """Of scenes that hold no wrong pair without a scale the fit would ask for next to nothing there."""
    pairs = rows("a", 6, wrong_up_to=90)
    made = [row for row in pairs if row.is_right or row.evidence.has_scale]  # type: ignore[attr-defined]

    rule = fit.fitted(made, 1.15)

    assert rule.without_scale.alone >= rule.with_scale.alone > fit.ALONE[0]
    assert rule.without_scale.agreeing >= rule.with_scale.agreeing


def test_the_neighbour_is_not_heard_where_the_rule_does_not_ask_it() -> None:
    contradicted = Evidence(100, 0.1, True, 0.001, OdometryNeighbour.CONTRADICTS)
    row = Row("a", 0, 1, True, 10.0, 100, 1000, contradicted, True)

    rule = fit.fitted([row], 1.2)

    assert fit.accepts(row, rule)
    assert not fit.accepts(row, None)  # Eq. (1) is 0.1


def test_rows_survive_their_file(tmp_path: Path) -> None:
    made = [*rows("a", 5)[:10], Row("a", 1, 2, False, 100.0, 3, 100)]

    rows_module.write_rows(made, tmp_path / "rows.jsonl")

    assert rows_module.read_rows(tmp_path / "rows.jsonl") == made
