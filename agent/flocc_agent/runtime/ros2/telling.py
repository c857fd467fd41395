"""Corrections as they go out: transforms and pose with the odometry, path and frame when they change."""

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import Ros2Config
from flocc_agent.core.corrected import CorrectedLog, Correction
from flocc_agent.core.earth_frame import T_earth_map
from flocc_agent.runtime.ros2.diagnostics import diagnostics
from flocc_agent.runtime.ros2.markers import KnownClosure, Markers
from flocc_agent.runtime.ros2.merged_maps import MergedMaps
from flocc_agent.runtime.ros2.node import RosNode, RosPublisher
from flocc_agent.runtime.ros2.outgoing import Outgoing
from flocc_agent.runtime.ros2.topics import Qos
from flocc_agent.runtime.ros2.types import DIAGNOSTICS, MARKERS, PATH, POSE, TEXT, TF, MessageTypes
from flocc_agent.runtime.status import AgentStatus

Float = NDArray[np.float64]

RELIABLE = Qos(10)
TF_QOS = Qos(100)
LATCHED = Qos(1, transient_local=True)
PATH_PAUSE_RATIO = 9.0
MAP_FRAME_TOPIC = "flocc/map_frame"
"""Name of the swarm's map frame, in the namespace; when it changes, every pose jumps."""
GRAPH_TOPIC = "flocc/graph"
DIAGNOSTICS_TOPIC = "/diagnostics"
DIAGNOSTICS_PERIOD_S = 1.0

State = tuple[AgentStatus, Sequence[str], Mapping[str, int]]
"""Status of the robot, warnings of its last solution, and messages of its ROS so far by kind."""
Trajectory = Callable[[], tuple[list[float], Float] | None]
"""Stamps (s) and (N, 4, 4) corrected body poses of all keyframes, None while the body is not known."""


class SwarmKnown(Protocol):
    """What a robot knows of all.

    Attributes:
        closures: Accepted closures of all logs; called off the loop's thread.
        logs: All robots in this robot's map as of now; called on the loop's thread, read off it.
    """

    @property
    def closures(self) -> Callable[[], Sequence[KnownClosure]]:
        """See above."""

    @property
    def logs(self) -> Callable[[], Mapping[str, CorrectedLog]]:
        """See above."""


class Teller:
    """Publishes what corrections say."""

    def __init__(
        self,
        config: Ros2Config,
        types: MessageTypes,
        node: RosNode,
        trajectory: Trajectory,
        swarm: SwarmKnown,
        grids: MergedMaps,
    ) -> None:
        """Declare the publishers.

        Args:
            config: Topics, frames, periods.
            types: Writes messages.
            node: Where to publish.
            trajectory: The corrected path; called off the loop's thread.
            swarm: What this robot knows of all.
            grids: Occupancy grids of all robots.
        """
        self._config = config
        self._outgoing = Outgoing(types, config.map_frame, config.odom_frame)
        self._markers = Markers(types, config.map_frame)
        self._types = types
        self._node = node
        self._trajectory = trajectory
        self._known = swarm
        self._grids = grids
        self._tf = node.publisher(config.tf_topic, TF, TF_QOS)
        self._path = node.publisher(config.path_topic, PATH, LATCHED)
        self._pose = node.publisher(config.pose_topic, POSE, RELIABLE)
        self._map_frame = node.publisher(MAP_FRAME_TOPIC, TEXT, LATCHED)
        self._graph = node.publisher(GRAPH_TOPIC, MARKERS, LATCHED)
        self._diagnostics = node.publisher(DIAGNOSTICS_TOPIC, DIAGNOSTICS, RELIABLE)
        self._correction: Correction | None = None
        self._T_earth_map: Float | None = None
        self._tf_last_ns: int | None = None
        self.path_changed = False

    async def listen(self, corrections: "asyncio.Queue[Correction | None]") -> None:
        """Take corrections until they end."""
        while (correction := await corrections.get()) is not None:
            self._correction = correction
            self._T_earth_map = None if correction.frame_changed else self._T_earth_map
            self._map_frame.put(self._outgoing.text(correction.map_frame))
            self.path_changed = True

    def place(self, stamp_ns: int, T_odom_body: Float) -> None:
        """Publish map to odom, and the pose, as often as configured; the time is that of the odometry."""
        correction = self._correction
        if correction is None:
            return
        if self._tf_last_ns is not None and stamp_ns - self._tf_last_ns < self._config.tf_period_s * 1e9:
            return
        self._tf_last_ns = stamp_ns
        self._put_transform(correction, stamp_ns)
        self._pose.put(self._outgoing.pose(correction.T_map_odom, correction.covariance, T_odom_body, stamp_ns))

    async def beat(self) -> None:
        """Publish map to odom by the clock where no odometry comes by ROS."""
        while not self._config.odometry_topic:
            await asyncio.sleep(self._config.tf_period_s)
            if self._correction is not None:
                self._put_transform(self._correction, self._node.now_ns())

    async def draw(self) -> None:
        """Publish the path when it changed, for at most a tenth of the time: it grows with the run."""
        pause_s = self._config.path_period_s
        while True:
            await asyncio.sleep(pause_s)
            began_s, path_changed, self.path_changed = time.monotonic(), self.path_changed, False
            logs = self._known.logs()
            if path_changed:
                await asyncio.to_thread(_put_one, self._path, self._drawn)
                await asyncio.to_thread(_put_one, self._graph, partial(self._swarm, logs))
                await self._place_on_earth(logs)
            if self._grids.is_due(logs):
                await asyncio.to_thread(self._merge, logs)
                self._grids.complain()
            pause_s = max(self._config.path_period_s, PATH_PAUSE_RATIO * (time.monotonic() - began_s))

    async def diagnose(self, state: Callable[[], State]) -> None:
        """Say how the robot is, once a second."""
        while True:
            status, warnings, heard = state()
            connected, now_ns = await asyncio.to_thread(lambda: (self._node.is_connected(), self._node.now_ns()))
            self._diagnostics.put(diagnostics(self._types, status, warnings, heard, connected, now_ns))
            await asyncio.sleep(DIAGNOSTICS_PERIOD_S)

    async def _place_on_earth(self, logs: Mapping[str, CorrectedLog]) -> None:
        """See where the map lies on Earth; where it became another one meanwhile, it is not known."""
        before = self._correction
        found = await asyncio.to_thread(T_earth_map, logs.values())
        same = before is not None and self._correction is not None and before.map_frame == self._correction.map_frame
        self._T_earth_map = found if same else None

    def _swarm(self, logs: Mapping[str, CorrectedLog]) -> Any:
        """All robots of the map with their closures; None before the first correction."""
        if self._correction is None or not logs:
            return None
        leader = self._correction.term.leader.robot
        return self._markers.array(logs, self._known.closures(), leader, self._node.now_ns())

    def _merge(self, logs: Mapping[str, CorrectedLog]) -> None:
        """Publish the merged occupancy, and hear the grids of robots that have come into the map."""
        self._grids.follow(logs)
        self._grids.publish(logs, self._node.now_ns())

    def _drawn(self) -> Any:
        """The corrected path, thinned evenly, with the last keyframe; None where it is not known yet."""
        known = self._trajectory()
        if known is None or not known[0]:
            return None
        stamps_s, T_map_body = known
        step = -(-len(stamps_s) // self._config.path_poses_max)
        chosen = sorted({*range(0, len(stamps_s), step), len(stamps_s) - 1})
        stamps_ns = [round(stamps_s[i] * 1e6) * 1000 for i in chosen]  # a double holds today's seconds to 0.2 us
        return self._outgoing.path(T_map_body[chosen], stamps_ns, stamps_ns[-1])

    def _put_transform(self, correction: Correction, stamp_ns: int) -> None:
        ahead_ns = round(self._config.tf_tolerance_s * 1e9)
        self._tf.put(self._outgoing.transforms(correction.T_map_odom, self._T_earth_map, stamp_ns + ahead_ns))


def _put_one(publisher: RosPublisher, make: Callable[[], Any]) -> None:
    message = make()
    if message is not None:
        publisher.put(message)
