"""A pose graph as recordings: agents play its odometry and look its closures up."""

from pathlib import Path

import numpy as np
import pytest

from flocc_agent.core.pose_graph import PoseGraph
from flocc_agent.perception.recorded import name_of, read_recorded
from flocc_agent.runtime.recording import Recording
from flocc_lab.bench.generated_graph import generate
from flocc_launch.graph_files.graph_file import GraphFile, GraphFileError
from flocc_launch.graph_files.graph_recording import write_recordings, write_scenario
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.simulate import simulate


def graph_file() -> GraphFile:
    made = generate(np.random.default_rng(4), 2, 25, 30)
    return GraphFile(made.graph, made.truth_m(), T_truth=dict(made.T_world_keyframe))


def test_a_recording_plays_the_odometry_and_its_pictures_name_the_keyframes(tmp_path: Path) -> None:
    file = graph_file()
    made = write_recordings(file, tmp_path, "generated")
    recording = Recording.open(made.robots["r01"])
    assert len(recording.frames) == 25
    names = [name_of(recording.load_image(frame).pixels.tobytes()) for frame in recording.frames]
    assert names == [f"r01/{k}" for k in range(25)]
    (log,) = [log for log in file.graph.trajectories if log.robot == "r01"]
    T_odom = np.asarray(file.graph.trajectories[log].T_odom_keyframe)
    assert np.allclose([frame.T_odom_body for frame in recording.frames], T_odom, atol=1e-6)


def test_every_closure_is_in_the_file_of_registrations_once(tmp_path: Path) -> None:
    file = graph_file()
    twice = PoseGraph(file.graph.trajectories, [*file.graph.closures, file.graph.closures[0]])
    made = write_recordings(GraphFile(twice, T_truth=file.T_truth), tmp_path, "generated")
    names, pairs = read_recorded(made.registrations)
    assert len(names) == 50
    assert len(pairs) == len(file.graph.closures)


def test_the_scenario_beside_the_recordings_runs_and_finds_every_closure(tmp_path: Path) -> None:
    file = graph_file()
    write_recordings(file, tmp_path / "graph", "generated")
    scenario = Scenario.read(write_scenario(file, tmp_path / "graph", 1.0, keeps_scale=False))
    report = simulate(scenario, tmp_path / "run", 1)
    assert report.map_frames == ["map/r00"]
    assert report.closures.accepted == len(file.graph.closures)
    assert report.ate_joint_m is not None


def test_a_graph_without_ground_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(GraphFileError, match="no ground truth of robot r00"):
        write_recordings(GraphFile(graph_file().graph), tmp_path, "generated")
