"""A ROS 2 node and its router as rmw_zenoh's design document describes them, on raw zenoh.

Neither flocc nor rosbags nor ROS is used here.
"""

import json
import time
from collections import defaultdict
from dataclasses import dataclass

import xxhash
import zenoh
import zenoh.ext
from tests.agent.runtime.ros2.cdr_by_hand import type_hash


def open_raw(settings: dict[str, object]) -> zenoh.Session:
    """A zenoh session with the given settings, and neither scouting nor shared memory."""
    config = zenoh.Config()
    quiet = {
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
    }
    for path, value in {**quiet, **settings}.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def open_router(port: int) -> zenoh.Session:
    """What rmw_zenohd is to the nodes: a router that they dial."""
    return open_raw({"mode": "router", "listen/endpoints": [f"tcp/127.0.0.1:{port}"]})


@dataclass(frozen=True, slots=True)
class Received:
    """One sample as it came."""

    payload: bytes
    attachment: bytes | None


class RawNode:
    """Publishes and subscribes; what came is kept by topic."""

    def __init__(self, port: int, domain_id: int = 0, name: str = "driver", namespace: str = "") -> None:
        self.session = open_raw(
            {"mode": "peer", "connect/endpoints": [f"tcp/127.0.0.1:{port}"], "listen/endpoints": ["tcp/127.0.0.1:0"]}
        )
        self.domain_id = domain_id
        self.received: dict[str, list[Received]] = defaultdict(list)
        self.tokens: set[str] = set()
        self._place = f"@ros2_lv/{domain_id}/{self.session.zid()}/0"
        self._name = f"%/{namespace.replace('/', '%') or '%'}/{name}"
        self._count = 0
        self._publishers: dict[str, tuple[bytes, list[int], zenoh.Publisher | zenoh.ext.AdvancedPublisher]] = {}
        liveliness = self.session.liveliness()
        self._kept: list[object] = [liveliness.declare_token(f"{self._place}/0/NN/{self._name}")]
        self._kept.append(liveliness.declare_subscriber(f"@ros2_lv/{domain_id}/**", self._on_token, history=True))

    def __enter__(self) -> "RawNode":
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            self.tokens.add(key)
        else:
            self.tokens.discard(key)

    def advertise(self, topic: str, kind: str, latched: bool = False, hash_: str | None = None) -> None:
        """Declare a publisher."""
        described = f"{dds(kind)}/{hash_ or type_hash(kind)}"
        self._count += 1
        qos = ":1:,1:,:,:,," if latched else "::,10:,:,:,,"
        token = f"{self._place}/{self._count}/MP/{self._name}/{topic.replace('/', '%')}/{described}/{qos}"
        self._kept.append(self.session.liveliness().declare_token(token))
        key = f"{self.domain_id}/{topic.strip('/')}/{described}"
        publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher
        if latched:
            publisher = zenoh.ext.declare_advanced_publisher(
                self.session, key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True
            )
        else:
            publisher = self.session.declare_publisher(key)
        self._publishers[topic] = (gid(token), [0], publisher)

    def publish(self, topic: str, payload: bytes) -> None:
        """Publish a serialised message."""
        identifier, count, publisher = self._publishers[topic]
        count[0] += 1
        numbers = count[0].to_bytes(8, "little") + time.time_ns().to_bytes(8, "little")
        publisher.put(payload, attachment=numbers + b"\x10" + identifier)

    def subscribe(self, topic: str, kind: str, latched: bool = False) -> None:
        """Keep what comes on a topic."""
        key = f"{self.domain_id}/{topic.strip('/')}/{dds(kind)}/{type_hash(kind)}"

        def keep(sample: zenoh.Sample) -> None:
            attached = sample.attachment
            told = None if attached is None else attached.to_bytes()
            self.received[topic].append(Received(sample.payload.to_bytes(), told))

        if latched:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            self._kept.append(zenoh.ext.declare_advanced_subscriber(self.session, key, keep, history=history))
        else:
            self._kept.append(self.session.declare_subscriber(key, keep))


def dds(kind: str) -> str:
    """`nav_msgs/msg/Path` as `nav_msgs::msg::dds_::Path_`."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def gid(token: str) -> bytes:
    """Identifier of a publisher."""
    digest = xxhash.xxh3_128_intdigest(token.encode())
    return (digest & (2**64 - 1)).to_bytes(8, "little") + (digest >> 64).to_bytes(8, "little")
