"""One robot's part of a distributed optimisation: what its worker is asked, and what comes back.

Every robot holds its own graph and copies of the poses of higher robots at the ends of the closures that it owns: the
lower robot of a closure does. What two robots tell each other of the poses that both have is `ToldPoses`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

ROW_BYTES, HEAD_BYTES = 52, 26


@dataclass(frozen=True, slots=True, eq=False)
class ToldPoses:
    """What one robot tells another of the poses that both have, as it travels: in single precision from a position on.

    Attributes:
        base_m: (3,) from which positions are told.
        rows: (S, 13) position (m), quaternion w x y z, force (rotation first, in the pose's own tangent).
        known: Number of the receiver's penalty or stiffness that the sender has; 0 for none.
        number: Of the penalty by which a lower robot says this, or of a higher one's stiffness; 0 for none.
        stiffness: (N,) it; empty where the receiver has it.
    """

    base_m: Float
    rows: Float
    known: int = 0
    number: int = 0
    stiffness: Float = field(default_factory=lambda: np.zeros(0))

    @property
    def size_bytes(self) -> int:
        """Of what travels, without its envelope."""
        return HEAD_BYTES + ROW_BYTES * len(self.rows) + 4 * len(self.stiffness)


@dataclass(frozen=True, slots=True, eq=False)
class OwnedClosure:
    """A closure that a robot uses and owns.

    Attributes:
        closure: It.
        weight: In (0, 1], as it was chosen.
        scale: Metres per network unit at which it begins, None where Eq. (6) says it.
        T_low_high: (4, 4) pose of its higher end in its lower one where it was chosen.
    """

    closure: LoopClosure
    weight: float
    scale: float | None
    T_low_high: Float

    @property
    def ends(self) -> tuple[KeyframeId, KeyframeId]:
        """Query and match of the closure, which name it."""
        return self.closure.query, self.closure.match


@dataclass(frozen=True, slots=True, eq=False)
class SharedWith:
    """What a robot shares with another, and what it last heard of it.

    Attributes:
        edition: Of the list of shared poses.
        keyframes: The list, of the higher robot.
        information: (S, 2) of the closures there, of rotation and translation; None where this robot owns them.
        told: What it heard in this robot's frame since the last step; None for nothing.
        forgotten: What it heard before counts only where both have the shared poses in the same places.
    """

    edition: int
    keyframes: tuple[KeyframeId, ...]
    information: Float | None = None
    told: ToldPoses | None = None
    forgotten: bool = False


class ConsensusState:
    """Where a robot's part stands between two steps; only its worker looks inside."""

    __slots__ = ()


@dataclass(frozen=True, slots=True, eq=False)
class ConsensusProblem:
    """One step of one part.

    Attributes:
        log: Whose part.
        trajectory: Its odometry.
        owned: Closures that it uses: within it, and those between it and higher robots.
        shared: Of every robot with which it shares poses.
        T_alone: (N, 4, 4) where its first keyframes begin, in its own frame; odometry follows them.
        number: Of the step; later ones have higher ones.
        anchored: The part is the anchor's, once moved: its first keyframe's odometry says where the map frame lies.
        origin: (4, 4) where the map frame lies among the poses, as last heard; of the frame that is moved to, if any.
        move_to: A robot, and what it told in another frame into which the part is to be moved first; else None.
        state: Where the part stands; None before the first step.
    """

    log: LogId
    trajectory: Trajectory
    owned: tuple[OwnedClosure, ...]
    shared: Mapping[LogId, SharedWith]
    T_alone: Float
    number: int
    anchored: bool
    origin: Float | None = None
    move_to: tuple[LogId, ToldPoses] | None = None
    state: ConsensusState | None = None


@dataclass(frozen=True, slots=True)
class Apart:
    """How far two robots are from each other where they share poses.

    Attributes:
        m: The largest distance.
        strain: Mean square of all differences, over what both covariances allow: above 1 is more.
    """

    m: float
    strain: float

    def most(self, other: "Apart") -> "Apart":
        """The larger of both, each."""
        return Apart(max(self.m, other.m), max(self.strain, other.strain))


@dataclass(frozen=True, slots=True, eq=False)
class ConsensusStep:
    """What a step gave.

    Attributes:
        state: Where the part stands now.
        T_map_keyframe: (N, 4, 4) poses in the map frame.
        origin: (4, 4) where the map frame lies among the poses of the state.
        told: What each robot with which it shares poses is to be told.
        information: (S, 2) by the higher robots of these, of the owned closures at the shared poses.
        moved: Largest change of a number of a pose: metres, or entries of a rotation.
        gap: Largest difference from what neighbours told, likewise; 0 where nothing was heard.
        cost: Half the sum of the weighted squared residuals of what the robot owns.
        aligned: The part moved into the frame it was asked to move into.
        refused: Robots that told what cannot be, and why.
        apart: How far each robot that was heard is from this one, before the step or after it.
    """

    state: ConsensusState
    T_map_keyframe: Float
    origin: Float
    told: Mapping[LogId, ToldPoses]
    information: Mapping[LogId, Float]
    moved: float
    gap: float
    cost: float
    aligned: bool = False
    refused: Mapping[LogId, str] = field(default_factory=dict)
    apart: Mapping[LogId, Apart] = field(default_factory=dict)
