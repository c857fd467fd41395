"""Claims on the spectral order of candidates."""

import time
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.core.candidate_order import (
    CLOSURE_WEIGHT,
    NODES_MAX,
    PICKS,
    PLACE_WEIGHT,
    Reduced,
    SpectralOrder,
    spectrum,
    step_for,
    uncertainty_removed,
)
from flocc_agent.core.effects import Effect, FetchLatent, Register
from flocc_agent.core.latents import Peer
from flocc_agent.core.loop_closing import LoopClosing, registrar_of
from flocc_agent.core.parameters import CoreParameters, LoopClosingParameters, PlaceRecognitionParameters
from flocc_agent.core.place_recognition import Candidate
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")
LENGTH = 60


def pair(one: LogId, i: int, other: LogId, j: int) -> CandidatePair:
    return CandidatePair.of(KeyframeId(one, i), KeyframeId(other, j))


def side_by_side(best: int = 30) -> dict[CandidatePair, float]:
    """Two robots that walk side by side: a candidate per keyframe, the most similar around one place."""
    similarities = {pair(R1, i, R2, i): 0.95 - 0.005 * abs(i - best) for i in range(LENGTH)}
    return dict(sorted(similarities.items(), key=lambda item: (-item[1], item[0])))


def order_of(*logs: LogId, length: int = LENGTH) -> SpectralOrder:
    order = SpectralOrder()
    for log in logs:
        for _ in range(length):
            order.on_keyframe(log)
    return order


def always(_: CandidatePair) -> bool:
    return True


def taken(order: SpectralOrder, candidates: dict[CandidatePair, float], count: int) -> list[CandidatePair]:
    """Register so many candidates, each as soon as it is chosen; all become closures."""
    left = dict(candidates)
    done: list[CandidatePair] = []
    while len(done) < count:
        chosen = order.chosen(left, always)[0]
        del left[chosen]
        order.on_closure(chosen)
        done.append(chosen)
    return done


def eigenvalues(closures: list[CandidatePair]) -> NDArray[np.float64]:
    """Those of two whole chains of `LENGTH` keyframes, joined by closures, but for the first; nothing is contracted."""
    laplacian = np.zeros((2 * LENGTH, 2 * LENGTH))
    ends = [(r * LENGTH + i, r * LENGTH + i + 1) for r in range(2) for i in range(LENGTH - 1)]
    ends += [(closure.low.index, LENGTH + closure.high.index) for closure in closures]
    for a, b in ends:
        weight = 1.0 if b == a + 1 else CLOSURE_WEIGHT
        laplacian[[a, b], [a, b]] += weight
        laplacian[[a, b], [b, a]] -= weight
    return np.asarray(np.linalg.eigvalsh(laplacian)[1:])


def uncertainty(closures: list[CandidatePair]) -> float:
    return float((1.0 / (eigenvalues(closures) + PLACE_WEIGHT)).sum())


def test_the_first_candidate_is_the_most_similar_that_joins_two_parts() -> None:
    candidates = side_by_side()
    assert order_of(R1, R2).chosen(candidates, always)[0] == pair(R1, 30, R2, 30)


def test_the_next_ones_are_spread_where_similarity_would_stay_at_one_place() -> None:
    indices = [closure.low.index for closure in taken(order_of(R1, R2), side_by_side(), 4)]
    assert max(indices) - min(indices) > LENGTH / 2
    similar = [closure.low.index for closure in list(side_by_side())[:4]]
    assert max(similar) - min(similar) <= 3


@pytest.mark.parametrize("best", [5, 30, 50])
def test_half_the_closures_connect_the_whole_graph_better_than_the_most_similar_ones(best: int) -> None:
    candidates = side_by_side(best)
    spectral, similar = taken(order_of(R1, R2), candidates, 5), list(candidates)[:10]
    assert uncertainty(spectral) < uncertainty(similar)
    assert eigenvalues(spectral)[0] >= eigenvalues(similar)[0] * (1 - 1e-9)


def test_what_is_chosen_stays_chosen_until_it_is_done() -> None:
    order, candidates = order_of(R1, R2), side_by_side()
    first = order.chosen(candidates, always)
    assert len(first) == PICKS
    more = {pair(R1, 0, R2, 59): 0.99, **candidates}
    assert order.chosen(more, always) == first
    del candidates[first[0]]
    assert order.chosen(candidates, always)[: PICKS - 1] == first[1:]


def test_only_what_can_be_registered_is_chosen() -> None:
    candidates = side_by_side()
    chosen = order_of(R1, R2).chosen(candidates, lambda one: one.low.index >= 40)
    assert chosen
    assert all(one.low.index >= 40 for one in chosen)


def test_parts_are_joined_before_any_is_strengthened() -> None:
    order = order_of(R1, R2, R3)
    order.on_closure(pair(R1, 0, R2, 0))
    strengthening = {pair(R1, i, R2, i): 0.99 for i in range(50, LENGTH)}
    joining = {pair(R2, 31, R3, 31): 0.6, pair(R2, 32, R3, 32): 0.55}
    assert order.chosen({**strengthening, **joining}, always)[0] in joining


def test_few_candidates_need_no_choice() -> None:
    candidates = dict(list(side_by_side().items())[:PICKS])
    assert order_of(R1, R2).chosen(candidates, always) == list(candidates)


def test_the_order_is_the_same_whenever_it_is_asked_for() -> None:
    rng = np.random.default_rng(4)
    logs = (R1, R2, R3)
    candidates: dict[CandidatePair, float] = {}
    for _ in range(200):
        a, b = rng.choice(3, size=2, replace=False)
        i, j = (int(k) for k in rng.integers(LENGTH, size=2))
        candidates[pair(logs[a], i, logs[b], j)] = round(float(rng.uniform(0.5, 1.0)), 2)
    assert taken(order_of(*logs), candidates, 30) == taken(order_of(*logs), candidates, 30)


def test_chains_are_contracted_without_losing_what_decides() -> None:
    """The connectivity of the contracted graph, with masses, is close to that of the whole one."""
    closures = [pair(R1, i, R2, i) for i in (3, 20, 55)]
    filler = [pair(R1, i, R2, i) for i in range(0, LENGTH, 4)]
    graph = Reduced([*closures, *filler], {R1: LENGTH, R2: LENGTH})
    for closure in closures:
        graph.add(closure)
    values, _ = spectrum(graph._laplacian, graph._masses)
    assert graph._masses.sum() == 2 * LENGTH
    assert values[1] == pytest.approx(eigenvalues(closures)[0], rel=0.1)


@pytest.mark.parametrize(
    ("logs", "length", "candidates"), [(2, 50, 20), (6, 500, 512), (16, 5000, 512), (200, 40, 512)]
)
def test_the_matrix_stays_small_and_a_choice_fast(logs: int, length: int, candidates: int) -> None:
    rng = np.random.default_rng(7)
    names = [LogId(f"r{k}") for k in range(logs)]
    given: dict[CandidatePair, float] = {}
    while len(given) < candidates:
        a, b = rng.choice(logs, size=2, replace=False)
        i, j = (int(k) for k in rng.integers(length, size=2))
        given[pair(names[a], i, names[b], j)] = 0.5
    graph = Reduced(given, dict.fromkeys(names, length))
    assert len(graph._masses) <= max(NODES_MAX, logs)
    order = order_of(*names, length=length)
    began_s = time.process_time()
    assert len(order.chosen(given, always)) == PICKS
    assert time.process_time() - began_s < 1.0


def test_neighbours_are_merged_no_further_than_needed() -> None:
    assert step_for([set(range(NODES_MAX))]) == 1
    assert step_for([set(range(NODES_MAX + 1))]) == 2
    assert step_for([set(range(NODES_MAX * 4))]) == 4
    assert step_for([{k} for k in range(3 * NODES_MAX)]) == 1


def test_the_first_mode_of_a_chain_is_a_cosine() -> None:
    n = 20
    laplacian = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    laplacian[0, 0] = laplacian[-1, -1] = 1.0
    values, modes = spectrum(laplacian, np.ones(n))
    expected = np.cos(np.pi * (np.arange(n) + 0.5) / n)
    assert values[1] == pytest.approx(2.0 - 2.0 * np.cos(np.pi / n))
    assert abs(modes[:, 1] @ expected) == pytest.approx(np.linalg.norm(expected), rel=1e-9)


def test_what_another_robot_will_register_is_left_to_it() -> None:
    """The most similar pair joins the maps: where it is another's, this robot chooses beside it."""
    candidates = side_by_side()
    best = next(iter(candidates))
    own = {one: similarity for one, similarity in candidates.items() if one != best}
    alone, beside = order_of(R1, R2), order_of(R1, R2)
    near = {one for one in own if abs(one.low.index - best.low.index) < 8}
    assert alone.chosen(own, always)[0] in near
    assert near.isdisjoint(beside.chosen(own, always, lambda: {best: 1.0, pair(R1, 31, R2, 31): 1.0}))


def test_a_gain_is_what_the_sum_of_inverse_eigenvalues_loses() -> None:
    closures = [pair(R1, 3, R2, 3), pair(R1, 40, R2, 41)]
    added = pair(R1, 20, R2, 22)
    everything = [pair(R1, i, R2, i) for i in range(LENGTH)]
    graph = Reduced([*closures, added, *everything], {R1: LENGTH, R2: LENGTH})
    assert len(graph._masses) == 2 * LENGTH
    for closure in closures:
        graph.add(closure)
    (gain,) = graph.gains([added])
    assert gain == pytest.approx(uncertainty(closures) - uncertainty([*closures, added]), rel=1e-9)


def test_an_edge_between_equal_values_removes_nothing() -> None:
    assert uncertainty_removed(np.zeros((1, 3)), np.ones(3), 1.0) == pytest.approx([0.0])


def closing_of(count: int) -> tuple[LoopClosing, list[CandidatePair]]:
    """Robot r1, in range of r2, with so many pairs of its own to register, one latent to fetch for each."""
    own = [one for one in side_by_side() if registrar_of(one) == R1 and one.low.index > 0][:count]
    machine = LoopClosing(
        R1,
        0,
        lambda keyframe: (KeyframeId(keyframe.log, keyframe.index - 1), (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),
        LoopClosingParameters(fetches_max=1),
        order_of(R1, R2),
    )
    machine.on_peer("r2", Peer(0))
    for index in range(LENGTH):
        machine.on_held(KeyframeId(R1, index))
    machine.on_candidates([Candidate(one, 0.9) for one in own], 0.0)
    return machine, own


def started(effects: list[Effect]) -> list[CandidatePair]:
    return [effect.pair for effect in effects if isinstance(effect, Register)]


def fetched(effects: list[Effect]) -> list[KeyframeId]:
    return [effect.keyframe for effect in effects if isinstance(effect, FetchLatent)]


def test_only_chosen_pairs_are_fetched_and_registered_also_where_latents_are_at_hand() -> None:
    machine, own = closing_of(12)
    (wanted,) = fetched(machine.tick(0.0))
    chosen = machine._choice()
    assert wanted == chosen[0].high
    idle = next(one for one in own if one not in chosen)
    machine.on_held(idle.high)
    assert started(machine.tick(1.0)) == []
    machine.on_held(wanted)
    assert started(machine.tick(2.0)) == [chosen[0]]


def test_every_pair_has_its_turn() -> None:
    machine, own = closing_of(12)
    done: list[CandidatePair] = []
    for step in range(200):
        for effect in machine.tick(float(step)):
            match effect:
                case FetchLatent(keyframe):
                    machine.on_held(keyframe)
                case Register(one):
                    done.append(one)
                    machine.on_closure(one, 0.0)
    assert sorted(done) == sorted(own)


@pytest.mark.parametrize(
    ("order", "bandwidth", "expected"),
    [
        ("auto", None, "similarity"),
        ("auto", 1e5, "spectral"),
        ("similarity", 1e5, "similarity"),
        ("spectral", None, "spectral"),
    ],
)
def test_a_budget_calls_for_the_spectral_order_unless_another_is_asked_for(
    order: Literal["auto", "similarity", "spectral"], bandwidth: float | None, expected: str
) -> None:
    given = CoreParameters(place_recognition=PlaceRecognitionParameters(candidate_order=order))
    assert given.under(bandwidth).place_recognition.candidate_order == expected
