"""Whether a correction can be true: it is held against what its receiver holds itself, the replicated graph.

A leader's solution may surprise: closures that it rejects, jumps of a broken odometry, maps that merge. So what is
asked is coarse, and each question has an answer that no such surprise gives:

- Does the map frame begin where its anchor begins, and do closures tie this robot to that anchor?
- Is the robot within the reach of all ways that were driven, or was it moved out of the map?
- Is its own odometry still its odometry, but for stretches that are few or short?
- Do most of its closures lead where they led, as far as the other ends are known?

A solution that passes may still be wrong by metres. What fails is held back for a while, since corrections of other
logs and records may be on their way, and is refused then. See DESIGN.md 5.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.knots import corrected, distances
from flocc_agent.geometry import angle_rad, between
from flocc_protocol.ids import LogId
from flocc_protocol.messages import CorrectionVersion, LogCorrection
from flocc_protocol.records import ClosureRecord

Float = NDArray[np.float64]

ORIGIN_M, ORIGIN_RAD = 0.1, np.deg2rad(1.0)
"""An anchor's first keyframe stays where its odometry puts it; this is for rounding."""
REACH_RATIO, REACH_M = 2.0, 50.0
"""How far apart robots of one map can be: their ways, with odometry half as long as the truth, and a view for each."""
BENT_RATIO, BENT_M = 0.25, 10.0
"""How much odometry may be changed beyond the length of its own steps: of its way, and always."""
JUMPS_MAX = 2
"""Steps that may be of any length: a robot was carried, or its odometry jumped, and a solution says so rightly."""
VIEW_M, VIEW_STEPS, VIEW_LENGTHS = 10.0, 10.0, 3.0
"""Cameras of one closure are this near: metres, steps of the odometry, lengths of the measured translation."""
DRIFT_RATIO = 0.3
"""How far a keyframe may be off where only the newest one's correction is known, against the way between the two."""
DRIFTED_RATIO = 0.5
"""How far a solution moves the newest keyframe of an anchor, against its way."""
TIES_MAX = 200
"""Closures that are looked at, the newest ones."""
TIES_MIN = 3
"""Fewer say nothing: one closure may be wrong."""
HELD_BACK_S = 10.0
"""Until then what a correction lacks to be believed may come; a lost short correction is asked for after a second."""
LOOK_AGAIN_S = 0.25
UNTIED = "nothing that this robot holds ties it to its map frame"
"""The records may be on a slow link still, so that this is waited for, and its leader is not doubted."""

MOVED, BENT = "its map frame does not begin where its anchor does", "it tears this robot's odometry apart"
FINAL = (MOVED, BENT)
"""What no message that is on its way can change is refused at once."""
AGREE_M, AGREE_RAD = 2.0, np.deg2rad(5.0)
"""Two corrections put a keyframe to the same place."""


class HeldGraph(Protocol):
    """What a robot knows of the graph itself."""

    def odometry(self, log: LogId) -> Float:
        """T_odom_camera (N, 4, 4) of the known keyframes of a log."""
        ...

    def ties(self, log: LogId, ties_max: int) -> Sequence[ClosureRecord]:
        """The newest closures of a log."""
        ...

    def joined(self, log: LogId, other: LogId) -> bool:
        """Whether closures or other measurements lead from one log to the other; a record of a later version may."""
        ...


@dataclass(frozen=True, slots=True)
class Placed:
    """Corrections of one moment: this robot's, whole, and of the other logs what is known."""

    own: LogCorrection
    others: Mapping[LogId, LogCorrection]


def contradiction(placed: Placed, before: Placed | None, graph: HeldGraph) -> str | None:
    """What speaks against a correction, None where nothing does.

    Args:
        placed: The correction, and those of others that are known with it.
        before: What was applied last.
        graph: What this robot holds.
    """
    correction = placed.own
    odometry = graph.odometry(correction.log)
    if not len(odometry):
        return None
    camera = corrected(correction, odometry, np.arange(len(odometry)))
    return (
        _frame(correction, before, camera, odometry, graph)
        or _away(placed, camera, graph)
        or _bent(camera, odometry)
        or _torn(placed, before, camera, odometry, graph)
    )


def _frame(
    correction: LogCorrection, before: Placed | None, camera: Float, odometry: Float, graph: HeldGraph
) -> str | None:
    if correction.anchor == correction.log:
        moved = between(odometry[0], camera[0])
        stays = np.linalg.norm(moved[:3, 3]) <= ORIGIN_M and angle_rad(moved[:3, :3]) <= ORIGIN_RAD
        return None if stays else MOVED
    if before is not None and before.own.anchor == correction.anchor:
        return None
    return None if graph.joined(correction.log, correction.anchor) else UNTIED


def _away(placed: Placed, camera: Float, graph: HeldGraph) -> str | None:
    """A robot is not farther from the beginning of its map than all ways together are long, nor is its anchor."""
    start, anchor = graph.odometry(placed.own.anchor), placed.others.get(placed.own.anchor)
    if not len(start):
        return None
    if anchor is not None and anchor.anchor == anchor.log:
        drifted_m = corrected(anchor, start[-1:], np.array([len(start) - 1]))[0, :3, 3] - start[-1, :3, 3]
        if np.linalg.norm(drifted_m) > VIEW_M + DRIFTED_RATIO * _way_m(start):
            return "its anchor is not where it began"
    away_m = float(np.linalg.norm(camera[-1, :3, 3] - start[0, :3, 3]))
    first = list(dict.fromkeys([placed.own.log, placed.own.anchor]))
    reach_m = 0.0
    for log in (*first, *sorted(set(placed.others).difference(first))):
        reach_m += REACH_M + REACH_RATIO * _way_m(graph.odometry(log))
        if away_m <= reach_m:
            return None
    return "it moves this robot out of the map"


def _bent(camera: Float, odometry: Float) -> str | None:
    """Steps may be of another length, up to none or twice; more only where odometry broke, which is seldom."""
    if len(odometry) < 2:
        return None
    steps, told = between(odometry[:-1], odometry[1:])[:, :3, 3], between(camera[:-1], camera[1:])[:, :3, 3]
    lengths_m = np.linalg.norm(steps, axis=1)
    excess_m = np.sort(np.maximum(np.linalg.norm(told - steps, axis=1) - lengths_m, 0.0))[:-JUMPS_MAX].sum()
    return None if excess_m <= BENT_M + BENT_RATIO * lengths_m.sum() else BENT


def _torn(placed: Placed, before: Placed | None, camera: Float, odometry: Float, graph: HeldGraph) -> str | None:
    """Closures may be rejected, and what leads to a log whose correction is not known says nothing."""
    view_m = VIEW_M + VIEW_STEPS * _way_m(odometry) / max(len(odometry) - 1, 1)
    known = before if before is not None and before.own.anchor == placed.own.anchor else None
    camera_before = None if known is None else corrected(known.own, odometry, np.arange(len(odometry)))
    counted = torn = 0
    for far, ties in _by_far_log(placed.own.log, graph.ties(placed.own.log, TIES_MAX), len(odometry)).items():
        near, ends = np.array([tie.near for tie in ties]), np.array([tie.far for tie in ties])
        apart = _apart_m(placed, far, near, ends, camera, graph)
        if apart is None:
            continue
        may_m = view_m + VIEW_LENGTHS * np.array([tie.length_m for tie in ties]) + apart.sigma_m
        if known is not None and camera_before is not None:
            last = _apart_m(known, far, near, ends, camera_before, graph)
            may_m += 0.0 if last is None else np.nan_to_num(last.distance_m)
        counted += int(np.isfinite(apart.distance_m).sum())
        torn += int((apart.distance_m > may_m).sum())
    return "it tears most of this robot's closures" if counted >= TIES_MIN and 2 * torn > counted else None


@dataclass(frozen=True, slots=True)
class _Tie:
    """One closure: this robot's keyframe, the other one, and how long its translation is, metres or 0."""

    near: int
    far: int
    length_m: float


def _by_far_log(own: LogId, closures: Sequence[ClosureRecord], keyframes: int) -> dict[LogId, list[_Tie]]:
    ties: dict[LogId, list[_Tie]] = {}
    for closure in closures:
        near, far = (closure.query, closure.match) if closure.query.log == own else (closure.match, closure.query)
        if near.index < keyframes:
            length_m = (closure.scale_initial or 0.0) * float(np.linalg.norm(closure.T_query_match_unscaled[:3]))
            ties.setdefault(far.log, []).append(_Tie(near.index, far.index, length_m))
    return ties


@dataclass(frozen=True, slots=True, eq=False)
class _Apart:
    """Distances (K,) of the cameras of closures, NaN where one is not known, and by how much they may be off (K,)."""

    distance_m: Float
    sigma_m: Float


def _apart_m(
    placed: Placed,
    log: LogId,
    near: NDArray[np.integer],
    far: NDArray[np.integer],
    camera: Float,
    graph: HeldGraph,
) -> _Apart | None:
    """How far apart the cameras of closures with one log are; None where that log's correction is not known."""
    own = log == placed.own.log
    correction = placed.own if own else placed.others.get(log)
    odometry = graph.odometry(log)
    if correction is None or correction.anchor != placed.own.anchor or not len(odometry):
        return None
    known = far < len(odometry)
    far = np.minimum(far, len(odometry) - 1)
    ends = camera[far] if own else corrected(correction, odometry[far], far)
    distance_m = np.where(known, np.linalg.norm(camera[near, :3, 3] - ends[:, :3, 3], axis=1), np.nan)
    if correction.knots is not None:
        return _Apart(distance_m, np.zeros(len(far)))
    steps_m = np.linalg.norm(np.diff(odometry[:, :3, 3], axis=0), axis=1)
    to_end_m = np.concatenate([np.cumsum(steps_m[::-1])[::-1], [0.0]])
    return _Apart(distance_m, DRIFT_RATIO * to_end_m[far])


def _way_m(poses: Float) -> float:
    """Length of a way over poses (N, 4, 4)."""
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


class Doubts:
    """Corrections of a robot's own log that it does not believe, or not yet.

    Attributes:
        doubted: Leaders whose corrections were refused, until somebody clears it.
        confirmed: Leaders with whom another robot's solution agreed later, until somebody clears it.
    """

    def __init__(self, graph: HeldGraph | None) -> None:
        self.doubted: set[LogId] = set()
        self.confirmed: set[LogId] = set()
        self._graph = graph
        self._before: Placed | None = None
        self._checked: LogCorrection | None = None
        self._held: _HeldBack | None = None
        self._refused: LogCorrection | None = None
        self._next_look_s = float("-inf")

    def to_look_at(self, now: float) -> LogCorrection | None:
        """What is held back, when it is time to look at it again."""
        if self._held is None or self._next_look_s > now:
            return None
        self._next_look_s = now + LOOK_AGAIN_S
        return self._held.correction

    def knows(self, version: CorrectionVersion) -> bool:
        """Whether this correction was looked at and not believed."""
        held = () if self._held is None else (self._held.correction.version,)
        return version in held or (self._refused is not None and self._refused.version == version)

    def believes(self, placed: Placed, now: float) -> str | None:
        """What speaks against a correction, None where it may be applied; for a while it is held back then.

        What another robot's solution says as well is believed in the end.
        """
        if self._graph is None or self._is_confirmed(placed.own) or self._says_the_same(placed.own):
            return None
        why = contradiction(placed, self._before, self._graph)
        if why is None:
            self._checked = placed.own
            return None
        if why in FINAL:
            self._refuse(placed.own)
            return why
        if self._held is None:
            self._held = _HeldBack(placed.own, now, why)
        elif self._held.correction.version <= placed.own.version:
            self._held = replace(self._held, correction=placed.own, why=why)
        return why

    def given_up(self, now: float) -> str | None:
        """Refuse what was held back for long enough; what is to be told of it, None where nothing is."""
        held = self._held
        if held is None or held.since_s + HELD_BACK_S > now:
            return None
        if held.why == UNTIED:
            self._held = replace(held, told=True)
            return None if held.told else held.why
        self._refuse(held.correction)
        return held.why

    def _refuse(self, correction: LogCorrection) -> None:
        self._refused, self._held = correction, None
        self.doubted.add(correction.term.leader)

    def on_applied(self, placed: Placed) -> None:
        """A correction was applied: what is older need not be waited for, and what it agrees with was true."""
        if self._refused is not None and self._is_confirmed(placed.own):
            self.confirmed.add(self._refused.term.leader)
            self._refused = None
        self._before, self._held = placed, None

    def _says_the_same(self, correction: LogCorrection) -> bool:
        """Whether it moves no keyframe far from where what was looked at last had it: that need not be done again.

        While something is held back, leaders contradict each other, and everything is looked at.
        """
        checked = None if self._held is not None else self._checked
        if checked is None or self._graph is None or checked.anchor != correction.anchor:
            return False
        odometry = self._graph.odometry(correction.log)
        knots = [each.knots.keyframes.numpy() for each in (checked, correction) if each.knots is not None]
        numbers = np.unique(np.concatenate([*knots, [len(odometry) - 1]]).astype(np.intp))
        return _agree(checked, correction, odometry, numbers[(numbers >= 0) & (numbers < len(odometry))])

    def _is_confirmed(self, correction: LogCorrection) -> bool:
        """Whether another robot's refused solution put this one to the same place in the same map."""
        refused = self._refused
        if refused is None or refused.term.leader.robot == correction.term.leader.robot or self._graph is None:
            return False
        odometry = self._graph.odometry(correction.log)
        if refused.anchor != correction.anchor or not len(odometry):
            return False
        return _agree(refused, correction, odometry, np.array([len(odometry) - 1]))


def _agree(one: LogCorrection, other: LogCorrection, odometry: Float, numbers: NDArray[np.intp]) -> bool:
    """Whether two corrections put keyframes (K,) of their log to the same places."""
    shift_m, turn_rad = distances(*(corrected(each, odometry[numbers], numbers) for each in (one, other)))
    return bool(shift_m.max(initial=0.0) <= AGREE_M and turn_rad.max(initial=0.0) <= AGREE_RAD)


@dataclass(frozen=True, slots=True)
class _HeldBack:
    """What is held back, since when, and why."""

    correction: LogCorrection
    since_s: float
    why: str
    told: bool = False
