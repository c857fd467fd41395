"""Measurements' records of all logs, and the factors made of them as soon as what they need is here."""

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
)

Float = NDArray[np.float64]


class MeasuredRecords:
    """What was measured besides odometry and images, of every known log."""

    def __init__(self) -> None:
        self._unmade: list[NewRecord] = []
        self._made: dict[tuple[LogId, int], MeasuredFactor] = {}
        self._waiting: dict[str, list[float]] = {}
        self._edges: dict[LogId, dict[int, Float]] = {}

    def add(self, new: NewRecord, record: MeasurementRecord) -> tuple[KeyframeId, ...]:
        """Take in a record, which is the new one's, and give the keyframes that it speaks of."""
        if isinstance(record, OdometryCovarianceRecord):
            self._edges.setdefault(new.log, {})[record.index] = symmetric(record.covariance.numpy())
            return ()
        self._unmade.append(new)
        return (record.query, record.match) if isinstance(record, MetricClosureRecord) else ()

    def awaited(self, robot: str, stamp_s: float) -> bool:
        """Whether a sighting of a robot waited for its odometry to reach this stamp; it is told once."""
        stamps_s = self._waiting.get(robot)
        if not stamps_s or min(stamps_s) > stamp_s:
            return False
        self._waiting[robot] = [other for other in stamps_s if other > stamp_s]
        return True

    def factors(self, tracks: Tracks, known: Callable[[KeyframeId], bool]) -> tuple[MeasuredFactor, ...]:
        """All factors whose keyframes are here, by log and number."""
        self._waiting.clear()
        self._unmade = [new for new in self._unmade if not self._make(new, tracks, known)]
        return tuple(self._made[key] for key in sorted(self._made))

    def _make(self, new: NewRecord, tracks: Tracks, known: Callable[[KeyframeId], bool]) -> bool:
        """Make a factor; whether the record need not be looked at again."""
        keyframe = made_at(new.log, new.record)
        if keyframe is not None and not known(keyframe):
            return False
        made = factor_of(new.log, new.record, tracks)
        if isinstance(made, Waiting):
            self._waiting.setdefault(made.robot, []).append(made.stamp_s)
            return False
        if made is None:
            return True
        if not all(is_landmark(end.log) or known(end) for end in (made.query, made.match)):
            return False
        self._made[new.log, new.number] = made
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
