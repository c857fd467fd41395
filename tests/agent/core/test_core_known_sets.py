"""Pairs that are known for good take little memory, and none is taken for another."""

import tracemalloc

from flocc_agent.core.known_sets import KeyframeSet, PairSet, PairTable
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


def test_a_table_is_bounded_and_finds_pairs_of_the_same_stretches() -> None:
    table: PairTable[int] = PairTable(3)
    for k in range(4):
        table.put(pair(k, 10), k)
    assert table.size() == (3, 3)
    assert pair(0, 10) not in table
    assert list(table.beside(pair(2, 12), 2)) == [pair(1, 10), pair(2, 10), pair(3, 10)]
    assert list(table.beside(pair(4, 12), 2)) == [pair(2, 10), pair(3, 10)]
    assert not list(table.beside(pair(2, 13), 2))
    assert not list(table.beside(CandidatePair(KeyframeId(A, 2), KeyframeId(LogId("c"), 10)), 2))
    assert table.pop(pair(2, 10)) == 2
    assert table.pop(pair(2, 10)) is None
    assert len(table) == 2


def test_a_table_of_pairs_finds_those_with_a_keyframe_of_the_same_stretch() -> None:
    c = LogId("c")
    table: PairTable[float] = PairTable(10)
    across = CandidatePair(KeyframeId(B, 18), KeyframeId(c, 40))
    within = CandidatePair(KeyframeId(A, 14), KeyframeId(A, 15))
    for each in (pair(20, 90), across, within, pair(90, 90)):
        table.put(each, 0.5)
    assert table.near(pair(17, 15), 3) == [within, pair(20, 90), across]
    assert table.near(CandidatePair(KeyframeId(c, 15), KeyframeId(c, 18)), 3) == []
    for each in (pair(20, 90), across, within):
        table.pop(each)
    assert table.near(pair(17, 15), 3) == []
    assert table.near(pair(89, 1), 3) == [pair(90, 90)]
