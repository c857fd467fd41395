"""The adapter against a raw zenoh node that speaks the documented form: keyframes in, corrections out, faults said."""

import asyncio
import sys
import time
from collections.abc import AsyncIterator, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.agent.core.test_core_earth_frame import BENT, log_of
from tests.agent.runtime.loopback import free_ports, until
from tests.agent.runtime.ros2 import cdr_by_hand
from tests.agent.runtime.ros2.cdr_by_hand import Stamped
from tests.agent.runtime.ros2.raw_node import RawNode, gid, open_router

from flocc_agent.config import KeyframeConfig, Ros2Config
from flocc_agent.core.corrected import CorrectedLog, Correction, RecordedOdometry
from flocc_agent.core.geodesy import place_of
from flocc_agent.core.interfaces import Image
from flocc_agent.core.log_copy import LogCopy
from flocc_agent.core.measurements import GeodeticFix, Measurement, OdometryCovariance
from flocc_agent.core.reports import Fact
from flocc_agent.geometry import Float, pose, pose7, so3_exp, tq_from_pose
from flocc_agent.runtime.facts import RosProblem, RouterConnected
from flocc_agent.runtime.inbox import Incoming
from flocc_agent.runtime.keyframes import KeyframeSelector
from flocc_agent.runtime.ros2.adapter import Host, Ros2Adapter
from flocc_agent.runtime.ros2.types import BadMessage, Ros2Error
from flocc_agent.runtime.status import AgentStatus
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import LogCorrection

EPOCH_S = 1_700_000_000
SIZE = (4, 6)
MOUNTING = (0.1, 0.0, 0.5, -0.5, 0.5, -0.5, 0.5)
T_BODY_CAMERA = pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.0, 0.5]))
T_MAP_ODOM = pose(so3_exp(np.array([0.0, 0.0, 0.7])), np.array([3.0, -2.0, 0.1]))
INFO, PICTURE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Image"
TF, PATH, POSE = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Path", "geometry_msgs/msg/PoseWithCovarianceStamped"


def stamp(t_ms: int) -> tuple[int, int]:
    return EPOCH_S + t_ms // 1000, t_ms % 1000 * 1_000_000


class Robot:
    """A robot's drivers: moves along x by 1 m/s."""

    def __init__(self, node: RawNode) -> None:
        self.node = node
        self.advertised: set[str] = set()

    def _publish(self, topic: str, kind: str, payload: bytes, latched: bool = False) -> None:
        if topic not in self.advertised:
            self.node.advertise(topic, kind, latched)
            self.advertised.add(topic)
        self.node.publish(topic, payload)

    def odometry(self, t_ms: int, frame: str = "odom", off_m: float = 0.0) -> None:
        sample = Stamped(stamp(t_ms), frame, "base_link", (1e-3 * t_ms + off_m, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        self._publish("/r1/odom", "nav_msgs/msg/Odometry", cdr_by_hand.odometry(sample))

    def image(self, t_ms: int, encoding: str = "mono8", frame: str = "optical") -> None:
        payload = cdr_by_hand.image(stamp(t_ms), frame, SIZE, encoding, bytes([t_ms % 251]) * 24, 6)
        self._publish("/r1/camera/image_raw", PICTURE, payload)

    def camera_info(self) -> None:
        K, P = (5.0, 0, 3.0, 0, 5.0, 2.0, 0, 0, 1), (5.0, 0, 3.0, 0, 0, 5.0, 2.0, 0, 0, 0, 1, 0)
        self._publish(
            "/r1/camera/camera_info", INFO, cdr_by_hand.camera_info(stamp(0), "optical", SIZE, K, [0.0] * 5, P)
        )

    def fix(self, t_ms: int) -> None:
        payload = cdr_by_hand.nav_sat_fix(
            stamp(t_ms), "gps", (48.0 + 1e-8 * t_ms, 11.0, 500.0), [4.0, 0, 0, 0, 4, 0, 0, 0, 9]
        )
        self._publish("/r1/gps/fix", "sensor_msgs/msg/NavSatFix", payload)

    def mounting(self) -> None:
        placed = Stamped((0, 0), "base_link", "optical", MOUNTING[:3], MOUNTING[3:])
        self._publish("/tf_static", TF, cdr_by_hand.transforms([placed]), latched=True)


class Agent:
    """What the adapter gave its agent, and what it is given."""

    def __init__(self) -> None:
        self.keyframes: list[tuple[Image, Float, float]] = []
        self.mounted: list[Float] = []
        self.measured: list[tuple[Measurement, float]] = []
        self.facts: list[Fact] = []
        self.resets: list[None] = []
        self.corrections: asyncio.Queue[Correction | None] = asyncio.Queue()
        self.logs: dict[str, CorrectedLog] = {}
        self.poses = [(EPOCH_S + 0.25, np.eye(4)), (EPOCH_S + 1.0, T_MAP_ODOM)]

    async def add_keyframe(self, image: Image, T_odom_camera: Float, stamp_s: float) -> None:
        self.keyframes.append((image, T_odom_camera, stamp_s))

    def trajectory(self) -> tuple[list[float], Float]:
        return [stamp_s for stamp_s, _ in self.poses], np.stack([T for _, T in self.poses])

    def host(self) -> Host:
        return Host(
            self.add_keyframe,
            self.mounted.append,
            self.trajectory,
            lambda measurement, stamp_s: self.measured.append((measurement, stamp_s)),
            self.facts.append,
            lambda: "r1/result.json",
            lambda: self.resets.append(None),
            lambda: [],
            lambda: (AgentStatus(robot="r-1"), ()),
            lambda: self.logs,
        )

    def problems(self) -> list[str]:
        return [fact.sentence for fact in self.facts if isinstance(fact, RosProblem)]


def correction(covariance: Float | None = None) -> Correction:
    term = Term(1, LogId("r1", 0))
    message = LogCorrection(term.leader, term, 1, term.leader, pose7(T_MAP_ODOM))
    own = CorrectedLog(message, RecordedOdometry(LogCopy()))
    return Correction(term, 1, "map/r1", False, T_MAP_ODOM, covariance, own, {})


@contextmanager
def ros(port: int, domain_id: int = 0) -> Iterator[Robot]:
    """A router and a robot's drivers."""
    router = open_router(port)
    try:
        with RawNode(port, domain_id) as node:
            yield Robot(node)
    finally:
        router.close()


@asynccontextmanager
async def adapted(port: int, **options: Any) -> AsyncIterator[tuple[Agent, Ros2Adapter]]:
    """An adapter that runs; it must end when its corrections end."""
    where = {"middleware": "rmw_zenoh", "router": f"tcp/127.0.0.1:{port}", "namespace": "/r1"}
    config = Ros2Config.model_validate({**where, "path_period_s": 0.1, **options})
    agent = Agent()
    adapter = Ros2Adapter(config, "r-1", KeyframeSelector(KeyframeConfig(distance_m=0.09)), agent.host())
    running = asyncio.create_task(adapter.run(agent.corrections))
    try:
        yield agent, adapter
    finally:
        agent.corrections.put_nowait(None)
        async with asyncio.timeout(10.0):
            await running


def drive(robot: Robot, agent: Agent, count: int = 3) -> Any:
    """Send one more odometry message and image, until enough keyframes were taken."""
    steps = iter(range(0, 100_000, 50))

    def step() -> None:
        t = next(steps)
        robot.camera_info()
        robot.mounting()
        robot.image(t)
        robot.odometry(t)

    return until(lambda: len(agent.keyframes) >= count, act=step)


async def test_images_and_odometry_become_keyframes_where_the_robot_moved_enough() -> None:
    (port,) = free_ports(1)
    with ros(port) as robot:
        async with adapted(port) as (agent, adapter):
            await drive(robot, agent)
    for image, T_odom_camera, stamp_s in agent.keyframes:
        t_s = stamp_s - EPOCH_S
        np.testing.assert_allclose(T_odom_camera, pose(np.eye(3), np.array([t_s, 0.0, 0.0])) @ T_BODY_CAMERA, atol=1e-6)
        assert np.all(image.pixels == round(t_s * 1000) % 251)
        assert (image.camera.height, image.camera.width) == SIZE
    steps_s = np.diff([stamp_s for *_, stamp_s in agent.keyframes])
    np.testing.assert_allclose(steps_s, 0.1, atol=1e-6)
    assert len(agent.mounted) == 1
    np.testing.assert_allclose(agent.mounted[0], T_BODY_CAMERA, atol=1e-12)
    assert agent.problems() == []
    assert "ros2 image refused" not in adapter.counters()


async def test_fixes_are_interpolated_to_the_stamps_of_keyframes() -> None:
    (port,) = free_ports(1)
    with ros(port) as robot:
        async with adapted(port, fix_topic="gps/fix") as (agent, _):
            steps = iter(range(0, 100_000, 50))

            def step() -> None:
                t = next(steps)
                robot.camera_info()
                robot.mounting()
                if t % 200 == 50:
                    robot.fix(t)
                robot.image(t)
                robot.odometry(t)

            await until(lambda: len(agent.measured) >= 4, act=step)
    given_s = {stamp_s for *_, stamp_s in agent.keyframes}
    for fix, stamp_s in agent.measured:
        assert stamp_s in given_s
        assert isinstance(fix, GeodeticFix)
        assert fix.latitude_deg == pytest.approx(48.0 + 1e-5 * (stamp_s - EPOCH_S), abs=1e-9)
        assert np.asarray(fix.covariance_m2)[2, 2] == 9.0
    assert agent.problems() == []


async def driven_by_hand(way: Iterable[tuple[int, float]]) -> Agent:
    """What an adapter gives of a camera that was at so many metres at each of some times (ms), without a network."""
    agent = Agent()
    config = Ros2Config(camera_mounting=MOUNTING)
    adapter = Ros2Adapter(config, "r1", KeyframeSelector(KeyframeConfig(distance_m=0.09)), agent.host())
    hearing = adapter._hearing = adapter._heard(config)
    K, P = (5.0, 0, 3.0, 0, 5.0, 2.0, 0, 0, 1), (5.0, 0, 3.0, 0, 0, 5.0, 2.0, 0, 0, 0, 1, 0)
    hearing.take("camera_info", cdr_by_hand.camera_info(stamp(0), "optical", SIZE, K, [0.0] * 5, P))
    for t_ms, x_m in way:
        sample = Stamped(stamp(t_ms), "odom", "base_link", (x_m, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        hearing.take("odometry", cdr_by_hand.odometry(sample, variance=1e-6 * t_ms))
        hearing.take("image", cdr_by_hand.image(stamp(t_ms), "optical", SIZE, "mono8", bytes(24), 6))
        while (posed := hearing.next_wanted(adapter._selector)) is not None:
            await adapter._add(hearing, posed)
    return agent


async def test_what_the_covariance_of_odometry_grew_by_becomes_that_of_the_steps() -> None:
    agent = await driven_by_hand((t_ms, 1e-3 * t_ms) for t_ms in range(0, 400, 100))
    assert len(agent.keyframes) == 4
    assert [round(1000 * (stamp_s - EPOCH_S)) for _, stamp_s in agent.measured] == [100, 200, 300]
    for measured, _ in agent.measured:
        assert isinstance(measured, OdometryCovariance)
        seen = OdometryCovariance(1e-4 * np.eye(6)).in_camera(T_BODY_CAMERA).covariance
        np.testing.assert_allclose(measured.covariance, seen, atol=3e-5)


async def test_a_step_over_a_pause_of_odometry_is_left_to_closures_whatever_its_covariance_says() -> None:
    before, after = range(0, 1200, 100), range(21_200, 21_500, 100)
    way = [*((t_ms, 1e-3 * t_ms) for t_ms in before), *((t_ms, 1e-3 * (t_ms - 20_000)) for t_ms in after)]
    agent = await driven_by_hand(way)
    wide = {round(1000 * (stamp_s - EPOCH_S)): m.covariance[0, 0] for m, stamp_s in agent.measured}  # type: ignore[union-attr]
    assert [t_ms for t_ms, variance in wide.items() if variance > 1.0] == [21_200]


async def test_a_correction_goes_out_as_transform_pose_path_and_frame() -> None:
    (port,) = free_ports(1)
    with ros(port, domain_id=9) as robot:
        node = robot.node
        node.subscribe("/tf", TF)
        node.subscribe("/r1/flocc/pose", POSE)
        async with adapted(port, domain_id=9, tf_tolerance_s=0.25) as (agent, _):
            agent.corrections.put_nowait(correction(np.eye(6)))
            await drive(robot, agent, 1)
            times = iter(range(100_000, 200_000, 20))
            await until(lambda: len(node.received["/r1/flocc/pose"]) >= 4, act=lambda: robot.odometry(next(times)))
            node.subscribe("/r1/flocc/path", PATH, latched=True)
            node.subscribe("/r1/flocc/map_frame", "std_msgs/msg/String", latched=True)
            await until(lambda: bool(node.received["/r1/flocc/path"] and node.received["/r1/flocc/map_frame"]))
            token = next(token for token in node.tokens if "%tf/" in token and "flocc_r_1" in token)
    x, y, z, w, qx, qy, qz = tq_from_pose(T_MAP_ODOM).tolist()
    placed = [cdr_by_hand.read_transforms(each.payload)[0] for each in node.received["/tf"]]
    expected = ("map", "odom", (x, y, z), (qx, qy, qz, w))
    assert {(p.frame, p.child, p.position, p.quaternion) for p in placed} == {expected}
    poses = [cdr_by_hand.read_pose(each.payload) for each in node.received["/r1/flocc/pose"]]
    placed_ns, posed_ns = ([s * 10**9 + ns for s, ns in (p.stamp for p in each)] for each in (placed, poses))
    assert {a - b for a, b in zip(placed_ns, posed_ns, strict=False)} == {250_000_000}
    assert np.all(np.diff(posed_ns) >= 50_000_000)
    t_s = poses[-1].stamp[0] - EPOCH_S + poses[-1].stamp[1] * 1e-9
    np.testing.assert_allclose(poses[-1].position, (T_MAP_ODOM @ [t_s, 0, 0, 1])[:3], atol=1e-5)
    assert poses[-1].covariance[0] > 0
    _, frame, path = cdr_by_hand.read_path(node.received["/r1/flocc/path"][0].payload)
    assert (frame, [p.stamp for p in path]) == ("map", [stamp(250), stamp(1000)])
    assert cdr_by_hand.read_text(node.received["/r1/flocc/map_frame"][0].payload) == "map/r1"
    attached = [cdr_by_hand.read_attachment(each.attachment or b"") for each in node.received["/tf"]]
    assert [number for number, *_ in attached] == list(range(attached[0][0], attached[0][0] + len(attached)))
    assert {identifier for *_, identifier in attached} == {gid(token)}


async def test_a_map_with_fixes_is_placed_on_earth_with_each_transform() -> None:
    (port,) = free_ports(1)
    with ros(port) as robot:
        robot.node.subscribe("/tf", TF)
        async with adapted(port) as (agent, _):
            agent.logs["r1"] = log_of(BENT)
            agent.corrections.put_nowait(correction())
            await drive(robot, agent, 1)
            times = iter(range(100_000, 200_000, 20))

            def told() -> list[list[Stamped]]:
                return [cdr_by_hand.read_transforms(each.payload) for each in robot.node.received["/tf"]]

            await until(lambda: [len(each) for each in told()[-2:]] == [2, 2], act=lambda: robot.odometry(next(times)))
            agent.corrections.put_nowait(replace(correction(), map_frame="map/r0", frame_changed=True))
            agent.logs.clear()
            await until(lambda: len(told()[-1]) == 1, act=lambda: robot.odometry(next(times)))
    both = next(each for each in told() if len(each) == 2)
    assert [(each.frame, each.child) for each in both] == [("map", "odom"), ("earth", "map")]
    assert both[0].stamp == both[1].stamp
    place = place_of(np.array(both[1].position))
    assert place[:2] == pytest.approx((48.1, 11.5), abs=1e-3)
    assert place.altitude_m == pytest.approx(500.0, abs=10.0)


async def test_a_program_that_feeds_the_agent_gets_transforms_by_the_clock_and_a_thinned_path() -> None:
    (port,) = free_ports(1)
    with ros(port) as robot:
        robot.node.subscribe("/tf", TF)
        robot.node.subscribe("/r1/flocc/path", PATH, latched=True)
        options = {"image_topic": "", "odometry_topic": "", "path_poses_max": 2, "tf_period_s": 0.02}
        async with adapted(port, **options) as (agent, _):
            agent.poses = [(EPOCH_S + float(k), pose(np.eye(3), np.array([k, 0.0, 0.0]))) for k in range(7)]
            before_s = time.time()
            agent.corrections.put_nowait(correction())
            await until(lambda: len(robot.node.received["/tf"]) >= 5 and bool(robot.node.received["/r1/flocc/path"]))
            assert not any("/MS/" in token for token in robot.node.tokens if "flocc_r_1" in token)
    times_s = [cdr_by_hand.read_transforms(each.payload)[0].stamp[0] for each in robot.node.received["/tf"]]
    assert all(before_s - 1.0 <= each_s <= time.time() + 1.0 for each_s in times_s)
    *_, path = cdr_by_hand.read_path(robot.node.received["/r1/flocc/path"][-1].payload)
    assert [(p.stamp[0] - EPOCH_S, p.position[0]) for p in path] == [(0, 0.0), (4, 4.0), (6, 6.0)]


async def test_the_graph_shows_the_node_and_its_endpoints() -> None:
    (port,) = free_ports(1)
    with ros(port) as robot:
        async with adapted(port):
            await until(lambda: len([token for token in robot.node.tokens if "flocc_r_1" in token]) == 13)
            ours = [token.split("/") for token in robot.node.tokens if "flocc_r_1" in token]
    assert {chunks[2] for chunks in ours} != {str(robot.node.session.zid())}
    assert {tuple(chunks[6:9]) for chunks in ours} == {("%", "%r1", "flocc_r_1")}
    assert {(chunks[5], chunks[9], chunks[12]) for chunks in ours if len(chunks) == 13} == {
        ("MP", "%tf", "::,100:,:,:,,"),
        ("MP", "%r1%flocc%path", ":1:,1:,:,:,,"),
        ("MP", "%r1%flocc%pose", "::,10:,:,:,,"),
        ("MP", "%r1%flocc%map_frame", ":1:,1:,:,:,,"),
        ("MP", "%r1%flocc%graph", ":1:,1:,:,:,,"),
        ("MP", "%diagnostics", "::,10:,:,:,,"),
        ("MS", "%r1%odom", "::,200:,:,:,,"),
        ("MS", "%r1%camera%image_raw", "2::,5:,:,:,,"),
        ("MS", "%r1%camera%camera_info", "2::,5:,:,:,,"),
        ("MS", "%tf_static", ":1:,100:,:,:,,"),
        ("SS", "%r1%flocc_r_1%save_map", "::,10:,:,:,,"),
        ("SS", "%r1%flocc_r_1%reset_odometry", "::,10:,:,:,,"),
    }
    assert len({chunks[4] for chunks in ours}) == 13


async def test_a_topic_of_another_type_is_said() -> None:
    (port,) = free_ports(1)
    with ros(port) as robot:
        robot.node.advertise("/r1/camera/image_raw", "sensor_msgs/msg/CompressedImage")
        robot.node.advertise("/r1/odom", "nav_msgs/msg/Odometry", hash_="RIHS01_" + "0" * 64)
        async with adapted(port) as (agent, _):
            await until(lambda: len(agent.problems()) == 2)
    assert sorted(agent.problems()) == [
        "/r1/camera/image_raw: /driver publishes it as sensor_msgs/msg/CompressedImage, but sensor_msgs/msg/Image is "
        "needed",
        f"/r1/odom: /driver publishes it as nav_msgs/msg/Odometry of another definition (RIHS01_{'0' * 64}), but "
        "nav_msgs/msg/Odometry is needed",
    ]


async def test_what_cannot_be_used_is_said_once_counted_and_left_out() -> None:
    (port,) = free_ports(1)
    with ros(port) as robot:
        async with adapted(port, camera_frame="optical") as (agent, adapter):
            await drive(robot, agent, 1)
            depth_ms = iter(range(200_000, 300_000, 200))

            def wrong() -> None:
                t = next(depth_ms)
                robot.odometry(t, frame="world")
                robot.odometry(t)
                robot.odometry(t + 1, off_m=2e6)
                robot.odometry(5)
                robot.image(t, encoding="16UC1")
                robot.image(t, frame="left")
                robot.image(5)
                robot.node.publish("/r1/odom", b"\x00\x01\x00\x00junk")

            reasons = {"odometry refused", "image refused", "odometry back in time", "image back in time"}
            await until(lambda: reasons <= {key.removeprefix("ros2 ") for key in adapter.counters()}, act=wrong)
            before = len(agent.keyframes)
            later = iter(range(400_000, 500_000, 50))

            def right() -> None:
                t = next(later)
                robot.image(t)
                robot.odometry(t)

            await until(lambda: len(agent.keyframes) > before, act=right)
    said = " | ".join(agent.problems())
    assert "odometry is of 'base_link' in 'world', but the configuration says 'base_link' in 'odom'" in said
    assert "/r1/camera/image_raw: images are encoded as '16UC1'" in said
    assert "images are in frame 'left', but the configuration says 'optical'" in said
    assert said.count("time goes backwards") == 2
    assert "are no nav_msgs/msg/Odometry" in said
    assert "odometry jumps out of reach (faster than 1000 m/s)" in said
    assert len(agent.problems()) == len(set(agent.problems())) == 7


async def test_messages_that_a_publisher_numbered_and_that_never_came_are_said_and_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("flocc_agent.runtime.ros2.adapter.PATIENCE_S", 1.0)
    (port,) = free_ports(1)
    with ros(port) as robot:
        async with adapted(port) as (agent, adapter):
            await drive(robot, agent, 1)
            robot.node._publishers["/r1/camera/image_raw"][1][0] += 30  # as if the network had lost them
            times = iter(range(200_000, 300_000, 50))
            await until(lambda: bool(agent.problems()), act=lambda: robot.image(next(times)))
            lost = adapter.counters()["ros2 image lost before this node"]
    assert lost == 30
    assert len(agent.problems()) == 1
    assert agent.problems()[0].startswith("/r1/camera/image_raw: messages are lost before they reach this node")


async def test_without_a_router_it_says_so_and_connects_when_one_comes() -> None:
    (port,) = free_ports(1)
    async with adapted(port, camera_mounting=MOUNTING) as (agent, _):
        await until(lambda: agent.problems() != [])
        assert agent.problems() == [f"ROS 2: nobody answers at tcp/127.0.0.1:{port}; is rmw_zenohd running?"]
        with ros(port) as robot:
            await drive(robot, agent, 2)
            linked = RouterConnected(router=f"tcp/127.0.0.1:{port}", connected=True)
            await until(lambda: linked in agent.facts)


async def test_images_wait_for_their_camera_and_what_they_wait_for_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flocc_agent.runtime.ros2.adapter.PATIENCE_S", 1.0)
    (port,) = free_ports(1)
    with ros(port) as robot:
        async with adapted(port) as (agent, adapter):
            times = iter(range(0, 100_000, 10))

            def step() -> None:
                t = next(times)
                robot.image(t)
                robot.odometry(t)

            await until(lambda: any("CameraInfo" in said for said in agent.problems()), act=step)
            assert agent.keyframes == []
            robot.camera_info()
            await until(lambda: any("does not connect" in said for said in agent.problems()), act=step)
            assert agent.keyframes == []
            robot.mounting()
            await until(lambda: len(agent.keyframes) >= 4)
            lost = adapter.counters()
    assert "/r1/camera/camera_info: no sensor_msgs/msg/CameraInfo has come yet" in agent.problems()
    assert "/tf_static: no tf2_msgs/msg/TFMessage has come yet" in agent.problems()
    assert "/tf_static: does not connect 'base_link' with the camera's frame" in agent.problems()
    stamps_s = [stamp_s - EPOCH_S for *_, stamp_s in agent.keyframes]
    assert stamps_s[0] < 1.0, "from the first image on, also those that came before the camera was known"
    assert np.all(np.abs(np.diff(stamps_s) - 0.095) < 0.006)
    assert lost == {}


async def test_images_that_wait_for_their_camera_are_bounded_and_counted() -> None:
    agent, config = Agent(), Ros2Config()
    adapter = Ros2Adapter(config, "r1", KeyframeSelector(KeyframeConfig(distance_m=0.09)), agent.host())
    hearing = adapter._hearing = adapter._heard(config)
    K, P = (5.0, 0, 3.0, 0, 5.0, 2.0, 0, 0, 1), (5.0, 0, 3.0, 0, 0, 5.0, 2.0, 0, 0, 0, 1, 0)
    info = cdr_by_hand.camera_info(stamp(0), "optical", SIZE, K, [0.0] * 5, P)
    placed = cdr_by_hand.transforms([Stamped((0, 0), "base_link", "optical", MOUNTING[:3], MOUNTING[3:])])
    for count, kind, payload in ((70, "camera_info", info), (80, "tf_static", placed)):
        for t_ms in range(0 if count == 70 else 7000, 100 * count, 100):
            sample = Stamped(stamp(t_ms), "odom", "base_link", (1e-3 * t_ms, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
            hearing.take("odometry", cdr_by_hand.odometry(sample))
            hearing.take("image", cdr_by_hand.image(stamp(t_ms), "optical", SIZE, "mono8", bytes(24), 6))
            assert hearing.next_wanted(adapter._selector) is None
        assert hearing.take(kind, payload)
    assert adapter.counters() == {"ros2 image without intrinsics": 6, "ros2 image without mounting": 10}
    waiting = iter(lambda: hearing.next_wanted(adapter._selector), None)
    assert [round(posed.stamp_ns * 1e-9 - EPOCH_S, 1) for posed in waiting] == [
        round(0.1 * k, 1) for k in range(16, 80)
    ]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"image_topic": "camera//image"}, "no ROS name"),
        ({"odometry_topic": ""}, "images need odometry_topic"),
        ({"map_frame": "odom"}, "map_frame and odom_frame must differ"),
        ({"camera_mounting": (0, 0, 0, 0, 0, 0, 0.5)}, "quaternion of unit length"),
        ({"path_topic": ""}, "path_topic must not be empty"),
        ({"domain_id": 500}, "less than or equal to 232"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Ros2Config(**options)


@pytest.mark.parametrize("package", ["rosbags.typesys", "xxhash"])
def test_a_missing_extra_is_said(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(Ros2Error, match=r"needs rosbags and xxhash: .*pip install '\.\[ros2\]'"):
        Ros2Adapter(Ros2Config(), "r1", KeyframeSelector(KeyframeConfig()), Agent().host())


def test_the_type_of_images_follows_from_the_topics_name_unless_it_is_said() -> None:
    assert not Ros2Config().is_compressed()
    assert Ros2Config(image_topic="camera/image_raw/compressed").is_compressed()
    assert Ros2Config(image_type="compressed").is_compressed()


def mutated(payload: bytes, rng: np.random.Generator) -> bytes:
    """A payload with a few other bytes, or cut, or with junk behind."""
    broken = bytearray(payload)
    for _ in range(int(rng.integers(1, 4))):
        broken[int(rng.integers(0, min(len(broken), 250)))] = int(rng.integers(0, 256))
    return bytes(broken[: int(rng.integers(0, len(broken) + 1))]) if rng.random() < 0.3 else bytes(broken)


async def test_no_payload_of_any_kind_stops_the_adapter() -> None:
    rng, agent = np.random.default_rng(11), Agent()
    selector = KeyframeSelector(KeyframeConfig(distance_m=0.0))
    config = Ros2Config(camera_mounting=MOUNTING)
    adapter = Ros2Adapter(config, "r1", selector, agent.host())
    hearing = adapter._hearing = adapter._heard(config)
    K, P = (5.0, 0, 3.0, 0, 5.0, 2.0, 0, 0, 1), (5.0, 0, 3.0, 0, 0, 5.0, 2.0, 0, 0, 0, 1, 0)
    info = cdr_by_hand.camera_info(stamp(0), "optical", SIZE, K, [0.1, 0.0, 0.0, 0.0, 0.1], P)
    placed = cdr_by_hand.transforms([Stamped((0, 0), "base_link", "optical", MOUNTING[:3], MOUNTING[3:])])
    for t_ms in range(0, 20_000, 20):
        sample = Stamped(stamp(t_ms), "odom", "base_link", (1e-3 * t_ms, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        picture = cdr_by_hand.image(stamp(t_ms), "optical", SIZE, "bgr8", bytes(72), 18)
        sent = {"odometry": cdr_by_hand.odometry(sample), "image": picture, "camera_info": info, "tf_static": placed}
        for kind, payload in sent.items():
            adapter._arrived(Incoming("", kind, mutated(payload, rng)))
        while (posed := hearing.next_wanted(selector)) is not None:
            with suppress(BadMessage):
                await adapter._add(hearing, posed)
    assert len(agent.problems()) <= 64
    assert sum(adapter.counters().values()) > 300
    assert all(np.all(np.isfinite(T)) for _, T, _ in agent.keyframes)
