"""One step of a robot's part: it begins, moves into another's frame, and keeps what it heard when the list changes."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.backend.consensus_step import PartState, consensus_step
from flocc_agent.config import BackendConfig, Formulation
from flocc_agent.core.own_part import ConsensusProblem, ConsensusStep, OwnedClosure, SharedWith, ToldPoses
from flocc_agent.core.pose_graph import LoopClosure, OptimisationFailed, Trajectory
from flocc_agent.geometry import pose, so3_exp
from flocc_protocol.codec import COORDINATE_MAX
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.shared_poses import stiffness_numbers

Float = NDArray[np.float64]

A, B = LogId("a"), LogId("b")
CONFIG = BackendConfig(formulation=Formulation.BASE, weight_by_probability=False)
LENGTH = 6


def walk(log: LogId) -> Trajectory:
    """A straight way, in an odom frame of its own."""
    start = np.eye(4) if log == A else pose(so3_exp(np.array([0.0, 0.0, 0.7])), np.array([3.0, -2.0, 0.5]))
    steps = [start @ pose(np.eye(3), np.array([float(k), 0.0, 0.0])) for k in range(LENGTH)]
    return Trajectory(np.array(steps))


def owned(seen: tuple[int, ...]) -> tuple[OwnedClosure, ...]:
    """b's keyframes are where a's of the same number are, one metre to the left."""
    T = pose(np.eye(3), np.array([0.0, 1.0, 0.0]))
    closures = [LoopClosure(KeyframeId(A, k), KeyframeId(B, k), T, metric=True) for k in seen]
    return tuple(OwnedClosure(closure, 1.0, None, T) for closure in closures)


def problem(log: LogId, seen: tuple[int, ...] = (1, 3, 5), edition: int = 1, **changes: object) -> ConsensusProblem:
    other = B if log == A else A
    information = None if log == A else np.ones((len(seen), 2))
    shared = SharedWith(edition, tuple(KeyframeId(B, k) for k in seen), information)
    begins = ConsensusProblem(
        log, walk(log), owned(seen) if log == A else (), {other: shared}, np.zeros((0, 4, 4)), number=1, anchored=True
    )
    return replace(begins, **changes)  # type: ignore[arg-type]


def stepped(asked: ConsensusProblem) -> ConsensusStep:
    step = consensus_step(CONFIG, asked)
    assert isinstance(step, ConsensusStep)
    return step


def heard(asked: ConsensusProblem, told: ToldPoses, **changes: object) -> ConsensusProblem:
    ((other, shared),) = asked.shared.items()
    return replace(asked, shared={other: replace(shared, told=told)}, **changes)  # type: ignore[arg-type]


def test_two_robots_in_frames_of_their_own_come_together_in_the_lower_ones() -> None:
    a = stepped(problem(A))
    information = a.information[B]
    shared = replace(problem(B).shared[A], information=information)
    b = stepped(problem(B, shared={A: shared}, move_to=(A, a.told[B]), origin=a.origin, anchored=False))
    assert b.aligned
    for _ in range(30):
        a = stepped(heard(problem(A, state=a.state), b.told[A]))
        told = replace(shared, told=a.told[B])
        b = stepped(problem(B, shared={A: told}, state=b.state, origin=a.origin, anchored=False))
    assert max(a.gap, b.gap) < 1e-4
    expected = np.array([[k, 1.0, 0.0] for k in range(LENGTH)])
    assert np.allclose(b.T_map_keyframe[:, :3, 3], expected, atol=1e-3)
    assert np.allclose(a.T_map_keyframe[0], np.eye(4), atol=1e-9)


def test_a_robot_that_nothing_holds_stays_on_its_odometry() -> None:
    alone = problem(A, shared={}, owned=())
    step = stepped(replace(alone, trajectory=Trajectory(walk(A).T_odom_keyframe[:1])))
    later = stepped(replace(alone, state=step.state))
    assert np.allclose(later.T_map_keyframe, walk(A).T_odom_keyframe, atol=1e-9)


def test_where_poses_are_listed_anew_those_that_stay_are_pulled_as_before() -> None:
    first = stepped(problem(A))
    told = first.told[B]
    pulled = replace(told, rows=told.rows + np.array([0.02, *[0.0] * 6, *[0.5] * 6]))
    second = stepped(heard(problem(A, state=first.state), pulled))
    assert isinstance(second.state, PartState)
    before = second.state.pairs[B]
    where = np.array([second.state.copies[k] for k in before.keyframes])
    third = stepped(problem(A, (1, 2, 3, 5), edition=2, state=second.state))
    assert isinstance(third.state, PartState)
    after = third.state.pairs[B]
    assert after.edition == 2
    assert after.T is not None
    again = after.pull(after.T).reshape(-1, 6)
    assert np.allclose(again[[0, 2, 3]], before.pull(where).reshape(-1, 6), atol=1e-9)
    assert np.allclose(again[1], 0.0, atol=1e-9)


@pytest.mark.parametrize(("apart_m", "stands"), [(0.001, True), (5.0, False)])
def test_the_last_word_of_one_that_fell_silent_stands_where_both_had_agreed(apart_m: float, stands: bool) -> None:
    first = stepped(problem(A))
    far = replace(first.told[B], base_m=first.told[B].base_m + np.array([0.0, 0.0, apart_m]))
    second = stepped(heard(problem(A, state=first.state), far))
    assert isinstance(second.state, PartState)
    held = second.state.pairs[B]
    assert held.T is not None
    moved = second.state.moved(np.eye(4)) if stands else replace(second.state, pairs={B: replace(held, T=held.T + 1.0)})
    asked = problem(A, state=moved)
    silent = stepped(replace(asked, shared={B: replace(asked.shared[B], forgotten=True)}))
    assert isinstance(silent.state, PartState)
    assert (silent.state.pairs[B].T is not None) == stands


def test_what_cannot_be_is_refused_by_name_and_changes_nothing() -> None:
    first = stepped(problem(A))
    told = first.told[B]
    rows = told.rows.copy()
    rows[0, 8] = np.nan
    step = stepped(heard(problem(A, state=first.state), replace(told, rows=rows)))
    assert "not finite" in step.refused[B]
    assert np.allclose(step.T_map_keyframe, first.T_map_keyframe, atol=1e-9)


@pytest.mark.parametrize("seed", range(12))
def test_whatever_a_neighbour_lies_no_step_leads_out_of_the_map_and_it_is_named_or_alone(seed: int) -> None:
    """Poses, forces and stiffnesses of any size; what is told in answer can be said."""
    rng = np.random.default_rng(seed)
    a = stepped(problem(A))
    for number in range(2, 9):
        lie = rng.normal(size=(3, 13)) * 10.0 ** rng.uniform(0.0, (5.0, 5.0, 37.0)[seed % 3])
        lie[:, 3:7] /= np.linalg.norm(lie[:, 3:7], axis=1, keepdims=True)
        lie[:, :3] = np.clip(lie[:, :3], -1e5, 1e5)
        told = ToldPoses(np.zeros(3), lie)
        if number == 3:
            stiffness = np.abs(rng.normal(size=stiffness_numbers(3))) * 10.0 ** rng.uniform(-30.0, 30.0)
            told = replace(told, number=1, stiffness=stiffness)
        a = stepped(heard(problem(A, state=a.state, number=number), told))
        assert np.all(np.isfinite(a.T_map_keyframe))
        assert float(np.abs(a.T_map_keyframe[:, :3, 3]).max()) <= COORDINATE_MAX
        assert np.all(np.isfinite(np.float32(a.told[B].rows)))
        assert set(a.refused) <= {B}


def test_only_the_neighbour_is_named_whose_word_leads_out_of_the_map() -> None:
    C = LogId("c")
    ((_, shared),) = problem(A).shared.items()
    T = pose(np.eye(3), np.array([0.0, 2.0, 0.0]))
    with_c = OwnedClosure(LoopClosure(KeyframeId(A, 2), KeyframeId(C, 2), T, metric=True), 1.0, None, T)
    of_c = SharedWith(1, (KeyframeId(C, 2),), None)
    both = problem(A, shared={B: shared, C: of_c}, owned=(*owned((1, 3, 5)), with_c))
    first = stepped(both)
    lie = first.told[C].rows.copy()
    lie[:, 7:] = 1e37
    heard_both = {
        B: replace(shared, told=first.told[B]),
        C: replace(of_c, told=replace(first.told[C], rows=lie)),
    }
    step = stepped(replace(both, shared=heard_both, state=first.state, number=2))
    assert list(step.refused) == [C]
    assert isinstance(step.state, PartState)
    assert step.state.pairs[B].T is not None
    assert step.state.pairs[C].T is None


def test_odometry_that_is_not_rigid_is_said() -> None:
    T = walk(A).T_odom_keyframe.copy()
    T[2, 0, 0] = 7.0
    failed = consensus_step(CONFIG, problem(A, trajectory=Trajectory(T)))
    assert isinstance(failed, OptimisationFailed)
    assert "keyframe 2" in failed.reason
