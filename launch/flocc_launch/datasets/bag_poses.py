"""Poses of a bag's topic, read straight from the bytes where their layout allows.

Odometry has two covariances of 36 numbers that a recording does not keep; leaving them out makes conversion faster. The
first message is read by rosbags as well, and where the two do not agree rosbags reads them all.
"""

import struct
from typing import Any

from flocc_launch.datasets.bag_messages import checked_numbers, poses, stamp_ns, transform_numbers
from flocc_launch.datasets.bag_reader import Bag, BagTopic
from flocc_launch.datasets.source import DatasetError

Posed = tuple[int, tuple[float, ...]]
"""Stamp in nanoseconds and `tx ty tz qx qy qz qw`."""

STRINGS = {
    "nav_msgs/msg/Odometry": 2,
    "geometry_msgs/msg/PoseStamped": 1,
    "geometry_msgs/msg/PoseWithCovarianceStamped": 1,
}

WITH_COVARIANCE = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped")
LOST_COVARIANCE = 9999.0
"""What RTAB-Map writes where it lost its way."""


class PoseDecoder:
    """Called with a raw message, returns its poses."""

    def __init__(self, bag: Bag, topic: BagTopic) -> None:
        self._bag = bag
        self._topic = topic
        self._straight: bool | None = None if topic.type in STRINGS else False
        self._covariance = topic.type in WITH_COVARIANCE
        self._tail = 0
        self._names = b""
        self._frames: tuple[str, str] | None = None

    def __call__(self, raw: bytes) -> list[Posed]:
        """Poses of one message, in order.

        Raises:
            DatasetError: The message is not of the topic's type, a pose is broken, or odometry calls itself lost.
        """
        if self._straight:
            try:
                stamp_ns, numbers, covariance, names, tail = self._read(raw)
            except struct.error:
                return self._decoded(raw)
            if tail != self._tail or names != self._names:
                return self._decoded(raw)
            if covariance >= LOST_COVARIANCE:
                raise _lost(self._topic)
            return [(stamp_ns, checked_numbers(numbers, self._topic))]
        found = self._decoded(raw)
        if self._straight is None and found:
            self._straight = self._agrees(raw, found[0])
        return found

    def _decoded(self, raw: bytes) -> list[Posed]:
        message = self._bag.decoded(raw, self._topic)
        self._see_frames(message)
        covariance = getattr(getattr(message, "pose", None), "covariance", None)
        if covariance is not None and len(covariance) and covariance[0] >= LOST_COVARIANCE:
            raise _lost(self._topic)
        return list(poses(message, self._topic))

    def _see_frames(self, message: Any) -> None:
        """See that poses are of the frames of the first one.

        Raises:
            DatasetError: They are of others, as of another robot or of a map.
        """
        frames = (message.header.frame_id.lstrip("/"), getattr(message, "child_frame_id", "").lstrip("/"))
        self._frames = self._frames or frames
        if frames != self._frames:
            here, first = (" to ".join(name or "''" for name in names) for names in (frames, self._frames))
            raise DatasetError(f"topic {self._topic.name}: a pose is of the frames {here}, the first one of {first}")

    def _agrees(self, raw: bytes, expected: Posed) -> bool:
        try:
            stamp_ns, numbers, _, self._names, self._tail = self._read(raw)
            return (stamp_ns, checked_numbers(numbers, self._topic)) == expected
        except (struct.error, DatasetError):
            return False

    def _read(self, raw: bytes) -> tuple[int, tuple[float, ...], float, bytes, int]:
        """Stamp, pose, the first number behind it, the frames' names, and how many bytes there are from the pose on.

        The pose follows the frames' names, in CDR at a multiple of eight bytes.
        """
        ros1 = self._bag.ros1
        seconds, nanoseconds = struct.unpack_from("<iI", raw, 4)
        at = 12
        for _ in range(STRINGS[self._topic.type]):
            if not ros1:
                at = (at + 3) & ~3
            at += 4 + int.from_bytes(raw[at : at + 4], "little")
        names = raw[12:at]
        if not ros1:
            at = 4 + ((at - 4 + 7) & ~7)
        numbers: Any = struct.unpack_from("<7d", raw, at)
        covariance = struct.unpack_from("<d", raw, at + 56)[0] if self._covariance else 0.0
        return seconds * 10**9 + nanoseconds, numbers, covariance, names, len(raw) - at


class TransformDecoder:
    """Called with a raw message of transforms, returns the poses of one edge."""

    def __init__(self, bag: Bag, topic: BagTopic, edge: tuple[str, str]) -> None:
        self._bag = bag
        self._topic = topic
        self._edge = edge

    def __call__(self, raw: bytes) -> list[Posed]:
        """Poses of one message; none where it moves other frames.

        Raises:
            DatasetError: The message is not of the topic's type, or a transform is broken.
        """
        message = self._bag.decoded(raw, self._topic)
        return [
            (stamp_ns(each.header), transform_numbers(each.transform, self._topic))
            for each in message.transforms
            if (each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")) == self._edge
        ]


def _lost(topic: BagTopic) -> DatasetError:
    return DatasetError(
        f"topic {topic.name}: odometry calls itself lost (its covariance is {LOST_COVARIANCE:g} or more)"
    )
