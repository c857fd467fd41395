"""Which joins of two logs are doubted, and for which pairs their owners ask: kept for the logs that a robot holds.

What is known of two logs is looked through again when a closure or a refusal between them became known, or left, and
somebody asks: who leads, or one of the two for the pairs that it is to ask for. Once closures of more than one place
agree nothing is looked at any more.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.closure_rows import ClosureTable
from flocc_agent.core.known_sets import PairSet, pair_number
from flocc_agent.core.second_places import (
    ACCIDENT_RATIO,
    CLOSURES_MAX,
    REFUSED_MIN,
    Between,
    Join,
    Stretch,
    agreement,
    beside,
    contradicting,
    is_firm,
    joins_of,
    may_contradict,
    stretch_of,
)
from flocc_agent.core.spared import STRETCH
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

    def positions_m(self, indices: Sequence[int]) -> Float:
        """Where they were (K, 3)."""
        ...


@dataclass(frozen=True, slots=True)
class Tentative:
    """What is known of the joins of two logs.

    Attributes:
        doubted: Closures that are held, and why.
        asked: Pairs whose registration would tell more, the most useful first.
        is_whole: Whether all of the closures' keyframes were known.
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
        self._undoubted: set[Logs] = set()
        """For now, without a look at odometry."""
        self._joined: set[Logs] = set()
        self._firm: set[Logs] = set()
        self._open: dict[Logs, frozenset[CandidatePair]] = {}
        self._changes = 0

    def on_closure(self, pair: CandidatePair) -> None:
        """A closure came."""
        logs = pair.low.log, pair.high.log
        if pair.low.log != pair.high.log and logs not in self._firm:
            self._joined.add(logs)
            self._forget(logs)

    def on_refused(self, pair: CandidatePair) -> None:
        """A pair was registered in vain."""
        logs = pair.low.log, pair.high.log
        if pair.low.log == pair.high.log:
            return
        self._refused.add(pair)
        if self.is_tentative(*logs):
            found = self._forget(logs)
            self._open.setdefault(logs, frozenset() if found is None else frozenset(found.doubted))

    def on_withdrawn(self, log: LogId, first: int, end: int, counts: Callable[[CandidatePair], bool]) -> None:
        """Keyframes of a log were taken back: of what was refused of them, some may count still."""
        self._refused.keep_of_stretch(log, first, end, counts)
        self._found = {logs: found for logs, found in self._found.items() if log not in logs}
        self._firm = {logs for logs in self._firm if log not in logs}
        self._undoubted = {logs for logs in self._undoubted if log not in logs}

    def _forget(self, logs: Logs) -> Tentative | None:
        """What was known of two logs, which is so no more."""
        self._undoubted.discard(logs)
        return self._found.pop(logs, None)

    def is_tentative(self, low: LogId, high: LogId) -> bool:
        """Whether two logs are joined, and as far as is known not by closures of more than one place."""
        return (low, high) in self._joined and (low, high) not in self._firm

    def changes(self) -> int:
        """How often refusals changed what is doubted; looked at by who solves, and only then."""
        before, self._open = self._open, {}
        self._changes += sum(self._doubted(logs).keys() != doubted for logs, doubted in before.items())
        return self._changes

    def doubted(self) -> dict[CandidatePair, str]:
        """All closures that are held, and why."""
        tentative = self._joined - self._firm
        return {pair: why for logs in sorted(tentative) for pair, why in self._doubted(logs).items()}

    def _doubted(self, logs: Logs) -> Mapping[CandidatePair, str]:
        """Those of two logs; odometry is looked at only where numbers of keyframes and what was refused allow any."""
        if logs in self._undoubted:
            return {}
        if logs not in self._found and not self._may_doubt(logs):
            self._undoubted.add(logs)
            return {}
        return self.of(*logs).doubted

    def _may_doubt(self, logs: Logs) -> bool:
        every = self._closures.of_logs(*logs)
        if len(every) > CLOSURES_MAX or len(self._refused.of_logs(*logs)) >= REFUSED_MIN:
            return True
        return len(every) >= 2 and may_contradict(np.array([[pair.low.index, pair.high.index] for pair in every]))

    def of(self, low: LogId, high: LogId) -> Tentative:
        """What is known of the joins of two logs."""
        if not self.is_tentative(low, high):
            return NOTHING
        found = self._found.get((low, high))
        if found is None:
            found = self._look((low, high))
            if found.is_whole:
                self._found[low, high] = found
        return found

    def _look(self, logs: Logs) -> Tentative:
        low, high = self._track(logs[0]), self._track(logs[1])
        every = self._closures.of_logs(*logs)
        if len(every) > CLOSURES_MAX:
            self._firm.add(logs)
            return NOTHING
        if low is None or high is None:
            return Tentative(is_whole=False)
        known = [pair for pair in every if pair.low.index < len(low) and pair.high.index < len(high)]
        is_whole = len(known) == len(every)
        if len(known) < 2:
            return Tentative(is_whole=is_whole)
        between = self._between(known, low, high)
        agree = agreement(between)
        if is_firm(between, agree):
            self._firm.add(logs)
            return NOTHING
        doubted: dict[CandidatePair, str] = {}
        asked: list[CandidatePair] = []
        for join in joins_of(between, agree):
            why, wanted = self._doubt(logs, between, join, low, high)
            asked += [CandidatePair(KeyframeId(logs[0], i), KeyframeId(logs[1], j)) for i, j in wanted]
            doubted |= {known[row]: why for row in join.rows} if why else {}
        return Tentative(doubted, tuple(asked), is_whole and min(len(low), len(high)) > STRETCH)

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
        return (why if found.is_against else ""), found.open

    def _refused_of(self, logs: Logs) -> NDArray[np.int64]:
        """Keyframes (R, 2) of pairs of two logs that were refused; where another record says closure, that counts."""
        closed = [pair_number(pair) for pair in self._closures.of_logs(*logs)]
        packed = np.setdiff1d(np.array(self._refused.of_logs(*logs), dtype=np.int64), closed)
        return np.stack([packed // (INDEX_MAX + 1), packed % (INDEX_MAX + 1)], axis=1)

    def _between(self, closures: Sequence[CandidatePair], low: KnownOdometry, high: KnownOdometry) -> Between:
        T, has_length = self._closures.said(closures)
        ends = np.array([[pair.low.index, pair.high.index] for pair in closures])
        steps_m = (_steps_m(low, ends[:, 0]) + _steps_m(high, ends[:, 1])) / 2.0
        T[~has_length, :3, 3] *= steps_m[~has_length, None]
        T_low, T_high = low.poses(ends[:, 0].tolist()), high.poses(ends[:, 1].tolist())
        return Between(ends, T_low, T_high, T, has_length, steps_m)


def _seen_twice(logs: Logs, between: Between, other: int, row: int, end: int) -> str:
    """Why a join is doubted that another closure contradicts."""
    seen = KeyframeId(logs[end], int(between.ends[row, end]))
    here, there = (KeyframeId(logs[1 - end], int(between.ends[k, 1 - end])) for k in (row, other))
    what = f"{seen} was registered with {here}, and it or one beside it with {there}, which is elsewhere"
    return SECOND_PLACE + what


def _steps_m(track: KnownOdometry, indices: NDArray[np.int64]) -> Float:
    """How far apart a log's keyframes are up to each of some (K,), in the mean; of its first ones up to a later one."""
    first = np.maximum(indices - STRETCH, 0)
    last = np.minimum(np.maximum(indices, STRETCH), len(track) - 1)
    t_m = track.positions_m([*first.tolist(), *last.tolist()]).reshape(2, -1, 3)
    return np.asarray(np.linalg.norm(t_m[1] - t_m[0], axis=1) / np.maximum(last - first, 1))


def _stretch(track: KnownOdometry, keyframes: range) -> Stretch:
    return Stretch(keyframes.start, track.poses(keyframes))
