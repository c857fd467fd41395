"""What a robot holds for or against a correction of its log: closures and fixes, as offsets from where it puts it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.closure_rows import Tie
from flocc_agent.core.geodesy import T_earth_enu
from flocc_agent.core.knots import corrected
from flocc_agent.core.pose_graph import MeasuredFactor, is_landmark
from flocc_agent.geometry import between, inverse, umeyama
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import LogCorrection

Float = NDArray[np.float64]
Int = NDArray[np.intp]

VIEW_M, VIEW_STEPS, VIEW_LENGTHS = 10.0, 10.0, 3.0
"""Cameras of one closure are this near: metres, steps of the odometry, lengths of the measured translation."""
DRIFT_RATIO = 0.3
"""How far a keyframe may be off where only the newest one's correction is known, against the way between the two."""
WOUND_RATIO = 0.05
"""The same for two keyframes of one way that winds, whose places are off together, besides the line between the two."""
WARPED_RATIO = 0.75
"""How far odometry may lead away from where it was measured last, against its own way from there: a wrong scale."""
BROKEN_M, BROKEN_RAD = 1.0, np.deg2rad(30.0)
"""A step that is changed by more, beyond its own length, was broken."""
TIES_MIN = 3
"""Fewer say nothing: one closure may be wrong."""
TORN_RUN = 6
"""So many closures one after the other that all say the same are no accident."""
LINKED = 3
"""A measured keyframe says something of this many before it: one between them may be wrong."""
DENIED = 1
"""By so many pairs of measured keyframes more a jump may be denied than demanded: one false one is in several."""
MADE_BY_JUMPS = 1.2
"""Jumps turn a robot, too: a path is a little longer than the straight line that was measured."""


class HeldGraph(Protocol):
    """What a robot knows of the graph itself."""

    def odometry(self, log: LogId) -> Float:
        """T_odom_camera (N, 4, 4) of the known keyframes of a log."""
        ...

    def ties(self, log: LogId, ties_max: int) -> Sequence[Tie]:
        """The newest closures of a log."""
        ...

    def measured(self, log: LogId) -> Sequence[MeasuredFactor]:
        """What else was measured at a log's keyframes, or of them."""
        ...

    def joined(self, log: LogId, other: LogId) -> bool:
        """Whether closures or other measurements lead from one log to the other; a record of a later version may."""
        ...


@dataclass(frozen=True, slots=True)
class Placed:
    """Corrections of one moment: this robot's, whole, and of the other logs what is known."""

    own: LogCorrection
    others: Mapping[LogId, LogCorrection]


@dataclass(frozen=True, slots=True, eq=False)
class _Between:
    """Two measured keyframes of a log.

    Attributes:
        first: The earlier one.
        last: The later one.
        off_m: (3,) how much more the later one is off from where it was measured, in the map.
        slack_m: How far that may be wrong.
    """

    first: int
    last: int
    off_m: Float
    slack_m: float

    def demands(self, jump_m: Float) -> int:
        """Whether what was measured demands that the later one jumped by so much: 1, or denies it: -1; 0 if unsure."""
        with_m, without_m = float(np.linalg.norm(self.off_m)), float(np.linalg.norm(self.off_m - jump_m))
        slack_m = self.slack_m + BROKEN_M
        return int(with_m + slack_m < without_m) - int(without_m + slack_m < with_m)


@dataclass(frozen=True, slots=True, eq=False)
class _Agreement:
    """How far off (K, 3) a correction puts measured keyframes, in their order, and how far that may be (K,).

    Where the other ends are known in short only they may be off together, so that some that agree say nothing.
    """

    off_m: Float
    may_m: Float
    exact: bool

    def is_torn(self) -> bool:
        """Whether they agree with each other, and not with the correction.

        False ones point anywhere; those of a robot that was put elsewhere point to where it is, all along or in a part.
        """
        holds = np.linalg.norm(self.off_m, axis=1) <= self.may_m
        torn = np.flatnonzero(~holds)
        if len(torn) < TIES_MIN:
            return False
        differ_m = np.linalg.norm(np.diff(self.off_m[torn], axis=0), axis=1)
        agree = differ_m <= np.minimum(self.may_m[torn[1:]], self.may_m[torn[:-1]])
        if 1 + int(agree.sum()) >= max(TIES_MIN, int(holds.sum())):
            return True
        ends = np.flatnonzero(~(agree & (np.diff(torn) == 1)))
        runs = np.diff(np.concatenate([[-1], ends, [len(agree)]]))
        return bool(runs.max() >= TORN_RUN) and self.exact


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionEvidence:
    """Closures of a log in the order of its keyframes, and what else was measured there.

    Attributes:
        groups: Measurements that tell of the same: of where this log lies among others, of itself, in one frame.
        pins: (P,) keyframes whose place is known.
        links: Pairs of keyframes between which something was measured.
        view_m: How far cameras of one place are apart.
    """

    groups: Sequence[_Agreement]
    pins: Int
    links: Sequence[_Between]
    view_m: float

    def is_torn(self) -> bool:
        """Whether measurements agree with each other, and not with the correction."""
        return any(group.is_torn() for group in self.groups)

    def explains(self, camera: Float, odometry: Float) -> bool:
        """Whether odometry (N, 4, 4) is broken or warped by poses (N, 4, 4) only where that was measured."""
        steps, told = between(odometry[:-1], odometry[1:]), between(camera[:-1], camera[1:])
        more_m = told[:, :3, 3] - steps[:, :3, 3]
        lengths_m, more = np.linalg.norm(steps[:, :3, 3], axis=1), np.linalg.norm(more_m, axis=1)
        excess_m = np.maximum(more - lengths_m, 0.0)
        if excess_m.sum() > self.view_m:
            along = more_m * (excess_m / np.maximum(more, 1e-12))[:, None]
            jumps_m = (camera[:-1, :3, :3] @ along[..., None])[..., 0]
            left = self._unexplained(excess_m, jumps_m)
            if left @ excess_m > self.view_m:
                return False
        traces = np.einsum("kii->k", between(steps, told)[:, :3, :3])
        turned = np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0))
        broken = np.flatnonzero((excess_m > BROKEN_M) | (turned > BROKEN_RAD))
        return not self._is_warped(camera, odometry, np.concatenate([[0.0], np.cumsum(lengths_m)]), broken)

    def _unexplained(self, excess_m: Float, jumps_m: Float) -> Float:
        """Which share (N,) of jumps (N, 3) of these lengths (N,) nothing demands, or more denies than demands.

        Jumps that add up to nothing between two measured keyframes were not measured.
        """
        left, votes = np.ones(len(excess_m)), np.zeros(len(excess_m))
        for link in sorted(self.links, key=lambda link: link.last - link.first):
            part = slice(link.first, link.last)
            demanded = link.demands(jumps_m[part].sum(axis=0))
            votes[part] += demanded
            length_m = float(left[part] @ excess_m[part])
            if demanded >= 0 and length_m > BROKEN_M:
                measured_m = MADE_BY_JUMPS * float(np.linalg.norm(left[part] @ jumps_m[part]))
                left[part] *= 1.0 - min(1.0, measured_m / length_m)
        return np.where(votes < -DENIED, 1.0, left)

    def _is_warped(self, camera: Float, odometry: Float, way_m: Float, broken: Int) -> bool:
        """Whether anything is farther from the measured keyframe before it than odometry and the next one explain."""
        pins = self.pins if len(self.pins) else np.zeros(1, dtype=np.intp)
        numbers = np.arange(len(camera))
        before = np.clip(np.searchsorted(pins, numbers, side="right") - 1, 0, None)
        after = np.minimum(before + 1, len(pins) - 1)
        base, inside = pins[before], (numbers >= pins[0]) & (numbers < pins[-1])
        between_m = _apart_m(camera, odometry, pins[before], pins[after]) * inside
        if len(broken):
            k = np.searchsorted(broken, numbers, side="left") - 1
            since = np.where(k >= 0, broken[np.maximum(k, 0)] + 1, 0)
            base = np.where(inside, np.maximum(base, since), base)
        may_m = WARPED_RATIO * np.abs(way_m - way_m[base]) + self.view_m + between_m
        return bool((_apart_m(camera, odometry, base, numbers) > may_m).any())


def _apart_m(one: Float, other: Float, first: Int, last: Int) -> Float:
    """How much two trajectories differ in where they see later keyframes (K,) from earlier ones (K,)."""
    seen, told = between(one[first], one[last]), between(other[first], other[last])
    return np.asarray(np.linalg.norm(seen[:, :3, 3] - told[:, :3, 3], axis=1))


def evidence_of(
    placed: Placed, closures: Sequence[Tie], camera: Float, odometry: Float, graph: HeldGraph
) -> CorrectionEvidence:
    """What closures of a correction's log and its measurements say of it, as far as the other ends are known."""
    own, near_m = placed.own.log, view_m(odometry)
    ties, fixes = _ties_and_fixes(own, closures, len(odometry), graph)
    ends = [_End(0, np.zeros(3), 0.0, 0.0, None)] if placed.own.anchor == own else []
    within = list[_End]()
    for far, of_log in ties.items():
        found = _seen(placed, far, of_log, camera, graph)
        made = [
            _End(tie.near, off, sigma_m, near_m + VIEW_LENGTHS * tie.length_m + sigma_m, tie.far)
            for tie, off, sigma_m in found
        ]
        (within if far == own else ends).extend(made)
    fitted = [_fitted(of_landmark, camera, near_m) for of_landmark in fixes.values()]
    links = [end.loop() for end in within if end.holds] + _chained([end for end in ends if end.holds], graph)
    for each in fitted:
        links += _chained(each, graph)
    pins = [end.near for each in (ends, *fitted) for end in each if end.holds]
    return CorrectionEvidence(
        groups=[
            _agreement(each) for each in (ends, [end for end in ends if end.sigma_m == 0.0], within, *fitted) if each
        ],
        pins=np.unique([*pins, *(k for link in links for k in (link.first, link.last))]).astype(np.intp),
        links=links,
        view_m=near_m,
    )


def _agreement(ends: "list[_End]") -> _Agreement:
    ends = sorted(ends, key=lambda end: end.near)
    exact = all(end.sigma_m == 0.0 for end in ends)
    return _Agreement(np.array([end.off_m for end in ends]), np.array([end.may_m for end in ends]), exact)


@dataclass(frozen=True, slots=True, eq=False)
class _End:
    """A keyframe whose place is known.

    Attributes:
        near: It.
        off_m: (3,) how far off it was put.
        sigma_m: How far that may be wrong.
        may_m: How far off it may be.
        far: From where its place is known, where that is a keyframe.
    """

    near: int
    off_m: Float
    sigma_m: float
    may_m: float
    far: KeyframeId | None

    @property
    def holds(self) -> bool:
        """Whether it is where it should be."""
        return bool(np.linalg.norm(self.off_m) <= self.may_m)

    def loop(self) -> _Between:
        """As a link, where its place is known from the same log."""
        assert self.far is not None
        later = self.near > self.far.index
        first, last = sorted((self.near, self.far.index))
        return _Between(first, last, self.off_m if later else -self.off_m, 0.0)


def _chained(ends: list[_End], graph: HeldGraph) -> list[_Between]:
    """Links from each keyframe to some before it."""
    ends = sorted(ends, key=lambda end: end.near)
    pairs = [(one, ends[k + n]) for n in range(1, LINKED + 1) for k, one in enumerate(ends[:-n])]
    return [
        _Between(one.near, other.near, other.off_m - one.off_m, _slack_m(one, other, graph))
        for one, other in pairs
        if one.near < other.near
    ]


def _slack_m(one: _End, other: _End, graph: HeldGraph) -> float:
    """Where only the newest correction of a log is known, near keyframes of it are off together."""
    slack_m = one.sigma_m + other.sigma_m
    if slack_m == 0.0 or one.far is None or other.far is None or one.far.log != other.far.log:
        return slack_m
    first, last = sorted((one.far.index, other.far.index))
    way = graph.odometry(one.far.log)[first : last + 1]
    return min(slack_m, DRIFT_RATIO * float(np.linalg.norm(way[-1, :3, 3] - way[0, :3, 3])) + WOUND_RATIO * way_m(way))


def _ties_and_fixes(
    log: LogId, closures: Sequence[Tie], keyframes: int, graph: HeldGraph
) -> tuple[dict[LogId, list[Tie]], dict[LogId, dict[int, Float]]]:
    """Of a log's known keyframes: ties to keyframes by their log, and places by the frame that they are in."""
    ties, fixes = by_far_log(closures, keyframes), dict[LogId, dict[int, Float]]()
    for factor in graph.measured(log):
        _sort_in(factor, log, keyframes, ties, fixes)
    return ties, fixes


def _sort_in(
    factor: MeasuredFactor,
    own: LogId,
    keyframes: int,
    ties: dict[LogId, list[Tie]],
    fixes: dict[LogId, dict[int, Float]],
) -> None:
    """A measurement is as good as a closure where it tells of another keyframe; else it is a place of its own frame."""
    near, far = (factor.query, factor.match) if factor.query.log == own else (factor.match, factor.query)
    if near.log != own or near.index >= keyframes:
        return
    if not is_landmark(far.log):
        ties.setdefault(far.log, []).append(Tie(near.index, far, float(np.linalg.norm(factor.T_query_match[:3, 3]))))
        return
    T = T_earth_enu(factor.place) if factor.place is not None else factor.T_query_match
    fixes.setdefault(far.log, {})[near.index] = (T if far == factor.query else inverse(T))[:3, 3]


def _fitted(fixes: Mapping[int, Float], camera: Float, may_m: float) -> list[_End]:
    """Places in a frame of their own, which is laid over those where a correction puts them."""
    near = sorted(fixes)
    places = np.array([fixes[k] for k in near])
    T = umeyama(places - places[0], camera[near, :3, 3])[1]
    off_m = camera[near, :3, 3] - (places - places[0]) @ T[:3, :3].T - T[:3, 3]
    return [_End(k, off, 0.0, may_m, None) for k, off in zip(near, off_m, strict=True)]


def by_far_log(closures: Sequence[Tie], keyframes: int) -> dict[LogId, list[Tie]]:
    """Closures of a log by the log of their other end."""
    ties: dict[LogId, list[Tie]] = {}
    for tie in closures:
        if tie.near < keyframes:
            ties.setdefault(tie.far.log, []).append(tie)
    return ties


def _seen(
    placed: Placed, log: LogId, ties: Sequence[Tie], camera: Float, graph: HeldGraph
) -> list[tuple[Tie, Float, float]]:
    """Closures with one log, how far off (3,) they put this robot's cameras, and by how much that may be wrong."""
    own = log == placed.own.log
    correction, odometry = placed.own if own else placed.others.get(log), graph.odometry(log)
    ties = [tie for tie in ties if tie.far.index < len(odometry)]
    if correction is None or correction.anchor != placed.own.anchor or not ties:
        return []
    near, far = np.array([tie.near for tie in ties]), np.array([tie.far.index for tie in ties])
    ends = camera[far] if own else corrected(correction, odometry[far], far)
    sigma_m = np.zeros(len(ties))
    if correction.knots is None:
        steps_m = np.linalg.norm(np.diff(odometry[:, :3, 3], axis=0), axis=1)
        sigma_m = DRIFT_RATIO * np.concatenate([np.cumsum(steps_m[::-1])[::-1], [0.0]])[far]
    return list(zip(ties, camera[near, :3, 3] - ends[:, :3, 3], sigma_m.tolist(), strict=True))


def missed_m(log: LogId, closures: Sequence[Tie], graph: HeldGraph) -> float:
    """How much of a log's way its odometry missed, by closures that contradict it, whatever solution is believed."""
    odometry, missed = graph.odometry(log), 0.0
    ties, fixes = _ties_and_fixes(log, closures, len(odometry), graph)
    for places in fixes.values():
        near = sorted(places)
        moved_m = np.linalg.norm(np.diff(np.array([places[k] for k in near]), axis=0), axis=1)
        told_m = np.linalg.norm(np.diff(odometry[near, :3, 3], axis=0), axis=1)
        missed += float(np.maximum(moved_m - told_m, 0.0).sum())
    for far, of_log in ties.items():
        there = graph.odometry(far)
        known = sorted((tie for tie in of_log if tie.far.index < len(there)), key=lambda tie: tie.near)
        if not known:
            continue
        here_m, there_m = odometry[[tie.near for tie in known], :3, 3], there[[tie.far.index for tie in known], :3, 3]
        may_m = view_m(odometry) + VIEW_LENGTHS * np.array([tie.length_m for tie in known])
        if far == log:
            missed += float(np.maximum(np.linalg.norm(here_m - there_m, axis=1) - may_m, 0.0).sum())
            continue
        own_m, far_m = (np.linalg.norm(np.diff(each, axis=0), axis=1) for each in (here_m, there_m))
        missed += float(np.maximum(np.abs(own_m - far_m) - np.maximum(may_m[1:], may_m[:-1]), 0.0).sum())
    return missed


def view_m(odometry: Float) -> float:
    """How far cameras that see one place are apart."""
    return VIEW_M + VIEW_STEPS * way_m(odometry) / max(len(odometry) - 1, 1)


def way_m(poses: Float) -> float:
    """Length of a way over poses (N, 4, 4)."""
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
