"""Candidates to registrations: each pair by one robot, taken over, rejected when its latents are lost."""

from collections import Counter
from typing import Any

import pytest
from tests.agent.core.virtual_time import Robots, answer, keyframe

from flocc_agent.core import latents
from flocc_agent.core.effects import Effect, Encode, FetchLatent, Register, Unicast
from flocc_agent.core.events import (
    LATENT_FALSE,
    LATENT_UNKNOWN,
    Event,
    KeyframeEncodingFailed,
    LatentFetchFailed,
    LatentMissing,
)
from flocc_agent.core.latents import (
    BACKLOG_MAX,
    HEARD_S,
    OFFERED_S,
    RELAYS_MAX,
    RETRY_S,
    TOLD_AGAIN_S,
    WANTS_TURN_S,
    Latents,
    Peer,
    Reach,
)
from flocc_agent.core.loop_closing import REGISTRATION_TIMEOUT_S, LoopClosing, registrar_of
from flocc_agent.core.offers import OFFER_PERIOD_S, TAKEOVER_S
from flocc_agent.core.parameters import LoopClosingParameters
from flocc_agent.core.place_recognition import Candidate
from flocc_agent.core.reports import ClosureRejected, LatentFailed
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidateOffer, CandidatePair
from flocc_protocol.records import RejectionRecord

R1, R2 = LogId("r1"), LogId("r2")
PARAMETERS = LoopClosingParameters()
ONE = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def pair_of(registrar: LogId) -> CandidatePair:
    """A pair of r1 and r2 that the given robot is to register."""
    return pairs_of(registrar, 1)[0]


def pairs_of(registrar: LogId, count: int) -> list[CandidatePair]:
    """The first few pairs of different keyframes of r1 with r2/1 that a robot is to register."""
    pairs = (CandidatePair.of(KeyframeId(R1, i), KeyframeId(R2, 1)) for i in range(1, 100))
    return [pair for pair in pairs if registrar_of(pair) == registrar][:count]


def closing(
    compute_class: int = 0, own: LogId = R1, listens_until_s: float = float("-inf"), **changes: Any
) -> LoopClosing:
    def odometry_pair(k: KeyframeId) -> tuple[KeyframeId, Any]:
        return KeyframeId(k.log, k.index - 1), ONE

    parameters = LoopClosingParameters(**changes)
    return LoopClosing(own, compute_class, odometry_pair, parameters, listens_until_s=listens_until_s)


def found(machine: LoopClosing, pair: CandidatePair, similarity: float = 0.9, now: float = 0.0) -> None:
    machine.on_candidates([Candidate(pair, similarity)], now)


def offers(effects: list[Effect]) -> list[tuple[str, bool]]:
    found = [(e.to, e.message) for e in effects if isinstance(e, Unicast)]
    return [(to, message.transferred) for to, message in found if isinstance(message, CandidateOffer)]


def hold_all(machine: LoopClosing, pair: CandidatePair) -> None:
    for end in (pair.low, pair.high):
        machine.on_held(end)
        machine.on_held(KeyframeId(end.log, end.index - 1))


def meet(robots: Robots, *names: str, keyframes: int = 4) -> None:
    """Each robot passes the same places, two metres apart."""
    for name in names:
        for k in range(keyframes):
            robots.capture(name, 2.0 * k, look=k)


def registrations(robots: Robots) -> list[CandidatePair]:
    return [e.pair for _, _, e in robots.done if isinstance(e, Register)]


def test_both_robots_agree_who_registers_a_pair_and_share_the_work() -> None:
    pairs = [CandidatePair.of(KeyframeId(R1, i), KeyframeId(R2, j)) for i in range(20) for j in range(20)]
    share = sum(registrar_of(pair) == R1 for pair in pairs) / len(pairs)
    assert 0.4 < share < 0.6


def test_a_pair_of_the_other_robot_is_offered_until_its_record_shows() -> None:
    machine, pair = closing(), pair_of(R2)
    machine.on_peer("r2", Peer(0))
    found(machine, pair)
    assert offers(machine.tick(0.0)) == [("r2", False)]
    assert machine.deadline() == OFFER_PERIOD_S
    assert offers(machine.tick(OFFER_PERIOD_S)) == [("r2", False)]
    machine.on_resolved(pair)
    assert machine.tick(100.0) == []


def test_an_own_pair_waits_for_its_latents_and_is_then_registered() -> None:
    machine, pair = closing(), pair_of(R1)
    machine.on_peer("r2", Peer(0))
    found(machine, pair)
    machine.on_held(pair.low)
    machine.on_held(KeyframeId(R1, pair.low.index - 1))
    assert machine.tick(0.0) == [FetchLatent(pair.high, "r2", PARAMETERS.fetch_timeout_s)]
    machine.on_held(pair.high)
    assert machine.tick(1.0) == [Register(pair, pair.low, pair.high, KeyframeId(R1, pair.low.index - 1), ONE)]


def test_the_most_similar_pair_comes_first() -> None:
    machine = closing(registrations_max=1)
    pairs = pairs_of(R1, 6)
    for k, pair in enumerate(pairs):
        found(machine, pair, similarity=0.5 + 0.01 * k)
        hold_all(machine, pair)
    started = [e.pair for e in machine.tick(0.0) if isinstance(e, Register)]
    assert started == [pairs[-1]]


def test_a_pair_is_handed_to_the_least_loaded_of_the_strongest_neighbours() -> None:
    machine = closing()
    for name, peer in (("s1", Peer(9, load=5)), ("s2", Peer(9, load=2)), ("r2", Peer(0))):
        machine.on_peer(name, peer)
    found(machine, pair_of(R1))
    assert offers(machine.tick(0.0)) == [("s2", True)]


def test_an_offer_of_the_other_owner_does_not_take_a_transferred_pair_back() -> None:
    machine, pair = closing(), pair_of(R1)
    machine.on_peer("s1", Peer(9))
    found(machine, pair)
    machine.on_offer(CandidateOffer((pair,)), 1.0)
    hold_all(machine, pair)
    assert [e for e in machine.tick(1.0) if isinstance(e, Register)] == []


def test_an_offered_pair_is_handed_on_to_a_stronger_neighbour_too() -> None:
    machine, pair = closing(), pair_of(R1)
    machine.on_peer("s1", Peer(9))
    machine.on_offer(CandidateOffer((pair,)), 0.0)
    assert offers(machine.tick(0.0)) == [("s1", True)]


def test_a_transferred_pair_is_taken_over_when_the_stronger_robot_is_gone() -> None:
    machine, pair = closing(), pair_of(R1)
    machine.on_peer("s1", Peer(9))
    found(machine, pair)
    machine.tick(0.0)
    hold_all(machine, pair)
    machine.on_lost("s1", 5.0)
    assert machine.tick(5.0) == []
    assert machine.deadline() == 5.0 + TAKEOVER_S
    assert [type(e) for e in machine.tick(machine.deadline())] == [Register]


def test_a_pair_that_is_taken_over_goes_to_another_stronger_robot() -> None:
    machine = closing()
    pair = pair_of(R1)
    hold_all(machine, pair)
    machine.on_peer("r8", Peer(9))
    found(machine, pair)
    machine.tick(0.0)
    machine.on_lost("r8", 1.0)
    machine.on_peer("r9", Peer(9))
    assert offers(machine.tick(1.0 + TAKEOVER_S)) == [("r9", True)]


def test_a_registrar_that_comes_back_in_time_keeps_its_pair() -> None:
    machine, pair = closing(), pair_of(R2)
    machine.on_peer("r2", Peer(0))
    found(machine, pair)
    machine.tick(0.0)
    hold_all(machine, pair)
    machine.on_lost("r2", 5.0)
    machine.tick(6.0)
    machine.on_peer("r2", Peer(0))
    assert offers(machine.tick(5.0 + TAKEOVER_S)) == [("r2", False)]


def test_a_registrar_that_comes_back_soon_is_not_told_the_same_again_at_once() -> None:
    machine, pair = closing(), pair_of(R2)
    machine.on_peer("r2", Peer(0))
    found(machine, pair)
    machine.tick(0.0)
    machine.on_lost("r2", 0.5)
    machine.tick(0.5)
    machine.on_peer("r2", Peer(0))
    assert machine.tick(1.0) == []
    assert machine.deadline() == OFFER_PERIOD_S


def test_pairs_of_a_log_whose_writer_lost_its_disk_are_taken_over_at_once() -> None:
    machine, pair = closing(), pair_of(R2)
    machine.on_peer("r2", Peer(0, log=R2))
    found(machine, pair)
    machine.tick(0.0)
    hold_all(machine, pair)
    machine.on_peer("r2", Peer(0, log=LogId("r2", 1)))
    assert [type(e) for e in machine.tick(1.0)] == [Register]


def test_an_offer_of_a_pair_that_is_neither_transferred_nor_own_is_ignored() -> None:
    machine, pair = closing(), pair_of(R2)
    machine.on_offer(CandidateOffer((pair,)), 0.0)
    assert machine.open_pairs() == []


def test_a_robot_that_comes_back_listens_before_it_decides_about_a_pair() -> None:
    machine = closing(listens_until_s=1.5)
    pair = pair_of(R1)
    hold_all(machine, pair)
    found(machine, pair)
    assert machine.tick(0.0) == []
    assert machine.deadline() == 1.5
    machine.on_peer("r9", Peer(9))
    assert offers(machine.tick(1.5)) == [("r9", True)]


def test_a_resolved_pair_is_never_taken_up_again() -> None:
    machine, pair = closing(), pair_of(R1)
    machine.on_resolved(pair)
    found(machine, pair)
    machine.on_offer(CandidateOffer((pair,), transferred=True), 0.0)
    assert machine.open_pairs() == []


def test_a_registration_without_an_answer_is_tried_again() -> None:
    machine, pair = closing(), pair_of(R1)
    found(machine, pair)
    hold_all(machine, pair)
    machine.tick(0.0)
    assert machine.deadline() == REGISTRATION_TIMEOUT_S
    for second in range(5, int(REGISTRATION_TIMEOUT_S), 5):
        assert machine.tick(float(second)) == []
    assert [type(e) for e in machine.tick(REGISTRATION_TIMEOUT_S)] == [Register]


def test_a_robot_that_slept_waits_for_the_registrations_that_slept_with_it() -> None:
    machine, pair = closing(), pair_of(R1)
    found(machine, pair)
    hold_all(machine, pair)
    machine.tick(0.0)
    assert machine.tick(5.0 + 3600.0) == []
    assert machine.deadline() == REGISTRATION_TIMEOUT_S + 3605.0


def test_the_least_similar_candidates_are_dropped_beyond_the_maximum() -> None:
    machine = closing(candidates_max=3)
    pairs = pairs_of(R1, 6)
    for k, pair in enumerate(pairs):
        found(machine, pair, similarity=0.1 * k)
    assert machine.open_pairs() == sorted(pairs[3:6])
    assert machine.dropped == 3


def test_where_a_log_has_one_keyframe_the_pair_is_registered_the_other_way_round() -> None:
    pair = CandidatePair.of(KeyframeId(R1, 0), KeyframeId(R2, 3))
    machine = LoopClosing(R1, 0, lambda k: None if k.log == R1 else (KeyframeId(R2, 2), ONE), PARAMETERS)
    machine.on_offer(CandidateOffer((pair,), transferred=True), 0.0)
    for k in ("r1/0", "r2/3", "r2/2"):
        machine.on_held(keyframe(k))
    assert machine.tick(0.0) == [Register(pair, keyframe("r2/3"), keyframe("r1/0"), keyframe("r2/2"), ONE)]


# Latents


def reach(**holds: tuple[KeyframeId, ...]) -> Reach:
    made = Reach()
    for name, held in holds.items():
        made.update(name, Peer(0, holds=held))
    return made


def test_a_failed_fetch_waits_longer_each_time_up_to_the_maximum() -> None:
    latents, wanted, now, pauses = Latents(R1, PARAMETERS), keyframe("r2/1"), 0.0, []
    for _ in range(7):
        assert len(latents.fetch([wanted], reach(r2=()), now)) == 1
        latents.on_failed(wanted, now)
        pauses.append(latents.due_s(now) - now)
        now = latents.due_s(now)
    assert pauses == [1.0, 2.0, 4.0, 8.0, 16.0, 16.0, 16.0]


def test_a_fetch_without_an_answer_is_given_up() -> None:
    latents, wanted = Latents(R1, PARAMETERS), keyframe("r2/1")
    latents.fetch([wanted], reach(r2=()), 0.0)
    latents.give_up(PARAMETERS.fetch_timeout_s)
    assert latents.due_s(PARAMETERS.fetch_timeout_s) == PARAMETERS.fetch_timeout_s + RETRY_S


def test_a_robot_that_comes_back_is_asked_at_once() -> None:
    latents, wanted = Latents(R1, PARAMETERS), keyframe("r2/1")
    latents.fetch([wanted], reach(r2=()), 0.0)
    latents.on_failed(wanted, 0.0)
    latents.on_reached("r2")
    assert len(latents.fetch([wanted], reach(r2=()), 0.1)) == 1


def test_what_a_lost_robot_was_to_deliver_is_fetched_elsewhere() -> None:
    latents, wanted = Latents(R1, PARAMETERS), keyframe("r3/1")
    latents.fetch([wanted], reach(r3=()), 0.0)
    latents.on_lost("r3")
    assert latents.fetch([wanted], reach(r2=(wanted,)), 3.0) == [FetchLatent(wanted, "r2", PARAMETERS.fetch_timeout_s)]


def test_no_more_fetches_than_allowed_are_in_flight() -> None:
    latents, wanted = Latents(R1, PARAMETERS), [keyframe(f"r2/{k}") for k in range(9)]
    assert len(latents.fetch(wanted, reach(r2=()), 0.0)) == PARAMETERS.fetches_max
    assert latents.fetch(wanted, reach(r2=()), 0.1) == []


def test_a_latent_out_of_reach_is_asked_of_relays_and_fetched_from_one() -> None:
    latents, wanted = Latents(R1, PARAMETERS), keyframe("r3/1")
    assert latents.fetch([wanted], reach(r2=()), 0.0) == []
    assert latents.wants([wanted], reach(r2=()), 0.0) == (wanted,)
    assert latents.fetch([wanted], reach(r2=(wanted,)), 1.0) == [FetchLatent(wanted, "r2", PARAMETERS.fetch_timeout_s)]


def test_wishes_that_nobody_can_grant_do_not_keep_others_waiting() -> None:
    latents, needed = Latents(R1, PARAMETERS), [keyframe(f"r3/{k}") for k in range(20)]
    turns = {wish for t in range(0, 40, 5) for wish in latents.wants(needed, reach(r2=()), float(t))}
    assert turns == set(needed)


def test_a_holder_that_served_a_false_latent_is_asked_again_only_when_it_comes_back() -> None:
    wanted, holds = keyframe("r3/1"), Peer(0, holds=(keyframe("r3/1"), keyframe("r3/2")))
    around = reach(r2=holds.holds, r4=holds.holds)
    around.on_false("r2", wanted)
    around.update("r2", holds)
    assert (around.holder(wanted), around.holder(keyframe("r3/2"))) == ("r4", "r2")
    around.on_false("r4", wanted)
    assert Latents(R1, PARAMETERS).wants([wanted], around, 0.0) == (wanted,)
    around.remove("r2")
    around.update("r2", holds)
    assert around.holder(wanted) == "r2"


def test_a_latent_is_asked_of_its_owner_whatever_it_served() -> None:
    around = reach(r2=())
    around.on_false("r2", keyframe("r2/1"))
    assert around.holder(keyframe("r2/1")) == "r2"


def test_what_neighbours_want_is_kept_up_to_a_maximum() -> None:
    latents = Latents(R1, PARAMETERS)
    for k in range(50):
        latents.on_wants("r2", [keyframe(f"r3/{k}")], float(k))
        latents.add(keyframe(f"r3/{k}"))
    assert latents.holds(49.0) == tuple(keyframe(f"r3/{k}") for k in range(50 - RELAYS_MAX, 50))


def test_wishes_have_their_turns_although_some_are_granted_meanwhile() -> None:
    latents, needed = Latents(R1, PARAMETERS), [keyframe(f"r3/{k}") for k in range(40)]
    wished: set[KeyframeId] = set()
    for turn in range(5):
        wishes = latents.wants(needed[turn:], reach(r2=()), turn * WANTS_TURN_S)  # the first ones come, one a turn
        assert not wished & set(wishes)
        wished |= set(wishes)
    assert wished == set(needed)


def test_what_is_wished_for_still_is_wished_for_until_its_turn_is_over() -> None:
    latents, needed = Latents(R1, PARAMETERS), [keyframe(f"r3/{k}") for k in range(20)]
    first = latents.wants(needed, reach(r2=()), 0.0)
    assert latents.wants(needed, reach(r2=()), 0.5, first[1:]) == (*first[1:], needed[8])


def test_what_came_for_a_neighbour_is_held_however_many_others_are_wished_for() -> None:
    latents, came = Latents(R1, PARAMETERS), keyframe("r3/0")
    latents.on_wants("r2", [came], 0.0)
    latents.add(came)
    for k in range(1, 100):
        latents.on_wants("r2", [keyframe(f"r3/{k}")], 0.0)
    assert latents.holds(0.0) == (came,)
    assert latents.sizes()["relayed"] == (RELAYS_MAX, RELAYS_MAX)
    for k in range(1, 100):
        latents.on_wants("r2", [keyframe(f"r3/{k}")], WANTS_TURN_S)
    assert latents.holds(WANTS_TURN_S) == ()


def test_what_is_held_for_a_robot_is_told_until_it_must_have_heard_and_again_when_it_comes_back() -> None:
    latents, wanted = Latents(R1, PARAMETERS), keyframe("r3/0")
    latents.on_wants("r2", [wanted], 0.0)
    assert latents.holds(100.0) == ()
    latents.add(wanted)
    told = {now: latents.holds(now) for now in (200.0, 200.0 + OFFERED_S - 0.1, 200.0 + OFFERED_S)}
    assert list(told.values()) == [(wanted,), (wanted,), ()]
    latents.on_reached("r4")
    assert latents.holds(300.0) == ()
    latents.on_reached("r2")
    assert (latents.holds(300.0), latents.holds(300.0 + OFFERED_S)) == ((wanted,), ())
    latents.on_wants("r4", [wanted], 400.0)
    assert latents.holds(400.0) == (wanted,)
    for takes_away in (latents.remove, latents.on_withdrawn):
        latents.add(wanted)
        assert latents.holds(400.0) == (wanted,)
        takes_away(wanted)
        assert latents.holds(400.1) == ()


def test_a_wish_is_told_now_and_then_and_all_of_them_to_whoever_comes_into_range() -> None:
    machine, pairs = closing(), pairs_of(R1, 2)
    for pair in pairs:
        found(machine, pair, 0.5)
    machine.on_peer("r4", Peer(0))
    first = machine.wants(0.0)
    assert first == (KeyframeId(R2, 1),)
    assert machine.wants(TOLD_AGAIN_S / 2) == ()
    machine.on_peer("r4", Peer(0))
    assert machine.wants(TOLD_AGAIN_S / 2) == ()
    machine.on_peer("r5", Peer(0))
    assert machine.wants(TOLD_AGAIN_S / 2) == first
    assert machine.wants(TOLD_AGAIN_S) == ()
    assert machine.wants(1.5 * TOLD_AGAIN_S) == first


def test_an_offer_is_told_now_and_then_and_counts_meanwhile_for_who_heard_it() -> None:
    machine, hears, held = closing(), closing(own=R2), keyframe("r3/0")
    machine.on_wants("r2", [held], 0.0)
    machine.on_held(held)
    told = [machine.holds(0.5 * k) for k in range(8)]
    assert [k for k, each in enumerate(told) if each] == [0, 5]
    heard = [hears.held_by("r1", each, 0.5 * k) for k, each in enumerate(told)]
    assert heard == [(held,)] * 8
    machine.on_peer("r4", Peer(0))
    assert machine.holds(4.0) == (held,)
    assert hears.held_by("r1", (), 2.5 + HEARD_S - 0.1) == (held,)
    assert hears.held_by("r1", (), 2.5 + HEARD_S) == ()


def test_what_a_robot_says_to_hold_is_remembered_up_to_a_maximum_and_while_it_is_in_range() -> None:
    machine, many = closing(), [keyframe(f"r3/{k}") for k in range(3 * RELAYS_MAX)]
    assert [machine.held_by("r2", [each], 0.0) for each in many][-1] == tuple(many[-RELAYS_MAX:])
    machine.on_peer("r2", Peer(0))
    machine.on_lost("r2", 0.1)
    assert machine.held_by("r2", (), 0.2) == ()


def handed(machine: LoopClosing, now: float) -> list[CandidatePair]:
    told = [effect.message for effect in machine.tick(now) if isinstance(effect, Unicast) and effect.to == "server"]
    return [pair for message in told if isinstance(message, CandidateOffer) for pair in message.pairs]


def test_a_stronger_robot_is_handed_its_share_of_what_it_has_room_for_the_most_similar_first() -> None:
    machine, pairs = closing(), pairs_of(R1, 5)
    machine.on_peer("server", Peer(9, load=BACKLOG_MAX - 4))
    machine.on_peer("r2", Peer(0))
    for k, pair in enumerate(pairs):
        found(machine, pair, 0.5 + 0.1 * k)
    assert handed(machine, 0.0) == [pairs[4], pairs[3]]
    assert handed(machine, 0.3) == []
    machine.on_peer("server", Peer(9, load=BACKLOG_MAX - 4))
    assert handed(machine, 0.6) == [pairs[2], pairs[1]]
    assert handed(machine, OFFER_PERIOD_S) == sorted([pairs[4], pairs[3]])


def test_while_a_stronger_robot_has_more_than_enough_to_do_others_help() -> None:
    machine, pairs = closing(), pairs_of(R1, 5)
    for k in range(100):
        machine.on_held(KeyframeId(R1, k))
    machine.on_peer("server", Peer(9, load=BACKLOG_MAX))
    machine.on_peer("r2", Peer(0))
    for k, pair in enumerate(pairs):
        found(machine, pair, 0.5 + 0.1 * k)
    helped = PARAMETERS.registrations_max + PARAMETERS.fetches_max
    effects = machine.tick(0.0)
    assert offers(effects) == []
    assert [effect.keyframe for effect in effects if isinstance(effect, FetchLatent)] == [keyframe("r2/1")]
    assert machine.load == helped
    machine.on_peer("server", Peer(9, load=0))
    assert handed(machine, 0.5) == [pairs[1], pairs[0]]


def test_what_nobody_in_range_can_give_is_left_to_the_stronger_robot() -> None:
    machine = closing()
    machine.on_peer("server", Peer(9, load=BACKLOG_MAX))
    found(machine, pair_of(R1))
    assert machine.tick(0.0) == []
    assert machine.load == 0
    assert len(machine.open_pairs()) == 1


def test_a_robot_that_begins_hands_on_what_it_may_have_handed_on_before() -> None:
    machine = closing(listens_until_s=1.0)
    machine.on_peer("server", Peer(9, load=BACKLOG_MAX))
    machine.on_peer("r2", Peer(0))
    found(machine, pair_of(R1))
    assert handed(machine, 1.0) == [pair_of(R1)]


def test_pairs_that_a_stronger_robot_was_not_told_of_do_not_wait_for_it_when_it_is_gone() -> None:
    machine = closing()
    machine.on_peer("server", Peer(9, load=BACKLOG_MAX))
    found(machine, pair_of(R1))
    machine.tick(0.0)
    machine.on_lost("server", 1.0)
    machine.on_peer("r2", Peer(0))
    assert [effect.keyframe for effect in machine.tick(1.0) if isinstance(effect, FetchLatent)] == [keyframe("r2/1")]


# Whole robots


def two_and_a_server() -> Robots:
    robots = Robots()
    for name in ("r1", "r2"):
        robots.add(name)
    robots.add("server", compute_class=9)
    return robots


def all_but_the_server(_: Robots, name: str, effect: Effect) -> Event | None:
    """The server registers nothing."""
    return None if name == "server" and isinstance(effect, Register) else answer(effect)


def test_a_server_that_answers_nothing_does_not_keep_the_others_from_closing_loops(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(latents, "BACKLOG_MAX", 2)
    robots = two_and_a_server()
    robots.run(30.0)
    robots.work = all_but_the_server
    meet(robots, "r1", "r2", keyframes=16)
    robots.run(30.0)
    by = Counter(name for _, name, effect in robots.done if isinstance(effect, Register))
    assert by["server"] == 1
    assert by["r1"] + by["r2"] >= 8
    assert len(registrations(robots)) == len(set(registrations(robots)))


def test_every_pair_is_registered_once() -> None:
    robots = Robots()
    for name in ("r1", "r2", "r3"):
        robots.add(name)
    meet(robots, "r1", "r2", "r3")
    robots.run(30.0)
    pairs = registrations(robots)
    assert len(pairs) == len(set(pairs)) == 12
    assert all(core.closing.open_pairs() == [] for core in robots.cores.values())


def test_a_server_without_a_camera_registers_for_the_others() -> None:
    robots = two_and_a_server()
    robots.run(3.0)
    meet(robots, "r1", "r2")
    robots.run(30.0)
    by = {name for _, name, effect in robots.done if isinstance(effect, Register)}
    assert by == {"server"}
    assert len(registrations(robots)) == 4


def test_pairs_of_a_server_that_dies_are_taken_over() -> None:
    robots = two_and_a_server()
    robots.run(3.0)
    robots.work = all_but_the_server
    meet(robots, "r1", "r2")
    robots.run(4.0)
    robots.kill("server")
    robots.run(40.0)
    assert robots.cores["r1"].assembly.closures == 4


def test_closures_join_robots_that_never_meet() -> None:
    robots = Robots()
    for name in ("r1", "r2", "r3"):
        robots.add(name)
    robots.separate("r1", "r3")
    meet(robots, "r1", "r3")
    robots.run(90.0)
    assert robots.cores["r2"].assembly.closures == 4
    assert robots.frames() == {"r1": "map/r1", "r3": "map/r1"}


def test_a_latent_that_its_owner_lost_rejects_its_pairs_for_everybody() -> None:
    def work(robots: Robots, name: str, effect: Effect) -> Event | None:
        if isinstance(effect, FetchLatent):
            return LatentFetchFailed(effect.keyframe, effect.holder, LATENT_UNKNOWN)
        return answer(effect)

    robots = Robots(work=work)
    for name in ("r1", "r2"):
        robots.add(name)
    meet(robots, "r1", "r2")
    robots.run(30.0)
    assert registrations(robots) == []
    assert all(core.closing.open_pairs() == [] for core in robots.cores.values())
    reasons = {
        record.reason
        for log in robots.cores["r1"].gossip.logs.values()
        for record in log.records
        if isinstance(record, RejectionRecord)
    }
    assert reasons == {"a latent was lost"}


def test_a_lost_latent_is_known_to_robots_that_only_hear_the_owner_through_others() -> None:
    def work(robots: Robots, name: str, effect: Effect) -> Event | None:
        if isinstance(effect, FetchLatent) and effect.keyframe.log == R1:
            return LatentFetchFailed(effect.keyframe, effect.holder, LATENT_UNKNOWN)
        return answer(effect)

    robots = Robots(work=work)
    for name in ("r1", "r2", "r3", "r4"):
        robots.add(name)
    robots.separate("r1", "r3 r4")
    robots.cut.add(frozenset(("r2", "r4")))
    meet(robots, "r1", "r4")
    robots.run(60.0)
    assert all(core.closing.open_pairs() == [] for core in robots.cores.values())
    assert {fact.reason for fact in robots.facts("r4", ClosureRejected)} == {"a latent was lost"}
    robots.run(60.0)
    assert all(core.closing.lost(robots.now_s) == () for core in robots.cores.values())


def test_a_relay_that_serves_false_latents_keeps_no_closure_back() -> None:
    def work(robots: Robots, name: str, effect: Effect) -> Event | None:
        if isinstance(effect, FetchLatent) and effect.holder == "r2" and effect.keyframe.log.robot != "r2":
            return LatentFetchFailed(effect.keyframe, effect.holder, LATENT_FALSE)
        return answer(effect)

    robots = Robots(work=work)
    for name in ("r1", "r2", "r3", "r4"):
        robots.add(name)
    robots.separate("r1", "r4")
    meet(robots, "r1", "r4")
    robots.run(60.0)
    assert robots.cores["r3"].assembly.closures == 4
    false = [fact.keyframe for fact in robots.facts("r4", LatentFailed) if fact.holder == "r2"]
    assert len(false) == len(set(false)) > 0


def test_an_own_latent_that_the_store_evicted_rejects_its_pair() -> None:
    def work(robots: Robots, name: str, effect: Effect) -> Event | None:
        if isinstance(effect, Register):
            return LatentMissing(effect.pair, effect.query)
        return answer(effect)

    robots = Robots(work=work)
    for name in ("r1", "r2"):
        robots.add(name)
    meet(robots, "r1", "r2")
    robots.run(30.0)
    assert all(core.closing.open_pairs() == [] for core in robots.cores.values())


def test_an_own_latent_that_the_disk_did_not_bring_back_rejects_its_pairs() -> None:
    machine = closing()
    pair = pair_of(R1)
    machine.on_held(pair.high)
    found(machine, pair)
    assert machine.own_lost() == [KeyframeId(R1, pair.low.index - 1), pair.low]
    assert machine.on_latent_lost(pair.low, 0.0) == [pair]


def test_an_evicted_latent_of_another_robot_is_fetched_again() -> None:
    evicted: list[KeyframeId] = []

    def work(robots: Robots, name: str, effect: Effect) -> Event | None:
        if isinstance(effect, Register) and not evicted:
            evicted.append(effect.match)
            return LatentMissing(effect.pair, effect.match)
        return answer(effect)

    robots = Robots(work=work)
    for name in ("r1", "r2"):
        robots.add(name)
    meet(robots, "r1", "r2")
    robots.run(30.0)
    fetched = [e.keyframe for _, _, e in robots.done if isinstance(e, FetchLatent)]
    assert fetched.count(evicted[0]) == 2
    assert robots.cores["r1"].assembly.closures == 4


def test_a_keyframe_that_cannot_be_encoded_still_carries_odometry() -> None:
    def work(robots: Robots, name: str, effect: Effect) -> Event | None:
        if isinstance(effect, Encode) and effect.keyframe == keyframe("r1/1"):
            return KeyframeEncodingFailed(effect.keyframe, "damaged image")
        return answer(effect)

    robots = Robots(work=work)
    for name in ("r1", "r2"):
        robots.add(name)
    meet(robots, "r1", "r2")
    robots.run(30.0)
    assert robots.cores["r2"].gossip.logs[R1].keyframes == 4
    assert robots.cores["r2"].assembly.closures == 3


def test_a_result_for_a_pair_that_another_robot_resolved_is_not_recorded_again() -> None:
    robots = Robots()
    for name in ("r1", "r2"):
        robots.add(name)
    meet(robots, "r1", "r2", keyframes=2)
    robots.run(20.0)
    done = next(e for _, name, e in robots.done if isinstance(e, Register) and name == "r1")
    before = len(robots.cores["r1"].gossip.logs[R1])
    event = answer(done)
    assert event is not None
    robots.put("r1", event)
    assert len(robots.cores["r1"].gossip.logs[R1]) == before


def test_a_few_pairs_are_asked_for_at_a_time_each_once_and_before_all_others() -> None:
    machine = closing()
    asked = [Candidate(pair, 0.2) for pair in pairs_of(R1, 6)]
    (other,) = set(pairs_of(R1, 7)) - {candidate.pair for candidate in asked}
    machine.on_candidates([Candidate(other, 0.9)], 0.0)
    assert len(machine.on_asked(asked, 0.0)) == 4
    assert machine.on_asked(asked, 0.0) == []
    assert [work.pair for work in machine._work] == [*(c.pair for c in asked[:4]), other]
    machine.on_rejection(asked[0].pair, "a latent was lost", was_seen=False)
    assert len(machine.on_asked(asked, 0.0)) == 1
    machine.on_closure(asked[1].pair, 0.0)
    assert len(machine.on_asked(asked, 0.0)) == 1
    assert machine.on_asked(asked, 0.0) == []
