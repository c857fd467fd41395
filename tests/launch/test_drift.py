"""Odometry that is made fits what carried the camera: a car keeps its heading, and long paths do not end askew."""

from pathlib import Path

import numpy as np
import pytest
from tests.launch.test_dataset_folders import write_kitti, write_sevenscenes

from flocc_agent.geometry import angle_rad, between, pose, so3_exp
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.datasets.commands import needed_drift, split
from flocc_launch.datasets.detect import read_source
from flocc_launch.datasets.drift import DRIFTS, HEADING_END_MAX_RAD, DriftKind, checked_kind, drifted, fitted, kind_of
from flocc_launch.datasets.source import DatasetError
from flocc_launch.report.build import _odometry_made

KINDS: tuple[DriftKind, ...] = ("car", "handheld")


def straight(count: int, step_m: float, step_s: float = 0.1) -> Trajectory:
    poses = np.array([pose(np.eye(3), np.array([k * step_m, 0.0, 0.0])) for k in range(count)])
    return Trajectory(np.arange(float(count)) * step_s, poses)


@pytest.mark.parametrize("kind", DRIFTS)
@pytest.mark.parametrize("length_m", [5.0, 50.0, 2000.0])
def test_no_path_ends_askew(kind: DriftKind, length_m: float) -> None:
    truth = straight(200, length_m / 199)
    spec = fitted(kind, length_m)
    turned_rad = [
        angle_rad(drifted(truth, spec, np.random.default_rng(seed)).T_fixed_body[-1][:3, :3]) for seed in range(20)
    ]
    assert np.sqrt(np.mean(np.square(turned_rad))) < 2 * HEADING_END_MAX_RAD
    if kind == "car" and length_m == 50.0:
        assert max(turned_rad) < 0.05


def test_what_carried_the_camera_is_told_by_data_set_and_motion(tmp_path: Path) -> None:
    assert kind_of("kitti", straight(5, 1.0)) == "car"
    assert kind_of("euroc", straight(5, 1.0)) == "drone"
    assert kind_of("plain", straight(50, 1.5)) == "car"
    turning = [pose(so3_exp(np.array([0, 0, 0.1 * k])), np.array([0.5 * k, 0, 0])) for k in range(50)]
    assert kind_of("plain", Trajectory(np.arange(50.0), np.array(turning))) == "wheeled"
    rng = np.random.default_rng(0)
    shaken = [pose(so3_exp(0.3 * rng.standard_normal(3)), np.array([0.5 * k, 0, 0])) for k in range(50)]
    assert kind_of("plain", Trajectory(np.arange(50.0), np.array(shaken))) == "handheld"


def test_a_named_kind_is_taken_and_told_in_the_recording(tmp_path: Path) -> None:
    source = write_sevenscenes(tmp_path / "s")
    parts = {kind: split(source, tmp_path / kind, 2, kind=kind) for kind in KINDS}
    ends = {kind: Recording.open(paths[0]).frames[-1].T_odom_body for kind, paths in parts.items()}
    assert angle_rad(between(ends["car"], ends["handheld"])[:3, :3]) > 0.01
    made = _odometry_made({"r1": str(parts["car"][0])})
    assert made["r1"].startswith("made of ground truth: scale 0.01, heading 0.0001 rad/m")


def test_a_car_gets_a_cars_odometry(tmp_path: Path) -> None:
    spec = needed_drift(read_source(write_kitti(tmp_path / "05")))
    assert spec == DRIFTS["car"]


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(DatasetError, match="--drift 'boat' is not known; there are handheld, wheeled, car, drone"):
        checked_kind("boat")
