"""Odometry that cannot be is refused where it comes in: at the call, or as a row of a file."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flocc_agent.geometry import Float, pose, so3_exp
from flocc_agent.runtime.pose_limits import POSITION_MAX_M, PoseGate, breaks, possible, spikes
from flocc_agent.runtime.text_tables import RecordingError
from flocc_agent.runtime.trajectory_text import read_trajectory


def at_m(x: float) -> Float:
    return pose(np.eye(3), np.array([x, 0.0, 0.0]))


def stretched() -> Float:
    T = at_m(1.0)
    T[0, 0] = 1.1
    return T


REFUSED: dict[str, tuple[Callable[[], object], float, str]] = {
    "far": (lambda: at_m(1e12), 2.0, "over 10000 km"),
    "just too far": (lambda: at_m(np.nextafter(POSITION_MAX_M, np.inf)), 2.0, "over 10000 km"),
    "fast": (lambda: at_m(1001.0), 2.0, "faster than 1000 m/s"),
    "nan": (lambda: at_m(np.nan), 2.0, "finite and rigid"),
    "not rigid": (stretched, 2.0, "finite and rigid"),
    "3 by 4": (lambda: at_m(1.0)[:3], 2.0, "shape (3, 4)"),
    "list of words": (lambda: ["a"], 2.0, "no array of numbers"),
    "same stamp": (lambda: at_m(0.0), 1.0, "not newer"),
    "older": (lambda: at_m(0.0), 0.5, "not newer"),
    "no stamp": (lambda: at_m(0.0), np.nan, "stamp"),
    "stamp too large for a record": (lambda: at_m(0.0), 1e30, "stamp"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_pose_that_cannot_be_has_a_fault_and_the_next_has_none(name: str) -> None:
    make, stamp_s, said = REFUSED[name]
    gate = PoseGate()
    gate.let_in(at_m(0.0), 1.0, kept=True)
    fault = gate.fault(make(), stamp_s)  # type: ignore[arg-type]
    assert fault is not None
    assert said in fault
    assert gate.fault(at_m(1.0), 2.0) is None


def test_a_frame_that_became_no_keyframe_may_be_given_once_more() -> None:
    gate = PoseGate()
    gate.let_in(at_m(0.0), 1.0, kept=False)
    assert gate.fault(at_m(0.0), 1.0) is None


def line(stamp_s: float, T: Float) -> str:
    x, y, z = T[:3, 3]
    return f"{stamp_s} {x} {y} {z} 0 0 0 1\n"


@pytest.mark.parametrize(("bad", "note"), [(1e12, "were left out"), (9e6, "out of reach"), (-5e4, "out of reach")])
@pytest.mark.parametrize("places", [(0,), (3, 9), (19,), (7, 8)])
def test_rows_that_cannot_be_are_left_out_and_counted(
    tmp_path: Path, bad: float, note: str, places: tuple[int, ...]
) -> None:
    xs = [bad if k in places else 0.5 * k for k in range(20)]
    (tmp_path / "odometry.tum").write_text("".join(line(0.1 * k, at_m(x)) for k, x in enumerate(xs)))
    trajectory, notes = read_trajectory(tmp_path / "odometry.tum")
    assert trajectory.T_fixed_body[:, 0, 3].tolist() == [0.5 * k for k in range(20) if k not in places]
    assert any(note in each and f"{len(places)} of 20" in each for each in notes), notes


@pytest.mark.parametrize("places", [(9,), (9, 10), (5, 6, 17)])
def test_poses_that_a_lost_program_wrote_at_the_origin_are_left_out(tmp_path: Path, places: tuple[int, ...]) -> None:
    """A robot that stands at its origin at first, or comes back to it in its own steps, keeps those poses."""
    xs = [0.0, 0.0, *(0.5 * k for k in range(1, 19)), *(9.0 - 0.5 * k for k in range(1, 19))]
    wrong = [0.0 if k in places else x for k, x in enumerate(xs)]
    (tmp_path / "odometry.tum").write_text("".join(line(0.1 * k, at_m(x)) for k, x in enumerate(wrong)))
    trajectory, notes = read_trajectory(tmp_path / "odometry.tum")
    assert trajectory.T_fixed_body[:, 0, 3].tolist() == [x for k, x in enumerate(xs) if k not in places]
    assert any(f"{len(places)} of 38 poses are exactly at the origin and not turned" in note for note in notes)


def test_a_robot_that_is_back_at_its_origin_is_not_lost(tmp_path: Path) -> None:
    xs = [0.0, *(0.5 * k for k in range(1, 10)), *(4.5 - 0.5 * k for k in range(1, 10)), *(0.5 * k for k in range(9))]
    (tmp_path / "odometry.tum").write_text("".join(line(0.1 * k, at_m(x)) for k, x in enumerate(xs)))
    trajectory, notes = read_trajectory(tmp_path / "odometry.tum")
    assert len(trajectory) == len(xs)
    assert not any("left out" in note for note in notes)


def test_a_trajectory_faster_than_any_robot_is_refused_with_a_question(tmp_path: Path) -> None:
    (tmp_path / "odometry.tum").write_text("".join(line(0.1 * k, at_m(1e3 * k)) for k in range(20)))
    with pytest.raises(RecordingError, match="in metres"):
        read_trajectory(tmp_path / "odometry.tum")


def test_a_jump_of_the_origin_is_let_in_once_a_robot_could_have_gone_there() -> None:
    stamps_s = np.linspace(0.0, 9.9, 100)
    positions_m = np.zeros((100, 3))
    positions_m[60:, 0] = 2000.0
    good = possible(stamps_s, positions_m)
    assert np.flatnonzero(~good).tolist() == list(range(60, 79))


def test_rotations_alone_are_never_too_fast() -> None:
    gate = PoseGate()
    gate.let_in(at_m(5.0), 1.0, kept=True)
    assert gate.fault(pose(so3_exp(np.array([0.0, 0.0, 3.0])), np.array([5.0, 0.0, 0.0])), 1.0 + 1e-6) is None


@pytest.mark.parametrize("step_s", [0.05, 1.0, 10.0])
@pytest.mark.parametrize("form", ["tum", "kitti"])
def test_a_single_pose_that_jumps_away_is_left_out_and_counted(tmp_path: Path, step_s: float, form: str) -> None:
    """Of any stamps: at one pose in ten seconds, 5 km are within the speed that a robot may have."""
    poses = [at_m(0.1 * k + (5000.0 if k == 30 else 0.0)) for k in range(60)]
    stamps_s = [1.7e9 + step_s * k for k in range(60)]
    path = tmp_path / "odometry.txt"
    if form == "tum":
        path.write_text("".join(line(s, T) for s, T in zip(stamps_s, poses, strict=True)))
    else:
        np.savetxt(path, np.array(poses)[:, :3].reshape(60, 12))
    trajectory, notes = read_trajectory(path, stamps_s=stamps_s)
    assert len(trajectory) == 59
    assert float(np.abs(trajectory.T_fixed_body[:, 0, 3]).max()) < 10.0
    assert len(notes) == 1
    assert notes[0].startswith(f"{path}:31: 1 of 60 poses ")


def drawn_walk(rng: np.random.Generator) -> Float:
    """Positions of somebody who walks, stands, turns round and is carried; of any rate."""
    steps = rng.normal(0, rng.choice([0.01, 0.3, 5.0]), (rng.integers(20, 200), 3))
    steps[rng.random(len(steps)) < rng.choice([0.0, 0.7])] = 0.0
    return np.cumsum(steps, axis=0)


@pytest.mark.parametrize("seed", range(20))
def test_walks_have_no_spike_and_one_that_is_put_in_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    walk = drawn_walk(rng)
    assert not spikes(walk).any()
    k = int(rng.integers(1, len(walk) - 1))
    walk[k] += 5000.0
    assert np.flatnonzero(spikes(walk)).tolist() == [k]


def test_a_ride_that_goes_on_elsewhere_has_no_spike() -> None:
    ferry = np.concatenate([np.arange(20.0), 5000.0 + np.arange(20.0)])[:, None] * [1.0, 0.0, 0.0]
    assert not spikes(ferry).any()
    assert not spikes(np.array([[0.0, 0, 0], [5000.0, 0, 0], [0.0, 0, 0]])).any()


def drawn_ride(rng: np.random.Generator) -> tuple[Float, Float]:
    """Stamps and poses of somebody who speeds up, stands and turns smoothly, at any rate, with jitter and gaps."""
    count, step_s = int(rng.integers(30, 300)), float(np.exp(rng.uniform(np.log(0.005), np.log(1.0))))
    dt_s = step_s * rng.uniform(0.5, 1.5, count)
    dt_s[rng.random(count) < 0.02] *= 20.0
    stamps_s = np.cumsum(dt_s)
    phase = 2 * np.pi * stamps_s / rng.uniform(20.0, 60.0)
    speed_m_s = rng.choice([0.5, 3.0, 25.0]) * np.clip(np.sin(phase) + 0.3, 0.0, None)
    positions = np.cumsum(speed_m_s * dt_s)[:, None] * [1.0, 0.2, 0.0] + rng.normal(0, 0.005, (count, 3))
    turns = np.cumsum(0.6 * np.sin(phase) * dt_s)
    return stamps_s, np.array(
        [pose(so3_exp(np.array([0.0, 0.0, turn])), x) for turn, x in zip(turns, positions, strict=True)]
    )


@pytest.mark.parametrize("seed", range(40))
def test_rides_have_no_break_and_one_that_is_put_in_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps_s, T = drawn_ride(rng)
    assert not breaks(stamps_s, T).any()
    k = int(rng.integers(5, len(T) - 5))
    stamps_s[k:] += stamps_s[k - 1] + min(0.1, stamps_s[k] - stamps_s[k - 1]) - stamps_s[k]
    moved = np.array(T)
    if seed % 2:
        moved[k:, :3, 3] += [500.0, 0.0, 0.0]
    else:
        moved[k:] = moved[k:] @ pose(so3_exp(np.array([0.0, 0.0, 3.0])), np.zeros(3))
    assert np.flatnonzero(breaks(stamps_s, moved)).tolist() == [k]


def test_a_jump_that_goes_on_is_said_with_its_row(tmp_path: Path) -> None:
    rows = [f"{100 + 0.1 * k:.1f} {0.1 * k + 50 * (k >= 6):.2f} 0 0 0 0 0 1" for k in range(12)]
    (tmp_path / "odometry.tum").write_text("\n".join(rows) + "\n")
    trajectory, notes = read_trajectory(tmp_path / "odometry.tum")
    assert len(trajectory) == 12
    (note,) = notes
    assert "odometry.tum:7: the pose jumps and goes on from there; where this is odometry, it began anew there" in note
