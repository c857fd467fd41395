"""Distributed optimisation between processes over real zenoh: shared poses travel, everybody corrects itself."""

import json
from pathlib import Path

import pytest

from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.swarm.launching import launch

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]


def test_three_processes_optimise_together_over_a_lossy_link(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    exact = {"scale_sigma_ratio": 0.0, "scale_drift_sigma_ratio": 0.0}
    scenario = Scenario.model_validate(
        {
            "name": "together",
            "rate": 4.0,
            "settle_s": 3.0,
            "tracks": {"robots": 3, "seed": 3, "area_m": 12.0, "length_m": 40.0},
            "perception": {"method": "synthetic", "synthetic": exact},
            "backend": {"mode": "distributed", "formulation": "base"},
            "radio": {"loss_ratio": 0.2},
        }
    )
    report = launch(scenario, tmp_path / "run")
    assert report.map_frames == ["map/r1"]
    assert report.ate_joint_m is not None
    assert report.ate_joint_m < 1.0
    assert report.bytes["shared-poses"] > 0
    lines = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert "optimised" not in {line["event"] for line in lines}
    givers = {(line["robot"], line["leader"]) for line in lines if line["event"] == "correction"}
    assert givers == {("r1", "r1"), ("r2", "r2"), ("r3", "r3")}
