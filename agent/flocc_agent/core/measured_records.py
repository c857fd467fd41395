"""Measurements' records of all logs, and the factors made of them as soon as what they need is here.

Rules: a factor is made once, when somebody asks for it; who asks for those of one log pays for records that name its
robot only.
"""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.factors import Tracks, Waiting, factor_of, made_at
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.pose_graph import MeasuredFactor, is_landmark
from flocc_agent.geometry import symmetric
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import (
    MeasurementRecord,
    MetricClosureRecord,
    OdometryCovarianceRecord,
    Record,
    RobotBearingRecord,
    RobotSightingRecord,
)

Float = NDArray[np.float64]
Place = tuple[LogId, int]
"""A log and the number of a record in it."""

UNMEASURED_RAD = 1.0


class MeasuredRecords:
    """What was measured besides odometry and images, of every known log."""

    def __init__(self) -> None:
        self._unmade: dict[str, dict[Place, NewRecord]] = {}
        self._made: dict[LogId, dict[Place, MeasuredFactor]] = {}
        self._waiting: dict[str, dict[Place, float]] = {}
        self._edges: dict[LogId, dict[int, Float]] = {}
        self._links: set[tuple[LogId, LogId]] = set()

    def add(self, new: NewRecord, record: MeasurementRecord) -> tuple[KeyframeId, ...]:
        """Take in a record, which is the new one's, and give the keyframes that it speaks of."""
        if isinstance(record, OdometryCovarianceRecord):
            self._edges.setdefault(new.log, {})[record.index] = symmetric(record.covariance.numpy())
            return ()
        for robot in _robots_of(new.log, record):
            self._unmade.setdefault(robot, {})[new.log, new.number] = new
        return (record.query, record.match) if isinstance(record, MetricClosureRecord) else ()

    def writers(self) -> set[LogId]:
        """Logs in which something measured stands, or of which it speaks."""
        unmade = {log for places in self._unmade.values() for log, _ in places}
        made = {log for places in self._made.values() for log, _ in places}
        return unmade | made | set(self._made) | set(self._edges)

    def awaited(self, robot: str, stamp_s: float) -> bool:
        """Whether a sighting of a robot waited for its odometry to reach this stamp; it is told once."""
        stamps_s = self._waiting.get(robot)
        if not stamps_s or min(stamps_s.values()) > stamp_s:
            return False
        self._waiting[robot] = {place: other for place, other in stamps_s.items() if other > stamp_s}
        return True

    def factors(self, tracks: Tracks, known: Callable[[KeyframeId], bool]) -> tuple[MeasuredFactor, ...]:
        """All factors whose keyframes are here, by log and number."""
        self._make_everything(tracks, known)
        made = {place: factor for of_log in self._made.values() for place, factor in of_log.items()}
        return tuple(made[place] for place in sorted(made))

    def links(self, tracks: Tracks, known: Callable[[KeyframeId], bool]) -> list[tuple[LogId, LogId]]:
        """Pairs of logs, or of a log and a landmark, that factors join; sorted."""
        self._make_everything(tracks, known)
        return sorted(self._links)

    def of(self, log: LogId, tracks: Tracks, known: Callable[[KeyframeId], bool]) -> tuple[MeasuredFactor, ...]:
        """Those factors at a log's keyframes, or of them."""
        self._make_all(log.robot, tracks, known)
        made = self._made.get(log, {})
        return tuple(made[place] for place in sorted(made))

    def _make_everything(self, tracks: Tracks, known: Callable[[KeyframeId], bool]) -> None:
        for robot in [robot for robot, unmade in self._unmade.items() if unmade]:
            self._make_all(robot, tracks, known)

    def _make_all(self, robot: str, tracks: Tracks, known: Callable[[KeyframeId], bool]) -> None:
        """Make what can be made of the records that name a robot."""
        for new in list(self._unmade.get(robot, {}).values()):
            if self._make(new, tracks, known):
                for name in _robots_of(new.log, new.record):
                    del self._unmade[name][new.log, new.number]

    def _make(self, new: NewRecord, tracks: Tracks, known: Callable[[KeyframeId], bool]) -> bool:
        """Make a factor; whether the record need not be looked at again."""
        place = new.log, new.number
        keyframe = made_at(new.log, new.record)
        if keyframe is not None and not known(keyframe):
            return False
        made = factor_of(new.log, new.record, tracks)
        if isinstance(made, Waiting):
            self._waiting.setdefault(made.robot, {})[place] = made.stamp_s
            return False
        if made is None:
            return True
        if not all(is_landmark(end.log) or known(end) for end in (made.query, made.match)):
            return False
        for log in {made.query.log, made.match.log}:
            self._made.setdefault(log, {})[place] = made
        self._links.add((made.query.log, made.match.log))
        return True

    def edge_covariances(self, log: LogId, keyframes: int) -> Float | None:
        """Covariances (N-1, 6, 6) of a log's odometry edges, NaN where none was measured; None where none ever was."""
        measured: Mapping[int, Float] = self._edges.get(log, {})
        if not measured or keyframes < 2:
            return None
        covariances = np.full((keyframes - 1, 6, 6), np.nan)
        for index, covariance in measured.items():
            if 1 <= index < keyframes:
                covariances[index - 1] = covariance
        return covariances


def is_unmeasured(record: OdometryCovarianceRecord) -> bool:
    """Whether odometry says nothing of a step: its rotation may be off by over a radian about every axis.

    A robot that drives in a plane may well know nothing of two of them.
    """
    return bool(nobody_measured(symmetric(record.covariance.numpy())))


def nobody_measured(covariances: Float) -> NDArray[np.bool_]:
    """The same of steps with covariances (..., 6, 6)."""
    return np.asarray(np.linalg.eigvalsh(covariances[..., :3, :3])[..., 0] > UNMEASURED_RAD**2)


def _robots_of(log: LogId, record: Record) -> set[str]:
    """Robots whose logs a record of a log may speak of."""
    match record:
        case RobotSightingRecord() | RobotBearingRecord():
            return {log.robot, record.robot}
        case MetricClosureRecord(query, match):
            return {query.log.robot, match.log.robot}
        case _:
            return {log.robot}
