"""Bully election with terms, over several hops."""

import random
from dataclasses import replace

import pytest
from tests.agent.core.virtual_time import Robots

from flocc_agent.core.effects import Broadcast, Effect, PersistTerm, Report, Unicast
from flocc_agent.core.election import (
    ANSWER_TIMEOUT_S,
    COUNTER_JUMP_MAX,
    FORGOTTEN_S,
    RISE_MAX,
    RISE_PER_S,
    TRANSITIONS,
    LeaderElection,
    Role,
    Turn,
)
from flocc_agent.core.events import Leaving, MessageReceived
from flocc_agent.core.parameters import CoreParameters, ElectionParameters
from flocc_agent.core.reports import PeerRefused
from flocc_agent.core.restored import Restored
from flocc_protocol.ids import TERM_COUNTER_MAX, LogId, Term
from flocc_protocol.messages import Answer, Coordinator, Election, Envelope, Handover, Heartbeat, LeaderAdvert

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")


def heartbeat(leader: LeaderAdvert | None = None, counter: int = 0, compute_class: int = 0) -> Heartbeat:
    return Heartbeat(1, 7, compute_class, leader, counter, 0)


def election(own: LogId = R2, counter: int = 0) -> LeaderElection:
    return LeaderElection(own, 0, counter, ElectionParameters(), 0.0)


def claims(effects: list[Effect]) -> list[Term]:
    return [e.message.advert.term for e in effects if isinstance(e, Broadcast) and isinstance(e.message, Coordinator)]


def test_a_robot_alone_leads_after_listening() -> None:
    robots = Robots()
    robots.add("r1")
    robots.run(1.4)
    assert robots.leaders() == {"r1": "None"}
    robots.run(0.2)
    assert robots.leaders() == {"r1": "1:r1"}


def test_the_lowest_log_of_one_class_leads() -> None:
    robots = Robots()
    for name in ("r3", "r1", "r2"):
        robots.add(name)
    robots.run(6.0)
    assert set(robots.leaders().values()) == {"1:r1"}


def test_a_higher_compute_class_outranks_a_lower_log() -> None:
    robots = Robots()
    robots.add("r1")
    robots.add("server", compute_class=9)
    robots.run(6.0)
    assert {term.split(":")[1] for term in robots.leaders().values()} == {"server"}


def test_a_compute_class_that_the_list_of_members_does_not_know_outranks_nobody() -> None:
    machine = LeaderElection(R2, 0, 0, ElectionParameters(), 0.0, {"server": 9})
    machine.on_heartbeat(R3, heartbeat(LeaderAdvert(Term(1, R3), 9, 1, 0), 1, compute_class=9), 1.0)
    assert claims(machine.tick(2.0)) == [Term(2, R2)]
    server = LogId("server")
    machine.on_heartbeat(server, heartbeat(LeaderAdvert(Term(3, server), 0, 1, 0), 3), 3.0)
    assert machine.term == Term(3, server)


def test_a_leader_that_is_not_believed_is_not_followed() -> None:
    machine = election(R2)
    machine.on_coordinator(R1, Coordinator(LeaderAdvert(Term(1, R1), 0, 0, 0)), 0.0)
    machine.on_distrusted("r3", 1.0)
    assert machine.term == Term(1, R1)
    machine.on_distrusted("r1", 1.0)
    machine.tick(1.0 + ANSWER_TIMEOUT_S)
    assert machine.term == Term(2, R2)


def test_a_leader_claims_anew_when_somebody_speaks_in_its_term() -> None:
    machine = election(R2)
    assert claims(machine.tick(2.0)) == [Term(1, R2)]
    machine.on_applied(R3, Term(1, R2), 2.0)
    assert claims(machine.tick(2.1)) == [Term(2, R2)]


def test_a_flood_of_claims_raises_the_counter_slowly() -> None:
    """A robot that was away learns what is left of an hour of it within little more."""
    machine, rogue, counter = election(R2, counter=5), LogId("r9"), 5
    for tick in range(36_000):
        counter = machine.counter_max + COUNTER_JUMP_MAX
        machine.on_coordinator(rogue, Coordinator(LeaderAdvert(Term(counter, rogue), 0, tick, 0)), 0.1 * tick)
    assert machine.counter_max < RISE_MAX + 1.1 * 3600.0 * RISE_PER_S
    returned, away_s = election(R3, counter=5), 0.0
    while returned.counter_max < machine.counter_max and away_s < 4000.0:
        away_s += 0.5
        returned.on_heartbeat(R2, heartbeat(LeaderAdvert(Term(machine.counter_max, R2), 0, int(2 * away_s), 0)), away_s)
    assert returned.counter_max == machine.counter_max


def test_a_better_robot_that_comes_later_takes_over() -> None:
    robots = Robots()
    robots.add("r2")
    robots.run(3.0)
    robots.add("r1")
    robots.run(4.0)
    assert robots.leaders() == {"r1": "2:r1", "r2": "2:r1"}


def test_the_next_best_follows_a_killed_leader_within_two_timeouts() -> None:
    robots = Robots()
    for name in ("r1", "r2", "r3"):
        robots.add(name)
    robots.run(6.0)
    robots.kill("r1")
    robots.run(6.0)
    assert robots.leaders() == {"r2": "2:r2", "r3": "2:r2"}


def test_a_leader_that_leaves_in_order_is_followed_at_once() -> None:
    robots = Robots()
    for name in ("r1", "r2", "r3"):
        robots.add(name)
    robots.run(6.0)
    robots.put("r1", Leaving())
    robots.kill("r1")
    robots.run(1.5)
    assert robots.leaders() == {"r2": "2:r2", "r3": "2:r2"}


def test_a_chain_of_robots_follows_one_leader() -> None:
    robots = Robots()
    names = [f"r{k}" for k in range(1, 6)]
    for name in names:
        robots.add(name)
    robots.cut = {frozenset((a, b)) for i, a in enumerate(names) for b in names[i + 2 :]}
    robots.run(20.0)
    assert {term.split(":")[1] for term in robots.leaders().values()} == {"r1"}
    assert len(set(robots.leaders().values())) == 1


def test_a_chain_notices_that_a_far_leader_died() -> None:
    robots = Robots()
    names = ["r1", "r2", "r3", "r4"]
    for name in names:
        robots.add(name)
    robots.cut = {frozenset((a, b)) for i, a in enumerate(names) for b in names[i + 2 :]}
    robots.run(15.0)
    robots.kill("r1")
    robots.run(20.0)
    assert len(set(robots.leaders().values())) == 1
    assert robots.leaders()["r4"].endswith(":r2")


def test_a_stale_advert_is_not_followed_twice() -> None:
    machine = election(R3)
    ghost = LeaderAdvert(Term(5, R1), 0, beat=9, hops=1)
    machine.on_heartbeat(R2, heartbeat(ghost, 5), 0.0)
    assert machine.term == Term(5, R1)
    machine.tick(3.0)
    machine.on_heartbeat(R2, heartbeat(ghost, 5), 3.1)
    assert machine.term != Term(5, R1)


def test_a_lost_leader_counts_again_when_its_beat_grows() -> None:
    machine = election(R3)
    machine.on_heartbeat(R2, heartbeat(LeaderAdvert(Term(5, R1), 0, 9, 1), 5), 0.0)
    machine.tick(3.0)
    machine.on_heartbeat(R2, heartbeat(LeaderAdvert(Term(5, R1), 0, 10, 1), 5), 3.1)
    assert machine.term == Term(5, R1)


def test_whoever_elects_follows_and_advertises_nobody() -> None:
    machine = election(R3)
    machine.on_heartbeat(R2, heartbeat(LeaderAdvert(Term(5, R1), 0, 9, 0), 5), 0.0)
    machine.tick(3.0)
    assert machine.role is Role.ELECTING
    assert machine.advert() is None


def test_a_follower_answers_an_election_without_starting_its_own() -> None:
    machine = election(R2)
    machine.on_heartbeat(R1, heartbeat(LeaderAdvert(Term(5, R1), 0, 9, 0), 5), 0.0)
    machine.on_heartbeat(R3, heartbeat(), 0.0)
    assert machine.on_election(R3, 0.1) == [Unicast("r3", Answer(5))]
    assert machine.term == Term(5, R1)


def test_an_election_of_a_better_robot_is_not_answered() -> None:
    machine = election(R2)
    machine.on_heartbeat(R1, heartbeat(), 0.0)
    assert machine.on_election(R1, 0.1) == []


def test_a_robot_asks_those_who_outrank_it_before_it_claims() -> None:
    machine = election(R2)
    machine.on_heartbeat(R1, heartbeat(), 0.0)
    assert machine.tick(1.5) == [Unicast("r1", Election(0))]
    assert claims(machine.tick(1.5 + ANSWER_TIMEOUT_S)) == [Term(1, R2)]


def test_an_answer_makes_a_robot_wait_and_ask_again() -> None:
    machine = election(R2)
    machine.on_heartbeat(R1, heartbeat(), 0.0)
    machine.tick(1.5)
    machine.on_answer(R1, 1.6)
    assert machine.role is Role.WAITING
    assert machine.tick(3.6) == [Unicast("r1", Election(0))]


def leads(log: LogId, counter: int, beat: int = 1) -> Heartbeat:
    """What a leader says of itself."""
    return heartbeat(LeaderAdvert(Term(counter, log), 0, beat, hops=0), counter)


def test_a_claim_is_above_every_counter_that_is_used() -> None:
    machine = election(R1)
    machine.on_heartbeat(R2, leads(R2, 41), 0.0)
    assert claims(machine.tick(1.5)) == [Term(42, R1)]


def test_what_a_robot_says_of_others_counters_changes_nothing() -> None:
    machine = election(R1)
    machine.on_heartbeat(R2, heartbeat(None, counter=41), 0.0)
    machine.on_heartbeat(R2, heartbeat(LeaderAdvert(Term(77, R3), 0, 1, hops=0), 77), 0.1)
    assert claims(machine.tick(1.5)) == [Term(1, R1)]


def test_a_claim_is_persisted_before_it_is_announced() -> None:
    machine = election(R1)
    kinds = [type(effect) for effect in machine.tick(1.5)]
    assert kinds.index(PersistTerm) < kinds.index(Broadcast)


def test_a_restarted_leader_claims_a_counter_above_its_last() -> None:
    machine = election(R1, counter=Restored(term_counter=7).counter_max())
    assert claims(machine.tick(1.5)) == [Term(8, R1)]


def test_a_leader_claims_anew_when_another_leads_with_a_higher_counter() -> None:
    machine = election(R1)
    machine.tick(1.5)
    assert claims(machine.on_heartbeat(R2, leads(R2, 9), 2.0)) == [Term(10, R1)]


def test_a_leader_claims_anew_when_others_applied_an_equal_counter_of_another() -> None:
    machine = election(R1)
    machine.tick(1.5)
    assert machine.on_applied(R3, Term(1, R3), 0.0) == []
    assert machine.deadline() <= 2.0
    assert claims(machine.tick(2.0)) == [Term(2, R1)]
    assert machine.deadline() == float("inf")


def test_nobody_claims_a_term_for_another() -> None:
    machine = election(R3)
    refused = machine.on_coordinator(R2, Coordinator(LeaderAdvert(Term(5, R1), 0, 1, 0)), 0.0)
    assert [type(effect) for effect in refused] == [Report]
    assert machine.term is None


@pytest.mark.parametrize("message", [leads(R2, TERM_COUNTER_MAX), Coordinator(LeaderAdvert(Term(2**40, R2), 0, 1, 0))])
def test_one_claim_raises_the_counter_by_so_much_at_most(message: Heartbeat | Coordinator) -> None:
    machine = election(R1, counter=5)
    hear = machine.on_heartbeat if isinstance(message, Heartbeat) else machine.on_coordinator
    told = hear(R2, message, 0.0)  # type: ignore[arg-type]
    assert [effect.fact for effect in told if isinstance(effect, Report)] == [
        PeerRefused(peer="r2", reason="a term counter far above all others")
    ]
    assert machine.counter_max == 5 + COUNTER_JUMP_MAX


def test_a_robot_without_history_takes_the_counter_as_it_is() -> None:
    machine = election(R1)
    assert Report not in map(type, machine.on_heartbeat(R2, leads(R2, 60_000), 0.0))
    assert claims(machine.tick(1.5)) == [Term(60_001, R1)]


def test_a_robot_that_was_away_for_many_terms_learns_of_them_step_by_step() -> None:
    machine = election(R1, counter=5)
    for beat in range(4):
        machine.on_heartbeat(R2, leads(R2, 5 + 3 * COUNTER_JUMP_MAX, beat), 0.1 * beat)
    assert machine.counter_max == 5 + 3 * COUNTER_JUMP_MAX
    assert claims(machine.tick(1.5)) == [Term(6 + 3 * COUNTER_JUMP_MAX, R1)]


def test_heartbeats_with_huge_counters_shut_nobody_out() -> None:
    robots = Robots()
    for name in ("r1", "r2"):
        robots.add(name)
    robots.run(4.0)
    liar = LogId("r9")
    for k in range(1, 4):
        for name in ("r1", "r2"):
            robots.put(name, MessageReceived(Envelope(liar, replace(heartbeat(counter=k * 1_000_000), sequence=k))))
    robots.add("r3")
    robots.run(6.0)
    assert robots.leaders() == dict.fromkeys(("r1", "r2", "r3"), "1:r1")


def test_what_was_claimed_and_never_followed_is_forgotten_after_an_hour() -> None:
    """The rogue is outranked, so that its terms are no one's; those of the leader stay known."""
    machine, rogue = election(R2, counter=5), LogId("r9")
    for step in range(1, 4):
        machine.on_coordinator(rogue, Coordinator(LeaderAdvert(Term(50_000, rogue), 0, step, 0)), float(step))
    machine.on_heartbeat(R1, heartbeat(LeaderAdvert(Term(7, R1), 0, 1, 0), 7), 4.0)
    assert machine.counter_max > 3000
    machine.on_heartbeat(R1, heartbeat(LeaderAdvert(Term(7, R1), 0, 2, 0), 7), 3.0 + FORGOTTEN_S - 1.0)
    assert machine.counter_max > 3000
    machine.on_heartbeat(R1, heartbeat(LeaderAdvert(Term(7, R1), 0, 3, 0), 7), 3.0 + FORGOTTEN_S)
    assert machine.counter_max == 7


def test_no_leader_is_followed_beyond_the_greatest_number_of_hops() -> None:
    machine = election(R3)
    machine.on_heartbeat(R2, heartbeat(LeaderAdvert(Term(5, R1), 0, 1, hops=8), 5), 0.0)
    assert machine.term is None


def test_two_groups_that_merge_agree_on_a_term_above_both() -> None:
    robots = Robots()
    for name in ("r1", "r2", "r3", "r4"):
        robots.add(name)
    robots.separate("r1 r2", "r3 r4")
    robots.run(6.0)
    robots.cores["r3"].election.on_applied(LogId("r4"), Term(5, LogId("r3")), 0.0)
    robots.run(1.0)
    robots.separate()
    robots.run(5.0)
    assert set(robots.leaders().values()) == {"7:r1"}


def test_robots_beyond_the_greatest_number_of_hops_follow_nobody_and_are_corrected_all_the_same() -> None:
    robots = Robots(CoreParameters(election=ElectionParameters(hops_max=2)))
    names = ["r1", "r2", "r3", "r4", "r5"]
    for k, name in enumerate(names):
        robots.add(name)
        robots.capture(name, 0.0, look=k)
    robots.cut = {frozenset((a, b)) for i, a in enumerate(names) for b in names[i + 2 :]}
    robots.run(30.0)
    assert robots.leaders() == {"r1": "1:r1", "r2": "1:r1", "r3": "1:r1", "r4": "None", "r5": "None"}
    assert set(robots.frames()) == set(names)


def test_the_table_says_every_transition_that_happens_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: set[tuple[Role, Turn, Role]] = set()
    turn = LeaderElection._turn

    def noted(self: LeaderElection, what: Turn, due_s: float) -> None:
        before = self.role
        turn(self, what, due_s)
        taken.add((before, what, self.role))

    monkeypatch.setattr(LeaderElection, "_turn", noted)
    for seed in range(200):
        _live(random.Random(seed))
    stated = {(role, what, after) for role, turns in TRANSITIONS.items() for what, after in turns.items()}
    assert taken == stated


def _live(draw: random.Random) -> None:
    """Push anything at one robot, in any order."""
    robot, now = election(draw.choice((R1, R2, R3))), 0.0
    for beat in range(60):
        now += draw.choice((0.0, 0.3, 2.0))
        sender = draw.choice([log for log in (R1, R2, R3) if log != robot._own])
        counter = draw.randrange(8)
        advert = LeaderAdvert(Term(counter, sender), 0, beat, 0)
        match draw.randrange(8):
            case 0:
                robot.on_heartbeat(sender, heartbeat(draw.choice((None, advert)), counter), now)
            case 1:
                robot.on_coordinator(sender, Coordinator(advert), now)
            case 2:
                robot.on_election(sender, now)
            case 3:
                robot.on_answer(sender, now)
            case 4:
                robot.on_handover(sender, Handover(robot.term or advert.term), now)
            case 5:
                robot.on_lost(sender.robot)
            case 6 if draw.random() < 0.2:
                robot.leave()
            case _:
                robot.tick(now)
