"""Pairs that tell nothing new are not registered, and are taken up again where closures contradict each other."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.effects import Effect, Register, Unicast
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.latents import Peer
from flocc_agent.core.loop_closing import LoopClosing, registrar_of
from flocc_agent.core.offers import OFFER_PERIOD_S
from flocc_agent.core.parameters import LoopClosingParameters
from flocc_agent.core.place_recognition import Candidate
from flocc_agent.core.spared import (
    AGREE_LENGTHS,
    AGREE_RATIO,
    AGREE_STEPS,
    CONTRADICTED,
    LOOKED_MAX,
    SPARED_MAX,
    STRETCH,
    TIED_MIN,
    Spared,
)
from flocc_protocol.codec import Pose7
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidateOffer, CandidatePair
from flocc_protocol.records import ClosureRecord, KeyframeRecord, WithdrawalRecord

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")
KEYFRAMES = 40
ENOUGH = 3
APART_M = 1.0
Closures = list[tuple[int, int]]


def pair(low: int, high: int) -> CandidatePair:
    return CandidatePair(KeyframeId(R1, low), KeyframeId(R2, high))


class Road:
    """Two robots that drive side by side along a straight road, a metre apart and a metre from keyframe to keyframe.

    A third one's closures tie their ways, so that these are not weak.
    """

    def __init__(self, keyframes: int = KEYFRAMES, tied: int = 1) -> None:
        self.assembly = GraphAssembly()
        self.foretelling = self.assembly.foretelling
        self.spared = Spared(self.foretelling, ENOUGH)
        self._numbers: dict[LogId, int] = {}
        for log in (R1, R2):
            for k in range(keyframes):
                self.drives(log, k)
            for k in range(tied * KEYFRAMES):
                T = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
                ends = KeyframeId(log, k % KEYFRAMES), KeyframeId(R3, k)
                self._add(R3, ClosureRecord(*ends, T, 60, 100, 0.6, 1.0))

    def drives(self, log: LogId, k: int, jump_m: float = 0.0) -> None:
        self._add(log, KeyframeRecord(k, float(k), (k + jump_m, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None))

    def closes(
        self, low: int, high: int, scale: float | None = 1.0, off_m: float = 0.0, turned_rad: float = 0.0
    ) -> None:
        q = (math.cos(turned_rad / 2), 0.0, 0.0, math.sin(turned_rad / 2))
        length = 1.0 if scale is None else scale
        T = ((high - low) / length, (APART_M + off_m) / length, 0.0, *q)
        self._add(R1, ClosureRecord(KeyframeId(R1, low), KeyframeId(R2, high), T, 60, 100, 0.6, scale))

    def closes_backwards(self, low: int, high: int) -> None:
        """The same closure with the other keyframe as its query."""
        T = (low - high, -APART_M, 0.0, 1.0, 0.0, 0.0, 0.0)
        self._add(R2, ClosureRecord(KeyframeId(R2, high), KeyframeId(R1, low), T, 60, 100, 0.6, 1.0))

    def withdraws(self, log: LogId, index: int) -> list[CandidatePair]:
        """A robot takes a keyframe back; pairs of the closures that count no more."""
        return self._add(log, WithdrawalRecord(log, index, index + 1, is_final=True))

    def _add(self, log: LogId, record: KeyframeRecord | ClosureRecord | WithdrawalRecord) -> list[CandidatePair]:
        number = self._numbers.get(log, 0)
        self._numbers[log] = number + 1
        return self.assembly.add(NewRecord(log, number, record))


def test_a_pair_is_told_by_enough_closures_of_its_stretches() -> None:
    road = Road()
    for k in range(ENOUGH):
        assert not road.spared.is_told(pair(12, 12))
        road.closes(10 + k, 11 + k)
    assert road.spared.is_told(pair(12, 12))
    last = 10 + STRETCH
    assert road.spared.is_told(pair(last, last))
    assert not road.spared.is_told(pair(last + 1, last))
    assert not road.spared.is_told(pair(last, 12 - STRETCH))
    assert not Spared(road.foretelling, 0).is_told(pair(12, 12))


def test_a_stretch_with_few_closures_in_all_is_weak() -> None:
    road = Road(tied=0)
    for k in range(ENOUGH):
        road.closes(10 + k, 11 + k)
    assert not road.spared.is_told(pair(12, 12))
    keyframes = 2 * STRETCH + 1
    for k in range(int(TIED_MIN * keyframes) - ENOUGH):
        assert not road.spared.is_told(pair(12, 12))
        road.closes(9, 7 + k)
    assert road.spared.is_told(pair(12, 12))


def test_closures_of_either_direction_count_and_those_of_other_robots_do_not() -> None:
    road = Road()
    road.closes(10, 10)
    road.closes_backwards(11, 11)
    road.closes(12, 13)
    assert road.spared.is_told(pair(12, 12))
    assert not road.spared.is_told(CandidatePair(KeyframeId(R1, 12), KeyframeId(R3, 12)))
    assert not road.spared.is_told(CandidatePair(KeyframeId(R1, 10), KeyframeId(R1, 12)))


def test_what_closures_foretell_is_what_a_registration_would_find() -> None:
    road = Road()
    for k in (10, 12):
        road.closes(k, k + 1)
    road.closes_backwards(14, 13)
    road.closes(11 - STRETCH - 1, 12)
    found = road.foretelling.foretold(pair(11, 12), STRETCH)
    assert found.T_low_high == pytest.approx(np.array([[[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]]] * 3))


@pytest.mark.parametrize(
    "adds",
    [
        lambda road: road.closes(12, 13, scale=None),
        lambda road: road.closes(12, 13, off_m=6.0),
        lambda road: road.closes(12, 13, turned_rad=0.5),
        lambda road: road.closes(KEYFRAMES, KEYFRAMES),
    ],
)
def test_a_closure_without_a_length_or_that_does_not_agree_or_is_not_known_is_not_enough(
    adds: Callable[[Road], None],
) -> None:
    road = Road()
    road.closes(10, 11)
    road.closes(11, 12)
    adds(road)
    assert not road.spared.is_told(pair(12, 12))
    road.closes(11, 11)
    contradicted = road.foretelling.foretold(pair(12, 12), STRETCH)
    assert road.spared.is_told(pair(12, 12)) == (len(contradicted.may_m) == ENOUGH)


def test_odometry_that_tears_closures_apart_leaves_a_stretch_weak() -> None:
    road = Road(keyframes=12)
    for log in (R1, R2):
        for k in range(12, 20):
            road.drives(log, k, jump_m=30.0 if log == R1 else 0.0)
    for k in (10, 11):
        road.closes(k, k)
    road.closes(13, 13)
    road.closes(14, 14)
    assert not road.spared.is_told(pair(12, 12))


def test_each_closure_that_contradicts_takes_others_that_agree() -> None:
    road = Road()
    road.closes(10, 10, off_m=20.0)
    for k in range(ENOUGH + CONTRADICTED):
        assert not road.spared.is_told(pair(12, 12))
        road.closes(10 + k, 11 + k)
    assert road.spared.is_told(pair(12, 12))


def machine(road: Road, own: LogId = R1, held: tuple[LogId, ...] = (R1, R2)) -> LoopClosing:
    def odometry_pair(k: KeyframeId) -> tuple[KeyframeId, Pose7] | None:
        return (KeyframeId(k.log, k.index - 1), (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)) if k.index else None

    parameters = LoopClosingParameters(closures_enough=ENOUGH, sparing_logs_min=3)
    closing = LoopClosing(own, 0, odometry_pair, parameters, held=road.foretelling)
    for log in held:
        for k in range(KEYFRAMES):
            closing.on_held(KeyframeId(log, k))
    return closing


def learns(closing: LoopClosing, road: Road, ends: Closures, off_m: float = 0.0, now: float = 0.0) -> None:
    for low, high in ends:
        road.closes(low, high, off_m=off_m)
        closing.on_closure(pair(low, high), now)


def registered(effects: list[Effect]) -> list[CandidatePair]:
    return [effect.pair for effect in effects if isinstance(effect, Register)]


def of_r1(closures: int = 1) -> list[CandidatePair]:
    """Pairs of one stretch that r1 registers."""
    pairs = (pair(low, high) for low in range(11, 15) for high in range(11, 15))
    return [each for each in pairs if registrar_of(each) == R1][:closures]


TELLING = [(10, 10), (10, 11), (11, 10)]


def test_a_pair_that_tells_nothing_new_is_not_registered_and_said_once() -> None:
    road = Road()
    closing, candidate = machine(road), of_r1()[0]
    learns(closing, road, TELLING)
    closing.on_candidates([Candidate(candidate, 0.9)], 0.0)
    assert not registered(closing.tick(0.0))
    assert closing.take_told() == [candidate]
    assert not closing.take_told()
    assert not closing.open_pairs()
    assert closing.load == 0
    assert not closing.on_candidates([Candidate(candidate, 0.9)], 1.0), "it is known"
    closing.on_offer(CandidateOffer((candidate,), transferred=True), 1.0)
    assert not closing.open_pairs()


def test_a_small_team_registers_all_pairs() -> None:
    road = Road()
    for k in range(ENOUGH):
        road.closes(10 + k, 11 + k)
    assert road.foretelling.logs() == 3
    assert Spared(road.foretelling, ENOUGH, logs_min=3).is_told(pair(12, 12))
    assert not Spared(road.foretelling, ENOUGH, logs_min=4).is_told(pair(12, 12))


def test_what_waits_is_spared_when_closures_come_and_what_is_under_way_is_not() -> None:
    road = Road()
    closing, (begun, *waiting) = machine(road), of_r1(3)
    closing.on_candidates([Candidate(begun, 0.9), *(Candidate(each, 0.5) for each in waiting)], 0.0)
    assert registered(closing.tick(0.0)) == [begun]
    learns(closing, road, TELLING)
    assert sorted(closing.take_told()) == sorted(waiting)
    assert closing.open_pairs() == [begun]


def test_an_offer_is_told_no_more_once_its_pair_is_told() -> None:
    road = Road()
    closing = machine(road)
    other = next(pair(low, low) for low in range(11, 15) if registrar_of(pair(low, low)) == R2)
    closing.on_peer("r2", Peer(0, log=R2))
    closing.on_candidates([Candidate(other, 0.9)], 0.0)
    assert [type(effect) for effect in closing.tick(0.0)] == [Unicast]
    learns(closing, road, TELLING)
    assert not closing.tick(OFFER_PERIOD_S)
    assert closing.take_told() == [other]
    assert not closing.open_pairs()


def test_pairs_are_taken_up_again_where_a_closure_contradicts() -> None:
    road = Road()
    closing, candidate = machine(road), of_r1()[0]
    learns(closing, road, TELLING)
    closing.on_candidates([Candidate(candidate, 0.9)], 0.0)
    learns(closing, road, [(12, 10)])
    assert not closing.open_pairs(), "one more that agrees changes nothing"
    learns(closing, road, [(13, 10)], off_m=20.0, now=1.0)
    assert closing.open_pairs() == [candidate]
    assert registered(closing.tick(1.0)) == [candidate]


def test_a_closure_whose_keyframes_are_not_known_yet_changes_nothing() -> None:
    road = Road()
    closing = machine(road)
    last = next(each for k in (36, 37, 38) if registrar_of(each := pair(KEYFRAMES - 1, k)) == R1)
    learns(closing, road, [(37, 37), (38, 38), (38, 37)])
    closing.on_candidates([Candidate(last, 0.9)], 0.0)
    learns(closing, road, [(KEYFRAMES, KEYFRAMES - 1)], off_m=20.0)
    assert closing.take_told() == [last]
    assert not closing.open_pairs()
    road.drives(R1, KEYFRAMES)
    learns(closing, road, [(37, 38)])
    assert closing.open_pairs() == [last], "now it contradicts"


def test_a_record_of_a_spared_pair_is_taken_as_any() -> None:
    road = Road()
    closing, candidate = machine(road), of_r1()[0]
    learns(closing, road, TELLING)
    closing.on_candidates([Candidate(candidate, 0.9)], 0.0)
    assert closing.sizes()["spared"] == (1, SPARED_MAX)
    closing.on_rejection(candidate, "a latent was lost")
    assert closing.sizes()["spared"] == (0, SPARED_MAX)
    assert not closing.on_candidates([Candidate(candidate, 0.9)], 1.0)


def test_tables_are_bounded() -> None:
    road = Road()
    for k in range(SPARED_MAX + 10):
        road.spared.add(pair(k, k), 0.5)
    assert road.spared.sizes()["spared"] == (SPARED_MAX, SPARED_MAX)
    assert pair(0, 0) not in road.spared
    assert pair(SPARED_MAX, SPARED_MAX) in road.spared
    for k in range(KEYFRAMES):
        road.drives(R3, k)
    for k in range(4):
        road.closes(10 + k, 10 + k, off_m=20.0 * k)
    assert not road.spared.is_told(pair(12, 12))
    assert road.spared.sizes()["weak"] == (1, LOOKED_MAX)


class Crowd(Road):
    """The same road, and others that drive between the two, half a metre from each."""

    def __init__(self, others: int = 1) -> None:
        super().__init__()
        self.others = [LogId(f"s{k}") for k in range(others)]
        for log in self.others:
            for k in range(KEYFRAMES):
                self.drives(log, k)

    def meets(self, log: LogId, one: KeyframeId, at: int = 12, off_m: float = 0.0) -> CandidatePair:
        """A closure of another one with the first or the second."""
        T = (float(at - one.index), (0.5 if one.log == R1 else -0.5) + off_m, 0.0, 1.0, 0.0, 0.0, 0.0)
        self._add(log, ClosureRecord(one, KeyframeId(log, at), T, 60, 100, 0.6, 1.0))
        return CandidatePair.of(one, KeyframeId(log, at))

    def meets_both(self, log: LogId, low: int, high: int, off_m: float = 0.0) -> list[CandidatePair]:
        return [self.meets(log, KeyframeId(R1, low), off_m=off_m), self.meets(log, KeyframeId(R2, high))]

    def foretold(self) -> int:
        return len(self.foretelling.foretold(pair(12, 12), STRETCH).may_m)


def test_a_third_log_foretells_what_a_registration_would_find() -> None:
    road = Crowd()
    (s0,) = road.others
    road.meets(s0, KeyframeId(R1, 10), at=8)
    road.meets(s0, KeyframeId(R2, 14), at=13)
    found = road.foretelling.foretold(pair(12, 13), STRETCH)
    assert found.T_low_high == pytest.approx(np.array([[[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]]]))
    closures = AGREE_LENGTHS * (math.hypot(2.0, 0.5) + math.hypot(1.0, 0.5))
    assert found.may_m == pytest.approx([closures + AGREE_RATIO * (2.0 + 5.0 + 1.0) + AGREE_STEPS])


def test_a_third_log_is_one_witness_and_only_where_it_saw_both_at_one_place() -> None:
    road = Crowd()
    (s0,) = road.others
    road.meets(s0, KeyframeId(R1, 12), at=1)
    road.meets(s0, KeyframeId(R2, 12), at=2 * STRETCH + 2)
    assert not road.foretold()
    road.meets(s0, KeyframeId(R2, 12), at=2 * STRETCH + 1)
    assert road.foretold() == 1
    road.meets_both(s0, 11, 13)
    assert road.foretold() == 1
    road.meets(LogId("s9"), KeyframeId(R1, 12))
    road.meets(LogId("s9"), KeyframeId(R2, 12))
    assert road.foretold() == 1, "its odometry is not known"


def test_third_logs_and_direct_closures_are_enough_together() -> None:
    road = Crowd(others=2)
    road.closes(12, 13)
    for log in road.others:
        assert not road.spared.is_told(pair(12, 12))
        road.meets_both(log, 11, 11)
    assert road.spared.is_told(pair(12, 12))


def test_a_third_log_that_contradicts_takes_others_that_agree() -> None:
    road = Crowd(others=1 + ENOUGH + CONTRADICTED)
    wrong, *others = road.others
    road.meets_both(wrong, 12, 12, off_m=9.0)
    for log in others:
        assert not road.spared.is_told(pair(12, 12))
        road.meets_both(log, 12, 12)
    assert road.spared.is_told(pair(12, 12))


def test_what_is_foretold_does_not_depend_on_the_order_in_which_records_came() -> None:
    told = []
    for order in (1, -1):
        road = Crowd(others=3)
        for log in road.others[::order]:
            for k in range(11, 14)[::order]:
                road.meets_both(log, k, 24 - k, off_m=0.01 * k)
        for k in range(10, 15)[::order]:
            road.closes(k, k + 1, off_m=0.01 * k)
        told.append(road.foretelling.foretold(pair(12, 12), STRETCH))
    assert len(told[0].may_m) == 8
    assert np.array_equal(told[0].T_low_high, told[1].T_low_high)
    assert np.array_equal(told[0].may_m, told[1].may_m)


def test_what_third_logs_tell_meanwhile_is_neither_fetched_nor_registered() -> None:
    road = Crowd(others=ENOUGH)
    closing, candidate = machine(road), of_r1()[0]
    closing.on_candidates([Candidate(candidate, 0.9)], 0.0)
    for log in road.others:
        for each in road.meets_both(log, 12, 12):
            closing.on_closure(each, 0.0)
    assert not closing.tick(0.0)
    assert closing.take_told() == [candidate]
    assert not closing.open_pairs()

    lacking = machine(road, held=(R1,))
    lacking.on_peer("r2", Peer(0, log=R2))
    lacking.on_candidates([Candidate(candidate, 0.9)], 0.0)
    assert not lacking.tick(0.0)


def test_pairs_are_taken_up_again_where_what_third_logs_say_counts_no_more() -> None:
    road = Crowd(others=ENOUGH)
    closing, candidate = machine(road), of_r1()[0]
    closures = [each for log in road.others for each in road.meets_both(log, 12, 12)]
    for each in closures:
        closing.on_closure(each, 0.0)
    closing.on_candidates([Candidate(candidate, 0.9)], 0.0)
    assert closing.take_told() == [candidate]
    gone = road.withdraws(road.others[0], 12)
    assert gone == closures[:2]
    for each in gone:
        closing.on_withdrawn(each, 1.0)
    assert candidate in closing.open_pairs()


def test_pairs_that_third_logs_told_are_taken_up_again_where_a_closure_contradicts() -> None:
    road = Crowd(others=ENOUGH)
    closing, candidate = machine(road), of_r1()[0]
    for log in road.others:
        for each in road.meets_both(log, 12, 12):
            closing.on_closure(each, 0.0)
    closing.on_candidates([Candidate(candidate, 0.9)], 0.0)
    assert closing.take_told() == [candidate]
    learns(closing, road, [(13, 13)])
    assert not closing.open_pairs()
    learns(closing, road, [(13, 10)], off_m=20.0, now=1.0)
    assert closing.open_pairs() == [candidate]


@pytest.mark.parametrize("is_spared", [False, True])
def test_a_pair_that_is_asked_for_is_registered_whatever_others_tell(is_spared: bool) -> None:
    road = Road()
    closing, candidate = machine(road), of_r1()[0]
    learns(closing, road, TELLING)
    if is_spared:
        closing.on_candidates([Candidate(candidate, 0.9)], 0.0)
    closing.on_asked([Candidate(candidate, 0.9)], 0.0)
    assert registered(closing.tick(0.0)) == [candidate]


def test_a_pair_that_is_asked_for_is_not_offered_for_ever_to_a_stronger_robot_that_spares_it() -> None:
    road = Road()
    closing, candidate = machine(road), of_r1()[0]
    closing.on_peer("r9", Peer(5, log=LogId("r9")))
    closing.on_asked([Candidate(candidate, 0.9)], 0.0)
    assert [type(effect) for effect in closing.tick(0.0)] == [Unicast]
    learns(closing, road, TELLING)
    assert not closing.tick(OFFER_PERIOD_S)
    assert not closing.open_pairs()


def test_a_pair_is_looked_at_again_when_keyframes_of_closures_become_known() -> None:
    road = Crowd()
    others = [LogId(f"u{k}") for k in range(ENOUGH)]
    for log in others:
        road.meets_both(log, 12, 12)
        for k in range(12):
            road.drives(log, k)
    assert not road.spared.is_told(pair(12, 12))
    for log in others:
        road.drives(log, 12)
    assert road.spared.is_told(pair(12, 12))


def test_a_pair_whose_record_does_not_reach_who_waits_for_it_is_registered_again_whatever_others_tell() -> None:
    road = Road()
    closing, candidate = machine(road), of_r1()[0]
    learns(closing, road, [*TELLING, (candidate.low.index, candidate.high.index)])
    closing.do_again(candidate)
    assert registered(closing.tick(0.0)) == [candidate]
