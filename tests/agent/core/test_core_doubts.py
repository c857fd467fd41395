"""Which corrections are held against the graph: those that say something new."""

from typing import cast

import numpy as np
import pytest

from flocc_agent.core import plausibility
from flocc_agent.core.correction_evidence import HeldGraph, Placed
from flocc_agent.core.knots import Track, knots_of
from flocc_agent.core.plausibility import AGREE_M, Doubts
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import LogCorrection

OWN, LEADER = LogId("r2"), LogId("r1")
T_ODOM = np.tile(np.eye(4), (20, 1, 1))
T_ODOM[:, 0, 3] = np.arange(20)


class _Graph:
    def odometry(self, log: LogId) -> np.ndarray:
        return T_ODOM


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
