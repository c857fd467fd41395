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
    """Keyframes, closures and fixes of every known log."""

    def __init__(self) -> None:
        self._poses: dict[LogId, list[Float]] = {}
        self._closures: dict[CandidatePair, tuple[LogId, int, LoopClosure]] = {}
        self._fixes: list[AbsoluteFix] = []

    @property
    def keyframes(self) -> int:
        """Number of keyframes of all logs."""
        return sum(map(len, self._poses.values()))

    @property
    def closures(self) -> int:
        """Number of closures, each pair once."""
        return len(self._closures)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Logs, closures and fixes: when this changes, a solution is out of date."""
        return (len(self._poses), len(self._closures), len(self._fixes))

    def add(self, new: NewRecord) -> None:
        """Take in one record; records of a log come in their order."""
        match new.record:
            case KeyframeRecord(T_odom_camera=tq):
                self._poses.setdefault(new.log, []).append(pose_from_tq(np.array(tq)))
            case ClosureRecord():
                self._add_closure(new, new.record)
            case FixRecord(index, position_m, covariance_m2):
                covariance = covariance_m2.numpy().reshape(3, 3)
                self._fixes.append(AbsoluteFix(KeyframeId(new.log, index), position_m.numpy(), covariance))
            case _:
                pass

    def odometry_pair(self, keyframe: KeyframeId) -> tuple[KeyframeId, Pose7] | None:
        """The keyframe's neighbour in its log (the one before; after, for the first) and `T_neighbour_query`."""
        poses = self._poses.get(keyframe.log, [])
        neighbour = keyframe.index - 1 if keyframe.index > 0 else 1
        if keyframe.index >= len(poses) or neighbour >= len(poses):
            return None
        T_neighbour_query = between(poses[neighbour], poses[keyframe.index])
        return KeyframeId(keyframe.log, neighbour), pose7(T_neighbour_query)

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

    def _add_closure(self, new: NewRecord, record: ClosureRecord) -> None:
        """Of several registrations of one pair the one in the lowest log counts, on every robot."""
        pair = CandidatePair.of(record.query, record.match)
        held = self._closures.get(pair)
        if held is None or (new.log, new.number) < held[:2]:
            self._closures[pair] = (new.log, new.number, _closure(record))


def _closure(record: ClosureRecord) -> LoopClosure:
    return LoopClosure(
        query=record.query,
        match=record.match,
        T_query_match_unscaled=pose_from_tq(np.array(record.T_query_match_unscaled)),
        match_ratio=record.match_ratio,
        scale_initial=record.scale_initial,
        covariance=None if record.covariance is None else symmetric(record.covariance.numpy()),
    )
