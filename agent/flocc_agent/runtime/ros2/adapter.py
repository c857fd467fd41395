"""The ROS 2 side of an agent: stamped images and odometry become keyframes, corrections become /tf, path and pose.

The node's threads only enqueue; everything else happens on the event loop. What a robot's messages do wrong is said
once and counted; the agent goes on.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import Ros2Config
from flocc_agent.core.corrected import CorrectedLog, Correction
from flocc_agent.core.interfaces import Image
from flocc_agent.core.measurements import BadMeasurement, Measurement
from flocc_agent.core.reports import Fact
from flocc_agent.runtime.facts import RouterConnected
from flocc_agent.runtime.given_keyframes import BadKeyframe
from flocc_agent.runtime.inbox import Inbox, Incoming
from flocc_agent.runtime.keyframes import KeyframeSelector
from flocc_agent.runtime.ros2.hearing import KINDS, Hearing
from flocc_agent.runtime.ros2.markers import KnownClosure
from flocc_agent.runtime.ros2.merged_maps import MergedMaps
from flocc_agent.runtime.ros2.node import RosNode, ignore, open_node
from flocc_agent.runtime.ros2.problems import Problems
from flocc_agent.runtime.ros2.satellite import SatelliteFixes
from flocc_agent.runtime.ros2.synchroniser import PosedImage
from flocc_agent.runtime.ros2.telling import Teller
from flocc_agent.runtime.ros2.topics import Offer
from flocc_agent.runtime.ros2.types import BadMessage, MessageTypes
from flocc_agent.runtime.status import AgentStatus
from flocc_agent.runtime.transport import TrafficCounter

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]

INBOX_MESSAGES_MAX = 512
INBOX_BYTES_MAX = 64 * 1024 * 1024
WATCH_PERIOD_S = 1.0
PATIENCE_S = 5.0
SERVICE_TIMEOUT_S = 5.0
MISSED = ("odometry", "fix", "image")
"""Kinds of which each message counts."""
LOST_MIN, LOST_RATIO_MAX = 10, 0.01
"""Fewer lost messages are not worth a sentence."""
LOST_BEFORE = (
    "messages are lost before they reach this node, by best effort or too short a queue; where they matter: "
    "--ros-args -p qos_overrides (docs/ros2.md)"
)
TOO_FAST = (
    "messages come faster than this machine takes them in, and the oldest are left out; "
    "play slower, or take fewer keyframes"
)


@dataclass(frozen=True, slots=True)
class Host:
    """What the agent gives the adapter.

    Attributes:
        add_keyframe: Takes (image, T_odom_camera, stamp_s); may wait.
        mount_camera: Told `T_body_camera` once it is known, before the first keyframe.
        trajectory: Gives stamps (s) and (N, 4, 4) corrected body poses of all keyframes; called off the loop's thread.
        add_measurement: Takes what was measured at the keyframe with a stamp (s).
        report: Takes facts for people.
        save_map: Writes what the robot knows, and says where; raises OSError.
        begin_anew: Ends this journey and begins another one, of odometry that has nothing to do with this one's.
        closures: Accepted closures of all logs; called off the loop's thread.
        state: Status of the robot, and what its last own solution warned of.
        logs: All robots in this robot's map as of now; read off the loop's thread.
    """

    add_keyframe: Callable[[Image, Float, float], Awaitable[None]]
    mount_camera: Callable[[Float], None]
    trajectory: Callable[[], tuple[list[float], Float]]
    add_measurement: Callable[[Measurement, float], None]
    report: Callable[[Fact], None]
    save_map: Callable[[], str]
    begin_anew: Callable[[], None]
    closures: Callable[[], Sequence[KnownClosure]]
    state: Callable[[], tuple[AgentStatus, Sequence[str]]]
    logs: Callable[[], Mapping[str, CorrectedLog]]


class Ros2Adapter:
    """One robot's ROS 2 side; `run` until it is cancelled."""

    def __init__(
        self,
        config: Ros2Config,
        robot: str,
        selector: KeyframeSelector,
        host: Host,
        ros_args: Sequence[str] = (),
    ) -> None:
        """Prepare; nothing is opened yet.

        Args:
            config: Topics, frames, middleware.
            robot: Name of the robot.
            selector: Says which images become keyframes.
            host: The agent.
            ros_args: What stands behind `--ros-args`.

        Raises:
            Ros2Error: The extra is not installed.
        """
        self._config = config
        self._robot = robot
        self._selector = selector
        self._host = host
        self._ros_args = ros_args
        self._types = MessageTypes()
        self._counter = TrafficCounter()
        self._problems = Problems(host.report)
        self._fixes = SatelliteFixes(host.add_measurement)
        self._hearing: Hearing | None = None
        self._teller: Teller | None = None
        self._posed = asyncio.Event()
        self._node: RosNode | None = None

    def counters(self) -> dict[str, int]:
        """What was dropped or refused, by reason."""
        lost = self._hearing.synchroniser.dropped if self._hearing is not None else {}
        kinds = (lost, self._counter.snapshot().dropped, self._fixes.dropped, self._problems.counts)
        return {f"ros2 {reason}": n for counts in kinds for reason, n in counts.items()}

    async def run(self, corrections: "asyncio.Queue[Correction | None]") -> None:
        """Open the node, live until the corrections end, close it.

        Raises:
            TransportError: The session cannot be opened as configured.
            Ros2Error: ROS does not start.
        """
        loop = asyncio.get_running_loop()
        limits = (INBOX_MESSAGES_MAX, INBOX_BYTES_MAX)
        inbox = Inbox(loop, self._arrived, self._counter, *limits, urgent_first=KINDS)
        try:
            node, hearing, teller = await asyncio.to_thread(self._open, inbox, loop)
            for note in node.notes:
                hearing.complain("node", note)
            async with asyncio.TaskGroup() as tasks:
                telling = (teller.draw(), teller.beat(), teller.diagnose(lambda: (*self._host.state(), hearing.heard)))
                works = (self._feed(hearing), self._watch(node, hearing), *telling)
                others = [tasks.create_task(work) for work in works]
                await teller.listen(corrections)
                for other in others:
                    other.cancel()
        finally:
            if self._node is not None:
                await asyncio.shield(asyncio.to_thread(self._node.close))

    # Opening

    def _open(self, inbox: Inbox, loop: asyncio.AbstractEventLoop) -> tuple[RosNode, Hearing, Teller]:
        name = "flocc_" + self._robot.replace("-", "_")
        node = self._node = open_node(self._config, name, self._ros_args, self._types)
        config = self._config = node.config
        hearing = self._hearing = self._heard(config)
        grids = MergedMaps(config, self._robot, self._types, node, self._problems)
        teller = self._teller = Teller(config, self._types, node, self._bodies, self._host, grids)
        for kind, (topic, type_name, qos) in hearing.wanted().items():
            lost = partial(self._counter.count_dropped, f"{kind} lost before this node")
            missing = lost if kind in MISSED else ignore
            hearing.subscribed[kind] = node.subscribe(topic, type_name, qos, partial(_enqueue, inbox, kind), missing)
        node.watch_offers(lambda offer: _on_loop(loop, partial(self._compare, offer)))
        node.serve("save_map", partial(_answered, loop, self._save_map))
        node.serve("reset_odometry", partial(_answered, loop, self._reset_odometry))
        return node, hearing, teller

    def _heard(self, config: Ros2Config) -> Hearing:
        return Hearing(config, self._types, self._problems, self._fixes, self._host.mount_camera)

    # What comes

    def _arrived(self, message: Incoming) -> None:
        assert self._hearing is not None
        if not self._hearing.take(message.kind, message.payload):
            return
        self._posed.set()
        if message.kind == "odometry" and self._teller is not None and self._hearing.synchroniser.latest is not None:
            self._teller.place(*self._hearing.synchroniser.latest)

    def _compare(self, offer: Offer) -> None:
        if self._hearing is not None:
            self._hearing.compare(offer)

    def _save_map(self) -> tuple[bool, str]:
        try:
            return True, self._host.save_map()
        except OSError as error:
            return False, str(error)

    def _reset_odometry(self) -> tuple[bool, str]:
        self._host.begin_anew()
        return True, "the robot begins another journey; what it saw so far stays in the map"

    # Keyframes

    async def _feed(self, hearing: Hearing) -> None:
        """Turn images into keyframes, one after the other."""
        while True:
            await self._posed.wait()
            self._posed.clear()
            while (posed := hearing.next_wanted(self._selector)) is not None:
                try:
                    await self._add(hearing, posed)
                except BadMessage as error:
                    self._selector.missed()
                    hearing.refuse("image", str(error))
                except (BadKeyframe, BadMeasurement) as error:
                    hearing.refuse("image", str(error))

    async def _add(self, hearing: Hearing, posed: PosedImage) -> None:
        """Make a keyframe of an image whose camera is known."""
        eye, T_body_camera = hearing.eye, hearing.T_body_camera
        assert eye is not None
        assert T_body_camera is not None
        message = self._types.read(posed.payload, hearing.image_type())
        image = await asyncio.to_thread(eye.image, message)
        await self._host.add_keyframe(image, posed.T_odom_body @ T_body_camera, posed.stamp_ns * 1e-9)
        told = hearing.covariances.of_keyframe(posed.stamp_ns, posed.T_odom_body)
        unmeasured = hearing.steps.of_keyframe(posed.stamp_ns * 1e-9)
        if unmeasured is not None:
            logger.warning("odometry paused or jumped; loop closures decide where the robot was")
        if (step := unmeasured or told) is not None:
            self._host.add_measurement(step.in_camera(T_body_camera), posed.stamp_ns * 1e-9)
        if self._config.fix_topic:
            self._fixes.add_keyframe(posed.stamp_ns * 1e-9)
        if self._teller is not None:
            self._teller.path_changed = True

    def _bodies(self) -> tuple[list[float], Float] | None:
        """The corrected path; None while it is not known where the camera sits on the body."""
        unknown = self._hearing is None or self._hearing.T_body_camera is None
        return None if self._config.image_topic and unknown else self._host.trajectory()

    # What is wrong

    async def _watch(self, node: RosNode, hearing: Hearing) -> None:
        """Say when the others come and go, and what the first image still waits for."""
        connected, waited_s = False, 0.0
        while True:
            await asyncio.sleep(WATCH_PERIOD_S)
            waited_s += WATCH_PERIOD_S
            if node.is_connected() != connected:
                connected = not connected
                self._host.report(RouterConnected(router=node.where, connected=connected))
                logger.info("ROS 2: %s to %s", "connected" if connected else "no longer connected", node.where)
            if waited_s == PATIENCE_S and not connected:
                hearing.complain("router", node.advice)
            if waited_s % PATIENCE_S == 0 and connected:
                hearing.say_what_is_missing()
                self._say_what_is_lost(hearing)
                hearing.compare_clocks(node.now_ns())

    def _say_what_is_lost(self, hearing: Hearing) -> None:
        """Say of images and odometry that more than a few do not make it into the agent; counts go on in `refused`."""
        dropped = self._counter.snapshot().dropped
        for kind in ("image", "odometry"):
            before = dropped.get(f"{kind} lost before this node", 0)
            if before > max(LOST_MIN, LOST_RATIO_MAX * (hearing.heard[kind] + before)):
                hearing.complain(kind, LOST_BEFORE)
            late = hearing.synchroniser.dropped[f"{kind} not taken in time"] + dropped.get(f"inbox-full-{kind}", 0)
            if late:
                hearing.complain(kind, TOO_FAST)


def _enqueue(inbox: Inbox, kind: str, payload: bytes) -> None:
    inbox.put(Incoming("", kind, payload))


def _on_loop(loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
    try:
        loop.call_soon_threadsafe(call)
    except RuntimeError:  # the loop is closed: nobody listens any more
        return


def _answered(loop: asyncio.AbstractEventLoop, act: Callable[[], tuple[bool, str]]) -> tuple[bool, str]:
    """Do something on the loop's thread and wait for what it says."""

    async def acted() -> tuple[bool, str]:
        return act()

    try:
        return asyncio.run_coroutine_threadsafe(acted(), loop).result(SERVICE_TIMEOUT_S)
    except (TimeoutError, RuntimeError):
        return False, "the agent is busy, or ends"
