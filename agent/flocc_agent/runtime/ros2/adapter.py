"""The ROS 2 side of an agent: stamped images and odometry become keyframes, corrections become /tf, path and pose.

zenoh's threads only enqueue; everything else happens on the event loop. What a robot's messages do wrong is said once
and counted; the agent goes on.
"""

import asyncio
import logging
import math
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import Ros2Config
from flocc_agent.core.corrected import Correction
from flocc_agent.core.interfaces import Image
from flocc_agent.core.measurements import Measurement
from flocc_agent.core.reports import Fact
from flocc_agent.runtime.facts import RouterConnected
from flocc_agent.runtime.given_keyframes import BadKeyframe
from flocc_agent.runtime.inbox import Inbox, Incoming
from flocc_agent.runtime.keyframes import KeyframeSelector
from flocc_agent.runtime.ros2.incoming import Eye, model_of, odometry_of
from flocc_agent.runtime.ros2.problems import Problems
from flocc_agent.runtime.ros2.satellite import SatelliteFixes, fix_of
from flocc_agent.runtime.ros2.session import Ros2Session
from flocc_agent.runtime.ros2.static_frames import StaticFrames, pose_of_numbers
from flocc_agent.runtime.ros2.synchroniser import PosedImage, Synchroniser
from flocc_agent.runtime.ros2.telling import Teller
from flocc_agent.runtime.ros2.topics import Offer, Qos, Topic
from flocc_agent.runtime.ros2.types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    NAV_SAT_FIX,
    ODOMETRY,
    TF,
    BadMessage,
    MessageTypes,
    header_of,
)
from flocc_agent.runtime.transport import TrafficCounter

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]

IMAGES_MAX = 8
"""Images that wait for odometry or for the encoder; the oldest gives way."""
ODOMETRY_GAP_MAX_S = 0.5
"""Images in a longer pause of the odometry are left out: what is between is guessed, not measured."""
INBOX_MESSAGES_MAX = 512
INBOX_BYTES_MAX = 64 * 1024 * 1024
WATCH_PERIOD_S = 1.0
PATIENCE_S = 5.0
BACK_IN_TIME = "time goes backwards; such messages are left out (docs/ros2.md says what to do after a reset)"

SENSOR = Qos(5, best_effort=True)
TF_STATIC = Qos(100, transient_local=True)


@dataclass(frozen=True, slots=True)
class Host:
    """What the agent gives the adapter.

    Attributes:
        add_keyframe: Takes (image, T_odom_camera, stamp_s); may wait.
        mount_camera: Told `T_body_camera` once it is known, before the first keyframe.
        trajectory: Gives stamps (s) and (N, 4, 4) corrected body poses of all keyframes; called off the loop's thread.
        add_measurement: Takes what was measured at the keyframe with a stamp (s).
        report: Takes facts for people.
    """

    add_keyframe: Callable[[Image, Float, float], Awaitable[None]]
    mount_camera: Callable[[Float], None]
    trajectory: Callable[[], tuple[list[float], Float]]
    add_measurement: Callable[[Measurement, float], None]
    report: Callable[[Fact], None]


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
        self._synchroniser = Synchroniser(IMAGES_MAX, ODOMETRY_GAP_MAX_S)
        self._static = StaticFrames()
        self._counter = TrafficCounter()
        self._problems = Problems(host.report)
        self._fixes = SatelliteFixes(host.add_measurement)
        self._heard = Counter[str]()
        self._eye: Eye | None = None
        self._T_body_camera: Float | None = None
        self._teller: Teller | None = None
        self._posed = asyncio.Event()
        self._session: Ros2Session | None = None
        self._subscribed: dict[str, Topic] = {}

    def counters(self) -> dict[str, int]:
        """What was dropped or refused, by reason."""
        dropped = {f"ros2 {reason}": n for reason, n in self._synchroniser.dropped.items()}
        waiting = {f"ros2 {reason}": n for reason, n in self._counter.snapshot().dropped.items()}
        fixes = {f"ros2 {reason}": n for reason, n in self._fixes.dropped.items()}
        return {**dropped, **waiting, **fixes, **{f"ros2 {reason}": n for reason, n in self._problems.counts.items()}}

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
            teller = self._teller = await asyncio.to_thread(self._open, inbox, loop)
            async with asyncio.TaskGroup() as tasks:
                works = (self._feed(), self._watch(), teller.draw(), teller.beat())
                others = [tasks.create_task(work) for work in works]
                await teller.listen(corrections)
                for other in others:
                    other.cancel()
        finally:
            if self._session is not None:
                await asyncio.shield(asyncio.to_thread(self._session.close))

    # Opening

    def _open(self, inbox: Inbox, loop: asyncio.AbstractEventLoop) -> Teller:
        config = self._config
        node = "flocc_" + self._robot.replace("-", "_")
        session = self._session = Ros2Session(config.router, config.domain_id, config.namespace, node, self._types)
        teller = Teller(config, self._types, session, self._bodies)
        for kind, (name, type_name, qos) in self._wanted().items():
            self._subscribed[kind] = session.subscribe(name, type_name, qos, partial(_enqueue, inbox, kind))
        session.watch_offers(lambda offer: _on_loop(loop, partial(self._compare, offer)))
        return teller

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
                wanted["tf_static"] = (f"{config.tf_topic}_static", TF, TF_STATIC)
        if config.fix_topic:
            wanted["fix"] = (config.fix_topic, NAV_SAT_FIX, SENSOR)
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
                    self._take_camera_info(message.payload)
                case "fix":
                    self._take_fix(message.payload)
                case "tf_static":
                    self._static.add(self._types.read(message.payload, TF))
        except BadMessage as error:
            self._refuse(message.kind, str(error))

    def _take_camera_info(self, payload: bytes) -> None:
        model = model_of(self._types.read(payload, CAMERA_INFO), self._config.rectified)
        if self._eye is None or self._eye.model != model:
            view_deg = self._config.field_of_view_deg
            self._eye = Eye(model, None if view_deg is None else math.radians(view_deg))

    def _take_odometry(self, payload: bytes) -> None:
        config = self._config
        sample = odometry_of(self._types.read(payload, ODOMETRY), config.odom_frame, config.base_frame)
        if not self._synchroniser.add_odometry(*sample):
            self._complain("odometry", BACK_IN_TIME)
            return
        self._posed.set()
        if self._teller is not None:
            self._teller.place(*sample)

    def _take_image(self, payload: bytes) -> None:
        stamp_ns, frame = header_of(payload)
        wanted = self._config.camera_frame
        if wanted and frame.lstrip("/") != wanted:
            raise BadMessage(f"images are in frame {frame!r}, but the configuration says {wanted!r}")
        if not self._synchroniser.add_image(stamp_ns, payload):
            self._complain("image", BACK_IN_TIME)
            return
        self._posed.set()

    def _take_fix(self, payload: bytes) -> None:
        if not self._fixes.add_fix(fix_of(self._types.read(payload, NAV_SAT_FIX))):
            self._complain("fix", BACK_IN_TIME)

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
                except (BadMessage, BadKeyframe) as error:
                    self._refuse("image", str(error))

    async def _consider(self, posed: PosedImage) -> None:
        if not self._selector.wants(posed.T_odom_body):
            return
        eye = self._eye
        if eye is None:
            self._problems.counts["image without intrinsics"] += 1
            return
        message = self._types.read(posed.payload, COMPRESSED_IMAGE if self._config.is_compressed() else IMAGE)
        T_body_camera = self._mounting(message.header.frame_id.lstrip("/"))
        if T_body_camera is None:
            self._problems.counts["image without mounting"] += 1
            return
        image = await asyncio.to_thread(eye.image, message)
        self._selector.took(posed.T_odom_body)
        await self._host.add_keyframe(image, posed.T_odom_body @ T_body_camera, posed.stamp_ns * 1e-9)
        if self._config.fix_topic:
            self._fixes.add_keyframe(posed.stamp_ns * 1e-9)
        if self._teller is not None:
            self._teller.path_changed = True

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

    def _bodies(self) -> tuple[list[float], Float] | None:
        """The corrected path; None while it is not known where the camera sits on the body."""
        return None if self._config.image_topic and self._T_body_camera is None else self._host.trajectory()

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
                self._host.report(RouterConnected(router=self._config.router, connected=connected))
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
