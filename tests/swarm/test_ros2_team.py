"""Two ROS 2 robots of two domains, each beside `flocc agent`: what their /tf says puts both into one map."""

import asyncio
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from tests.agent.runtime.loopback import free_ports, loopback_configs
from tests.agent.runtime.ros2 import cdr_by_hand
from tests.agent.runtime.ros2.cdr_by_hand import Stamped
from tests.agent.runtime.ros2.raw_node import RawNode, open_router

from flocc_agent.config import AgentConfig, PerceptionConfig, Ros2Config, TransportConfig
from flocc_agent.geometry import Float, between, inverse, pose_from_tq, tq_from_pose
from flocc_agent.runtime.recording import Frame, Recording
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Scenario

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]

NAMES = ("r1", "r2")
RATE = 4.0
EPOCH_NS = 1_700_000_000 * 10**9
TIMEOUT_S = 60.0
STANDING_PERIOD_S = 0.1
ERROR_MAX_M = 0.5
IMAGE, INFO, ODOMETRY = "/camera/image_raw", "/camera/camera_info", "/odom"


class Robot:
    """A robot's drivers, which play a recording; `/tf` as it came."""

    def __init__(self, node: RawNode, recording: Recording) -> None:
        self.node = node
        self.recording = recording
        self.played = 0
        self._placed_s = 0.0
        node.advertise(ODOMETRY, "nav_msgs/msg/Odometry")
        node.advertise(IMAGE, "sensor_msgs/msg/Image")
        node.advertise(INFO, "sensor_msgs/msg/CameraInfo")
        node.subscribe("/tf", "tf2_msgs/msg/TFMessage")
        node.subscribe("/flocc/map_frame", "std_msgs/msg/String", latched=True)

    def play(self, elapsed_s: float) -> None:
        """Publish the frames that are due; a robot whose recording is over stands, and its odometry goes on."""
        frames = self.recording.frames
        while self.played < len(frames) and frames[self.played].stamp_s - frames[0].stamp_s <= elapsed_s * RATE:
            self._publish(frames[self.played])
            self.played += 1
            self._placed_s = elapsed_s
        if self.played == len(frames) and elapsed_s > self._placed_s + STANDING_PERIOD_S:
            self._placed_s = elapsed_s
            self._place(frames[-1].T_odom_body, frames[0].stamp_s + elapsed_s * RATE)

    def _publish(self, frame: Frame) -> None:
        stamp = divmod(EPOCH_NS + round(frame.stamp_s * 1e9), 10**9)
        image = self.recording.load_image(frame)
        (height, width, _), c = image.pixels.shape, image.camera
        K, P = (c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1), (c.fx, 0, c.cx, 0, 0, c.fy, c.cy, 0, 0, 0, 1, 0)
        size = (height, width)
        self.node.publish(INFO, cdr_by_hand.camera_info(stamp, "optical", size, K, [0.0] * 5, P))
        payload = cdr_by_hand.image(stamp, "optical", size, "rgb8", image.pixels.tobytes(), 3 * width)
        self.node.publish(IMAGE, payload)
        self._place(frame.T_odom_body, frame.stamp_s)

    def _place(self, T_odom_body: Float, stamp_s: float) -> None:
        stamp = divmod(EPOCH_NS + round(stamp_s * 1e9), 10**9)
        position, quaternion = position_and_quaternion(T_odom_body)
        self.node.publish(ODOMETRY, cdr_by_hand.odometry(Stamped(stamp, "odom", "base_link", position, quaternion)))

    def T_map_odom(self) -> Float | None:
        """What `/tf` said last."""
        if not self.node.received["/tf"]:
            return None
        (told,) = cdr_by_hand.read_transforms(self.node.received["/tf"][-1].payload)
        x, y, z, w = told.quaternion
        return pose_from_tq(np.array([*told.position, w, x, y, z]))

    def map_frame(self) -> str | None:
        """The swarm's name of its map, as it came last."""
        told = self.node.received["/flocc/map_frame"]
        return cdr_by_hand.read_text(told[-1].payload) if told else None

    def T_world_odom(self) -> Float:
        """Where its odometry truly begins."""
        first = self.recording.frames[0]
        truth = self.recording.ground_truth(first.stamp_s)
        assert truth is not None
        return truth @ inverse(first.T_odom_body)


def position_and_quaternion(T: Float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Translation, and quaternion as x y z w."""
    x, y, z, q_w, q_x, q_y, q_z = tq_from_pose(T).tolist()
    return (x, y, z), (q_x, q_y, q_z, q_w)


@contextmanager
def agent(transport: TransportConfig, name: str, ros2: Ros2Config, folder: Path) -> Iterator[None]:
    """`flocc agent` on a configuration; it must end in order."""
    synthetic = PerceptionConfig(method="synthetic")
    config = AgentConfig(name=name, swarm="team", transport=transport, perception=synthetic, ros2=ros2)
    path = folder / f"{name}.json"
    path.write_text(config.model_dump_json())
    command = [sys.executable, "-m", "flocc_launch.commands.main", "agent", "--config", str(path)]
    with (folder / f"{name}.log").open("wb") as log:
        process = subprocess.Popen(command, stderr=log)
        try:
            yield
        finally:
            process.terminate()
            status = process.wait(20.0)
    assert status == 0, (folder / f"{name}.log").read_text()


def error_m(first: Robot, second: Robot) -> float:
    """How far the second robot's odometry, as /tf places it beside the first's, is from the truth."""
    told = first.T_map_odom(), second.T_map_odom()
    if told[0] is None or told[1] is None or first.map_frame() != second.map_frame():
        return np.inf
    T_true = between(first.T_world_odom(), second.T_world_odom())
    return float(np.linalg.norm(between(told[0], told[1])[:3, 3] - T_true[:3, 3]))


async def test_two_ros_2_robots_of_two_domains_get_one_map(tmp_path: Path) -> None:
    tracks = {"robots": 2, "length_m": 30.0, "area_m": 6.0, "seed": 3}
    paths = recordings(Scenario.model_validate({"name": "team", "tracks": tracks})).values()
    transports, robots = loopback_configs(NAMES), []
    with ExitStack() as stack:
        for domain_id, (name, path, port) in enumerate(zip(NAMES, paths, free_ports(2), strict=True)):
            stack.callback(open_router(port).close)
            robot = Robot(stack.enter_context(RawNode(port, domain_id)), Recording.open(path))
            robots.append(robot)
            position, quaternion = position_and_quaternion(robot.recording.T_body_camera)
            x, y, z, *q = (*position, *quaternion)
            mounting = (x, y, z, q[0], q[1], q[2], q[3])
            ros2 = Ros2Config(router=f"tcp/127.0.0.1:{port}", domain_id=domain_id, camera_mounting=mounting)
            stack.enter_context(agent(transports[name], name, ros2, tmp_path))
        began_s: float | None = None
        async with asyncio.timeout(TIMEOUT_S):
            while error_m(*robots) > ERROR_MAX_M:
                await asyncio.sleep(0.02)
                if began_s is None and all(has_agent(robot) for robot in robots):
                    began_s = time.monotonic()
                if began_s is not None:
                    for robot in robots:
                        robot.play(time.monotonic() - began_s)
        assert robots[0].map_frame() == robots[1].map_frame()
        T_second = robots[1].T_map_odom()
        assert T_second is not None
        assert np.linalg.norm(T_second[:3, 3]) > 1.0, "the second robot starts elsewhere"


def has_agent(robot: Robot) -> bool:
    """Whether the agent's subscriptions are known to the robot's node."""
    return any("/MS/" in token and "%odom/" in token for token in robot.node.tokens)
