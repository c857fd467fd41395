"""Rows of descriptors: the same candidates whether keyframes come alone or together, whatever their numbers are."""

import numpy as np
import pytest

from flocc_agent.core.descriptor_rows import THINNED_AT_ONCE, direction
from flocc_agent.core.log_copy import BLOCK_RECORDS, LogCopy
from flocc_agent.core.parameters import PlaceRecognitionParameters
from flocc_agent.core.place_recognition import Found, PlaceRecognition
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import KeyframeRecord, encode_record

OWN, OTHERS = LogId("r1"), (LogId("r2"), LogId("r3"))
OWN_FIRST = KeyframeId(OWN, 0)
KEYFRAMES = 300
"""More than are compared at one time."""


def drawn(dimension: int, dtype: str = "i1") -> list[tuple[KeyframeId, Array]]:
    """Keyframes of three logs in turn, many of them near one of a few places."""
    rng = np.random.default_rng(dimension)
    places = rng.standard_normal((40, dimension))
    keyframes = []
    for k in range(KEYFRAMES):
        for log in (*OTHERS, OWN):
            values = places[rng.integers(40)] + 0.3 * rng.standard_normal(dimension)
            array = Array.int8(values) if dtype == "i1" else Array.of(values, dtype)
            keyframes.append((KeyframeId(log, k), array))
    return keyframes


def found(keyframes: list[tuple[KeyframeId, Array]], together: int) -> list[Found]:
    recognition = PlaceRecognition(OWN, PlaceRecognitionParameters(similarity_threshold=0.6))
    parts = [keyframes[k : k + together] for k in range(0, len(keyframes), together)]
    return [each for part in parts for each in recognition.on_keyframes(part)]


def by_hand(keyframes: list[tuple[KeyframeId, Array]]) -> set[tuple[KeyframeId, KeyframeId]]:
    """Each keyframe and its best partner before it in each log that it is compared with."""
    pairs = set()
    seen: dict[LogId, list[tuple[KeyframeId, np.ndarray]]] = {}
    for keyframe, array in keyframes:
        unit = direction(array)
        assert unit is not None
        for log in (OWN,) if keyframe.log != OWN else OTHERS:
            rows = seen.get(log, [])
            similarities = [float(unit @ row) for _, row in rows]
            if similarities and max(similarities) >= 0.6:
                pairs.add((keyframe, rows[int(np.argmax(similarities))][0]))
        seen.setdefault(keyframe.log, []).append((keyframe, unit))
    return pairs


@pytest.mark.parametrize("dtype", ["i1", "f4"])
def test_alone_every_keyframe_finds_its_best_partner_of_each_log(dtype: str) -> None:
    keyframes = drawn(32, dtype)
    assert {(k, c.pair.other(k)) for k, c in found(keyframes, 1)} == by_hand(keyframes)


def test_other_robots_keyframes_find_exactly_the_same_in_a_batch() -> None:
    own = [each for each in drawn(128) if each[0].log == OWN]
    others = [each for each in drawn(128) if each[0].log != OWN]
    one = PlaceRecognition(OWN, PlaceRecognitionParameters(similarity_threshold=0.6))
    many = PlaceRecognition(OWN, PlaceRecognitionParameters(similarity_threshold=0.6))
    one.on_keyframes(own)
    many.on_keyframes(own)
    alone = [each for keyframe in others for each in one.on_keyframes([keyframe])]
    assert alone == many.on_keyframes(others)
    assert one.best_similarities == many.best_similarities


def test_rows_of_int8_and_of_floats_are_compared_with_each_other() -> None:
    ints, floats = drawn(32), drawn(32, "f4")
    mixed = [ints[k] if keyframe.log == OTHERS[0] else floats[k] for k, (keyframe, _) in enumerate(ints)]
    assert {(k, c.pair.other(k)) for k, c in found(mixed, 1)} == by_hand(mixed)


def test_every_keyframe_has_a_partner_in_each_other_log_where_anything_is_alike_enough() -> None:
    """A log of which no row is here, the own one among them, has none to give."""
    keyframes = drawn(32)
    recognition = PlaceRecognition(OWN, PlaceRecognitionParameters(similarity_threshold=-1.0))
    first, second = (next(each for each in keyframes if each[0].log == log) for log in (OTHERS[0], OWN))
    assert recognition.on_keyframes([first]) == []
    assert [candidate.pair.other(OWN_FIRST) for _, candidate in recognition.on_keyframes([second])] == [first[0]]


def test_rows_that_stand_for_others_are_few_unlike_and_found_by_their_keyframes() -> None:
    """Many logs of which none is like itself: bounds fall until few enough stay, and what stays is where it belongs."""
    rng = np.random.default_rng(5)
    logs, held, count = [LogId(f"r{k}") for k in range(2, 8)], 1200, 900
    keyframes = [(KeyframeId(log, k), Array.int8(rng.standard_normal(64))) for log in logs for k in range(count)]
    arrays = dict(keyframes)
    whole, parts = (
        PlaceRecognition(OWN, PlaceRecognitionParameters(similarity_threshold=0.99), keyframes_held=held)
        for _ in range(2)
    )
    whole.on_keyframes(keyframes)
    for first in range(0, len(keyframes), 500):
        parts.on_keyframes(keyframes[first : first + 500])
    share = held // (len(logs) - 1)
    for recognition in (whole, parts):
        assert recognition.rows <= len(logs) * (2 * share + THINNED_AT_ONCE)
        for log in logs:
            kept = {k: around for k in range(count) if (around := recognition._around(KeyframeId(log, k), 0))}
            assert set(range(count - share, count)) <= set(kept)
            assert len(kept) <= 2 * share + THINNED_AT_ONCE
            for k, (units, number) in kept.items():
                unit = direction(arrays[KeyframeId(log, k)])
                assert unit is not None
                np.testing.assert_allclose(units[number], unit, atol=1e-6)
            oldest = KeyframeId(log, min(kept))
            found = recognition.on_keyframes([(OWN_FIRST, arrays[oldest])])
            assert found[0][1].pair.other(OWN_FIRST) == oldest


class Logs:
    """Copies of logs, which lend place recognition the descriptors of their full blocks."""

    def __init__(self) -> None:
        self._copies: dict[LogId, LogCopy] = {}

    def add(self, recognition: PlaceRecognition, keyframe: KeyframeId, array: Array) -> list[Found]:
        copy = self._copies.setdefault(keyframe.log, LogCopy())
        copy.append(encode_record(KeyframeRecord(keyframe.index, 0.0, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), array)))
        found = recognition.on_keyframes([(keyframe, array)])
        if len(copy) % BLOCK_RECORDS == 0:
            recognition.lend(keyframe.log, *copy.descriptors(len(copy) // BLOCK_RECORDS - 1))
        return found


@pytest.mark.parametrize("held", [10**6, 300, 200])
@pytest.mark.parametrize("of_floats", [None, OTHERS[1]])
def test_rows_that_a_log_holds_are_compared_as_those_held_here(held: int, of_floats: LogId | None) -> None:
    ints, floats = drawn(64), drawn(64, "f4")
    keyframes = [floats[k] if each[0].log == of_floats else each for k, each in enumerate(ints)]
    parameters = PlaceRecognitionParameters(similarity_threshold=0.6)
    lent, alone = (PlaceRecognition(OWN, parameters, keyframes_held=held) for _ in range(2))
    logs, around = Logs(), 0
    for keyframe, array in keyframes:
        found = logs.add(lent, keyframe, array)
        assert found == alone.on_keyframes([(keyframe, array)])
        for _, candidate in found:
            assert lent.agreement(candidate.pair) == alone.agreement(candidate.pair)
            around += 1
    assert around > 100
    assert lent.rows == alone.rows
    assert lent.best_similarities == alone.best_similarities


def test_rows_that_a_log_holds_are_not_held_twice() -> None:
    recognition, logs = PlaceRecognition(OWN, PlaceRecognitionParameters(similarity_threshold=0.6)), Logs()
    for keyframe, array in drawn(64):
        logs.add(recognition, keyframe, array)
    (rows,) = recognition._others.values()
    assert len(rows) == len(OTHERS) * KEYFRAMES
    assert len(rows._rows) <= len(OTHERS) * (KEYFRAMES % BLOCK_RECORDS) + BLOCK_RECORDS


def test_rows_that_are_others_than_those_held_here_are_not_taken() -> None:
    recognition = PlaceRecognition(OWN, PlaceRecognitionParameters(similarity_threshold=0.6))
    keyframes = [each for each in drawn(64) if each[0].log == OTHERS[0]]
    recognition.on_keyframes(keyframes[:100])
    rows = np.array([np.frombuffer(array.data, np.int8) for _, array in keyframes])
    for indices, lent in ((range(64), rows[1:65]), (range(90, 110), rows[90:110]), (range(64), rows[:64, :32])):
        recognition.lend(OTHERS[0], list(indices), lent)
    recognition.lend(OTHERS[1], list(range(64)), rows[:64])
    recognition.lend(OTHERS[0], [], rows[:0])
    (held,) = recognition._others.values()
    assert held._lent == []


def test_keyframes_of_a_closed_log_find_their_best_partners_too() -> None:
    """A robot comes into a map: what the map's keyframes would have found among its own, had they come later."""
    keyframes = drawn(32)
    closed, own = ([each for each in keyframes if each[0].log == log] for log in (OTHERS[0], OWN))
    parameters = PlaceRecognitionParameters(similarity_threshold=0.6)
    in_map = PlaceRecognition(OWN, parameters, closed=frozenset({OTHERS[0]}))
    in_map.on_keyframes(closed)
    given = [each for keyframe in own for each in in_map.on_keyframes([keyframe])]
    later = PlaceRecognition(OWN, parameters)
    later.on_keyframes(own[:-1])  # of the last one nobody knows yet whether the next one is more similar
    best = {(k, c.pair.other(k)) for k, c in later.on_keyframes(closed)}
    both_ways = {(k, c.pair.other(k)) for k, c in given}
    assert len(best) > KEYFRAMES / 2
    assert best <= both_ways | {(k, own[-2][0]) for k, _ in closed}  # nor of the one before, where they rise
    givers = [(k, c) for k, c in given if k.log != OWN]
    assert len({(k, c.pair) for k, c in givers}) == len(givers)
    for giver in {k for k, _ in givers}:
        similarities = [c.similarity for k, c in givers if k == giver]
        assert similarities == sorted(set(similarities))
    by_themselves = {(k, c.pair.other(k)) for k, c in given if k.log == OWN}
    alone = PlaceRecognition(OWN, parameters)
    alone.on_keyframes(closed)
    assert by_themselves == {(k, c.pair.other(k)) for each in own for k, c in alone.on_keyframes([each])}
