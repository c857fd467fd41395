"""`simulate`: the same bytes for the same seed, and a whole run folder."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flocc_agent.core.reports import ClosureAccepted, CorrectionApplied, KeyframeTaken, LeaderFollowed
from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.event_lines import of_kind
from flocc_agent.runtime.facts import AgentDied
from flocc_launch.doctor import diagnose
from flocc_launch.report.text import sentences
from flocc_launch.runs.loaded_run import load
from flocc_launch.runs.moments import errors_then_m, moments_of
from flocc_launch.runs.run_folder import RunFolder, RunFolderError
from flocc_launch.runs.tracks import lost_robots
from flocc_launch.scenarios.leader_faults import FaultError
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.simulate import simulate


def scenario(**changes: Any) -> Scenario:
    fields: dict[str, Any] = {
        "name": "small",
        "tracks": {"robots": 3, "seed": 4, "area_m": 16.0, "length_m": 30.0},
        "keyframes": {"distance_m": 1.0},
        "perception": {"method": "synthetic", "synthetic": {"outlier_probability": 0.0, "alias_probability": 0.0}},
        "simulation": {"optimiser": "quick"},
        "radio": {"loss_ratio": 0.2, "latency_s": 0.05, "jitter_s": 0.05},
        "expectations": {"merged_within_s": 60.0, "closures_min": 5},
    }
    return Scenario.model_validate({**fields, **changes})


def test_the_same_seed_gives_the_same_bytes_and_another_differs(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        simulate(scenario(), tmp_path / name, seed)
    a, b, c = ((tmp_path / name / "events.jsonl").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_robots_on_virtual_time_merge_and_meet_their_expectations(tmp_path: Path) -> None:
    report = simulate(scenario(), tmp_path / "run")
    assert report.map_frames == ["map/r1"]
    assert all(expectation.met for expectation in report.expectations)
    assert report.driver == "simulate"
    assert report.ate_joint_m is not None


def test_what_the_last_corrections_told_is_the_final_map(tmp_path: Path) -> None:
    report = simulate(scenario(simulation={"optimiser": "backend"}), tmp_path / "run")
    loaded = load(RunFolder.open(tmp_path / "run"))
    moments = moments_of(loaded.events, loaded.tracks)
    everything = {robot: len(track) for robot, track in loaded.tracks.items()}
    last = errors_then_m(replace(moments[-1], keyframes=everything), loaded.tracks)
    assert last is not None
    assert last == pytest.approx((report.ate_joint_m, report.ate_joint_odometry_m), abs=2e-3)
    errors = [found for moment in moments if (found := errors_then_m(moment, loaded.tracks)) is not None]
    assert report.iate_moments == len(errors) > 1
    assert (report.iate_m, report.iate_odometry_m) == pytest.approx(tuple(np.mean(errors, axis=0)))
    assert report.if1 is not None
    assert report.if1 > 0.9


def test_a_run_folder_is_whole(tmp_path: Path) -> None:
    simulate(scenario(), tmp_path / "run")
    names = {str(path.relative_to(tmp_path / "run")) for path in (tmp_path / "run").rglob("*") if path.is_file()}
    wanted = {"run.json", "events.jsonl", "report.json", "report.html", "pose_graph.g2o", "groundtruth/r1.tum"}
    assert wanted <= names
    told = {type(event.fact) for event in RunFolder.open(tmp_path / "run").events()}
    assert told >= {KeyframeTaken, LeaderFollowed, CorrectionApplied}


def test_no_wall_clock_is_in_the_events(tmp_path: Path) -> None:
    simulate(scenario(), tmp_path / "run")
    lines = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert {line["solve_s"] for line in lines if line["event"] == "optimised"} == {0.0}


def test_a_killed_robot_is_reported_and_the_rest_goes_on(tmp_path: Path) -> None:
    report = simulate(scenario(faults=[{"at_s": 20.0, "kind": "kill", "robots": ["r1"]}]), tmp_path / "run")
    events = RunFolder.open(tmp_path / "run").events()
    assert [(event.robot, event.t) for event in of_kind(events, AgentDied)] == [("r1", 20.0)]
    assert [span.leader for span in report.leaders][-1] == "r2"
    killed = next(finding for finding in diagnose(RunFolder.open(tmp_path / "run")) if finding.robots == ("r1",))
    assert (killed.cause, killed.advice) == ("agent-killed", "")


def test_a_folder_that_holds_a_run_is_left_alone(tmp_path: Path) -> None:
    simulate(scenario(), tmp_path / "run")
    with pytest.raises(RunFolderError, match="holds a run already"):
        simulate(scenario(), tmp_path / "run")


@pytest.mark.parametrize(
    "fault",
    [
        {"at_s": 1.0, "kind": "kill", "robots": ["r9"]},
        {"at_s": 1.0, "kind": "partition", "groups": [["r1"], ["r9"]]},
    ],
)
def test_a_fault_that_names_a_robot_that_is_not_there_is_refused(fault: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="'r9'"):
        scenario(faults=[fault])


def test_a_mute_names_what_it_swallows() -> None:
    with pytest.raises(ValueError, match="kind of message"):
        scenario(faults=[{"at_s": 1.0, "kind": "mute", "value": 1.0}])


def test_a_robot_without_images_of_its_own_serves_the_others(tmp_path: Path) -> None:
    robots = {"server": {"compute_class": 9}}
    report = simulate(scenario(robots=robots), tmp_path / "run")
    assert {span.leader for span in report.leaders} == {"server"}
    events = RunFolder.open(tmp_path / "run").iterate_events()
    by = Counter(event.fact.by for event in of_kind(events, ClosureAccepted))
    assert by["server"] > 0.8 * by.total()


def test_after_a_scripted_kill_the_error_is_of_the_survivors_and_of_the_dead_until_it_died(tmp_path: Path) -> None:
    kill = {"at_s": 25.0, "kind": "kill", "robots": ["r2"]}
    report = simulate(scenario(faults=[kill], expectations={"ate_max_m": 2.0}), tmp_path / "run")
    assert report.ate_joint_m is not None
    assert [(e.name, e.met) for e in report.expectations] == [("ate_max_m", True), ("deaths_max", True)]
    assert list(report.ate_dead_m) == ["r2"]
    assert report.ate_dead_m["r2"] < 2.0
    assert "of the survivors, r2 until it died" in next(line for line in sentences(report) if "joint ATE" in line)
    result = RunFolder.open(tmp_path / "run").result("r2")
    assert result is not None
    taken = of_kind(RunFolder.open(tmp_path / "run").events(), KeyframeTaken)
    assert len(result.keyframes) == sum(event.robot == "r2" and event.t <= 25.0 for event in taken)
    assert result.T_map_odom is not None
    survivors = RunFolder.open(tmp_path / "run").results()
    lost = lost_robots(survivors)["r2"]
    assert (lost.map_frame, survivors["r3"].lost[0].knots) == ("map/r1", [])
    off = lost.T_map_body(result.T_odom_body()) - [pose_from_tq(np.array(k.T_map_body)) for k in result.keyframes]
    assert np.abs(off[:, :3, 3]).max() < 0.5


def test_a_fault_may_name_whoever_leads_when_it_happens(tmp_path: Path) -> None:
    kills = [{"at_s": at_s, "kind": "kill", "robots": ["leader"]} for at_s in (10.0, 25.0)]
    report = simulate(scenario(faults=kills), tmp_path / "run")
    died = [event.robot for event in of_kind(RunFolder.open(tmp_path / "run").events(), AgentDied)]
    assert died == ["r1", "r2"]
    assert report.leaders[-1].leader == "r3"
    assert (len(report.map_frames), sorted(report.ate_dead_m)) == (1, ["r1", "r2"])
    apart = {"at_s": 5.0, "kind": "partition", "groups": [["leader"], ["r2", "r3"]]}
    alone = simulate(scenario(faults=[apart], duration_s=20.0), tmp_path / "apart")
    assert {span.leader for span in alone.leaders if span.to_s == 20.0} == {"r1", "r2"}


def test_a_fault_of_the_leader_where_nobody_leads_ends_the_run_with_a_sentence(tmp_path: Path) -> None:
    kill = {"at_s": 0.1, "kind": "kill", "robots": ["leader"]}
    with pytest.raises(FaultError, match=r"'kill' at 0\.1 s concerns the leader, but nobody leads then"):
        simulate(scenario(faults=[kill]), tmp_path / "run")


def test_a_fault_an_hour_after_all_was_played_is_a_slip(tmp_path: Path) -> None:
    faults = [{"at_s": 1e6, "kind": "kill", "robots": ["r1"]}]
    with pytest.raises(FaultError, match=r"small: a fault at 1e\+06 s comes over 60 min 0 s after the end of all that"):
        simulate(scenario(faults=faults), tmp_path / "run")
