"""From a measurement's record to a factor of the pose graph: one function per type of record.

A factor needs nothing but its record, or, where another robot was seen, both robots' odometry: the seen robot's pose
at the stamp of the sighting lies between two of its keyframes.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.geodesy import Place
from flocc_agent.core.measurements import (
    Fix,
    GeodeticFix,
    MetricClosure,
    PoseFix,
    RobotBearing,
    RobotSighting,
    TagSighting,
)
from flocc_agent.core.pose_graph import EARTH, WORLD, MeasuredFactor, landmark
from flocc_agent.geometry import adjoint, between, inverse, pose, pose_from_tq, se3_exp, se3_log, symmetric
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import (
    ClosureRecord,
    FixRecord,
    GeodeticFixRecord,
    MetricClosureRecord,
    PoseFixRecord,
    Record,
    RejectionRecord,
    RobotBearingRecord,
    RobotSightingRecord,
    TagSightingRecord,
    UnknownRecord,
    WithdrawalRecord,
)

Float = NDArray[np.float64]


class OdometryTrack(Protocol):
    """One log's odometry, as far as factors need it."""

    def stamp_s(self, index: int) -> float:
        """When a keyframe was taken."""
        ...

    def around(self, stamp_s: float) -> tuple[int, float] | None:
        """Last keyframe not after a stamp, and the stamp's share of the way to the next; None outside of the log."""
        ...

    def pose(self, index: int) -> Float:
        """`T_odom_camera` (4, 4) of a keyframe."""
        ...


class Waiting(NamedTuple):
    """A factor that cannot be made yet: a robot's odometry does not reach the stamp."""

    robot: str
    stamp_s: float


Tracks = Mapping[LogId, OdometryTrack]
Made = MeasuredFactor | Waiting | None


def fix_factor(log: LogId, record: FixRecord, _: Tracks) -> Made:
    """A position in the world."""
    at = KeyframeId(log, record.index)
    T = pose(np.eye(3), record.position_m.numpy())
    return MeasuredFactor(Fix.kind, at, landmark(WORLD), at, T, record.covariance_m2.numpy().reshape(3, 3))


def geodetic_factor(log: LogId, record: GeodeticFixRecord, _: Tracks) -> Made:
    """A place on Earth; the back end chooses the origin from which it is told."""
    at = KeyframeId(log, record.index)
    place = Place(record.latitude_deg, record.longitude_deg, record.altitude_m)
    covariance = record.covariance_m2.numpy().reshape(3, 3)
    return MeasuredFactor(GeodeticFix.kind, at, landmark(EARTH), at, np.eye(4), covariance, place)


def pose_fix_factor(log: LogId, record: PoseFixRecord, _: Tracks) -> Made:
    """A whole pose in the world."""
    at = KeyframeId(log, record.index)
    T, covariance = pose_from_tq(np.array(record.T_world_camera)), symmetric(record.covariance.numpy())
    return MeasuredFactor(PoseFix.kind, at, landmark(WORLD), at, T, covariance)


def tag_factor(log: LogId, record: TagSightingRecord, _: Tracks) -> Made:
    """A tag's pose; all sightings of one name are of one landmark."""
    at = KeyframeId(log, record.index)
    T, covariance = pose_from_tq(np.array(record.T_camera_tag)), symmetric(record.covariance.numpy())
    return MeasuredFactor(TagSighting.kind, at, at, landmark(f"tag/{record.tag}"), T, covariance)


def robot_factor(log: LogId, record: RobotSightingRecord, tracks: Tracks) -> Made:
    """Another robot's pose, told of its nearest keyframe."""
    stamp_s = tracks[log].stamp_s(record.index)
    found = _seen(log, record.robot, stamp_s, tracks)
    if found is None:
        return Waiting(record.robot, stamp_s)
    match, T_seen_match, spread = found
    A = adjoint(inverse(T_seen_match))
    covariance = A @ (symmetric(record.covariance.numpy()) + spread) @ A.T
    T = pose_from_tq(np.array(record.T_camera_seen)) @ T_seen_match
    return MeasuredFactor(RobotSighting.kind, *_ends(log, record.index, match), T, 0.5 * (covariance + covariance.T))


def bearing_factor(log: LogId, record: RobotBearingRecord, tracks: Tracks) -> Made:
    """Another robot's position, told of its nearest keyframe, whose own motion since is left out.

    The way between that keyframe and the stamp cannot be turned into this robot's frame, so it widens the covariance.
    """
    stamp_s = tracks[log].stamp_s(record.index)
    found = _seen(log, record.robot, stamp_s, tracks)
    if found is None:
        return Waiting(record.robot, stamp_s)
    match, T_seen_match, _ = found
    moved_m2 = float(T_seen_match[:3, 3] @ T_seen_match[:3, 3])
    covariance = record.covariance_m2.numpy().reshape(3, 3) + moved_m2 * np.eye(3)
    T = pose(np.eye(3), record.position_m.numpy())
    return MeasuredFactor(RobotBearing.kind, *_ends(log, record.index, match), T, covariance)


def metric_closure_factor(log: LogId, record: MetricClosureRecord, _: Tracks) -> Made:
    """A registration of a user's own."""
    T, covariance = pose_from_tq(np.array(record.T_query_match)), symmetric(record.covariance.numpy())
    at = record.query if record.query.log == log else record.match
    return MeasuredFactor(MetricClosure.kind, at, record.query, record.match, T, covariance)


_MAKERS: dict[type, Callable[[LogId, Any, Tracks], Made]] = {
    FixRecord: fix_factor,
    GeodeticFixRecord: geodetic_factor,
    PoseFixRecord: pose_fix_factor,
    TagSightingRecord: tag_factor,
    RobotSightingRecord: robot_factor,
    RobotBearingRecord: bearing_factor,
    MetricClosureRecord: metric_closure_factor,
}


def factor_of(log: LogId, record: object, tracks: Tracks) -> Made:
    """The factor of a measurement's record; None where the record makes none."""
    maker = _MAKERS.get(type(record))
    return None if maker is None else maker(log, record, tracks)


def made_at(log: LogId, record: Record) -> KeyframeId | None:
    """The keyframe of its log at which a measurement was made; None where the record names its keyframes itself."""
    match record:
        case ClosureRecord() | RejectionRecord() | MetricClosureRecord() | WithdrawalRecord() | UnknownRecord():
            return None
        case _:
            return KeyframeId(log, record.index)


def _seen(log: LogId, robot: str, stamp_s: float, tracks: Tracks) -> tuple[KeyframeId, Float, Float] | None:
    """The seen robot's keyframe nearest to a stamp, that keyframe's pose in where the robot was, and what is unsure.

    Where a robot was between two keyframes is taken from a constant twist; how far that may be from the truth, nothing
    at a keyframe and a quarter of the way in the middle, is the (6, 6) covariance.
    """
    for seen in sorted((other for other in tracks if other.robot == robot and other != log), reverse=True):
        track, found = tracks[seen], tracks[seen].around(stamp_s)
        if found is None:
            continue
        before, share = found
        near = before + (share > 0.5)
        step = se3_log(between(track.pose(before), track.pose(before + (share > 0.0))))
        T_odom_seen = track.pose(before) @ se3_exp(share * step)
        unsure = share * (1.0 - share) * np.linalg.norm(step.reshape(2, 3), axis=1)
        spread = np.diag(np.repeat(unsure**2, 3))
        return KeyframeId(seen, near), between(T_odom_seen, track.pose(near)), spread
    return None


def _ends(log: LogId, index: int, match: KeyframeId) -> tuple[KeyframeId, KeyframeId, KeyframeId]:
    at = KeyframeId(log, index)
    return at, at, match
