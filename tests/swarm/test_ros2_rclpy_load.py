"""Two robots of 640x480 at 10 Hz over a real ROS 2: nothing is dropped, and how long a pose takes.

The limit on that time is for a machine that does much else; what it takes on a quiet one is printed."""

import os
import statistics
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="no ROS 2 here; .ci/ros2_environment makes one", exc_type=ImportError)
pytest.importorskip("tf2_msgs", reason="no tf2_msgs here; .ci/ros2_environment builds it", exc_type=ImportError)

from contextlib import ExitStack
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from tests.agent.runtime.loopback import loopback_configs
from tests.swarm.rclpy_robot import Graph, ns_of, stamp_of
from tests.swarm.test_ros2_rclpy import agent, events

from flocc_agent.config import AgentConfig, Ros2Config

pytestmark = [pytest.mark.swarm, pytest.mark.slow]

NAMES = ("r1", "r2")
HEIGHT, WIDTH = 480, 640
IMAGE_PERIOD_S, ODOMETRY_PERIOD_S = 0.1, 0.02
SECONDS = 20.0
MOUNTING = (0.1, 0.0, 0.5, -0.5, 0.5, -0.5, 0.5)
QUIET_S = 6.0
LATENCY_MEDIAN_MAX_S = 1.5


class Camera:
    """A robot that drives along a textured wall at 1 m/s, on the wall clock."""

    def __init__(self, graph: Graph, name: str) -> None:
        self.name = name
        self.images = self.odometries = 0
        node = graph.node("driver", f"/{name}")
        self._image = node.create_publisher(Image, "camera/image_raw", QoSProfile(depth=20))
        self._info = node.create_publisher(CameraInfo, "camera/camera_info", QoSProfile(depth=20))
        self._odometry = node.create_publisher(Odometry, "odom", QoSProfile(depth=200))
        blocks = np.random.default_rng(hash(name) % 100).integers(0, 256, (HEIGHT // 16, 300, 3)).astype(np.uint8)
        self._wall = np.kron(blocks, np.ones((16, 16, 1), np.uint8))
        self._running = threading.Event()
        self._thread = threading.Thread(target=self._drive, daemon=True)
        self._thread.start()

    def ready(self) -> bool:
        """Whether the agent listens."""
        return bool(self._image.get_subscription_count() and self._odometry.get_subscription_count())

    def run(self, seconds: float) -> None:
        """Drive for a while."""
        self._running.set()
        time.sleep(seconds)
        self._running.clear()

    def _drive(self) -> None:
        """Publish at the camera's and the odometry's rate while the robot runs; late ones are not made up for."""
        due_s = time.monotonic()
        while self._running.wait():
            due_s = max(due_s + ODOMETRY_PERIOD_S, time.monotonic())
            self._step(self.odometries * ODOMETRY_PERIOD_S)
            self.odometries += 1
            time.sleep(max(0.0, due_s - time.monotonic()))

    def _step(self, t_s: float) -> None:
        stamp = stamp_of(time.time_ns())
        if self.odometries % round(IMAGE_PERIOD_S / ODOMETRY_PERIOD_S) == 0:
            left = int(80 * t_s) % (self._wall.shape[1] - WIDTH)
            pixels = np.ascontiguousarray(self._wall[:, left : left + WIDTH])
            image = Image(height=HEIGHT, width=WIDTH, encoding="bgr8", step=3 * WIDTH, data=pixels.tobytes())
            info = CameraInfo(height=HEIGHT, width=WIDTH, distortion_model="plumb_bob")
            info.k, info.d = np.array([400.0, 0, 320, 0, 400, 240, 0, 0, 1]), [0.0] * 5
            for message, publisher in ((info, self._info), (image, self._image)):
                message.header.stamp, message.header.frame_id = stamp, "optical"
                publisher.publish(message)
            self.images += 1
        odometry = Odometry(child_frame_id="base_link")
        odometry.header.stamp, odometry.header.frame_id = stamp, f"{self.name}/odom"
        odometry.pose.pose.position.x = t_s
        odometry.pose.pose.orientation.w = 1.0
        self._odometry.publish(odometry)


@pytest.fixture
def domain_id(monkeypatch: pytest.MonkeyPatch) -> int:
    """A domain that other tests of this machine do not use, and that stays on it."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id := 101 + (os.getpid() + 50) % 100))
    return domain_id


class Ears:
    """What the listener counts: when each pose came after its odometry, and the last diagnostics."""

    def __init__(self, graph: Graph) -> None:
        self.latencies_s: list[float] = []
        self.values: dict[str, dict[str, str]] = {}
        node = graph.node("listener")
        for name in NAMES:
            node.create_subscription(PoseWithCovarianceStamped, f"/{name}/flocc/pose", self._pose, 10)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._status, 10)

    def _pose(self, pose: Any) -> None:
        self.latencies_s.append((time.time_ns() - ns_of(pose.header.stamp)) * 1e-9)

    def _status(self, array: Any) -> None:
        for one in array.status:
            self.values[one.hardware_id] = {value.key: value.value for value in one.values}


@pytest.fixture
def team(domain_id: int, tmp_path: Path) -> Iterator[tuple[list[Camera], Ears]]:
    """Two cameras and their agents, with reliable images and the classical front end."""
    transports = loopback_configs(NAMES)
    with ExitStack() as stack:
        graphs = [Graph(domain_id), Graph(domain_id)]
        for graph in graphs:
            stack.callback(graph.close)
        cameras = [Camera(graphs[0], name) for name in NAMES]
        ears = Ears(graphs[1])
        for name in NAMES:
            ros2 = Ros2Config(
                namespace=f"/{name}", odom_frame=f"{name}/odom", base_frame="base_link", camera_mounting=MOUNTING
            )
            config = AgentConfig(name=name, swarm="load", folder=tmp_path / name, transport=transports[name], ros2=ros2)
            topics = [f"/{name}/camera/{topic}" for topic in ("image_raw", "camera_info")]
            policies = ("reliability:=reliable", "depth:=20")
            reliable = [f"qos_overrides.{topic}.subscription.{policy}" for topic in topics for policy in policies]
            stack.enter_context(agent(config, tmp_path, *(word for each in reliable for word in ("-p", each))))
        end_s = time.monotonic() + 30.0
        while not all(camera.ready() for camera in cameras) and time.monotonic() < end_s:
            time.sleep(0.05)
        yield cameras, ears


def drive(cameras: list[Camera], ears: Ears, seconds: float) -> dict[str, tuple[int, int]]:
    """Let all robots drive, wait until nothing more comes, and give (images, odometry) heard so far by robot."""
    drivers = [threading.Thread(target=camera.run, args=(seconds,)) for camera in cameras]
    for driver in drivers:
        driver.start()
    for driver in drivers:
        driver.join()
    last, since_s, end_s = heard(ears), time.monotonic(), time.monotonic() + 40.0
    while time.monotonic() - since_s < QUIET_S and time.monotonic() < end_s:
        time.sleep(0.1)
        if heard(ears) != last:
            last, since_s = heard(ears), time.monotonic()
    return last


def heard(ears: Ears) -> dict[str, tuple[int, int]]:
    """Messages that the agents say they heard."""
    told = {name: ears.values.get(name, {}) for name in NAMES}
    return {name: (int(v.get("heard: image", 0)), int(v.get("heard: odometry", 0))) for name, v in told.items()}


def refused(ears: Ears, name: str) -> dict[str, str]:
    """What an agent left out of its ROS's messages, by reason."""
    return {key: count for key, count in ears.values[name].items() if key.startswith("refused: ros2")}


def test_nothing_is_dropped_at_ten_images_a_second(team: tuple[list[Camera], Ears], tmp_path: Path) -> None:
    """Counted after a first drive: what a publisher sends before its subscriber is found is lost to volatile topics."""
    cameras, ears = team
    before = drive(cameras, ears, 5.0)
    sent_before = {camera.name: (camera.images, camera.odometries) for camera in cameras}
    dropped_before = {name: refused(ears, name) for name in NAMES}
    ears.latencies_s.clear()
    after = drive(cameras, ears, SECONDS)
    for camera in cameras:
        name, values = camera.name, ears.values[camera.name]
        sent = camera.images - sent_before[name][0], camera.odometries - sent_before[name][1]
        came = after[name][0] - before[name][0], after[name][1] - before[name][1]
        sys.stdout.write(f"{name}: sent {sent}, heard {came} (images, odometry), {values['keyframes']} keyframes\n")
        assert came == sent
        assert refused(ears, name) == dropped_before[name]
        assert int(values["keyframes"]) >= 5
        assert [event["sentence"] for event in events(tmp_path, name) if event["event"] == "ros2_problem"] == []
    latencies_s = ears.latencies_s
    assert latencies_s, "no correction has come within the drive"
    median_s, worst_s = statistics.median(latencies_s), np.quantile(latencies_s, 0.99)
    sys.stdout.write(f"stamp to pose: median {median_s:.3f} s, 99 % {worst_s:.3f} s of {len(latencies_s)} poses\n")
    assert median_s < LATENCY_MEDIAN_MAX_S
