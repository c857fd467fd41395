"""Whether the direction that a configuration calls up is up: closures between robots tell, whatever they were found by.

A closure says how one robot's odometry frame is turned against another's. What is up in both must be turned into
itself; no other direction is, where frames differ in heading. Closures of one robot tell nothing: there every direction
is turned into itself. That all frames have one heading shows in no closure at all, and nothing is said.
"""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.robot_result import ClosureKnown
from flocc_launch.doctor.finding import Finding, Severity
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]

AGREES_RAD = float(np.radians(5.0))
"""Rotations of right closures are off by 1 to 3 degrees, and two attitudes by a degree each."""
CLOSURES_MIN = 5
AGREEING_RATIO_MIN = 0.5
FOUND_RATIO_MIN = 0.8
"""Of the closures those that must agree with another direction for it to be named."""
HEADINGS_MIN = float(np.radians(10.0))
"""Root mean square by which another direction than the best must be turned: else headings are too much alike."""


def odd_up(loaded: LoadedRun) -> list[Finding]:
    """Closures between robots that turn `perception.odometry_up` into something else."""
    configured = loaded.run.perception.get("odometry_up")
    turns = _turns(loaded)
    if configured is None or len(turns) < CLOSURES_MIN:
        return []
    up = np.array(configured, dtype=float)
    agreeing = _agreeing(turns, up / np.linalg.norm(up))
    if agreeing >= AGREEING_RATIO_MIN * len(turns):
        return []
    x, y, z = configured
    sentence = (
        f"Gravity agreed with {agreeing} of {len(turns)} used closures between robots: perception.odometry_up = "
        f"[{x:g}, {y:g}, {z:g}] is not up in their odometry."
    )
    return [Finding("odometry-up", Severity.HINDERS, sentence, _advice(turns))]


def _advice(turns: Float) -> str:
    _, sizes, axes = np.linalg.svd((turns - np.eye(3)).reshape(-1, 3))
    leaves_one = float(sizes[1]) >= HEADINGS_MIN * np.sqrt(len(turns))
    found = axes[2] * np.sign(axes[2][np.abs(axes[2]).argmax()])
    agreeing = _agreeing(turns, found)
    if not leaves_one or agreeing < FOUND_RATIO_MIN * len(turns):
        return "Leave perception.odometry_up out where odometry does not keep roll and pitch: then nobody knows up."
    x, y, z = (round(float(value), 2) + 0.0 for value in found)
    return (
        f"With [{x:g}, {y:g}, {z:g}], or its opposite, {agreeing} agree. Name the one against gravity, or leave "
        "perception.odometry_up out."
    )


def _agreeing(turns: Float, up: Float) -> int:
    """How many turns (N, 3, 3) leave a direction (3,) where it is."""
    return int(np.sum(turns @ up @ up >= np.cos(AGREES_RAD)))


def _turns(loaded: LoadedRun) -> Float:
    """By closures that the solver used, the turn (N, 3, 3) of one robot's odometry frame against another's."""
    known = {(each.query, each.match): each for result in loaded.results.values() for each in result.closures}
    found = []
    for pair in loaded.pairs:
        if not pair.inter_robot or not pair.accepted or pair.used is False:
            continue
        closure = known.get((str(pair.query), str(pair.match))) or known.get((str(pair.match), str(pair.query)))
        turn = None if closure is None else _turn(loaded, closure)
        if turn is not None:
            found.append(turn)
    return np.array(found).reshape(-1, 3, 3)


def _turn(loaded: LoadedRun, closure: ClosureKnown) -> Float | None:
    query, match = (_R_odom_camera(loaded, KeyframeId.parse(text)) for text in (closure.query, closure.match))
    if query is None or match is None or closure.T_query_match_unscaled is None:
        return None
    R_query_match = pose_from_tq(np.array(closure.T_query_match_unscaled))[:3, :3]
    return np.asarray(query @ R_query_match @ match.T)


def _R_odom_camera(loaded: LoadedRun, keyframe: KeyframeId) -> Float | None:
    """How a keyframe's camera was turned (3, 3) by odometry; None where that is not known."""
    robot = keyframe.log.robot
    track, result = loaded.tracks.get(robot), loaded.results.get(robot)
    if track is None or result is None or keyframe.log.incarnation != track.incarnation:
        return None
    if keyframe.index >= len(track):
        return None
    R_odom_body = track.T_odom_body[keyframe.index, :3, :3]
    mounted = result.T_body_camera
    return R_odom_body if mounted is None else R_odom_body @ pose_from_tq(np.array(mounted))[:3, :3]
