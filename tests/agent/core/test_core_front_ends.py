"""Robots whose latents cannot be registered with each other stop trying, but not for ever."""

from flocc_agent.config import ClassicalConfig
from flocc_agent.core.front_ends import FAILURES_MIN, TRIED_EVERY, FrontEnds
from flocc_agent.core.loop_closing import LoopClosing
from flocc_agent.core.parameters import LoopClosingParameters
from flocc_agent.core.place_recognition import Candidate
from flocc_agent.core.registration import RegistrationFailed, RegistrationFailure
from flocc_agent.perception.classical import classical_registrar
from flocc_agent.perception.latent import pack
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

OTHER = RegistrationFailure.OTHER_FRONT_END.value


def pair(k: int, other: str = "r2") -> CandidatePair:
    return CandidatePair.of(KeyframeId(LogId("r1"), k), KeyframeId(LogId(other), k))


def test_two_failures_and_no_closure_set_two_logs_apart() -> None:
    ends = FrontEnds()
    assert not ends.on_rejection(pair(0), "few correspondences")
    assert [ends.on_rejection(pair(k), OTHER) for k in range(1, 4)] == [False, True, False]
    tried = [k for k in range(1000) if not ends.are_apart(pair(k))]
    assert 1000 / TRIED_EVERY / 2 < len(tried) < 2 * 1000 / TRIED_EVERY
    assert not any(ends.are_apart(pair(k, "r3")) for k in range(100))


def test_a_closure_brings_them_together_for_good() -> None:
    ends = FrontEnds()
    for k in range(FAILURES_MIN):
        ends.on_rejection(pair(k), OTHER)
    ends.on_closure(pair(50))
    assert not any(ends.are_apart(pair(k)) for k in range(100))
    assert not any(ends.on_rejection(pair(k), OTHER) for k in range(60, 70))


def test_pairs_that_wait_are_dropped_and_new_ones_not_taken() -> None:
    closing = LoopClosing(LogId("r1"), 0, lambda _: None, LoopClosingParameters())
    found = [Candidate(pair(k), 0.5) for k in range(40)]
    closing.on_candidates([*found, Candidate(pair(0, "r3"), 0.5)], 0.0)
    told = [closing.on_rejection(pair(k), OTHER) for k in range(3)]
    assert told == [False, True, False]
    left = closing.open_pairs()
    assert pair(0, "r3") in left
    assert 1 <= len(left) < 6
    more = closing.on_candidates([Candidate(pair(k), 0.5) for k in range(100, 140)], 1.0)
    assert len(more) < 5


def test_a_latent_of_another_front_end_is_told_from_a_damaged_one() -> None:
    registrar = classical_registrar(ClassicalConfig())
    other, damaged = pack("learned/xfeat-1", {}, {}), b"FLL1"
    results = [registrar.register(latent, latent, None) for latent in (other, damaged)]
    assert [result.failure for result in results if isinstance(result, RegistrationFailed)] == [
        RegistrationFailure.OTHER_FRONT_END,
        RegistrationFailure.BAD_LATENT,
    ]
