"""Pose-graph assembly: from the records of all logs to the graph that the leader optimises.

Every robot takes in every record, and only a leader asks for the graph: odometry and closures are kept as rows of
numbers, and become matrices when somebody wants them.
"""

from array import array
from bisect import bisect_right, insort
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.closure_rows import ClosureTable, Tie
from flocc_agent.core.cold_storage import ColdPieces, RowPieces
from flocc_agent.core.foretelling import Foretelling
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.measured_records import MeasuredRecords, is_unmeasured
from flocc_agent.core.parameters import KEYFRAMES_HELD
from flocc_agent.core.pose_graph import LoopClosure, MeasuredFactor, PoseGraph, Trajectory, groups_of
from flocc_agent.core.pulls import remember
from flocc_agent.core.registration import ODOMETRY_CORRESPONDENCES_MIN
from flocc_agent.core.saved_map import SavedMap
from flocc_agent.core.tentative_joins import TentativeJoins
from flocc_agent.core.withdrawals import Withdrawals
from flocc_agent.geometry import between, pose7, pose_from_tq, poses_from_tq
from flocc_protocol.codec import Pose7
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import (
    ClosureRecord,
    KeyframeRecord,
    LatentRecord,
    OdometryCovarianceRecord,
    RejectionRecord,
    UnknownRecord,
    WithdrawalRecord,
)

Float = NDArray[np.float64]

ODOMETRY_PAIRS_MAX = 1024
"""Neighbours that are remembered: those of the pairs that are at work."""
POSES_OF_A_PIECE = 64
"""Poses that leave memory together: some 4 kB."""
POSE = Struct("<7d")


class _Odometry:
    """One log's keyframes as columns: poses as its records give them, stamps, and whether each was described.

    The place of a keyframe that a later version wrote is taken by the pose of the next one; nothing is tied to it. Old
    poses leave memory where there is a cold storage, and with them what was made of them. `parts` has the keyframes
    before which nobody measured the step.
    """

    def __init__(self, cold: ColdPieces | None = None) -> None:
        self.stamps_s = array("d")
        self.encoded = bytearray()
        self.unread: set[int] = set()
        self.parts: list[int] = []
        self._poses = RowPieces(POSE.size, POSES_OF_A_PIECE, cold)
        self._matrices: Float = np.empty((0, 4, 4))

    def __len__(self) -> int:
        return len(self.stamps_s)

    def add(self, stamp_s: float, T_odom_keyframe: Pose7, is_described: bool) -> None:
        """The next keyframe."""
        self.stamps_s.append(stamp_s)
        self._poses.append(POSE.pack(*T_odom_keyframe))
        self.encoded.append(is_described)
        if self._poses.is_cold:
            self._matrices = np.empty((0, 4, 4))

    def matrices(self) -> Float:
        """All poses (N, 4, 4), T_odom_keyframe; held as long as all that they are made of is."""
        known = 0 if self._poses.is_cold else len(self._matrices)
        if known and known == len(self):
            return self._matrices
        rows = np.frombuffer(self._poses.all(known)).reshape(-1, 7)
        found = np.concatenate([self._matrices[:known], poses_from_tq(rows)])
        self._matrices = np.empty((0, 4, 4)) if self._poses.is_cold else found
        return found

    def poses(self, indices: Sequence[int]) -> Float:
        """`T_odom_keyframe` (K, 4, 4) of some keyframes."""
        return poses_from_tq(self.tq(indices))

    def positions_m(self, indices: Sequence[int]) -> Float:
        """Where they were (K, 3)."""
        return self.tq(indices)[:, :3]

    def tq(self, indices: Sequence[int]) -> Float:
        """The same as rows (K, 7): translation x y z, quaternion w x y z."""
        return np.frombuffer(b"".join(self._poses.row(index) for index in indices)).reshape(-1, 7)

    def pose(self, index: int) -> Float:
        """`T_odom_keyframe` (4, 4)."""
        return pose_from_tq(np.frombuffer(self._poses.row(index)))

    def stamp_s(self, index: int) -> float:
        """When a keyframe was taken."""
        return self.stamps_s[index]

    def around(self, stamp_s: float) -> tuple[int, float] | None:
        """Last keyframe not after a stamp, and the stamp's share of the way to the next; None outside of the log."""
        before = bisect_right(self.stamps_s, stamp_s) - 1
        if before < 0 or (before == len(self.stamps_s) - 1 and self.stamps_s[before] < stamp_s):
            return None
        if before == len(self.stamps_s) - 1:
            return before, 0.0
        passed_s, lasts_s = stamp_s - self.stamps_s[before], self.stamps_s[before + 1] - self.stamps_s[before]
        return before, passed_s / lasts_s

    def neighbour(self, index: int) -> int | None:
        """The nearest described keyframe before this one, for the first ones of a part the nearest after it."""
        part = bisect_right(self.parts, index)
        first = self.parts[part - 1] if part else 0
        end = self.parts[part] if part < len(self.parts) else len(self.encoded)
        around = chain(range(index - 1, first - 1, -1), range(index + 1, end))
        return next((other for other in around if self.encoded[other]), None)

    def between(self, index: int, other: int) -> Pose7:
        """Pose of one keyframe in the frame of another, `T_other_index`."""
        return pose7(between(self.pose(other), self.pose(index)))


class GraphAssembly:
    """Keyframes, closures and measurements of every known log.

    Attributes:
        keyframes: Number of keyframes of all logs but those of an opened map, which are solved already.
        withdrawals: Which keyframes were taken back; closures of them do not count.
        foretelling: What closures say of pairs around them.
    """

    def __init__(
        self,
        saved: SavedMap | None = None,
        cold: ColdPieces | None = None,
        cold_closures: ColdPieces | None = None,
        closures_built_max: int = KEYFRAMES_HELD,
    ) -> None:
        """Start with nothing.

        Args:
            saved: The opened map, where there is one.
            cold: Where pieces of old odometry go; None: all stay in memory.
            cold_closures: Where those of old closures go.
            closures_built_max: Closures that are kept between two looks at the graph.
        """
        self._cold = cold
        self._cold_closures = cold_closures
        self.keyframes = 0
        self._revision = 0
        self._saved = saved
        self._odometry: dict[LogId, _Odometry] = {}
        self.withdrawals = Withdrawals()
        self._closures = ClosureTable(cold_closures, closures_built_max, self.withdrawals.rank)
        self._tentative = TentativeJoins(self._closures, self._odometry.get)
        self.foretelling = Foretelling(self._closures, self._odometry.get, self._known)
        self._reads_all = True
        self._early: dict[KeyframeId, int] = {}
        self._measured = MeasuredRecords()
        self._odometry_pairs: dict[KeyframeId, tuple[KeyframeId, Pose7]] = {}

    @property
    def closures(self) -> int:
        """Number of closures, each pair once."""
        return len(self._closures)

    @property
    def revision(self) -> int:
        """Grows when a solution is out of date: a new log, closure, fix or doubt, or a keyframe that one waited for."""
        return self._revision + self._tentative.changes()

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        pieces = {"warm_odometry_pieces": self._cold, "warm_closure_pieces": self._cold_closures}
        warm = {name: cold.size() for name, cold in pieces.items() if cold is not None}
        return warm | self._closures.sizes() | self.withdrawals.sizes()

    def add(self, new: NewRecord) -> list[CandidatePair]:
        """Take in one record; records of a log come in their order, those of different logs in any.

        Returns:
            Pairs of which a closure is known that does not count, or no more.
        """
        record = new.record
        match record:
            case KeyframeRecord():
                self._add_keyframe(new.log, record)
            case ClosureRecord():
                return self._add_closure(new, record)
            case RejectionRecord():
                self._add_rejection(new, record)
            case WithdrawalRecord():
                return self._withdraw(new, record)
            case LatentRecord():
                pass
            case UnknownRecord():
                self._reads_all = False
            case _:
                self._revision += 1
                self._await(self._measured.add(new, record))
                if isinstance(record, OdometryCovarianceRecord) and is_unmeasured(record):
                    self._part(new.log, record.index)
        return []

    def _part(self, log: LogId, index: int) -> None:
        """Nobody measured the step to a keyframe: what is before it is no neighbour of what is after."""
        odometry = self._odometry.get(log)
        if odometry is not None and index not in odometry.parts:
            insort(odometry.parts, index)
            self._forget_pairs(log)

    def _forget_pairs(self, log: LogId) -> None:
        for keyframe in [keyframe for keyframe in self._odometry_pairs if keyframe.log == log]:
            del self._odometry_pairs[keyframe]

    def odometry_pair(self, keyframe: KeyframeId) -> tuple[KeyframeId, Pose7] | None:
        """The keyframe's neighbour in its log that has a latent, and `T_neighbour_query`.

        The nearest before it; for the first ones, also those after a step that nobody measured, the nearest after it,
        None as long as there is none.
        """
        found = self._odometry_pairs.get(keyframe)
        if found is None:
            odometry = self._odometry.get(keyframe.log)
            if odometry is None or keyframe.index >= len(odometry):
                return None
            index = odometry.neighbour(keyframe.index)
            if index is None:
                return None
            found = KeyframeId(keyframe.log, index), odometry.between(keyframe.index, index)
            remember(self._odometry_pairs, keyframe, found, ODOMETRY_PAIRS_MAX)
        return found

    def odometry(self, log: LogId) -> Float:
        """T_odom_camera (N, 4, 4) of the known keyframes of a log."""
        odometry = self._odometry.get(log)
        return np.empty((0, 4, 4)) if odometry is None else odometry.matrices()

    def ties(self, log: LogId, ties_max: int) -> Sequence[Tie]:
        """The newest closures of a log; their records are not read."""
        return self._closures.ties(log, ties_max)

    def tied(self) -> set[LogId]:
        """Logs that the graph needs: closures tie them, or stand in them, or something was measured there."""
        saved = set() if self._saved is None else set(self._saved.logs)
        return self._closures.logs() | saved | self._measured.writers()

    def forget(self, log: LogId) -> None:
        """Hold nothing more of a log that is not tied."""
        odometry = self._odometry.pop(log, None)
        if odometry is not None:
            self.keyframes -= len(odometry)
            self._revision += 1
        self._forget_pairs(log)

    def measured(self, log: LogId) -> Sequence[MeasuredFactor]:
        """What else was measured at a log's keyframes, or of them."""
        return self._measured.of(log, self._odometry, self._known)

    def joined(self, log: LogId, other: LogId) -> bool:
        """Whether closures, other measurements or the opened map lead from one log to the other.

        Where there are records of a later version, any of them may: another log is enough then.
        """
        if not self._reads_all and log in self._odometry and other in self._odometry:
            return True
        links = self._closures.links() + self._measured.links(self._odometry, self._known)
        if self._saved is not None:
            links += [(self._saved.anchor, each) for each in self._saved.logs]
        ends = {end for link in links for end in link}
        groups = groups_of(sorted(ends), links)
        return any(log in group and other in group for group in groups)

    def graph(self) -> PoseGraph:
        """The pose graph of everything known; closures whose keyframes are not here yet are left out."""
        trajectories = {log: self._trajectory(log) for log in sorted(self._odometry)}
        measured = self._measured.factors(self._odometry, self._known)
        unread = {KeyframeId(log, index) for log, odometry in self._odometry.items() for index in odometry.unread}
        closures = self._closures.closures(lambda log: len(trajectories.get(log, ())), unread)
        if doubted := self._tentative.doubted():
            closures = [_doubted(closure, doubted) for closure in closures]
        return PoseGraph(trajectories, tuple(closures), measured=measured, saved=self._saved)

    def asked(self, pair: CandidatePair) -> tuple[CandidatePair, ...]:
        """Pairs that would tell whether the tentative joins of a pair's two logs are right."""
        return self._tentative.of(pair.low.log, pair.high.log).asked

    def forget_built(self) -> None:
        """Nobody asks for the graph for now: keep nothing of it that can be made anew."""
        self._closures.forget_built()

    def _trajectory(self, log: LogId) -> Trajectory:
        T_odom_keyframe = self._odometry[log].matrices()
        return Trajectory(T_odom_keyframe, self._measured.edge_covariances(log, len(T_odom_keyframe)))

    def _known(self, keyframe: KeyframeId) -> bool:
        odometry = self._odometry.get(keyframe.log)
        return odometry is not None and keyframe.index < len(odometry) and keyframe.index not in odometry.unread

    def _add_keyframe(self, log: LogId, record: KeyframeRecord) -> None:
        """A new log, or a keyframe that a closure was waiting for, makes the last solution out of date."""
        odometry = self._odometry.get(log)
        if odometry is None:
            odometry = self._odometry[log] = _Odometry(self._cold)
        while len(odometry) < record.index:
            odometry.unread.add(len(odometry))
            odometry.add(record.stamp_s, record.T_odom_camera, is_described=False)
        odometry.add(record.stamp_s, record.T_odom_camera, is_described=record.descriptor is not None)
        self.keyframes += self._saved is None or log not in self._saved.closed
        awaited = bool(self._early) and self._early.pop(KeyframeId(log, len(odometry) - 1), 0) > 0
        awaited |= self._measured.awaited(log.robot, record.stamp_s)
        self._revision += awaited or len(odometry) == 1

    def _add_closure(self, new: NewRecord, record: ClosureRecord) -> list[CandidatePair]:
        """A closure, for the graph where it counts; else its pair."""
        pair = CandidatePair.of(record.query, record.match)
        self.withdrawals.on_judged(new.log, new.number, pair)
        if not self.withdrawals.counts(new.log, new.number, pair):
            return [pair]
        if self._closures.add(new.log, new.number, record):
            self._tentative.on_closure(pair)
            self._revision += 1
            self._await((record.query, record.match))
        return []

    def _add_rejection(self, new: NewRecord, record: RejectionRecord) -> None:
        """A pair that was registered in vain says something of the joins of its logs, where there was much to see."""
        pair = CandidatePair.of(record.query, record.match)
        self.withdrawals.on_judged(new.log, new.number, pair)
        counts = self.withdrawals.counts(new.log, new.number, pair)
        if counts and record.odometry_correspondences >= ODOMETRY_CORRESPONDENCES_MIN:
            self._tentative.on_refused(pair)

    def _withdraw(self, new: NewRecord, record: WithdrawalRecord) -> list[CandidatePair]:
        """A robot took keyframes back: the pairs of closures that leave the graph."""
        if not self.withdrawals.add(new.log, new.number, record):
            return []
        gone = self._closures.take_out(record.log, record.first, record.end, self.withdrawals.counts)
        self._tentative.on_withdrawn(record.log, record.first, record.end, self.withdrawals.is_judged_anew)
        self._revision += bool(gone)
        return gone

    def _await(self, keyframes: Iterable[KeyframeId]) -> None:
        """A solution will be out of date when one of these comes."""
        for keyframe in keyframes:
            if not self._known(keyframe):
                self._early[keyframe] = self._early.get(keyframe, 0) + 1


def _doubted(closure: LoopClosure, doubted: Mapping[CandidatePair, str]) -> LoopClosure:
    """A closure, with why it is doubted where it is."""
    why = doubted.get(CandidatePair.of(closure.query, closure.match))
    return closure if why is None else replace(closure, doubt=why)
