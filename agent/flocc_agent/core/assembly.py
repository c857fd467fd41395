"""Pose-graph assembly: from the records of all logs to the graph that the leader optimises.

Every robot takes in every record, and only a leader asks for the graph: odometry is kept as columns of numbers, of
closures it is kept where their records stand, and both become matrices when somebody wants them.
"""

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Sequence
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.closure_ends import ClosureEnds, Tie
from flocc_agent.core.cold_storage import ColdPieces
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.measured_records import MeasuredRecords
from flocc_agent.core.pose_graph import LoopClosure, MeasuredFactor, PoseGraph, Trajectory, groups_of
from flocc_agent.core.pulls import remember
from flocc_agent.core.saved_map import SavedMap
from flocc_agent.geometry import between, pose7, pose_from_tq, poses_from_tq, symmetric
from flocc_protocol.codec import Pose7
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import (
    ClosureRecord,
    KeyframeRecord,
    LatentRecord,
    Record,
    RejectionRecord,
    UnknownRecord,
)

Float = NDArray[np.float64]

ODOMETRY_PAIRS_MAX = 1024
"""Neighbours that are remembered: those of the pairs that are at work."""
POSES_OF_A_PIECE = 64
"""Poses that leave memory together: some 4 kB."""


class _Odometry:
    """One log's keyframes as columns: poses as its records give them, stamps, and whether each was described.

    The place of a keyframe that a later version wrote is taken by the pose of the next one; nothing is tied to it. Full
    pieces of old poses leave memory where there is a cold storage, and with them what was made of them.
    """

    def __init__(self, cold: ColdPieces | None = None) -> None:
        self.stamps_s = array("d")
        self.encoded = bytearray()
        self.unread: set[int] = set()
        self._cold = cold
        self._pieces: list[bytes | int] = []
        self._poses = array("d")
        self._matrices: Float = np.empty((0, 4, 4))

    def __len__(self) -> int:
        return len(self.stamps_s)

    def add(self, stamp_s: float, T_odom_keyframe: Pose7, is_described: bool) -> None:
        """The next keyframe."""
        self.stamps_s.append(stamp_s)
        self._poses.extend(T_odom_keyframe)
        self.encoded.append(is_described)
        if len(self._poses) == 7 * POSES_OF_A_PIECE and self._cold is not None:
            self._pieces.append(self._poses.tobytes())
            self._poses = array("d")
            self._cold.add(self, len(self._pieces) - 1)

    def cool(self, number: int) -> None:
        """Move a piece out of memory, where there is room for it elsewhere."""
        piece = self._pieces[number]
        if isinstance(piece, bytes) and self._cold is not None:
            place = self._cold.put(piece)
            if place is not None:
                self._pieces[number] = place
                self._matrices = np.empty((0, 4, 4))

    def matrices(self) -> Float:
        """All poses (N, 4, 4), T_odom_keyframe; held as long as all that they are made of is."""
        known = len(self._matrices)
        if known == len(self):
            return self._matrices
        found = np.concatenate([self._matrices, poses_from_tq(self._rows(known))])
        if not any(isinstance(piece, int) for piece in self._pieces):
            self._matrices = found
        return found

    def _rows(self, first: int) -> Float:
        """Poses (N, 7) from a keyframe on, as records give them."""
        number, k = divmod(first, POSES_OF_A_PIECE)
        if number >= len(self._pieces):
            return np.array(self._poses[7 * (first - len(self._pieces) * POSES_OF_A_PIECE) :]).reshape(-1, 7)
        parts = [self._piece(n) for n in range(number, len(self._pieces))]
        parts[0] = parts[0][k:]
        return np.concatenate([*parts, np.array(self._poses).reshape(-1, 7)])

    def _piece(self, number: int) -> Float:
        piece = self._pieces[number]
        if isinstance(piece, int):
            assert self._cold is not None
            piece = self._cold.get(piece, 7 * 8 * POSES_OF_A_PIECE)
        return np.frombuffer(piece).reshape(-1, 7)

    def _row(self, index: int) -> Float:
        number, k = divmod(index, POSES_OF_A_PIECE)
        if number < len(self._pieces):
            return np.asarray(self._piece(number)[k])
        k = index - len(self._pieces) * POSES_OF_A_PIECE
        return np.array(self._poses[7 * k : 7 * k + 7])

    def pose(self, index: int) -> Float:
        """`T_odom_keyframe` (4, 4)."""
        return pose_from_tq(self._row(index))

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
        """The nearest described keyframe before this one, for the first ones the nearest after it."""
        around = chain(range(index - 1, -1, -1), range(index + 1, len(self.encoded)))
        return next((other for other in around if self.encoded[other]), None)

    def between(self, index: int, other: int) -> Pose7:
        """Pose of one keyframe in the frame of another, `T_other_index`."""
        return pose7(between(self.pose(other), self.pose(index)))


class GraphAssembly:
    """Keyframes, closures and measurements of every known log.

    Attributes:
        keyframes: Number of keyframes of all logs but those of an opened map, which are solved already.
        revision: Grows when a solution is out of date: a new log, closure or fix, or a keyframe that one waited for.
    """

    def __init__(
        self,
        saved: SavedMap | None = None,
        record_at: Callable[[LogId, int], Record] | None = None,
        cold: ColdPieces | None = None,
    ) -> None:
        """Start with nothing.

        Args:
            saved: The opened map, where there is one.
            record_at: Gives a record again by its log and number, when closures are built; None: nobody else keeps
                them.
            cold: Where pieces of old odometry go; None: all stay in memory.
        """
        self._cold = cold
        self.keyframes = 0
        self.revision = 0
        self._saved = saved
        self._odometry: dict[LogId, _Odometry] = {}
        self._records: dict[tuple[LogId, int], Record] | None = {} if record_at is None else None
        self._record_at = record_at or self._kept_record
        self._closures: dict[CandidatePair, tuple[LogId, int]] = {}
        self._ends = ClosureEnds()
        self._unbuilt: set[CandidatePair] = set()
        self._reads_all = True
        self._built: list[CandidatePair] = []
        self._loop_closures: list[LoopClosure] = []
        self._early: dict[KeyframeId, int] = {}
        self._measured = MeasuredRecords()
        self._odometry_pairs: dict[KeyframeId, tuple[KeyframeId, Pose7]] = {}

    @property
    def closures(self) -> int:
        """Number of closures, each pair once."""
        return len(self._closures)

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {} if self._cold is None else {"warm_odometry_pieces": self._cold.size()}

    def add(self, new: NewRecord) -> None:
        """Take in one record; records of a log come in their order, those of different logs in any."""
        record = new.record
        match record:
            case KeyframeRecord():
                self._add_keyframe(new.log, record)
            case ClosureRecord():
                self._add_closure(new, record)
            case RejectionRecord() | LatentRecord():
                pass
            case UnknownRecord():
                self._reads_all = False
            case _:
                self.revision += 1
                self._await(self._measured.add(new, record))

    def odometry_pair(self, keyframe: KeyframeId) -> tuple[KeyframeId, Pose7] | None:
        """The keyframe's neighbour in its log that has a latent, and `T_neighbour_query`.

        The nearest before it; for the first ones the nearest after it, None as long as there is none.
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
        return self._ends.ties(log, ties_max)

    def tied(self) -> set[LogId]:
        """Logs that the graph needs: closures tie them, or stand in them, or something was measured there."""
        ends = {end for link in self._ends.links() for end in link}
        writers = {log for log, _ in self._closures.values()}
        saved = set() if self._saved is None else set(self._saved.logs)
        return ends | writers | saved | self._measured.writers()

    def forget(self, log: LogId) -> None:
        """Hold nothing more of a log that is not tied."""
        odometry = self._odometry.pop(log, None)
        if odometry is not None:
            self.keyframes -= len(odometry)
            self.revision += 1
        for keyframe in [keyframe for keyframe in self._odometry_pairs if keyframe.log == log]:
            del self._odometry_pairs[keyframe]

    def measured(self, log: LogId) -> Sequence[MeasuredFactor]:
        """What else was measured at a log's keyframes, or of them."""
        return self._measured.of(log, self._odometry, self._known)

    def joined(self, log: LogId, other: LogId) -> bool:
        """Whether closures, other measurements or the opened map lead from one log to the other.

        Where there are records of a later version, any of them may: another log is enough then.
        """
        if not self._reads_all and log in self._odometry and other in self._odometry:
            return True
        links = self._ends.links()
        measured = self._measured.factors(self._odometry, self._known)
        links += [(factor.query.log, factor.match.log) for factor in measured]
        if self._saved is not None:
            links += [(self._saved.anchor, each) for each in self._saved.logs]
        ends = {end for link in links for end in link}
        groups = groups_of(sorted(ends), links)
        return any(log in group and other in group for group in groups)

    def graph(self) -> PoseGraph:
        """The pose graph of everything known; closures whose keyframes are not here yet are left out."""
        trajectories = {log: self._trajectory(log) for log in sorted(self._odometry)}
        self._build()
        measured = self._measured.factors(self._odometry, self._known)
        return PoseGraph(trajectories, tuple(self._loop_closures), measured=measured, saved=self._saved)

    def _trajectory(self, log: LogId) -> Trajectory:
        T_odom_keyframe = self._odometry[log].matrices()
        return Trajectory(T_odom_keyframe, self._measured.edge_covariances(log, len(T_odom_keyframe)))

    def _build(self) -> None:
        """Build the closures that are new since the last graph, and those whose keyframes came meanwhile."""
        ready = sorted(pair for pair in self._unbuilt if self._known(pair.low) and self._known(pair.high))
        if not ready:
            return
        built = _loop_closures([self._record_at(*self._closures[pair]) for pair in ready])
        self._unbuilt.difference_update(ready)
        if not self._built:
            self._built, self._loop_closures = ready, built
            return
        for pair, closure in zip(ready, built, strict=True):
            at = bisect_left(self._built, pair)
            if at < len(self._built) and self._built[at] == pair:
                self._loop_closures[at] = closure
            else:
                self._built.insert(at, pair)
                self._loop_closures.insert(at, closure)

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
        self.revision += awaited or len(odometry) == 1

    def _add_closure(self, new: NewRecord, record: ClosureRecord) -> None:
        """Of several registrations of one pair the one in the lowest log counts, on every robot."""
        pair = CandidatePair.of(record.query, record.match)
        held = self._closures.get(pair)
        if held is None or (new.log, new.number) < held:
            if held is not None:
                self._ends.remove(pair.low, pair.high)
            self._ends.put(record)
            self._closures[pair] = (new.log, new.number)
            if self._records is not None:
                self._records[new.log, new.number] = record
            self._unbuilt.add(pair)
            self.revision += 1
            self._await((record.query, record.match))

    def _kept_record(self, log: LogId, number: int) -> Record:
        assert self._records is not None
        return self._records[log, number]

    def _await(self, keyframes: Iterable[KeyframeId]) -> None:
        """A solution will be out of date when one of these comes."""
        for keyframe in keyframes:
            if not self._known(keyframe):
                self._early[keyframe] = self._early.get(keyframe, 0) + 1


def _loop_closures(records: Iterable[Record]) -> list[LoopClosure]:
    closures = [record for record in records if isinstance(record, ClosureRecord)]
    poses = poses_from_tq(np.array([record.T_query_match_unscaled for record in closures]))
    return [
        LoopClosure(
            query=record.query,
            match=record.match,
            T_query_match_unscaled=T_query_match_unscaled,
            match_ratio=record.match_ratio,
            scale_initial=record.scale_initial,
            covariance=None if record.covariance is None else symmetric(record.covariance.numpy()),
        )
        for record, T_query_match_unscaled in zip(closures, poses, strict=True)
    ]
