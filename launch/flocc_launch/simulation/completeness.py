"""Complete: nothing that should be found, registered or solved is left out."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.effects import PersistRecord, Report
from flocc_agent.core.events import KeyframeCaptured, KeyframeEncoded
from flocc_agent.core.known_sets import is_beside
from flocc_agent.core.log_copy import LogCopy, decoded
from flocc_agent.core.prospects import REFUSED_MIN, UNLIKELY
from flocc_agent.core.reports import ClosureRejected
from flocc_agent.core.spared import STRETCH, TOLD
from flocc_agent.core.withdrawals import Withdrawals
from flocc_launch.simulation.invariants import Step, core, groups
from flocc_launch.simulation.rightness import component_of
from flocc_launch.simulation.swarm import Swarm
from flocc_launch.simulation.virtual_robot import Station
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import ClosureRecord, KeyframeRecord, RejectionRecord, WithdrawalRecord

MARGIN = 1e-4
"""Similarities that differ by less may be ordered either way."""


@dataclass(slots=True)
class Complete:
    """Every keyframe is recorded and solved; of each two logs, keyframes that look most alike are registered.

    A robot that comes back looks no more for keyframes both of which were registered with one of the other's log.
    A pair is refused unseen only by a robot that holds refusals of pairs that were seen, and one that is spared lies
    beside as many closures as are enough, or third ways to which closures lead from both of its ends: when it is
    spared, and in all logs of the swarm at the end.
    """

    _descriptors: dict[bytes, NDArray[np.float32]] = field(default_factory=dict)
    _captured: Counter[tuple[str, int]] = field(default_factory=Counter)
    _recorded: Counter[tuple[str, int]] = field(default_factory=Counter)
    _noticed: Counter[tuple[str, int]] = field(default_factory=Counter)
    _withdrawn: Counter[tuple[str, int]] = field(default_factory=Counter)
    _held: dict[str, "_Held"] = field(default_factory=lambda: defaultdict(_Held))

    def step(self, step: Step) -> Iterator[str]:
        """Note keyframes that were taken and recorded; pairs that are refused unseen for no reason."""
        life = step.station.name, step.station.life
        self._captured[life] += isinstance(step.event, KeyframeCaptured)
        self._noticed[life] += isinstance(step.event, KeyframeEncoded) and step.event.withdrawn is not None
        for effect in step.effects:
            if isinstance(effect, Report) and isinstance(effect.fact, ClosureRejected) and effect.fact.reason == TOLD:
                yield from self._spared_too_early(step.station, CandidatePair.of(effect.fact.query, effect.fact.match))
            if isinstance(effect, PersistRecord) and effect.log == step.station.log:
                record = decoded(effect.data)
                if isinstance(record, KeyframeRecord):
                    self._recorded[life] += 1
                    self._describe(effect.data, record)
                elif isinstance(record, WithdrawalRecord):
                    self._withdrawn[life] += record.log == effect.log
                elif isinstance(record, RejectionRecord) and record.reason == UNLIKELY:
                    seen = self._held_by(step.station).refused_seen
                    if seen < REFUSED_MIN:
                        yield f"{step.station.name} refuses {record.query} {record.match} unseen, {seen} were seen"

    def _held_by(self, station: Station) -> "_Held":
        held = self._held[station.name]
        held.read(core(station).gossip.logs)
        return held

    def _spared_too_early(self, station: Station, pair: CandidatePair) -> Iterator[str]:
        enough = core(station).closures_enough
        beside = _told_by(self._held_by(station).closures, pair)
        if not enough or beside < enough:
            yield f"{station.name} spares {pair.low} {pair.high} with {beside} closures beside it"

    def _describe(self, data: bytes, record: KeyframeRecord) -> None:
        if record.descriptor is not None:
            values = record.descriptor.numpy().astype(np.float32)
            self._descriptors[data] = values / np.linalg.norm(values)

    def lacking(self, swarm: Swarm) -> Iterator[str]:
        """Keyframes without a record or a place in the leader's solution; withdrawals and pairs without a record."""
        for group in groups(swarm):
            for station in group:
                life = station.name, station.life
                if self._captured[life] > self._recorded[life]:
                    yield f"{station.name} recorded {self._recorded[life]} of {self._captured[life]} keyframes"
                if self._noticed[life] > self._withdrawn[life]:
                    yield f"{station.name} withdrew {self._withdrawn[life]} of {self._noticed[life]} times"
                if core(station).election.leading and core(station).distributed is None:
                    yield from _unsolved(station)
            yield from self._unregistered(swarm, group)

    def _unregistered(self, swarm: Swarm, group: list[Station]) -> Iterator[str]:
        threshold = swarm.scenario.core.place_recognition.similarity_threshold + MARGIN
        writers = {station.log for station in group}
        robots = {log.robot for log in writers}
        logs = core(group[0]).gossip.logs
        known = {
            log: self._described(logs[log]) for log in sorted(logs) if log.robot in robots and log not in swarm.forked
        }
        copies = _all_copies(swarm, group)
        withdrawals = core(group[0]).assembly.withdrawals
        resolved = resolved_pairs(copies, withdrawals)
        told = closures_by_logs(copy for _, copy in copies)
        partnered = {(end, pair.other(end).log) for pair in resolved for end in (pair.low, pair.high)}
        came_back = {station.log for station in group if station.life > 1}
        for one, other in combinations(known, 2):
            apart = one.robot != other.robot and (one in writers or other in writers)
            if not apart or max(logs[one].keyframes, logs[other].keyframes) < 2:
                continue
            for pair in _alike((one, known[one]), (other, known[other]), threshold):
                both = {(pair.low, pair.high.log), (pair.high, pair.low.log)} <= partnered
                if pair in resolved or (both and came_back & {one, other}):
                    continue
                if any(withdrawals.is_withdrawn(end) and end.log not in writers for end in (pair.low, pair.high)):
                    continue  # whoever made its latent anew is not here
                enough = core(group[0]).closures_enough
                if not enough or _told_by(told, pair) < enough:
                    yield f"nobody registered {pair.low} {pair.high}, which look alike"

    def _described(self, copy: LogCopy) -> dict[int, NDArray[np.float32]]:
        """Descriptors of a log's keyframes, as the swarm holds them."""
        both = zip(copy.records, copy.encoded, strict=True)
        return {
            record.index: self._descriptors[data]
            for record, data in both
            if isinstance(record, KeyframeRecord) and data in self._descriptors
        }


ClosuresByLogs = dict[tuple[LogId, LogId], set[CandidatePair]]
Described = tuple[LogId, dict[int, NDArray[np.float32]]]


def _alike(one: Described, other: Described, threshold: float) -> Iterator[CandidatePair]:
    """Pairs of keyframes each of which is the other's best: whichever came later, they were a candidate then."""
    (low, rows), (high, columns) = one, other
    if not rows or not columns:
        return
    similarities = np.array(list(rows.values())) @ np.array(list(columns.values())).T
    lefts, rights = list(rows), list(columns)
    for i, j in zip(*np.nonzero(similarities >= threshold), strict=True):
        rivals = max(_second(similarities[i], j), _second(similarities[:, j], i))
        if similarities[i, j] > rivals + MARGIN:
            yield CandidatePair.of(KeyframeId(low, lefts[i]), KeyframeId(high, rights[j]))


def _all_copies(swarm: Swarm, group: list[Station]) -> list[tuple[LogId, LogCopy]]:
    """Of each log the copy of one robot; of those of which two versions were seen the copies of all."""
    return [
        (log, copy)
        for station in group
        for log, copy in core(station).gossip.logs.items()
        if station is group[0] or log in swarm.forked
    ]


def resolved_pairs(logs: Iterable[tuple[LogId, LogCopy]], withdrawals: Withdrawals) -> set[CandidatePair]:
    """Pairs of which some log has a record; closures of what was withdrawn since do not count, refusals do."""
    judged = (
        (log, number, CandidatePair.of(record.query, record.match), isinstance(record, ClosureRecord))
        for log, copy in logs
        for number, record in copy.judgements()
    )
    return {pair for log, number, pair, is_closure in judged if not is_closure or withdrawals.counts(log, number, pair)}


def closures_by_logs(logs: Iterable[LogCopy]) -> ClosuresByLogs:
    """Closures by the two logs that they join."""
    held = _Held()
    for copy in logs:
        held.take(copy)
    return held.closures


@dataclass(slots=True)
class _Held:
    """What the logs that a robot holds say of pairs; of a log that grew only what is new is looked at.

    Attributes:
        closures: By the two logs that they join.
        refused_seen: How many pairs were refused that had been seen.
    """

    closures: ClosuresByLogs = field(default_factory=lambda: defaultdict(set))
    refused_seen: int = 0
    _read: dict[LogId, tuple[LogCopy, int]] = field(default_factory=dict)

    def read(self, logs: Mapping[LogId, LogCopy]) -> None:
        """Take in what came since; from the beginning where a log is held no more, or another version of it."""
        if any(logs.get(log) is not copy for log, (copy, _) in self._read.items()):
            self.closures.clear()
            self.refused_seen = 0
            self._read.clear()
        for log, copy in logs.items():
            _, first = self._read.get(log, (copy, 0))
            self.take(copy, first)
            self._read[log] = copy, len(copy)

    def take(self, copy: LogCopy, first: int = 0) -> None:
        """Take in a log's judgements from a number on."""
        for _, record in copy.judgements(first):
            if isinstance(record, RejectionRecord):
                self.refused_seen += record.reason != UNLIKELY
            else:
                pair = CandidatePair.of(record.query, record.match)
                self.closures[pair.low.log, pair.high.log].add(pair)


def _told_by(closures: ClosuresByLogs, pair: CandidatePair) -> int:
    """Closures of the same stretches of two ways, and third logs that closures join with both of them at one place."""
    of_logs = closures.get((pair.low.log, pair.high.log), set())
    own = {pair.low.log, pair.high.log}
    third = {log for logs in closures for log in logs} - own
    ways = ((_reached(closures, pair.low, log), _reached(closures, pair.high, log)) for log in third)
    by_way = sum(any(abs(i - j) <= 2 * STRETCH for i, j in product(*both)) for both in ways)
    return sum(is_beside(pair, other, STRETCH) for other in of_logs) + by_way


def _reached(closures: ClosuresByLogs, keyframe: KeyframeId, log: LogId) -> set[int]:
    """Keyframes of another log to which closures lead from around a keyframe."""
    logs = (min(keyframe.log, log), max(keyframe.log, log))
    ends = ((pair.low, pair.high) if pair.low.log == log else (pair.high, pair.low) for pair in closures.get(logs, ()))
    return {there.index for there, here in ends if abs(here.index - keyframe.index) <= STRETCH}


def _second(values: NDArray[np.float32], but: int) -> float:
    """The highest value at another place."""
    return float(np.delete(values, but).max(initial=-1.0))


def _unsolved(leader: Station) -> Iterator[str]:
    """Keyframes that a leader's last solution has no place for."""
    for log, copy in core(leader).gossip.logs.items():
        component = None if leader.solution is None else component_of(leader.solution, log)
        solved = 0 if component is None else len(component.T_map_keyframe[log])
        if solved < copy.keyframes:
            yield f"{leader.name} solved {solved} of {copy.keyframes} keyframes of {log}"
