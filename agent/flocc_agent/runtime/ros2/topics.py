"""How rmw_zenoh names things in zenoh: keys of topics, liveliness tokens of the graph, attachments of samples.

    0/r1/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_3cc9...                                   a topic
    @ros2_lv/0/ZID/0/0/NN/%/%r1/driver                                                        a node
    @ros2_lv/0/ZID/0/10/MP/%/%r1/driver/%r1%odom/nav_msgs::msg::dds_::Odometry_/RIHS01_.../QOS   its publisher

The form is that of rmw_zenoh's design document, for Jazzy and later. Nothing here knows zenoh or ROS.
"""

import struct
from dataclasses import dataclass
from enum import Enum

TOKENS = "@ros2_lv"
GID_BYTES = 16
DEPTH_DEFAULT = 42

_ATTACHMENT = struct.Struct(f"<qqB{GID_BYTES}s")
_TOKEN_CHUNKS = 13


class EntityRole(Enum):
    """What an entity of the graph does with its topic."""

    PUBLISHES = "MP"
    SUBSCRIBES = "MS"
    SERVES = "SS"


@dataclass(frozen=True, slots=True)
class Qos:
    """What rmw_zenoh tells of a topic's quality of service; the rest is ROS's default.

    Attributes:
        depth: Messages kept.
        best_effort: Lost messages are not sent again.
        transient_local: Late joiners get the last `depth` messages.
    """

    depth: int
    best_effort: bool = False
    transient_local: bool = False

    def __str__(self) -> str:
        reliability = "2" if self.best_effort else ""
        durability = "1" if self.transient_local else ""
        depth = "" if self.depth == DEPTH_DEFAULT else str(self.depth)
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic as rmw_zenoh knows it.

    Attributes:
        name: Full name, such as `/r1/odom`.
        type: Such as `nav_msgs/msg/Odometry`.
        hash: Type hash, `RIHS01_` and 64 hexadecimal digits.
        qos: Quality of service.
    """

    name: str
    type: str
    hash: str
    qos: Qos

    def key(self, domain_id: int) -> str:
        """Key expression of the topic's samples."""
        return f"{domain_id}/{self.name.strip('/')}/{dds_type(self.type)}/{self.hash}"


@dataclass(frozen=True, slots=True)
class Node:
    """A node, the only one of its session.

    Attributes:
        domain_id: ROS_DOMAIN_ID.
        session: zenoh's identifier of the session.
        namespace: Such as `/r1`; empty at the root.
        name: Name of the node.
    """

    domain_id: int
    session: str
    namespace: str
    name: str

    def token(self) -> str:
        """Liveliness token of the node."""
        return f"{self._place(0)}/NN/{self._name()}"

    def endpoint_token(self, number: int, role: EntityRole, topic: Topic) -> str:
        """Liveliness token of a publisher or subscription; numbers are unique within the session and not 0."""
        described = f"{mangled(topic.name)}/{dds_type(topic.type)}/{topic.hash}/{topic.qos}"
        return f"{self._place(number)}/{role.value}/{self._name()}/{described}"

    def _place(self, number: int) -> str:
        return f"{TOKENS}/{self.domain_id}/{self.session}/0/{number}"

    def _name(self) -> str:
        return f"%/{mangled(self.namespace)}/{self.name}"


@dataclass(frozen=True, slots=True)
class Offer:
    """What another node publishes.

    Attributes:
        node: Full name.
        topic: Full name.
        type: As of `Topic`.
        hash: As of `Topic`.
        misfit: Why its quality of service does not fit ours, in words; empty where it does.
    """

    node: str
    topic: str
    type: str
    hash: str
    misfit: str = ""


def offers_of(domain_id: int) -> str:
    """Key expression of the tokens of all publishers of a domain."""
    return f"{TOKENS}/{domain_id}/*/*/*/{EntityRole.PUBLISHES.value}/**"


def read_offer(token: str) -> Offer | None:
    """Read the token of a publisher; None for any other."""
    chunks = token.split("/")
    if len(chunks) != _TOKEN_CHUNKS or chunks[0] != TOKENS or chunks[5] != EntityRole.PUBLISHES.value:
        return None
    node = f"{chunks[7].replace('%', '/').rstrip('/')}/{chunks[8]}"
    return Offer(node, chunks[9].replace("%", "/"), _ros_type(chunks[10]), chunks[11])


def mangled(name: str) -> str:
    """A name as one chunk of a key; nothing is the root."""
    return name.replace("/", "%") or "%"


def dds_type(name: str) -> str:
    """`nav_msgs/msg/Odometry` as `nav_msgs::msg::dds_::Odometry_`."""
    package, kind, type_name = name.split("/")
    return f"{package}::{kind}::dds_::{type_name}_"


def _ros_type(name: str) -> str:
    return name.replace("::dds_::", "::").replace("::", "/").removesuffix("_")


def full_name(namespace: str, topic: str) -> str:
    """A topic's full name: relative ones lie in the namespace, absolute ones begin with a slash."""
    inside = topic if topic.startswith("/") else f"{namespace.rstrip('/')}/{topic}"
    return "/" + inside.lstrip("/")


def attachment(number: int, source_stamp_ns: int, gid: bytes) -> bytes:
    """What rmw_zenoh attaches to a sample, 33 bytes: its number from 1, when it was sent, and who publishes."""
    return _ATTACHMENT.pack(number, source_stamp_ns, GID_BYTES, gid)


def sender_of(attached: bytes | None) -> tuple[bytes, int] | tuple[None, None]:
    """Who published a sample, and its number, by what is attached to it; None where that does not say it."""
    if attached is None or len(attached) != _ATTACHMENT.size:
        return None, None
    number, _, _, gid = _ATTACHMENT.unpack(attached)
    return gid, number


def answer_attachment(asked: bytes, source_stamp_ns: int) -> bytes | None:
    """What is attached to the answer of a service: the question's number and asker; None where that said neither."""
    if len(asked) != _ATTACHMENT.size:
        return None
    number, _, _, gid = _ATTACHMENT.unpack(asked)
    return attachment(number, source_stamp_ns, gid)
