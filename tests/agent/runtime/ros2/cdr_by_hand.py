"""ROS messages as CDR bytes, written and read with `struct` alone: neither flocc nor rosbags is used here.

XCDR1, little-endian: four bytes of header, then every number aligned to its own size, counted from behind the header.
"""

import hashlib
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

HEADER = b"\x00\x01\x00\x00"
Stamp = tuple[int, int]
"""Seconds and nanoseconds."""


class Writer:
    """Appends numbers and strings."""

    def __init__(self) -> None:
        self.bytes = bytearray()

    def put(self, code: str, *values: float) -> "Writer":
        size = struct.calcsize(f"<{code}")
        for value in values:
            self.bytes += bytes(-len(self.bytes) % size) + struct.pack(f"<{code}", value)
        return self

    def text(self, words: str) -> "Writer":
        encoded = words.encode() + b"\0"
        self.put("I", len(encoded))
        self.bytes += encoded
        return self

    def blob(self, data: bytes) -> "Writer":
        self.put("I", len(data))
        self.bytes += data
        return self

    def header(self, stamp: Stamp, frame: str) -> "Writer":
        return self.put("i", stamp[0]).put("I", stamp[1]).text(frame)

    def message(self) -> bytes:
        return HEADER + bytes(self.bytes)


class Reader:
    """Takes numbers and strings off."""

    def __init__(self, payload: bytes) -> None:
        assert payload[:4] == HEADER
        self._bytes = payload[4:]
        self._at = 0

    def take(self, code: str, count: int = 1) -> Any:
        size = struct.calcsize(f"<{code}")
        values: list[Any] = []
        for _ in range(count):
            self._at += -self._at % size
            values += struct.unpack_from(f"<{code}", self._bytes, self._at)
            self._at += size
        return values[0] if count == 1 else tuple(values)

    def text(self) -> str:
        length = self.take("I")
        words = self._bytes[self._at : self._at + length]
        assert len(words) == length
        assert words.endswith(b"\0")
        self._at += length
        return words[:-1].decode()

    def header(self) -> tuple[Stamp, str]:
        return (self.take("i"), self.take("I")), self.text()

    def end(self) -> None:
        assert len(self._bytes) - self._at < 4, f"{len(self._bytes) - self._at} bytes are left"


def nav_sat_fix(
    stamp: Stamp, frame: str, place: Sequence[float], covariance: Sequence[float], status: int = 0, known: int = 3
) -> bytes:
    """NavSatFix: latitude, longitude (degrees), altitude (m), covariance east, north, up."""
    writer = Writer().header(stamp, frame).put("b", status).put("H", 1)
    return writer.put("d", *place).put("d", *covariance).put("B", known).message()


@dataclass(frozen=True, slots=True)
class Stamped:
    """What is placed: time, frame, child where it has one, `x y z`, `qx qy qz qw`, covariance where it has one."""

    stamp: Stamp
    frame: str
    child: str
    position: tuple[float, ...]
    quaternion: tuple[float, ...]
    covariance: tuple[float, ...] = ()


def odometry(sample: Stamped, variance: float = 0.0) -> bytes:
    """`variance` is that of each of the six numbers of the pose."""
    covariance = [variance * (k % 7 == 0) for k in range(36)]
    writer = Writer().header(sample.stamp, sample.frame).text(sample.child)
    writer.put("d", *sample.position, *sample.quaternion, *covariance)
    return writer.put("d", *[0.0] * 6, *[0.0] * 36).message()


def transforms(samples: Sequence[Stamped]) -> bytes:
    writer = Writer().put("I", len(samples))
    for sample in samples:
        writer.header(sample.stamp, sample.frame).text(sample.child).put("d", *sample.position, *sample.quaternion)
    return writer.message()


def image(
    stamp: Stamp, frame: str, size: tuple[int, int], encoding: str, data: bytes, step: int, big: int = 0
) -> bytes:
    """`size` is height and width."""
    writer = Writer().header(stamp, frame).put("I", *size).text(encoding).put("B", big).put("I", step)
    return writer.blob(data).message()


def compressed_image(stamp: Stamp, frame: str, kind: str, data: bytes) -> bytes:
    return Writer().header(stamp, frame).text(kind).blob(data).message()


def camera_info(
    stamp: Stamp,
    frame: str,
    size: tuple[int, int],
    K: Sequence[float],
    D: Sequence[float],
    P: Sequence[float],
    model: str = "plumb_bob",
) -> bytes:
    """`size` is height and width; K has 9 numbers, P has 12."""
    writer = Writer().header(stamp, frame).put("I", *size).text(model).put("I", len(D)).put("d", *D)
    writer.put("d", *K, *(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), *P).put("I", 0, 0)
    return writer.put("I", 0, 0, 0, 0).put("B", 0).message()


def read_transforms(payload: bytes) -> list[Stamped]:
    reader = Reader(payload)
    found = []
    for _ in range(reader.take("I")):
        (stamp, frame), child = reader.header(), reader.text()
        found.append(Stamped(stamp, frame, child, reader.take("d", 3), reader.take("d", 4)))
    reader.end()
    return found


def read_path(payload: bytes) -> tuple[Stamp, str, list[Stamped]]:
    reader = Reader(payload)
    stamp, frame = reader.header()
    poses = []
    for _ in range(reader.take("I")):
        each, within = reader.header()
        poses.append(Stamped(each, within, "", reader.take("d", 3), reader.take("d", 4)))
    reader.end()
    return stamp, frame, poses


def read_pose(payload: bytes) -> Stamped:
    reader = Reader(payload)
    stamp, frame = reader.header()
    posed = Stamped(stamp, frame, "", reader.take("d", 3), reader.take("d", 4), reader.take("d", 36))
    reader.end()
    return posed


def read_text(payload: bytes) -> str:
    reader = Reader(payload)
    words = reader.text()
    reader.end()
    return words


def read_attachment(attached: bytes) -> tuple[int, int, bytes]:
    """Sequence number, source time in nanoseconds, identifier of the publisher."""
    assert len(attached) == 33
    number, source_ns, length, gid = struct.unpack("<qqB16s", attached)
    assert length == 16
    return number, source_ns, gid


# REP 2016: the type hash is the SHA-256 of the type's description as JSON.

SCALARS = {"int8": 2, "uint8": 3, "uint16": 5, "int32": 6, "uint32": 7, "float64": 11, "bool": 15, "string": 17}
FIXED, UNBOUNDED = 48, 144
DEFINITIONS = {
    "builtin_interfaces/msg/Time": "int32 sec, uint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/msg/Time stamp, string frame_id",
    "std_msgs/msg/String": "string data",
    "geometry_msgs/msg/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/msg/Pose": "geometry_msgs/msg/Point position, geometry_msgs/msg/Quaternion orientation",
    "geometry_msgs/msg/PoseStamped": "std_msgs/msg/Header header, geometry_msgs/msg/Pose pose",
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/msg/Pose pose, float64[36] covariance",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "std_msgs/msg/Header header, "
    "geometry_msgs/msg/PoseWithCovariance pose",
    "geometry_msgs/msg/Twist": "geometry_msgs/msg/Vector3 linear, geometry_msgs/msg/Vector3 angular",
    "geometry_msgs/msg/TwistWithCovariance": "geometry_msgs/msg/Twist twist, float64[36] covariance",
    "geometry_msgs/msg/Transform": "geometry_msgs/msg/Vector3 translation, geometry_msgs/msg/Quaternion rotation",
    "geometry_msgs/msg/TransformStamped": "std_msgs/msg/Header header, string child_frame_id, "
    "geometry_msgs/msg/Transform transform",
    "nav_msgs/msg/Path": "std_msgs/msg/Header header, geometry_msgs/msg/PoseStamped[] poses",
    "nav_msgs/msg/Odometry": "std_msgs/msg/Header header, string child_frame_id, "
    "geometry_msgs/msg/PoseWithCovariance pose, geometry_msgs/msg/TwistWithCovariance twist",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/msg/TransformStamped[] transforms",
    "sensor_msgs/msg/Image": "std_msgs/msg/Header header, uint32 height, uint32 width, string encoding, "
    "uint8 is_bigendian, uint32 step, uint8[] data",
    "sensor_msgs/msg/CompressedImage": "std_msgs/msg/Header header, string format, uint8[] data",
    "sensor_msgs/msg/NavSatStatus": "int8 status, uint16 service",
    "sensor_msgs/msg/NavSatFix": "std_msgs/msg/Header header, sensor_msgs/msg/NavSatStatus status, float64 latitude, "
    "float64 longitude, float64 altitude, float64[9] position_covariance, uint8 position_covariance_type",
    "sensor_msgs/msg/RegionOfInterest": "uint32 x_offset, uint32 y_offset, uint32 height, uint32 width, "
    "bool do_rectify",
    "sensor_msgs/msg/CameraInfo": "std_msgs/msg/Header header, uint32 height, uint32 width, string distortion_model, "
    "float64[] d, float64[9] k, float64[9] r, float64[12] p, uint32 binning_x, uint32 binning_y, "
    "sensor_msgs/msg/RegionOfInterest roi",
}


def type_hash(name: str) -> str:
    """RIHS01 of one of the definitions above."""
    inner: set[str] = set()
    described = {"type_description": _described(name, inner)}
    referenced = [_described(each, set()) for each in sorted(inner)]
    text = json.dumps({**described, "referenced_type_descriptions": referenced})
    return "RIHS01_" + hashlib.sha256(text.encode()).hexdigest()


def _described(name: str, inner: set[str]) -> dict[str, Any]:
    return {"type_name": name, "fields": [_field(each, inner) for each in DEFINITIONS[name].split(", ")]}


def _field(definition: str, inner: set[str]) -> dict[str, Any]:
    kind, name = definition.split()
    base, _, length = kind.partition("[")
    capacity = int(length[:-1] or 0) if length else 0
    array = 0 if not length else FIXED if capacity else UNBOUNDED
    if base not in SCALARS:
        inner.add(base)
        _described(base, inner)
    described = {
        "type_id": SCALARS.get(base, 1) + array,
        "capacity": capacity,
        "string_capacity": 0,
        "nested_type_name": "" if base in SCALARS else base,
    }
    return {"name": name, "type": described}
