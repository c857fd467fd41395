"""Pairs that are refused unseen: only where better ones were refused, never for good, and by a record."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
import pytest

from flocc_agent.core.effects import Effect, FetchLatent, Register
from flocc_agent.core.latents import Peer
from flocc_agent.core.loop_closing import UNLIKELY_AT_ONCE_MAX, LoopClosing, registrar_of
from flocc_agent.core.parameters import LoopClosingParameters, PlaceRecognitionParameters
from flocc_agent.core.place_recognition import Candidate, PlaceRecognition, run_agreement
from flocc_agent.core.prospects import (
    HOLD_S,
    PROBED_EVERY,
    REFUSED_MIN,
    TAUGHT_BY_OTHERS_MAX,
    UNLIKELY,
    Prospect,
    Prospects,
    is_probe,
)
from flocc_protocol.arrays import Array
from flocc_protocol.codec import Pose7
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

R1, R2 = LogId("r1"), LogId("r2")
ONE: Pose7 = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def pair(i: int, j: int = 500) -> CandidatePair:
    return CandidatePair(KeyframeId(R1, i), KeyframeId(R2, j))


def of_own(
    count: int, is_wanted: Callable[[CandidatePair], bool] = lambda one: not is_probe(one)
) -> list[CandidatePair]:
    """Pairs that r1 registers, far from each other."""
    pairs = (pair(10 * k, 2000 + 10 * k) for k in range(1, 10_000))
    return [one for one in pairs if registrar_of(one) == R1 and is_wanted(one)][:count]


def is_unlikely(prospects: Prospects, one: CandidatePair) -> bool:
    """Whether a pair is not fetched at once."""
    return prospects.of(one, 0.0) is not Prospect.LIKELY


def after_refusals(count: int, agreement: float = 0.3) -> Prospects:
    """What is known after some pairs that agree by 0.5 were refused; all others agree as given."""
    refused = [pair(10 * k) for k in range(count)]
    prospects = Prospects(lambda one: 0.5 if one in refused else agreement)
    for one in refused:
        prospects.on_judged(one, is_closure=False)
    return prospects


def test_a_pair_is_unlikely_only_where_enough_better_ones_were_refused() -> None:
    one = of_own(1)[0]
    assert is_unlikely(after_refusals(REFUSED_MIN), one)
    assert not is_unlikely(after_refusals(REFUSED_MIN - 1), one)
    assert not is_unlikely(after_refusals(REFUSED_MIN, agreement=0.6), one)


def test_a_closure_that_agrees_just_better_keeps_a_pair_likely_and_a_much_better_one_does_not() -> None:
    one, near, far = of_own(3)
    levels = {near: 0.4, far: 0.9}
    refused = [pair(10 * k) for k in range(REFUSED_MIN)]
    for closure, expected in ((near, False), (far, True)):
        prospects = Prospects(lambda other: 0.5 if other in refused else levels.get(other, 0.3))
        for other in refused:
            prospects.on_judged(other, is_closure=False)
        prospects.on_judged(closure, is_closure=True)
        assert is_unlikely(prospects, one) is expected


def test_one_unlikely_pair_in_a_few_is_registered_all_the_same() -> None:
    prospects = after_refusals(REFUSED_MIN)
    probes = of_own(300, lambda _: True)
    share = sum(not is_unlikely(prospects, one) for one in probes) / len(probes)
    assert 0.5 / PROBED_EVERY < share < 2.0 / PROBED_EVERY


def test_nothing_is_unlikely_of_which_too_little_is_known() -> None:
    prospects = Prospects(lambda _: None)
    for k in range(3 * REFUSED_MIN):
        prospects.on_judged(pair(10 * k), is_closure=False)
    assert not any(is_unlikely(prospects, one) for one in of_own(20))


def test_what_lies_beside_a_closure_is_taken_up_again_and_likely_from_then_on() -> None:
    prospects = after_refusals(REFUSED_MIN)
    one = of_own(1)[0]
    near = CandidatePair(one.low, KeyframeId(R2, one.high.index + 2))
    away = CandidatePair(one.low, KeyframeId(R2, one.high.index + 3))
    for other in (near, away):
        prospects.on_unlikely(other)
    assert prospects.on_judged(one, is_closure=True) == [near]
    assert prospects.on_judged(one, is_closure=True) == []
    assert not is_unlikely(prospects, near)


def test_pairs_of_others_teach_a_robot_only_as_long_as_it_knows_little() -> None:
    asked: list[CandidatePair] = []
    prospects = Prospects(lambda one: asked.append(one) or 0.5)  # type: ignore[func-returns-value]
    for k in range(3 * TAUGHT_BY_OTHERS_MAX):
        prospects.on_judged(pair(10 * k), is_closure=False, is_own=False)
    own = [pair(10 * k, 5000) for k in range(20)]
    for one in own:
        prospects.on_judged(one, is_closure=False)
    prospects.of(of_own(1)[0], 0.0)
    assert asked[1:] == [*(pair(10 * k) for k in range(TAUGHT_BY_OTHERS_MAX)), *own]


def test_tables_stay_within_their_maximum() -> None:
    prospects = Prospects(lambda one: one.low.index % 97 / 97.0)
    for k in range(1500):
        prospects.on_judged(pair(k), is_closure=k % 3 == 0)
        prospects.on_unlikely(pair(k, 9000))
        prospects.of(pair(k, 7000), float(k))
    assert all(size <= size_max for size, size_max in prospects.sizes().values())


# Agreement of runs


def ways(is_reversed: bool) -> np.ndarray:
    """Similarities of two ways of ten keyframes through the same places."""
    similarities = np.full((10, 10), 0.3, np.float32)
    for k in range(10):
        similarities[k, 9 - k if is_reversed else k] = 0.8
    return similarities


@pytest.mark.parametrize("is_reversed", [False, True])
def test_runs_agree_in_the_same_and_in_opposite_directions(is_reversed: bool) -> None:
    assert run_agreement(ways(is_reversed), 4, 5 if is_reversed else 4) == pytest.approx(0.8)


def test_a_single_similar_pair_agrees_little() -> None:
    similarities = np.full((10, 10), 0.3, np.float32)
    similarities[4, 4] = 0.8
    agreement = run_agreement(similarities, 4, 4)
    assert agreement is not None
    assert agreement == pytest.approx(0.4)


def test_a_run_of_one_keyframe_says_nothing() -> None:
    assert run_agreement(np.ones((1, 5), np.float32), 0, 2) is None


def test_recognition_gives_the_agreement_of_any_two_logs_it_holds() -> None:
    recognition = PlaceRecognition(R1, PlaceRecognitionParameters(similarity_threshold=0.9))
    places = np.random.default_rng(4).normal(size=(12, 64))
    for log, order in ((R1, range(12)), (R2, range(11, -1, -1))):
        recognition.on_keyframes([(KeyframeId(log, k), Array.int8(places[place])) for k, place in enumerate(order)])
    agreement = recognition.agreement(pair(4, 7))
    assert agreement is not None
    assert agreement > 0.95
    other = recognition.agreement(pair(4, 2))
    assert other is not None
    assert other < 0.5
    assert recognition.agreement(pair(4, 12)) is None
    assert recognition.agreement(CandidatePair(KeyframeId(R1, 4), KeyframeId(LogId("r3"), 1))) is None


# In loop closing


def closing_after_refusals(levels: Mapping[CandidatePair, float] = MappingProxyType({})) -> LoopClosing:
    """r1 beside r2, after enough refusals; no other pair agrees as well, but as given."""
    refused = [pair(10 * k) for k in range(REFUSED_MIN)]
    machine = LoopClosing(
        R1,
        0,
        lambda k: (KeyframeId(k.log, k.index - 1), ONE),
        LoopClosingParameters(),
        agreement=lambda one: 0.5 if one in refused else levels.get(one, 0.3),
    )
    machine.on_peer("r2", Peer(0, log=R2))
    for one in refused:
        machine.on_rejection(one, "few correspondences")
    return machine


def fetched(effects: list[Effect]) -> list[KeyframeId]:
    return [effect.keyframe for effect in effects if isinstance(effect, FetchLatent)]


def test_an_unlikely_pair_is_refused_and_its_latent_not_fetched() -> None:
    machine, (one, *_) = closing_after_refusals(), of_own(1)
    machine.on_candidates([Candidate(one, 0.4)], 0.0)
    assert fetched(machine.tick(0.0)) == []
    assert machine.take_unlikely() == []
    assert machine.deadline() == HOLD_S
    assert fetched(machine.tick(HOLD_S)) == []
    assert machine.take_unlikely() == [one]
    assert machine.take_unlikely() == []


def test_a_probe_is_fetched_however_unlikely_it_is() -> None:
    machine, (one, *_) = closing_after_refusals(), of_own(1, is_probe)
    machine.on_candidates([Candidate(one, 0.4)], 0.0)
    assert fetched(machine.tick(0.0)) == [one.high]


def test_a_latent_that_a_likely_pair_needs_serves_the_unlikely_one_too() -> None:
    machine, (one, *_) = closing_after_refusals(), of_own(1)
    probe = next(
        other
        for k in range(1, 1000)
        if is_probe(other := CandidatePair(KeyframeId(R1, 10 * k), one.high)) and registrar_of(other) == R1
    )
    machine.on_candidates([Candidate(one, 0.4), Candidate(probe, 0.3)], 0.0)
    assert fetched(machine.tick(0.0)) == [one.high]
    assert machine.take_unlikely() == []


def test_an_unlikely_pair_whose_latents_are_here_is_registered() -> None:
    machine, (one, *_) = closing_after_refusals(), of_own(1)
    for keyframe in (one.low, KeyframeId(R1, one.low.index - 1), one.high):
        machine.on_held(keyframe)
    machine.on_candidates([Candidate(one, 0.4)], 0.0)
    assert [e.pair for e in machine.tick(0.0) if isinstance(e, Register)] == [one]
    assert machine.take_unlikely() == []


def test_a_pair_that_was_refused_unseen_is_fetched_once_a_closure_lies_beside_it() -> None:
    machine, (one, *_) = closing_after_refusals(), of_own(1)
    machine.on_candidates([Candidate(one, 0.4)], 0.0)
    machine.tick(0.0)
    machine.tick(HOLD_S)
    for refused in machine.take_unlikely():
        machine.on_rejection(refused, UNLIKELY, was_seen=False)
    assert machine.open_pairs() == []
    machine.on_closure(CandidatePair(KeyframeId(R1, one.low.index + 1), one.high), 9.0)
    assert machine.open_pairs() == [one]
    assert fetched(machine.tick(9.0)) == [one.high]


@pytest.mark.parametrize("seen", ["too few correspondences", "a latent was lost"])
@pytest.mark.parametrize("unseen_first", [False, True])
def test_a_pair_that_somebody_else_settled_is_not_taken_up_again(seen: str, unseen_first: bool) -> None:
    machine, (one, *_) = closing_after_refusals(), of_own(1)
    for reason in (UNLIKELY, seen) if unseen_first else (seen, UNLIKELY):
        machine.on_rejection(one, reason, was_seen=reason == "too few correspondences")
    machine.on_closure(CandidatePair(KeyframeId(R1, one.low.index + 1), one.high), 9.0)
    assert machine.open_pairs() == []


def test_a_pair_that_is_held_is_fetched_when_later_keyframes_agree() -> None:
    levels: dict[CandidatePair, float] = {}
    machine, (one, *_) = closing_after_refusals(levels), of_own(1)
    machine.on_candidates([Candidate(one, 0.4)], 0.0)
    assert fetched(machine.tick(0.0)) == []
    levels[one] = 0.6
    assert fetched(machine.tick(HOLD_S)) == [one.high]
    assert machine.take_unlikely() == []


def test_a_pair_that_is_held_is_fetched_at_once_when_a_closure_lies_beside_it() -> None:
    machine, (one, *_) = closing_after_refusals(), of_own(1)
    machine.on_candidates([Candidate(one, 0.4)], 0.0)
    assert fetched(machine.tick(0.0)) == []
    machine.on_closure(CandidatePair(KeyframeId(R1, one.low.index + 1), one.high), 1.0)
    assert fetched(machine.tick(1.0)) == [one.high]


def test_refusals_unseen_and_lost_latents_make_nothing_unlikely() -> None:
    machine = LoopClosing(R1, 0, lambda _: None, LoopClosingParameters(), agreement=lambda _: 0.5)
    machine.on_peer("r2", Peer(0, log=R2))
    for k in range(2 * REFUSED_MIN):
        machine.on_rejection(pair(10 * k), UNLIKELY, was_seen=False)
        machine.on_rejection(pair(10 * k, 600), "a latent was lost", was_seen=False)
    one = of_own(1)[0]
    machine.on_candidates([Candidate(one, 0.4)], 0.0)
    assert fetched(machine.tick(0.0)) == [one.high]


def test_many_unlikely_pairs_are_refused_a_few_at_a_time() -> None:
    machine, pairs = closing_after_refusals(), of_own(UNLIKELY_AT_ONCE_MAX + 5)
    machine.on_candidates([Candidate(one, 0.4) for one in pairs], 0.0)
    machine.tick(0.0)
    machine.tick(HOLD_S)
    first = machine.take_unlikely()
    assert len(first) == UNLIKELY_AT_ONCE_MAX
    for one in first:
        machine.on_rejection(one, UNLIKELY, was_seen=False)
    machine.tick(HOLD_S)
    assert sorted(first + machine.take_unlikely()) == sorted(pairs)
