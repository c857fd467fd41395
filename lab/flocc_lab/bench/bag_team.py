"""A long bag of three robots with damaged messages: `python -m flocc_lab.bench.bag_team` prints speed, memory, counts.

The bag has odometry and JPEG images under a namespace each, 9 to 1; of its messages one in a hundred is cut short. It
is read by rosbags (every message deserialised, errors counted) and converted, each in a process of its own.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flocc_lab.bench import bag_speed

MESSAGES = 100_000
ROBOTS = ("alpha", "bravo", "charlie")
IMAGE_EVERY = 10
DAMAGED_RATIO = 0.01
SIZE = (320, 240)


def write_bag(path: Path, messages: int = MESSAGES, seed: int = 0) -> dict[str, dict[str, int]]:
    """Write the bag, and say how many messages each topic has and how many of them are damaged."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    rng = np.random.default_rng(seed)
    noise = cv2.resize(rng.integers(0, 256, (24, 32, 3), dtype=np.uint8), SIZE)
    jpeg = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, bag_speed.TRANSPORT_QUALITY])[1].ravel()
    kinds = {"odom": "nav_msgs/msg/Odometry", "camera/image/compressed": "sensor_msgs/msg/CompressedImage"}
    counts = {f"/{robot}/{leaf}": {"messages": 0, "damaged": 0} for robot in ROBOTS for leaf in kinds}
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            topic: writer.add_connection(topic, kinds[topic.split("/", 2)[2]], typestore=store) for topic in counts
        }
        for k in range(messages):
            leaf = "camera/image/compressed" if (k // len(ROBOTS)) % IMAGE_EVERY == 0 else "odom"
            topic, stamp_ns = f"/{ROBOTS[k % len(ROBOTS)]}/{leaf}", 10**18 + k * 10**7
            make = bag_speed.image if leaf != "odom" else bag_speed.odometry
            raw = bytes(store.serialize_cdr(make(store, stamp_ns, jpeg), kinds[leaf]))
            is_damaged = k >= 60 and rng.random() < DAMAGED_RATIO
            counts[topic]["messages"] += 1
            counts[topic]["damaged"] += is_damaged
            writer.write(connections[topic], stamp_ns, raw[: int(rng.integers(5, len(raw) - 4))] if is_damaged else raw)
    return counts


def read_all(path: Path) -> int:
    """Read and deserialise every message with rosbags alone; returns how many cannot be."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    damaged = 0
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, raw in reader.messages():
            try:
                reader.deserialize(raw, connection.msgtype)
            except Exception:  # noqa: BLE001 - whatever rosbags raises on a message that is cut
                damaged += 1
    return damaged


def convert_all(path: Path, out: Path, camera: Path) -> None:
    """Convert every robot of the bag."""
    from flocc_launch.datasets.commands import convert

    convert(path, out, camera=camera)


def timed(mode: str, *paths: Path) -> dict[str, float]:
    """Seconds and the largest memory of one of the two, in a process of its own."""
    ran = subprocess.run(
        [sys.executable, "-m", "flocc_lab.bench.bag_team", mode, *map(str, paths)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    found: dict[str, float] = json.loads(ran.stdout.splitlines()[-1])
    return {**found, "told": ran.stderr} if ran.stderr else found  # type: ignore[dict-item]


def measure(folder: Path, messages: int) -> dict[str, Any]:
    """Speed of conversion over that of reading, memory, and counts against what was written."""
    bag = folder / f"bag{messages}"
    counts = write_bag(bag, messages)
    (folder / "camera.yaml").write_text("width: 320\nheight: 240\nfx: 250\nfy: 250\ncx: 160\ncy: 120\n")
    read = timed("read", bag)
    converted = timed("convert", bag, folder / f"out{messages}", folder / "camera.yaml")
    told = str(converted.pop("told", ""))
    files = {t: f"{t.split('/')[1]}/{'odometry.tum' if 'odom' in t else 'images.txt'}" for t in counts}
    kept = {topic: count_lines(folder / f"out{messages}" / file) for topic, file in files.items()}
    right = {topic: kept[topic] == found["messages"] - found["damaged"] for topic, found in counts.items()}
    return {
        "messages": messages,
        "damaged": sum(found["damaged"] for found in counts.values()),
        "convert_over_read_speed": read["seconds"] / converted["seconds"],
        "convert_over_read_cpu_speed": read["cpu_s"] / converted["cpu_s"],
        "read": read,
        "convert": converted,
        "counts_right": right,
        "damaged_told": {
            t: f"{found['damaged']} of {found['messages']} messages" in told for t, found in counts.items()
        },
    }


def count_lines(path: Path) -> int:
    """Lines of a file."""
    with path.open("rb") as lines:
        return sum(1 for line in lines if not line.startswith(b"#"))


def main() -> None:
    """Measure, or do one of the two for whoever measures."""
    if len(sys.argv) > 1 and sys.argv[1] in ("read", "convert"):
        started_s, worked_s = time.perf_counter(), time.process_time()
        if sys.argv[1] == "read":
            read_all(Path(sys.argv[2]))
        else:
            convert_all(*map(Path, sys.argv[2:5]))
        status = Path("/proc/self/status").read_text(encoding="ascii")
        peak_mib = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024
        spent = {"seconds": time.perf_counter() - started_s, "cpu_s": time.process_time() - worked_s}
        sys.stdout.write(json.dumps({**spent, "peak_mib": peak_mib}) + "\n")
        return
    messages = int(sys.argv[1]) if len(sys.argv) > 1 else MESSAGES
    with tempfile.TemporaryDirectory(prefix="flocc-bag-team-") as folder:
        results = [measure(Path(folder), count) for count in (messages // 10, messages)]
    sys.stdout.write(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
