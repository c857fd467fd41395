"""Pictures are held against the trajectory: an order of quaternions that they contradict is refused."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flocc_agent.geometry import pose, q_wxyz_from_R, so3_exp
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.datasets.commands import convert
from flocc_launch.datasets.detect import read_source
from flocc_launch.datasets.picture_check import APART_MAX, PAIRS_MAX, TURN_MAX_RAD, chosen_pairs, reordered, seen_faults
from flocc_launch.datasets.source import DatasetError, Source

SHARED = Path(os.environ.get("FLOCC_SHARED", Path(__file__).parents[3] / "shared"))
STREET = SHARED / "data" / "street" / "r1"
needs_street = pytest.mark.skipif(not STREET.is_dir(), reason=f"{STREET} is not there")


def street(images: int = 40) -> Source:
    source = read_source(STREET)
    return replace(source, images=source.images[:images])


def with_header(tmp_path: Path, header: str, order: list[int]) -> Path:
    """The street's first robot with a trajectory whose header says an order, and whose numbers stand in one."""
    path = tmp_path / "robot"
    path.mkdir()
    for name in ("images", "intrinsics.yaml"):
        (path / name).symlink_to(STREET / name)
    odometry = read_source(STREET).odometry
    assert odometry is not None
    rows = [header]
    for stamp_s, T in zip(odometry.stamps_s, odometry.T_fixed_body, strict=True):
        q = q_wxyz_from_R(T[:3, :3])[order]
        rows.append(" ".join(f"{value:.9f}" for value in (stamp_s, *T[:3, 3], *q)))
    (path / "odometry.txt").write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.data
@needs_street
def test_pictures_contradict_a_header_that_says_another_order(tmp_path: Path) -> None:
    path = with_header(tmp_path, "# timestamp tx ty tz qx qy qz qw", [0, 1, 2, 3])
    said = r"read as x y z w, but the pictures turn as they do read as w x y z .*format tum-wxyz reads them so"
    with pytest.raises(DatasetError, match=said):
        convert(path, tmp_path / "out")


@pytest.mark.data
@needs_street
@pytest.mark.parametrize("places", [0, 1, -1])
def test_the_order_that_pictures_show_is_told_from_both_others(places: int) -> None:
    source = street()
    assert source.odometry is not None
    poses = np.array([reordered(T, places) for T in source.odometry.T_fixed_body]) if places else None
    read = source.odometry if poses is None else Trajectory(source.odometry.stamps_s, poses)
    if not places:
        assert seen_faults(source, read) == ()
        return
    with pytest.raises(DatasetError, match=f"read as {'w x y z' if places < 0 else 'x y z w'}, but"):
        seen_faults(source, read)
    (told,) = seen_faults(source, read, is_settled=True)
    assert told.endswith("was named, and is taken")


@pytest.mark.data
@needs_street
def test_a_forgotten_mounting_is_told(tmp_path: Path) -> None:
    source = street()
    assert source.lens is not None
    assert source.odometry is not None
    turned = source.lens.T_body_camera @ pose(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    (told,) = seen_faults(replace(source, lens=replace(source.lens, T_body_camera=turned)), source.odometry)
    assert "degrees against T_body_camera; the axes seem to be another convention" in told


def test_pairs_turn_enough_to_be_seen_and_not_too_much() -> None:
    stamps_s = np.linspace(0.0, 19.9, 200)
    poses = [pose(so3_exp(np.array([0.0, 0.0, 0.01 * k])), np.zeros(3)) for k in range(200)]
    images = [(float(stamp_s), Path(f"{k}.png")) for k, stamp_s in enumerate(stamps_s)]
    chosen = chosen_pairs(images, Trajectory(stamps_s, np.array(poses)))
    steps = [round(10 * (now[0] - before[0])) for before, now in chosen]
    assert len(chosen) == PAIRS_MAX
    assert set(steps) == {6}
    still = Trajectory(stamps_s, np.tile(np.eye(4), (200, 1, 1)))
    assert chosen_pairs(images, still) == []
    assert 0.01 * APART_MAX > TURN_MAX_RAD


@pytest.mark.data
@needs_street
@pytest.mark.parametrize(("later_s", "told"), [(0.0, None), (0.5, "turns about 0.5 s later than the pictures do")])
def test_a_trajectory_of_another_clock_is_told(later_s: float, told: str | None) -> None:
    source = read_source(STREET)
    assert source.odometry is not None
    faults = seen_faults(source, source.odometry.later(later_s))
    assert (len(faults) == 0) if told is None else (told in faults[0] and "flocc dataset clock" in faults[0])
