"""Claims on identifiers: one text each, one order everywhere, limits at construction."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.protocol.wire_examples import keyframe_ids, log_ids

from flocc_protocol.errors import FloccError
from flocc_protocol.ids import (
    INCARNATION_MAX,
    INDEX_MAX,
    TERM_COUNTER_MAX,
    BadName,
    KeyframeId,
    LogId,
    Term,
    checked_name,
)


@given(log_ids)
def test_a_log_identifier_reads_back(log: LogId) -> None:
    assert LogId.parse(str(log)) == log


@given(keyframe_ids)
def test_a_keyframe_identifier_reads_back(keyframe: KeyframeId) -> None:
    assert KeyframeId.parse(str(keyframe)) == keyframe


@given(st.integers(0, TERM_COUNTER_MAX), log_ids)
def test_a_term_reads_back(counter: int, log: LogId) -> None:
    assert Term.parse(str(Term(counter, log))) == Term(counter, log)


@given(st.text(max_size=60) | st.from_regex(r"\A[a-z0-9~:/+_ -]{0,20}\Z"))
def test_any_other_text_is_a_value_error(text: str) -> None:
    for parse in (LogId.parse, KeyframeId.parse, Term.parse):
        try:
            identifier = parse(text)
        except ValueError:
            continue
        assert str(identifier) == text


@pytest.mark.parametrize(
    "text", ["", "~", "a~", "a~0", "a~0x1f", "a~1F", "a~01", "a~-1", "a~1~2", "A", "a b", "-a", "a" * 33, "ä"]
)
def test_a_log_has_one_spelling(text: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        LogId.parse(text)


@pytest.mark.parametrize("text", ["a", "a/", "/1", "a/-1", "a/+1", "a/01", "a/1_0", "a/ 1", "a/1/2", "a/२", "a/1e3"])
def test_a_keyframe_has_one_spelling(text: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        KeyframeId.parse(text)


@pytest.mark.parametrize("name", ["", "A", "a/b", "a*", "$", "a b", "-a", "_a", "a\n", "a" * 33, "ａ"])
def test_names_that_a_key_cannot_hold_are_refused_by_name(name: str) -> None:
    with pytest.raises(BadName, match="robot name") as caught:
        checked_name(name)
    assert repr(name) in str(caught.value)
    assert isinstance(caught.value, FloccError)


def test_identifiers_are_limited_at_construction() -> None:
    log = LogId("a")
    for build in (
        lambda: LogId("a", -1),
        lambda: LogId("a", INCARNATION_MAX + 1),
        lambda: KeyframeId(log, -1),
        lambda: KeyframeId(log, INDEX_MAX + 1),
        lambda: Term(-1, log),
        lambda: Term(TERM_COUNTER_MAX + 1, log),
    ):
        with pytest.raises(ValueError, match="out of range"):
            build()


def test_terms_are_ordered_by_counter_then_by_leader() -> None:
    a, b = LogId("a"), LogId("b")
    ordered = [Term(1, a), Term(1, LogId("a", 3)), Term(1, b), Term(2, a), Term(10, a)]
    shuffled = [ordered[k] for k in (3, 0, 4, 2, 1)]
    assert sorted(shuffled) == ordered


def test_keyframes_are_ordered_by_number_not_by_text() -> None:
    log = LogId("a")
    assert KeyframeId(log, 9) < KeyframeId(log, 10) < KeyframeId(LogId("a", 1), 0)
