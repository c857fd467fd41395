"""Two robots of plain rclpy nodes over a real ROS 2 (Fast DDS), each with `flocc agent`: one map, every output judged.

Runs where rclpy and tf2_msgs are: `.ci/run` makes such an environment (build/ros2); elsewhere all of it is skipped.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="no ROS 2 here; .ci/ros2_environment makes one", exc_type=ImportError)
pytest.importorskip("tf2_msgs", reason="no tf2_msgs here; .ci/ros2_environment builds it", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticStatus
from tests.agent.runtime.loopback import loopback_configs
from tests.swarm.rclpy_robot import Drivers, Graph, Listener, SimulatedClock, matrix, ns_of

from flocc_agent.config import AgentConfig, PerceptionConfig, Ros2Config
from flocc_agent.geometry import between, is_rigid
from flocc_agent.runtime.recording import Recording
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Scenario

pytestmark = [pytest.mark.swarm, pytest.mark.slow]

NAMES = ("r1", "r2")
RATE = 4.0
START_NS = 1000 * 10**9
TOLERANCE_NS = 100_000_000
TIMEOUT_S = 60.0
ERROR_MAX_M = 0.5


@pytest.fixture
def domain_id(monkeypatch: pytest.MonkeyPatch) -> int:
    """A domain that other tests of this machine do not use, and that stays on it."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    domain_id = 101 + os.getpid() % 100
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id))
    return domain_id


class Team:
    """Robots, clock and listener; time runs when it is told to."""

    def __init__(self, robots: list[Drivers], clock: SimulatedClock, listener: Listener) -> None:
        self.robots, self.clock, self.listener = robots, clock, listener
        self.since_ns = 0

    def until(self, is_true: Callable[[], bool], running: bool = True, timeout_s: float = TIMEOUT_S) -> None:
        """Let time pass, or stand still, until something is true."""
        last_s = began_s = time.monotonic()
        while not is_true():
            time.sleep(0.01)
            now_s = time.monotonic()
            assert now_s - began_s < timeout_s, self.error_m()
            if running:
                self.since_ns += round((now_s - last_s) * RATE * 1e9)
                for robot in self.robots:
                    robot.play(self.since_ns, START_NS)
            self.clock.publish(START_NS + self.since_ns)
            last_s = now_s

    def wait(self, wall_s: float, running: bool = True) -> None:
        """Let time pass, or stand still, for a while."""
        end_s = time.monotonic() + wall_s
        self.until(lambda: time.monotonic() > end_s, running)

    def reset(self) -> None:
        """Begin anew: clock, odometry, recordings."""
        self.since_ns = 0
        for robot in self.robots:
            robot.played = 0
            robot.odometry_ns.clear()

    def error_m(self) -> float:
        """How far the second robot's odometry, as /tf places it beside the first's, is from the truth."""
        told = [self.listener.T_map_odom(name) for name in NAMES]
        frames = {self.listener.map_frame(name) for name in NAMES}
        if told[0] is None or told[1] is None or len(frames) != 1:
            return np.inf
        T_true = between(self.robots[0].T_world_odom(), self.robots[1].T_world_odom())
        return float(np.linalg.norm(between(told[0], told[1])[:3, 3] - T_true[:3, 3]))


@contextmanager
def agent(config: AgentConfig, folder: Path, *ros_args: str) -> Iterator[None]:
    """`flocc agent`; it must end in order, and without a traceback."""
    path = folder / f"{config.name}.json"
    path.write_text(config.model_dump_json())
    command = [sys.executable, "-m", "flocc_launch.commands.main", "agent", "--config", str(path)]
    with (folder / f"{config.name}.log").open("wb") as log:
        process = subprocess.Popen([*command, "--ros-args", *ros_args], stderr=log)
        try:
            yield
        finally:
            process.terminate()
            status = process.wait(20.0)
    said = (folder / f"{config.name}.log").read_text()
    assert status == 0, said
    assert "Traceback" not in said


@pytest.fixture
def team(tmp_path: Path, domain_id: int) -> Iterator[Team]:
    """Two robots of one domain, the first with raw images, the second with compressed ones; an agent for each."""
    tracks = {"robots": 2, "length_m": 30.0, "area_m": 6.0, "seed": 3}
    paths = recordings(Scenario.model_validate({"name": "team", "tracks": tracks}))
    transports = loopback_configs(NAMES)
    with ExitStack() as stack:
        graphs = [Graph(domain_id), Graph(domain_id)]
        for graph in graphs:
            stack.callback(graph.close)
        robots = [Drivers(graphs[0], name, Recording.open(paths[name]), name == "r2") for name in NAMES]
        team = Team(robots, SimulatedClock(graphs[0]), Listener(graphs[1], NAMES))
        for name in NAMES:
            ros2 = Ros2Config(
                namespace=f"/{name}",
                image_topic="camera/image_raw" if name == "r1" else "camera/image_raw/compressed",
                grid_topic="local_map",
                odom_frame=f"{name}/odom",
                base_frame=f"{name}/base_link",
            )
            config = AgentConfig(
                name=name,
                swarm="team",
                folder=tmp_path / name,
                transport=transports[name],
                perception=PerceptionConfig(method="synthetic"),
                ros2=ros2,
            )
            stack.enter_context(agent(config, tmp_path, "-p", "use_sim_time:=true"))
        team.until(lambda: all(robot.has_agent() for robot in robots), running=False)
        yield team


def test_two_robots_get_one_map_through_a_pause_and_a_reset(team: Team, tmp_path: Path) -> None:
    team.until(lambda: team.error_m() < ERROR_MAX_M)
    team.wait(2.0)
    check_transforms_and_poses(team)
    check_paths(team)
    check_markers(team)
    check_diagnostics(team)
    check_merged_map(team)
    check_pause(team)
    check_services_after_a_reset(team, tmp_path)
    for name in NAMES:
        sentences = [event["sentence"] for event in events(tmp_path, name) if event["event"] == "ros2_problem"]
        assert {sentence for sentence in sentences if "time goes backwards" not in sentence} == set()


def check_transforms_and_poses(team: Team) -> None:
    """Each transform is dated ahead of an odometry message; with the pose of that time it says the same."""
    for robot in team.robots:
        told = team.listener.transforms(f"{robot.name}/odom")
        assert {each.header.frame_id for each in told} == {"map"}
        T_map_odom = {ns_of(each.header.stamp) - TOLERANCE_NS: matrix(each.transform) for each in told}
        assert set(T_map_odom) <= set(robot.odometry_ns)
        assert all(is_rigid(T) for T in T_map_odom.values())
        poses = team.listener.heard[f"/{robot.name}/flocc/pose"]
        assert {pose.header.frame_id for pose in poses} == {"map"}
        assert len(poses) > 5
        for pose in poses:
            t_ns = ns_of(pose.header.stamp)
            if t_ns in T_map_odom:
                np.testing.assert_allclose(
                    matrix(pose.pose.pose), T_map_odom[t_ns] @ robot.odometry_ns[t_ns], atol=1e-6
                )
            covariance = np.reshape(pose.pose.covariance, (6, 6))
            np.testing.assert_allclose(covariance, covariance.T)
            assert np.linalg.eigvalsh(covariance).min() > -1e-9


def check_paths(team: Team) -> None:
    """A path holds keyframes at the times of their images, where the robot truly was."""
    for robot in team.robots:
        path = team.listener.heard[f"/{robot.name}/flocc/path"][-1]
        stamps_ns = [ns_of(each.header.stamp) for each in path.poses]
        assert path.header.frame_id == "map"
        assert {each.header.frame_id for each in path.poses} == {"map"}
        assert len(stamps_ns) > 5
        assert np.all(np.diff(stamps_ns) > 0)
        assert ns_of(path.header.stamp) == stamps_ns[-1]
        assert all(min(abs(t_ns - image_ns) for image_ns in robot.images_ns) < 1000 for t_ns in stamps_ns)
        first_s = robot.recording.frames[0].stamp_s
        truths = [robot.recording.ground_truth(first_s + (t_ns - START_NS) * 1e-9) for t_ns in stamps_ns]
        T_first = matrix(path.poses[0].pose)
        for T_true, told in zip(truths, path.poses, strict=True):
            assert T_true is not None
            assert truths[0] is not None
            expected = T_first @ between(truths[0], T_true)
            assert np.linalg.norm(expected[:3, 3] - matrix(told.pose)[:3, 3]) < 1.0


def check_markers(team: Team) -> None:
    """Each agent draws both robots in the one frame, and closures between keyframes that it draws."""
    for name in NAMES:
        team.until(partial(has_drawn, team, name))
        told = team.listener.markers(name)
        assert {marker.header.frame_id for marker in told.values()} == {"map"}
        drawn = {robot: told[f"path/{robot}", 0].points for robot in NAMES}
        points = np.array([[p.x, p.y, p.z] for robot in NAMES for p in drawn[robot]])
        ends = np.array([[p.x, p.y, p.z] for p in told["closures", 0].points])
        assert len(ends) >= 2
        assert np.linalg.norm(ends[:, None] - points[None], axis=2).min(axis=1).max() < 1e-3
        assert len(told["closures", 0].colors) == len(ends)
        texts = {marker.text for marker in told.values() if marker.text}
        assert {text.split(" ")[0] for text in texts} == set(NAMES)
        assert sum("(leads)" in text for text in texts) == 1


def has_drawn(team: Team, name: str) -> bool:
    """Whether an agent's last markers are of both robots' ways and of closures; on a busy machine they come later."""
    told = team.listener.markers(name) if team.listener.heard[f"/{name}/flocc/graph"] else {}
    drawn = [told.get((f"path/{robot}", 0)) for robot in NAMES]
    return ("closures", 0) in told and all(marker is not None and len(marker.points) > 5 for marker in drawn)


def check_diagnostics(team: Team) -> None:
    """Each robot says once a second how it is, by simulated time, and what it has heard."""
    for robot in team.robots:
        one, values = team.listener.status(robot.name)
        held = "held until another one agrees" in one.message  # a lone closure that a chance match gave
        assert held or one.level == DiagnosticStatus.OK, one.message
        assert one.name == f"flocc: {robot.name}"
        assert held or ("leads" in one.message) == (values["leader"] == robot.name)
        assert values["map frame"] == team.listener.map_frame(robot.name)
        assert values["neighbours"] == ({*NAMES} - {robot.name}).pop()
        assert int(values["heard: image"]) > 5
        assert {key: count for key, count in values.items() if "refused: ros2" in key} == {}
    stamps_ns = [ns_of(array.header.stamp) for array in team.listener.heard["/diagnostics"]]
    assert all(0 <= t_ns - START_NS <= team.since_ns + 1e9 for t_ns in stamps_ns if t_ns)


def check_merged_map(team: Team) -> None:
    """Each agent merges both robots' grids, where /tf puts them; a grid in another frame is refused, and said."""
    marks = {"r1": ((4.55, 0.55), 100), "r2": ((4.5, -1.5), 77)}  # centres of cells
    team.robots[0].publish_grid("r1/odom", {marks["r1"][0]: 100})
    team.robots[1].publish_grid("r2/odom", {marks["r2"][0]: 77}, resolution_m=0.2)

    def is_there(by: str, name: str) -> bool:
        """The mark, or a cell beside it: /tf and the map may be of two corrections that differ by millimetres."""
        T = team.listener.T_map_odom(name)
        if T is None:
            return False
        place = (T @ np.array([*marks[name][0], 0.0, 1.0]))[:3]
        around = [place + 0.1 * np.array([x, y, 0.0]) for x in (-1, 0, 1) for y in (-1, 0, 1)]
        return marks[name][1] in [team.listener.merged_at(by, each) for each in around]

    for by in NAMES:
        for name in NAMES:
            team.until(partial(is_there, by, name))
        assert team.listener.heard[f"/{by}/flocc_{by}/merged_map"][-1].header.frame_id == "map"


def check_pause(team: Team) -> None:
    """While simulated time stands still, no transform comes; afterwards they come again."""
    team.wait(0.5, running=False)
    before = len(team.listener.heard["/tf"])
    team.wait(1.5, running=False)
    assert len(team.listener.heard["/tf"]) == before
    team.until(lambda: len(team.listener.heard["/tf"]) > before + 2)


def check_services_after_a_reset(team: Team, folder: Path) -> None:
    """Where clock and odometry begin anew, the agent says so; told by its service, it begins another journey."""
    first_frame = team.listener.map_frame("r1")
    for name in NAMES:
        saved = team.listener.call(f"/{name}/flocc_{name}/save_map")
        assert saved.success
        assert saved.message == str((folder / name / "result.json").resolve())
        assert len(json.loads(Path(saved.message).read_text())["keyframes"]) > 5
    team.reset()
    team.wait(1.0)
    for name in NAMES:
        team.until(partial(has_said, folder, name, "time goes backwards"))
        assert team.listener.call(f"/{name}/flocc_{name}/reset_odometry").success
    team.reset()
    team.listener.heard["/tf"].clear()
    team.until(lambda: all(robot.has_agent() for robot in team.robots), running=False)
    team.until(lambda: team.error_m() < ERROR_MAX_M)
    assert team.listener.map_frame("r1") == team.listener.map_frame("r2")
    for name in NAMES:
        assert [e["event"] for e in events(folder, name)].count("journey_ended") == 1
    assert first_frame is not None


def has_said(folder: Path, name: str, words: str) -> bool:
    """Whether an agent complained of something."""
    return any(words in event.get("sentence", "") for event in events(folder, name))


def events(folder: Path, name: str) -> list[dict[str, Any]]:
    """Events of an agent."""
    return [json.loads(line) for line in (folder / name / "events.jsonl").read_text().splitlines()]
