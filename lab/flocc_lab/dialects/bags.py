"""Draws bags as robots record them, converts them, and compares the recordings with what was drawn.

Drawn are: ROS 1, SQLite or MCAP; one to three robots under namespaces; odometry as a topic of any type or as `/tf`; a
camera on the body by static transforms, or one with it; raw or compressed images; clocks that differ or are not set;
and a few damaged messages.

    python -m flocc_lab.dialects.bags --count 60 --seed 1
"""

import argparse
import json
import logging
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.recording import Recording
from flocc_launch.datasets.commands import convert
from flocc_protocol.errors import FloccError

KINDS = ("bag", "db3", "mcap")
POSES = ("Odometry", "PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "tf")
CLOCKS = ("one", "camera since start", "zero")
ZERO_NS = 1_650_000_000 * 10**9
STEP_NS = 10**8
IMAGES = 24
WIDTH, HEIGHT = 32, 24
MOUNT = ((0.2, 0.1, 0.3), (-0.5, 0.5, -0.5, 0.5))


@dataclass(frozen=True, slots=True)
class Draw:
    """What a bag is like."""

    kind: str
    robots: int
    poses: str
    mounted: bool
    raw: bool
    clock: str
    damaged: int


def drawn(rng: np.random.Generator) -> Draw:
    """One kind of bag."""
    poses = str(rng.choice(POSES))
    clock = str(rng.choice(CLOCKS)) if poses != "tf" else "one"
    named_child = poses in ("Odometry", "TransformStamped", "tf")
    return Draw(
        str(rng.choice(KINDS)), int(rng.integers(1, 4)), poses, bool(rng.integers(2)) and named_child,
        bool(rng.integers(2)), clock, int(rng.integers(0, 3)),
    )  # fmt: skip


class BagScript:
    """Messages of one bag."""

    def __init__(self, draw: Draw) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.draw = draw
        self.ros1 = draw.kind == "bag"
        self.store: Any = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            self.store.register(
                get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
            )
        self.messages: list[tuple[int, str, str, Any]] = []

    def make(self, name: str, *values: Any) -> Any:
        """A message or part of one, by its type's name."""
        return self.store.types[name](*values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        """A header."""
        stamp = self.make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
        return self.make("std_msgs/msg/Header", *([0] if self.ros1 else []), stamp, frame)

    def add(self, bag_ns: int, topic: str, kind: str, message: Any) -> None:
        """Take a message in."""
        self.messages.append((bag_ns, topic, kind, message))

    def transform(self, stamp_ns: int, edge: tuple[str, str], t: tuple[float, ...], q: tuple[float, ...]) -> Any:
        """A TransformStamped from the first frame of the edge to the second."""
        moved = self.make(
            "geometry_msgs/msg/Transform",
            self.make("geometry_msgs/msg/Vector3", *t),
            self.make("geometry_msgs/msg/Quaternion", *q),
        )
        return self.make("geometry_msgs/msg/TransformStamped", self.header(stamp_ns, edge[0]), edge[1], moved)

    def robot(self, namespace: str, offset_m: float) -> None:
        """One robot's camera, odometry and mounting."""
        prefix, draw = f"{namespace}/" if namespace else "", self.draw
        body, camera = f"{prefix}base_link", f"{prefix}{'optical' if draw.mounted else 'base_link'}"
        root = f"/{prefix}"
        if draw.mounted:
            link = self.transform(ZERO_NS, (body, f"{prefix}link"), MOUNT[0], (0.0, 0.0, 0.0, 1.0))
            lens = self.transform(ZERO_NS, (f"{prefix}link", camera), (0.0, 0.0, 0.0), MOUNT[1])
            self.add(ZERO_NS, "/tf_static", "tf2_msgs/msg/TFMessage", self.make("tf2_msgs/msg/TFMessage", [link, lens]))
        for k in range(IMAGES):
            bag_ns = ZERO_NS + k * STEP_NS
            shown_ns = {"one": bag_ns, "camera since start": bag_ns - ZERO_NS + 10**9, "zero": 0}[draw.clock]
            self.camera(bag_ns, shown_ns, f"{root}camera", camera, k)
            self.pose(bag_ns + 1000, 0 if draw.clock == "zero" else bag_ns, root, body, offset_m + 0.2 * k)

    def camera(self, bag_ns: int, stamp_ns: int, topic: str, frame: str, k: int) -> None:
        """A picture and its intrinsics."""
        header = self.header(stamp_ns, frame)
        region = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        K = np.array([30.0, 0, 16, 0, 31, 12, 0, 0, 1])
        info = self.make(
            "sensor_msgs/msg/CameraInfo", header, HEIGHT, WIDTH, "plumb_bob", np.zeros(5), K, np.eye(3).ravel(),
            np.array([30.0, 0, 16, 0, 0, 31, 12, 0, 0, 0, 1, 0]), 0, 0, region,
        )  # fmt: skip
        self.add(bag_ns, f"{topic}/camera_info", "sensor_msgs/msg/CameraInfo", info)
        pixels = np.full((HEIGHT, WIDTH), 5 * k, np.uint8)
        if self.draw.raw:
            kind = "sensor_msgs/msg/Image"
            image = self.make(kind, header, HEIGHT, WIDTH, "mono8", 0, WIDTH, pixels.ravel())
            self.add(bag_ns, f"{topic}/image_raw", kind, image)
        else:
            kind = "sensor_msgs/msg/CompressedImage"
            data = cv2.imencode(".png", pixels)[1].ravel()
            self.add(bag_ns, f"{topic}/image_raw/compressed", kind, self.make(kind, header, "png", data))

    def pose(self, bag_ns: int, stamp_ns: int, root: str, body: str, x_m: float) -> None:
        """Where a robot is, by a topic of the drawn type below `root`."""
        draw, q = self.draw, (0.0, 0.0, 0.0, 1.0)
        fixed = body.replace("base_link", "odom")
        if draw.poses in ("tf", "TransformStamped"):
            moved = self.transform(stamp_ns, (fixed, body), (x_m, 0.0, 0.0), q)
            if draw.poses == "tf":
                self.add(bag_ns, "/tf", "tf2_msgs/msg/TFMessage", self.make("tf2_msgs/msg/TFMessage", [moved]))
            else:
                self.add(bag_ns, f"{root}vio", "geometry_msgs/msg/TransformStamped", moved)
            return
        point, turned = (
            self.make("geometry_msgs/msg/Point", x_m, 0.0, 0.0),
            self.make("geometry_msgs/msg/Quaternion", *q),
        )
        pose, header = self.make("geometry_msgs/msg/Pose", point, turned), self.header(stamp_ns, fixed)
        posed = self.make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36))
        if draw.poses == "Odometry":
            zero = self.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
            twist = self.make(
                "geometry_msgs/msg/TwistWithCovariance", self.make("geometry_msgs/msg/Twist", zero, zero), np.zeros(36)
            )
            kind = "nav_msgs/msg/Odometry"
            message = self.make(kind, header, body, posed, twist)
        else:
            kind = f"geometry_msgs/msg/{draw.poses}"
            message = self.make(kind, header, pose if draw.poses == "PoseStamped" else posed)
        self.add(bag_ns, f"{root}odom", kind, message)

    def write(self, path: Path, rng: np.random.Generator) -> None:
        """Write the bag; some messages of poses and images behind the first ones are cut short."""
        self.messages.sort(key=lambda message: message[0])
        cut = set(
            rng.choice(
                np.arange(len(self.messages) // 2, len(self.messages)), self.draw.damaged, replace=False
            ).tolist()
        )
        with self._writer(path) as writer:
            connections: dict[str, Any] = {}
            for k, (bag_ns, topic, kind, message) in enumerate(self.messages):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                raw = bytes((self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr)(message, kind))
                writer.write(connections[topic], bag_ns, raw[:30] if k in cut else raw)

    def _writer(self, path: Path) -> Any:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2

        if self.ros1:
            return Writer1(path)
        plugin = StoragePlugin.MCAP if self.draw.kind == "mcap" else StoragePlugin.SQLITE3
        return Writer2(path, version=9, storage_plugin=plugin)


def judged(draw: Draw, rng: np.random.Generator, folder: Path) -> str | None:
    """Write and convert one bag; returns what is wrong with the recordings, or None."""
    script = BagScript(draw)
    names = [""] if draw.robots == 1 else ["alpha", "bravo", "charlie"][: draw.robots]
    for number, name in enumerate(names):
        script.robot(name, 100.0 * number)
    path = folder / ("run.bag" if draw.kind == "bag" else "run")
    script.write(path, rng)
    try:
        convert(path, folder / "out")
        found = [Recording.open(folder / "out" / name) for name in names]
    except FloccError as error:
        return f"refused: {error}"
    for number, recording in enumerate(found):
        wrong = _wrong(recording, draw, 100.0 * number)
        if wrong is not None:
            return f"{names[number] or 'robot'}: {wrong}"
    return None


def _wrong(recording: Recording, draw: Draw, offset_m: float) -> str | None:
    (x, y, z), (qx, qy, qz, qw) = MOUNT
    T = pose_from_tq(np.array([x, y, z, qw, qx, qy, qz])) if draw.mounted else np.eye(4)
    if not np.allclose(recording.T_body_camera, T, atol=1e-9):
        return f"the mounting is {recording.T_body_camera.tolist()}"
    if len(recording.frames) < IMAGES - draw.damaged - 1:
        return f"{len(recording.frames)} images of {IMAGES}"
    shown = [round(float(recording.load_image(frame).pixels.mean()) / 5) for frame in recording.frames]
    off_m = [
        abs(frame.T_odom_body[0, 3] - offset_m - 0.2 * k) for k, frame in zip(shown, recording.frames, strict=True)
    ]
    return f"a picture is {max(off_m):.3f} m from where it was taken" if max(off_m) > 1e-3 else None


def main() -> None:
    """Print how many bags were right, and what was wrong with the others."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    rng = np.random.default_rng(given.seed)
    verdicts: list[tuple[Draw, str | None]] = []
    for _ in range(given.count):
        with tempfile.TemporaryDirectory(prefix="flocc-bag-dialects-") as folder:
            draw = drawn(rng)
            verdicts.append((draw, judged(draw, rng, Path(folder))))
    bad = [f"{draw}: {wrong}" for draw, wrong in verdicts if wrong is not None]
    counts = Counter("right" if wrong is None else "wrong" for _, wrong in verdicts)
    sys.stdout.write(json.dumps({"bags": given.count, **counts, "which": bad[:20]}, indent=1) + "\n")


if __name__ == "__main__":
    main()
