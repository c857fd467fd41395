"""Campaigns: seeds that hold, replay exactly, and shrink."""

from unittest.mock import patch

import pytest

from flocc_agent.core.reports import ClosureWithdrawn
from flocc_agent.core.withdrawals import Withdrawals
from flocc_launch.scenarios.scenario import Fault, FaultKind, Scenario
from flocc_launch.simulation.campaign import (
    Campaign,
    SeedOutcome,
    campaign,
    is_noiseless,
    prepared,
    run_checked,
    run_seed,
    shrink,
)
from flocc_launch.simulation.coverage import table
from flocc_launch.simulation.generator import FAMILIES, FAULTS_END_S, calm_s, drawn_scenario
from flocc_launch.simulation.hardships import CLOCK_STEP_MAX_S, Hardship, HardshipKind, drawn_hardships
from flocc_launch.simulation.invariants import Violation


@pytest.mark.slow
def test_a_small_campaign_on_two_processes_holds() -> None:
    result = campaign(range(5000, 5024), processes=2)
    assert [outcome.seed for outcome in result.outcomes] == list(range(5000, 5024))
    assert result.as_json()["violations"] == []


def test_a_seed_replays_exactly() -> None:
    told = []
    for _ in range(2):
        swarm = prepared(drawn_scenario(7))
        swarm.run_until(20.0)
        told.append(swarm.told)
    assert told[0] == told[1]


def test_other_seeds_draw_other_faults() -> None:
    assert drawn_scenario(1) != drawn_scenario(2)
    assert drawn_scenario(1) == drawn_scenario(1)


def test_from_the_end_of_the_faults_on_nothing_is_drawn() -> None:
    faults = [fault for seed in range(200) for fault in drawn_scenario(seed).faults]
    assert max(fault.at_s for fault in faults) <= FAULTS_END_S
    assert {fault.kind for fault in faults} >= set(FaultKind) - {FaultKind.LATENCY, FaultKind.RANGE}


def test_shrinking_leaves_the_fault_that_matters() -> None:
    culprit = Fault(at_s=3.0, kind=FaultKind.SLOW, robots=("r1",), value=3.0)
    others = tuple(Fault(at_s=float(k), kind=FaultKind.LOSS, value=0.1) for k in range(4))
    scenario = drawn_scenario(1).model_copy(update={"faults": (*others[:2], culprit, *others[2:])})

    def fails(smaller: Scenario) -> bool:
        return culprit in smaller.faults

    assert shrink(scenario, fails).faults == (culprit,)


def test_the_json_of_a_campaign_names_seed_invariant_and_time() -> None:
    outcome = SeedOutcome(9, (Violation("agreement", 92.5, "two lead"),), None)
    fields = Campaign((outcome, SeedOutcome(10, (), 2.5))).as_json()
    assert fields["runs"] == 2
    assert fields["violations"] == [{"seed": 9, "invariant": "agreement", "at_s": 92.5, "detail": "two lead"}]


def test_a_campaign_tells_which_messages_arrived_during_which_faults() -> None:
    found = campaign(range(51000000, 51000003), processes=1)
    coverage = found.coverage()
    assert coverage["heartbeat", "mute"] > 0
    assert coverage["records", "older copy"] > 0
    rows = table(coverage).splitlines()
    assert any(row.startswith("heartbeat") for row in rows)
    cell = {"message": "heartbeat", "fault": "mute", "count": coverage["heartbeat", "mute"]}
    assert cell in found.as_json()["coverage"]  # type: ignore[operator]


def test_clocks_step_by_up_to_two_hours_in_a_tenth_of_the_seeds() -> None:
    drawn = [each for seed in range(500) for each in drawn_hardships(seed, ["r1", "r2"], FAULTS_END_S)]
    steps_s = [each.number for each in drawn if each.kind is HardshipKind.CLOCK]
    assert 30 < len(steps_s) < 70
    assert min(steps_s) < 60
    assert CLOCK_STEP_MAX_S / 2 < max(steps_s) <= CLOCK_STEP_MAX_S


def test_a_robot_whose_clock_stepped_registers_no_pair_again() -> None:
    step = Hardship(HardshipKind.CLOCK, "r3", 10.866, 27.024, 439)
    assert run_checked(drawn_scenario(99600047), [step]).violations == ()


def test_a_fetch_is_given_up_by_the_clock_of_its_robot() -> None:
    step = Hardship(HardshipKind.CLOCK, "r5", 14.789, 18.061, 2)
    full = Hardship(HardshipKind.FULL, "r3", 16.593, 17.762, 116)
    assert run_checked(drawn_scenario(99450020), [step, full]).violations == ()


def test_something_gets_onto_a_camera_in_a_fifth_of_the_seeds() -> None:
    drawn = [each for seed in range(500) for each in drawn_hardships(seed, ["r1", "r2"], FAULTS_END_S)]
    assert 70 < sum(each.kind is HardshipKind.OVERLAY for each in drawn) < 130


def test_what_a_camera_with_something_on_it_showed_is_registered_anew() -> None:
    scenario, overlay = drawn_scenario(99960002), Hardship(HardshipKind.OVERLAY, "r1", 1.0, 9.0)
    assert is_noiseless(scenario)
    swarm = prepared(scenario, [overlay])
    swarm.run_until(FAULTS_END_S)
    taken_back = [told.fact for told in swarm.told if isinstance(told.fact, ClosureWithdrawn)]
    assert taken_back
    assert all(fact.again for fact in taken_back)
    assert run_checked(scenario, [overlay]).violations == ()


def test_a_closure_of_what_a_robot_took_back_is_no_true_one() -> None:
    overlay = Hardship(HardshipKind.OVERLAY, "r1", 1.0, 9.0)
    with patch.object(Withdrawals, "counts", lambda *_: True):
        assert [v.invariant for v in run_checked(drawn_scenario(99960002), [overlay]).violations] == ["right"]


def test_a_large_family_has_20_robots_and_ten_minutes_with_faults_to_their_end() -> None:
    drawn = [drawn_scenario(seed, FAMILIES["large"]) for seed in range(20)]
    assert {len(scenario.names()) for scenario in drawn} == {20}
    assert {calm_s(scenario) for scenario in drawn} == {540.0}
    assert max(fault.at_s for scenario in drawn for fault in scenario.faults if fault.kind is FaultKind.KILL) > 500.0
    flapping = [sum(fault.kind is FaultKind.RESTART for fault in scenario.faults) for scenario in drawn]
    assert max(flapping) >= 6


@pytest.mark.parametrize("seed", [99900774, 99901706, 100002544])
def test_checkers_do_not_blame_a_robot_for_what_it_could_not_know(seed: int) -> None:
    """A late solution; a latent whose news waited for a slow disk; which version of a log the leader holds."""
    assert run_seed(seed).violations == ()
