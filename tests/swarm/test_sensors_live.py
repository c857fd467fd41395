"""Claim: every kind of measurement that a scenario's sensors draw travels and counts in real processes over zenoh."""

import json
from pathlib import Path
from typing import Any

import pytest
from tests.simulation.test_measurements import APART, measured

from flocc_agent.core.measurement_text import KINDS
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.swarm.launching import launch

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


def test_two_processes_without_a_common_view_join_by_what_they_measure(tmp_path: Path) -> None:
    sensors: dict[str, Any] = {
        "tags": {"7": [12.0, 2.5, 1.0]},
        "robot_range_m": 8.0,
        "bearing_range_m": 8.0,
        "fix_robots": ["r1"],
        "gnss_robots": ["r2"],
        "start_robots": ["r1", "r2"],
        "closure_every_s": 5.0,
        "odometry_every_s": 5.0,
    }
    scenario = Scenario.model_validate(
        {
            "name": "apart",
            "rate": 2.0,
            "settle_s": 4.0,
            "tracks": {"robots": 2, "seed": 4, "routes_m": APART},
            "keyframes": {"distance_m": 1.0},
            "perception": {"method": "synthetic", "synthetic": {"outlier_probability": 0.0, "alias_probability": 0.0}},
            "sensors": sensors,
        }
    )
    report = launch(scenario, tmp_path / "run")
    assert report.closures.accepted == 0
    assert report.map_frames == ["map/r1"]
    assert report.ate_joint_m is not None
    assert report.ate_joint_m < 0.5
    kept = measured(tmp_path / "run")
    assert set(kept) == set(KINDS) - {"pose"}, "a whole pose in between is a known start at a later keyframe"
    lines = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert [line for line in lines if line["event"] == "measurement_refused"] == []
    last = [line for line in lines if line["event"] == "optimised"][-1]
    assert last["measured_used"] >= 0.8 * (sum(kept.values()) - kept["odometry"])
    logs = [json.loads((tmp_path / "run" / "robots" / r / "result.json").read_text())["logs"] for r in ("r1", "r2")]
    assert logs[0] == logs[1]
