"""Corrections as they go out: transform and pose with the odometry, path and frame when they change."""

import asyncio
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import Ros2Config
from flocc_agent.core.corrected import Correction
from flocc_agent.runtime.ros2.node import RosNode, RosPublisher
from flocc_agent.runtime.ros2.outgoing import Outgoing
from flocc_agent.runtime.ros2.topics import Qos
from flocc_agent.runtime.ros2.types import PATH, POSE, TEXT, TF, MessageTypes

Float = NDArray[np.float64]

RELIABLE = Qos(10)
TF_QOS = Qos(100)
LATCHED = Qos(1, transient_local=True)
PATH_PAUSE_RATIO = 9.0
MAP_FRAME_TOPIC = "flocc/map_frame"
"""Name of the swarm's map frame, in the namespace; when it changes, every pose jumps."""

Trajectory = Callable[[], tuple[list[float], Float] | None]
"""Stamps (s) and (N, 4, 4) corrected body poses of all keyframes, None while the body is not known."""


class Teller:
    """Publishes what corrections say."""

    def __init__(self, config: Ros2Config, types: MessageTypes, node: RosNode, trajectory: Trajectory) -> None:
        """Declare the publishers.

        Args:
            config: Topics, frames, periods.
            types: Writes messages.
            node: Where to publish.
            trajectory: The corrected path; called off the loop's thread.
        """
        self._config = config
        self._outgoing = Outgoing(types, config.map_frame, config.odom_frame)
        self._trajectory = trajectory
        self._tf = node.publisher(config.tf_topic, TF, TF_QOS)
        self._path = node.publisher(config.path_topic, PATH, LATCHED)
        self._pose = node.publisher(config.pose_topic, POSE, RELIABLE)
        self._map_frame = node.publisher(MAP_FRAME_TOPIC, TEXT, LATCHED)
        self._correction: Correction | None = None
        self._tf_last_ns: int | None = None
        self.path_changed = False

    async def listen(self, corrections: "asyncio.Queue[Correction | None]") -> None:
        """Take corrections until they end."""
        while (correction := await corrections.get()) is not None:
            self._correction = correction
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

    async def beat(self, node: RosNode) -> None:
        """Publish map to odom by the clock where no odometry comes by ROS."""
        while not self._config.odometry_topic:
            await asyncio.sleep(self._config.tf_period_s)
            if self._correction is not None:
                self._put_transform(self._correction, node.now_ns())

    async def draw(self) -> None:
        """Publish the path when it changed, for at most a tenth of the time: it grows with the run."""
        pause_s = self._config.path_period_s
        while True:
            await asyncio.sleep(pause_s)
            if not self.path_changed:
                continue
            self.path_changed = False
            began_s = time.monotonic()
            await asyncio.to_thread(_put_one, self._path, self._drawn)
            pause_s = max(self._config.path_period_s, PATH_PAUSE_RATIO * (time.monotonic() - began_s))

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
        self._tf.put(self._outgoing.transform(correction.T_map_odom, stamp_ns + ahead_ns))


def _put_one(publisher: RosPublisher, make: Callable[[], Any]) -> None:
    message = make()
    if message is not None:
        publisher.put(message)
