"""Evaluation destroys nothing that a person put into a run, and names what is wrong with ground truth."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.launch import synthetic_run
from tests.launch.synthetic_run import Synthetic
from tests.launch.test_evaluation import program

from flocc_agent.geometry import Float, pose
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_launch.doctor import diagnose
from flocc_launch.report import evaluate, finish
from flocc_launch.runs.run_folder import RunFolder


def truth_of(made: Synthetic, robot: str) -> Trajectory:
    return Trajectory(synthetic_run.stamps(made.truth[robot]), made.truth[robot])


def give(folder: RunFolder, robot: str, truth: Trajectory) -> bytes:
    path = folder.path / "groundtruth" / f"{robot}.tum"
    path.parent.mkdir(exist_ok=True)
    write_tum(path, truth)
    return path.read_bytes()


def lifted(poses: Float) -> Float:
    return pose(np.eye(3), np.array([0.0, 0.0, 100.0])) @ poses


def test_a_truth_that_a_person_gave_counts_and_stays_as_it_is(tmp_path: Path) -> None:
    made = Synthetic(with_truth=False)
    folder = synthetic_run.write(tmp_path / "run", made)
    assert finish(folder).ate_joint_m is None
    given = {robot: give(folder, robot, truth_of(made, robot)) for robot in made.truth}
    assert finish(folder).ate_joint_m is not None
    evaluate(folder.path)
    assert {robot: (folder.path / "groundtruth" / f"{robot}.tum").read_bytes() for robot in given} == given


def test_a_given_truth_goes_before_the_recordings(tmp_path: Path) -> None:
    made = Synthetic()
    folder = synthetic_run.write(tmp_path / "run", made)
    before = finish(folder)
    for robot in made.truth:
        give(folder, robot, Trajectory(synthetic_run.stamps(made.truth[robot]), 2.0 * lifted(made.truth[robot]) / 2.0))
    assert finish(folder).ate_joint_m == pytest.approx(before.ate_joint_m, abs=1e-6)
    assert read_tum(folder.path / "groundtruth" / "r1.tum").T_fixed_body[0, 2, 3] > 99.0


def test_a_recording_that_another_user_keeps_costs_its_pictures_and_not_the_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = synthetic_run.write(tmp_path / "run", Synthetic())
    before = finish(folder)
    barred = folder.path / "recordings" / "r2"
    monkeypatch.setattr(os, "access", lambda path, _: Path(path) != barred)
    report = finish(folder)
    assert report.ate_joint_m == before.ate_joint_m
    (said,) = (warning for warning in report.warnings if "may not read" in warning)
    assert said.startswith("The recordings of r2 lie where you may not read")
    assert "ground truth" not in said
    (folder.path / "groundtruth" / "r2.tum").unlink()
    report = finish(folder)
    assert any("nor ground truth of r2: put it into groundtruth/" in warning for warning in report.warnings)
    assert {r.robot: r.corrected.ate_m is None for r in report.robot_details} == {"r1": False, "r2": True, "r3": False}


def test_what_flocc_made_of_a_truth_is_made_again(tmp_path: Path) -> None:
    made = Synthetic()
    folder = synthetic_run.write(tmp_path / "run", made)
    finish(folder)
    changed = Trajectory(synthetic_run.stamps(made.truth["r1"]), lifted(made.truth["r1"]))
    write_tum(folder.path / "recordings" / "r1" / "groundtruth.tum", changed)
    finish(folder)
    assert read_tum(folder.path / "groundtruth" / "r1.tum").T_fixed_body[0, 2, 3] > 99.0


def test_a_truth_on_another_clock_is_named_with_the_offset(tmp_path: Path) -> None:
    made = Synthetic()
    folder = synthetic_run.write(tmp_path / "run", made)
    write_tum(folder.path / "recordings" / "r2" / "groundtruth.tum", truth_of(made, "r2").later(-3600.0))
    report = finish(folder)
    said = [warning for warning in report.warnings if "clock" in warning]
    assert len(said) == 1
    assert said[0].startswith("The ground truth of r2 has no pose at its keyframes")
    assert "-3600.000 s" in said[0]
    assert "truth-clock" in {finding.cause for finding in diagnose(folder)}


def test_truths_in_separate_frames_are_named_and_give_no_joint_error(tmp_path: Path) -> None:
    made = Synthetic()
    folder = synthetic_run.write(tmp_path / "run", made)
    for robot in made.truth:
        own = truth_of(made, robot).relative_to_first()
        write_tum(folder.path / "recordings" / robot / "groundtruth.tum", own)
    report = finish(folder)
    assert (report.ate_joint_m, report.ate_joint_odometry_m, report.ate_by_frame_m) == (None, None, {})
    assert all(error_m is not None and error_m < 0.5 for error_m in report.ate_m.values())
    assert any("r1, r2, r3 are in separate frames" in warning for warning in report.warnings)
    assert "truth-frames" in {finding.cause for finding in diagnose(folder)}


def test_a_truth_moved_away_from_the_others_is_doubted_and_the_figure_stays(tmp_path: Path) -> None:
    made = Synthetic()
    folder = synthetic_run.write(tmp_path / "run", made)
    moved = Trajectory(synthetic_run.stamps(made.truth["r3"]), lifted(made.truth["r3"]))
    write_tum(folder.path / "recordings" / "r3" / "groundtruth.tum", moved)
    report = finish(folder)
    assert report.ate_joint_m is not None
    assert any("but not together: either" in warning for warning in report.warnings)


def test_truths_that_fit_are_not_doubted(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    assert not [warning for warning in finish(folder).warnings if "truth" in warning]
    assert not {"truth-clock", "truth-frames"} & {finding.cause for finding in diagnose(folder)}


def test_a_robot_that_evo_refuses_costs_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    stub = 'case "$3" in *r2.tum) echo "Degenerate covariance rank" >&2; exit 1;; *) echo "rmse 0.1";; esac'
    program(tmp_path / "bin", stub)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "bin" / "python"))
    text = evaluate(folder.path, with_evo=True)
    assert text.count("rmse 0.1") == 2
    assert "r2: evo_ape refused" in text
    assert "Degenerate covariance rank" in text


def test_a_run_whose_launcher_was_cut_off_is_evaluated_from_its_agents_files(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    whole = finish(folder)
    lines = (folder.path / "events.jsonl").read_text().splitlines()
    (folder.path / "events.jsonl").unlink()
    for robot in ("r1", "r2", "r3"):
        own = [line for line in lines if f'"robot": "{robot}"' in line]
        (folder.path / "robots" / robot / "events.jsonl").write_text("\n".join([*own, '{"t": 9']))
    assert finish(folder) == whole
