"""The ROS 2 side of an agent: stamped images and odometry become keyframes, corrections become /tf, path and pose.

zenoh's threads only enqueue; everything else happens on the event loop. What a robot's messages do wrong is said once
and counted; the agent goes on.
"""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import Ros2Config
from flocc_agent.core.effects import Correction
from flocc_agent.core.interfaces import Image
from flocc_agent.runtime.inbox import Inbox, Incoming
from flocc_agent.runtime.keyframes import KeyframeSelector
from flocc_agent.runtime.ros2.incoming import Lens, image_of, lens_of, odometry_of
from flocc_agent.runtime.ros2.names import Offer, Qos, Topic
from flocc_agent.runtime.ros2.outgoing import Outgoing
from flocc_agent.runtime.ros2.problems import Problems
from flocc_agent.runtime.ros2.session import Publisher, Ros2Session
from flocc_agent.runtime.ros2.static_frames import StaticFrames, pose_of_numbers
from flocc_agent.runtime.ros2.synchroniser import PosedImage, Synchroniser
from flocc_agent.runtime.ros2.types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    ODOMETRY,
    PATH,
    POSE,
    TEXT,
    TF,
    BadMessage,
    MessageTypes,
    header_of,
)
from flocc_agent.runtime.transport import TrafficCounter

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]

INBOX_MESSAGES_MAX = 512
INBOX_BYTES_MAX = 64 * 1024 * 1024
WATCH_PERIOD_S = 1.0
PATIENCE_S = 5.0
PATH_PAUSE_RATIO = 9.0
BACK_IN_TIME = "time goes backwards; such messages are left out (docs/ros2.md says what to do after a reset)"

SENSOR = Qos(5, best_effort=True)
RELIABLE = Qos(10)
TF_QOS = Qos(100)
LATCHED = Qos(1, transient_local=True)
TF_STATIC = Qos(100, transient_local=True)


@dataclass(frozen=True, slots=True)
class Host:
    """What the agent gives the adapter.

    Attributes:
        add_keyframe: Takes (image, T_odom_camera, stamp_s); may wait.
        mount_camera: Told `T_body_camera` once it is known, before the first keyframe.
        trajectory: Gives stamps (s) and (N, 4, 4) corrected body poses of all keyframes; called off the loop's thread.
        report: Takes an event and its fields.
    """

    add_keyframe: Callable[[Image, Float, float], Awaitable[None]]
    mount_camera: Callable[[Float], None]
    trajectory: Callable[[], tuple[list[float], Float]]
    report: Callable[[str, dict[str, Any]], None]


class Ros2Adapter:
    """One robot's ROS 2 side; `run` until it is cancelled."""

    def __init__(self, config: Ros2Config, robot: str, selector: KeyframeSelector, host: Host) -> None:
        """Prepare; nothing is opened yet.

        Raises:
            Ros2Error: The extra is not installed.
        """
        self._config = config
        self._robot = robot
        self._selector = selector
        self._host = host
        self._types = MessageTypes()
        self._outgoing = Outgoing(self._types, config.map_frame, config.odom_frame)
        self._synchroniser = Synchroniser(config.images_max, config.odometry_gap_max_s)
        self._static = StaticFrames()
        self._counter = TrafficCounter()
        self._problems = Problems(host.report)
        self._heard = Counter[str]()
        self._lens: Lens | None = None
        self._T_body_camera: Float | None = None
        self._correction: Correction | None = None
        self._tf_last_ns: int | None = None
        self._path_changed = False
        self._posed = asyncio.Event()
        self._session: Ros2Session | None = None
        self._publishers: dict[str, Publisher] = {}
        self._subscribed: dict[str, Topic] = {}

    def counters(self) -> dict[str, int]:
        """What was dropped or refused, by reason."""
        dropped = {f"ros2 {reason}": n for reason, n in self._synchroniser.dropped.items()}
        waiting = {f"ros2 {reason}": n for reason, n in self._counter.snapshot().dropped.items()}
        return {**dropped, **waiting, **{f"ros2 {reason}": n for reason, n in self._problems.counts.items()}}

    async def run(self, corrections: "asyncio.Queue[Correction | None]") -> None:
        """Open the session, live until the corrections end, close it.

        Raises:
            TransportError: The session cannot be opened as configured.
        """
        loop = asyncio.get_running_loop()
        if self._config.camera_mounting is not None:
            self._mount(pose_of_numbers(self._config.camera_mounting, "camera_mounting"))
        inbox = Inbox(loop, self._arrived, self._counter, INBOX_MESSAGES_MAX, INBOX_BYTES_MAX)
        try:
            await asyncio.to_thread(self._open, inbox, loop)
            async with asyncio.TaskGroup() as tasks:
                others = [tasks.create_task(work) for work in (self._feed(), self._draw(), self._watch(), self._beat())]
                await self._tell(corrections)
                for other in others:
                    other.cancel()
        finally:
            if self._session is not None:
                await asyncio.shield(asyncio.to_thread(self._session.close))

    # Opening

    def _open(self, inbox: Inbox, loop: asyncio.AbstractEventLoop) -> None:
        config = self._config
        node = "flocc_" + self._robot.replace("-", "_")
        session = self._session = Ros2Session(config.router, config.domain_id, config.namespace, node, self._types)
        self._publishers = {
            "tf": session.publisher(config.tf_topic, TF, TF_QOS),
            "path": session.publisher(config.path_topic, PATH, LATCHED),
            "pose": session.publisher(config.pose_topic, POSE, RELIABLE),
            "map_frame": session.publisher(config.map_frame_topic, TEXT, LATCHED),
        }
        for kind, (name, type_name, qos) in self._wanted().items():
            self._subscribed[kind] = session.subscribe(name, type_name, qos, partial(_enqueue, inbox, kind))
        session.watch_offers(lambda offer: _on_loop(loop, partial(self._compare, offer)))

    def _wanted(self) -> dict[str, tuple[str, str, Qos]]:
        """Topic, type and quality of service of each subscription."""
        config = self._config
        wanted: dict[str, tuple[str, str, Qos]] = {}
        if config.odometry_topic:
            wanted["odometry"] = (config.odometry_topic, ODOMETRY, Qos(50))
        if config.image_topic:
            wanted["image"] = (config.image_topic, COMPRESSED_IMAGE if config.is_compressed() else IMAGE, SENSOR)
            wanted["camera_info"] = (config.camera_info_topic, CAMERA_INFO, SENSOR)
            if config.camera_mounting is None:
                wanted["tf_static"] = (config.tf_static_topic, TF, TF_STATIC)
        return wanted

    # What comes

    def _arrived(self, message: Incoming) -> None:
        self._heard[message.kind] += 1
        try:
            match message.kind:
                case "odometry":
                    self._take_odometry(message.payload)
                case "image":
                    self._take_image(message.payload)
                case "camera_info":
                    self._lens = lens_of(self._types.read(message.payload, CAMERA_INFO), self._config.rectified)
                case "tf_static":
                    self._static.add(self._types.read(message.payload, TF))
        except BadMessage as error:
            self._refuse(message.kind, str(error))

    def _take_odometry(self, payload: bytes) -> None:
        config = self._config
        sample = odometry_of(self._types.read(payload, ODOMETRY), config.odom_frame, config.base_frame)
        if not self._synchroniser.add_odometry(*sample):
            self._complain("odometry", BACK_IN_TIME)
            return
        self._posed.set()
        self._place(*sample)

    def _take_image(self, payload: bytes) -> None:
        stamp_ns, frame = header_of(payload)
        wanted = self._config.camera_frame
        if wanted and frame.lstrip("/") != wanted:
            raise BadMessage(f"images are in frame {frame!r}, but the configuration says {wanted!r}")
        if not self._synchroniser.add_image(stamp_ns, payload):
            self._complain("image", BACK_IN_TIME)
            return
        self._posed.set()

    def _compare(self, offer: Offer) -> None:
        """Say when a node publishes one of our topics as something else: its messages would never come."""
        for kind, topic in self._subscribed.items():
            if offer.topic == topic.name and (offer.type, offer.hash) != (topic.type, topic.hash):
                told = offer.type if offer.type != topic.type else f"{offer.type} of another definition ({offer.hash})"
                self._complain(kind, f"{offer.node} publishes it as {told}, but {topic.type} is needed")

    # Keyframes

    async def _feed(self) -> None:
        """Turn images into keyframes, one after the other."""
        while True:
            await self._posed.wait()
            self._posed.clear()
            while (posed := self._synchroniser.next()) is not None:
                try:
                    await self._consider(posed)
                except BadMessage as error:
                    self._refuse("image", str(error))

    async def _consider(self, posed: PosedImage) -> None:
        if not self._selector.wants(posed.T_odom_body):
            return
        lens = self._lens
        if lens is None:
            self._problems.counts["image without intrinsics"] += 1
            return
        message = self._types.read(posed.payload, COMPRESSED_IMAGE if self._config.is_compressed() else IMAGE)
        T_body_camera = self._mounting(message.header.frame_id.lstrip("/"))
        if T_body_camera is None:
            self._problems.counts["image without mounting"] += 1
            return
        image = await asyncio.to_thread(image_of, message, lens)
        self._selector.took(posed.T_odom_body)
        await self._host.add_keyframe(image, posed.T_odom_body @ T_body_camera, posed.stamp_ns * 1e-9)
        self._path_changed = True

    def _mounting(self, camera_frame: str) -> Float | None:
        """`T_body_camera`, found once; None while /tf_static does not connect the two."""
        if self._T_body_camera is None:
            T_body_camera = self._static.between(self._config.base_frame, camera_frame)
            if T_body_camera is not None:
                self._mount(T_body_camera)
        return self._T_body_camera

    def _mount(self, T_body_camera: Float) -> None:
        self._T_body_camera = T_body_camera
        self._host.mount_camera(T_body_camera)

    # What goes

    async def _tell(self, corrections: "asyncio.Queue[Correction | None]") -> None:
        """Publish what a correction changes; ends with the corrections."""
        while (correction := await corrections.get()) is not None:
            self._correction = correction
            self._put("map_frame", self._outgoing.text(correction.map_frame))
            self._path_changed = True

    async def _draw(self) -> None:
        """Publish the path when it changed, for at most a tenth of the time: it grows with the run."""
        pause_s = self._config.path_period_s
        while True:
            await asyncio.sleep(pause_s)
            if not self._path_changed:
                continue
            self._path_changed = False
            began_s = time.monotonic()
            message = await asyncio.to_thread(self._path)
            if message is not None:
                await asyncio.to_thread(self._put, "path", message)
            pause_s = max(self._config.path_period_s, PATH_PAUSE_RATIO * (time.monotonic() - began_s))

    def _path(self) -> Any:
        """The corrected path, of at most `path_poses_max` keyframes and the last; None where it is not known yet."""
        if self._config.image_topic and self._T_body_camera is None:
            return None
        stamps_s, T_map_body = self._host.trajectory()
        if not stamps_s:
            return None
        step = -(-len(stamps_s) // self._config.path_poses_max)
        chosen = sorted({*range(0, len(stamps_s), step), len(stamps_s) - 1})
        stamps_ns = [round(stamps_s[i] * 1e6) * 1000 for i in chosen]  # a double holds today's seconds to 0.2 us
        return self._outgoing.path(T_map_body[chosen], stamps_ns, stamps_ns[-1])

    def _place(self, stamp_ns: int, T_odom_body: Float) -> None:
        """Publish map to odom, and the pose, as often as configured; the time is that of the odometry."""
        config, correction = self._config, self._correction
        if correction is None:
            return
        if self._tf_last_ns is not None and stamp_ns - self._tf_last_ns < config.tf_period_s * 1e9:
            return
        self._tf_last_ns = stamp_ns
        self._put_transform(correction, stamp_ns)
        self._put("pose", self._outgoing.pose(correction.T_map_odom, correction.covariance, T_odom_body, stamp_ns))

    def _put_transform(self, correction: Correction, stamp_ns: int) -> None:
        ahead_ns = round(self._config.tf_tolerance_s * 1e9)
        self._put("tf", self._outgoing.transform(correction.T_map_odom, stamp_ns + ahead_ns))

    async def _beat(self) -> None:
        """Publish map to odom by the clock where no odometry comes by ROS."""
        while not self._config.odometry_topic:
            await asyncio.sleep(self._config.tf_period_s)
            if self._correction is not None:
                self._put_transform(self._correction, time.time_ns())

    def _put(self, name: str, message: Any) -> None:
        self._publishers[name].put(message)

    # What is wrong

    async def _watch(self) -> None:
        """Say when the router comes and goes, and what the first image still waits for."""
        assert self._session is not None
        connected, waited_s = False, 0.0
        while True:
            await asyncio.sleep(WATCH_PERIOD_S)
            waited_s += WATCH_PERIOD_S
            if self._session.is_connected() != connected:
                connected = not connected
                self._host.report("ros2_router", {"router": self._config.router, "connected": connected})
                logger.info("ROS 2: %s to %s", "connected" if connected else "no longer connected", self._config.router)
            if waited_s == PATIENCE_S and not connected:
                self._complain("router", f"nobody answers at {self._config.router}; is rmw_zenohd running?")
            if waited_s % PATIENCE_S == 0 and connected:
                self._say_what_is_missing()

    def _say_what_is_missing(self) -> None:
        for kind, topic in self._subscribed.items():
            if not self._heard[kind]:
                self._complain(kind, f"no {topic.type} has come yet")
        if self._heard["image"] and self._problems.counts["image without mounting"] and self._T_body_camera is None:
            self._complain("tf_static", f"does not connect {self._config.base_frame!r} with the camera's frame")

    def _refuse(self, kind: str, sentence: str) -> None:
        self._problems.refuse(kind, self._name(kind), sentence)

    def _complain(self, kind: str, sentence: str) -> None:
        self._problems.say(self._name(kind), sentence)

    def _name(self, kind: str) -> str:
        return self._subscribed[kind].name if kind in self._subscribed else "ROS 2"


def _enqueue(inbox: Inbox, kind: str, payload: bytes) -> None:
    inbox.put(Incoming("", kind, payload))


def _on_loop(loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
    try:
        loop.call_soon_threadsafe(call)
    except RuntimeError:  # the loop is closed: nobody listens any more
        return
