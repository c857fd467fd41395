"""Optimisation rounds and the graph they are about."""

import numpy as np
import pytest
from tests.agent.core.virtual_time import Robots, answer, descriptor, keyframe

from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.effects import Effect, Optimise, Report
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.measurements import OdometryCovariance
from flocc_agent.core.parameters import RoundParameters
from flocc_agent.core.pose_graph import GraphSolution
from flocc_agent.core.reports import RoundTimedOut
from flocc_agent.core.rounds import (
    GRAPH_KEPT_S,
    KEYFRAMES_PER_ROUND,
    PATIENCE_S,
    PERIOD_PER_KEYFRAME_S,
    TIMEOUT_S,
    Rounds,
)
from flocc_protocol.ids import LogId, Term
from flocc_protocol.records import ClosureRecord, KeyframeRecord

R1, R2 = LogId("r1"), LogId("r2")
TERM = Term(1, R1)
SOLUTION = GraphSolution((), ())
PARAMETERS = RoundParameters()


def add_keyframes(assembly: GraphAssembly, log: LogId, first: int, last: int, encoded: bool = True) -> None:
    for k in range(first, last):
        look = descriptor(k) if encoded else None
        record = KeyframeRecord(k, float(k), (float(k), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), look)
        assembly.add(NewRecord(log, k, record))


def closure(query: str, match: str, ratio: float = 1.0) -> ClosureRecord:
    return ClosureRecord(keyframe(query), keyframe(match), (0, 0, 0, 1, 0, 0, 0), 100, 100, ratio)


def leading(keyframes: int = 1) -> tuple[Rounds, GraphAssembly]:
    assembly = GraphAssembly()
    add_keyframes(assembly, R1, 0, keyframes)
    rounds = Rounds(assembly, PARAMETERS)
    rounds.on_term(TERM)
    return rounds, assembly


def started(effects: list[Effect]) -> list[int]:
    return [effect.round for effect in effects if isinstance(effect, Optimise)]


def test_a_new_leader_optimises_at_once() -> None:
    rounds, _ = leading()
    assert started(rounds.tick(0.0)) == [1]


def test_nobody_optimises_who_does_not_lead() -> None:
    rounds, _ = leading()
    rounds.on_term(None)
    assert rounds.tick(0.0) == []
    assert rounds.deadline() == float("inf")


def test_who_leads_no_longer_keeps_nothing_that_it_built_after_a_while() -> None:
    rounds, assembly = leading()
    add_keyframes(assembly, R2, 0, 1)
    assembly.add(NewRecord(R1, 1, closure("r1/0", "r2/0")))
    rounds.tick(0.0)
    (built,) = assembly.graph().closures
    rounds.on_term(None)
    for now in (1.0, 1.0 + GRAPH_KEPT_S - 0.1):
        rounds.tick(now)
        assert assembly.sizes()["built_closures"][0] == 1
    rounds.tick(1.0 + GRAPH_KEPT_S)
    assert assembly.sizes()["built_closures"][0] == 0
    (again,) = assembly.graph().closures
    assert (again.query, again.match) == (built.query, built.match)
    rounds.on_term(Term(TERM.counter + 1, TERM.leader))
    rounds.tick(2.0 + GRAPH_KEPT_S)
    rounds.tick(100.0 + GRAPH_KEPT_S)
    assert assembly.sizes()["built_closures"][0] == 1


def test_nothing_new_calls_for_no_round() -> None:
    rounds, _ = leading()
    rounds.tick(0.0)
    rounds.on_solution(TERM, 1, SOLUTION, 0.0)
    assert rounds.tick(100.0) == []


def test_a_new_closure_calls_for_a_round_after_the_period() -> None:
    rounds, assembly = leading()
    rounds.tick(0.0)
    rounds.on_solution(TERM, 1, SOLUTION, 0.0)
    add_keyframes(assembly, R2, 0, 1)
    assembly.add(NewRecord(R1, 1, closure("r1/0", "r2/0")))
    assert rounds.deadline() == PARAMETERS.period_s
    assert started(rounds.tick(PARAMETERS.period_s)) == [2]


def test_rounds_of_a_large_swarm_follow_each_other_more_slowly() -> None:
    rounds, assembly = leading(keyframes=10_000)
    rounds.tick(0.0)
    rounds.on_solution(TERM, 1, SOLUTION, 0.0)
    add_keyframes(assembly, R2, 0, 1)
    assert rounds.deadline() == 10_000 * PERIOD_PER_KEYFRAME_S > PARAMETERS.period_s


def test_many_new_keyframes_call_for_a_round() -> None:
    rounds, assembly = leading()
    rounds.tick(0.0)
    rounds.on_solution(TERM, 1, SOLUTION, 0.0)
    add_keyframes(assembly, R1, 1, KEYFRAMES_PER_ROUND)
    assert rounds.tick(PARAMETERS.period_s) == []
    add_keyframes(assembly, R1, KEYFRAMES_PER_ROUND, KEYFRAMES_PER_ROUND + 1)
    assert started(rounds.tick(PARAMETERS.period_s)) == [2]


def test_the_last_keyframes_of_a_trajectory_call_for_a_round_after_a_while() -> None:
    rounds, assembly = leading()
    rounds.tick(0.0)
    rounds.on_solution(TERM, 1, SOLUTION, 0.0)
    add_keyframes(assembly, R1, 1, 2)
    assert rounds.deadline() == PATIENCE_S
    assert started(rounds.tick(PATIENCE_S)) == [2]


def test_a_solution_of_another_term_or_of_an_earlier_round_counts_for_nothing() -> None:
    rounds, _ = leading()
    rounds.tick(0.0)
    assert not rounds.on_solution(Term(9, R2), 1, SOLUTION, 0.0)
    rounds.tick(TIMEOUT_S)
    assert started(rounds.tick(rounds.deadline())) == [2]
    assert not rounds.on_solution(TERM, 1, SOLUTION, TIMEOUT_S)


def test_a_solution_that_comes_after_its_round_was_given_up_counts_until_the_next_starts() -> None:
    rounds, _ = leading()
    rounds.tick(0.0)
    rounds.tick(TIMEOUT_S)
    assert rounds.on_solution(TERM, 1, SOLUTION, TIMEOUT_S + 0.1)


def test_a_round_that_is_given_up_is_followed_by_one_with_twice_the_time() -> None:
    rounds, _ = leading()
    rounds.tick(0.0)
    rounds.tick(rounds.deadline())
    again_s = rounds.deadline()
    assert started(rounds.tick(again_s)) == [2]
    assert rounds.deadline() == again_s + 2 * TIMEOUT_S


@pytest.mark.parametrize(("solve_s", "next_s"), [(0.0, 40.0), (15.0, 35.0), (0.1, 20.1)])
def test_the_next_round_pauses_as_long_as_the_last_solve_took(solve_s: float, next_s: float) -> None:
    """Not as long as it took to start the solver's process; on virtual time a solve takes the whole round."""
    rounds, assembly = leading()
    rounds.tick(0.0)
    rounds.on_solution(TERM, 1, GraphSolution((), (), solve_s=solve_s), 20.0)
    add_keyframes(assembly, R2, 0, 1)
    assert rounds.deadline() == next_s


def test_a_clock_that_steps_while_a_round_is_solved_does_not_pause_the_next_one_for_as_long() -> None:
    """Seed 99902824: three minutes without a round."""
    rounds, assembly = leading()
    rounds.tick(0.0)
    rounds.on_solution(TERM, 1, GraphSolution((), ()), 180.0)
    add_keyframes(assembly, R2, 0, 1)
    assert rounds.deadline() == 180.0 + TIMEOUT_S


def test_a_round_that_gives_no_answer_is_given_up_and_tried_again() -> None:
    rounds, _ = leading()
    rounds.tick(0.0)
    effects = rounds.tick(TIMEOUT_S)
    assert [type(e.fact) for e in effects if isinstance(e, Report)] == [RoundTimedOut]
    assert rounds.deadline() > TIMEOUT_S
    assert started(rounds.tick(rounds.deadline())) == [2]


def test_a_failed_round_is_tried_again_ever_more_rarely() -> None:
    rounds, _ = leading()
    now, starts = 0.0, [0.0]
    rounds.tick(now)
    for number in range(1, 6):
        rounds.on_failed(TERM, number, now)
        now = rounds.deadline()
        assert started(rounds.tick(now)) == [number + 1]
        starts.append(now)
    pauses_s = np.diff(starts)
    assert np.all(np.diff(pauses_s) > 0)
    assert pauses_s[0] == 2 * PARAMETERS.period_s


def test_a_silent_optimiser_does_not_block_the_swarm() -> None:
    robots = Robots(
        work=lambda robots, name, effect: None if isinstance(effect, Optimise) and effect.round == 1 else answer(effect)
    )
    robots.add("r1")
    robots.capture("r1", 0.0, look=1)
    robots.run(TIMEOUT_S + 10.0)
    assert robots.frames() == {"r1": "map/r1"}


def test_a_closure_counts_when_its_keyframe_comes_later() -> None:
    assembly = GraphAssembly()
    add_keyframes(assembly, R1, 0, 2)
    add_keyframes(assembly, R2, 0, 1)
    assembly.add(NewRecord(R1, 2, closure("r1/0", "r2/1")))
    assert len(assembly.graph().closures) == 0
    revision = assembly.revision
    add_keyframes(assembly, R2, 1, 2)
    assert len(assembly.graph().closures) == 1
    assert assembly.revision > revision


def test_of_two_registrations_of_one_pair_every_robot_takes_the_same() -> None:
    graphs = []
    for order in ((R1, R2), (R2, R1)):
        assembly = GraphAssembly()
        add_keyframes(assembly, R1, 0, 1)
        add_keyframes(assembly, R2, 0, 1)
        for log in order:
            assembly.add(NewRecord(log, 1, closure("r1/0", "r2/0", ratio=1.0 if log == R1 else 2.0)))
        graphs.append([c.match_ratio for c in assembly.graph().closures])
    assert graphs == [[1.0], [1.0]]


def test_the_odometry_pair_is_the_keyframe_before() -> None:
    assembly = GraphAssembly()
    add_keyframes(assembly, R1, 0, 3)
    assert assembly.odometry_pair(keyframe("r1/2")) == (keyframe("r1/1"), (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))


def test_the_odometry_pair_of_a_first_keyframe_is_the_one_after() -> None:
    assembly = GraphAssembly()
    add_keyframes(assembly, R1, 0, 1)
    assert assembly.odometry_pair(keyframe("r1/0")) is None
    add_keyframes(assembly, R1, 1, 2)
    assert assembly.odometry_pair(keyframe("r1/0")) == (keyframe("r1/1"), (-1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))


def test_no_odometry_pair_goes_over_a_step_that_nobody_measured() -> None:
    assembly = GraphAssembly()
    add_keyframes(assembly, R1, 0, 2)
    add_keyframes(assembly, R1, 2, 4)
    exact, carried = (OdometryCovariance(sigma**2 * np.eye(6)).record(keyframe("r1/2")) for sigma in (0.05, 2.0))
    assembly.add(NewRecord(R1, 90, exact))
    assert assembly.odometry_pair(keyframe("r1/2")) == (keyframe("r1/1"), (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    planar = OdometryCovariance(np.diag([1e3, 1e3, 1e-4, 1e-3, 1e-3, 1e3])).record(keyframe("r1/2"))
    assembly.add(NewRecord(R1, 92, planar))
    assert assembly.odometry_pair(keyframe("r1/2")) == (keyframe("r1/1"), (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    assembly.add(NewRecord(R1, 91, carried))
    assert assembly.odometry_pair(keyframe("r1/2")) == (keyframe("r1/3"), (-1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    assert assembly.odometry_pair(keyframe("r1/1")) == (keyframe("r1/0"), (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))


def test_a_keyframe_that_could_not_be_encoded_is_no_partner_of_an_odometry_pair() -> None:
    assembly = GraphAssembly()
    add_keyframes(assembly, R1, 0, 1)
    add_keyframes(assembly, R1, 1, 2, encoded=False)
    add_keyframes(assembly, R1, 2, 3)
    pair = assembly.odometry_pair(keyframe("r1/2"))
    assert pair is not None
    assert pair[0] == keyframe("r1/0")


def test_rounds_follow_each_other_quickly_while_groups_meet() -> None:
    robots = Robots()
    for name in ("r1", "r2", "r3", "r4"):
        robots.add(name)
    robots.separate("r1 r2", "r3 r4")
    for name in robots.cores:
        for k in range(3):
            robots.capture(name, 2.0 * k, look=k)
    robots.run(20.0)
    robots.separate()
    healed_s = robots.now_s
    while set(robots.frames().values()) != {"map/r1"}:
        robots.run(0.1)
    assert robots.now_s - healed_s < 2.0
