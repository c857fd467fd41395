"""The pose graph: odometry of every log, loop closures between keyframes, what else was measured, and its solution.

Nodes are keyframe *camera* poses. A log's poses are given in its own `odom` frame; a component's solution is in
one `map` frame that is named after the component's anchor, its lowest log.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.geodesy import Place
from flocc_agent.core.saved_map import SavedMap
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

LANDMARK = "~"
"""Begins the names of landmarks: no robot's does, and it sorts after all of them."""
WORLD, EARTH = "world", "earth"
"""The landmarks that fixes tell of: the origin of a local frame, and of east, north and up."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Odometry of one log.

    Attributes:
        T_odom_keyframe: (N, 4, 4) camera poses in the log's odom frame, metric.
        edge_covariances: (N-1, 6, 6) covariance of each consecutive edge (tangent of the later pose, rotation
            first), NaN where an edge has none, or None: the back end's configured model stands for it.
    """

    T_odom_keyframe: Float
    edge_covariances: Float | None = None

    def __len__(self) -> int:
        return len(self.T_odom_keyframe)


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """A registered pair of keyframes.

    Attributes:
        query: Keyframe i of robot alpha.
        match: Keyframe j of robot beta; the same robot for an intra-robot closure.
        T_query_match_unscaled: (4, 4); translation in network units, or metres where `metric`.
        match_ratio: Eq. (1).
        scale_initial: Metres per network unit by Eq. (6), None if unknown.
        covariance: (6, 6) of the measurement in its own units, or None for the back end's configured model.
        metric: The translation is in metres and no scale is estimated.
        support: How many closures it counts as where maps are joined; a single one may be wrong.
        weight: How much of its information counts: less where what it shows is known to have changed.
        doubt: Why it counts only where others agree with it; else empty.
    """

    query: KeyframeId
    match: KeyframeId
    T_query_match_unscaled: Float
    match_ratio: float = 1.0
    scale_initial: float | None = None
    covariance: Float | None = None
    metric: bool = False
    support: int = 1
    weight: float = 1.0
    doubt: str = ""

    @property
    def from_images(self) -> bool:
        """Whether it was registered from two images; else something measured stands for it, or an opened map."""
        return self.support == 1


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredFactor:
    """Something measured at a keyframe besides odometry and images: a relative pose, or a relative position alone.

    Attributes:
        kind: Of the measurement, as users name it.
        at: The keyframe at which it was measured.
        query: From where it is told: a keyframe, or a landmark (`landmark`).
        match: What it tells of: a keyframe, or a landmark.
        T_query_match: (4, 4), metric; the rotation is the identity where only the position is known.
        covariance: (6, 6) in the tangent of that pose, rotation first; or (3, 3) of the position, in the query's frame.
        place: Of a geodetic fix, whose position is measured from there; None for all others.
    """

    kind: str
    at: KeyframeId
    query: KeyframeId
    match: KeyframeId
    T_query_match: Float
    covariance: Float
    place: Place | None = None

    @property
    def has_rotation(self) -> bool:
        """Whether the whole pose is measured."""
        return self.covariance.shape == (6, 6)

    def __str__(self) -> str:
        other = self.match if self.query == self.at else self.query
        if not is_landmark(other.log):
            return f"{self.kind} of {other} at {self.at}"
        _, _, name = other.log.robot.partition("/")
        return f"{self.kind} {name} at {self.at}" if name else f"{self.kind} at {self.at}"


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """Everything the optimiser needs, for all components at once.

    Attributes:
        trajectories: Odometry of every log.
        closures: Between their keyframes.
        measured: What else was measured.
        saved: The opened map, whose logs are among the others; None where there is none.
    """

    trajectories: Mapping[LogId, Trajectory]
    closures: Sequence[LoopClosure] = ()
    measured: Sequence[MeasuredFactor] = ()
    saved: SavedMap | None = None


class ClosureState(Enum):
    """What the solver made of a closure."""

    USED = "used"
    REJECTED = "rejected as an outlier"
    EXCLUDED = "excluded before solving"


@dataclass(frozen=True, slots=True, eq=False)
class ClosureResult:
    """One closure after optimisation.

    Attributes:
        query: As in the closure.
        match: As in the closure.
        state: Used, rejected or excluded.
        weight: Robust weight in [0, 1]; 0 where not used.
        scale: Metres per network unit, None where not estimated or not used.
        residual: Mahalanobis norm of the residual at the solution, NaN-free; 0 where excluded.
        reason: Why it was excluded, else empty.
    """

    query: KeyframeId
    match: KeyframeId
    state: ClosureState
    weight: float
    scale: float | None
    residual: float
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class FactorResult:
    """One measured factor after optimisation; its fields are those of a closure's result."""

    factor: MeasuredFactor
    state: ClosureState
    weight: float
    residual: float
    reason: str = ""


@dataclass(frozen=True, slots=True)
class OdometryScale:
    """How long a robot's odometry measures one metre.

    Attributes:
        ratio: Measured over true length, 1 where it is true.
        sigma_ratio: Standard deviation of `ratio`.
        is_applied: The solution holds the robot's way to be shorter or longer than measured.
        is_metric: Something in the component was measured in metres besides odometry; else ratios are relative to the
            mean of its robots.
    """

    ratio: float
    sigma_ratio: float
    is_applied: bool
    is_metric: bool


@dataclass(frozen=True, slots=True, eq=False)
class Component:
    """One connected part of the graph, solved in one map frame.

    Attributes:
        logs: Its logs, sorted, those of an opened map before all others; the first is the anchor.
        T_map_keyframe: (N, 4, 4) corrected camera poses of each log.
        T_map_odom: (4, 4) of each log: `T_map_keyframe[-1] @ inverse(T_odom_keyframe[-1])`.
        covariance_map_odom: (6, 6) marginal covariance of each log's `T_map_odom`, or None where not computed.
        cost: Sum of half squared weighted residuals at the solution.
        cost_initial: The same where the solver started.
        covariance_keyframe: (6, 6) marginal covariance of keyframes that were asked for, in their own tangent spaces.
        T_map_world: (4, 4) pose of the fixes' world frame, or None without fixes.
        T_map_landmark: (4, 4) pose of each landmark, by name: `tag/NAME`, `world`, `earth` (east, north, up).
        covariance_rounds: How many rounds ago `covariance_map_odom` was computed; 0 for this one.
        odometry_scales: Of each log whose odometry could be compared with something.
        covariance_factors: What the variances of each log's rotations and translations were multiplied by, because
            residuals are larger than stated uncertainties or keep their direction; at least 1.
    """

    logs: tuple[LogId, ...]
    T_map_keyframe: Mapping[LogId, Float]
    T_map_odom: Mapping[LogId, Float]
    covariance_map_odom: Mapping[LogId, Float | None]
    cost: float = 0.0
    cost_initial: float = 0.0
    covariance_keyframe: Mapping[KeyframeId, Float] = field(default_factory=dict)
    T_map_world: Float | None = None
    T_map_landmark: Mapping[str, Float] = field(default_factory=dict)
    covariance_rounds: int = 0
    odometry_scales: Mapping[LogId, OdometryScale] = field(default_factory=dict)
    covariance_factors: Mapping[LogId, tuple[float, float]] = field(default_factory=dict)

    @property
    def anchor(self) -> LogId:
        """The log whose start fixes the map frame."""
        return self.logs[0]

    @property
    def map_frame(self) -> str:
        """Name of the map frame, from the anchor."""
        return map_frame(self.anchor)


@dataclass(frozen=True, slots=True, eq=False)
class GraphSolution:
    """The optimised pose graph.

    Attributes:
        components: Every connected part, sorted by anchor; every log is in exactly one.
        closures: One result per closure of the graph, in its order.
        warnings: Sentences: scale unobservable or collapsed, exclusions, ill-conditioned parts.
        iterations: Linear solves that were done.
        solve_s: Wall time of the solve (0 on virtual time).
        measured: One result per measured factor of the graph, in its order.
        whole: The last solution for which all closures were judged, where this one rests on its choice; else None.
    """

    components: tuple[Component, ...]
    closures: tuple[ClosureResult, ...]
    warnings: tuple[str, ...] = ()
    iterations: int = 0
    solve_s: float = 0.0
    timings_s: Mapping[str, float] = field(default_factory=dict)
    measured: tuple[FactorResult, ...] = ()
    whole: "GraphSolution | None" = None


@dataclass(frozen=True, slots=True)
class OptimisationFailed:
    """The back end could not solve; the last good solution stands."""

    reason: str


class LandmarkLog(LogId):
    """What stands for a log where a landmark is: its name is none that a robot may have."""

    __slots__ = ()

    def __new__(cls, robot: str, incarnation: int = 0) -> "LandmarkLog":
        """Take any name."""
        return tuple.__new__(cls, (robot, incarnation))


def landmark(name: str) -> KeyframeId:
    """A landmark, which is in the graph what a robot with one keyframe would be."""
    return KeyframeId(LandmarkLog(LANDMARK + name), 0)


def is_landmark(log: LogId) -> bool:
    """Whether this is no robot's log."""
    return log.robot.startswith(LANDMARK)


def stretched(trajectory: Trajectory, ratio: float) -> Trajectory:
    """A way of the same shape that is `ratio` times as long."""
    T = np.array(trajectory.T_odom_keyframe, dtype=float)
    T[:, :3, 3] = T[0, :3, 3] + ratio * (T[:, :3, 3] - T[0, :3, 3])
    return replace(trajectory, T_odom_keyframe=T)


def map_frame(anchor: LogId) -> str:
    """Name of the map frame of the component whose lowest log is the anchor."""
    return f"map/{anchor}"


def components_of(logs: Sequence[LogId], closures: Sequence[LoopClosure]) -> tuple[tuple[LogId, ...], ...]:
    """Group logs that closures connect; each group sorted, groups sorted by their lowest log."""
    return groups_of(logs, [(closure.query.log, closure.match.log) for closure in closures])


Node = TypeVar("Node", LogId, KeyframeId)


def groups_of(logs: Sequence[Node], links: Sequence[tuple[Node, Node]]) -> tuple[tuple[Node, ...], ...]:
    """Group logs, or parts of them, that links connect; each group sorted, groups sorted by their lowest one."""
    parent = {log: log for log in logs}

    def root(log: Node) -> Node:
        while parent[log] != log:
            parent[log] = parent[parent[log]]
            log = parent[log]
        return log

    for a, b in links:
        if a in parent and b in parent:
            low, high = sorted((root(a), root(b)))
            parent[high] = low
    groups: dict[Node, list[Node]] = {}
    for log in sorted(logs):
        groups.setdefault(root(log), []).append(log)
    return tuple(tuple(groups[anchor]) for anchor in sorted(groups))
