"""Claim: poses that consumers get are within 1 cm and 0.1 degrees of their leader's solution, at every keyframe.

Also over relays, with odometry in UTM coordinates, and on recorded pose graphs.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flocc_agent.backend import build_optimiser
from flocc_agent.config import BackendConfig
from flocc_agent.core.corrected import CorrectedLog, RecordedOdometry
from flocc_agent.core.knots import ROTATION_BOUND_RAD, TRANSLATION_BOUND_M, Track, knots_of, strays
from flocc_agent.core.pose_graph import GraphSolution
from flocc_agent.geometry import Float, angle_rad, between, pose
from flocc_launch.graph_files.jrl import read_jrl
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.simulate import playbacks_of, run, swarm_of
from flocc_launch.simulation.swarm import Swarm
from flocc_launch.simulation.virtual_playback import Playback
from flocc_protocol.ids import Term
from flocc_protocol.messages import LogCorrection

UTM = pose(np.eye(3), np.array([691_000.0, 5_334_000.0, 520.0]))
DATA = Path(__file__).parents[3] / "shared" / "data" / "cosmo_bench"


def scenario(**changes: Any) -> Scenario:
    fields: dict[str, Any] = {
        "name": "knots",
        "tracks": {"robots": 4, "seed": 4, "area_m": 20.0, "length_m": 40.0},
        "keyframes": {"distance_m": 1.0},
        "perception": {"method": "synthetic", "synthetic": {"outlier_probability": 0.0, "alias_probability": 0.0}},
    }
    return Scenario.model_validate({**fields, **changes})


def moved(playback: Playback, T: Float) -> Playback:
    """The same robot, whose odometry starts elsewhere."""
    captures = tuple(replace(capture, T_odom_body=T @ capture.T_odom_body) for capture in playback.captures)
    return replace(playback, captures=captures)


def ran(given: Scenario, T: Float | None = None) -> Swarm:
    playbacks = playbacks_of(given, {})
    if T is not None:
        playbacks = {name: moved(playback, T) for name, playback in playbacks.items()}
    swarm = swarm_of(given, playbacks, 1)
    run(swarm)
    return swarm


def worst(swarm: Swarm) -> tuple[int, float, float]:
    """Keyframes that were compared, and the largest differences of what consumers have from the leaders' solutions."""
    count, shift_m, turn_rad = 0, 0.0, 0.0
    for station in swarm.running():
        assert station.core is not None
        applied = station.core.corrections.applied
        assert applied is not None, station.name
        solution = swarm.stations[applied.term.leader.robot].solution
        assert solution is not None
        solved = {log: c.T_map_keyframe[log] for c in solution.components for log in c.logs}
        shown = CorrectedLog(applied, RecordedOdometry(station.core.gossip.logs[station.log])).poses()
        for T_shown, T_solved in zip(shown, solved[station.log], strict=False):
            count += 1
            shift_m = max(shift_m, float(np.linalg.norm(T_shown[:3, 3] - T_solved[:3, 3])))
            turn_rad = max(turn_rad, angle_rad(between(T_shown, T_solved)[:3, :3]))
    return count, shift_m, turn_rad


def assert_within_bounds(swarm: Swarm, keyframes: int) -> None:
    count, shift_m, turn_rad = worst(swarm)
    assert count >= keyframes
    assert shift_m <= TRANSLATION_BOUND_M
    assert turn_rad <= ROTATION_BOUND_RAD


def test_consumers_see_the_leaders_solution_in_utm_coordinates() -> None:
    assert_within_bounds(ran(scenario(), UTM), 150)


def test_over_relays_as_well() -> None:
    """Near the origin; range is short and messages are lost: knots of some robots pass others."""
    swarm = ran(scenario(radio={"range_m": 12.0, "loss_ratio": 0.1}, duration_s=100.0))
    relayed = sum(traffic.received["want-knots"] for traffic in swarm.network.traffic.values())
    assert relayed > 0
    assert_within_bounds(swarm, 150)


@pytest.mark.skipif(not DATA.exists(), reason="the pose graphs of cosmo_bench are not here")
def test_knots_say_the_solution_of_a_recorded_pose_graph() -> None:
    graph = read_jrl(DATA / "wifi" / "kth_r3_00_d06_d09_d10_wifi.jrl").graph
    solution = build_optimiser(BackendConfig())(graph, None)
    assert isinstance(solution, GraphSolution)
    keyframes = knots = 0
    for component in solution.components:
        for log in component.logs:
            odometry = graph.trajectories[log].T_odom_keyframe
            track = Track(odometry, component.T_map_keyframe[log], component.T_map_odom[log], None)
            T_map_odom, told = knots_of(track)
            correction = LogCorrection(log, Term(1, log), 1, log, T_map_odom, told)
            assert strays(correction, track) <= 1.0
            keyframes, knots = keyframes + len(odometry), knots + len(told)
    assert knots < keyframes
