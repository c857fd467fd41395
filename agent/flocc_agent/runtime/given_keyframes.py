"""Which keyframes a robot was given, by their stamps: what a measurement may belong to, known at the call.

The core numbers keyframes in the order in which they are given, and so does this.
"""

from bisect import bisect_left

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
    """Stamps of all keyframes of the own log, in their order."""

    def __init__(self, stamps_s: list[float] | None = None) -> None:
        self._stamps_s: list[float] = stamps_s or []
        self._restored = len(self._stamps_s)
        self._sorted: list[tuple[float, int]] = sorted((stamp_s, k) for k, stamp_s in enumerate(self._stamps_s))

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
        entry = (stamp_s, len(self._stamps_s))
        self._stamps_s.append(stamp_s)
        if not self._sorted or self._sorted[-1] <= entry:
            self._sorted.append(entry)
        else:
            self._sorted.insert(bisect_left(self._sorted, entry), entry)

    def between(self, after_s: float, until_s: float) -> list[float]:
        """Stamps in (after, until], in order."""
        first, end = (bisect_left(self._sorted, (stamp_s, len(self))) for stamp_s in (after_s, until_s))
        return [stamp_s for stamp_s, _ in self._sorted[first:end]]

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
        if not self._sorted:
            raise BadMeasurement(f"{kind}: no keyframe was given yet that it could belong to")
        if stamp_s < self._sorted[0][0] - STAMP_TOLERANCE_S:
            raise BadMeasurement(
                f"{kind} at {stamp_s} s: is older than the map, which begins at {self._sorted[0][0]} s"
            )
        first, end = (
            bisect_left(self._sorted, (stamp_s + tolerance_s, index))
            for tolerance_s, index in ((-STAMP_TOLERANCE_S, -1), (STAMP_TOLERANCE_S, len(self)))
        )
        if first == end:
            raise BadMeasurement(f"{kind} at {stamp_s} s: no keyframe has this stamp")
        return min(self._sorted[first:end], key=lambda entry: (abs(entry[0] - stamp_s), -entry[1]))[1]
