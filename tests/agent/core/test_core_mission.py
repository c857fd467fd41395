"""A mission's length costs a robot little memory: what is old is on disk, and one descriptor stands for each place.

One robot that holds what a team records during one hour: three others drive the same lanes again and again, each visit
with descriptors of its own, and register closures with where they were before. At most 500 keyframes are held in full.
"""

import gc
import time
import tracemalloc
from collections.abc import Iterator
from itertools import pairwise
from statistics import median

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.core.cold_storage import ColdPieces
from flocc_agent.core.descriptor_rows import comparable
from flocc_agent.core.effects import Unicast
from flocc_agent.core.events import MessageReceived
from flocc_agent.core.log_copy import LogCopy, decoded
from flocc_agent.core.parameters import CoreParameters, MemoryParameters, PlaceRecognitionParameters
from flocc_agent.core.place_recognition import PlaceRecognition
from flocc_agent.core.robot import Robot
from flocc_agent.runtime.page_file import PageFile
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import (
    CandidatePair,
    Envelope,
    LogPosition,
    RecordBatch,
    RecordRequest,
    Records,
    decode,
    encode,
)
from flocc_protocol.records import ClosureRecord, KeyframeRecord, Record, chain, encode_record

OWN = LogId("r1")
TEAM = (LogId("r2"), LogId("r3"), LogId("r4"))
HOUR_S = 3600
KEYFRAME_S = 3
"""Between two keyframes of a robot."""
PLACES = 300
"""Keyframes of a whole round: a robot is back after 15 minutes."""
DIMENSION = 256
HELD = 500
MB = 1e6


def places(rng: np.random.Generator) -> NDArray[np.float64]:
    """Descriptors (PLACES, DIMENSION) of places in a row, which change on the way."""
    steps = rng.standard_normal((PLACES + 8, DIMENSION))
    smooth = np.array([steps[k : k + 8].sum(axis=0) for k in range(PLACES)])
    return np.asarray(smooth / np.linalg.norm(smooth, axis=1, keepdims=True))


def seen(rng: np.random.Generator, place: NDArray[np.float64]) -> Array:
    """A place as one visit sees it."""
    return Array.int8(place + 0.15 * rng.standard_normal(DIMENSION) / np.sqrt(DIMENSION))


def records_of(log: LogId, rng: np.random.Generator, where: NDArray[np.float64]) -> Iterator[list[Record]]:
    """What a robot records at each of its keyframes."""
    for number in range(HOUR_S // KEYFRAME_S):
        angle = 2.0 * np.pi * number / PLACES
        pose = (100.0 * np.cos(angle), 100.0 * np.sin(angle), 0.0, np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))
        found: list[Record] = [KeyframeRecord(number, number * KEYFRAME_S, pose, seen(rng, where[number % PLACES]))]
        if number >= PLACES and number % 4 == 0:
            before = KeyframeId(log, number - PLACES)
            unit = (0.1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
            found.append(ClosureRecord(KeyframeId(log, number), before, unit, 200, 200, 1.0, 1.0))
        yield found


class Hour:
    """A robot that hears a team for an hour."""

    def __init__(self, held: int) -> None:
        never_alike = PlaceRecognitionParameters(similarity_threshold=1.0)
        parameters = CoreParameters(place_recognition=never_alike, memory=MemoryParameters(keyframes_held=held))
        self.pages = PageFile()
        self.robot = Robot(OWN, 0, 1, parameters, 0.0, cold=self.pages)
        rng = np.random.default_rng(5)
        where = places(rng)
        self._sources = {log: records_of(log, rng, where) for log in TEAM}
        self._ends = dict.fromkeys(TEAM, (0, 0))
        self.now_s = 0.0

    def minutes(self, count: float) -> None:
        """Let time pass."""
        until_s = self.now_s + 60.0 * count
        while self.now_s < until_s:
            for log, source in self._sources.items():
                for record in next(source):
                    data, (number, checksum) = encode_record(record), self._ends[log]
                    message = encode(Envelope(log, Records((RecordBatch(log, number, checksum, (data,)),))))
                    self._ends[log] = (number + 1, chain(checksum, data))
                    self.robot.handle(MessageReceived(decode(message)), self.now_s)
            self.now_s += KEYFRAME_S


def held_bytes() -> int:
    for cache in (comparable, decoded):  # of a fixed size
        cache.cache_clear()
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


def growth_mb(held: int) -> list[float]:
    """What a robot holds more after each quarter of the hour."""
    hour = Hour(held)
    tracemalloc.start()
    try:
        marks = [held_bytes()]
        for _ in range(4):
            hour.minutes(15)
            marks.append(held_bytes())
    finally:
        tracemalloc.stop()
        hour.pages.close()
    return [round((b - a) / MB, 3) for a, b in pairwise(marks)]


def test_memory_does_not_follow_the_clock() -> None:
    limited, all_held = growth_mb(HELD), growth_mb(10**6)
    print(f"MB per quarter: {limited} with {HELD} keyframes held, {all_held} with all of them")
    assert 2.0 * sum(limited[2:]) <= 1.0, "MB per hour, once the limit is reached"
    assert sum(limited[2:]) < 0.3 * sum(all_held[2:])


def test_work_does_not_follow_the_clock() -> None:
    """Minute by minute, so that what else the machine does for a while is in few of them."""
    hour = Hour(HELD)
    hour.minutes(15)
    spent: list[float] = []
    for _ in range(45):
        began = time.process_time()
        hour.minutes(1)
        spent.append(time.process_time() - began)
    first, last = median(spent[:15]), median(spent[-15:])
    print(f"CPU seconds per minute: {first:.3f} of the first quarter, {last:.3f} of the last")
    assert last <= 1.4 * first
    hour.pages.close()


def test_everything_old_is_still_there_for_others() -> None:
    hour, whole = Hour(HELD), Hour(10**6)
    for each in (hour, whole):
        each.minutes(60)
    assert hour.pages.size_bytes > 0
    for log in TEAM:
        of_hour, of_whole = (each.robot.gossip.logs[log] for each in (hour, whole))
        assert of_hour.encoded == of_whole.encoded
        assert [of_hour.checksum_at(n) for n in range(0, len(of_hour), 37)] == [
            of_whole.checksum_at(n) for n in range(0, len(of_whole), 37)
        ]
    graph, reference = hour.robot.assembly.graph(), whole.robot.assembly.graph()
    for log, trajectory in reference.trajectories.items():
        np.testing.assert_array_equal(graph.trajectories[log].T_odom_keyframe, trajectory.T_odom_keyframe)
    assert [(c.query, c.match) for c in graph.closures] == [(c.query, c.match) for c in reference.closures]
    asked = RecordRequest((LogPosition(TEAM[0], 3),))
    answers = [each.robot.gossip.on_request(TEAM[1], asked) for each in (hour, whole)]
    assert isinstance(answers[0][0], Unicast)
    assert answers[0] == answers[1]


@pytest.mark.parametrize("noise", [0.1, 0.3, 0.6])
def test_few_descriptors_find_what_all_of_them_find(noise: float) -> None:
    """Recall: hours-old places among those that a search over all descriptors finds, within two keyframes' way."""
    rng = np.random.default_rng(9)
    where = places(rng)
    parameters = PlaceRecognitionParameters(similarity_threshold=0.6)
    few, every = (PlaceRecognition(OWN, parameters, keyframes_held=held) for held in (200, 10**6))
    for number in range(4 * PLACES):
        descriptor = Array.int8(where[number % PLACES] + noise * rng.standard_normal(DIMENSION) / np.sqrt(DIMENSION))
        for search in (few, every):
            search.on_keyframes([(KeyframeId(TEAM[0], number), descriptor)])
    found, right, asked = 0, 0, 0
    for place in range(PLACES):
        descriptor = Array.int8(where[place] + noise * rng.standard_normal(DIMENSION) / np.sqrt(DIMENSION))
        of_few, of_every = (search.on_keyframes([(KeyframeId(OWN, place), descriptor)]) for search in (few, every))
        if of_every:
            asked += 1
            found += bool(of_few)
            near = [abs((c.pair.other(k).index - place + PLACES // 2) % PLACES - PLACES // 2) for k, c in of_few]
            right += bool(near) and min(near) <= 2
    print(f"noise {noise}: {found} and {right} of {asked}; {few.rows} of {every.rows} rows")
    assert asked > 0.9 * PLACES
    assert right >= 0.95 * asked


def test_both_robots_of_a_pair_ask_for_the_same_old_keyframes() -> None:
    """Each compares its own log with the other's: where they kept other rows, both register, for one place twice."""
    rng = np.random.default_rng(4)
    where = places(rng)
    parameters = PlaceRecognitionParameters(similarity_threshold=0.6)
    logs = (OWN, *TEAM)
    one, other = (PlaceRecognition(log, parameters, keyframes_held=120) for log in logs[:2])
    pairs: tuple[set[CandidatePair], set[CandidatePair]] = (set(), set())
    for number in range(3 * PLACES):
        taken = [
            (
                KeyframeId(log, number),
                Array.int8(where[(number + 70 * k) % PLACES] + 0.03 * rng.standard_normal(DIMENSION)),
            )
            for k, log in enumerate(logs)
        ]
        for search, found in zip((one, other), pairs, strict=True):
            of_pair = (c.pair for _, c in search.on_keyframes(taken))
            found |= {pair for pair in of_pair if {pair.low.log, pair.high.log} == set(logs[:2])}
    print(f"{len(pairs[0] & pairs[1])} of {len(pairs[0] | pairs[1])} pairs are asked for by both")
    assert len(pairs[0] & pairs[1]) >= 0.95 * len(pairs[0] | pairs[1]) > 0.0


def test_a_full_disk_keeps_pieces_in_memory() -> None:
    class Full:
        def put(self, _piece: bytes) -> int | None:
            return None

        def get(self, place: int, size_bytes: int) -> bytes:
            raise AssertionError((place, size_bytes))

        def free(self, place: int, size_bytes: int) -> None:
            raise AssertionError((place, size_bytes))

    copy = LogCopy(ColdPieces(Full(), 1))
    data = [encode_record(KeyframeRecord(k, float(k), (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None)) for k in range(300)]
    for each in data:
        copy.append(each)
    assert list(copy.encoded) == data
