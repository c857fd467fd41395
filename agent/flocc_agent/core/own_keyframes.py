"""This robot's keyframes between their capture and their record, and what was measured at them meanwhile.

Records are appended in the order of capture, whatever order the encoder ends in.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from flocc_agent.core.events import Withdrawn
from flocc_agent.core.measurements import WAITING_MAX, Measurement
from flocc_protocol.arrays import Array
from flocc_protocol.codec import Pose7


@dataclass(slots=True)
class OwnKeyframe:
    """A keyframe between capture and its record; `descriptor` stays None where it failed to encode."""

    index: int
    stamp_s: float
    T_odom_camera: Pose7
    is_encoded: bool = False
    descriptor: Array | None = None
    sha256: bytes = b""
    withdrawn: Withdrawn | None = None


class OwnKeyframes:
    """Keyframes that wait for the encoder, and measurements that wait for a keyframe's record."""

    def __init__(self) -> None:
        self._pending: list[OwnKeyframe] = []
        self._measured: dict[int, list[Measurement]] = {}

    def __len__(self) -> int:
        return len(self._pending)

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {"measurements": (sum(map(len, self._measured.values())), WAITING_MAX * max(len(self._pending), 1))}

    def captured(self, index: int, stamp_s: float, T_odom_camera: Pose7) -> None:
        """A keyframe goes to the encoder."""
        self._pending.append(OwnKeyframe(index, stamp_s, T_odom_camera))

    def encoded(self, index: int, descriptor: Array | None, sha256: bytes, withdrawn: Withdrawn | None = None) -> None:
        """The encoder is done with a keyframe, with or without a descriptor."""
        for pending in self._pending:
            if pending.index == index:
                pending.is_encoded, pending.descriptor, pending.sha256 = True, descriptor, sha256
                pending.withdrawn = withdrawn

    def ready(self) -> Iterator[OwnKeyframe]:
        """Those whose records are due, in the order of capture; each is taken out as it comes."""
        while self._pending and self._pending[0].is_encoded:
            yield self._pending.pop(0)

    def keep(self, measurement: Measurement, index: int) -> bool:
        """Let a measurement wait for the record of its keyframe; whether there is room for it."""
        waiting = self._measured.setdefault(index, [])
        if len(waiting) >= WAITING_MAX:
            return False
        waiting.append(measurement)
        return True

    def take_measured(self, index: int) -> list[Measurement]:
        """What waited for the record of a keyframe, in the order it was measured."""
        return self._measured.pop(index, [])
