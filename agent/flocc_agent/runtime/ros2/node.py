"""What the adapter needs of a ROS 2 node, whatever speaks for it: rclpy (`rclpy_node`) or zenoh (`session`).

Messages are CDR on both ways, and the messages themselves are rosbags'. Nothing here knows zenoh, rclpy or asyncio.
"""

import logging
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from flocc_agent.config import Ros2Config
from flocc_agent.runtime.ros2.topics import Offer, Qos, Topic
from flocc_agent.runtime.ros2.types import MessageTypes, Ros2Error, domain_of

logger = logging.getLogger(__name__)

OnPayload = Callable[[bytes], None]
OnMissing = Callable[[int], None]
"""Told how many messages of a publisher are missing before the one that came."""
Act = Callable[[], tuple[bool, str]]
"""What a service does: whether it worked, and a sentence. Called on the node's own thread."""


def ignore(_: int) -> None:
    """Where nobody asks what is missing."""


class RosPublisher(Protocol):
    """A publisher of the node."""

    def put(self, message: Any) -> None:
        """Publish a message; any thread may call."""


class RosNode(Protocol):
    """One node: its callbacks run on threads of its own, and may only enqueue.

    Attributes:
        config: As configured, after the parameters that ROS was started with.
        where: With whom it speaks, for people.
        advice: What to look at when nobody answers.
        notes: What it cannot do, each with what to do; said by the adapter.
    """

    config: Ros2Config
    where: str
    advice: str
    notes: list[str]

    def publisher(self, topic: str, type_name: str, qos: Qos) -> RosPublisher:
        """Declare a publisher; relative topics lie in the node's namespace."""

    def subscribe(
        self, topic: str, type_name: str, qos: Qos, on_payload: OnPayload, on_missing: OnMissing = ignore
    ) -> Topic:
        """Declare a subscription; of a transient local topic the last messages come first."""

    def serve(self, name: str, act: Act) -> None:
        """Offer a std_srvs/Trigger service, `~/name`."""

    def watch_offers(self, on_offer: Callable[[Offer], None]) -> None:
        """Tell of every publisher, those that are there first."""

    def is_connected(self) -> bool:
        """Whether anybody else is there."""

    def now_ns(self) -> int:
        """The node's time: simulated where ROS says so; 0 while that has not begun."""

    def close(self) -> None:
        """Close; blocks for a moment."""


def open_node(config: Ros2Config, name: str, ros_args: Sequence[str], types: MessageTypes) -> RosNode:
    """Open a node with what the configuration wants; the first line says what was taken, and why.

    Raises:
        Ros2Error: rclpy is wanted and cannot be used, arguments were given that only rclpy reads, or the environment's
            ROS_DOMAIN_ID is no number.
        TransportError: zenoh's session cannot be opened as configured.
    """
    if config.domain_id is None:
        domain_of(os.environ)  # a bad one ends the process inside of Fast DDS
    fault = None if config.middleware == "rmw_zenoh" else middleware_fault(os.environ)
    if config.middleware != "rmw_zenoh" and fault is None:
        try:
            from flocc_agent.runtime.ros2.rclpy_node import RclpyNode
        except ImportError as error:
            fault = _import_fault(error)
        else:
            node = RclpyNode(config, name, ros_args, types)
            why = "as configured" if config.middleware == "rclpy" else "it can be imported"
            logger.info("ROS 2: rclpy, %s (%s)", node.where, why)
            return node
    if config.middleware == "rclpy":
        raise Ros2Error(f"ros2.middleware is 'rclpy', but {fault}")
    if ros_args:
        raise Ros2Error(f"--ros-args needs rclpy, but {fault or 'ros2.middleware is rmw_zenoh'}")
    from flocc_agent.runtime.ros2.session import Ros2Session

    logger.info("ROS 2: rmw_zenoh by the agent's own zenoh, %s (%s)", config.router, fault or "as configured")
    return Ros2Session(config, name, types)


def middleware_fault(environment: Mapping[str, str]) -> str | None:
    """Why rclpy must not even be imported here: an unfit RMW_IMPLEMENTATION ends the process inside of rcl."""
    wanted = environment.get("RMW_IMPLEMENTATION", "")
    folders = [Path(folder) for folder in environment.get("LD_LIBRARY_PATH", "").split(os.pathsep) if folder]
    if wanted and folders and not any((folder / f"lib{wanted}.so").exists() for folder in folders):
        return f"RMW_IMPLEMENTATION is {wanted}, and no folder of LD_LIBRARY_PATH has it; install or unset it"
    return None


def _import_fault(error: ImportError) -> str:
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    if error.name == "rclpy":
        return "no rclpy is here: source the robot's ROS first (setup.bash)"
    return f"rclpy cannot be imported ({str(error).splitlines()[0]}); is it of another Python than this {version}?"
