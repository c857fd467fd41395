"""ATE and RPE, held against evo."""

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.geometry import inverse, se3_exp
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_launch.runs import trajectory_errors as evaluation

Float = NDArray[np.float64]


def random_walk(seed: int, length: int = 60) -> Float:
    rng = np.random.default_rng(seed)
    poses = [se3_exp(rng.normal(0, 1, 6))]
    for _ in range(length - 1):
        poses.append(poses[-1] @ se3_exp(np.array([0, 0, 0, 0.5, 0, 0]) + rng.normal(0, 0.1, 6)))
    return np.array(poses)


def disturbed(poses: Float, seed: int, sigma: float = 0.2) -> Float:
    rng = np.random.default_rng(seed)
    return np.array([T @ se3_exp(rng.normal(0, sigma, 6)) for T in poses])


def evo_rmse(estimate: Float, truth: Float) -> float:
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory = pytest.importorskip("evo.core.trajectory")
    true_path = trajectory.PosePath3D(poses_se3=list(truth))
    path = trajectory.PosePath3D(poses_se3=list(estimate))
    path.align(true_path, correct_scale=False)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((true_path, path))
    return float(ape.get_statistic(metrics.StatisticsType.rmse))


@pytest.mark.parametrize("seed", range(5))
def test_joint_ate_agrees_with_evo_to_1e_9(seed: int) -> None:
    truths = [random_walk(10 * seed + k, 40 + k) for k in range(3)]
    T_map_world = se3_exp(np.array([0.3, -2.0, 1.1, 5.0, -7.0, 3.0]))
    estimates = [T_map_world @ disturbed(truth, seed) for truth in truths]
    ours = evaluation.ate_m(estimates, truths)
    assert ours == pytest.approx(evo_rmse(np.concatenate(estimates), np.concatenate(truths)), abs=1e-9)
    assert ours is not None
    assert ours > 0.1


@pytest.mark.parametrize("delta", [1, 3])
def test_rpe_agrees_with_evo_to_1e_9(delta: int) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory = pytest.importorskip("evo.core.trajectory")
    truth = random_walk(1)
    estimate = disturbed(truth, 2)
    ours = evaluation.relative_pose_error(estimate, truth, delta)
    assert ours is not None
    paths = (trajectory.PosePath3D(poses_se3=list(truth)), trajectory.PosePath3D(poses_se3=list(estimate)))
    for relation, value in (
        (metrics.PoseRelation.translation_part, ours.translation_rmse_m),
        (metrics.PoseRelation.rotation_angle_deg, ours.rotation_rmse_deg),
    ):
        rpe = metrics.RPE(relation, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=False)
        rpe.process_data(paths)
        assert value == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)


def test_one_alignment_for_all_robots_sees_an_error_between_them() -> None:
    truths = [random_walk(1), random_walk(2)]
    moved = se3_exp(np.array([0, 0, 0, 3.0, 0, 0])) @ truths[1]
    joint = evaluation.ate_m([truths[0], moved], truths)
    assert joint is not None
    assert joint > 0.5
    assert evaluation.ate_m([moved], [truths[1]]) == pytest.approx(0, abs=1e-9)


def test_odometry_placed_at_its_true_start_begins_without_error() -> None:
    truth = random_walk(3)
    T_odom_world = se3_exp(np.array([1.0, 0.2, -0.4, 9.0, 8.0, 7.0]))
    placed = evaluation.placed_at_true_start(T_odom_world @ disturbed(truth, 4), truth)
    np.testing.assert_allclose(placed[0], truth[0], atol=1e-12)
    undisturbed = evaluation.placed_at_true_start(T_odom_world @ truth, truth)
    assert evaluation.unaligned_ate_m([undisturbed], [truth]) == pytest.approx(0, abs=1e-9)


def test_ate_without_ground_truth_is_unknown() -> None:
    empty = np.zeros((0, 4, 4))
    assert evaluation.ate_m([empty], [empty]) is None
    assert evaluation.unaligned_ate_m([empty], [empty]) is None
    assert evaluation.relative_pose_error(empty, empty) is None


def test_ground_truth_is_brought_to_the_keyframes_stamps() -> None:
    truth = np.array([se3_exp(np.array([0.0, 0.0, 0.0, k, 0.0, 0.0])) for k in range(4)])
    trajectory = Trajectory(np.linspace(0.0, 0.3, 4), truth)
    known, poses = evaluation.associate(np.array([-1.0, 0.05, 0.1, 0.27, 9.0]), trajectory)
    assert known.tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(poses[:, 0, 3], [0.5, 1.0, 2.7], atol=1e-12)


def test_evo_opens_our_tum_files(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    poses = random_walk(6)
    write_tum(tmp_path / "r1.tum", Trajectory(np.arange(60.0), poses))
    read = file_interface.read_tum_trajectory_file(tmp_path / "r1.tum")
    np.testing.assert_allclose(np.array(read.poses_se3), poses, atol=1e-9)


def program(folder: Path, text: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "evo_ape"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def test_evo_is_found_beside_this_python_before_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(program(tmp_path / "path", "true").parent))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "bin" / "python"))
    assert evaluation.evo_program() == str(tmp_path / "path" / "evo_ape")
    beside = program(tmp_path / "bin", "true")
    assert evaluation.evo_program() == str(beside)


def test_evo_that_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    with pytest.raises(evaluation.EvaluationError, match=r"\.\[eval\]"):
        evaluation.evo_program()


def test_inverse_places_the_first_pose_at_the_origin() -> None:
    truth = random_walk(7)
    np.testing.assert_allclose((inverse(truth[0]) @ truth)[0], np.eye(4), atol=1e-12)
