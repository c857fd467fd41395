"""Pose-graph assembly: from the records of all logs to the graph that the leader optimises."""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.corrections import pose7, symmetric
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.pose_graph import AbsoluteFix, LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import between, pose_from_tq
from flocc_protocol.codec import Pose7
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import ClosureRecord, FixRecord, KeyframeRecord

Float = NDArray[np.float64]


class GraphAssembly:
    """Keyframes, closures and fixes of every known log.

    Attributes:
        keyframes: Number of keyframes of all logs.
        revision: Grows when a solution is out of date: a new log, closure or fix, or a keyframe that one waited for.
    """

    def __init__(self) -> None:
        self.keyframes = 0
        self.revision = 0
        self._poses: dict[LogId, list[Float]] = {}
        self._encoded: dict[LogId, list[bool]] = {}
        self._closures: dict[CandidatePair, tuple[LogId, int, LoopClosure]] = {}
        self._early: dict[KeyframeId, int] = {}
        self._fixes: list[AbsoluteFix] = []
        self._odometry_pairs: dict[KeyframeId, tuple[KeyframeId, Pose7]] = {}

    @property
    def closures(self) -> int:
        """Number of closures, each pair once."""
        return len(self._closures)

    def add(self, new: NewRecord) -> None:
        """Take in one record; records of a log come in their order, those of different logs in any."""
        match new.record:
            case KeyframeRecord():
                self._add_keyframe(new.log, new.record)
            case ClosureRecord():
                self._add_closure(new, new.record)
            case FixRecord(index, position_m, covariance_m2):
                covariance = covariance_m2.numpy().reshape(3, 3)
                self._fixes.append(AbsoluteFix(KeyframeId(new.log, index), position_m.numpy(), covariance))
                self.revision += 1
            case _:
                pass

    def odometry_pair(self, keyframe: KeyframeId) -> tuple[KeyframeId, Pose7] | None:
        """The keyframe's neighbour in its log that has a latent, and `T_neighbour_query`.

        The nearest before it; for the first ones the nearest after it, None as long as there is none.
        """
        found = self._odometry_pairs.get(keyframe)
        if found is None:
            index = self._neighbour(keyframe)
            if index is None:
                return None
            poses = self._poses[keyframe.log]
            T_neighbour_query = pose7(between(poses[index], poses[keyframe.index]))
            found = self._odometry_pairs[keyframe] = (KeyframeId(keyframe.log, index), T_neighbour_query)
        return found

    def _neighbour(self, keyframe: KeyframeId) -> int | None:
        encoded = self._encoded.get(keyframe.log, [])
        if keyframe.index >= len(encoded):
            return None
        around = (*range(keyframe.index - 1, -1, -1), *range(keyframe.index + 1, len(encoded)))
        return next((index for index in around if encoded[index]), None)

    def graph(self) -> PoseGraph:
        """The pose graph of everything known; closures whose keyframes are not here yet are left out."""
        trajectories = {log: Trajectory(np.array(poses)) for log, poses in sorted(self._poses.items())}
        closures = tuple(
            closure
            for _, (_, _, closure) in sorted(self._closures.items(), key=lambda item: item[0])
            if self._known(closure.query) and self._known(closure.match)
        )
        return PoseGraph(trajectories, closures, tuple(fix for fix in self._fixes if self._known(fix.keyframe)))

    def _known(self, keyframe: KeyframeId) -> bool:
        return keyframe.index < len(self._poses.get(keyframe.log, []))

    def _add_keyframe(self, log: LogId, record: KeyframeRecord) -> None:
        """A new log, or a keyframe that a closure was waiting for, makes the last solution out of date."""
        poses = self._poses.setdefault(log, [])
        keyframe = KeyframeId(log, len(poses))
        poses.append(pose_from_tq(np.array(record.T_odom_camera)))
        self._encoded.setdefault(log, []).append(record.descriptor is not None)
        self.keyframes += 1
        self.revision += len(poses) == 1 or self._early.pop(keyframe, 0) > 0

    def _add_closure(self, new: NewRecord, record: ClosureRecord) -> None:
        """Of several registrations of one pair the one in the lowest log counts, on every robot."""
        pair = CandidatePair.of(record.query, record.match)
        held = self._closures.get(pair)
        if held is None or (new.log, new.number) < held[:2]:
            self._closures[pair] = (new.log, new.number, _closure(record))
            self.revision += 1
            for keyframe in (record.query, record.match):
                if not self._known(keyframe):
                    self._early[keyframe] = self._early.get(keyframe, 0) + 1


def _closure(record: ClosureRecord) -> LoopClosure:
    return LoopClosure(
        query=record.query,
        match=record.match,
        T_query_match_unscaled=pose_from_tq(np.array(record.T_query_match_unscaled)),
        match_ratio=record.match_ratio,
        scale_initial=record.scale_initial,
        covariance=None if record.covariance is None else symmetric(record.covariance.numpy()),
    )
