"""A bag that rclpy publishers play as `ros2 bag play --clock` does, at 1x and 5x: flocc keeps up, or says what is lost.

The bag is written and read by rosbags; its payloads are published as they were recorded, with `/clock` beside them.
"""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="no ROS 2 here; .ci/ros2_environment makes one", exc_type=ImportError)
pytest.importorskip("tf2_msgs", reason="no tf2_msgs here; .ci/ros2_environment builds it", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CameraInfo, Image
from tests.agent.runtime.loopback import loopback_configs
from tests.swarm.rclpy_robot import Graph, SimulatedClock, ns_of, stamp_of
from tests.swarm.test_ros2_rclpy import agent, events
from tests.swarm.test_ros2_rclpy_load import HEIGHT, MOUNTING, WIDTH, domain_id

from flocc_agent.config import AgentConfig, KeyframeConfig, Ros2Config

__all__ = ["domain_id"]
pytestmark = [pytest.mark.swarm, pytest.mark.slow]

START_NS = 1000 * 10**9
SECONDS = 12
KEYFRAMES = 2 * SECONDS
IMAGE_PERIOD_NS, ODOMETRY_PERIOD_NS, CLOCK_PERIOD_NS = 100_000_000, 20_000_000, 25_000_000
SETTLE_S = 4.0
UNKNOWN_MAX = 20
"""Best effort: what was lost behind the last that came, which nobody tells, or not by the middleware's word."""
CAMERA_TOPICS = ("/camera/camera_info", "/camera/image_raw")
TOPICS = {
    "/odom": "nav_msgs/msg/Odometry",
    "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
    "/camera/image_raw": "sensor_msgs/msg/Image",
}


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot that drives along a textured wall at 1 m/s: 640x480 at 10 Hz, odometry at 50 Hz, simulated time."""
    path = tmp_path_factory.mktemp("bag") / "wall"
    blocks = np.random.default_rng(5).integers(0, 256, (HEIGHT // 16, 300, 3)).astype(np.uint8)
    wall = np.kron(blocks, np.ones((16, 16, 1), np.uint8))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        types = get_typestore(Stores.ROS2_KILTED)
        to = {name: writer.add_connection(name, kind, typestore=types) for name, kind in TOPICS.items()}
        for t_ns in range(0, SECONDS * 10**9, ODOMETRY_PERIOD_NS):
            at_ns = START_NS + t_ns
            if t_ns % IMAGE_PERIOD_NS == 0:
                info, image = picture(wall, t_ns)
                writer.write(to["/camera/camera_info"], at_ns, serialize_message(info))
                writer.write(to["/camera/image_raw"], at_ns, serialize_message(image))
            odometry = Odometry(child_frame_id="base_link")
            odometry.header.stamp, odometry.header.frame_id = stamp_of(at_ns), "odom"
            odometry.pose.pose.position.x, odometry.pose.pose.orientation.w = t_ns * 1e-9, 1.0
            writer.write(to["/odom"], at_ns, serialize_message(odometry))
    return path


def picture(wall: "np.ndarray[Any, np.dtype[np.uint8]]", t_ns: int) -> tuple[CameraInfo, Image]:
    """What the camera sees, with its intrinsics."""
    left = int(80e-9 * t_ns) % (wall.shape[1] - WIDTH)
    pixels = np.ascontiguousarray(wall[:, left : left + WIDTH])
    info = CameraInfo(height=HEIGHT, width=WIDTH, distortion_model="plumb_bob")
    info.k, info.d = np.array([400.0, 0, 320, 0, 400, 240, 0, 0, 1]), [0.0] * 5
    image = Image(height=HEIGHT, width=WIDTH, encoding="bgr8", step=3 * WIDTH, data=pixels.tobytes())
    for message in (info, image):
        message.header.stamp, message.header.frame_id = stamp_of(START_NS + t_ns), "optical"
    return info, image


class Player:
    """Publishes a bag's messages when they are due, and the time."""

    def __init__(self, graph: Graph, path: Path, reliable: bool) -> None:
        self.sent = dict.fromkeys(TOPICS, 0)
        self.reliable = reliable
        node = graph.node("player")
        self._path = path
        self._clock = SimulatedClock(graph)
        camera = QoSProfile(depth=50) if reliable else qos_profile_sensor_data
        qos = {name: camera if name in CAMERA_TOPICS else QoSProfile(depth=200) for name in TOPICS}
        self._to = {name: node.create_publisher(kind_of(kind), name, qos[name]) for name, kind in TOPICS.items()}

    def is_heard(self) -> bool:
        """Whether the agent listens to everything."""
        return all(publisher.get_subscription_count() for publisher in self._to.values())

    def play(self, rate: float) -> None:
        """From its beginning to its end."""
        clock_ns = START_NS
        with AnyReader([self._path]) as reader:
            began_s = time.monotonic()
            for connection, at_ns, payload in reader.messages():
                while clock_ns <= at_ns:
                    self._wait(began_s, clock_ns, rate)
                    self._clock.publish(clock_ns)
                    clock_ns += CLOCK_PERIOD_NS
                self._wait(began_s, at_ns, rate)
                self._to[connection.topic].publish(payload)
                self.sent[connection.topic] += 1

    def _wait(self, began_s: float, at_ns: int, rate: float) -> None:
        time.sleep(max(0.0, began_s + (at_ns - START_NS) * 1e-9 / rate - time.monotonic()))


def kind_of(name: str) -> Any:
    """rclpy's class of a type."""
    package, folder, kind = name.split("/")
    return getattr(import_module(f"{package}.{folder}"), kind)


class Monitor:
    """What the agent's diagnostics said last."""

    def __init__(self, graph: Graph) -> None:
        self.values: dict[str, str] = {}
        self.stamp_ns = 0
        graph.node("monitor").create_subscription(DiagnosticArray, "/diagnostics", self._hear, 10)

    def _hear(self, array: Any) -> None:
        self.stamp_ns = ns_of(array.header.stamp)
        for one in array.status:
            self.values = {value.key: value.value for value in one.values}

    def count(self, key: str) -> int:
        """One of its values; 0 where it is not told."""
        return int(self.values.get(key, 0))

    def settle(self) -> None:
        """Wait until nothing more comes."""
        last, since_s, end_s = dict[str, str](), time.monotonic(), time.monotonic() + 60.0
        while time.monotonic() - since_s < SETTLE_S and time.monotonic() < end_s:
            time.sleep(0.2)
            told = {
                key: value for key, value in self.values.items() if key.startswith(("heard", "keyframes", "refused"))
            }
            if told != last:
                last, since_s = told, time.monotonic()


@pytest.fixture
def playing(
    bag: Path, domain_id: int, tmp_path: Path, request: pytest.FixtureRequest
) -> Iterator[tuple[Player, Monitor]]:
    """A player, and an agent of simulated time with the classical front end; images best effort, or as asked."""
    reliable = request.param == "reliable"
    policies = ("reliability:=reliable", "depth:=50") if reliable else ()
    asked = [f"qos_overrides.{topic}.subscription.{policy}" for topic in CAMERA_TOPICS for policy in policies]
    with ExitStack() as stack:
        graphs = [Graph(domain_id), Graph(domain_id)]
        for graph in graphs:
            stack.callback(graph.close)
        player, monitor = Player(graphs[0], bag, reliable), Monitor(graphs[1])
        config = AgentConfig(
            name="r1",
            swarm="bag",
            folder=tmp_path / "r1",
            transport=loopback_configs(("r1",))["r1"],
            keyframes=KeyframeConfig(distance_m=0.5),
            ros2=Ros2Config(camera_mounting=MOUNTING),
        )
        overrides = [word for each in asked for word in ("-p", each)]
        stack.enter_context(agent(config, tmp_path, "-p", "use_sim_time:=true", *overrides))
        end_s = time.monotonic() + 30.0
        while not (player.is_heard() and monitor.values) and time.monotonic() < end_s:
            time.sleep(0.05)
        time.sleep(1.0)
        yield player, monitor


@pytest.mark.parametrize(
    ("playing", "rate"), [("reliable", 1.0), ("reliable", 5.0), ("best_effort", 5.0)], indirect=["playing"]
)
def test_a_bag_is_taken_in_or_what_is_lost_is_said(
    playing: tuple[Player, Monitor], rate: float, tmp_path: Path
) -> None:
    player, monitor = playing
    began_s = time.monotonic()
    player.play(rate)
    played_s = time.monotonic() - began_s
    monitor.settle()
    heard = {kind: monitor.count(f"heard: {kind}") for kind in ("image", "odometry")}
    refused = {key: int(count) for key, count in monitor.values.items() if key.startswith("refused: ros2")}
    lost = {kind: refused.get(f"refused: ros2 {kind} lost before this node", 0) for kind in heard}
    keyframes = monitor.count("keyframes")
    sys.stdout.write(
        f"{rate:g}x, {'reliable' if player.reliable else 'best effort'}, in {played_s:.1f} s: sent {player.sent}, "
        f"heard {json.dumps(heard)}, {keyframes} keyframes, refused {json.dumps(refused)}\n"
    )
    for kind, topic in (("image", "/camera/image_raw"), ("odometry", "/odom")):
        unknown = player.sent[topic] - heard[kind] - lost[kind]
        assert 0 <= unknown <= (0 if player.reliable or kind == "odometry" else UNKNOWN_MAX), "each is taken or counted"
    sentences = [event["sentence"] for event in events(tmp_path, "r1") if event["event"] == "ros2_problem"]
    assert sum(refused.values()) < 15 or any("lost before" in s or "come faster" in s for s in sentences)
    assert keyframes == KEYFRAMES or sum(refused.values()) > 0, "keyframes are missing, and nothing says why"
    if player.reliable and rate == 1.0:
        assert (sum(refused.values()), keyframes) == (0, KEYFRAMES)
    assert START_NS < monitor.stamp_ns <= START_NS + SECONDS * 10**9, "time is the bag's"
