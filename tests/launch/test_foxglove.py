"""MCAP of protobuf and JSON: Foxglove's messages are read, others refused by name."""

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import get_types_from_msg
from tests.launch.bag_fixtures import HEIGHT, WIDTH, ZERO_NS, walking

from flocc_agent.runtime.recording import Recording
from flocc_launch.datasets.commands import convert, info
from flocc_launch.datasets.protobuf import Types
from flocc_launch.datasets.source import DatasetError

JPEG = cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), 90, np.uint8))[1].tobytes()
D = [0.1, 0.2, 0.3, 0.4, 0.0]
K = [30.0, 0, 16, 0, 31, 12, 0, 0, 1]


def varint(value: int) -> bytes:
    out = b""
    while value > 0x7F:
        out, value = out + bytes([value & 0x7F | 0x80]), value >> 7
    return out + bytes([value])


def part(number: int, value: object) -> bytes:
    """One field: whole numbers as varints, others as doubles, texts, bytes, or packed doubles."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    if isinstance(value, float):
        return varint(number << 3 | 1) + struct.pack("<d", value)
    if isinstance(value, list):
        value = struct.pack(f"<{len(value)}d", *value)
    data = value.encode() if isinstance(value, str) else bytes(value)  # type: ignore[call-overload]
    return varint(number << 3 | 2) + varint(len(data)) + data


SHAPES: dict[str, list[tuple[str, int, int, str]]] = {
    "google.protobuf.Timestamp": [("seconds", 1, 3, ""), ("nanos", 2, 5, "")],
    "foxglove.Vector3": [("x", 1, 1, ""), ("y", 2, 1, ""), ("z", 3, 1, "")],
    "foxglove.Quaternion": [("x", 1, 1, ""), ("y", 2, 1, ""), ("z", 3, 1, ""), ("w", 4, 1, "")],
    "foxglove.Pose": [("position", 1, 11, "foxglove.Vector3"), ("orientation", 2, 11, "foxglove.Quaternion")],
    "foxglove.PoseInFrame": [
        ("timestamp", 1, 11, "google.protobuf.Timestamp"), ("frame_id", 2, 9, ""), ("pose", 3, 11, "foxglove.Pose"),
    ],
    "foxglove.CompressedImage": [
        ("timestamp", 1, 11, "google.protobuf.Timestamp"), ("data", 2, 12, ""), ("format", 3, 9, ""),
        ("frame_id", 4, 9, ""),
    ],
    "foxglove.CameraCalibration": [
        ("timestamp", 1, 11, "google.protobuf.Timestamp"), ("width", 2, 13, ""), ("height", 3, 13, ""),
        ("distortion_model", 4, 9, ""), ("D", 5, 1, ""), ("K", 6, 1, ""), ("frame_id", 9, 9, ""),
    ],
}  # fmt: skip
REPEATED = ("D", "K")


def descriptors() -> bytes:
    """A FileDescriptorSet of `SHAPES`."""
    files = b""
    for full, fields in SHAPES.items():
        package, _, name = full.rpartition(".")
        message = part(1, name)
        for field, number, kind, of in fields:
            label = 3 if field in REPEATED else 1
            message += part(2, part(1, field) + part(3, number) + part(4, label) + part(5, kind) + part(6, f".{of}"))
        files += part(1, part(1, f"{full}.proto") + part(2, package) + part(4, message))
    return files


def protobuf(name: str, fields: dict[str, Any]) -> bytes:
    out = b""
    for field, number, kind, of in SHAPES[name]:
        if field in fields:
            value = fields[field]
            out += part(number, protobuf(of, value) if kind == 11 else value)
    return out


def json_bytes(name: str, fields: dict[str, Any]) -> bytes:
    def plain(value: object) -> object:
        return base64.b64encode(value).decode() if isinstance(value, bytes) else value

    renamed = {"sec": fields["timestamp"]["seconds"], "nsec": fields["timestamp"]["nanos"]}
    return json.dumps({**{key: plain(value) for key, value in fields.items()}, "timestamp": renamed}).encode()


def record(operation: int, body: bytes) -> bytes:
    return struct.pack("<BQ", operation, len(body)) + body


def sized(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def write_mcap(
    path: Path, encoding: str, schema_data: bytes, messages: list[tuple[str, str, int, dict[str, Any]]],
    serialise: Callable[[str, dict[str, Any]], bytes],
) -> Path:  # fmt: skip
    out = b"\x89MCAP0\r\n" + record(1, sized(b"") + sized(b"test"))
    channels: dict[str, int] = {}
    for topic, schema, stamp_ns, fields in messages:
        if topic not in channels:
            number = channels[topic] = len(channels) + 1
            kind = {"json": b"jsonschema", "protobuf": b"protobuf"}[encoding]
            out += record(3, struct.pack("<H", number) + sized(schema.encode()) + sized(kind) + sized(schema_data))
            names = sized(topic.encode()) + sized(encoding.encode())
            out += record(4, struct.pack("<HH", number, number) + names + sized(b""))
        head = struct.pack("<HIQQ", channels[topic], 0, stamp_ns, stamp_ns)
        out += record(5, head + serialise(schema, fields))
    path.write_bytes(out + record(0x0F, struct.pack("<I", 0)) + record(2, bytes(20)) + b"\x89MCAP0\r\n")
    return path


def script() -> list[tuple[str, str, int, dict[str, Any]]]:
    messages: list[tuple[str, str, int, dict[str, Any]]] = []
    for k in range(4):
        stamp_ns = ZERO_NS + k * 10**9
        stamp = {"timestamp": {"seconds": stamp_ns // 10**9, "nanos": 0}}
        pose = {"position": {"x": float(k), "y": 2.0}, "orientation": {"w": 1.0}}
        messages += [
            ("/calibration", "foxglove.CameraCalibration", stamp_ns,
             {**stamp, "width": WIDTH, "height": HEIGHT, "distortion_model": "plumb_bob", "D": D, "K": K,
              "frame_id": "camera"}),
            ("/camera", "foxglove.CompressedImage", stamp_ns,
             {**stamp, "frame_id": "camera", "data": JPEG, "format": "jpeg"}),
            ("/pose", "foxglove.PoseInFrame", stamp_ns, {**stamp, "frame_id": "odom", "pose": pose}),
        ]  # fmt: skip
    return messages


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_foxgloves_messages_become_a_recording(tmp_path: Path, encoding: str) -> None:
    serialise = json_bytes if encoding == "json" else protobuf
    schema = b"{}" if encoding == "json" else descriptors()
    path = write_mcap(tmp_path / "run.mcap", encoding, schema, script(), serialise)
    assert info(path).faults == ()
    recording = Recording.open(convert(path, tmp_path / "out"))
    assert [frame.T_odom_body[0, 3] for frame in recording.frames] == pytest.approx([0.0, 1.0, 2.0, 3.0])
    assert (recording.camera.fx, recording.camera.fy, recording.camera.distortion[0]) == (30.0, 31.0, 0.1)


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_other_messages_are_refused_by_name(tmp_path: Path, encoding: str) -> None:
    messages = [("/talk", "chatter.Word", ZERO_NS, {"timestamp": {"seconds": 1, "nanos": 0}})]
    path = write_mcap(tmp_path / "run.mcap", encoding, b"", messages, lambda name, fields: b"")
    with pytest.raises(
        DatasetError, match=rf"is an MCAP of {encoding} messages, not of ROS; .* it has /talk \(chatter."
    ):
        convert(path, tmp_path / "out")


def test_a_message_of_ros_2_that_foxglove_describes_is_an_image(tmp_path: Path) -> None:
    bag = walking(False)
    name = "foxglove_msgs/msg/CompressedImage"
    text = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    bag.store.register(get_types_from_msg(text, name))
    for index, (topic, kind, stamp_ns, message) in enumerate(bag.messages):
        if "CompressedImage" in kind:
            shown = bag.type(name)(message.header.stamp, "camera", message.data, "jpeg")
            bag.messages[index] = (topic, name, stamp_ns, shown)
    assert len(Recording.open(convert(bag.write(tmp_path / "run", "mcap"), tmp_path / "out")).frames) == 5


def test_a_message_that_ends_too_early_is_no_message() -> None:
    types = Types.of(descriptors())
    raw = protobuf("foxglove.PoseInFrame", script()[2][3])
    assert types.decode("foxglove.PoseInFrame", raw)["pose"]["position"]["y"] == 2.0
    with pytest.raises(ValueError, match="ends too early"):
        types.decode("foxglove.PoseInFrame", raw[:-3])


@pytest.mark.parametrize("cut", [0, 9])
def test_an_mcap_that_was_made_of_a_ros_1_bag_is_read(tmp_path: Path, cut: int) -> None:
    bag = walking(True)
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1")
        channels: dict[str, int] = {}
        for topic, kind, stamp_ns, message in bag.messages:
            if topic not in channels:
                text = bag.store.generate_msgdef(kind, ros_version=1)[0].encode()
                schema = writer.register_schema(kind.replace("/msg/", "/"), "ros1msg", text)
                channels[topic] = writer.register_channel(topic, "ros1", schema)
            writer.add_message(channels[topic], stamp_ns, bytes(bag.store.serialize_ros1(message, kind)), stamp_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    path.write_bytes(path.read_bytes()[: path.stat().st_size - cut])
    if cut:
        with pytest.raises(DatasetError, match="is damaged or cut off"):
            convert(path, tmp_path / "out")
    else:
        convert(path, tmp_path / "out")
    frames = Recording.open(tmp_path / "out").frames
    assert [frame.T_odom_body[0, 3] for frame in frames] == pytest.approx([k + 0.2 for k in range(5)])
