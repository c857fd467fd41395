"""Poses of a bag's topic, read straight from the bytes where their layout allows.

Odometry has two covariances of 36 numbers that a recording does not keep; leaving them out makes conversion faster. The
first message is read by rosbags as well, and where the two do not agree rosbags reads them all.
"""

import struct
from typing import Any

from flocc_launch.datasets.bag_messages import checked_numbers, poses
from flocc_launch.datasets.bag_reader import Bag, BagTopic

Posed = tuple[int, tuple[float, ...]]
"""Stamp in nanoseconds and `tx ty tz qx qy qz qw`."""

STRINGS = {
    "nav_msgs/msg/Odometry": 2,
    "geometry_msgs/msg/PoseStamped": 1,
    "geometry_msgs/msg/PoseWithCovarianceStamped": 1,
}


class PoseDecoder:
    """Called with a raw message, returns its poses."""

    def __init__(self, bag: Bag, topic: BagTopic) -> None:
        self._bag = bag
        self._topic = topic
        self._straight: bool | None = None if topic.type in STRINGS else False

    def __call__(self, raw: bytes) -> list[Posed]:
        """Poses of one message, in order.

        Raises:
            DatasetError: The message is not of the topic's type, or a pose is broken.
        """
        if self._straight:
            try:
                stamp_ns, numbers = self._read(raw)
            except struct.error:
                return list(poses(self._bag.decoded(raw, self._topic), self._topic))
            return [(stamp_ns, checked_numbers(numbers, self._topic))]
        found = list(poses(self._bag.decoded(raw, self._topic), self._topic))
        if self._straight is None:
            self._straight = self._agrees(raw, found[0])
        return found

    def _agrees(self, raw: bytes, expected: Posed) -> bool:
        try:
            stamp_ns, numbers = self._read(raw)
        except struct.error:
            return False
        return (stamp_ns, checked_numbers(numbers, self._topic)) == expected

    def _read(self, raw: bytes) -> tuple[int, tuple[float, ...]]:
        """Stamp and pose; the pose follows the frames' names, in CDR at a multiple of eight bytes."""
        ros1 = self._bag.ros1
        seconds, nanoseconds = struct.unpack_from("<iI", raw, 4)
        at = 12
        for _ in range(STRINGS[self._topic.type]):
            if not ros1:
                at = (at + 3) & ~3
            at += 4 + int.from_bytes(raw[at : at + 4], "little")
        if not ros1:
            at = 4 + ((at - 4 + 7) & ~7)
        numbers: Any = struct.unpack_from("<7d", raw, at)
        return seconds * 10**9 + nanoseconds, numbers
