"""One robot's block of a distributed optimisation: what its worker is asked, and what comes back.

A lifted pose is (4, r): the three rows of a relaxed rotation, transposed, then the position (`block_descent.py`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class BlockState:
    """Where a robot's block stands between two iterations; only its worker looks inside.

    Attributes:
        X: (n, 4, r) poses that are shared with others.
        X_before: (n, 4, r) poses before the last extrapolation.
        age: Iterations since the extrapolation last started anew.
        weights: Robust weight of each closure that is this robot's to decide.
        control: Control parameter of graduated non-convexity; None where it has ended.
        in_stage: Iterations since the weights were last decided.
        epoch: Number of the graduation that the weights come from.
        has_unjudged: A closure came since that did not agree; it waits, without weight, for the next graduation.
    """

    X: Float
    X_before: Float
    age: int = 0
    weights: Mapping[CandidatePair, float] = field(default_factory=dict)
    control: float | None = None
    in_stage: int = 0
    epoch: int = 0
    has_unjudged: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class BlockProblem:
    """One iteration of one block.

    Attributes:
        log: Whose block.
        trajectory: Its odometry.
        closures: Closures with at least one end in it.
        others: (4, r) pose of other robots' keyframes at the far ends of closures, as last heard, in this frame.
        heard: Robust weights that other robots decided.
        epoch: Latest graduation that another robot began.
        anchored: The block is the anchor's: its first keyframe's odometry says where the map frame lies.
        origin: (4, r) where the map frame lies among the poses, as last heard; of the frame of `align_to`, if any.
        align_to: Other robots' keyframes in another frame into which the block is to be moved first; else empty.
        state: Where the block stands; None before the first iteration.
    """

    log: LogId
    trajectory: Trajectory
    closures: tuple[LoopClosure, ...]
    others: Mapping[KeyframeId, Float]
    heard: Mapping[CandidatePair, float]
    epoch: int
    anchored: bool
    origin: Float | None
    align_to: Mapping[KeyframeId, Float]
    state: BlockState | None


@dataclass(frozen=True, slots=True, eq=False)
class BlockStep:
    """What an iteration gave.

    Attributes:
        state: Where the block stands now.
        T_map_keyframe: (n, 4, 4) rounded poses in the map frame.
        origin: (4, r) where the map frame lies among the poses of the state.
        moved: Largest change of a number of a pose: metres, or entries of a rotation.
        aligned: The block moved into the frame it was asked to move into.
        finished: Robust weights are final.
        rejected: Closures of this robot's decision with weight zero.
    """

    state: BlockState
    T_map_keyframe: Float
    origin: Float
    moved: float
    aligned: bool
    finished: bool
    rejected: int


def decides(closure: LoopClosure) -> LogId:
    """The robot that decides a closure's robust weight: the lower of its two ends."""
    return min(closure.query.log, closure.match.log)
