"""Whether a correction can be true: it is held against what its receiver holds itself, the replicated graph.

A leader's solution may surprise: closures that it rejects, jumps of a broken odometry, maps that merge. So what is
asked is coarse, and each question has an answer that no such surprise gives:

- Does the map frame begin where its anchor begins, and do closures tie this robot to that anchor?
- Is the robot within the reach of all ways that were driven, or was it moved out of the map?
- Is its own odometry still its odometry, but for jumps that closures or fixes on both sides of them demand?
- Do closures that are not where they should be disagree with each other, as false ones do, or do they all say that the
  robot is elsewhere?

Evidence is counted, not jumps: what is measured may be as odd as it likes, what nothing demands is a lie. A solution
that passes may still be wrong by metres. What fails is held back for a while, since corrections of other logs and
records may be on their way. Then this robot solves the graph itself, and refuses what its own solution does not bear
out. See DESIGN.md 5.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.correction_evidence import VIEW_M, HeldGraph, Placed, evidence_of, missed_m, way_m
from flocc_agent.core.knots import corrected, distances
from flocc_agent.core.pose_graph import Component
from flocc_agent.geometry import angle_rad, between
from flocc_protocol.ids import LogId
from flocc_protocol.messages import CorrectionVersion, LogCorrection

Float = NDArray[np.float64]

ORIGIN_M, ORIGIN_RAD = 0.1, np.deg2rad(1.0)
"""An anchor's first keyframe stays where its odometry puts it; this is for rounding."""
REACH_RATIO, REACH_M = 2.0, 50.0
"""How far apart robots of one map can be: their ways, with odometry half as long as the truth, and a view for each."""
DRIFTED_RATIO = 0.5
"""How far a solution moves the newest keyframe of an anchor, against its way."""
MISSED_RATIO = 2.0
"""How much farther a robot may be than its odometry says, against what closures say that odometry missed."""
TIES_MAX, TIES_OF_JUMPS_MAX = 200, 2000
"""Closures that are looked at, the newest ones; where there are jumps that those do not explain, so many."""
HELD_BACK_S = 10.0
"""Until then what a correction lacks to be believed may come; a lost short correction is asked for after a second."""
SOLVED_S, SOLVES_EVERY_S = 60.0, 60.0
"""So long an own solution is waited for; and so often one is made at most, whatever liars send."""
LOOK_AGAIN_S = 0.25
UNTIED = "nothing that this robot holds ties it to its map frame"
"""The records may be on a slow link still, so that this is waited for, and its leader is not doubted."""

MOVED = "its map frame does not begin where its anchor does"
BENT = "it tears this robot's odometry apart where nothing was measured"
TORN = "it tears most of this robot's closures"
FINAL = (MOVED,)
"""What no message that is on its way can change is refused at once."""
AGREE_M, AGREE_RAD = 2.0, np.deg2rad(5.0)
"""Two corrections put a keyframe to the same place."""


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
        or _unmeasured(placed, camera, odometry, graph)
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
    """A robot is not farther from the beginning of its map than all ways together are long, nor is its anchor.

    A way is longer by what odometry missed, as far as closures say so. Where the anchor's own way is not here yet,
    nothing says where its map begins.
    """
    start, anchor = graph.odometry(placed.own.anchor), placed.others.get(placed.own.anchor)
    if not len(start):
        return UNTIED
    if anchor is not None and anchor.anchor == anchor.log:
        drifted_m = corrected(anchor, start[-1:], np.array([len(start) - 1]))[0, :3, 3] - start[-1, :3, 3]
        beyond_m = float(np.linalg.norm(drifted_m)) - VIEW_M - DRIFTED_RATIO * way_m(start)
        ties = graph.ties(anchor.log, TIES_OF_JUMPS_MAX) if beyond_m > 0.0 else ()
        if beyond_m > 0.0 and beyond_m > MISSED_RATIO * missed_m(anchor.log, ties, graph):
            return "its anchor is not where it began"
    away_m = float(np.linalg.norm(camera[-1, :3, 3] - start[0, :3, 3]))
    first = list(dict.fromkeys([placed.own.log, placed.own.anchor]))
    logs = (*first, *sorted(set(placed.others).difference(first)))
    reach_m = 0.0
    for log in logs:
        reach_m += REACH_M + REACH_RATIO * way_m(graph.odometry(log))
        if away_m <= reach_m:
            return None
    more_m = MISSED_RATIO * sum(missed_m(log, graph.ties(log, TIES_OF_JUMPS_MAX), graph) for log in first)
    return None if away_m <= reach_m + more_m else "it moves this robot out of the map"


def _unmeasured(placed: Placed, camera: Float, odometry: Float, graph: HeldGraph) -> str | None:
    """Odometry may be bent where something that was measured demands it; measurements may be rejected one by one."""
    if len(odometry) < 2:
        return None
    for ties_max in (TIES_MAX, TIES_OF_JUMPS_MAX):
        closures = graph.ties(placed.own.log, ties_max)
        evidence = evidence_of(placed, closures, camera, odometry, graph)
        if evidence.is_torn():
            return TORN
        if evidence.explains(camera, odometry):
            return None
        if len(closures) < ties_max:
            break
    return BENT


class Doubts:
    """Corrections of a robot's own log that it does not believe, or not yet.

    Attributes:
        doubted: Leaders whose corrections were refused, until somebody clears it.
        confirmed: Leaders with whom another robot's solution agreed later, until somebody clears it.
        wants_solution: Whether a solution of this robot's own is to decide, until somebody clears it.
    """

    def __init__(self, graph: HeldGraph | None) -> None:
        self.doubted: set[LogId] = set()
        self.confirmed: set[LogId] = set()
        self.wants_solution = False
        self._solves_s = float("-inf")
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
            if self._held is not None and self._held.correction.version == placed.own.version:
                self._held = None
            return None
        if why in FINAL:
            self._refuse(placed.own)
            return why
        if self._held is None:
            self._held = _HeldBack(placed.own, now, why, self._rests_on(placed.own.log))
        elif self._held.correction.version <= placed.own.version:
            self._held = replace(self._held, correction=placed.own, why=why)
        return why

    def rests_on(self) -> frozenset[LogId]:
        """Other logs on whose poses it rests whether what is held back can be true.

        Where only a log's newest correction is known, its odometry says where it was before; it may have missed a ride.
        """
        return frozenset() if self._held is None or self._held.why == UNTIED else self._held.rests_on

    def _rests_on(self, log: LogId) -> frozenset[LogId]:
        assert self._graph is not None
        return frozenset(tie.far.log for tie in self._graph.ties(log, TIES_OF_JUMPS_MAX)) - {log}

    def speaks_against(self, placed: Placed) -> str | None:
        """What speaks against a correction that this robot made itself, None where nothing does."""
        if self._graph is None or self._says_the_same(placed.own):
            return None
        why = contradiction(placed, self._before, self._graph)
        if why is None:
            self._checked = placed.own
        return why

    def given_up(self, now: float) -> str | None:
        """Refuse what was held back for long enough; what is to be told of it, None where nothing is.

        Before that a solution of this robot's own is asked for and waited for, unless there was one just now.
        """
        held = self._held
        if held is None or held.since_s + HELD_BACK_S > now:
            return None
        if self._before is not None and held.correction.version <= self._before.own.version:
            self._held = held if held.since_s + 2.0 * HELD_BACK_S > now else None
            return None
        if held.why == UNTIED:
            self._held = replace(held, told=True)
            return None if held.told else held.why
        if held.solves_s is None and self._solves_s + SOLVES_EVERY_S <= now:
            self._solves_s, self.wants_solution = now, True
            self._held = held = replace(held, solves_s=now)
        if held.solves_s is not None and held.solves_s + SOLVED_S > now:
            return None
        self._refuse(held.correction)
        return held.why

    def on_solution(self, component: Component | None) -> LogCorrection | None:
        """This robot solved the graph itself, None: in vain. The correction that is borne out, and will be believed."""
        held = self._held
        if held is None or held.solves_s is None:
            return None
        if component is None or not self._bears_out(component, held.correction):
            self._held = replace(held, solves_s=float("-inf"))
            return None
        self._held, self._checked = None, held.correction
        return held.correction

    def _bears_out(self, component: Component, correction: LogCorrection) -> bool:
        """Whether an own solution puts the keyframes of the log where a correction puts them."""
        assert self._graph is not None
        solved = np.asarray(component.T_map_keyframe.get(correction.log, ()))
        odometry = self._graph.odometry(correction.log)[: len(solved)]
        if component.anchor != correction.anchor or not len(odometry):
            return False
        told = corrected(correction, odometry, np.arange(len(odometry)))
        shift_m, turn_rad = distances(solved[: len(odometry)], told)
        return bool(shift_m.max() <= AGREE_M and turn_rad.max() <= AGREE_RAD)

    def _refuse(self, correction: LogCorrection) -> None:
        self._refused, self._held = correction, None
        self.doubted.add(correction.term.leader)

    def on_applied(self, placed: Placed) -> None:
        """A correction was applied: what is older need not be waited for, and what it agrees with was true.

        What another leader's corrections lack they lack still: two that lead in turn do not save the one that lies.
        """
        if self._refused is not None and self._is_confirmed(placed.own):
            self.confirmed.add(self._refused.term.leader)
            self._refused = None
        self._before = placed
        if self._held is not None and self._held.correction.term.leader.robot == placed.own.term.leader.robot:
            self._held = None

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
    """What is held back, since when, and why; and the other logs whose poses may say that it is true."""

    correction: LogCorrection
    since_s: float
    why: str
    rests_on: frozenset[LogId] = frozenset()
    told: bool = False
    solves_s: float | None = None
    """When this robot began to solve the graph itself; long ago where that did not bear it out."""
