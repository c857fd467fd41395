"""What two robots tell each other of the poses that both have, in distributed mode: `shared-poses`, there and back."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.own_part import OwnedClosure, ToldPoses
from flocc_agent.geometry import pose7
from flocc_protocol.arrays import Array
from flocc_protocol.ids import LogId
from flocc_protocol.messages import SharedPoses

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ToldFrame:
    """In which frame a robot tells poses, and after which step.

    Attributes:
        anchor: Log after which the frame is named.
        number: Of the step.
        origin: (4, 4) where the map frame lies among the poses.
        origin_step: The anchor's step that said so.
    """

    anchor: LogId
    number: int
    origin: Float
    origin_step: int


@dataclass(slots=True)
class SharedPair:
    """What a robot shares with another, and what that one said last.

    Attributes:
        edition: Of the list of shared poses; 0 before there is one.
        keyframes: It: numbers in the higher robot's log.
        information: (S, 2) of the closures there; of an owner's own as its last step gave it.
        owned: Closures of the pair that this robot, the lower one, uses.
        said: The other's last message, of whatever edition.
        said_s: When that came.
        heard: The same, where it is of this edition and frame and no step has taken it yet.
        is_news: It came since the last step began.
        told: What this robot's last step wants told.
    """

    edition: int = 0
    keyframes: tuple[int, ...] = ()
    information: Array | None = None
    owned: tuple[OwnedClosure, ...] = ()
    said: SharedPoses | None = None
    said_s: float = float("-inf")
    heard: SharedPoses | None = None
    is_news: bool = True
    told: ToldPoses | None = None

    def message(self, frame: ToldFrame, is_lower: bool) -> SharedPoses:
        """What the other one is told; by the lower robot with the list of shared poses until the other one has it."""
        told = self.told
        assert told is not None
        has_list = self.said is not None and self.said.edition == self.edition
        information = self.information if is_lower and not has_list else None
        is_known = has_list and self.said is not None and self.said.known == told.number
        return SharedPoses(
            frame.anchor,
            frame.number,
            pose7(frame.origin),
            frame.origin_step,
            self.edition,
            () if information is None else self.keyframes,
            Array.of(np.zeros((0, 2))) if information is None else information,
            Array.of(told.base_m, "f8"),
            Array.of(told.rows),
            told.known,
            told.number,
            Array.of(np.zeros(0) if is_known else told.stiffness),
        )


def asking_for_list(frame: ToldFrame) -> SharedPoses:
    """What a lower robot is told whose list of shared poses is not here."""
    none, rows, information = (Array.of(np.zeros(shape)) for shape in (0, (0, 13), (0, 2)))
    base_m = Array.of(np.zeros(3), "f8")
    return SharedPoses(frame.anchor, frame.number, pose7(frame.origin), 0, 0, (), information, base_m, rows, 0, 0, none)


def told_by(message: SharedPoses) -> ToldPoses:
    """What a message tells, as numbers."""
    stiffness = message.stiffness.numpy()
    return ToldPoses(message.base_m.numpy(), message.rows.numpy(), message.known, message.stiffness_number, stiffness)
