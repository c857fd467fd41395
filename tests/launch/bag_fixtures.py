"""Small ROS bags, written by rosbags in the forms that the readers must take."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ZERO_NS = 1_600_000_000 * 10**9
WIDTH, HEIGHT = 32, 24


class BagScript:
    """Collects messages as (topic, type, nanoseconds, message) for one kind of bag."""

    def __init__(self, ros1: bool) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:
            self.store.register(
                get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
            )
        self.messages: list[tuple[str, str, int, Any]] = []
        self.frame, self.child = "camera", "body"
        self.fixed = "odom"

    def type(self, name: str) -> Any:
        return self.store.types[name]

    def add(self, topic: str, kind: str, stamp_ns: int, message: Any) -> None:
        self.messages.append((topic, kind, stamp_ns, message))

    def header(self, stamp_ns: int, frame: str | None = None) -> Any:
        time = self.type("builtin_interfaces/msg/Time")(stamp_ns // 10**9, stamp_ns % 10**9)
        make = self.type("std_msgs/msg/Header")
        frame = self.frame if frame is None else frame
        return make(0, time, frame) if self.ros1 else make(time, frame)

    def pose(self, x: float, q_xyzw: tuple[float, float, float, float] = (0, 0, 0, 1)) -> Any:
        point = self.type("geometry_msgs/msg/Point")(x, 2.0, 0.5)
        return self.type("geometry_msgs/msg/Pose")(point, self.type("geometry_msgs/msg/Quaternion")(*q_xyzw))

    def compressed(
        self, topic: str, stamp_ns: int, grey: int = 90, form: str = "jpeg", size: tuple[int, int] = (WIDTH, HEIGHT)
    ) -> None:
        pixels = np.full((size[1], size[0], 3), grey, dtype=np.uint8)
        if form == "noise":
            pixels, form = np.random.default_rng(stamp_ns).integers(0, 256, pixels.shape, dtype=np.uint8), "jpeg"
        data = cv2.imencode(".png" if form == "png" else ".jpg", pixels)[1].ravel()
        if form not in ("jpeg", "png"):
            data = np.frombuffer(b"RIFF....WEBPVP8 ", dtype=np.uint8)
        kind = "sensor_msgs/msg/CompressedImage"
        self.add(topic, kind, stamp_ns, self.type(kind)(self.header(stamp_ns), form, data))

    def jpeg(self, topic: str, stamp_ns: int, encoded: bytes) -> None:
        kind = "sensor_msgs/msg/CompressedImage"
        data = np.frombuffer(encoded, dtype=np.uint8)
        self.add(topic, kind, stamp_ns, self.type(kind)(self.header(stamp_ns), "jpeg", data))

    def raw(self, topic: str, stamp_ns: int, pixels: Any, encoding: str, padding: int = 0) -> None:
        rows = pixels.reshape(pixels.shape[0], -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        kind = "sensor_msgs/msg/Image"
        message = self.type(kind)(
            self.header(stamp_ns), pixels.shape[0], pixels.shape[1], encoding, 0, rows.shape[1], rows.ravel()
        )
        self.add(topic, kind, stamp_ns, message)

    def odometry(
        self, topic: str, stamp_ns: int, x: float, q_xyzw: tuple[float, float, float, float] = (0, 0, 0, 1)
    ) -> None:
        covariance = np.zeros(36)
        zero = self.type("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0)
        twist = self.type("geometry_msgs/msg/Twist")(zero, zero)
        kind = "nav_msgs/msg/Odometry"
        message = self.type(kind)(
            self.header(stamp_ns),
            self.child,
            self.type("geometry_msgs/msg/PoseWithCovariance")(self.pose(x, q_xyzw), covariance),
            self.type("geometry_msgs/msg/TwistWithCovariance")(twist, covariance),
        )
        self.add(topic, kind, stamp_ns, message)

    def transform(
        self,
        topic: str,
        stamp_ns: int,
        edge: tuple[str, str],
        t: tuple[float, float, float] = (0.0, 0.0, 0.0),
        q_xyzw: tuple[float, float, float, float] = (0, 0, 0, 1),
    ) -> None:
        """A TFMessage with one transform, from the first frame of the edge to the second."""
        vector, quaternion = (
            self.type("geometry_msgs/msg/Vector3")(*t),
            self.type("geometry_msgs/msg/Quaternion")(*q_xyzw),
        )
        stamped = self.type("geometry_msgs/msg/TransformStamped")
        before, self.frame = self.frame, edge[0]
        header, self.frame = self.header(stamp_ns), before
        moved = stamped(header, edge[1], self.type("geometry_msgs/msg/Transform")(vector, quaternion))
        kind = "tf2_msgs/msg/TFMessage"
        self.add(topic, kind, stamp_ns, self.type(kind)([moved]))

    def pose_stamped(self, topic: str, stamp_ns: int, x: float) -> None:
        kind = "geometry_msgs/msg/PoseStamped"
        self.add(topic, kind, stamp_ns, self.type(kind)(self.header(stamp_ns, self.fixed), self.pose(x)))

    def path(self, topic: str, stamps_ns: list[int], recorded_ns: int | None = None) -> None:
        posed = self.type("geometry_msgs/msg/PoseStamped")
        poses = [posed(self.header(ns, self.fixed), self.pose(float(k))) for k, ns in enumerate(stamps_ns)]
        kind = "nav_msgs/msg/Path"
        recorded_ns = stamps_ns[-1] if recorded_ns is None else recorded_ns
        self.add(topic, kind, recorded_ns, self.type(kind)(self.header(recorded_ns, self.fixed), poses))

    def camera_info(self, topic: str, stamp_ns: int, focal_px: float = 30.0) -> None:
        region = self.type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        K = np.array([focal_px, 0, 16, 0, 31, 12, 0, 0, 1])
        D, R, P = np.array([0.1, 0.2, 0.3, 0.4, 0.0]), np.eye(3).ravel(), np.zeros(12)
        kind = "sensor_msgs/msg/CameraInfo"
        message = self.type(kind)(self.header(stamp_ns), HEIGHT, WIDTH, "plumb_bob", D, K, R, P, 0, 0, region)
        self.add(topic, kind, stamp_ns, message)

    def write(self, path: Path, storage: str = "bag") -> Path:
        """Write a bag; storage is bag (ROS 1), db3 or mcap."""
        if storage == "bag":
            self._write(Writer1(path), self.store.serialize_ros1)
        else:
            plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
            self._write(Writer2(path, version=9, storage_plugin=plugin), self.store.serialize_cdr)
        return path

    def _write(self, writer: Any, serialize: Callable[[Any, str], Any]) -> None:
        with writer:
            connections: dict[str, Any] = {}
            for topic, kind, stamp_ns, message in self.messages:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic], stamp_ns, bytes(serialize(message, kind)))


def walking(
    ros1: bool, count: int = 5, image: str = "/cam/image/compressed", odometry: str | None = "/odom"
) -> BagScript:
    """A robot that drives a metre a second, with an image every second and odometry at twice the rate."""
    script = BagScript(ros1)
    script.camera_info("/cam/camera_info", ZERO_NS)
    for k in range(count):
        stamp_ns = ZERO_NS + k * 10**9
        if odometry is not None:
            script.odometry(odometry, stamp_ns, float(k))
            script.odometry(odometry, stamp_ns + 5 * 10**8, k + 0.5)
        script.compressed(image, stamp_ns + 2 * 10**8, 10 * (k % 20))
    return script
