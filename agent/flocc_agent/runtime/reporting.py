"""What a robot's run leaves for people: facts and `result.json`. The same for every driver.

The core knows camera poses only; users know the body. Both speak of the body.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.corrected import CorrectedLog, RecordedOdometry
from flocc_agent.core.pose_graph import GraphSolution, map_frame
from flocc_agent.core.registration import closure_probability
from flocc_agent.core.reports import ClosureAccepted, CorrectionApplied, Fact, KeyframeTaken
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import inverse, pose7, pose7s, pose_from_tq, poses_from_tq
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.robot_result import ClosureKnown, KeyframeResult, LostRobot, RobotResult
from flocc_protocol.codec import Pose7
from flocc_protocol.messages import CandidatePair, Knots
from flocc_protocol.records import ClosureRecord, KeyframeRecord, RejectionRecord

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
                return replace(fact, T_odom_body=self._body(fact.T_odom_body))
            case CorrectionApplied():
                return replace(fact, T_map_body=tuple(map(_rounded, self._bodies(fact.T_map_body))))
            case ClosureAccepted():
                return replace(fact, probability=round(closure_probability(fact.ratio, self.steepness), 6))
        return fact

    def _body(self, T_camera: Pose7) -> Pose7:
        """The body's pose, of the camera's in the same frame."""
        return pose7(pose_from_tq(np.array(T_camera)) @ inverse(self.T_body_camera))

    def _bodies(self, T_camera: tuple[Pose7, ...]) -> tuple[Pose7, ...]:
        if not T_camera:
            return ()
        return pose7s(poses_from_tq(np.array(T_camera)) @ inverse(self.T_body_camera))


def _rounded(pose: Pose7) -> Pose7:
    """A pose to a tenth of a millimetre and some microradians, so that lines stay short."""
    x, y, z, *q = pose
    w, i, j, k = (round(part, 5) for part in q)
    return round(x, 4), round(y, 4), round(z, 4), w, i, j, k


def result_of(robot: Robot, T_body_camera: Float, solution: GraphSolution | None = None) -> RobotResult:
    """What a robot knows at its end: its trajectory before and after correction, closures, sizes of logs."""
    records = [r for r in robot.gossip.logs[robot.log].records if isinstance(r, KeyframeRecord)]
    T_odom_camera = np.array([pose_from_tq(np.array(r.T_odom_camera)) for r in records]).reshape(-1, 4, 4)
    applied = robot.corrections.applied
    T_camera_body = inverse(T_body_camera)
    _, T_map_body = corrected_bodies(robot, T_body_camera)
    keyframes = [
        KeyframeResult(
            index=record.index,
            stamp_s=record.stamp_s,
            T_odom_body=list(pose7(T_odom_camera[i] @ T_camera_body)),
            T_map_body=None if applied is None else list(pose7(T_map_body[record.index])),
        )
        for i, record in enumerate(records)
    ]
    return RobotResult(
        robot=robot.log.robot,
        incarnation=robot.log.incarnation,
        map_frame=None if applied is None else map_frame(applied.anchor),
        T_map_odom=None if applied is None else list(applied.T_map_odom),
        T_body_camera=list(pose7(T_body_camera)),
        keyframes=keyframes,
        closures=closures_known(robot, solution),
        logs={str(digest.log): digest.count for digest in robot.gossip.digests()},
        lost=lost_robots(robot),
        best_similarities=best_similarities(robot),
    )


def lost_robots(robot: Robot) -> list[LostRobot]:
    """The last corrections of robots that are not heard, as far as a robot knows them; all of them if it leads."""
    heard = {robot.log.robot, *robot.neighbours.names()}
    found = []
    for log in sorted(robot.gossip.logs):
        known = None if log.robot in heard else robot.corrections.of(log)
        if known is None:
            continue
        where = LostRobot(
            log=str(log),
            map_frame=map_frame(known.anchor),
            term=known.term.counter,
            round=known.round,
            T_map_odom=list(known.T_map_odom),
        )
        found.append(where if known.knots is None else where.model_copy(update=_bends(known.knots)))
    return found


def _bends(knots: Knots) -> dict[str, object]:
    return {
        "knots": knots.keyframes.numpy().astype(int).tolist(),
        "twists": knots.twists.numpy().round(6).tolist(),
        "about_odom_m": knots.about_odom_m.numpy().tolist(),
    }


def corrected_bodies(robot: Robot, T_body_camera: Float) -> tuple[list[float], Float]:
    """Stamps (s) and (N, 4, 4) corrected body poses of all own keyframes; none before the first correction."""
    applied = robot.corrections.applied
    if applied is None:
        return [], np.zeros((0, 4, 4))
    odometry = RecordedOdometry(robot.gossip.logs[robot.log])
    T_map_body = CorrectedLog(applied, odometry, inverse(T_body_camera)).poses()
    return odometry.stamps_s()[: len(T_map_body)], T_map_body


def best_similarities(robot: Robot) -> dict[str, float]:
    """Best cosine similarity of any keyframe of each other robot with one of this robot, below the threshold too."""
    return {name: round(best, 4) for name, best in sorted(robot.recognition.best_similarities.items())}


def counted(robot: Robot) -> Iterator[ClosureRecord | RejectionRecord]:
    """Judgements of all logs, the lowest log's first, without those of keyframes that were taken back since."""
    counts = robot.assembly.withdrawals.counts
    for log, copy in sorted(robot.gossip.logs.items()):
        for number, record in copy.judgements():
            if counts(log, number, CandidatePair.of(record.query, record.match)):
                yield record


def closures_known(robot: Robot, solution: GraphSolution | None) -> list[ClosureKnown]:
    """Every closure in a robot's logs that counts, each pair once, with the scale of the last solution it made."""
    scales = {} if solution is None else {CandidatePair.of(c.query, c.match): c.scale for c in solution.closures}
    found: dict[CandidatePair, ClosureRecord] = {}
    for record in counted(robot):
        if isinstance(record, ClosureRecord):
            found.setdefault(CandidatePair.of(record.query, record.match), record)
    return [
        ClosureKnown(
            query=str(record.query),
            match=str(record.match),
            T_query_match_unscaled=list(record.T_query_match_unscaled),
            match_ratio=record.match_ratio,
            scale_initial=record.scale_initial,
            scale=scales.get(pair),
        )
        for pair, record in sorted(found.items())
    ]
