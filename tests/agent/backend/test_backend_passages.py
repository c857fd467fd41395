"""Closures of one place that close a long loop together are judged by what odometry allows, and taken in as one."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.agent.backend.plain_team import plain_team

from flocc_agent.backend.descent import Solved, descend
from flocc_agent.backend.initial import initial_poses
from flocc_agent.backend.passages import added_costs, passages
from flocc_agent.backend.posing import Posed, posed
from flocc_agent.backend.solvers import accepted, replaced, searching
from flocc_agent.core.pose_graph import LoopClosure
from flocc_agent.geometry import inverse, pose
from flocc_lab.graph_family.graphs import Member
from flocc_lab.graph_family.methods import settings
from flocc_protocol.ids import KeyframeId, LogId

A, B = LogId("r00"), LogId("r01")
JOINS = [(B, k, 4 * k) for k in range(5)]
"""Closures of both robots' first keyframes: they say nothing of A's later way."""
PASSAGE = [(A, 4 + k, 140 + k) for k in range(4)]


def said(member: Member, other: LogId, i: int, j: int, wrong_m: float = 0.0) -> LoopClosure:
    """A keyframe of A sees one of another log where it is, or so far beside it."""
    T = inverse(member.T_world_keyframe[A][i]) @ member.T_world_keyframe[other][j]
    T = T @ pose(np.eye(3), np.array([0.0, wrong_m, 0.0]))
    covariance = np.diag([1e-6] * 3 + [1e-5] * 3)
    return LoopClosure(KeyframeId(A, i), KeyframeId(other, j), T, covariance=covariance, metric=True)


def without_passage(wrong_m: float = 0.0) -> tuple[Posed, Solved, NDArray[np.bool_]]:
    """A team solved without the closures that close its long loop, and which ones (L,) those are."""
    member = plain_team(8, (150, 40), closures=2)
    seen = [*(said(member, *ends) for ends in JOINS), *(said(member, *ends, wrong_m) for ends in PASSAGE)]
    closures, config = dict(enumerate(seen)), settings()
    trajectories = {log: member.graph.trajectories[log] for log in (A, B)}
    aligned = initial_poses(trajectories, closures, config.steepness, None)
    component = posed(trajectories, closures, aligned, config, None)
    component = replace(component, objective=searching(component.objective))
    away = np.arange(len(seen)) >= len(JOINS)
    solved = descend(component.objective, component.start, component.objective.weights((~away).astype(float)))
    return component, solved, away


def test_a_passage_that_was_turned_away_is_taken_in_as_a_whole() -> None:
    component, solved, away = without_passage()
    assert np.all(component.objective.closure_residuals(solved.state)[away] > 10.0 * component.objective.bounds()[away])
    found = replaced(component.objective, solved, component.places)
    assert np.all(accepted(component.objective, found))


def test_what_a_passage_costs_is_told_without_solving() -> None:
    component, solved, away = without_passage()
    objective, groups = component.objective, [component.problem.closure_rows.start + np.flatnonzero(away)]
    (said_cost,) = added_costs(objective, solved.state, solved.weights, groups)
    assert said_cost == pytest.approx(descend(objective, solved.state, objective.weights()).cost - solved.cost, rel=0.1)


def test_a_passage_that_odometry_contradicts_is_not_tried() -> None:
    component, solved, away = without_passage(wrong_m=200.0)
    places = component.places
    assert not list(passages(component.objective, solved.state, ~away, places.votes, places.groups))
