"""The node by rclpy against plain rclpy nodes: messages as CDR both ways, hashes, parameters, lifecycle, misfits."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="no ROS 2 here; .ci/ros2_environment makes one", exc_type=ImportError)
pytest.importorskip("tf2_msgs", reason="no tf2_msgs here; .ci/ros2_environment builds it", exc_type=ImportError)

from importlib import import_module

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image, NavSatFix
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tests.agent.runtime.ros2.test_ros2_markers import corrected_log
from tests.swarm.rclpy_robot import Graph

from flocc_agent.config import ConfigError, Ros2Config
from flocc_agent.geometry import pose, so3_exp
from flocc_agent.runtime.ros2 import types
from flocc_agent.runtime.ros2.diagnostics import diagnostics
from flocc_agent.runtime.ros2.markers import KnownClosure, Markers
from flocc_agent.runtime.ros2.node import RosNode, open_node
from flocc_agent.runtime.ros2.outgoing import Outgoing
from flocc_agent.runtime.ros2.topics import Offer, Qos
from flocc_agent.runtime.ros2.types import MessageTypes, Ros2Error
from flocc_agent.runtime.status import AgentStatus
from flocc_protocol.ids import KeyframeId, LogId

pytestmark = [pytest.mark.swarm]

TYPES = MessageTypes()
T = pose(so3_exp(np.array([0.1, -0.2, 0.7])), np.array([3.0, -2.0, 0.1]))
NAMES = sorted(value for name, value in vars(types).items() if name.isupper() and "/msg/" in str(value))


@pytest.fixture(autouse=True)
def domain_id(monkeypatch: pytest.MonkeyPatch) -> int:
    """A domain that other tests of this machine do not use, and that stays on it."""
    domain_id = 1 + os.getpid() % 100
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id))
    return domain_id


@pytest.fixture
def graph(domain_id: int) -> Iterator[Graph]:
    """Plain rclpy nodes."""
    graph = Graph(domain_id)
    yield graph
    graph.close()


@contextmanager
def opened(*ros_args: str, **options: Any) -> Iterator[RosNode]:
    """flocc's node."""
    node = open_node(Ros2Config(**{"namespace": "/r1", **options}), "flocc_r1", ros_args, TYPES)
    try:
        yield node
    finally:
        node.close()


def until(is_true: Callable[[], object], timeout_s: float = 10.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not is_true():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def class_of(type_name: str) -> Any:
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def assert_same(ours: Any, ros: Any, where: str = "") -> None:
    """A message of rosbags says the same as one of rclpy, field by field."""
    if is_dataclass(ours):
        names = [field.name for field in fields(ours) if field.name != "__msgtype__" and not field.name.isupper()]
        assert names == list(ros.get_fields_and_field_types()), where
        for name in names:
            assert_same(getattr(ours, name), getattr(ros, name), f"{where}.{name}")
    elif isinstance(ros, bytes):
        assert ours == ros[0], where
    elif isinstance(ours, float):
        assert ours == ros or np.float32(ours) == np.float32(ros), where
    elif isinstance(ours, str | bool | int):
        assert ours == ros, where
    elif len(ours) and is_dataclass(ours[0]):
        assert len(ours) == len(ros), where
        for k, (a, b) in enumerate(zip(ours, ros, strict=True)):
            assert_same(a, b, f"{where}[{k}]")
    else:
        np.testing.assert_array_equal(np.asarray(ours), np.asarray(ros), err_msg=where)


STATUS = AgentStatus(robot="r1", leader="r2", term=3, map_frame="map/r2", keyframes=9, refused={"ros2 x": 2})


def markers() -> Any:
    """A map of two robots with a closure."""
    logs = {robot: corrected_log(robot, 5) for robot in ("r1", "r2")}
    closure = KnownClosure(KeyframeId(LogId("r1"), 1), KeyframeId(LogId("r2"), 2), 0.8)
    return Markers(TYPES, "map").array(logs, [closure], "r2", 7 * 10**9 + 3)


def written() -> dict[str, Any]:
    """Each message that flocc writes, with something in every field."""
    outgoing = Outgoing(TYPES, "map", "r1/odom")
    return {
        types.TF: outgoing.transforms(T, T, 1_234_567_890_123_456_789),
        types.PATH: outgoing.path(np.stack([T, np.eye(4)]), [10**9, 2 * 10**9 + 7], 2 * 10**9 + 7),
        types.POSE: outgoing.pose(T, np.diag([1.0, 2, 3, 4, 5, 6]), T, 5 * 10**9),
        types.MARKERS: markers(),
        types.DIAGNOSTICS: diagnostics(TYPES, STATUS, ["scale collapsed"], {"image": 3}, True, 10**9 + 5),
        types.TEXT: outgoing.text("map/r1, \u00fcber alles"),
    }


@pytest.mark.parametrize("type_name", written())
def test_what_flocc_writes_rclpy_reads(type_name: str) -> None:
    message = written()[type_name]
    assert_same(message, deserialize_message(TYPES.written(message), class_of(type_name)), type_name)


def filled(message: Any, rng: np.random.Generator) -> Any:
    """A message of rclpy with something drawn in every field that is a number, text or array of numbers."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if hasattr(value, "get_fields_and_field_types"):
            filled(value, rng)
        elif isinstance(value, bool):
            setattr(message, name, True)
        elif isinstance(value, int):
            setattr(message, name, int(rng.integers(1, 100)))
        elif isinstance(value, float):
            setattr(message, name, float(rng.normal()))
        elif isinstance(value, str):
            setattr(message, name, f"text {rng.integers(100)}")
        elif isinstance(value, np.ndarray):
            setattr(message, name, rng.normal(size=value.shape))
        elif kind.startswith("sequence<double") or kind.startswith("sequence<uint8") or kind == "sequence<int8>":
            setattr(message, name, [1, 2, 3] if "int8" in kind else [0.5, -0.5, 1.5])
        elif isinstance(value, bytes):
            setattr(message, name, bytes([int(rng.integers(0, 3))]))
        elif kind.startswith("sequence<"):
            setattr(message, name, [filled(class_of(kind[9:-1].replace("/", "/msg/"))(), rng) for _ in range(2)])
    return message


@pytest.mark.parametrize("type_name", NAMES)
def test_what_rclpy_writes_flocc_reads(type_name: str) -> None:
    for seed in range(20):
        message = filled(class_of(type_name)(), np.random.default_rng(seed))
        assert_same(TYPES.read(serialize_message(message), type_name), message, type_name)


def test_every_type_hash_is_that_of_rclpy(graph: Graph) -> None:
    node = graph.node("hashes")
    for k, type_name in enumerate(NAMES):
        publisher = node.create_publisher(class_of(type_name), f"/hash_{k}", 1)
        (end,) = node.get_publishers_info_by_topic(f"/hash_{k}")
        assert str(end.topic_type_hash) == TYPES.hash(type_name), type_name
        node.destroy_publisher(publisher)


def test_the_hash_of_a_trigger_service_is_that_of_its_package() -> None:
    told = json.loads((Path(sys.prefix) / "share/std_srvs/srv/Trigger.json").read_text())["type_hashes"]
    assert {each["type_name"]: each["hash_string"] for each in told}[types.TRIGGER] == types.TRIGGER_HASH
    answer = deserialize_message(types.trigger_response(True, "saved"), Trigger.Response)
    assert (answer.success, answer.message) == (True, "saved")


def test_messages_go_both_ways_with_remapped_names(graph: Graph) -> None:
    plain, heard, got = graph.node("plain"), list[Any](), list[bytes]()
    plain.create_subscription(String, "/elsewhere", heard.append, 10)
    sender = plain.create_publisher(Odometry, "/wheels", 10)
    with opened("-r", "flocc/map_frame:=/elsewhere", "-r", "odom:=/wheels") as node:
        publisher = node.publisher("flocc/map_frame", types.TEXT, Qos(1))
        topic = node.subscribe("odom", types.ODOMETRY, Qos(50), got.append)
        assert topic.name == "/wheels"
        until(lambda: sender.get_subscription_count() and plain.count_publishers("/elsewhere") and node.is_connected())
        time.sleep(0.5)
        sender.publish(Odometry(child_frame_id="base"))
        publisher.put(TYPES.new(types.TEXT, data="map/r1"))
        until(lambda: heard and got)
    assert heard[0].data == "map/r1"
    assert TYPES.read(got[0], types.ODOMETRY).child_frame_id == "base"


def test_keys_are_parameters_and_namespaces_are_taken() -> None:
    mounting = "camera_mounting:=[0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]"
    with opened("-p", "map_frame:=world", "-p", mounting, "-r", "__ns:=/r9") as node:
        assert node.config.map_frame == "world"
        assert node.config.camera_mounting == (0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0)
        assert node.where.endswith("node /r9/flocc_r1")


def open_and_use(words: Sequence[str]) -> None:
    with opened(*words) as node:
        node.publisher("path", types.PATH, Qos(1))
        node.subscribe("odom", types.ODOMETRY, Qos(1), lambda _: None)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-p", "map_frame:=5"], "--ros-args: map_frame: Input should be a valid string"),
        (["-p", "map_frame:=odom"], "map_frame and odom_frame must differ"),
        (["-p", "map_frame"], "ROS 2 does not start: .*parse parameter override rule"),
        (["-r", "__ns:=r 1"], "ROS 2 does not start"),
        (["--bogus"], r"ROS 2 does not start: it does not know the arguments \['--bogus'\]"),
        (["-p", "autostart:=maybe"], "ROS 2 does not start: .* expecting type 'BOOL'"),
        (["-p", "qos_overrides./r1/odom.subscription.reliability:=bogus"], "ROS 2 does not start: .*`bogus`"),
        (["-p", "qos_overrides./r1/odom.subscription.depth:=-1"], "ROS 2 does not start: .*history depth"),
        (["-p", "qos_overrides./r1/path.publisher.depth:=many"], "ROS 2 does not start: .*depth' to 'many'"),
    ],
)
def test_arguments_that_cannot_be_are_one_sentence(words: Sequence[str], said: str) -> None:
    with pytest.raises((Ros2Error, ConfigError), match=said):
        open_and_use(words)


@pytest.mark.parametrize(
    ("variable", "value", "said"),
    [
        ("ROS_DOMAIN_ID", "twelve", "ROS_DOMAIN_ID is 'twelve'; it must be a number from 0 to 232"),
        ("ROS_DOMAIN_ID", "500", "ROS_DOMAIN_ID is '500'; it must be a number from 0 to 232"),
        ("RMW_IMPLEMENTATION", "rmw_none_cpp", "RMW_IMPLEMENTATION is rmw_none_cpp, and no folder"),
    ],
)
def test_an_environment_that_does_not_fit_is_one_sentence(variable: str, value: str, said: str) -> None:
    program = (
        "from flocc_agent.config import Ros2Config; from flocc_agent.runtime.ros2.node import open_node;"
        "from flocc_agent.runtime.ros2.types import MessageTypes, Ros2Error\n"
        "try: open_node(Ros2Config(middleware='rclpy'), 'x', (), MessageTypes())\n"
        "except Ros2Error as error: print(error)"
    )
    environment = os.environ | {variable: value}
    ran = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60)
    assert said in ran.stdout, ran.stderr


def test_a_robot_in_another_domain_is_not_seen_and_it_says_what_must_fit(graph: Graph, domain_id: int) -> None:
    graph.node("driver", "/r1")
    with opened(domain_id=domain_id + 100) as node:
        time.sleep(1.0)
        assert not node.is_connected()
        assert node.advice == "no other node is seen; do ROS_DOMAIN_ID and RMW_IMPLEMENTATION fit the robot's?"
    with opened() as node:
        until(node.is_connected)


def test_other_types_and_qualities_of_service_are_told(graph: Graph) -> None:
    plain, offers = graph.node("camera", "/r1"), list[Offer]()
    plain.create_publisher(CompressedImage, "image", 10)
    plain.create_publisher(Odometry, "odom", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    plain.create_publisher(NavSatFix, "fix", 10)
    with opened() as node:
        node.subscribe("image", types.IMAGE, Qos(5, best_effort=True), lambda _: None)
        node.subscribe("odom", types.ODOMETRY, Qos(50), lambda _: None)
        node.subscribe("fix", types.NAV_SAT_FIX, Qos(50), lambda _: None)
        node.watch_offers(offers.append)
        until(lambda: len(offers) == 3)
    by_topic = {offer.topic: offer for offer in offers}
    assert by_topic["/r1/image"].type == types.COMPRESSED_IMAGE
    assert {offer.node for offer in offers} == {"/r1/camera"}
    assert by_topic["/r1/odom"].misfit.startswith(
        "offers it as best_effort, volatile, which does not fit reliable, volatile (ERROR: Best effort publisher"
    )
    fix = by_topic["/r1/fix"]
    assert (fix.type, fix.hash, fix.misfit) == (types.NAV_SAT_FIX, TYPES.hash(types.NAV_SAT_FIX), "")


def test_a_quality_of_service_can_be_overridden(graph: Graph) -> None:
    plain, got = graph.node("driver", "/r1"), list[bytes]()
    sender = plain.create_publisher(Odometry, "odom", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    with opened("-p", "qos_overrides./r1/odom.subscription.reliability:=best_effort") as node:
        node.subscribe("odom", types.ODOMETRY, Qos(50), got.append)
        until(lambda: (sender.publish(Odometry()), got)[1])


def test_a_manager_activates_the_node_and_nothing_passes_before(graph: Graph) -> None:
    plain, heard, got = graph.node("manager"), list[Any](), list[bytes]()
    sender = plain.create_publisher(Image, "/r1/image", 10)
    plain.create_subscription(String, "/r1/said", heard.append, 10)
    with opened("-p", "autostart:=false") as node:
        publisher = node.publisher("said", types.TEXT, Qos(10))
        node.subscribe("image", types.IMAGE, Qos(10), got.append)
        until(lambda: sender.get_subscription_count() and plain.count_publishers("/r1/said"))

        def exchanged(wanted: bool) -> bool:
            heard.clear()
            got.clear()
            end_s = time.monotonic() + (5.0 if wanted else 0.5)
            while time.monotonic() < end_s and not (heard and got):
                sender.publish(Image())
                publisher.put(TYPES.new(types.TEXT, data="x"))
                time.sleep(0.02)
            return bool(heard and got) if wanted else bool(heard or got)

        assert not exchanged(False)
        assert not changed(plain, Transition.TRANSITION_ACTIVATE), "out of order"
        assert changed(plain, Transition.TRANSITION_CONFIGURE)
        assert changed(plain, Transition.TRANSITION_ACTIVATE)
        assert exchanged(True)
        assert changed(plain, Transition.TRANSITION_DEACTIVATE)
        assert not exchanged(False)
        assert asked(plain, GetState, "get_state", GetState.Request()).current_state.id == State.PRIMARY_STATE_INACTIVE
        assert changed(plain, Transition.TRANSITION_CLEANUP)


def asked(plain: Any, kind: Any, service: str, request: Any) -> Any:
    client = plain.create_client(kind, f"/r1/flocc_r1/{service}")
    assert client.wait_for_service(10.0)
    future = client.call_async(request)
    until(future.done)
    return future.result()


def changed(plain: Any, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(asked(plain, ChangeState, "change_state", request).success)


def test_a_package_that_is_not_there_is_noted_and_the_rest_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", None)
    with opened() as node:
        node.publisher("/tf", types.TF, Qos(100)).put(Outgoing(TYPES, "map", "odom").transforms(T, None, 0))
        assert node.notes == ["this ROS has no tf2_msgs, so /tf is not published: apt install ros-$ROS_DISTRO-tf2-msgs"]
