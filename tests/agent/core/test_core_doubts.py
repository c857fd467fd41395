"""Which corrections are held against the graph: those that say something new."""

from typing import cast

import numpy as np
import pytest

from flocc_agent.core import plausibility
from flocc_agent.core.closure_rows import Tie
from flocc_agent.core.correction_evidence import HeldGraph, Placed
from flocc_agent.core.knots import Track, knots_of
from flocc_agent.core.plausibility import AGREE_M, BENT, HELD_BACK_S, SOLVED_S, SOLVES_EVERY_S, Doubts
from flocc_agent.core.pose_graph import Component
from flocc_protocol.ids import KeyframeId, LogId, Term
from flocc_protocol.messages import LogCorrection

OWN, LEADER = LogId("r2"), LogId("r1")
T_ODOM = np.tile(np.eye(4), (20, 1, 1))
T_ODOM[:, 0, 3] = np.arange(20)


class _Graph:
    def odometry(self, log: LogId) -> np.ndarray:
        return T_ODOM

    def ties(self, log: LogId, ties_max: int) -> list[Tie]:
        return [Tie(3, KeyframeId(LEADER, 4), 1.0), Tie(9, KeyframeId(OWN, 2), 1.0)]


def believed(monkeypatch: pytest.MonkeyPatch, *solved: np.ndarray) -> list[int]:
    """Numbers of those solutions that were looked at, of these that come one after the other."""
    looked: list[int] = []
    monkeypatch.setattr(plausibility, "contradiction", lambda placed, *_: looked.append(placed.own.round))
    doubts = Doubts(cast(HeldGraph, _Graph()))
    for k, T_map in enumerate(solved):
        T_map_odom, knots = knots_of(Track(T_ODOM, T_map, T_map[-1] @ np.linalg.inv(T_ODOM[-1]), None))
        assert (
            doubts.believes(Placed(LogCorrection(OWN, Term(1, LEADER), k, LEADER, T_map_odom, knots), {}), 0.0) is None
        )
    return looked


def moved(by_m: float, keyframe: int | slice = slice(None)) -> np.ndarray:
    T_map = T_ODOM.copy()
    T_map[keyframe, 1, 3] += by_m
    return T_map


def test_what_moves_no_keyframe_far_is_not_looked_at_again(monkeypatch: pytest.MonkeyPatch) -> None:
    assert believed(monkeypatch, moved(0.0), moved(0.9 * AGREE_M), moved(0.5 * AGREE_M)) == [0]
    assert believed(monkeypatch, moved(0.0), moved(1.1 * AGREE_M)) == [0, 1]
    assert believed(monkeypatch, moved(0.0), moved(1.1 * AGREE_M, 7)) == [0, 1]


def test_small_steps_do_not_lead_away_unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [moved(0.8 * AGREE_M * k) for k in range(6)]
    assert believed(monkeypatch, *steps) == [0, 2, 4]


def told(T_map: np.ndarray, version: int) -> LogCorrection:
    T_map_odom, knots = knots_of(Track(T_ODOM, T_map, T_map[-1] @ np.linalg.inv(T_ODOM[-1]), None))
    return LogCorrection(OWN, Term(1, LEADER), version, LEADER, T_map_odom, knots)


def solved(T_map: np.ndarray, anchor: LogId = LEADER) -> Component:
    return Component((anchor, OWN), {OWN: T_map}, {OWN: T_map[-1] @ np.linalg.inv(T_ODOM[-1])}, {OWN: None})


def doubting(monkeypatch: pytest.MonkeyPatch) -> Doubts:
    """It holds a correction back, and wants to solve the graph itself."""
    monkeypatch.setattr(plausibility, "contradiction", lambda *_: BENT)
    doubts = Doubts(cast(HeldGraph, _Graph()))
    assert doubts.believes(Placed(told(moved(50.0), 1), {}), 0.0) == BENT
    assert doubts.given_up(HELD_BACK_S) is None
    assert doubts.wants_solution
    assert doubts.rests_on() == {LEADER}
    return doubts


def test_what_an_own_solution_bears_out_is_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    doubts = doubting(monkeypatch)
    assert doubts.on_solution(solved(moved(50.0 + 0.9 * AGREE_M))) == told(moved(50.0), 1)
    assert doubts.believes(Placed(told(moved(50.5), 2), {}), HELD_BACK_S) is None
    assert not doubts.doubted


@pytest.mark.parametrize(
    "solution", [None, solved(moved(0.0)), solved(moved(50.0), LogId("r0")), solved(moved(50.0 + 1.1 * AGREE_M))]
)
def test_what_it_does_not_bear_out_is_refused(monkeypatch: pytest.MonkeyPatch, solution: Component | None) -> None:
    doubts = doubting(monkeypatch)
    assert doubts.on_solution(solution) is None
    assert doubts.given_up(HELD_BACK_S + 0.25) == BENT
    assert doubts.doubted == {LEADER}


def test_a_solution_that_does_not_come_is_not_waited_for_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    doubts = doubting(monkeypatch)
    assert doubts.given_up(HELD_BACK_S + SOLVED_S - 0.25) is None
    assert doubts.given_up(HELD_BACK_S + SOLVED_S) == BENT


def test_however_many_lies_come_few_solutions_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    doubts, asked, lies = doubting(monkeypatch), 1, 0
    doubts.on_solution(None)
    doubts.given_up(HELD_BACK_S)
    for now in np.arange(HELD_BACK_S, 10 * SOLVES_EVERY_S, 1.0):
        doubts.wants_solution = False
        lies += doubts.believes(Placed(told(moved(50.0 + now), 2 + int(now)), {}), now) is not None
        doubts.given_up(now)
        asked += doubts.wants_solution
        if doubts.wants_solution:
            doubts.on_solution(None)
    assert lies > 500
    assert asked <= 1 + 10
