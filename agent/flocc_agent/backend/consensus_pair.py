"""What a robot knows of one with which it shares poses, and what the two tell each other (`backend/consensus.py`)."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, diags_array

from flocc_agent.backend.shared_stiffness import SharedStiffness, geometric_mean
from flocc_agent.core.own_part import Apart, ToldPoses
from flocc_agent.geometry import inverse, poses_from_tq, quaternions
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]
Int = NDArray[np.int64]

STIFFNESS_AFTER = (5, 12)
"""After which steps the higher robot says how stiff it holds what both share: first by a guess of its other neighbours,
then by what they said; dense graphs are at rest before the second. The lower one makes no penalty before the first."""
STIFFNESS_SAME = 0.05
"""One that differs by less, in its factors, is not said: a penalty need not be exact, only the same on both sides."""
RELAXATION = 0.8
"""Of what is heard; at 0.9 smallGrid3D comes apart, at 0.5 chains take half as long again."""
ANCHORING = 1e-4
"""Part of it that both sides add to their penalty; with more, long chains bend slowly."""
ANCHORING_UNKNOWN = 0.3
"""Part of it that is the penalty while nothing is known of the neighbour's stiffness."""
ALLOWED, ALLOWED_UNKNOWN = 4.0, 100.0
"""Mean square of a disagreement, in units of the penalty, that two robots may have on their way to each other: where it
is the mean of both stiffnesses, and so at most twice the inverse of both covariances together; and before that."""


@dataclass(frozen=True, slots=True, eq=False)
class Tidings:
    """What one robot tells another of the poses that both have.

    Attributes:
        T: (S, 4, 4) where it has them, in the common frame.
        force: (S, 6) gradient there of all that it knows from elsewhere; rotation first, in the pose's own tangent.
        known: Number of the receiver's stiffness, or of its penalty, that it has; 0 for none.
        number: Of the penalty by which this is said, or of how stiff the higher robot holds them; 0 for none.
        stiffness: That one; None where the receiver has it.
    """

    T: Float
    force: Float
    known: int = 0
    number: int = 0
    stiffness: SharedStiffness | None = None

    def told(self) -> ToldPoses:
        """As it travels: the first position in double, all else in single precision."""
        origin = self.T[0, :3, 3]
        rows = np.concatenate([self.T[:, :3, 3] - origin, quaternions(self.T[:, :3, :3]), self.force], axis=1)
        stiffness = np.zeros(0) if self.stiffness is None else self.stiffness.packed()
        return ToldPoses(origin, _single(rows), self.known, self.number, _single(stiffness))

    @staticmethod
    def of(told: ToldPoses, count: int) -> "Tidings":
        """Read what is told of so many poses.

        Raises:
            ValueError: It is of another number, not finite, or holds a quaternion without direction.
        """
        rows = np.asarray(told.rows, dtype=float)
        if rows.shape != (count, 13):
            raise ValueError(f"rows of the shape {rows.shape} are not {count} shared poses")
        T = poses_from_tq(rows[:, :7])
        T[:, :3, 3] += told.base_m
        stiffness = SharedStiffness.unpacked(told.stiffness, count) if len(told.stiffness) else None
        read = Tidings(T, rows[:, 7:], told.known, told.number, stiffness)
        read.check(count)
        return read

    def check(self, count: int) -> None:
        """Refuse what is not finite, of another size, or no stiffness.

        Raises:
            ValueError: It is; the sentence says what.
        """
        if self.T.shape != (count, 4, 4) or self.force.shape != (count, 6):
            raise ValueError(f"{len(self.T)} poses and {len(self.force)} forces are not {count} shared poses")
        if not (np.all(np.isfinite(self.T)) and np.all(np.isfinite(self.force))):
            raise ValueError("shared poses or forces are not finite")
        if self.stiffness is not None:
            if not self.number:
                raise ValueError("the stiffness of shared poses has no number")
            self.stiffness.check(count)


@dataclass(frozen=True, slots=True, eq=False)
class Numbered:
    """How stiff shared poses are held: by one robot of a pair alone, or by the penalty of both.

    Attributes:
        number: Step of the robot that made it; no other one of the pair has it.
        stiffness: As it travels.
    """

    number: int
    stiffness: SharedStiffness


@dataclass(slots=True, eq=False)
class PairedRobot:
    """What a robot knows of one with which it shares poses.

    Attributes:
        lower: Whether the robot itself is the lower of both.
        keyframes: The poses that both have.
        index: (S,) the shared poses among its own and its copies.
        closures: (S, 6, 6) information of the closures at each, diagonal.
        penalty: (6S, 6S) sparse information by which they are held to T.
        T: (S, 4, 4) where the neighbour said that it has them; None before it was heard.
        force: (6S,) what it asks for there besides the penalty.
        ours: What this robot made: the penalty if it is the lower one, else how stiff it holds the poses.
        theirs: What the neighbour made.
        mean_of: Number of what the higher robot said that is in the lower one's penalty.
        known: Number of the own one that the neighbour has.
        steps: Own steps since both share these poses.
        edition: Of the list of these poses.
    """

    lower: bool
    keyframes: tuple[KeyframeId, ...]
    index: Int
    closures: Float
    penalty: csc_array
    T: Float | None = None
    force: Float = field(default_factory=lambda: np.zeros(0))
    ours: Numbered | None = None
    theirs: Numbered | None = None
    mean_of: int = 0
    known: int = 0
    steps: int = 0
    edition: int = 0

    @property
    def version(self) -> int:
        """Number of the penalty; 0 where it is of the closures alone."""
        return number_of(self.ours if self.lower else self.theirs)

    @property
    def information(self) -> Float:
        """(S, 2) of the closures at each pose, of rotation and translation."""
        return np.asarray(np.einsum("sbb->sb", self.closures)[:, [0, 3]])

    def pull(self, T: Float) -> Float:
        """Gradient (6S,) where the shared poses are at `T`."""
        return np.asarray(self.force + self.penalty @ self._apart(T))

    def merit(self, T: Float) -> float:
        """What `pull` is the gradient of."""
        apart = self._apart(T)
        return float(self.force @ apart + 0.5 * apart @ self.penalty @ apart)

    def apart(self, T: Float) -> Apart:
        """How far the neighbour is from shared poses at `T`."""
        apart = self._apart(T)
        mean = float(apart @ self.penalty @ apart) / max(len(apart), 1)
        furthest_m = float(np.linalg.norm(apart.reshape(-1, 6)[:, 3:], axis=1).max(initial=0.0))
        return Apart(furthest_m, mean / (ALLOWED if self.version else ALLOWED_UNKNOWN))

    def hear(self, told: Tidings, here: Float) -> None:
        """Take a part of what the neighbour said in the place of what it said before.

        What a lower robot said by a penalty that is not here counts for nothing; it is told which one is.

        Args:
            told: It.
            here: (S, 4, 4) where the shared poses are.
        """
        self.known = told.known
        said = None if told.stiffness is None else Numbered(told.number, told.stiffness)
        if self.lower:
            self.theirs = said or self.theirs
        elif said is not None or not told.number:
            self._hold_by(said, here)
        if not self.lower and told.number != self.version:
            return
        force = told.force.ravel()
        if self.T is not None:
            force = RELAXATION * force + (1.0 - RELAXATION) * self.pull(told.T)
        self.T, self.force = told.T, force

    @property
    def is_asked(self) -> bool:
        """Whether it is to be found how stiff this robot holds the poses."""
        if not self.lower:
            return self.steps in STIFFNESS_AFTER
        return number_of(self.theirs) != self.mean_of and self.steps >= STIFFNESS_AFTER[0]

    def stiffen(self, stiffness: SharedStiffness, number: int, here: Float) -> None:
        """Take how stiff this robot holds the poses: the lower one makes the penalty of that.

        Args:
            stiffness: It.
            number: Of the step after which that was found.
            here: (S, 4, 4) where the shared poses are.

        Raises:
            ValueError: What the neighbour told has no mean with it.
        """
        if self.lower:
            assert self.theirs is not None, "the penalty is the mean of both"
            self.mean_of = self.theirs.number
            stiffness = geometric_mean(stiffness, self.theirs.stiffness)
        made = Numbered(number, stiffness.told(len(self.keyframes)))
        made.stiffness.check(len(self.keyframes))
        if self.ours is not None and not made.stiffness.differs(self.ours.stiffness) > STIFFNESS_SAME:
            return
        if self.lower:
            self._hold_by(made, here)
        else:
            self.ours = made

    def _hold_by(self, made: Numbered | None, here: Float) -> None:
        """Use another penalty, or that of the closures alone; the pull where the poses are stays."""
        if number_of(made) == self.version:
            return
        pull = None if self.T is None else self.pull(here)
        anchors = _diagonal(ANCHORING if made else ANCHORING_UNKNOWN, self.closures)
        self.penalty = anchors if made is None else csc_array(made.stiffness.matrix() + anchors)
        if self.lower:
            self.ours = made
        else:
            self.theirs = made
        if pull is not None:
            self.force = pull - self.penalty @ self._apart(here)

    def _apart(self, T: Float) -> Float:
        """Tangents (6S,) from where the neighbour has the shared poses to `T`."""
        assert self.T is not None
        return _differences(self.T, T).ravel()


def paired(lower: bool, keyframes: Sequence[KeyframeId], information: Float, edition: int = 0) -> PairedRobot:
    """A robot of which nothing was heard yet.

    Args:
        lower: Whether the robot itself is the lower of both.
        keyframes: The poses that both have.
        information: (S, 2) of the closures at each, of rotation and translation.
        edition: Of that list.
    """
    closures = np.repeat(information, 3, axis=1)[:, :, None] * np.eye(6)
    unplaced = np.zeros(len(keyframes), dtype=np.int64)
    penalty = _diagonal(ANCHORING_UNKNOWN, closures)
    return PairedRobot(lower, tuple(keyframes), unplaced, closures, penalty, edition=edition)


def number_of(made: Numbered | None) -> int:
    """The number of what was made; 0 where nothing was."""
    return 0 if made is None else made.number


def _diagonal(ratio: float, closures: Float) -> csc_array:
    """Information (6S, 6S) that is a part of that of closures (S, 6, 6), diagonal each."""
    return csc_array(diags_array(ratio * np.einsum("sbb->sb", closures).ravel()))


def _single(values: Float) -> Float:
    """Rounded as single precision does."""
    return np.asarray(values, dtype=np.float32)


def _differences(T: Float, there: Float) -> Float:
    """Tangent vectors (S, 6) from poses to others near them, `2 vec q` for the rotation."""
    D = inverse(T) @ there
    return np.concatenate([2.0 * quaternions(D[:, :3, :3])[:, 1:], D[:, :3, 3]], axis=1)
