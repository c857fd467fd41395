"""The order of candidates under a budget: its smallest version, and how its shares are read off the curves."""

from pathlib import Path
from typing import Any

import pytest

from flocc_lab.experiments.candidate_orders import CANDIDATE_ORDER, findings, reached, shares_of
from flocc_lab.experiments.experiment import Verdict
from flocc_lab.experiments.runner import run_experiment


def row(order: str, curve: list[list[Any]], run: int = 0) -> dict[str, Any]:
    return {"order": order, "run": run, "curve": curve}


def test_the_smallest_version_draws_its_figure_and_spectral_order_joins_the_maps_first(tmp_path: Path) -> None:
    settings = CANDIDATE_ORDER.settings.model_validate(CANDIDATE_ORDER.quick)
    result = run_experiment(CANDIDATE_ORDER, settings, 1, tmp_path / "out")
    assert result.errors == []
    kinds = {f"candidate-order.{kind}" for kind in ("csv", "md", "png", "svg")}
    assert kinds | {"findings.json"} <= {path.name for path in (tmp_path / "out").iterdir()}
    curves = {found["order"]: dict(found["curve"]) for found in result.rows}
    joined = {order: min(n for n, error in curve.items() if error is not None) for order, curve in curves.items()}
    assert joined["spectral"] < joined["similarity"]
    assert all(row["curve"][-1][1] is not None for row in result.rows)


def test_an_accuracy_is_reached_where_it_stays() -> None:
    curve: list[list[Any]] = [[4, None], [8, 1.0], [12, 3.0], [16, 0.9], [20, 0.95]]
    assert reached(curve, 1.0) == 16
    assert reached(curve, 5.0) == 8
    assert reached(curve, 0.5) is None


def test_shares_are_of_what_was_spent_and_of_what_first_sufficed() -> None:
    rows = [
        row("similarity", [[8, None], [16, 2.0], [32, 1.04], [64, 1.0]]),
        row("spectral", [[8, 1.5], [16, 1.02], [32, 0.9]]),
    ]
    assert shares_of(rows) == [(0, 16 / 64, 16 / 32)]


@pytest.mark.parametrize("curve", [[[8, None], [16, None]], [[8, 3.0], [16, 1.2]]])
def test_what_is_never_reached_counts_against_the_claim(curve: list[list[Any]]) -> None:
    rows = [row("similarity", [[8, 2.0], [16, 1.0]]), row("spectral", curve)]
    assert shares_of(rows) == [(0, None, None)]
    assert [finding.verdict for finding in findings(rows)] == [Verdict.CONTRADICTED] * 2


def test_runs_that_end_in_several_maps_give_no_share() -> None:
    rows = [row("similarity", [[8, None]]), row("spectral", [[8, 1.0]])]
    assert shares_of(rows) == []
    assert findings(rows) == []
