"""What a program is told of poses is what the report shows: its own body's, and where the others were."""

from pathlib import Path

import numpy as np

from flocc_agent.core.corrected import Correction, Corrector
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import inverse
from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_launch.report.finish import finish
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.simulate import playbacks_of, run, swarm_of, write
from flocc_launch.simulation.swarm import Swarm

WIRE_M = 1e-5
"""The report's trajectories have seven decimals, corrections float32."""

SCENARIO = Scenario.model_validate(
    {
        "name": "poses",
        "tracks": {"robots": 3, "seed": 4, "area_m": 16.0, "length_m": 30.0},
        "keyframes": {"distance_m": 1.0},
        "perception": {"method": "synthetic", "synthetic": {"outlier_probability": 0.0, "alias_probability": 0.0}},
        "simulation": {"optimiser": "quick"},
    }
)


def _core(swarm: Swarm, name: str) -> Robot:
    core = swarm.stations[name].core
    assert core is not None
    return core


def told(swarm: Swarm, name: str) -> Correction:
    """What the robot's program would be told at the end."""
    core = _core(swarm, name)
    assert core.corrections.applied is not None
    T_body_camera = swarm.stations[name].playback.T_body_camera
    return Corrector(core).correction(core.corrections.applied, False, T_body_camera)


def test_poses_of_keyframes_and_times_are_those_of_the_reports_trajectories(tmp_path: Path) -> None:
    swarm = swarm_of(SCENARIO, playbacks_of(SCENARIO, {}), 1)
    folder = RunFolder.create(tmp_path / "run")
    swarm.agenda.at(5.0, lambda: _core(swarm, "r2").corrections.follow_all())
    write(folder, swarm, 1, run(swarm))
    assert finish(folder).map_frames == ["map/r1"]
    shown = {name: read_tum(tmp_path / "run/trajectories" / f"{name}.tum") for name in swarm.stations}
    for name, trajectory in shown.items():
        correction = told(swarm, name)
        assert len(correction.own) == len(trajectory.stamps_s) > 8
        assert_follows(correction, trajectory, [c.stamp_s for c in swarm.stations[name].playback.captures])
        assert correction.others.keys() == shown.keys() - {name}
        for other, log in correction.others.items():
            T_camera_body = inverse(swarm.stations[other].playback.T_body_camera)
            poses = log.poses() @ T_camera_body
            assert np.abs(poses[-1] - shown[other].T_fixed_body[-1]).max() < WIRE_M
            if name in ("r1", "r2"):
                assert np.abs(poses - shown[other].T_fixed_body).max() < WIRE_M


def assert_follows(correction: Correction, shown: Trajectory, stamps_s: list[float]) -> None:
    """Every keyframe by number and by time; half-way between two the pose is between theirs."""
    for k, (stamp_s, T) in enumerate(zip(stamps_s, shown.T_fixed_body, strict=True)):
        for pose in (correction.pose_of(k), correction.pose_at(stamp_s)):
            assert pose is not None
            assert np.abs(pose - T).max() < WIRE_M
    middle = correction.pose_at(float(np.mean(stamps_s[:2])))
    assert middle is not None
    assert np.abs(middle[:3, 3] - shown.T_fixed_body[:2, :3, 3].mean(axis=0)).max() < 0.5
