"""Errors of robots that died: placed by those that outlived them in their map, whoever else is elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.geometry import pose, so3_exp
from flocc_agent.runtime.robot_result import LostRobot, RobotResult
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.report.build import ate_dead_m
from flocc_launch.runs.run_folder import event_from_line
from flocc_launch.runs.tracks import RobotTrack, tracks_of

Float = NDArray[np.float64]

OFF_M = 0.5
EAST = [5.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]


def way(robot: str, frame: str | None, off_m: float = 0.0, at_m: float = 0.0) -> RobotTrack:
    """An arc, whose estimate in the map is turned as maps are, and beside the truth by `off_m`."""
    T_world: Float = np.array(
        [pose(so3_exp(np.array([0.0, 0.0, a])), np.array([at_m + np.cos(a), np.sin(a), 0.2 * a])) for a in range(5)]
    )
    T_map_world = pose(so3_exp(np.array([0.0, 0.0, 1.0])), np.array([3.0, -2.0, 0.0]))
    T_map = T_map_world @ pose(np.eye(3), np.array([off_m, 0.0, 0.0])) @ T_world
    every = np.full(len(T_world), frame is not None)
    stamps_s = np.arange(len(T_world), dtype=np.float64)
    true, truth = np.ones(len(T_world), dtype=bool), Trajectory(stamps_s, T_world)
    return RobotTrack(robot, 0, frame, stamps_s, T_world, every, T_map, true, T_world, truth)


@pytest.mark.parametrize("elsewhere", ["map/r4", None])
def test_the_survivors_of_its_own_map_place_a_dead_robot_whoever_is_elsewhere(elsewhere: str | None) -> None:
    survivors = {"r1": way("r1", "map/r1"), "r4": way("r4", elsewhere, at_m=100.0)}
    dead = {"r2": way("r2", "map/r1", OFF_M, at_m=2.0)}
    assert ate_dead_m(survivors, survivors | dead) == {"r2": pytest.approx(OFF_M)}


def test_a_dead_robot_that_nobody_outlived_in_its_map_is_aligned_alone() -> None:
    survivors = {"r1": way("r1", "map/r1"), "r4": way("r4", None, at_m=100.0)}
    for frame in ("map/r2", "map/r1"):
        alone = survivors | {"r1": replace(survivors["r1"], map_frame="map/r0")}
        assert ate_dead_m(alone, alone | {"r2": way("r2", frame, OFF_M)}) == {"r2": pytest.approx(0.0, abs=1e-9)}
    assert ate_dead_m(survivors, survivors | {"r2": way("r2", None, OFF_M)}) == {}


def lost(knots: int, round_number: int) -> LostRobot:
    """Where a survivor has r2: moved east, and more so from keyframe 2 on where it knows knots."""
    bent = {"knots": [0, 2], "twists": [[0.0] * 6, [0.0] * 4 + [1.0, 0.0]]} if knots else {}
    said = {"log": "r2", "map_frame": "map/r1", "term": 3, "round": round_number, "T_map_odom": EAST}
    return LostRobot.model_validate({**said, **bent})


@pytest.mark.parametrize("end", ["agent_died", "agent_stopped"])
def test_a_robot_that_died_uncorrected_is_where_survivors_have_it(end: str) -> None:
    """The leader that solved its log knows where each keyframe was, others where the last one was."""
    taken = '"event": "keyframe", "T_odom_body": [0, 0, 0, 1, 0, 0, 0]'
    lines = [f'{{"t": {k}, "robot": "r2", {taken}, "keyframe": "r2/{k}", "stamp_s": {k}}}' for k in range(3)]
    lines.append(f'{{"t": 9, "robot": "r2", "event": "{end}"}}')
    events = [event_from_line(line, "events.jsonl") for line in lines]
    results = {"r1": RobotResult(robot="r1", lost=[lost(2, 4)]), "r3": RobotResult(robot="r3", lost=[lost(0, 5)])}
    track = tracks_of({"r2": None}, results, events)["r2"]
    if end == "agent_stopped":
        assert (track.map_frame, int(track.corrected.sum())) == (None, 0)
    else:
        assert track.map_frame == "map/r1"
        np.testing.assert_allclose(track.T_map_body[:, :3, 3], np.array([[5, 0, 0], [5, 0.5, 0], [5, 1, 0]]), atol=1e-9)
