"""Robots that rejected closures would put elsewhere, nearly as many as were followed: said, because it is a guess.

Two halves of a symmetrical hall look the same. Four closures then say that a robot is in one half, four that it is in
the other; one of the two is taken, and which of them depends on next to nothing.
"""

from collections.abc import Mapping, Sequence

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

    Places that the alignment of robots takes for one are one: closures are also rejected for being inexact.

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
    by_pair: dict[tuple[LogId, LogId], list[int]] = {}
    for n, k in enumerate(problem.closure_ids):
        a, b = sorted((closures[k].query.log, closures[k].match.log))
        if a != b:
            by_pair.setdefault((a, b), []).append(n)

    sentences: list[str] = []
    for (a, b), rows in sorted(by_pair.items()):
        followed, rejected = [n for n in rows if used[n]], [n for n in rows if not used[n]]
        enough = max(NEARLY_RATIO * len(followed), REJECTED_MIN)
        if not followed or len(rejected) < enough:
            continue
        ids = [problem.closure_ids[n] for n in rejected]
        ends = {}
        for k in ids:
            query, match = closures[k].query, closures[k].match
            ends[k] = (query, match) if query.log == a else (match, query)
        path_m = {log: travelled_m(trajectories[log]) for log in (a, b)}
        found = align_pair(rays_from(ids, closures, ends, T_keyframes, path_m, steepness))
        if len(found.agreeing) < enough:
            continue
        middle = T_keyframes[b][:, :3, 3].mean(axis=0)
        moved_m = float(np.linalg.norm(found.T_a_b[:3, :3] @ middle + found.T_a_b[:3, 3] - middle))
        turned_rad = angle_rad(found.T_a_b[:3, :3])
        if moved_m <= TRANSLATION_TOLERANCE_M and turned_rad <= ROTATION_TOLERANCE_RAD:
            continue
        turned_deg = np.degrees(turned_rad)
        sentences.append(
            f"robots {a.robot} and {b.robot}: {len(followed)} closures agree on the place that was taken, and "
            f"{len(found.agreeing)} others on another one, {moved_m:.1f} m and {turned_deg:.0f} degrees away; "
            f"places that look the same do this{_or_jumped(problem, ends, followed, found.agreeing, closures)}, "
            "and nothing here tells which is right"
        )
    return tuple(sentences)


def _or_jumped(
    problem: Problem,
    ends: Mapping[int, tuple[KeyframeId, KeyframeId]],
    followed: list[int],
    others: Sequence[int],
    closures: Mapping[int, LoopClosure],
) -> str:
    """What else it may be, where all keyframes of one place come before all of the other, in one robot's log.

    Args:
        problem: The component.
        ends: Both keyframes of each closure that was not followed, by its index in the graph.
        followed: Rows of those that were.
        others: Those that agree on another place, by their index in the graph.
        closures: All of them.
    """
    here = [closures[problem.closure_ids[n]] for n in followed]
    for side in (0, 1):
        there = [ends[k][side].index for k in others]
        log = ends[others[0]][side].log
        taken = [end.index for closure in here for end in (closure.query, closure.match) if end.log == log]
        for early, late in ((taken, there), (there, taken)):
            if max(early) < min(late):
                return f", and so does odometry of robot {log.robot} that jumps between {max(early)} and {min(late)}"
    return ""
