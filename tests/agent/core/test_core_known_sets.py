"""Pairs that are known for good take little memory, and none is taken for another."""

import tracemalloc

from flocc_agent.core.known_sets import KeyframeSet, PairSet
from flocc_protocol.ids import INDEX_MAX, KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

A, B = LogId("a"), LogId("b")


def pair(low: int, high: int) -> CandidatePair:
    return CandidatePair.of(KeyframeId(A, low), KeyframeId(B, high))


def test_what_was_added_is_there_and_nothing_else() -> None:
    some, pairs = PairSet(), [pair(0, INDEX_MAX), pair(1, 0), pair(INDEX_MAX, 1)]
    for each in pairs[:2]:
        some.add(each)
        some.add(each)
    assert [each in some for each in pairs] == [True, True, False]
    some.discard(pairs[0])
    some.discard(pairs[2])
    assert [each in some for each in pairs] == [False, True, False]
    assert CandidatePair.of(KeyframeId(A, 1), KeyframeId(A, 2)) not in some


def test_a_pair_takes_few_bytes() -> None:
    tracemalloc.start()
    some = PairSet()
    for k in range(20_000):
        some.add(pair(1000 + k, 2000 + k // 2))
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert held <= 10 * 20_000


def test_a_set_of_keyframes_holds_what_was_added() -> None:
    some = KeyframeSet()
    for index in (7, 0, INDEX_MAX, 7):
        some.add(KeyframeId(A, index))
    assert [k for k in (0, 1, 7, INDEX_MAX) if KeyframeId(A, k) in some] == [0, 7, INDEX_MAX]
    some.discard(KeyframeId(A, 7))
    some.discard(KeyframeId(B, 7))
    assert KeyframeId(A, 7) not in some
    assert KeyframeId(B, 0) not in some
    assert "a/0" not in some
