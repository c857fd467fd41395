"""The rmw_zenoh form against an independent implementation of it: a robot of `zenoh-ros2-sdk` (Apache-2.0, tests only).

It names keys and tokens, hashes types and writes CDR by its own code, from the .msg files of ROS's own packages. Runs
where both are: `.ci/ros2_environment` makes such an environment (build/ros2); elsewhere all of it is skipped.
"""

import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zenoh_ros2_sdk", reason="no zenoh-ros2-sdk here; .ci/ros2_environment brings it")

from tests.agent.runtime.loopback import free_ports, loopback_configs
from tests.agent.runtime.ros2.raw_node import open_router
from zenoh_ros2_sdk import (
    ROS2Publisher,
    ROS2ServiceClient,
    ROS2Subscriber,
    ZenohSession,
    get_message_class,
    get_registry,
)
from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability

from flocc_agent.config import AgentConfig, PerceptionConfig, Ros2Config
from flocc_agent.core.geodesy import Place, T_earth_enu, place_of
from flocc_agent.geometry import Float, pose, so3_exp, tq_from_pose
from flocc_agent.perception.synthetic import pose_image

pytestmark = [pytest.mark.swarm, pytest.mark.slow]

DEFINITIONS = Path(sys.prefix) / "share"
LATCHED = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)
SENSOR = QosProfile(reliability=QosReliability.BEST_EFFORT, history_depth=5)
PERIOD_S, STEP_M = 0.1, 0.2
WITHIN_S = 60.0
HERE = Place(48.1, 11.5, 500.0)
TOPICS = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/r1/flocc/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
LATE = {
    "/r1/flocc/path": "nav_msgs/msg/Path",
    "/r1/flocc/map_frame": "std_msgs/msg/String",
    "/r1/flocc/graph": "visualization_msgs/msg/MarkerArray",
}


def T_odom_body(step: int) -> Float:
    """A square whose sides are eight metres long."""
    side, along = divmod(step * STEP_M, 8.0)
    corner = np.array([[0, 0], [8, 0], [8, 8], [0, 8]], dtype=float)[int(side) % 4]
    heading = np.pi / 2 * (side % 4)
    at = corner + along * np.array([np.cos(heading), np.sin(heading)])
    return pose(so3_exp(np.array([0.0, 0.0, heading])), np.array([*at, 0.0]))


class SdkRobot:
    """Drivers and a listener, all by the SDK."""

    def __init__(self, port: int) -> None:
        get_registry().messages_dir = DEFINITIONS
        self.heard: dict[str, list[Any]] = defaultdict(list)
        self.step = 0
        self._port = port
        self._kept: list[Any] = []
        kinds = {
            "odom": ("nav_msgs/msg/Odometry", QosProfile(history_depth=200)),
            "camera/image_raw": ("sensor_msgs/msg/Image", SENSOR),
            "camera/camera_info": ("sensor_msgs/msg/CameraInfo", SENSOR),
            "gps/fix": ("sensor_msgs/msg/NavSatFix", SENSOR),
        }
        self._to = {name: self._publisher(f"/r1/{name}", kind, qos) for name, (kind, qos) in kinds.items()}
        for topic, kind in TOPICS.items():
            self.listen(topic, kind)

    def _publisher(self, topic: str, kind: str, qos: QosProfile) -> Any:
        made = ROS2Publisher(topic, kind, domain_id=7, router_port=self._port, namespace="/r1", node_name="r", qos=qos)
        self._kept.append(made)
        return made

    def listen(self, topic: str, kind: str, qos: QosProfile | None = None) -> None:
        """Keep what comes on a topic; of a transient local one, ask for what was there before."""
        keep = self.heard[topic].append
        self._kept.append(ROS2Subscriber(topic, kind, keep, domain_id=7, router_port=self._port, qos=qos))

    def drive(self) -> None:
        """One step: image, intrinsics, fix and odometry of one time."""
        T, now_ns = T_odom_body(self.step), time.time_ns()
        x, y, z, q_w, q_x, q_y, q_z = (float(number) for number in tq_from_pose(T))
        image = pose_image(T, f"r1/{self.step}")
        height, width, _ = image.pixels.shape
        c = image.camera
        roi = of("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        K, R = np.array([c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1]), np.eye(3).ravel()
        P = np.array([c.fx, 0, c.cx, 0, 0, c.fy, c.cy, 0, 0, 0, 1, 0])
        eyes = header(now_ns, "optical")
        self._to["camera/camera_info"].publish(
            header=eyes, height=height, width=width, distortion_model="plumb_bob", d=np.zeros(5), k=K, r=R, p=P,
            binning_x=0, binning_y=0, roi=roi,
        )  # fmt: skip
        self._to["camera/image_raw"].publish(
            header=eyes, height=height, width=width, encoding="rgb8", is_bigendian=0, step=3 * width,
            data=image.pixels.ravel(),
        )  # fmt: skip
        place = place_of((T_earth_enu(HERE) @ [x, y, z, 1.0])[:3])
        self._to["gps/fix"].publish(
            header=header(now_ns, "gps"), status=of("sensor_msgs/msg/NavSatStatus")(0, 1), latitude=place.latitude_deg,
            longitude=place.longitude_deg, altitude=place.altitude_m, position_covariance=0.01 * R,
            position_covariance_type=2,
        )  # fmt: skip
        at = of("geometry_msgs/msg/Pose")(
            of("geometry_msgs/msg/Point")(x, y, z), of("geometry_msgs/msg/Quaternion")(q_x, q_y, q_z, q_w)
        )
        none = of("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0)
        self._to["odom"].publish(
            header=header(now_ns, "odom"), child_frame_id="base_link",
            pose=of("geometry_msgs/msg/PoseWithCovariance")(at, np.zeros(36)),
            twist=of("geometry_msgs/msg/TwistWithCovariance")(of("geometry_msgs/msg/Twist")(none, none), np.zeros(36)),
        )  # fmt: skip
        self.step += 1

    def until(self, is_true: Callable[[], bool]) -> None:
        """Drive until something is true."""
        end_s = time.monotonic() + WITHIN_S
        while not is_true():
            assert time.monotonic() < end_s, {topic: len(heard) for topic, heard in self.heard.items()}
            self.drive()
            time.sleep(PERIOD_S)

    def call(self, service: str) -> Any:
        """The answer of a Trigger service; the SDK reads no empty request, which ROS fills with one member anyway."""
        request, answer = "uint8 structure_needs_at_least_one_member\n", "bool success\nstring message\n"
        reached = {"domain_id": 7, "router_port": self._port}
        client = ROS2ServiceClient(service, "std_srvs/srv/Trigger", request, answer, **reached)
        self._kept.append(client)
        return client.call(structure_needs_at_least_one_member=0)

    def close(self) -> None:
        """Close everything."""
        for each in self._kept:
            each.close()
        ZenohSession.get_instance().close()


def of(kind: str) -> Any:
    """The SDK's class of a type."""
    return get_message_class(kind)


def header(t_ns: int, frame: str) -> Any:
    """A header of the SDK."""
    return of("std_msgs/msg/Header")(of("builtin_interfaces/msg/Time")(*divmod(t_ns, 10**9)), frame)


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[SdkRobot]:
    """A router, the SDK's robot, and `flocc agent` by its own zenoh; the agent must end in order."""
    (port,) = free_ports(1)
    with ExitStack() as stack:
        stack.callback(open_router(port).close)
        driving = SdkRobot(port)
        stack.callback(driving.close)
        ros2 = Ros2Config(
            middleware="rmw_zenoh", router=f"tcp/127.0.0.1:{port}", domain_id=7, namespace="/r1", fix_topic="gps/fix",
            camera_mounting=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        )  # fmt: skip
        transport = loopback_configs(("r1",))["r1"]
        synthetic = PerceptionConfig(method="synthetic")
        config = AgentConfig(name="r1", folder=tmp_path / "r1", transport=transport, perception=synthetic, ros2=ros2)
        (tmp_path / "r1.json").write_text(config.model_dump_json())
        command = [sys.executable, "-m", "flocc_launch.commands.main", "agent", "--config", str(tmp_path / "r1.json")]
        with (tmp_path / "r1.log").open("wb") as log:
            agent = subprocess.Popen(command, stderr=log)
            try:
                yield driving
            finally:
                agent.terminate()
                status = agent.wait(20.0)
    assert status == 0, (tmp_path / "r1.log").read_text()


def test_a_robot_of_another_implementation_is_heard_and_hears(robot: SdkRobot, tmp_path: Path) -> None:
    def frames() -> set[tuple[str, str]]:
        told = robot.heard["/tf"][-1].transforms if robot.heard["/tf"] else []
        return {(each.header.frame_id, each.child_frame_id) for each in told}

    robot.until(lambda: frames() == {("map", "odom"), ("earth", "map")})
    told = {each.child_frame_id: each for each in robot.heard["/tf"][-1].transforms}
    t = told["map"].transform.translation
    assert place_of(np.array([t.x, t.y, t.z])) == pytest.approx(HERE, abs=1e-4)
    assert (told["odom"].transform.translation.x, told["odom"].transform.rotation.w) == pytest.approx((0, 1), abs=0.05)

    before = len(robot.heard["/r1/flocc/pose"])
    robot.until(lambda: len(robot.heard["/r1/flocc/pose"]) > before + 5)
    at = robot.heard["/r1/flocc/pose"][-1].pose.pose.position
    there = [T_odom_body(step)[:3, 3] for step in range(max(0, robot.step - 10), robot.step)]
    assert min(np.linalg.norm(np.array([at.x, at.y, at.z]) - each) for each in there) < 0.1

    values = {each.key: each.value for each in robot.heard["/diagnostics"][-1].status[0].values}
    assert values["leader"] == "r1"
    assert int(values["heard: odometry"]) > 20
    assert {key: count for key, count in values.items() if key.startswith("refused: ros2")} == {}

    for topic, kind in LATE.items():
        robot.listen(topic, kind, LATCHED)
    robot.until(lambda: all(robot.heard[topic] for topic in LATE))
    assert robot.heard["/r1/flocc/map_frame"][0].data.startswith("map/r1")
    assert len(robot.heard["/r1/flocc/path"][0].poses) >= 3
    assert {marker.header.frame_id for marker in robot.heard["/r1/flocc/graph"][0].markers} == {"map"}

    saved = robot.call("/r1/flocc_r1/save_map")
    assert saved is not None
    assert (saved.success, saved.message) == (True, str((tmp_path / "r1/result.json").resolve()))
