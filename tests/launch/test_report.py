"""What `finish` makes of a run folder."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from tests.launch import synthetic_run
from tests.launch.synthetic_run import Synthetic

from flocc_agent.core.reports import Fact
from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.event_lines import Reported, UnknownFact
from flocc_agent.runtime.facts import AgentDied, KilledByOrder
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_launch.commands.common import show_report
from flocc_launch.report import RunReport, evaluate, finish, read_report
from flocc_launch.report.build import judged, told_of
from flocc_launch.report.text import sentences
from flocc_launch.report.verdict import verdict
from flocc_launch.runs.plain_numbers import plain
from flocc_launch.runs.run_folder import RunFolder, RunFolderError, event_from_line
from flocc_launch.runs.timeline import Merges, deaths_unasked, merges_of
from flocc_launch.runs.trajectory_errors import ate_m

ROBOTS = ["r1", "r2", "r3"]


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return synthetic_run.write(tmp_path / "run")


def report_json(folder: RunFolder) -> dict[str, Any]:
    finish(folder)
    loaded: dict[str, Any] = json.loads((folder.path / "report.json").read_text())
    return loaded


def test_report_has_the_keys_that_other_programs_rely_on(folder: RunFolder) -> None:
    report = report_json(folder)
    assert report["schema_version"] == 1
    assert report["robots"] == ROBOTS
    assert report["map_frames"] == ["map/r1"]
    assert report["closures"]["accepted"] > 20
    assert report["closures"]["rejected"] == sum(report["closures"]["rejected_by_reason"].values()) > 0
    assert report["ate_joint_m"] < 0.5 * report["ate_joint_odometry_m"]
    assert sorted(report["ate_m"]) == ROBOTS
    assert set(report["bytes"]) == {"corrections", "election", "heartbeat", "latents", "records"}
    assert report["leaders"][-1] == {"term": 2, "leader": "r1", "from_s": 4.2, "to_s": report["duration_s"]}
    assert report["merged_after_s"] == 41.3
    assert (report["wall_s"], report["seed"]) == (121.4, 7)
    assert [(e["name"], e["limit"], e["met"]) for e in report["expectations"]] == [
        ("ate_max_m", 0.5, True),
        ("merged_within_s", 60.0, True),
    ]


def test_read_report_gives_what_finish_returned(folder: RunFolder) -> None:
    report = finish(folder)
    assert read_report(folder.path / "report.json") == report


def test_finishing_again_writes_the_same_files(folder: RunFolder) -> None:
    finish(folder)
    written = {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}
    finish(folder)
    assert written == {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}


def test_the_joint_ate_can_be_recomputed_from_the_tum_files(folder: RunFolder) -> None:
    report = finish(folder)
    estimates, truths = (
        [read_tum(folder.path / kind / f"{robot}.tum").T_fixed_body for robot in ROBOTS]
        for kind in ("trajectories", "groundtruth")
    )
    assert report.ate_joint_m == pytest.approx(ate_m(estimates, truths), abs=1e-8)


def test_evo_ape_on_the_tum_files_gives_the_reports_ate(folder: RunFolder) -> None:
    sync = pytest.importorskip("evo.core.sync")
    metrics = pytest.importorskip("evo.core.metrics")
    file_interface = pytest.importorskip("evo.tools.file_interface")
    report = finish(folder)
    for robot in ROBOTS:
        truth = file_interface.read_tum_trajectory_file(folder.path / "groundtruth" / f"{robot}.tum")
        estimate = file_interface.read_tum_trajectory_file(folder.path / "trajectories" / f"{robot}.tum")
        truth, estimate = sync.associate_trajectories(truth, estimate)
        estimate.align(truth)
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data((truth, estimate))
        rmse = ape.get_statistic(metrics.StatisticsType.rmse)
        assert report.ate_m[robot] == pytest.approx(rmse, abs=1e-8)


def test_a_keyframe_after_the_last_correction_moves_with_T_map_odom(folder: RunFolder) -> None:
    finish(folder)
    result = folder.result("r2")
    assert result is not None
    assert result.keyframes[-1].T_map_body is None
    assert len(read_tum(folder.path / "trajectories" / "r2.tum")) == len(result.keyframes)


def test_maps_that_did_not_merge_have_no_joint_ate_but_one_per_frame(tmp_path: Path) -> None:
    report = finish(synthetic_run.write(tmp_path / "run", Synthetic(merged_s=None)))
    assert report.map_frames == ["map/r1", "map/r2", "map/r3"]
    assert report.ate_joint_m is None
    assert report.merged_after_s is None
    assert all(value is not None for value in report.ate_by_frame_m.values())
    assert {e.name: e.met for e in report.expectations} == {"ate_max_m": None, "merged_within_s": False}


def test_nothing_is_invented_without_ground_truth(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run", Synthetic(with_truth=False))
    report = finish(folder)
    assert (report.ate_joint_m, report.ate_joint_odometry_m) == (None, None)
    assert report.ate_m == dict.fromkeys(ROBOTS)
    assert not (folder.path / "groundtruth").exists()


def test_a_killed_robot_is_reported_and_the_rest_go_on(tmp_path: Path) -> None:
    report = finish(synthetic_run.write(tmp_path / "run", Synthetic(died=("r1", 50.0))))
    assert report.warnings[0] == "r1 died after 50.0 s (signal 9)."
    assert "r1 left no result; its trajectory is odometry only." in report.warnings
    assert report.leaders[-1].leader == "r2"
    assert [span.to_s for span in report.leaders if span.leader == "r1"][-1] >= 50.0
    r1 = report.robot_details[0]
    assert (r1.end, r1.ended_s, r1.map_frame) == ("died", 50.0, None)
    assert r1.keyframes > 10
    assert report.ate_joint_m == report.ate_by_frame_m["map/r1"]
    assert report.ate_dead_m == {}
    assert report.ate_by_frame_m["map/r1"] is not None


def test_living_robots_count_as_merged_when_another_died() -> None:
    correction = '"event": "correction", "term": 1, "round": 1, "T_map_odom": [0, 0, 0, 1, 0, 0, 0]'
    lines = [
        f'{{"t": 1, "robot": "r1", "map_frame": "map/r1", {correction}}}',
        f'{{"t": 2, "robot": "r2", "map_frame": "map/r1", {correction}}}',
        '{"t": 3, "robot": "r3", "event": "agent_died", "signal": 9}',
    ]
    events = [event_from_line(line, "events.jsonl") for line in lines]
    assert merges_of(events, ["r1", "r2", "r3"]) == Merges(3)
    assert merges_of(events, ["r1", "r2"]) == Merges(2)
    assert merges_of(events[:2], ["r1", "r2", "r3"]) == Merges(None)
    assert merges_of(events[:1], ["r1"]) == Merges(None)


A, B, C = "map/r1", "map/r2", "map/r1.1"


@pytest.mark.parametrize(
    ("story", "found"),
    [
        ([(1, "r1", A), (2, "r2", A)], Merges(2)),
        ([(1, "r1", A), (2, "r2", A), (3, "r2", B), (5, "r2", A)], Merges(5, ((2, 3),))),
        ([(1, "r1", A), (2, "r2", A), (3, "r2", B)], Merges(None, ((2, 3),))),
        ([(1, "r1", B), (2, "r2", B), (3, "r1", A), (4, "r2", A)], Merges(2)),
        ([(1, "r1", B), (2, "r2", B), (3, "r1", C), (4, "r1", A), (5, "r2", A)], Merges(5, ((2, 3),))),
        ([(1, "r1", A), (2, "r2", A), (3, "r2", "died"), (4, "r2", "keyframe"), (5, "r2", B), (6, "r2", A)], Merges(2)),
        ([(1, "r1", A), (2, "r2", A), (3, "r2", "died")], Merges(2)),
        ([(1, "r1", A), (2, "r2", A), (3, "r2", B), (4, "r1", "died")], Merges(None, ((2, 3),))),
    ],
    ids=["held", "taken back", "parted at the end", "gone over", "apart meanwhile", "came back", "died", "lost"],
)
def test_a_merge_counts_from_when_it_held(story: list[tuple[float, str, str]], found: Merges) -> None:
    kinds = {
        "died": '"event": "agent_died", "signal": 9',
        "keyframe": '"event": "keyframe", "keyframe": "r2/9", "stamp_s": 1, "T_odom_body": [0, 0, 0, 1, 0, 0, 0]',
    }
    correction = '"event": "correction", "term": 1, "round": 1, "T_map_odom": [0, 0, 0, 1, 0, 0, 0], "map_frame": "%s"'
    lines = [f'{{"t": {t}, "robot": "{robot}", {kinds.get(what) or correction % what}}}' for t, robot, what in story]
    assert merges_of([event_from_line(line, "events.jsonl") for line in lines], ["r1", "r2"]) == found


def test_bytes_of_a_restarted_robot_are_added(folder: RunFolder) -> None:
    before = finish(folder).bytes_by_robot["r1"].sent["heartbeat"]
    event = {"t": 1e3, "robot": "r1", "event": "bytes", "sent": {"heartbeat": 10}, "received": {}}
    with (folder.path / "events.jsonl").open("a") as file:
        file.write(json.dumps(event) + "\n")
    assert finish(folder).bytes_by_robot["r1"].sent["heartbeat"] == before + 10


def test_that_distributed_mode_used_no_fixes_is_said(folder: RunFolder) -> None:
    fix = {"t": 1.0, "robot": "r1", "event": "measured", "kind": "fix", "keyframe": "r1/0", "of": ""}
    shared = {"t": 1e3, "robot": "r1", "event": "bytes", "sent": {"shared-poses": 10}, "received": {}}
    told = []
    for more in (shared, {**fix, "kind": "odometry"}, fix, fix):
        with (folder.path / "events.jsonl").open("a") as file:
            file.write(json.dumps(more) + "\n")
        told.append([warning for warning in finish(folder).warnings if warning.startswith("Distributed mode")])
    assert told[:2] == [[], []]
    (sentence,) = told[3]
    assert sentence.startswith("Distributed mode used no measurements: 2 of the kind fix were kept only")


def test_evaluate_says_what_the_report_holds(folder: RunFolder) -> None:
    text = evaluate(folder.path)
    assert text.startswith("All three robots found one common map")
    assert "joint ATE     0.134 m; odometry at its true starts 1.64 m, aligned 1.46 m" in text
    assert "expected      merged_within_s 60: 41.3, met" in text
    assert RunReport.model_validate_json(evaluate(folder.path, as_json=True)) == read_report(
        folder.path / "report.json"
    )


def test_without_ground_truth_no_line_is_full_of_dashes(tmp_path: Path) -> None:
    text = evaluate(synthetic_run.write(tmp_path / "run", Synthetic(with_truth=False)).path)
    assert "There is no ground truth" in text
    told = [line for line in text.splitlines() if not line.startswith("expected")]
    assert not [line for line in told if "–" in line or "ATE" in line]


def test_what_was_missed_stands_in_the_first_line_in_red_on_a_terminal(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = finish(folder)
    assert not sentences(report)[0].startswith("MISSED")
    limits = {"ate_max_m": 0.01, "merged_within_s": 60.0}
    missed = report.model_copy(update={"expectations": judged(limits, report)})
    assert sentences(missed)[0] == f"MISSED: ate_max_m {plain(0.01)} ({plain(report.ate_joint_m)})"

    told: list[str] = []
    monkeypatch.setattr("typer.secho", lambda text, **how: told.append(typer.style(text, **how)))
    with pytest.raises(SystemExit) as left:
        show_report(missed, folder.path)
    assert left.value.code == 1
    assert told[0].startswith("\x1b[31m\x1b[1mMISSED: ")
    assert verdict(missed) in told[1]


@pytest.mark.slow
def test_evaluate_lets_evo_speak(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("evo")
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent))
    for robot in ("r2", "r3"):
        (folder.path / "recordings" / robot / "groundtruth.tum").unlink()
    text = evaluate(folder.path, with_evo=True)
    rmse = [float(line.split()[1]) for line in text.splitlines() if line.split()[:1] == ["rmse"]]
    assert rmse == pytest.approx([read_report(folder.path / "report.json").ate_m["r1"]], abs=1e-6)
    assert "r2: evo has nothing to compare (no ground truth)" in text


def test_an_unknown_expectation_is_not_judged(folder: RunFolder) -> None:
    (expectation,) = judged({"happiness_min": 1.0}, finish(folder))
    assert (expectation.value, expectation.met) == (None, None)


def test_gtsam_reads_the_pose_graph_and_its_closures_agree_with_the_poses(folder: RunFolder) -> None:
    gtsam = pytest.importorskip("gtsam")
    report = finish(folder)
    graph, values = gtsam.readG2o(str(folder.path / "pose_graph.g2o"), True)
    keyframes = sum(robot.keyframes for robot in report.robot_details)
    assert values.size() == keyframes
    assert graph.size() == keyframes - 3 + report.closures.accepted
    closure = gtsam.BetweenFactorPose3
    errors = [graph.at(k) for k in range(graph.size()) if isinstance(graph.at(k), closure)]
    offsets = [
        factor.measured().between(values.atPose3(factor.keys()[0]).between(values.atPose3(factor.keys()[1])))
        for factor in errors
        if abs(factor.keys()[0] - factor.keys()[1]) > 1
    ]
    assert len(offsets) == report.closures.accepted
    assert max(float(np.linalg.norm(T.translation())) for T in offsets) < 1.0


@pytest.mark.parametrize(
    ("name", "damage", "sentence"),
    [
        ("run.json", "", r"run\.json: is cut off or not JSON"),
        ("run.json", '{"version": 9, "scenario": "x", "robots": []}', r"run\.json: is of version 9"),
        ("run.json", '{"scenario": "x"}', r"run\.json: robots: Field required"),
        ("events.jsonl", '{"t": 1, "robot": "r1", "event": "keyf', r"events\.jsonl:1: is cut off or not JSON"),
        ("events.jsonl", '{"t": 1, "robot": "r1"}', r"events\.jsonl:1: event: Field required"),
        ("events.jsonl", "[]", r"events\.jsonl:1: \(top level\): "),
        (
            "events.jsonl",
            '{"t": 1, "robot": "r1", "event": "candidate", "query": "r1/x", "match": "r2/1", "similarity": 1}',
            r"events\.jsonl:1: query: ",
        ),
        ("robots/r1/result.json", '{"robot": "r1", "keyf', r"result\.json: is cut off or not JSON"),
        ("robots/r1/result.json", '{"robot": "r1", "T_map_odom": [0,0,0,0,0,0,0]}', r"T_map_odom: .*unit length"),
    ],
)
def test_a_damaged_folder_is_named_in_one_sentence(folder: RunFolder, name: str, damage: str, sentence: str) -> None:
    (folder.path / name).write_text(damage)
    with pytest.raises(RunFolderError, match=sentence) as caught:
        finish(RunFolder.open(folder.path))
    assert "\n" not in str(caught.value)


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"has no run\.json"):
        RunFolder.open(tmp_path)
    with pytest.raises(RunFolderError, match="is not a folder"):
        RunFolder.open(tmp_path / "nothing")


def test_a_run_is_not_written_over_another(folder: RunFolder) -> None:
    with pytest.raises(RunFolderError, match="holds a run already"):
        RunFolder.create(folder.path)


def test_an_event_of_a_later_version_is_kept_as_it_is() -> None:
    event = event_from_line('{"t": 2.5, "robot": "r1", "event": "teleported", "where": "mars"}', "here")
    assert event == Reported(2.5, "r1", UnknownFact("teleported", {"where": "mars"}))


def test_events_of_a_later_version_are_counted_in_the_report(folder: RunFolder) -> None:
    path = folder.path / "events.jsonl"
    later = '{"t": 2.5, "robot": "r1", "event": "teleported", "where": "mars"}\n'
    path.write_text(path.read_text() + 2 * later)
    report = finish(folder)
    assert "This version does not know events of the kind teleported (2 in this run)." in report.warnings
    assert "of the kind teleported" in (folder.path / "report.html").read_text()


def test_a_run_without_any_event_has_a_report(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    folder.write_run(synthetic_run.run_of(Synthetic(with_truth=False)))
    folder.write_events([])
    report = finish(folder)
    assert (report.closures.accepted, report.leaders, report.bytes) == (0, [], {})
    assert (report.ate_joint_m, report.merged_after_s, report.duration_s) == (None, None, 0.0)


def test_an_order_to_kill_explains_one_death_of_its_robot_and_no_later_one() -> None:
    died = AgentDied(signal=9, exit_code=None, scripted=False)
    told: list[tuple[float, Fact]] = [
        (1.0, KilledByOrder()),
        (1.2, died),
        (8.0, died),
        (9.0, AgentDied(signal=9, exit_code=None, scripted=True)),
    ]
    assert deaths_unasked([Reported(t, "r1", each) for t, each in told]) == ["r1"]


def test_a_result_names_the_order_of_its_poses(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    fields = json.loads((folder.path / "robots/r1/result.json").read_text())
    assert fields["pose_order"] == "x y z qw qx qy qz"
    result = folder.results()["r1"]
    assert np.allclose(result.T_odom_body()[3], pose_from_tq(np.array(fields["keyframes"][3]["T_odom_body"])))


def test_closures_that_wait_are_told_a_few_times_and_other_warnings_each() -> None:
    held = [f"closure r1/{k} - r2/{k}: held until another one agrees with it, because it would turn" for k in range(9)]
    told = told_of(["the scale collapsed", *held, "a gap"])
    assert told[:5] == ["the scale collapsed", *held[:3], "a gap"]
    assert told[5:] == ["6 more closures are held until others agree with them (events.jsonl names them)"]
    assert told_of(held[:3]) == held[:3]
