"""The machine of distributed optimisation: what it has solved, what it tells whom, and into which frame it moves."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.core.coming_apart import CONTACTS, SILENT_S
from flocc_agent.core.distributed_optimisation import (
    DELIVER_PERIOD_S,
    VAIN_STEPS_MAX,
    DistributedOptimisation,
)
from flocc_agent.core.distrust import DISTRUSTED_FIRST_S
from flocc_agent.core.effects import ChooseClosures, Effect, Report, StepConsensus, Unicast
from flocc_agent.core.own_part import Apart, ConsensusState, ConsensusStep, ToldPoses
from flocc_agent.core.parameters import DistributedParameters
from flocc_agent.core.plausibility import HELD_BACK_S
from flocc_agent.core.pose_graph import (
    ClosureResult,
    ClosureState,
    Component,
    GraphSolution,
    LoopClosure,
    PoseGraph,
    Trajectory,
)
from flocc_agent.core.reports import CAME_APART, PeerRefused, RoundFailed
from flocc_agent.geometry import pose, pose7
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import SHARED_MAX, SharedPoses
from flocc_protocol.shared_poses import stiffness_numbers

Float = NDArray[np.float64]

A, B, C = LogId("a"), LogId("b"), LogId("c")
PARAMETERS = DistributedParameters(
    period_s=0.2, wait_s=1.0, choose_s=5.0, repeat_s=0.5, repeat_max_s=2.0, timeout_s=10.0
)
SEEN = ((KeyframeId(B, 1), KeyframeId(A, 2)), (KeyframeId(C, 0), KeyframeId(B, 3)))
"""b/1 saw a/2, c/0 saw b/3: a owns the first, b the second."""


@dataclass
class Source:
    """Logs that a test writes, four keyframes each."""

    seen: tuple[tuple[KeyframeId, KeyframeId], ...] = SEEN
    revision: int = 1
    length: int = 4
    doubt: str = ""
    shift_m: float = 0.0

    @property
    def keyframes(self) -> int:
        return 3 * self.length

    def graph(self) -> PoseGraph:
        trajectories = {log: Trajectory(np.repeat(np.eye(4)[None], self.length, axis=0)) for log in (A, B, C)}
        T = pose(np.eye(3), np.array([self.shift_m, 0.0, 0.0]))
        closures = tuple(LoopClosure(query, match, T, doubt=self.doubt) for query, match in self.seen)
        return PoseGraph(trajectories, closures)


@dataclass
class Bench:
    """A machine of robot b, and what it wants."""

    source: Source = field(default_factory=Source)
    near: set[str] = field(default_factory=lambda: {"a", "c"})

    def __post_init__(self) -> None:
        self.b = DistributedOptimisation(B, self.source, PARAMETERS, self.near.__contains__)

    def turn(
        self, now: float, state: ClosureState = ClosureState.USED, parted: bool = False, **changes: Any
    ) -> tuple[list[Effect], list[StepConsensus]]:
        """A tick whose work is answered at once; what came of it, and the steps that it asked for."""
        effects = self.b.tick(now)
        for choice in choices(effects):
            effects += self.b.on_chosen(choice.number, solution(choice.graph, state, parted), now)
        asked = jobs(effects)
        for job in asked:
            effects += self.b.on_step(job.number, step(job, **changes), now)
        return effects, asked

    def shares(self) -> "Bench":
        """After it has chosen what it shares with c, and told c so."""
        self.turn(0.0)
        effects, _ = self.turn(0.2)
        assert set(told(effects)) == {"c"}
        return self


def solution(graph: PoseGraph, state: ClosureState = ClosureState.USED, parted: bool = False) -> GraphSolution:
    """Everything where it was, in one component or in one of each log."""
    logs = tuple(graph.trajectories)
    groups = [(log,) for log in logs] if parted else [logs]
    components = tuple(
        Component(
            group,
            {log: np.asarray(graph.trajectories[log].T_odom_keyframe) for log in group},
            {log: np.eye(4) for log in group},
            {},
        )
        for group in groups
    )
    closures = [
        ClosureResult(c.query, c.match, state, float(state is ClosureState.USED), 2.0, 0.0) for c in graph.closures
    ]
    return GraphSolution(components, tuple(closures))


def step(job: StepConsensus, moved: float = 0.0, gap: float = 0.0, **changes: Any) -> ConsensusStep:
    problem = job.problem
    told = {other: ToldPoses(np.zeros(3), rows(len(shared.keyframes))) for other, shared in problem.shared.items()}
    information = {
        other: np.ones((len(shared.keyframes), 2)) for other, shared in problem.shared.items() if problem.log < other
    }
    T = np.repeat(np.eye(4)[None], len(problem.trajectory), axis=0)
    done = ConsensusStep(ConsensusState(), T, np.eye(4), told, information, moved, gap, 1.0)
    return replace(done, **changes)


def rows(count: int, shift_m: float = 0.0) -> Float:
    made = np.zeros((count, 13))
    made[:, 0], made[:, 3] = shift_m, 1.0
    return made


def said(
    anchor: LogId,
    number: int,
    edition: int = 1,
    keyframes: tuple[int, ...] = (),
    shift_m: float = 0.0,
    count: int = 1,
    origin_step: int = 0,
) -> SharedPoses:
    information = Array.of(np.ones((len(keyframes), 2)))
    origin, none = pose7(np.eye(4)), Array.of(np.zeros(0))
    base_m, told = Array.of(np.zeros(3), "f8"), Array.of(rows(count, shift_m))
    return SharedPoses(anchor, number, origin, origin_step, edition, keyframes, information, base_m, told, 0, 0, none)


def jobs(effects: list[Effect]) -> list[StepConsensus]:
    return [effect for effect in effects if isinstance(effect, StepConsensus)]


def choices(effects: list[Effect]) -> list[ChooseClosures]:
    return [effect for effect in effects if isinstance(effect, ChooseClosures)]


def told(effects: list[Effect]) -> dict[str, SharedPoses]:
    return {e.to: e.message for e in effects if isinstance(e, Unicast) and isinstance(e.message, SharedPoses)}


def reasons(effects: list[Effect]) -> list[str]:
    return [e.fact.reason for e in effects if isinstance(e, Report) and isinstance(e.fact, PeerRefused | RoundFailed)]


def test_the_lower_robot_has_both_logs_solved_and_tells_the_list_until_the_other_has_it() -> None:
    bench = Bench()
    effects, _ = bench.turn(0.0)
    (choice,) = choices(effects)
    assert set(choice.graph.trajectories) == {B, C}
    assert [c.query for c in choice.graph.closures] == [KeyframeId(C, 0)]
    effects, (job,) = bench.turn(0.2)
    assert job.problem.shared[C].keyframes == (KeyframeId(C, 0),)
    assert [each.closure.query for each in job.problem.owned] == [KeyframeId(C, 0)]
    first = told(effects)["c"]
    assert first.keyframes == (0,)
    assert first.information.numpy().tolist() == [[1.0, 1.0]]
    bench.b.on_shared_poses(C, said(C, 3, edition=first.edition), 0.3)
    effects, _ = bench.turn(1.5)
    assert told(effects)["c"].keyframes == ()


def test_an_unknown_scale_begins_where_it_was_found() -> None:
    bench = Bench().shares()
    bench.b._has_news = True
    _, (job,) = bench.turn(1.0)
    assert [each.scale for each in job.problem.owned] == [2.0]


@pytest.mark.parametrize(("state", "parted"), [(ClosureState.REJECTED, False), (ClosureState.USED, True)])
def test_what_the_solver_rejects_or_leaves_apart_is_not_shared(state: ClosureState, parted: bool) -> None:
    bench = Bench()
    bench.turn(0.0, state, parted)
    effects, asked = bench.turn(0.2)
    assert told(effects) == {}
    assert all(job.problem.owned == () and job.problem.shared == {} for job in asked)


def test_nobody_out_of_range_is_told_anything() -> None:
    bench = Bench(near={"a"})
    bench.turn(0.0)
    effects, asked = bench.turn(0.2)
    assert len(asked) == 1
    assert told(effects) == {}


def test_the_higher_robot_takes_the_list_that_its_own_closures_bear_out() -> None:
    bench = Bench()
    bench.turn(0.0)
    for wrong in (said(B, 1, 7, (2,)), said(B, 1, 7, (9,)), said(B, 1, 7)):
        bench.b.on_shared_poses(A, wrong, 0.1)
        _, asked = bench.turn(0.2)
        assert all(A not in job.problem.shared for job in asked)
    bench.b.on_shared_poses(A, said(B, 2, 7, (1,)), 0.3)
    effects, (job,) = bench.turn(0.5)
    assert job.problem.shared[A].keyframes == (KeyframeId(B, 1),)
    assert job.problem.shared[A].told is not None
    assert told(effects)["a"].edition == 7
    assert told(effects)["a"].keyframes == ()


def test_an_older_list_and_what_is_told_of_another_one_count_for_nothing() -> None:
    bench = Bench().shares()
    bench.b.on_shared_poses(A, said(B, 2, 7, (1,)), 0.3)
    bench.turn(0.5)
    bench.b.on_shared_poses(A, said(B, 3, 6, (1,), shift_m=5.0), 0.6)
    edition = told(bench.b._said())["c"].edition
    bench.b.on_shared_poses(C, said(B, 3, edition + 1, shift_m=5.0), 0.6)
    bench.b._has_news = True
    _, (job,) = bench.turn(2.0)
    assert [shared.told for shared in job.problem.shared.values()] == [None, None]
    assert job.problem.shared[A].edition == 7


def test_it_moves_into_the_frame_of_a_lower_anchor_and_never_back() -> None:
    bench = Bench().shares()
    bench.b.on_shared_poses(A, said(A, 2, 7, (1,), origin_step=4), 0.3)
    _, (job,) = bench.turn(0.5, aligned=True)
    assert job.problem.move_to is not None
    assert job.problem.move_to[0] == A
    assert bench.b.anchor == A
    edition = told(bench.b._said())["c"].edition
    bench.b.on_shared_poses(C, said(C, 9, edition), 0.6)
    _, (job,) = bench.turn(1.6)
    assert job.problem.move_to is None
    assert job.problem.shared[C].told is None
    assert not job.problem.anchored


def test_a_robot_whose_last_shared_closure_is_taken_back_is_in_its_own_frame_again() -> None:
    bench = Bench(Source(seen=(SEEN[0],)))
    bench.turn(0.0)
    bench.b.on_shared_poses(A, said(A, 2, 7, (1,)), 0.3)
    bench.turn(0.5, aligned=True)
    assert bench.b.anchor == A
    bench.b._pairs[A].keyframes = ()
    bench.b._has_news = True
    bench.turn(2.0)
    assert bench.b.anchor == B


def test_a_pair_is_chosen_anew_when_its_closures_change_but_not_at_once() -> None:
    bench = Bench().shares()
    edition = told(bench.b._said())["c"].edition
    bench.source.seen += ((KeyframeId(C, 2), KeyframeId(B, 0)),)
    bench.source.revision += 1
    assert not choices(bench.turn(1.0)[0])
    effects, _ = bench.turn(PARAMETERS.choose_s)
    assert len(choices(effects)) == 1
    effects, _ = bench.turn(PARAMETERS.choose_s + 0.2)
    assert told(effects)["c"].keyframes == (0, 2)
    assert told(effects)["c"].edition > edition


@pytest.mark.parametrize("doubt", ["", "it may be a twin"])
def test_closures_that_are_taken_back_or_doubted_are_shared_no_more(doubt: str) -> None:
    bench = Bench().shares()
    bench.b.on_shared_poses(A, said(B, 2, 7, (1,)), 0.3)
    assert bench.b._pairs[A].keyframes
    assert bench.b._pairs[C].keyframes
    bench.source.seen, bench.source.doubt = SEEN if doubt else (), doubt
    bench.source.revision += 1
    bench.turn(PARAMETERS.choose_s, ClosureState.EXCLUDED)
    bench.turn(PARAMETERS.choose_s + 0.2, ClosureState.EXCLUDED)
    assert bench.b._pairs[A].keyframes == bench.b._pairs[C].keyframes == ()


def test_closures_that_were_taken_back_are_used_no_more_and_others_in_their_place_are_chosen() -> None:
    within = (KeyframeId(B, 0), KeyframeId(B, 2))
    bench = Bench(Source(seen=(SEEN[1], within)))
    bench.turn(0.0)
    bench.turn(0.2)
    bench.turn(0.4)
    assert {each.ends for each in bench.b._owned()} == {SEEN[1], within}
    instead = (KeyframeId(C, 1), KeyframeId(B, 3))
    bench.source.seen = (instead, within)
    bench.source.revision += 1
    for now in (10.0, 10.2, 10.4):
        bench.turn(now)
    assert {each.ends for each in bench.b._owned()} == {instead, within}
    bench.source.seen = ()
    bench.source.revision += 1
    for now in (20.0, 20.2, 20.4, 20.6):
        _, asked = bench.turn(now)
    assert bench.b._owned() == ()
    assert bench.b.shares_with() == ()
    assert [job.problem.shared for job in asked] == [{}] * len(asked)
    assert bench.b.has_chosen


def test_another_measurement_between_the_same_keyframes_is_chosen_anew() -> None:
    bench = Bench().shares()
    bench.source.shift_m = 1.0
    bench.source.revision += 1
    assert len(choices(bench.turn(PARAMETERS.choose_s + 1.0)[0])) == 1


def test_a_list_that_its_own_logs_bear_out_no_more_is_dropped_by_the_higher_robot() -> None:
    bench = Bench(Source(seen=(SEEN[0],)))
    bench.turn(0.0)
    bench.b.on_shared_poses(A, said(A, 2, 7, (1,)), 0.3)
    bench.turn(0.5, aligned=True)
    assert bench.b.shares_with() == (A,)
    bench.source.seen = ()
    bench.source.revision += 1
    _, (job,) = bench.turn(2.0)
    assert bench.b.shares_with() == ()
    assert job.problem.shared == {}
    assert bench.b.anchor == B
    (asks,) = told(bench.b.on_shared_poses(A, said(A, 4, 7), 2.1)).values()
    assert asks.edition == 0
    bench.b.on_shared_poses(A, said(A, 5, 8, (1,)), 2.2)
    assert bench.b.shares_with() == ()


def test_a_failed_or_overdue_choice_is_made_again_after_a_growing_pause() -> None:
    bench = Bench()
    (choice,) = choices(bench.b.tick(0.0))
    assert reasons(bench.b.on_choice_failed(choice.number, "singular", 0.0)) == ["singular"]
    assert not choices(bench.b.tick(9.0))
    (again,) = choices(bench.b.tick(10.0))
    assert bench.b.on_chosen(choice.number, solution(choice.graph), 10.0) == []
    assert "it took too long" in reasons(bench.b.tick(20.0))
    assert bench.b.on_chosen(again.number, solution(again.graph), 20.0) == []


def test_more_than_the_maximum_are_not_shared() -> None:
    length = SHARED_MAX + 50
    seen = tuple((KeyframeId(C, k), KeyframeId(B, k)) for k in range(length))
    bench = Bench(Source(seen=seen, length=length))
    bench.turn(0.0)
    _, (job,) = bench.turn(0.2)
    assert len(job.problem.shared[C].keyframes) == SHARED_MAX
    assert len(job.problem.owned) == SHARED_MAX
    assert {max(each.closure.query, each.closure.match) for each in job.problem.owned} == set(
        job.problem.shared[C].keyframes
    )


def test_it_waits_for_news_of_neighbours_in_range_but_not_for_ever() -> None:
    bench = Bench().shares()
    edition = told(bench.b._said())["c"].edition
    bench.b.on_shared_poses(C, said(B, 3, edition), 0.2)
    bench.turn(0.4, moved=1.0)
    assert not bench.turn(0.7)[1]
    assert bench.turn(1.5)[1]
    bench.b.on_shared_poses(C, said(B, 4, edition, shift_m=1.0), 1.6)
    assert bench.turn(1.8)[1]


def test_at_rest_it_repeats_itself_at_a_rate_that_falls_to_a_bound() -> None:
    bench = Bench().shares()
    times: list[float] = []
    now = 0.2
    while len(times) < 5:
        bench.b.component(now)
        now = bench.b.deadline()
        effects, asked = bench.turn(now)
        assert not asked
        times += [now] if told(effects) else []
    assert np.allclose(np.diff([0.2, *times]), [0.5, 1.0, 2.0, 2.0, 2.0])


def test_two_that_come_no_nearer_to_each_other_rest_all_the_same() -> None:
    bench = Bench().shares()
    edition = told(bench.b._said())["c"].edition
    now, steps = 1.0, 0
    for number in range(3 * VAIN_STEPS_MAX):
        now += 0.5
        bench.b.on_shared_poses(C, said(B, 10 + number, edition, shift_m=1.0), now)
        steps += len(bench.turn(now, gap=1.0)[1])
    assert VAIN_STEPS_MAX - 2 <= steps <= VAIN_STEPS_MAX + 2


def test_who_tells_what_cannot_be_is_named() -> None:
    bench = Bench().shares()
    bench.b._has_news = True
    effects, _ = bench.turn(1.0, refused={C: "no stiffness"})
    assert reasons(effects) == ["shared poses: no stiffness"]
    bench.b.on_shared_poses(C, said(B, 30, 1), 1.1)
    bench.b._has_news = True
    assert [job.problem.shared for job in bench.turn(3.0)[1]] == [{}]
    bench.b._has_news = True
    assert [list(job.problem.shared) for job in bench.turn(1.0 + DISTRUSTED_FIRST_S)[1]] == [[C]]


def test_what_its_own_log_contradicts_for_long_makes_it_go_on_alone() -> None:
    bench = Bench().shares()
    bench.b.on_shared_poses(A, said(A, 2, 7, (1,)), 0.3)
    bench.turn(0.5, aligned=True)
    assert bench.b.on_judged("torn", 1.0) == []
    assert bench.b.on_judged(None, 2.0) == []
    assert bench.b.on_judged("torn", 3.0) == []
    assert bench.b.on_judged("torn", 2.9 + HELD_BACK_S) == []
    effects = bench.b.on_judged("torn", 3.0 + HELD_BACK_S)
    assert reasons(effects) == ["shared poses: torn: it goes on alone"]
    assert bench.b.anchor == B
    bench.b.on_shared_poses(A, said(A, 5, 8, (1,)), 14.0)
    _, (job,) = bench.turn(15.0)
    assert A not in job.problem.shared
    assert job.problem.state is None


FAR = Apart(m=50.0, strain=9.0)


def test_while_neighbours_are_too_far_away_it_does_not_correct_itself() -> None:
    bench = Bench().shares()
    assert bench.b.component(0.2) is not None
    bench.b._has_news = True
    bench.turn(3.0, apart={C: FAR})
    assert bench.b.component(3.0) is None
    assert bench.b.deadline() > 3.0
    bench.b._has_news = True
    bench.turn(4.0, apart={C: Apart(0.1, 0.1)})
    assert bench.b.component(4.0) is not None
    bench.b._has_news = True
    bench.turn(7.0, apart={C: FAR})
    assert bench.b.component(7.0 + SILENT_S) is not None


def test_one_that_comes_apart_is_named_and_not_heard_and_it_goes_back_to_where_it_agreed() -> None:
    bench = Bench().shares()
    edition = told(bench.b._said())["c"].edition
    bench.b._has_news = True
    bench.turn(1.0, apart={C: Apart(0.1, 0.1)})
    agreed = bench.b._state
    found: list[str] = []
    for k in range(CONTACTS):
        bench.b._has_news = True
        effects, _ = bench.turn(2.0 + k, apart={C: FAR})
        found += reasons(effects)
    assert found == [f"shared poses: {CAME_APART}"]
    assert told(bench.b._said()) == {}
    bench.b.on_shared_poses(C, said(B, 30, edition), 8.0)
    _, (job,) = bench.turn(9.0)
    assert job.problem.state is agreed
    assert job.problem.shared == {}
    _, (later,) = bench.turn(2.0 + CONTACTS + DISTRUSTED_FIRST_S)
    assert later.problem.shared[C].edition > edition
    assert later.problem.shared[C].told is None


def test_one_that_lost_its_list_asks_for_it_and_is_told_a_new_one() -> None:
    higher = DistributedOptimisation(C, Source(), PARAMETERS, {"b"}.__contains__)
    bench = Bench().shares()
    first = told(bench.b._said())["c"]
    bench.b.on_shared_poses(C, said(B, 3, edition=first.edition), 0.3)
    silent = told(bench.b._said())["c"]
    assert silent.keyframes == ()
    (asks,) = told(higher.on_shared_poses(B, replace(silent, step=4), 0.4)).values()
    assert (asks.edition, len(asks)) == (0, 0)
    bench.b.on_shared_poses(C, replace(asks, step=4), 0.5)
    effects, _ = bench.turn(1.5)
    again = told(effects)["c"]
    assert again.edition > first.edition
    assert again.keyframes == (0,)


def test_what_a_step_found_of_an_older_list_is_not_told_of_the_new_one() -> None:
    bench = Bench().shares()
    bench.b._has_news = True
    (job,) = jobs(bench.b.tick(1.0))
    bench.b._list_anew(bench.b._pairs[C])
    assert told(bench.b.on_step(job.number, step(job), 1.1)) == {}


def test_a_stiffness_that_the_neighbour_has_is_not_told_again() -> None:
    bench = Bench().shares()
    edition = told(bench.b._said())["c"].edition
    stiff = {C: ToldPoses(np.zeros(3), rows(1), number=1, stiffness=np.ones(stiffness_numbers(1)))}
    bench.b._has_news = True
    effects, _ = bench.turn(1.0, told=stiff)
    assert len(told(effects)["c"].stiffness.numpy())
    bench.b.on_shared_poses(C, replace(said(B, 3, edition), known=1), 1.1)
    (said_again,) = told(bench.b._said()).values()
    assert (said_again.stiffness_number, len(said_again.stiffness.numpy())) == (1, 0)


def test_a_neighbour_that_fell_silent_is_forgotten_by_a_step_of_its_own() -> None:
    bench = Bench().shares()
    edition = told(bench.b._said())["c"].edition
    bench.b.on_shared_poses(C, said(B, 3, edition, shift_m=1.0), 0.3)
    bench.turn(0.5)
    assert not bench.turn(0.2 + SILENT_S)[1]
    _, (job,) = bench.turn(0.3 + SILENT_S)
    assert job.problem.shared[C].forgotten
    assert not bench.turn(1.0 + SILENT_S)[1]


def test_an_overdue_or_failed_step_is_tried_again_after_a_growing_pause() -> None:
    bench = Bench(Source(seen=()))
    (job,) = jobs(bench.b.tick(0.0))
    assert reasons(bench.b.tick(10.0)) == ["it took too long"]
    assert bench.b.on_step(job.number, step(job), 10.1) == []
    (second,) = jobs(bench.b.tick(10.4))
    bench.b.on_failed(second.number, "singular", 11.0)
    assert jobs(bench.b.tick(11.5)) == []
    assert jobs(bench.b.tick(11.8))


def test_corrections_come_at_most_once_per_period_and_name_the_anchor() -> None:
    bench = Bench().shares()
    bench.b.on_shared_poses(A, said(A, 2, 7, (1,)), 0.3)
    bench.turn(0.5, aligned=True)
    component = bench.b.component(0.5)
    assert component is not None
    assert component.anchor == A
    assert list(component.T_map_keyframe) == [B]
    bench.b._has_news = True
    bench.turn(2.0)
    assert bench.b.component(0.4 + DELIVER_PERIOD_S) is None
    assert bench.b.component(0.5 + DELIVER_PERIOD_S) is not None


def test_old_and_repeated_messages_begin_nothing() -> None:
    bench = Bench().shares()
    edition = told(bench.b._said())["c"].edition
    bench.b.on_shared_poses(C, said(B, 3, edition), 0.3)
    bench.turn(0.5)
    bench.b.on_shared_poses(C, said(B, 3, edition), 0.6)
    bench.b.on_shared_poses(C, said(B, 2, edition, shift_m=9.0), 0.6)
    assert not bench.turn(5.0)[1]
