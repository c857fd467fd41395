"""Closures of one place that agree are one witness; robots that few right closures hold are found beside a facade."""

from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.placing import spanning
from flocc_agent.backend.votes import grouped, votes_of
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, LoopClosure, PoseGraph
from flocc_agent.geometry import inverse, pose, so3_exp
from flocc_lab.graph_family.family_campaign import verdict_of
from flocc_lab.graph_family.family_spec import Lengths, drawn
from flocc_lab.graph_family.graphs import Member, made, member
from flocc_lab.graph_family.methods import flocc, oracle, settings
from flocc_protocol.ids import KeyframeId, LogId

A, B, C = (LogId(f"r{k:02d}") for k in range(3))


def two_robots() -> Member:
    spec = replace(
        drawn(8), keyframes=(60, 60), scale_off=(1.0, 1.0), lengths=Lengths.METRIC, closures=2, outliers=0.0, groups=0
    )
    return made(replace(spec, odometry_factor=1.0, closure_factor=1.0, heavy_tails=False))


def said(member: Member, i: int, j: int, turned_rad: float = 0.0) -> LoopClosure:
    T = inverse(member.T_world_keyframe[A][i]) @ member.T_world_keyframe[B][j]
    wrong = pose(so3_exp(np.array([0.0, 0.0, turned_rad])), np.array([10.0 * turned_rad, 0.0, 0.0]))
    return LoopClosure(KeyframeId(A, i), KeyframeId(B, j), T @ wrong, covariance=np.diag([1e-4] * 6), metric=True)


def test_closures_that_agree_share_their_votes_and_wrong_ones_beside_them_take_none() -> None:
    member = two_robots()
    right = [said(member, 20 + k, 30 + k) for k in range(8)]
    wrong = [said(member, 20 + k, 30 + k, 0.7 * k) for k in range(1, 5)]
    closures = dict(enumerate([*right, *wrong]))
    found = votes_of(grouped(member.graph.trajectories, closures, closures, settings()))
    np.testing.assert_allclose(found, [8.0 ** (-2 / 3)] * 8 + [1.0] * 4)


def test_places_that_are_far_from_each_other_are_two_witnesses() -> None:
    member = two_robots()
    closures = dict(enumerate([said(member, 5, 5), said(member, 50, 50)]))
    found = votes_of(grouped(member.graph.trajectories, closures, closures, settings()))
    np.testing.assert_array_equal(found, [1.0, 1.0])


def test_only_pairs_that_join_something_new_can_be_what_holds_a_part() -> None:
    pairs = [frozenset((A, B)), frozenset((B, C)), frozenset((A, C))]
    assert spanning(pairs) == pairs[:2]


@pytest.mark.parametrize(
    ("seed", "kind"),
    [
        (975, "a ring of robots with one closure each"),
        (1162, "a repeated facade against two right closures"),
        (533, "a repeated facade against many right closures that bend odometry"),
    ],
)
def test_robots_that_few_right_closures_hold_are_where_those_say(seed: int, kind: str) -> None:
    graph = member(seed)
    verdict = verdict_of(graph, kind, flocc(settings()), oracle(graph))
    assert not verdict.failed
    assert verdict.wrong_kept <= 10  # a robot that nothing but a facade holds follows it


def test_many_right_closures_are_not_let_go_of_for_the_odometry_that_they_bend() -> None:
    drawn_member = member(1700)
    logs = {log for log in drawn_member.graph.trajectories if log.robot in ("r00", "r03", "r04")}
    closures = [c for c in drawn_member.graph.closures if {c.query.log, c.match.log} <= logs][::3]
    trajectories = {log: t for log, t in drawn_member.graph.trajectories.items() if log in logs}
    found = optimise(PoseGraph(trajectories, closures), settings())
    assert isinstance(found, GraphSolution)
    assert [component.logs for component in found.components] == [tuple(sorted(logs))]


def test_a_place_that_leaves_hardly_a_closure_is_none() -> None:
    drawn_member = member(2593)
    found = optimise(drawn_member.graph, settings())
    assert isinstance(found, GraphSolution)
    used = np.array([closure.state is ClosureState.USED for closure in found.closures])
    assert np.count_nonzero(used & drawn_member.is_right) > 45
    assert not np.any(used & ~drawn_member.is_right)
