"""Each invariant's checker catches a core that is broken in one place."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from flocc_agent.core import corrections as corrections_module
from flocc_agent.core.corrections import Corrections
from flocc_agent.core.effects import Broadcast, Deliver, Effect, Unicast
from flocc_agent.core.election import LeaderElection
from flocc_agent.core.latents import Relayed
from flocc_agent.core.log_copy import EncodedRecords
from flocc_agent.core.loop_closing import LoopClosing
from flocc_agent.core.neighbours import Neighbours
from flocc_agent.core.offers import Offers
from flocc_agent.core.own_log import OwnLog
from flocc_agent.core.place_recognition import Candidate
from flocc_agent.core.pose_graph import GraphSolution
from flocc_agent.core.pulls import Pulls
from flocc_agent.core.restored import Restored
from flocc_launch.scenarios.scenario import Fault, FaultKind, Scenario
from flocc_launch.simulation.campaign import run_checked
from flocc_launch.simulation.disk import Disk
from flocc_launch.simulation.generator import FAULTS_END_S, drawn_scenario
from flocc_protocol.ids import KeyframeId, LogId, Term
from flocc_protocol.messages import Coordinator

CALM = Fault(at_s=FAULTS_END_S, kind=FaultKind.CALM)


def scenario(*faults: Fault, **changes: Any) -> Scenario:
    """Three robots that meet, with faults."""
    fields: dict[str, Any] = {
        "seed": 5,
        "tracks": {"robots": 3, "seed": 1, "area_m": 12.0, "speed_m_s": 0.8, "length_m": 14.0},
        "keyframes": {"distance_m": 1.5, "rotation_rad": 1.2},
        "core": {"place_recognition": {"similarity_threshold": 0.5}},
        "perception": {
            "method": "synthetic",
            "synthetic": {"dimension": 16, "outlier_probability": 0.0, "alias_probability": 0.0},
        },
        "faults": [fault.model_dump() for fault in (*faults, CALM)],
        **changes,
    }
    return Scenario.model_validate(fields)


def killed_and_back(name: str) -> tuple[Fault, ...]:
    return (
        Fault(at_s=10.0, kind=FaultKind.KILL, robots=(name,)),
        Fault(at_s=11.0, kind=FaultKind.START, robots=(name,)),
    )


LOSSY = {"radio": {"loss_ratio": 0.4}}


def broken(run: Scenario) -> set[str]:
    """Names of the invariants that did not hold."""
    return {violation.invariant for violation in run_checked(run).violations}


@pytest.mark.parametrize("run", [scenario(), scenario(*killed_and_back("r1")), scenario(**LOSSY)])
def test_the_core_as_it_is_breaks_nothing(run: Scenario) -> None:
    assert broken(run) == set()


def test_a_robot_that_never_follows_breaks_agreement(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LeaderElection, "_prefers", lambda self, heard: False)
    assert "agreement" in broken(scenario())


def test_a_robot_that_applies_whatever_comes_breaks_fencing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Corrections, "is_news", lambda self, message, now: True)
    monkeypatch.setattr(Corrections, "_has_knots", lambda self, version: False)
    late = {"radio": {"jitter_s": 0.3, "duplicate_ratio": 0.5, "reorder_ratio": 0.5, "reorder_delay_s": 4.0}}
    assert "fencing" in broken(scenario(**late))


def test_a_jump_that_is_not_told_breaks_fencing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corrections_module, "Deliver", lambda message, frame_changed: Deliver(message, False))
    assert "fencing" in broken(scenario())


def test_a_leader_that_forgets_its_counter_breaks_one_claim(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Restored, "counter_max", lambda self: 0)
    assert "one claim" in broken(scenario(*killed_and_back("r1"), tracks={"robots": 1}))


def test_a_leader_that_leaves_lonely_robots_out_starves_them(monkeypatch: pytest.MonkeyPatch) -> None:
    original = Corrections.publish

    def only_groups(self: Corrections, term: Term, number: int, solution: GraphSolution) -> list[Effect]:
        groups = tuple(component for component in solution.components if len(component.logs) > 1)
        return original(self, term, number, GraphSolution(groups, solution.closures))

    monkeypatch.setattr(Corrections, "publish", only_groups)
    far = {"tracks": {"robots": 2, "seed": 3, "area_m": 4000.0, "length_m": 14.0}}
    assert "no starvation" in broken(scenario(**far))


def test_robots_that_all_take_a_pair_break_registered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def greedy(self: LoopClosing, candidate: Candidate, now: float) -> None:
        self._add(candidate)

    monkeypatch.setattr(LoopClosing, "_assign", greedy)
    assert "registered once" in broken(scenario())


def test_a_robot_that_forgets_what_is_resolved_breaks_registered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LoopClosing, "on_resolved", lambda self, pair: self._work.remove(pair))
    assert "registered once" in broken(scenario(**LOSSY))


def test_a_robot_that_does_not_offer_leaves_pairs_unregistered(monkeypatch: pytest.MonkeyPatch) -> None:
    original = Offers.tell

    def silent(self: Offers, *details: Any) -> list[Effect]:
        original(self, *details)
        return []

    monkeypatch.setattr(Offers, "tell", silent)
    assert "registered once" in broken(drawn_scenario(0))


def test_corrections_in_frames_of_their_own_break_one_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    original = Corrections._made

    def own_frame(self: Corrections, component: Any, log: Any, *rest: Any) -> Any:
        made = original(self, component, log, *rest)
        return None if made is None else replace(made, anchor=log)

    monkeypatch.setattr(Corrections, "_made", own_frame)
    assert "one frame" in broken(scenario())


def test_logs_that_are_not_repaired_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Pulls, "_may_ask", lambda self, *details: False)
    assert "nothing lost" in broken(scenario(**LOSSY))


def test_a_disk_that_forgets_what_was_published_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    original = Disk.restored

    def forgetful(self: Disk) -> Restored:
        for log, records in self.records.items():
            self.records[log] = EncodedRecords(records[:-1])
        return original(self)

    monkeypatch.setattr(Disk, "restored", forgetful)
    assert "nothing lost" in broken(scenario(*killed_and_back("r1")))


def test_a_robot_that_sends_before_it_writes_loses_what_it_published(monkeypatch: pytest.MonkeyPatch) -> None:
    original = OwnLog.append

    def hasty(self: OwnLog, record: Any, now: float) -> list[Effect]:
        effects = original(self, record, now)
        return [
            *(e for e in effects if isinstance(e, Broadcast)),
            *(e for e in effects if not isinstance(e, Broadcast)),
        ]

    monkeypatch.setattr(OwnLog, "append", hasty)
    cuts = tuple(
        Fault(at_s=t + dt, kind=kind, robots=("r1",), value=value)
        for t in range(4, 24, 2)
        for dt, kind, value in ((0.0, FaultKind.KILL, 1.0), (1.5, FaultKind.START, None))
    )
    assert "nothing lost" in broken(scenario(*cuts))


def test_a_table_without_a_maximum_breaks_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    def hoard(self: LoopClosing, peer: str, wants: Any, now: float) -> None:
        self.latents._relayed.update({KeyframeId(self._own, k): Relayed(now, False) for k in range(99)})

    monkeypatch.setattr(LoopClosing, "on_wants", hoard)
    assert "bounded" in broken(scenario())


def test_a_deadline_in_the_past_is_a_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Neighbours, "deadline", lambda self: 0.0)
    assert "no crash" in broken(scenario())


def test_an_exception_of_the_core_is_a_crash_that_names_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: LeaderElection, now: float) -> list[Effect]:
        raise KeyError("made to fail")

    monkeypatch.setattr(LeaderElection, "tick", fail)
    violations = run_checked(scenario()).violations
    assert [v.invariant for v in violations] == ["no crash"]
    assert "made to fail" in violations[0].detail


def test_a_claim_of_another_robots_term_breaks_one_claim(monkeypatch: pytest.MonkeyPatch) -> None:
    original: Callable[..., list[Effect]] = LeaderElection._claim

    def steal(self: LeaderElection) -> list[Effect]:
        effects = original(self)
        assert self._leader is not None
        stolen = replace(self._leader, term=Term(self._leader.term.counter, LogId("r9")))
        return [*effects, Broadcast(Coordinator(stolen)), Unicast("r2", Coordinator(stolen))]

    monkeypatch.setattr(LeaderElection, "_claim", steal)
    assert "one claim" in broken(scenario())
