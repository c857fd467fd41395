"""`flocc map merge`: two maps of teams that never met, joined by closures that are found offline.

The places of one are compared with those of the other as robots would, the most similar pairs registered by the front
end that made the latents, and what it accepts is recorded in a log of its own, whose robot nobody is. The frame is that
of the first map. Where too few closures agree, nothing is written, and the most similar pairs are named.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import PerceptionConfig, validated
from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.descriptor_rows import direction
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.interfaces import OdometryPair, Perception
from flocc_agent.core.judgement import judged
from flocc_agent.core.parameters import CoreParameters
from flocc_agent.geometry import pose_from_tq
from flocc_agent.perception.backends import build_perception
from flocc_agent.runtime.map_folder import BadMap, MapFolder, MapManifest
from flocc_launch.maps.gathering import opened_record
from flocc_launch.maps.map_page import map_page
from flocc_launch.maps.map_saving import back_end_of, latents_of, optics_of
from flocc_launch.maps.solving import SolvedMap, solved_map
from flocc_launch.maps.writing import MapContent, check_target, write_map
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import (
    ClosureRecord,
    KeyframeRecord,
    Record,
    RejectionRecord,
    WithdrawalRecord,
    encode_record,
)

MERGER = "map-merge"
"""Robot name of the log that holds the closures between maps."""
REGISTRATIONS_MAX = 300
ENOUGH = 40
"""Closures after which no further pair is registered."""
ASKED_MAX = 100
"""Pairs beside closures of one place that are registered besides."""
NAMED_MAX = 3

Descriptors = NDArray[np.float32]
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class LikePair:
    """A keyframe of each map, and how alike they look."""

    first: KeyframeId
    second: KeyframeId
    similarity: float


@dataclass(frozen=True, slots=True)
class Merged:
    """What came of it: the map, pairs that were registered, closures found."""

    manifest: MapManifest
    registered: int
    closures: int


def merge_maps(
    first: Path,
    second: Path,
    out: Path,
    progress: Progress = lambda _, __: None,
    parameters: CoreParameters | None = None,
    clock_ms: Callable[[], int] = lambda: time.time_ns() // 1_000_000,
) -> Merged:
    """Merge two maps; the frame of the first stays.

    Raises:
        FloccError: One is no map, they are of different front ends, hold one log or frame, are signed, have nothing in
            common, or `out` cannot be written.
    """
    check_target(out, first, second)
    a, b = MapFolder.open(first), MapFolder.open(second)
    a.check_whole()
    b.check_whole()
    _check_pair(a, b)
    limits = parameters or CoreParameters()
    pairs = like_pairs(a, b, limits.place_recognition.best_matches)
    threshold = limits.place_recognition.similarity_threshold
    candidates = [pair for pair in pairs if pair.similarity >= threshold][:REGISTRATIONS_MAX]
    perception = perception_of(a)
    judging = Judging((a, b), LogId(MERGER, clock_ms()), perception, limits)
    judging.judge(candidates, progress)
    closures, registered, joining = judging.closures, judging.registered, judging.log
    records = tuple(map(encode_record, judging.said)) if closures else ()
    logs = {**a.records, **b.records, **({joining: records} if records else {})}
    back_end = back_end_of(a)
    solved = solved_map(f"{first} and {second}", logs, a.saved(), config=back_end)
    _check_joined(solved, b, pairs, registered, closures)
    content = MapContent(
        name=out.name,
        logs=logs,
        solved=solved,
        front_end=a.manifest.front_end,
        optics={**optics_of(b), **optics_of(a)},
        latents=chain(latents_of(a), latents_of(b)),
        back_end=back_end,
        edition=max(a.manifest.edition, b.manifest.edition) + 1,
        swarm=a.manifest.swarm,
        pruned=a.manifest.pruned or b.manifest.pruned,
        page=lambda manifest: map_page(manifest, solved, ()),
    )
    return Merged(write_map(out, content), registered, len(closures))


def _check_pair(a: MapFolder, b: MapFolder) -> None:
    """Whether two maps can be one.

    Raises:
        BadMap: They cannot.
    """
    shared = sorted(a.closed() & b.closed())
    if shared:
        log = shared[0]
        one, other = a.records[log], b.records[log]
        both = min(len(one), len(other))
        if one[:both] == other[:both]:
            raise BadMap(f"{a.path} and {b.path}: both hold the log {log}: they are editions of one map")
        raise BadMap(
            f"{a.path} and {b.path}: both are of {a.manifest.frame}, and each has another log {log}"
            if a.manifest.frame == b.manifest.frame
            else f"{a.path} and {b.path}: each has another log {log}: give robots of two missions different names"
        )
    if a.manifest.front_end.model != b.manifest.front_end.model:
        models = " and ".join(str(each.manifest.front_end.model) for each in (a, b))
        raise BadMap(f"{a.path} and {b.path}: their latents are of different front ends, {models}")
    if a.manifest.signed or b.manifest.signed:
        raise BadMap(
            f"{a.path} and {b.path}: their logs are signed, and closures found offline would be nobody's: "
            "let a team work in one map and meet the other's"
        )


def perception_of(a: MapFolder) -> Perception:
    """The front end that made a map, built again.

    Raises:
        BadMap: The map does not say which, or it is another one here.
    """
    front_end = a.manifest.front_end
    if front_end.method is None:
        raise BadMap(f"{a.path}: does not say which front end made it, so its latents cannot be registered")
    config = validated(PerceptionConfig, front_end.settings, f"{a.path}: front end")
    perception = build_perception(config)
    a.check_front_end(front_end.method, perception.encoder.model)
    return perception


# Which places look alike


def described(opened: MapFolder) -> tuple[list[KeyframeId], Descriptors]:
    """Keyframes with a latent and a descriptor, and the descriptors' directions (N, D)."""
    with_latent = set(opened.latent_keyframes())
    keyframes: list[KeyframeId] = []
    rows: list[Descriptors] = []
    for log, records in opened.records.items():
        for data in records:
            record = opened_record(data)[0]
            if not isinstance(record, KeyframeRecord) or record.descriptor is None:
                continue
            row = direction(record.descriptor)
            if row is not None and KeyframeId(log, record.index) in with_latent:
                keyframes.append(KeyframeId(log, record.index))
                rows.append(row)
    if len({len(row) for row in rows}) > 1:
        raise BadMap(f"{opened.path}: its descriptors have different lengths")
    return keyframes, np.array(rows, dtype=np.float32).reshape(len(rows), -1 if rows else 0)


def like_pairs(a: MapFolder, b: MapFolder, best_matches: int) -> list[LikePair]:
    """For each keyframe of one map the most similar ones of the other, the most similar pairs first."""
    (of_a, rows_a), (of_b, rows_b) = described(a), described(b)
    if not of_a or not of_b or rows_a.shape[1] != rows_b.shape[1]:
        return []
    similarities = rows_a @ rows_b.T
    best = set(_best(similarities, best_matches)) | {(i, j) for j, i in _best(similarities.T, best_matches)}
    pairs = [LikePair(of_a[i], of_b[j], float(similarities[i, j])) for i, j in best]
    return sorted(pairs, key=lambda pair: (-pair.similarity, pair.first, pair.second))


def _best(similarities: Descriptors, count: int) -> Iterator[tuple[int, int]]:
    for i, row in enumerate(similarities):
        for j in np.argsort(-row, kind="stable")[:count]:
            yield i, int(j)


# Which of them are the same


class Judging:
    """Pairs of two maps that are registered, and what is said of them in a log of its own.

    Closures of one place may be of two that look alike, as with robots: pairs beside them are registered, too, and said
    where they are refused. What is finally withdrawn has no latent worth a look.

    Attributes:
        log: The log that joins the maps.
        said: Its records: what was withdrawn, since who judges it says so first, closures, refusals beside them.
        registered: How many pairs were.
    """

    def __init__(
        self, opened: tuple[MapFolder, MapFolder], log: LogId, perception: Perception, limits: CoreParameters
    ) -> None:
        """Take in the logs of both maps."""
        self.log = log
        self.said: list[Record] = []
        self.registered = 0
        self._opened = opened
        self._perception = perception
        self._limits = limits
        self._assembly = GraphAssembly()
        self._judged: dict[CandidatePair, ClosureRecord | RejectionRecord | None] = {}
        for each in opened:
            for own, records in each.records.items():
                for number, data in enumerate(records):
                    self._assembly.add(NewRecord(own, number, opened_record(data)[0]))
        for record in _withdrawals(*opened):
            self._say(record)

    @property
    def closures(self) -> list[ClosureRecord]:
        """Those that were found."""
        return [record for record in self.said if isinstance(record, ClosureRecord)]

    def judge(self, candidates: Sequence[LikePair], progress: Progress) -> None:
        """Register candidates until there are closures enough, and then pairs that tell whether these are right."""
        for number, pair in enumerate(candidates):
            if len(self.closures) >= ENOUGH:
                break
            progress(number, len(candidates))
            record = self._record(CandidatePair.of(pair.first, pair.second))
            if isinstance(record, ClosureRecord):
                self._say(record)
        while self.registered < REGISTRATIONS_MAX + ASKED_MAX and (asked := self._asked()):
            for both in asked:
                beside = self._record(both)
                if beside is not None:
                    self._say(beside)

    def _asked(self) -> list[CandidatePair]:
        """Pairs beside closures that are of one place, of which nothing was said yet."""
        joined = {(pair.low.log, pair.high.log): pair for pair in map(_pair_of, self.closures)}
        asked = [pair for each in joined.values() for pair in self._assembly.asked(each)]
        said = {_pair_of(record) for record in self.said if isinstance(record, ClosureRecord | RejectionRecord)}
        return [pair for pair in asked if pair not in said and (pair not in self._judged or self._judged[pair])]

    def _say(self, record: Record) -> None:
        self._assembly.add(NewRecord(self.log, len(self.said), record))
        self.said.append(record)

    def _record(self, pair: CandidatePair) -> ClosureRecord | RejectionRecord | None:
        """The record of a pair; None where a latent is missing, or taken back for good."""
        if pair not in self._judged:
            final = any(map(self._assembly.withdrawals.is_final, (pair.low, pair.high)))
            self._judged[pair] = None if final else self._register(pair)
            self.registered += self._judged[pair] is not None
        return self._judged[pair]

    def _register(self, pair: CandidatePair) -> ClosureRecord | RejectionRecord | None:
        """The query is whichever has an odometry pair with a latent, of the first map where both have."""
        a, b = self._opened
        first, second = (pair.low, pair.high) if pair.low.log in a.records else (pair.high, pair.low)
        for query, match, of_query, of_match in ((first, second, a, b), (second, first, b, a)):
            neighbour = self._assembly.odometry_pair(query)
            latents = [of_query.latent(query), of_match.latent(match)]
            beside = None if neighbour is None else of_query.latent(neighbour[0])
            if neighbour is None or beside is None or latents[0] is None or latents[1] is None:
                continue
            T_neighbour_query = pose_from_tq(np.array(neighbour[1]))
            odometry = OdometryPair(beside, T_neighbour_query, f"{neighbour[0]} {query}")
            result = self._perception.register(latents[0], latents[1], odometry)
            return judged(query, match, result, self._limits.loop_closing)
        return None


def _pair_of(record: ClosureRecord | RejectionRecord) -> CandidatePair:
    return CandidatePair.of(record.query, record.match)


def _withdrawals(*opened: MapFolder) -> list[WithdrawalRecord]:
    """What robots of the maps took back: their latents here are those made anew."""
    records = ((log, opened_record(data)[0]) for each in opened for log, rows in each.records.items() for data in rows)
    return [record for log, record in records if isinstance(record, WithdrawalRecord) and record.log == log]


def _check_joined(
    solved: SolvedMap, b: MapFolder, pairs: Sequence[LikePair], registered: int, closures: Iterable[ClosureRecord]
) -> None:
    if not set(b.poses()) - set(solved.saved.logs):
        return
    best = ", ".join(f"{p.first} and {p.second} {p.similarity:.3f}" for p in pairs[:NAMED_MAX]) or "none"
    raise BadMap(
        f"{b.path}: has too little in common with the other map: {registered} pairs registered, "
        f"{len(list(closures))} closures; most similar: {best}"
    )
