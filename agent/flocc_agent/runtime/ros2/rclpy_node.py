"""A node of the robot's own ROS, by rclpy, with whatever middleware that has. rclpy is never a dependency of flocc.

Messages are taken and given as CDR, so all that is said of them elsewhere holds here, too. The executor spins on a
thread of its own; callbacks only enqueue. The node is a lifecycle node that activates itself, unless the parameter
`autostart` is false: then a manager configures and activates it, and while it is inactive nothing goes in or out.
"""

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from typing import Any, cast

import rclpy
from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions

from flocc_agent.config import Ros2Config, validated
from flocc_agent.runtime.ros2.missed import Missing
from flocc_agent.runtime.ros2.node import Act, OnMissing, OnPayload, ignore
from flocc_agent.runtime.ros2.topics import Offer, Qos, Topic
from flocc_agent.runtime.ros2.types import MessageTypes, Ros2Error

logger = logging.getLogger(__name__)

LOOK_S = 1.0
ENDPOINTS_MAX = 1024
DRAIN_MAX = 64
FIXED = ("middleware", "router", "domain_id", "namespace")
"""Keys that are no ROS parameters: ROS has its own words for them (`__ns`, ROS_DOMAIN_ID)."""


class ManagedNode(LifecycleNode):  # type: ignore[misc]
    """The node itself; `is_active` is what its manager last said."""

    is_active = False

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let messages through."""
        self.is_active = True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Hold messages back."""
        self.is_active = False
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Hold messages back for good."""
        self.is_active = False
        return super().on_shutdown(state)


class RclpyPublisher:
    """A publisher; of a type that this ROS does not have, it publishes nothing."""

    def __init__(self, node: ManagedNode, publisher: Any, types: MessageTypes) -> None:
        self._node = node
        self._publisher = publisher
        self._types = types

    def put(self, message: Any) -> None:
        """Serialise and publish a message."""
        if self._publisher is not None and self._node.is_active:
            try:
                self._publisher.publish(self._types.written(message))
            except RuntimeError:  # rclpy's word for a context that has ended meanwhile
                self._publisher = None


class RclpyNode:
    """The node, its context and its executor."""

    def __init__(self, config: Ros2Config, name: str, ros_args: Sequence[str], types: MessageTypes) -> None:
        """Open; parameters, remappings, namespace and time are those that ROS was started with.

        Raises:
            Ros2Error: ROS does not take the arguments, or its environment (ROS_DOMAIN_ID) is wrong.
            ConfigError: A parameter is no value of its key.
        """
        self._types = types
        self._context = Context()
        self._on_offer: Callable[[Offer], None] = lambda _: None
        self._subscribed: list[tuple[Topic, Any]] = []
        self._seen: set[tuple[str, ...]] = set()
        self.notes: list[str] = []
        try:
            with _in_words():
                rclpy.init(
                    args=["--ros-args", *ros_args] if ros_args else None,
                    context=self._context,
                    domain_id=config.domain_id,
                    signal_handler_options=SignalHandlerOptions.NO,
                )
                self._node = ManagedNode(name, context=self._context, namespace=config.namespace or None)
                self.config = self._with_parameters(config)
                activates_itself = self._node.declare_parameter("autostart", True).value
        except Ros2Error:
            self._context.try_shutdown()
            raise
        middleware = rclpy.get_rmw_implementation_identifier()
        self.where = (
            f"{middleware}, domain {self._context.get_domain_id()}, node {self._node.get_fully_qualified_name()}"
        )
        self.advice = "no other node is seen; do ROS_DOMAIN_ID and RMW_IMPLEMENTATION fit the robot's?"
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._node.create_timer(LOOK_S, self._look, clock=rclpy.clock.Clock())
        self._thread = threading.Thread(target=self._spin, name="rclpy", daemon=True)
        if activates_itself:
            self._node.trigger_configure()
            self._node.trigger_activate()
        self._thread.start()

    def _with_parameters(self, config: Ros2Config) -> Ros2Config:
        """Declare each key as a parameter that is read once, and take what ROS says of it."""
        fields = dict(config)
        read_only = rclpy.node.ParameterDescriptor(dynamic_typing=True, read_only=True)
        for key in [key for key, field in Ros2Config.model_fields.items() if not field.exclude and key not in FIXED]:
            given = list(fields[key]) if isinstance(fields[key], tuple) else fields[key]
            told = self._node.declare_parameter(key, given, read_only)
            if told.type_ is not Parameter.Type.NOT_SET:
                fields[key] = tuple(told.value) if told.type_ is Parameter.Type.DOUBLE_ARRAY else told.value
        return validated(Ros2Config, fields, "--ros-args")

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            logger.info("ROS 2: the context was shut down")

    def publisher(self, topic: str, type_name: str, qos: Qos) -> RclpyPublisher:
        """Declare a publisher; of a type that this ROS does not have, a silent one."""
        kind = self._kind(type_name, f"{topic} is not published")
        overrides = QoSOverridingOptions.with_default_policies()
        with _in_words():
            made = kind and self._node.create_publisher(kind, topic, profile(qos), qos_overriding_options=overrides)
        return RclpyPublisher(self._node, made, self._types)

    def subscribe(
        self, topic: str, type_name: str, qos: Qos, on_payload: OnPayload, on_missing: OnMissing = ignore
    ) -> Topic:
        """Declare a subscription; while the node is inactive only transient local messages pass."""
        kind = self._kind(type_name, f"{topic} is not read")
        named = Topic(self._node.resolve_topic_name(topic), type_name, self._types.hash(type_name), qos)

        made: Any = None
        missed = Missing()

        def count(missing: int) -> None:
            if missing and self._node.is_active:
                on_missing(missing)

        def take(payload: bytes, info: Any) -> None:
            """Pass a message on, and those behind it: the executor gives one each time it has waited, which is slow."""
            waiting, taken = DRAIN_MAX, cast(tuple[bytes, Any] | None, (payload, info))
            while taken is not None:
                count(missed.heard(*_sender_of(taken[1])))
                if self._node.is_active or qos.transient_local:
                    on_payload(taken[0])
                waiting -= 1
                taken = made.handle.take_message(kind, True) if waiting else None

        def made_with(events: SubscriptionEventCallbacks | None) -> Any:
            overrides = QoSOverridingOptions.with_default_policies()
            return self._node.create_subscription(
                kind, topic, take, profile(qos), event_callbacks=events, raw=True, qos_overriding_options=overrides
            )

        if kind is not None:
            with _in_words():
                try:
                    told = SubscriptionEventCallbacks(message_lost=lambda said: count(missed.lost(said.total_count)))
                    made = made_with(told)
                except UnsupportedEventTypeError:
                    made = made_with(None)
            self._subscribed.append((named, made))
        return named

    def serve(self, name: str, act: Act) -> None:
        """Offer a std_srvs/Trigger service, `~/name`."""
        kind = self._kind("std_srvs/srv/Trigger", f"the service {name} is not offered")
        if kind is not None:
            self._node.create_service(kind, f"~/{name}", partial(_answer, act))

    def watch_offers(self, on_offer: Callable[[Offer], None]) -> None:
        """Tell of the publishers of subscribed topics, looked at once a second."""
        self._on_offer = on_offer

    def is_connected(self) -> bool:
        """Whether another node is seen."""
        return len(self._node.get_node_names()) > 1

    def now_ns(self) -> int:
        """The node's time; 0 while simulated time has not begun."""
        return int(self._node.get_clock().now().nanoseconds)

    def close(self) -> None:
        """End the executor, then the node and its context."""
        self._executor.shutdown(timeout_sec=2.0)
        self._thread.join(2.0)
        self._node.destroy_node()
        self._context.try_shutdown()

    def _kind(self, type_name: str, consequence: str) -> Any:
        """The class of a type; None, with a note, where this ROS does not have its package."""
        package, folder, name = type_name.split("/")
        try:
            return getattr(import_module(f"{package}.{folder}"), name)
        except ImportError:
            self.notes.append(
                f"this ROS has no {package}, so {consequence}: apt install ros-$ROS_DISTRO-{package.replace('_', '-')}"
            )
            return None

    def _look(self) -> None:
        """Tell of publishers that were not seen before."""
        for topic, subscription in self._subscribed:
            for end in self._node.get_publishers_info_by_topic(topic.name):
                key = (topic.name, ".".join(f"{byte:02x}" for byte in end.endpoint_gid))
                if key in self._seen or len(self._seen) >= ENDPOINTS_MAX:
                    continue
                self._seen.add(key)
                fit, reason = qos_check_compatible(end.qos_profile, subscription.qos_profile)
                misfit = "" if fit != QoSCompatibility.ERROR else _misfit(end.qos_profile, subscription, reason)
                hashed = str(getattr(end, "topic_type_hash", ""))
                node = f"{end.node_namespace.rstrip('/')}/{end.node_name}"
                known = hashed if hashed.startswith("RIHS01_") else topic.hash
                self._on_offer(Offer(node, topic.name, end.topic_type, known, misfit))


@contextmanager
def _in_words() -> Iterator[None]:
    """What ROS does not take of its arguments and parameters, in one sentence.

    Raises:
        Ros2Error: It did not take something.
    """
    try:
        yield
    except (RuntimeError, ParameterException, ValueError) as error:
        told = str(error).split(", at /")[0]
        told = f"it does not know the arguments {told}" if told.startswith("[") else told  # rclpy only lists them
        raise Ros2Error(f"ROS 2 does not start: {told}") from error


def _sender_of(info: Any) -> tuple[bytes | None, int | None]:
    """Who published a message, and its number; None where the middleware, or an older rclpy, does not say it."""
    told = info if isinstance(info, dict) else {}
    gid = told.get("publisher_gid") or {}
    return gid.get("data"), told.get("publication_sequence_number")


def profile(qos: Qos) -> QoSProfile:
    """A quality of service as rclpy says it."""
    return QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if qos.best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if qos.transient_local else DurabilityPolicy.VOLATILE,
    )


def _misfit(offered: QoSProfile, subscription: Any, reason: str) -> str:
    def words(of: QoSProfile) -> str:
        return f"{of.reliability.name.lower()}, {of.durability.name.lower()}"

    asked = words(subscription.qos_profile)
    return f"offers it as {words(offered)}, which does not fit {asked} ({reason.strip().rstrip(';')})"


def _answer(act: Act, _: Any, response: Any) -> Any:
    response.success, response.message = act()
    return response
