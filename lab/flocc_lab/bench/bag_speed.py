"""How fast bags are converted: `python -m flocc_lab.bench.bag_speed` prints ratios to rosbags' own reading.

A bag of 10,000 messages (odometry and JPEG images, 9 to 1) is read by rosbags (every message deserialised) and
converted, several times in turn.
"""

import json
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flocc_agent.lenses import CameraModel
from flocc_launch.datasets.bag_convert import BagOptions, convert_bag
from flocc_launch.datasets.source import Lens

MESSAGES = 10_000
IMAGE_EVERY = 10
ROUNDS = 5
TRANSPORT_QUALITY = 80  # the default of ROS' compressed_image_transport


def write_bag(path: Path, messages: int = MESSAGES) -> Path:
    """Write a ROS 2 bag (SQLite) of odometry at 100 Hz and 640x480 JPEG images at 10 Hz."""
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    noise = cv2.resize(np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8), (640, 480))
    jpeg = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, TRANSPORT_QUALITY])[1].ravel()
    kinds = ("nav_msgs/msg/Odometry", "sensor_msgs/msg/CompressedImage")
    with Writer(path, version=9) as writer:
        connections = [
            writer.add_connection(t, k, typestore=store) for t, k in zip(("/odom", "/image"), kinds, strict=True)
        ]
        for k in range(messages):
            which, stamp_ns = int(k % IMAGE_EVERY == 0), 10**18 + k * 10**7
            message = image(store, stamp_ns, jpeg) if which else odometry(store, stamp_ns)
            writer.write(connections[which], stamp_ns, store.serialize_cdr(message, kinds[which]))
    return path


def _header(store: Any, stamp_ns: int) -> Any:
    stamp = store.types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
    return store.types["std_msgs/msg/Header"](stamp, "odom")


def image(store: Any, stamp_ns: int, jpeg: Any) -> Any:
    """A compressed image."""
    return store.types["sensor_msgs/msg/CompressedImage"](_header(store, stamp_ns), "jpeg", jpeg)


def odometry(store: Any, stamp_ns: int, _: Any = None) -> Any:
    """A pose of odometry."""

    def make(name: str, *values: Any) -> Any:
        return store.types[f"geometry_msgs/msg/{name}"](*values)

    zero, covariance = make("Vector3", 0.0, 0.0, 0.0), np.zeros(36)
    pose = make("Pose", make("Point", stamp_ns * 1e-18, 0.0, 0.0), make("Quaternion", 0.0, 0.0, 0.0, 1.0))
    posed, moved = make("PoseWithCovariance", pose, covariance), make("Twist", zero, zero)
    twisted = make("TwistWithCovariance", moved, covariance)
    return store.types["nav_msgs/msg/Odometry"](_header(store, stamp_ns), "base", posed, twisted)


def read_all(path: Path) -> int:
    """Read and deserialise every message with rosbags alone."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        return sum(1 for c, _, raw in reader.messages() if reader.deserialize(raw, c.msgtype) is not None)


def measure(folder: Path, rounds: int = ROUNDS) -> dict[str, Any]:
    """Ratios of conversion speed to reading speed, one per round."""
    bag = write_bag(folder / "bag")
    options = BagOptions(camera=Lens(CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5)))
    ratios = []
    for k in range(rounds):
        read_s = _seconds(lambda: read_all(bag))
        ratios.append(read_s / _seconds(lambda out=folder / f"out{k}": convert_bag(bag, out, options)))  # type: ignore[misc]
        shutil.rmtree(folder / f"out{k}")
    return {"median": statistics.median(ratios), "min": min(ratios), "max": max(ratios)}


def _seconds(work: Callable[[], object]) -> float:
    start_s = time.perf_counter()
    work()
    return time.perf_counter() - start_s


def main() -> None:
    """Print the ratios as JSON."""
    with tempfile.TemporaryDirectory(prefix="flocc-bag-speed-") as folder:
        result = {"ratios": {"convert_over_read_speed": measure(Path(folder))}, "messages": MESSAGES}
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
