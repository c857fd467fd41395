"""What a robot's run leaves for people: facts and `result.json`. The same for every driver.

The core knows camera poses only; users know the body. Both speak of the body.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.corrections import pose7
from flocc_agent.core.pose_graph import GraphSolution, map_frame
from flocc_agent.core.registration import closure_probability
from flocc_agent.core.reports import ClosureAccepted, Fact, KeyframeTaken
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import inverse, pose_from_tq, se3_exp, se3_log
from flocc_agent.runtime.event_lines import Reported
from flocc_protocol.messages import CandidatePair, LogCorrection
from flocc_protocol.records import ClosureRecord, KeyframeRecord

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Reporter:
    """Says when and where facts happened, and adds to the core's what it cannot know.

    Attributes:
        robot: Name of the robot.
        T_body_camera: (4, 4) where the camera sits on the body.
        steepness: k of Eq. (2), for the probability beside each accepted closure.
    """

    robot: str
    T_body_camera: Float
    steepness: float

    def reported(self, fact: Fact, t: float) -> Reported[Fact]:
        """A fact at a time since the start of the run (s)."""
        return Reported(t, self.robot, self._completed(fact))

    def _completed(self, fact: Fact) -> Fact:
        match fact:
            case KeyframeTaken():
                T_odom_body = pose_from_tq(np.array(fact.T_odom_body)) @ inverse(self.T_body_camera)
                return replace(fact, T_odom_body=pose7(T_odom_body))
            case ClosureAccepted():
                return replace(fact, probability=round(closure_probability(fact.ratio, self.steepness), 6))
        return fact


def result_of(robot: Robot, T_body_camera: Float, solution: GraphSolution | None = None) -> dict[str, Any]:
    """What a robot knows at its end: its trajectory before and after correction, closures, sizes of logs."""
    records = [r for r in robot.gossip.logs[robot.log].records if isinstance(r, KeyframeRecord)]
    T_odom_camera = np.array([pose_from_tq(np.array(r.T_odom_camera)) for r in records]).reshape(-1, 4, 4)
    applied = robot.corrections.applied
    T_camera_body = inverse(T_body_camera)
    T_map_camera = None if applied is None else corrected(applied, T_odom_camera)
    keyframes = [
        {
            "index": record.index,
            "stamp_s": record.stamp_s,
            "T_odom_body": list(pose7(T_odom_camera[i] @ T_camera_body)),
            "T_map_body": None if T_map_camera is None else list(pose7(T_map_camera[i] @ T_camera_body)),
        }
        for i, record in enumerate(records)
    ]
    return {
        "robot": robot.log.robot,
        "incarnation": robot.log.incarnation,
        "map_frame": None if applied is None else map_frame(applied.anchor),
        "T_map_odom": None if applied is None else list(applied.T_map_odom),
        "T_body_camera": list(pose7(T_body_camera)),
        "keyframes": keyframes,
        "closures": closures_known(robot, solution),
        "logs": {str(digest.log): digest.count for digest in robot.gossip.digests()},
        "best_similarities": best_similarities(robot),
    }


def corrected_bodies(robot: Robot, T_body_camera: Float) -> tuple[list[float], Float]:
    """Stamps (s) and (N, 4, 4) corrected body poses of all own keyframes; none before the first correction."""
    applied = robot.corrections.applied
    records = [r for r in robot.gossip.logs[robot.log].records if isinstance(r, KeyframeRecord)]
    if applied is None or not records:
        return [], np.zeros((0, 4, 4))
    T_odom_camera = np.array([pose_from_tq(np.array(record.T_odom_camera)) for record in records])
    T_map_body = corrected(applied, T_odom_camera) @ inverse(T_body_camera)
    return [record.stamp_s for record in records], T_map_body


def best_similarities(robot: Robot) -> dict[str, float]:
    """Best cosine similarity of any keyframe of each other robot with one of this robot, below the threshold too."""
    return {name: round(best, 4) for name, best in sorted(robot.recognition.best_similarities.items())}


def closures_known(robot: Robot, solution: GraphSolution | None) -> list[dict[str, Any]]:
    """Every closure in a robot's logs, each pair once, with the scale of the last solution it made."""
    scales = {} if solution is None else {CandidatePair.of(c.query, c.match): c.scale for c in solution.closures}
    found: dict[CandidatePair, ClosureRecord] = {}
    for _, copy in sorted(robot.gossip.logs.items()):
        for record in copy.records:
            if isinstance(record, ClosureRecord):
                found.setdefault(CandidatePair.of(record.query, record.match), record)
    return [
        {
            "query": str(record.query),
            "match": str(record.match),
            "T_query_match_unscaled": list(record.T_query_match_unscaled),
            "match_ratio": record.match_ratio,
            "scale_initial": record.scale_initial,
            "scale": scales.get(pair),
        }
        for pair, record in sorted(found.items())
    ]


def corrected(message: LogCorrection, T_odom_camera: Float) -> Float:
    """Apply a correction to every keyframe, also to those it does not list.

    Between listed keyframes the correction is interpolated, after the last one it stays.

    Args:
        message: The correction, of every `step`-th keyframe.
        T_odom_camera: (N, 4, 4) odometry of all keyframes.

    Returns:
        (N, 4, 4) camera poses in the map.
    """
    listed = message.first + message.step * np.arange(message.T_map_camera.shape[0])
    known = listed < len(T_odom_camera)
    poses = np.array([pose_from_tq(row) for row in message.T_map_camera.numpy()[known]]).reshape(-1, 4, 4)
    if len(poses) == 0:
        return np.asarray(pose_from_tq(np.array(message.T_map_odom)) @ T_odom_camera)
    indices = listed[known]
    T_map_odom = poses @ inverse(T_odom_camera[indices])
    return np.array([_interpolated(k, indices, T_map_odom) @ T for k, T in enumerate(T_odom_camera)])


def _interpolated(k: int, indices: NDArray[np.int_], T_map_odom: Float) -> Float:
    after = int(np.searchsorted(indices, k))
    if after == len(indices) or indices[after] == k or after == 0:
        return np.asarray(T_map_odom[min(after, len(indices) - 1)])
    before = after - 1
    share = (k - indices[before]) / (indices[after] - indices[before])
    step = se3_log(inverse(T_map_odom[before]) @ T_map_odom[after])
    return np.asarray(T_map_odom[before] @ se3_exp(share * step))
