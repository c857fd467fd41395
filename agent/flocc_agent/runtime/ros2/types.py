"""ROS 2 messages as CDR, by rosbags: no ROS is installed here. Type hashes (RIHS01) come from the definitions.

The definitions are those of Jazzy; the messages used here have had the same ones, and so the same hashes, since Iron.
"""

import struct
from collections.abc import Mapping
from typing import Any

from flocc_agent.extras import to_install
from flocc_protocol.errors import FloccError

TF = "tf2_msgs/msg/TFMessage"
PATH = "nav_msgs/msg/Path"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TEXT = "std_msgs/msg/String"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
MARKERS = "visualization_msgs/msg/MarkerArray"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
GRID = "nav_msgs/msg/OccupancyGrid"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"

TRIGGER = "std_srvs/srv/Trigger"
TRIGGER_HASH = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
"""rosbags has no services."""

SEC_MAX = 2**31 - 3600
"""ROS counts seconds in 32 bits; an hour is left for what is dated ahead."""

DOMAIN_ID_MAX = 232

_HEADER = {b"\x00\x01": "<", b"\x00\x00": ">"}
_FRAME_AT = 16


class Ros2Error(FloccError):
    """The ROS 2 side cannot be used as configured."""


class BadMessage(FloccError):
    """A message that cannot be used; it is dropped and counted."""


class MessageTypes:
    """Reads and writes messages as CDR."""

    def __init__(self) -> None:
        try:
            import xxhash  # noqa: F401
            from rosbags.serde import SerdeError
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise Ros2Error(f"the ROS 2 side needs rosbags and xxhash: {to_install('ros2')}") from error
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._broken = (SerdeError, struct.error, ValueError, IndexError, AssertionError, OverflowError, MemoryError)

    def hash(self, type_name: str) -> str:
        """Type hash of a message type, `RIHS01_...`."""
        return str(self._store.hash_rihs01(type_name))

    def new(self, type_name: str, **fields: object) -> Any:
        """Make a message; every field is needed."""
        make: Any = self._store.types[type_name]
        return make(**fields)

    def written(self, message: Any) -> bytes:
        """Serialise a message: four bytes of header, then little-endian CDR."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__))

    def read(self, payload: bytes, type_name: str) -> Any:
        """Deserialise a message.

        Raises:
            BadMessage: The payload is cut short, or no CDR of this type.
        """
        try:
            return self._store.deserialize_cdr(memoryview(payload), type_name)
        except self._broken as error:
            raise BadMessage(f"{len(payload)} bytes are no {type_name}: {error}") from error


def header_of(payload: bytes) -> tuple[int, str]:
    """Time (nanoseconds) and frame of a serialised message whose first field is a header; the rest is not read.

    Raises:
        BadMessage: It is too short, begins with no CDR header, or its stamp is no time.
    """
    order = _HEADER.get(bytes(payload[:2]))
    if order is None or len(payload) < _FRAME_AT:
        raise BadMessage(f"{len(payload)} bytes are no CDR message")
    sec, nanosec, length = struct.unpack_from(f"{order}iII", payload, 4)
    frame = bytes(payload[_FRAME_AT : _FRAME_AT + length])
    if len(frame) != length or not frame.endswith(b"\0"):
        raise BadMessage(f"{len(payload)} bytes are no message with a header")
    return checked_stamp_ns(sec, nanosec), frame[:-1].decode(errors="replace")


def checked_stamp_ns(sec: int, nanosec: int) -> int:
    """Time of a stamp, nanoseconds.

    Raises:
        BadMessage: It is before 1970, or so late that no later one could be written.
    """
    if not 0 <= sec < SEC_MAX or nanosec >= 10**9:
        raise BadMessage(f"the stamp {sec} s and {nanosec} ns is no time")
    return int(sec) * 10**9 + int(nanosec)


def trigger_response(success: bool, message: str) -> bytes:
    """Response of a std_srvs/Trigger service as CDR."""
    text = message.encode() + b"\0"
    return b"\x00\x01\x00\x00" + struct.pack("<?3xI", success, len(text)) + text


def domain_of(environment: Mapping[str, str]) -> int:
    """The ROS_DOMAIN_ID of an environment; 0 where there is none.

    Raises:
        Ros2Error: It is no number from 0 to 232.
    """
    given = environment.get("ROS_DOMAIN_ID", "") or "0"
    if not given.isdecimal() or int(given) > DOMAIN_ID_MAX:
        raise Ros2Error(f"ROS_DOMAIN_ID is {given!r}; it must be a number from 0 to {DOMAIN_ID_MAX}")
    return int(given)


def gid_of(token: str) -> bytes:
    """Identifier of a publisher: XXH3-128 of its liveliness token, low half first."""
    import xxhash

    digest = int(xxhash.xxh3_128_intdigest(token.encode()))
    return digest.to_bytes(16, "little")
