"""Foxglove's messages, in MCAP as protobuf or JSON, or in ROS 2 bags, as the ROS messages that say the same.

`CompressedImage`, `RawImage`, `CameraCalibration`, `PoseInFrame`, `FrameTransform` and `FrameTransforms` are read.
"""

import base64
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from flocc_launch.datasets.bag_salvage import mcap_messages
from flocc_launch.datasets.protobuf import Types

ROS_TYPES = {
    "CompressedImage": "sensor_msgs/msg/CompressedImage",
    "RawImage": "sensor_msgs/msg/Image",
    "CameraCalibration": "sensor_msgs/msg/CameraInfo",
    "PoseInFrame": "geometry_msgs/msg/PoseStamped",
    "FrameTransform": "tf2_msgs/msg/TFMessage",
    "FrameTransforms": "tf2_msgs/msg/TFMessage",
}
FOREIGN = ("protobuf", "json")


def short_name(schema: str) -> str | None:
    """Foxglove's name of a schema `foxglove.NAME` or `foxglove_msgs/msg/NAME` that is read, or None."""
    name = schema.replace("/msg/", ".").rpartition(".")[2]
    return name if name in ROS_TYPES and schema.startswith(("foxglove.", "foxglove_msgs/")) else None


class ForeignMcap:
    """An MCAP file of protobuf or JSON messages; read as a damaged bag is, from the front."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[str, tuple[str, str, Types | None]] = {}

    @property
    def encodings(self) -> list[str]:
        """Of its messages."""
        return sorted({encoding for _, encoding, _ in self._schemas.values()})

    def topics(self) -> dict[str, str]:
        """Topics with their types: ROS' where Foxglove's message says the same, else the schema's name."""
        found: dict[str, str] = {}
        for message in mcap_messages(self._path):
            if message.topic not in found:
                types = Types.of(message.schema_data) if message.encoding == "protobuf" else None
                self._schemas[message.topic] = (message.schema, message.encoding, types)
                found[message.topic] = ROS_TYPES.get(short_name(message.schema) or "", message.schema)
        return dict(sorted(found.items()))

    def messages(self, names: list[str]) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, log time and raw message."""
        yield from ((m.topic, m.log_ns, m.data) for m in mcap_messages(self._path) if m.topic in names)

    def decode(self, raw: bytes, topic: str) -> Any:
        """Decode a message as the ROS message that says the same.

        Raises:
            ValueError: It is of no type that is read, or damaged.
        """
        schema, _, types = self._schemas[topic]
        name = short_name(schema)
        if name is None:
            raise ValueError(f"messages of {schema} are not read")
        fields = types.decode(schema, raw) if types is not None else json.loads(raw)
        return as_ros(name, fields)


def as_ros(name: str, message: Any) -> Any:
    """One of Foxglove's messages as the ROS message that says the same.

    Raises:
        ValueError: A part is missing.
    """
    get = _getter(message)
    header = SimpleNamespace(stamp=_stamp(get("timestamp")), frame_id=str(get("frame_id") or ""))
    if name == "CompressedImage":
        return SimpleNamespace(header=header, format=str(get("format") or ""), data=_bytes(get("data")))
    if name == "RawImage":
        size = {key: int(get(key) or 0) for key in ("width", "height", "step")}
        encoding = str(get("encoding") or "")
        return SimpleNamespace(header=header, encoding=encoding, is_bigendian=0, data=_bytes(get("data")), **size)
    if name == "CameraCalibration":
        return _Calibration(header, get)
    if name == "PoseInFrame":
        return SimpleNamespace(header=header, pose=_pose(get("pose"), "position", "orientation"))
    transforms = get("transforms") if name == "FrameTransforms" else [message]
    return SimpleNamespace(transforms=[_transform(each) for each in transforms or []])


def _transform(message: Any) -> Any:
    get = _getter(message)
    header = SimpleNamespace(stamp=_stamp(get("timestamp")), frame_id=str(get("parent_frame_id") or ""))
    moved = _pose(message, "translation", "rotation")
    return SimpleNamespace(header=header, child_frame_id=str(get("child_frame_id") or ""), transform=moved)


class _Calibration:
    """A CameraInfo; its fields are listed as those of rosbags' messages are."""

    __dataclass_fields__: Mapping[str, None] = {"k": None, "d": None, "r": None, "p": None}

    def __init__(self, header: Any, get: Any) -> None:
        self.header = header
        self.width, self.height = int(get("width") or 0), int(get("height") or 0)
        self.distortion_model = str(get("distortion_model") or "")
        self.d, self.k, self.r, self.p = (
            np.array(get(name) or get(name.lower()) or [], dtype=float) for name in ("D", "K", "R", "P")
        )
        if len(self.k) != 9:
            raise ValueError(f"a calibration has {len(self.k)} numbers in K, not 9")
        self.binning_x = self.binning_y = 0
        self.roi = SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)


def _getter(message: Any) -> Any:
    if isinstance(message, Mapping):
        return message.get
    return lambda name: getattr(message, name, None)


def _pose(message: Any, position: str, rotation: str) -> Any:
    if message is None:
        raise ValueError("a pose is missing")
    get = _getter(message)
    t, q = _numbers(get(position), "xyz"), _numbers(get(rotation), "xyzw")
    return SimpleNamespace(**{position: t, rotation: q})


def _numbers(part: Any, axes: str) -> Any:
    """Coordinates; protobuf leaves out those that are zero."""
    get = _getter(part if part is not None else {})
    return SimpleNamespace(**{axis: float(get(axis) or 0.0) for axis in axes})


def _stamp(part: Any) -> Any:
    get = _getter(part if part is not None else {})
    seconds = get("sec") if get("sec") is not None else get("seconds")
    nanoseconds = next((get(name) for name in ("nsec", "nanosec", "nanos") if get(name) is not None), 0)
    return SimpleNamespace(sec=int(seconds or 0), nanosec=int(nanoseconds or 0))


def _bytes(data: Any) -> Any:
    if isinstance(data, str):
        data = base64.b64decode(data)
    return data if isinstance(data, np.ndarray) else np.frombuffer(bytes(data or b""), dtype=np.uint8)
