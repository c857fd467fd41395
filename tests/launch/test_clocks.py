"""The clocks of pictures and odometry are told apart by turns that both show."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.doc_props import write_own_data

from flocc_agent.geometry import pose, so3_exp
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.clocks import fit_clocks
from flocc_launch.datasets.commands import clock, convert
from flocc_launch.datasets.source import DatasetError, Source
from flocc_launch.datasets.truth_clock import offset_s, truth_faults, turning_stretch

Float = NDArray[np.float64]


def turning(seconds: float, seed: int = 0) -> Trajectory:
    """A body whose turning rate wanders, at 50 Hz."""
    rng = np.random.default_rng(seed)
    rates = np.cumsum(rng.normal(0, 0.05, int(seconds * 50)))
    angles = np.cumsum(0.5 * np.sin(rates) / 50)
    poses = [
        pose(so3_exp(np.array([0.0, 0.0, angle])), np.array([0.01 * k, 0.0, 0.0])) for k, angle in enumerate(angles)
    ]
    return Trajectory(np.arange(len(poses)) / 50.0, np.array(poses))


def seen(trajectory: Trajectory, stamps_s: Float, seed: int = 1) -> Float:
    """Turns between pictures, with noise and some that were not seen."""
    rng = np.random.default_rng(seed)
    yaw = np.unwrap([np.arctan2(T[1, 0], T[0, 0]) for T in trajectory.T_fixed_body])
    cumulated = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(yaw)))])
    at = np.interp(stamps_s, trajectory.stamps_s, cumulated)
    turns = np.diff(at) + rng.normal(0, 0.002, len(stamps_s) - 1)
    turns[rng.random(len(turns)) < 0.1] = np.nan
    return np.asarray(turns)


@pytest.mark.parametrize("offset_s", [-1.6e9, -3.3, 0.0, 12.5])
def test_the_offset_is_found_whatever_it_is(offset_s: float) -> None:
    own = turning(60.0)
    stamps_s = np.arange(5.0, 55.0, 0.2)
    fit = fit_clocks(stamps_s + offset_s, seen(own, stamps_s), own)
    assert fit is not None
    assert fit.offset_s == pytest.approx(offset_s, abs=0.03)
    assert fit.drift_ratio is None


def test_a_drift_is_found() -> None:
    own = turning(200.0)
    stamps_s = np.arange(5.0, 190.0, 0.2)
    fit = fit_clocks(stamps_s * 1.002, seen(own, stamps_s), own)
    assert fit is not None
    assert fit.drift_ratio == pytest.approx(0.002, rel=0.3)


@pytest.mark.parametrize("late_s", [-3.0, -0.4, 0.0, 0.1, 0.5, 2.0])
def test_a_trajectory_that_is_late_is_told_by_the_stretch_in_which_it_turns_most(late_s: float) -> None:
    own = turning(60.0)
    stamps_s = np.arange(5.0, 55.0, 0.2)
    stretch = turning_stretch(stamps_s, own)
    assert stretch is not None
    assert stretch.stop - stretch.start == 60
    turns_rad = seen(own, stamps_s)[stretch.start : stretch.stop - 1]
    late = Trajectory(own.stamps_s + late_s, own.T_fixed_body)
    told = offset_s(stamps_s[stretch], turns_rad, late)
    assert told == (None if abs(late_s) < 0.2 else pytest.approx(-late_s, abs=0.04))


@pytest.mark.parametrize("late_s", [0.0, 1.5])
def test_ground_truth_of_another_clock_is_told_before_anything_is_measured_against_it(late_s: float) -> None:
    own = turning(60.0)
    bent = own.T_fixed_body @ pose(so3_exp(np.array([0.02, 0.0, 0.1])), np.array([0.5, 0.0, 0.0]))
    truth = Trajectory(own.stamps_s + late_s, bent)
    source = Source(Path("field"), "plain", tuple((k / 5, Path(f"{k}.jpg")) for k in range(300)), None, own, truth)
    sentence = "field: the ground truth turns 1.50 s too late for the odometry: one of them is of another clock"
    assert [told.startswith(sentence) for told in truth_faults(source, own)] == ([True] if late_s else [])


def test_an_even_turn_does_not_tell() -> None:
    poses = np.array([pose(so3_exp(np.array([0.0, 0.0, 0.01 * k])), np.zeros(3)) for k in range(500)])
    own = Trajectory(np.arange(500) / 50.0, poses)
    assert fit_clocks(np.arange(1.0, 9.0, 0.2), np.full(39, 0.1), own) is None


def test_an_offset_that_is_given_brings_pictures_and_odometry_together(tmp_path: Path) -> None:
    own = write_own_data(tmp_path / "own")
    truth, _ = read_trajectory(own / "groundtruth.txt")
    lines = (own / "groundtruth.txt").read_text().splitlines()
    moved = [f"{float(line.split()[0]) - 1.6e9:.6f} {line.split(' ', 1)[1]}" for line in lines[1:]]
    (own / "groundtruth.txt").write_text("\n".join([lines[0], *moved]))
    with pytest.raises(DatasetError, match="both must be of one clock: flocc dataset clock measures"):
        convert(own, tmp_path / "out")
    recording = Recording.open(convert(own, tmp_path / "out", time_offset_s=1.6e9))
    assert len(recording.frames) == len(truth)


def test_pictures_that_hardly_turn_do_not_tell(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="turns too little or too evenly"):
        clock(write_own_data(tmp_path / "own"))
