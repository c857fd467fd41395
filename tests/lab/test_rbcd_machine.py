"""The machine of a distributed optimisation: what it says, when it iterates, and into which frame it moves."""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure, PoseGraph, Trajectory
from flocc_lab.rbcd.blocks import BlockState, BlockStep
from flocc_lab.rbcd.machine import Effect, IterateBlock, RbcdMachine, RbcdParameters
from flocc_lab.rbcd.separators import Separators
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

Float = NDArray[np.float64]

A, B, C = LogId("a"), LogId("b"), LogId("c")
PARAMETERS = RbcdParameters(period_s=0.2, wait_s=1.0, repeat_s=0.5, repeat_max_s=2.0)


def three_robots() -> PoseGraph:
    """b/1 saw a/2, c/0 saw b/3, four keyframes each."""
    trajectories = {log: Trajectory(np.repeat(np.eye(4)[None], 4, axis=0)) for log in (A, B, C)}
    seen = [(KeyframeId(B, 1), KeyframeId(A, 2)), (KeyframeId(C, 0), KeyframeId(B, 3))]
    return PoseGraph(trajectories, [LoopClosure(query, match, np.eye(4)) for query, match in seen])


def machine(own: LogId = B) -> RbcdMachine:
    return RbcdMachine(own, three_robots(), PARAMETERS)


def lifted(shift_m: float = 0.0) -> Float:
    pose = np.eye(4, 3)
    pose[3] = shift_m
    return pose


def said(anchor: LogId, iteration: int, keyframe: int, shift_m: float = 0.0, epoch: int = 0) -> Separators:
    poses, origin = Array.of(lifted(shift_m)[None], "f8"), Array.of(lifted(), "f8")
    return Separators(anchor, iteration, epoch, origin, iteration, (keyframe,), poses, (), Array.of(np.zeros(0)))


def step(moved: float = 0.0, aligned: bool = False, finished: bool = True) -> BlockStep:
    X = np.repeat(np.eye(4, 3)[None], 4, axis=0)
    T = np.repeat(np.eye(4)[None], 4, axis=0)
    weights = {CandidatePair(KeyframeId(B, 3), KeyframeId(C, 0)): 0.25}
    return BlockStep(BlockState(X, X, weights=weights), T, lifted(), moved, aligned, finished, 0)


def jobs(effects: list[Effect]) -> list[IterateBlock]:
    return [effect for effect in effects if isinstance(effect, IterateBlock)]


def messages(effects: list[Effect]) -> list[Separators]:
    return [effect for effect in effects if isinstance(effect, Separators)]


def test_only_separators_and_the_weights_that_are_its_own_to_decide_are_said() -> None:
    b = machine()
    (job,) = jobs(b.tick(0.0))
    (message,) = messages(b.on_step(job.number, step(), 0.1))
    assert message.keyframes == (1, 3)
    assert message.pairs == (CandidatePair(KeyframeId(B, 3), KeyframeId(C, 0)),)
    assert message.weights.numpy().tolist() == [0.25]


def test_a_block_is_asked_about_its_own_closures_with_what_others_said_in_its_frame() -> None:
    b = machine()
    b.on_separators(C, said(B, 3, 0, shift_m=7.0))
    (job,) = jobs(b.tick(0.0))
    assert [str(end) for end in job.problem.others] == ["c/0"]
    assert job.problem.others[KeyframeId(C, 0)][3, 0] == 7.0
    assert {c.query.log for c in job.problem.closures} == {B, C}
    assert job.problem.anchored


def test_it_moves_into_the_frame_of_a_lower_anchor_and_never_back() -> None:
    b = machine()
    b.on_separators(A, said(A, 3, 2))
    (job,) = jobs(b.tick(0.0))
    assert list(job.problem.align_to) == [KeyframeId(A, 2)]
    b.on_step(job.number, step(aligned=True), 0.1)
    assert b.anchor == A
    b.on_separators(C, said(C, 3, 0))
    (later,) = jobs(b.tick(0.3))
    assert later.problem.align_to == {}
    assert not later.problem.anchored


def test_a_robot_that_could_not_be_aligned_stays_in_its_own_frame() -> None:
    b = machine()
    b.on_separators(A, said(A, 3, 2))
    (job,) = jobs(b.tick(0.0))
    b.on_step(job.number, step(aligned=False), 0.1)
    assert b.anchor == B


def test_it_waits_for_news_of_every_neighbour_but_not_for_ever() -> None:
    b = machine()
    b.on_separators(C, said(B, 3, 0))
    (job,) = jobs(b.tick(0.0))
    b.on_step(job.number, step(moved=1.0), 0.1)
    assert jobs(b.tick(0.3)) == []
    assert jobs(b.tick(1.0))  # wait_s is over, with the old pose
    again = machine()
    again.on_separators(C, said(B, 3, 0))
    (job,) = jobs(again.tick(0.0))
    again.on_step(job.number, step(moved=1.0), 0.1)
    again.on_separators(C, said(B, 4, 0, shift_m=1.0))
    assert jobs(again.tick(0.3))


def test_old_and_repeated_messages_begin_nothing() -> None:
    b = machine()
    b.on_separators(C, said(B, 3, 0))
    (job,) = jobs(b.tick(0.0))
    b.on_step(job.number, step(), 0.1)
    b.on_separators(C, said(B, 3, 0))
    b.on_separators(C, said(B, 2, 0, shift_m=9.0))
    assert jobs(b.tick(5.0)) == []
    assert b.is_settled


def test_separators_are_repeated_at_a_rate_that_falls_to_a_bound() -> None:
    b = machine()
    (job,) = jobs(b.tick(0.0))
    b.on_step(job.number, step(), 0.0)
    times = []
    now = 0.0
    for _ in range(5):
        now = b.deadline()
        if messages(b.tick(now)):
            times.append(now)
    assert np.allclose(np.diff([0.0, *times]), [0.5, 1.0, 2.0, 2.0, 2.0])


def test_weights_are_taken_only_from_the_robot_that_decides_them() -> None:
    b = machine()
    pair = CandidatePair(KeyframeId(A, 2), KeyframeId(B, 1))
    one = Array.of(np.ones(1))
    poses, origin = Array.of(lifted()[None], "f8"), Array.of(lifted(), "f8")
    b.on_separators(C, Separators(B, 1, 0, origin, 1, (0,), poses, (pair,), one))
    assert jobs(b.tick(0.0))[0].problem.heard == {}
    b.on_separators(A, Separators(A, 1, 0, origin, 1, (2,), poses, (pair,), one))
    b.on_step(1, step(), 0.1)
    assert jobs(b.tick(0.3))[0].problem.heard == {pair: 1.0}
