"""Robots that rejected closures would put elsewhere, nearly as many as were followed: said, because it is a guess.

Two halves of a symmetrical hall look the same. Four closures then say that a robot is in one half, four that it is in
the other; one of the two is taken, and which of them depends on next to nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.alignment import (
    ROTATION_TOLERANCE_RAD,
    TRANSLATION_TOLERANCE_M,
    align_pair,
    rays_from,
    travelled_m,
)
from flocc_agent.backend.problem import Problem
from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_agent.geometry import angle_rad
from flocc_protocol.ids import KeyframeId, LogId

Bool = NDArray[np.bool_]
Float = NDArray[np.float64]

REJECTED_MIN = 2
"""A single closure puts a robot nowhere that another one confirms."""
NEARLY_RATIO = 0.75
"""So large a part of those that were followed is nearly as many."""


def tie_warnings(
    problem: Problem,
    T_keyframes: Mapping[LogId, Float],
    used: Bool,
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    steepness: float,
) -> tuple[str, ...]:
    """One sentence for each pair of robots whose rejected closures agree on another place.

    Where none names a robot that has closures with several others, all of its closures are asked: a repeated facade
    that it shares with one robot says otherwise than what it shares with another. Places that the alignment of robots
    takes for one are one: closures are also rejected for being inexact.

    Args:
        problem: The component.
        T_keyframes: (N, 4, 4) solved poses of each log, all in one frame.
        used: (L,) which closures the solution follows.
        trajectories: Odometry of the component's logs.
        closures: Its closures, by their index in the graph.
        steepness: k of Eq. (2).
    """
    if used.all():
        return ()
    path_m = {log: travelled_m(trajectories[log]) for log in problem.logs}
    by_pair: dict[tuple[LogId, LogId], list[int]] = {}
    by_log: dict[LogId, list[int]] = {}
    for n, k in enumerate(problem.closure_ids):
        a, b = sorted((closures[k].query.log, closures[k].match.log))
        if a != b:
            for rows in (by_pair.setdefault((a, b), []), by_log.setdefault(a, []), by_log.setdefault(b, [])):
                rows.append(n)

    def tie(rows: list[int], log: LogId) -> TwoPlaces | None:
        """Where the rejected ones of some closures (rows) put a log, if they agree."""
        followed, rejected = [n for n in rows if used[n]], [n for n in rows if not used[n]]
        enough = max(NEARLY_RATIO * len(followed), REJECTED_MIN)
        if not followed or len(rejected) < enough:
            return None
        ids = [problem.closure_ids[n] for n in rejected]
        placed = {k: _towards(log, closures[k]) for k in ids}
        found = align_pair(rays_from(ids, closures, placed, T_keyframes, path_m, steepness))
        if len(found.agreeing) < enough:
            return None
        middle = T_keyframes[log][:, :3, 3].mean(axis=0)
        moved_m = float(np.linalg.norm(found.T_a_b[:3, :3] @ middle + found.T_a_b[:3, 3] - middle))
        turned_rad = angle_rad(found.T_a_b[:3, :3])
        if moved_m <= TRANSLATION_TOLERANCE_M and turned_rad <= ROTATION_TOLERANCE_RAD:
            return None
        taken = [_towards(log, closures[problem.closure_ids[n]]) for n in followed]
        return TwoPlaces(taken, [placed[k] for k in found.agreeing], moved_m, float(np.degrees(turned_rad)))

    ties = [(pair, found) for pair, rows in sorted(by_pair.items()) if (found := tie(rows, pair[1])) is not None]
    sentences = [f"robots {a.robot} and {b.robot}: {found.sentence()}" for (a, b), found in ties]
    named = {log for pair, _ in ties for log in pair}
    told: set[frozenset[frozenset[KeyframeId]]] = set()
    for log, rows in sorted(by_log.items()):
        found = tie(rows, log) if log not in named else None
        if found is None or found.with_taken == found.with_others:
            continue
        others = frozenset(map(frozenset, found.others))
        if others not in told:
            sentences.append(f"robot {log.robot}: {found.sentence(True)}")
            told.add(others)
    return tuple(sentences)


@dataclass(frozen=True, slots=True, eq=False)
class TwoPlaces:
    """Closures that agree on the place that was taken, and others on another one.

    Attributes:
        taken: Both keyframes of each that was followed, that of the robot in question last.
        others: The same of those that agree on another place.
        moved_m: How far that is.
        turned_deg: How much the robot is turned there.
    """

    taken: list[tuple[KeyframeId, KeyframeId]]
    others: list[tuple[KeyframeId, KeyframeId]]
    moved_m: float
    turned_deg: float

    @property
    def with_taken(self) -> str:
        """With which robots those are that were followed."""
        return _robots(self.taken)

    @property
    def with_others(self) -> str:
        """With which robots the others are."""
        return _robots(self.others)

    def sentence(self, names: bool = False) -> str:
        """What is said of it, by name of the other robots where these differ."""
        taken, others = (f" with {self.with_taken}", f" with {self.with_others}") if names else ("", "")
        return (
            f"{len(self.taken)} closures{taken} agree on the place that was taken, and {len(self.others)} others"
            f"{others} on another one, {self.moved_m:.1f} m and {self.turned_deg:.0f} degrees away; places that look "
            f"the same do this{_or_jumped(self)}, and nothing here tells which is right"
        )


def _robots(ends: Sequence[tuple[KeyframeId, KeyframeId]]) -> str:
    return " and ".join(sorted({other.log.robot for other, _ in ends}))


def _towards(log: LogId, closure: LoopClosure) -> tuple[KeyframeId, KeyframeId]:
    """Both keyframes of a closure, that of the log last."""
    return (closure.query, closure.match) if closure.match.log == log else (closure.match, closure.query)


def _or_jumped(tie: TwoPlaces) -> str:
    """What else it may be, where all keyframes of one place come before all of the other, in one robot's log."""
    for side in (0, 1):
        log = tie.others[0][side].log
        if {end[side].log for end in tie.others} != {log}:
            continue
        there = [end[side].index for end in tie.others]
        taken = [end.index for pair in tie.taken for end in pair if end.log == log]
        for early, late in ((taken, there), (there, taken)):
            if taken and max(early) < min(late):
                return f", and so does odometry of robot {log.robot} that jumps between {max(early)} and {min(late)}"
    return ""
