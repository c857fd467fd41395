"""Which joins of two logs are doubted, and for which pairs their owners ask: kept for the logs that a robot holds.

What is known of two logs is looked through again when a closure or a refusal between them became known, or left.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.closure_rows import ClosureTable
from flocc_agent.core.known_sets import PairSet, pair_number
from flocc_agent.core.second_places import (
    ACCIDENT_RATIO,
    ASKED_AT_ONCE,
    CLOSURES_MAX,
    Between,
    Join,
    Stretch,
    beside,
    contradicting,
    is_of_one_place,
    joins_of,
    stretch_of,
)
from flocc_protocol.ids import INDEX_MAX, KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

Float = NDArray[np.float64]
Logs = tuple[LogId, LogId]

SECOND_PLACE = "held until another one agrees with it at a second place, because "
"""How the reason begins why a closure is doubted."""


class KnownOdometry(Protocol):
    """Odometry of one log."""

    def __len__(self) -> int: ...

    def poses(self, indices: Sequence[int]) -> Float:
        """`T_odom_keyframe` (K, 4, 4) of some keyframes."""
        ...


@dataclass(frozen=True, slots=True)
class Tentative:
    """What is known of the joins of two logs.

    Attributes:
        doubted: Closures that are held, and why.
        asked: Pairs whose registration would tell most.
        is_whole: Whether all closures' keyframes were known.
    """

    doubted: dict[CandidatePair, str] = field(default_factory=dict)
    asked: tuple[CandidatePair, ...] = ()
    is_whole: bool = True


NOTHING = Tentative()


class TentativeJoins:
    """All pairs of logs."""

    def __init__(self, closures: ClosureTable, track: Callable[[LogId], KnownOdometry | None]) -> None:
        """Start with nothing refused.

        Args:
            closures: Those that count.
            track: Gives the odometry of a log, as far as it is known.
        """
        self._closures = closures
        self._track = track
        self._refused = PairSet()
        self._found: dict[Logs, Tentative] = {}

    def on_closure(self, pair: CandidatePair) -> None:
        """A closure came."""
        self._found.pop((pair.low.log, pair.high.log), None)

    def on_refused(self, pair: CandidatePair) -> None:
        """A pair was registered in vain."""
        if pair.low.log != pair.high.log:
            self._refused.add(pair)
            self._found.pop((pair.low.log, pair.high.log), None)

    def on_withdrawn(self, log: LogId, first: int, end: int, counts: Callable[[CandidatePair], bool]) -> None:
        """Keyframes of a log were taken back: of what was refused of them, some may count still."""
        self._refused.keep_of_stretch(log, first, end, counts)
        self._found = {logs: found for logs, found in self._found.items() if log not in logs}

    def of(self, low: LogId, high: LogId) -> Tentative:
        """What is known of the joins of two logs."""
        found = self._found.get((low, high))
        if found is None:
            found = self._look((low, high))
            if found.is_whole:
                self._found[low, high] = found
        return found

    def _look(self, logs: Logs) -> Tentative:
        tracks = self._track(logs[0]), self._track(logs[1])
        if logs[0] == logs[1] or tracks[0] is None or tracks[1] is None:
            return NOTHING
        low, high = tracks[0], tracks[1]
        every = self._closures.of_logs(*logs)
        if not 0 < len(every) <= CLOSURES_MAX:
            return NOTHING
        known = [pair for pair in every if pair.low.index < len(low) and pair.high.index < len(high)]
        if not known:
            return Tentative(is_whole=False)
        between = self._between(known, low, high)
        doubted: dict[CandidatePair, str] = {}
        asked: list[CandidatePair] = []
        for join in joins_of(between):
            if is_of_one_place(between, join):
                why, wanted = self._doubt(logs, between, join, low, high)
                asked += [CandidatePair(KeyframeId(logs[0], i), KeyframeId(logs[1], j)) for i, j in wanted]
                doubted |= {known[row]: why for row in join.rows} if why else {}
        return Tentative(doubted, tuple(asked), len(known) == len(every))

    def _doubt(
        self, logs: Logs, between: Between, join: Join, low: KnownOdometry, high: KnownOdometry
    ) -> tuple[str, tuple[tuple[int, int], ...]]:
        """Why a join of one place is doubted, empty where it is not; and what is to be asked for."""
        against = contradicting(between, join)
        if against and len(against) >= ACCIDENT_RATIO * len(join.rows):
            return _seen_twice(logs, between, *against[0]), ()
        if len(join.rows) < 2:
            return "", ()
        around = (_stretch(track, stretch_of(between, join, n, len(track))) for n, track in enumerate((low, high)))
        found = beside(between, join, (next(around), next(around)), self._refused_of(logs))
        robots, places = f"{logs[0].robot} and {logs[1].robot}", found.closed + found.refused
        why = f"{SECOND_PLACE}of {places} places where {robots} would be side by side {found.refused} do not match"
        return (why if found.is_against else ""), found.open[:ASKED_AT_ONCE]

    def _refused_of(self, logs: Logs) -> NDArray[np.int64]:
        """Keyframes (R, 2) of pairs of two logs that were refused; where another record says closure, that counts."""
        closed = [pair_number(pair) for pair in self._closures.of_logs(*logs)]
        packed = np.setdiff1d(np.array(self._refused.of_logs(*logs), dtype=np.int64), closed)
        return np.stack([packed // (INDEX_MAX + 1), packed % (INDEX_MAX + 1)], axis=1)

    def _between(self, closures: Sequence[CandidatePair], low: KnownOdometry, high: KnownOdometry) -> Between:
        T, has_length = self._closures.said(closures)
        ends = np.array([[pair.low.index, pair.high.index] for pair in closures])
        steps_m = float(np.mean([_step_m(track, ends[:, n]) for n, track in enumerate((low, high))]))
        T[~has_length, :3, 3] *= steps_m
        T_low, T_high = low.poses(ends[:, 0].tolist()), high.poses(ends[:, 1].tolist())
        return Between(ends, T_low, T_high, T, has_length, steps_m)


def _seen_twice(logs: Logs, between: Between, other: int, row: int, end: int) -> str:
    """Why a join is doubted that another closure contradicts."""
    seen = KeyframeId(logs[end], int(between.ends[row, end]))
    here, there = (KeyframeId(logs[1 - end], int(between.ends[k, 1 - end])) for k in (row, other))
    what = f"{seen} was registered with {here}, and it or one beside it with {there}, which is elsewhere"
    return SECOND_PLACE + what


def _step_m(track: KnownOdometry, indices: NDArray[np.int64]) -> float:
    """How far apart a log's keyframes are around some of them, in the mean."""
    first = max(int(indices.min()) - 1, 0)
    stretch = _stretch(track, range(first, min(int(indices.max()) + 2, first + CLOSURES_MAX, len(track))))
    steps_m = np.linalg.norm(np.diff(stretch.T[:, :3, 3], axis=0), axis=1)
    return float(steps_m.mean()) if len(steps_m) else 0.0


def _stretch(track: KnownOdometry, keyframes: range) -> Stretch:
    return Stretch(keyframes.start, track.poses(keyframes))
