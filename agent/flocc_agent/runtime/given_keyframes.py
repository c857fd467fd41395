"""Which keyframes a robot was given, by their stamps: what a measurement may belong to, known at the call.

The core numbers keyframes in the order in which they are given, and so does this.
"""

from bisect import bisect_left

from flocc_agent.core.measurements import BadMeasurement, Measurement, StartPose
from flocc_agent.core.robot import Robot
from flocc_protocol.records import KeyframeRecord

STAMP_TOLERANCE_S = 1e-3
"""A stamp names a keyframe when it is this close to the keyframe's."""


class GivenKeyframes:
    """Stamps of all keyframes of the own log, in their order."""

    def __init__(self, stamps_s: list[float] | None = None) -> None:
        self._stamps_s: list[float] = stamps_s or []
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
        if not self._stamps_s:
            raise BadMeasurement(f"{kind}: no keyframe was given yet that it could belong to")
        return len(self._stamps_s) - 1 if stamp_s is None else self.at(kind, stamp_s)

    def at(self, kind: str, stamp_s: float) -> int:
        """Number of the keyframe with a stamp, for a measurement of this kind.

        Raises:
            BadMeasurement: There is none.
        """
        if stamp_s < self._sorted[0][0] - STAMP_TOLERANCE_S:
            raise BadMeasurement(
                f"{kind} at {stamp_s} s: is older than the map, which begins at {self._sorted[0][0]} s"
            )
        at = bisect_left(self._sorted, (stamp_s - STAMP_TOLERANCE_S, -1))
        near = [entry for entry in self._sorted[at : at + 2] if abs(entry[0] - stamp_s) <= STAMP_TOLERANCE_S]
        if not near:
            raise BadMeasurement(f"{kind} at {stamp_s} s: no keyframe has this stamp")
        return min(near, key=lambda entry: abs(entry[0] - stamp_s))[1]
