"""Claims: every kind of measurement works in `simulate`; robots without a common view join by tags and by sight."""

import json
from pathlib import Path
from typing import Any

import pytest

from flocc_launch.report.model import RunReport
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.simulate import simulate

APART = {"r1": [[0.0, 0.0], [24.0, 0.0]], "r2": [[24.0, 5.0], [0.0, 5.0]]}
"""Two robots pass each other in parallel streets and look in opposite directions."""


def scenario(sensors: dict[str, Any] | None, **changes: Any) -> Scenario:
    fields: dict[str, Any] = {
        "name": "apart",
        "tracks": {"robots": 2, "seed": 4, "routes_m": APART},
        "keyframes": {"distance_m": 1.0},
        "perception": {"method": "synthetic", "synthetic": {"outlier_probability": 0.0, "alias_probability": 0.0}},
        "duration_s": 60.0,
        "sensors": sensors,
    }
    return Scenario.model_validate({**fields, **changes})


def events(folder: Path, kind: str) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    return [line for line in lines if line["event"] == kind]


def measured(folder: Path) -> dict[str, int]:
    found: dict[str, int] = {}
    for event in events(folder, "measured"):
        found[event["kind"]] = found.get(event["kind"], 0) + 1
    return found


def run(folder: Path, sensors: dict[str, Any] | None, **changes: Any) -> RunReport:
    report = simulate(scenario(sensors, **changes), folder)
    assert report.closures.accepted == 0, "the robots must not have a common view"
    assert events(folder, "measurement_refused") == []
    return report


def test_without_measurements_they_stay_apart(tmp_path: Path) -> None:
    assert run(tmp_path / "run", None).map_frames == ["map/r1", "map/r2"]


def test_two_robots_without_a_common_view_end_in_one_frame_by_a_tag(tmp_path: Path) -> None:
    report = run(tmp_path / "run", {"tags": {"7": [12.0, 2.5, 1.0]}})
    assert measured(tmp_path / "run")["tag"] >= 2
    assert report.map_frames == ["map/r1"]
    assert report.ate_joint_m is not None
    assert report.ate_joint_m < 0.5


@pytest.mark.parametrize("kind", ["robot", "bearing"])
def test_two_robots_without_a_common_view_end_in_one_frame_by_having_seen_each_other(tmp_path: Path, kind: str) -> None:
    sensors = {f"{kind}_range_m": 12.0, "sighting_every_s": 1.0}
    report = run(tmp_path / "run", sensors)
    assert measured(tmp_path / "run")[kind] >= 3
    assert report.map_frames == ["map/r1"]
    assert report.ate_joint_m is not None
    assert report.ate_joint_m < 0.7


def test_two_robots_that_saw_each_other_once_by_bearing_are_named_not_joined(tmp_path: Path) -> None:
    report = run(tmp_path / "run", {"bearing_range_m": 5.4, "sighting_every_s": 60.0})
    assert report.map_frames == ["map/r1", "map/r2"]
    assert "robots r1 and r2 have seen each other" in " ".join(report.warnings)


@pytest.mark.parametrize("kind", ["fix", "gnss"])
def test_positions_take_drift_away_and_join_where_each_robots_way_turns(tmp_path: Path, kind: str) -> None:
    routes = {"r1": [[0.0, 0.0], [24.0, 0.0], [24.0, -20.0]], "r2": [[24.0, 9.0], [0.0, 9.0], [0.0, 30.0]]}
    sensors = {f"{kind}_robots": ["r1", "r2"]}
    changes = {"tracks": {"robots": 2, "seed": 4, "routes_m": routes}, "duration_s": 90.0}
    report = run(tmp_path / "run", sensors, **changes)
    assert measured(tmp_path / "run")[kind] >= 40
    assert report.map_frames == ["map/r1"]
    assert report.ate_joint_m is not None
    assert report.ate_joint_m < 0.3


def test_known_starts_join(tmp_path: Path) -> None:
    report = run(tmp_path / "run", {"start_robots": ["r1", "r2"]})
    assert measured(tmp_path / "run") == {"start": 2}
    assert report.map_frames == ["map/r1"]


def test_closures_of_a_users_own_and_odometry_covariances_are_taken(tmp_path: Path) -> None:
    run(tmp_path / "run", {"closure_every_s": 5.0, "odometry_every_s": 5.0})
    found = measured(tmp_path / "run")
    assert found["closure"] >= 6
    assert found["odometry"] >= 6
    last = [event for event in events(tmp_path / "run", "optimised") if event["measured_used"] > 0][-1]
    assert last["measured_not_used"] == 0


def test_wrong_tag_sightings_are_rejected_and_named(tmp_path: Path) -> None:
    tags = {"tags": {"a": [6.0, 2.5, 1.0], "b": [12.0, 2.5, 1.0], "c": [18.0, 2.5, 1.0]}, "tag_wrong_ratio": 0.2}
    report = run(tmp_path / "run", {**tags, "sighting_every_s": 1.5, "tag_range_m": 6.0, "seed": 3})
    named = [warning for warning in report.warnings if "is not used: disagrees" in warning]
    assert named
    assert report.map_frames == ["map/r1"]
    assert report.ate_joint_m is not None
    assert report.ate_joint_m < 0.5


def test_the_same_scenario_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        run(tmp_path / name, {"tags": {"7": [12.0, 2.5, 1.0]}, "robot_range_m": 6.0})
    assert (tmp_path / "a" / "events.jsonl").read_bytes() == (tmp_path / "b" / "events.jsonl").read_bytes()
