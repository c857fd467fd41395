"""Which keyframes a robot was given, by their stamps: what a measurement may belong to, known at the call.

The core numbers keyframes in the order in which they are given, and so does this.
"""

from array import array
from bisect import bisect_left
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.measurements import BadMeasurement, Measurement, StartPose
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import is_rigid, pose7
from flocc_protocol.codec import Pose7
from flocc_protocol.errors import FloccError
from flocc_protocol.records import KeyframeRecord, encode_record

Float = NDArray[np.float64]

STAMP_TOLERANCE_S = 1e-3
"""A stamp names a keyframe when it is this close to the keyframe's."""


class BadKeyframe(FloccError):
    """A keyframe that cannot be used; the agent goes on without it."""


def checked_keyframe(T_odom_camera: Float, stamp_s: float) -> Pose7:
    """The pose of a keyframe as its record has it.

    Raises:
        BadKeyframe: The pose is not finite and rigid, or pose or stamp are beyond what a log may hold.
    """
    try:
        T_odom = np.asarray(T_odom_camera, dtype=float)
        if not is_rigid(T_odom):
            raise BadKeyframe(f"keyframe at {stamp_s} s: its pose is not finite and rigid")
        T = pose7(T_odom)
        encode_record(KeyframeRecord(0, stamp_s, T, None))
    except (TypeError, ValueError) as error:
        raise BadKeyframe(f"keyframe at {stamp_s} s: {error}") from error
    return T


class GivenKeyframes:
    """Stamps of all keyframes of the own log, which may come in any order: 12 bytes for each."""

    def __init__(self, stamps_s: Iterable[float] = ()) -> None:
        self._stamps_s = array("d")
        self._order = array("I")
        for stamp_s in stamps_s:
            self.add(stamp_s)
        self._restored = len(self)

    @classmethod
    def of(cls, robot: Robot) -> "GivenKeyframes":
        """Those that a robot's log holds when it starts; one that a later version wrote has no stamp here."""
        copy = robot.gossip.logs[robot.log]
        stamps_s = [float("inf")] * copy.keyframes
        for record in copy.records:
            if isinstance(record, KeyframeRecord):
                stamps_s[record.index] = record.stamp_s
        return cls(stamps_s)

    def __len__(self) -> int:
        return len(self._stamps_s)

    def add(self, stamp_s: float) -> None:
        """The next keyframe was given."""
        number = len(self)
        self._stamps_s.append(stamp_s)
        newest = self._entry(self._order[-1]) if self._order else (float("-inf"), -1)
        if newest <= (stamp_s, number):
            self._order.append(number)
        else:
            self._order.insert(bisect_left(self._order, (stamp_s, number), key=self._entry), number)

    def index_of(self, measurement: Measurement, stamp_s: float | None) -> int:
        """Number of the keyframe that a measurement belongs to: the last one, or the one with this stamp.

        Raises:
            BadMeasurement: There is none.
        """
        kind = measurement.kind
        if isinstance(measurement, StartPose):
            return 0
        if len(self) == (self._restored if stamp_s is None else 0):
            raise BadMeasurement(f"{kind}: no keyframe was given yet that it could belong to")
        return len(self) - 1 if stamp_s is None else self.at(kind, stamp_s)

    def at(self, kind: str, stamp_s: float) -> int:
        """Number of the keyframe nearest to a stamp, for a measurement of this kind; of several the newest.

        Raises:
            BadMeasurement: There is none.
        """
        if not self._order:
            raise BadMeasurement(f"{kind}: no keyframe was given yet that it could belong to")
        oldest_s = self._stamps_s[self._order[0]]
        if stamp_s < oldest_s - STAMP_TOLERANCE_S:
            raise BadMeasurement(f"{kind} at {stamp_s} s: is older than the map, which begins at {oldest_s} s")
        first, end = (
            bisect_left(self._order, (stamp_s + tolerance_s, index), key=self._entry)
            for tolerance_s, index in ((-STAMP_TOLERANCE_S, -1), (STAMP_TOLERANCE_S, len(self)))
        )
        if first == end:
            raise BadMeasurement(f"{kind} at {stamp_s} s: no keyframe has this stamp")
        return min(self._order[first:end], key=lambda number: (abs(self._stamps_s[number] - stamp_s), -number))

    def _entry(self, number: int) -> tuple[float, int]:
        """By what keyframes are in order."""
        return self._stamps_s[number], number
