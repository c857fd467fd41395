"""Claim: what was registered of keyframes that their robot took back counts nowhere, until it is registered anew."""

from dataclasses import dataclass, field
from functools import partial

import numpy as np
import pytest
from tests.agent.core import virtual_time
from tests.agent.core.virtual_time import EveryoneSigns, Robots, answer, descriptor, keyframe

from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.effects import Effect, Encode, FetchLatent, Register
from flocc_agent.core.events import Event, KeyframeEncoded, KeyframeEncodingFailed, PairRegistered, Withdrawn
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.core.reports import ClosureWithdrawn
from flocc_agent.core.restored import Restored
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import pose
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import (
    ClosureRecord,
    KeyframeRecord,
    LatentRecord,
    Record,
    RejectionRecord,
    WithdrawalRecord,
    encode_record,
)

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")
TOLD_WITH = 3
"""The keyframe of r1 that shows what is on all of its pictures."""
RIGHT_M = 7.0


@dataclass
class Overlay:
    """Workers: a registration is right once r1's latent was made anew and fetched again.

    Attributes:
        final: No latent can be better.
        refuses: What was made anew shows too little.
        anew: Keyframes whose latents were, by who holds them.
    """

    final: bool = False
    refuses: bool = False
    is_told: bool = False
    anew: dict[str, set[KeyframeId]] = field(default_factory=dict)

    def __call__(self, robots: Robots, name: str, effect: Effect) -> Event | None:
        match effect:
            case Encode(of) if str(of) == f"r1/{TOLD_WITH}":
                self.is_told = True
                withdrawn = Withdrawn(TOLD_WITH, () if self.final else (bytes(32),) * TOLD_WITH, self.final)
                if self.final:
                    return KeyframeEncodingFailed(of, "withheld", withdrawn=withdrawn)
                return KeyframeEncoded(of, descriptor(effect.image), sha256=b"1" * 32, withdrawn=withdrawn)
            case Encode(of):
                return KeyframeEncoded(of, descriptor(effect.image), sha256=b"0" * 32)
            case FetchLatent(of) if self.is_told:
                self.anew.setdefault(name, set()).add(of)
            case Register(pair):
                return PairRegistered(pair, self._registered(name, pair))
            case _:
                pass
        return answer(effect)

    def _registered(self, name: str, pair: CandidatePair) -> Registration | RegistrationFailed:
        """Wrong, but for pairs of r1 with what was made anew."""
        of_r1 = next((end for end in (pair.low, pair.high) if end.log == R1), None)
        is_new = of_r1 is not None and self.is_told and (name == "r1" or of_r1 in self.anew.get(name, ()))
        if is_new and self.refuses:
            return RegistrationFailed(RegistrationFailure.FEW_CORRESPONDENCES, "3 verified")
        T = pose(np.eye(3), np.array([RIGHT_M if is_new else 0.0, 0.0, 0.0]))
        return Registration(T, 100, 100, 1.0)


def told(work: Overlay, names: str = "r1 r2 r3") -> Robots:
    """Robots that closed loops, of which r1 then learns what its pictures show."""
    robots = Robots(work=work)
    for name in names.split():
        robots.add(name)
        for k in range(TOLD_WITH):
            robots.capture(name, float(k), look=k)
    robots.run(20.0)
    assert {length for _, length in graph(robots.cores["r2"])} == {0.0}
    robots.capture("r1", float(TOLD_WITH), look=TOLD_WITH)
    robots.run(30.0)
    return robots


def graph(core: Robot) -> list[tuple[CandidatePair, float]]:
    """Closures of a robot's graph, and how far apart they say that the cameras are."""
    return [
        (CandidatePair.of(c.query, c.match), abs(float(c.T_query_match_unscaled[0, 3])))
        for c in core.assembly.graph().closures
    ]


def of_r1(closures: list[tuple[CandidatePair, float]]) -> list[float]:
    return [length for pair, length in closures if pair.low.log == R1 and pair.low.index < TOLD_WITH]


@pytest.mark.parametrize("keys", [False, True])
def test_closures_of_what_was_taken_back_are_registered_anew_and_all_graphs_agree(
    keys: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if keys:
        monkeypatch.setattr(virtual_time, "Robot", partial(Robot, sealer=EveryoneSigns()))
    robots = told(Overlay())
    found = graph(robots.cores["r1"])
    assert of_r1(found) == [RIGHT_M] * 2 * TOLD_WITH
    assert {length for pair, length in found if pair.low.log != R1} == {0.0}  # of others they stand
    assert graph(robots.cores["r2"]) == graph(robots.cores["r3"]) == found
    said = robots.facts("r1", ClosureWithdrawn)
    assert len(said) == 2 * TOLD_WITH
    assert all(each.again for each in said)
    assert not robots.facts("r2", ClosureWithdrawn)
    names = [r for r in robots.cores["r2"].gossip.logs[R1].records if isinstance(r, LatentRecord)]
    assert len(names) == (2 * TOLD_WITH + 1 if keys else 0)


def test_who_knows_a_keyframe_knows_what_was_taken_back_with_it() -> None:
    """Its pairs take the scale from the keyframe before, whose latent was made anew."""
    log = list(told(Overlay(), "r1 r2").cores["r2"].gossip.logs[R1].records)
    keyframes = [record.index for record in log if isinstance(record, KeyframeRecord)]
    withdrawn_at = next(k for k, record in enumerate(log) if isinstance(record, WithdrawalRecord))
    assert keyframes == list(range(TOLD_WITH + 1))
    following = log[withdrawn_at + 1]
    assert isinstance(following, KeyframeRecord)
    assert following.index == TOLD_WITH


def test_what_nothing_can_make_better_is_not_registered_again() -> None:
    robots = told(Overlay(final=True))
    registered = [effect for at_s, _, effect in robots.done if isinstance(effect, Register) and at_s > 120.0]
    assert not registered
    for core in robots.cores.values():
        assert not of_r1(graph(core))
        assert len(graph(core)) == TOLD_WITH
        assert not core.closing.open_pairs()


def test_what_is_refused_anew_is_no_closure_and_nobody_waits_for_it() -> None:
    robots = told(Overlay(refuses=True))
    for core in robots.cores.values():
        assert not of_r1(graph(core))
        assert not core.closing.open_pairs()


def test_a_robot_out_of_range_hears_of_it_later() -> None:
    work = Overlay()
    robots = Robots(work=work)
    for name in ("r1", "r2"):
        robots.add(name)
        for k in range(TOLD_WITH):
            robots.capture(name, float(k), look=k)
    robots.run(20.0)
    robots.separate("r1", "r2")
    robots.capture("r1", float(TOLD_WITH), look=TOLD_WITH)
    robots.run(20.0)
    assert of_r1(graph(robots.cores["r2"])) == [0.0] * TOLD_WITH
    robots.separate()
    robots.run(40.0)
    assert graph(robots.cores["r1"]) == graph(robots.cores["r2"])
    assert of_r1(graph(robots.cores["r2"])) == [RIGHT_M] * TOLD_WITH


def test_a_registration_under_way_is_done_again() -> None:
    robots = told(Overlay(), "r1 r2")
    core = robots.cores["r2"]
    pair = CandidatePair(keyframe("r1/0"), keyframe("r2/0"))
    core.closing.on_withdrawn(pair, robots.now_s)  # as if it had not been registered yet
    begun = core.closing.tick(robots.now_s)
    if not any(isinstance(effect, Register) for effect in begun):
        core = robots.cores["r1"]
        core.closing.on_withdrawn(pair, robots.now_s)
        begun = core.closing.tick(robots.now_s)
    assert any(isinstance(effect, Register) for effect in begun)
    core.closing.on_withdrawal(R1, 0, TOLD_WITH)
    records = len(core.gossip.logs[core.log])
    core.handle(PairRegistered(pair, Registration(np.eye(4), 100, 100, 1.0)), robots.now_s)
    assert len(core.gossip.logs[core.log]) == records
    assert pair in core.closing.open_pairs()


def test_a_robot_that_starts_again_has_the_same_graph_and_registers_nothing() -> None:
    robots = told(Overlay(), "r1 r2")
    for name in ("r1", "r2"):
        core = robots.cores[name]
        records = tuple((log, tuple(copy.encoded)) for log, copy in sorted(core.gossip.logs.items()))
        again = Robot(core.log, 0, 2, robots.parameters, robots.now_s, Restored(records))
        assert graph(again) == graph(core)
        assert not again.closing.open_pairs()


def closure(one: str, other: str, x_m: float) -> ClosureRecord:
    return ClosureRecord(keyframe(one), keyframe(other), (x_m, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), 60, 100, 0.6, 1.0)


LOGS: dict[LogId, list[Record]] = {
    R1: [
        *(KeyframeRecord(k, float(k), (float(k), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None) for k in range(6)),
        WithdrawalRecord(R1, 0, 3, False),
        closure("r1/0", "r2/0", 1.0),
        WithdrawalRecord(R1, 0, 5, False),
    ],
    R2: [
        *(KeyframeRecord(k, float(k), (float(k), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None) for k in range(6)),
        closure("r1/1", "r2/1", 2.0),
        closure("r1/4", "r2/4", 3.0),
        closure("r1/5", "r2/5", 4.0),
        WithdrawalRecord(R1, 0, 3, False),
        closure("r1/2", "r2/2", 5.0),
        WithdrawalRecord(R1, 0, 5, False),
        closure("r1/1", "r2/1", 6.0),
        RejectionRecord(keyframe("r1/2"), keyframe("r2/2"), "few", 3, 100),
    ],
    R3: [
        *(KeyframeRecord(k, float(k), (float(k), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None) for k in range(3)),
        closure("r1/1", "r2/1", 8.0),
        closure("r2/1", "r3/1", 9.0),
        WithdrawalRecord(R1, 0, 3, False),
        closure("r1/1", "r2/1", 10.0),
        closure("r1/1", "r3/1", 11.0),
        WithdrawalRecord(R3, 2, 3, True),
        closure("r2/2", "r3/2", 12.0),
        closure("r1/5", "r3/0", 13.0),
    ],
}


@pytest.mark.parametrize("seed", range(20))
def test_what_counts_does_not_depend_on_the_order_in_which_logs_are_heard(seed: int) -> None:
    rng, assembly, number = np.random.default_rng(seed), GraphAssembly(), dict.fromkeys(LOGS, 0)
    while open_logs := [log for log, at in number.items() if at < len(LOGS[log])]:
        log = open_logs[int(rng.integers(len(open_logs)))]
        record = LOGS[log][number[log]]
        encode_record(record)
        assembly.add(NewRecord(log, number[log], record))
        number[log] += 1
    found = {(str(c.query), str(c.match)): float(c.T_query_match_unscaled[0, 3]) for c in assembly.graph().closures}
    assert found == {
        ("r1/5", "r2/5"): 4.0,  # was never taken back
        ("r1/1", "r2/1"): 6.0,  # the only registration that knows of both withdrawals
        ("r2/1", "r3/1"): 9.0,
        ("r1/5", "r3/0"): 13.0,
    }
    assert assembly.closures == len(found)
    judged = ("r1/0 r2/0", "r1/1 r2/1", "r1/2 r2/2", "r1/4 r2/4", "r1/5 r2/5", "r1/1 r3/1", "r2/2 r3/2")
    pairs = {ends: CandidatePair.of(*map(keyframe, ends.split())) for ends in judged}
    asked = [ends for ends, pair in pairs.items() if assembly.withdrawals.asks_again(pair)]
    assert asked == ["r1/0 r2/0", "r1/4 r2/4", "r1/1 r3/1"]
