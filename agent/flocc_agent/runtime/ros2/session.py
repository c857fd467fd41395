"""One zenoh session as rmw_zenoh opens it, with one node in it: publishers, subscriptions, what others publish.

Beside the agent's own two sessions, because it goes to another network: the router and the nodes of this robot's ROS.
Callbacks run on zenoh's threads and may only enqueue.
"""

import os
import time
from collections.abc import Callable
from typing import Any

import zenoh
import zenoh.ext

from flocc_agent.config import Ros2Config
from flocc_agent.runtime.ros2.missed import Missing
from flocc_agent.runtime.ros2.node import Act, OnMissing, OnPayload, ignore
from flocc_agent.runtime.ros2.topics import (
    EntityRole,
    Node,
    Offer,
    Qos,
    Topic,
    answer_attachment,
    attachment,
    full_name,
    offers_of,
    read_offer,
    sender_of,
)
from flocc_agent.runtime.ros2.types import TRIGGER, TRIGGER_HASH, MessageTypes, domain_of, gid_of, trigger_response
from flocc_agent.runtime.zenoh_session import open_session

MESSAGE_BYTES_MAX = 64 * 1024 * 1024
LEASE_S = 60.0
HEARTBEAT_S = 0.5


def session_settings(router: str) -> dict[str, Any]:
    """Zenoh's settings, by zenoh's path: those of rmw_zenoh's own sessions."""
    return {
        "mode": "peer",
        "connect/endpoints": [router],
        "listen/endpoints": ["tcp/localhost:0"],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "timestamping/enabled": True,
        "adminspace/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": round(LEASE_S * 1000),
        "transport/link/rx/max_message_size": MESSAGE_BYTES_MAX,
    }


class Publisher:
    """A publisher of the node."""

    def __init__(self, session: zenoh.Session, topic: Topic, domain_id: int, token: str, types: MessageTypes) -> None:
        self.topic = topic
        self._types = types
        self._gid = gid_of(token)
        self._count = 0
        self._token = session.liveliness().declare_token(token)
        key, drop = topic.key(domain_id), zenoh.CongestionControl.DROP
        self._publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher
        if topic.qos.transient_local:
            self._publisher = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                congestion_control=drop,
                cache=zenoh.ext.CacheConfig(topic.qos.depth),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
                publisher_detection=True,
            )
        else:
            self._publisher = session.declare_publisher(key, congestion_control=drop)

    def put(self, message: Any) -> None:
        """Serialise and publish a message; long ones may wait for the link for 50 ms."""
        self._count += 1
        attached = attachment(self._count, time.time_ns(), self._gid)
        self._publisher.put(self._types.written(message), attachment=attached)


class Ros2Session:
    """The session and its node."""

    def __init__(self, config: Ros2Config, name: str, types: MessageTypes) -> None:
        """Open; blocks for up to half a second, also where no router is there: zenoh goes on dialling.

        Raises:
            TransportError: The settings cannot be used.
            Ros2Error: ROS_DOMAIN_ID is no number.
        """
        self.config = config
        self.where = config.router
        self.advice = f"nobody answers at {config.router}; is rmw_zenohd running?"
        self.notes: list[str] = []
        self._types = types
        domain_id = domain_of(os.environ) if config.domain_id is None else config.domain_id
        self._session = open_session(session_settings(config.router), f"ROS 2 node {name}")
        namespace = full_name("", config.namespace) if config.namespace else ""
        self._node = Node(domain_id, str(self._session.zid()), namespace, name)
        self._numbers = 0
        self._kept: list[object] = [self._session.liveliness().declare_token(self._node.token())]

    def publisher(self, topic: str, type_name: str, qos: Qos) -> Publisher:
        """Declare a publisher; relative topics lie in the node's namespace."""
        described = self._topic(topic, type_name, qos)
        token = self._token(EntityRole.PUBLISHES, described)
        return Publisher(self._session, described, self._node.domain_id, token, self._types)

    def subscribe(
        self, topic: str, type_name: str, qos: Qos, on_payload: OnPayload, on_missing: OnMissing = ignore
    ) -> Topic:
        """Declare a subscription; of a transient local topic the last messages come first."""
        missed = Missing()

        def take(sample: zenoh.Sample) -> None:
            missing = missed.heard(*sender_of(sample.attachment.to_bytes() if sample.attachment else None))
            if missing:
                on_missing(missing)
            on_payload(sample.payload.to_bytes())

        described = self._topic(topic, type_name, qos)
        key = described.key(self._node.domain_id)
        token = self._session.liveliness().declare_token(self._token(EntityRole.SUBSCRIBES, described))
        subscriber: object
        if qos.transient_local:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth)
            subscriber = zenoh.ext.declare_advanced_subscriber(self._session, key, take, history=history)
        else:
            subscriber = self._session.declare_subscriber(key, take, allowed_origin=zenoh.Locality.REMOTE)
        self._kept += [token, subscriber]
        return described

    def serve(self, name: str, act: Act) -> None:
        """Offer a std_srvs/Trigger service, `~/name`."""
        own = f"{self._node.namespace}/{self._node.name}/{name}"
        service = Topic(own, TRIGGER, TRIGGER_HASH, Qos(10))

        def answer(query: zenoh.Query) -> None:
            worked, said = act()
            attached = answer_attachment(query.attachment.to_bytes() if query.attachment else b"", time.time_ns())
            if attached is not None:
                query.reply(query.key_expr, trigger_response(worked, said), attachment=attached)
            query.drop()

        key = service.key(self._node.domain_id)
        token = self._session.liveliness().declare_token(self._token(EntityRole.SERVES, service))
        self._kept += [token, self._session.declare_queryable(key, answer, complete=True)]

    def watch_offers(self, on_offer: Callable[[Offer], None]) -> None:
        """Tell of every publisher in the domain, those that are there first."""

        def read(sample: zenoh.Sample) -> None:
            offer = read_offer(str(sample.key_expr)) if sample.kind == zenoh.SampleKind.PUT else None
            if offer is not None:
                on_offer(offer)

        pattern = offers_of(self._node.domain_id)
        self._kept.append(self._session.liveliness().declare_subscriber(pattern, read, history=True))

    def is_connected(self) -> bool:
        """Whether a router, or another node, is linked."""
        info = self._session.info
        return bool(info.routers_zid() or info.peers_zid())

    def now_ns(self) -> int:
        """The computer's time."""
        return time.time_ns()

    def close(self) -> None:
        """Close; blocks for a moment."""
        self._session.close()

    def _topic(self, topic: str, type_name: str, qos: Qos) -> Topic:
        inside = topic.replace("~", self._node.name, 1) if topic.startswith("~/") else topic
        return Topic(full_name(self._node.namespace, inside), type_name, self._types.hash(type_name), qos)

    def _token(self, role: EntityRole, topic: Topic) -> str:
        self._numbers += 1
        return self._node.endpoint_token(self._numbers, role, topic)
