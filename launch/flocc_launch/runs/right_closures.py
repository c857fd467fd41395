"""Which closures are right, by ground truth, and how well those that were kept are the right ones."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import angle_rad, between, pose_from_tq
from flocc_agent.runtime.robot_result import ClosureKnown
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.moments import Moment
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]

ROTATION_ERROR_MAX_RAD = float(np.deg2rad(5.0))
DIRECTION_ERROR_MAX_RAD = float(np.deg2rad(15.0))
DISTANCE_MIN_M = 0.2
"""Cameras that truly are nearer to each other have no direction worth a judgement."""


@dataclass(frozen=True, slots=True)
class Judged:
    """One accepted closure whose keyframes have ground truth.

    Attributes:
        at_s: When the first robot accepted it.
        right: Its pose agrees with ground truth.
        kept: The last solution used it; True as well where no scales were estimated, so that nobody knows.
    """

    at_s: float
    right: bool
    kept: bool


def judged_closures(loaded: LoadedRun) -> list[Judged]:
    """All accepted closures with a pose, a time and ground truth of both keyframes."""
    known = verdicts(loaded)
    return [
        Judged(pair.at_s, known[pair.query, pair.match], pair.used is not False)
        for pair in loaded.pairs
        if pair.at_s is not None and (pair.query, pair.match) in known
    ]


def verdicts(loaded: LoadedRun) -> dict[tuple[KeyframeId, KeyframeId], bool]:
    """Query and match of every accepted closure with a pose and ground truth -> whether it is right."""
    poses = {
        (closure.query, closure.match): closure for result in loaded.results.values() for closure in result.closures
    }
    found = {}
    for pair in loaded.pairs:
        closure = poses.get((str(pair.query), str(pair.match))) or poses.get((str(pair.match), str(pair.query)))
        right = None if closure is None or not pair.accepted else agrees(closure, loaded)
        if right is not None:
            found[pair.query, pair.match] = right
    return found


def agrees(closure: ClosureKnown, loaded: LoadedRun) -> bool | None:
    """Whether a closure's rotation and direction are the true ones; None where the truth or its pose is not known."""
    ends = [true_camera(loaded, KeyframeId.parse(text)) for text in (closure.query, closure.match)]
    query, match = ends
    if closure.T_query_match_unscaled is None or query is None or match is None:
        return None
    T, T_true = pose_from_tq(np.array(closure.T_query_match_unscaled)), between(query, match)
    turned_rad = angle_rad(T_true[:3, :3].T @ T[:3, :3])
    return turned_rad <= ROTATION_ERROR_MAX_RAD and points_along(T[:3, 3], T_true[:3, 3])


def points_along(t_unscaled: Float, t_true_m: Float) -> bool:
    """Whether a translation of any length points where the true one does."""
    lengths = float(np.linalg.norm(t_unscaled)), float(np.linalg.norm(t_true_m))
    if lengths[1] < DISTANCE_MIN_M:
        return True
    cosine = float(t_unscaled @ t_true_m) / (lengths[0] * lengths[1]) if lengths[0] else -1.0
    return bool(cosine >= np.cos(DIRECTION_ERROR_MAX_RAD))


def true_camera(loaded: LoadedRun, keyframe: KeyframeId) -> Float | None:
    """True pose (4, 4) of a keyframe's camera; None where it, or the camera's place on the body, is not known."""
    robot = keyframe.log.robot
    track, result = loaded.tracks.get(robot), loaded.results.get(robot)
    if track is None or result is None or keyframe.log.incarnation != track.incarnation:
        return None
    if keyframe.index >= len(track) or not track.true[keyframe.index]:
        return None
    camera = result.T_body_camera
    T_world_body = track.T_world_body[keyframe.index]
    return T_world_body if camera is None else np.asarray(T_world_body @ pose_from_tq(np.array(camera)))


def f1_at(closures: Sequence[Judged], t: float) -> float | None:
    """F1 of the kept against the right ones of the closures that were accepted until then; None where there is none."""
    known = [closure for closure in closures if closure.at_s <= t]
    kept, right = sum(c.kept for c in known), sum(c.right for c in known)
    both = sum(c.kept and c.right for c in known)
    return 2 * both / (kept + right) if kept + right else None


def mean_f1(moments: Iterable[Moment], closures: Sequence[Judged]) -> float | None:
    """Mean of F1 over the moments that had a closure to judge; None where there is none."""
    found = [f1 for moment in moments if (f1 := f1_at(closures, moment.t)) is not None]
    return float(np.mean(found)) if found else None
