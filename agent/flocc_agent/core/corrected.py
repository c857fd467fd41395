"""Corrected poses: a log's correction laid over that log's odometry.

A correction has knots at some keyframes of its log. Between two of them it is interpolated, after the last one it
stays; so it says where a robot was at any keyframe, and at any time between two. Reports and programs get the same
poses, and the leader checked them with the same function (`knots.py`).
"""

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.knots import corrected
from flocc_agent.core.log_copy import LogCopy
from flocc_agent.core.pose_graph import map_frame
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import interpolated, inverse, pose_from_tq, symmetric
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import LogCorrection
from flocc_protocol.records import GeodeticFixRecord, KeyframeRecord

Float = NDArray[np.float64]


class RecordedOdometry:
    """A log's keyframes as they were recorded; it reads on as the log grows.

    The place of a keyframe that a later version wrote is taken by the next one, as in the pose graph.
    """

    def __init__(self, copy: LogCopy) -> None:
        self._copy = copy
        self._read = 0
        self._stamps_s: list[float] = []
        self._T_odom_camera: list[Float] = []
        self._fixes: list[GeodeticFixRecord] = []

    def stamps_s(self) -> list[float]:
        """Time of each keyframe on its robot's clock, seconds."""
        self._read_on()
        return self._stamps_s

    def poses(self) -> list[Float]:
        """T_odom_camera (4, 4) of each keyframe."""
        self._read_on()
        return self._T_odom_camera

    def fixes(self) -> list[GeodeticFixRecord]:
        """Places on Earth that were measured at keyframes."""
        self._read_on()
        return self._fixes

    def _read_on(self) -> None:
        records = self._copy.records[self._read :]
        self._read += len(records)
        for record in records:
            if isinstance(record, KeyframeRecord):
                unread = record.index - len(self._stamps_s)
                self._stamps_s += [record.stamp_s] * (unread + 1)
                self._T_odom_camera += [pose_from_tq(np.array(record.T_odom_camera))] * (unread + 1)
            elif isinstance(record, GeodeticFixRecord):
                self._fixes.append(record)


class CorrectedLog:
    """Where one robot was in the map, by one correction of its log and all keyframes that are known of it.

    Poses are those of the body where `T_camera_body` says how the camera sits on it, else of the camera.
    """

    def __init__(
        self, correction: LogCorrection, odometry: RecordedOdometry, T_camera_body: Float | None = None
    ) -> None:
        self._correction = correction
        self._odometry = odometry
        self._T_camera_body = T_camera_body

    def __len__(self) -> int:
        return len(self._odometry.poses())

    @property
    def log(self) -> LogId:
        """Which log it is."""
        return self._correction.log

    @property
    def T_map_odom(self) -> Float:
        """(4, 4) of the odom frame that the newest keyframes are in."""
        return pose_from_tq(np.array(self._correction.T_map_odom))

    def pose_of(self, index: int) -> Float | None:
        """Corrected pose (4, 4) at a keyframe, by its number; None where no such keyframe is known."""
        poses = self._odometry.poses()
        if not 0 <= index < len(poses):
            return None
        return np.asarray(self._bodies(np.array([poses[index]]), np.array([index]))[0])

    def pose_at(self, stamp_s: float) -> Float | None:
        """Corrected pose (4, 4) at a time; None before the first and after the last known keyframe.

        Between two keyframes it is interpolated: odometry between them is not in the log.
        """
        stamps_s = self._odometry.stamps_s()
        after = bisect_right(stamps_s, stamp_s)
        before, last = self.pose_of(after - 1), self.pose_of(after)
        if before is None or stamps_s[after - 1] == stamp_s:
            return before
        if last is None:
            return None
        share = (stamp_s - stamps_s[after - 1]) / (stamps_s[after] - stamps_s[after - 1])
        return interpolated(before, last, share)

    def last(self) -> Float | None:
        """Corrected pose (4, 4) at the last known keyframe; None where none is known."""
        return self.pose_of(len(self) - 1)

    def poses(self) -> Float:
        """Corrected poses (N, 4, 4) at all known keyframes."""
        poses = np.array(self._odometry.poses()).reshape(-1, 4, 4)
        return self._bodies(poses, np.arange(len(poses)))

    def fixed_cameras(self) -> tuple[list[GeodeticFixRecord], Float]:
        """Places on Earth, and (N, 3) metres where their cameras are in the map.

        None where only the end of the log is known in the map: the way before it would be its odometry.
        """
        poses = self._odometry.poses()
        fixes = [fix for fix in self._odometry.fixes() if fix.index < len(poses) and self._correction.knots is not None]
        numbers = np.array([fix.index for fix in fixes], dtype=int)
        T_odom_camera = np.array(poses).reshape(-1, 4, 4)[numbers]
        return fixes, corrected(self._correction, T_odom_camera, numbers)[:, :3, 3]

    def _bodies(self, T_odom_camera: Float, numbers: NDArray[np.integer]) -> Float:
        T_map_camera = corrected(self._correction, T_odom_camera, numbers)
        return T_map_camera if self._T_camera_body is None else np.asarray(T_map_camera @ self._T_camera_body)


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What a robot's program gets: its odom frame in the map, where it was, and where the others were.

    Attributes:
        term: Term of the leader that made it.
        round: Its optimisation round; (term, round) only grows.
        map_frame: Name of the map frame.
        frame_changed: The map frame differs from the last correction's: everything jumps.
        T_map_odom: (4, 4) of the robot's odom frame.
        covariance: (6, 6) of T_map_odom, rotation first, or None.
        own: This robot's body in the map.
        others: Robot -> its camera in the same map, by the newest correction that was known when this one came. Where
            a camera sits on its body, only its robot knows. Where they are now is always known; how their earlier poses
            were corrected only after `Agent.follow_others()`, and at a leader.
    """

    term: Term
    round: int
    map_frame: str
    frame_changed: bool
    T_map_odom: Float
    covariance: Float | None
    own: CorrectedLog
    others: Mapping[str, CorrectedLog]

    def pose_of(self, keyframe: int) -> Float | None:
        """T_map_body (4, 4) at a keyframe of this robot, by its number; None where there is no such keyframe.

        Keyframes that came after this correction move with its end, until a newer one says more.
        """
        return self.own.pose_of(keyframe)

    def pose_at(self, stamp_s: float) -> Float | None:
        """T_map_body (4, 4) at a time on this robot's clock; None before its first and after its last keyframe."""
        return self.own.pose_at(stamp_s)


class Corrector:
    """Makes what programs get of the corrections that one robot applies; to be called where the robot is driven."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._odometry: dict[LogId, RecordedOdometry] = {}

    def correction(self, applied: LogCorrection, frame_changed: bool, T_body_camera: Float) -> Correction:
        """What an applied correction says of all robots that are known in its frame."""
        covariance = None if applied.knots is None else applied.knots.covariance
        return Correction(
            term=applied.term,
            round=applied.round,
            map_frame=map_frame(applied.anchor),
            frame_changed=frame_changed,
            T_map_odom=pose_from_tq(np.array(applied.T_map_odom)),
            covariance=None if covariance is None else symmetric(covariance.numpy()),
            own=self._corrected(applied, inverse(T_body_camera)),
            others=self._others(applied),
        )

    def now(self, T_body_camera: Float) -> dict[str, CorrectedLog]:
        """All robots in this robot's map, itself among them, by the newest corrections; none before its first.

        They share nothing with what programs were given, so another thread may read them.
        """
        own = self._robot.corrections.of(self._robot.log)
        if own is None:
            return {}
        fresh = Corrector(self._robot)
        return {own.log.robot: fresh._corrected(own, inverse(T_body_camera)), **fresh._others(own)}

    def _others(self, applied: LogCorrection) -> dict[str, CorrectedLog]:
        """The newest life of every other robot that has a correction in this frame."""
        found: dict[str, CorrectedLog] = {}
        for log in sorted(self._robot.gossip.logs):
            known = self._robot.corrections.of(log)
            if log.robot != applied.log.robot and known is not None and known.anchor == applied.anchor:
                found[log.robot] = self._corrected(known, None)
        return found

    def _corrected(self, correction: LogCorrection, T_camera_body: Float | None) -> CorrectedLog:
        odometry = self._odometry.get(correction.log)
        if odometry is None:
            odometry = RecordedOdometry(self._robot.gossip.logs[correction.log])
            self._odometry[correction.log] = odometry
        return CorrectedLog(correction, odometry, T_camera_body)
