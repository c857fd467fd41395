"""Closures that are held before the solve: single false ones, until a second one agrees; right ones are not."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.agent.backend.plain_team import plain_team

from flocc_agent.backend.alarms import held_closures
from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.pair_closures import measured
from flocc_agent.config import BackendConfig, Formulation
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, LoopClosure, PoseGraph
from flocc_agent.geometry import inverse, pose, so3_exp
from flocc_lab.graph_family.family_spec import Lengths
from flocc_lab.graph_family.graphs import Member
from flocc_lab.graph_family.methods import settings
from flocc_lab.graph_family.single_false import outcome
from flocc_lab.graph_family.team_walks import TeamSpec, team_graph
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
FIRST, SECOND = LogId("r00"), LogId("r01")


def two_robots(lengths: Lengths = Lengths.METRIC, noise_factor: float = 1.0, robots: int = 2) -> Member:
    noise = {"odometry_factor": noise_factor, "closure_factor": noise_factor}
    return plain_team(8, (120,) * robots, lengths=lengths, **noise)


def said(member: Member, query: KeyframeId, match: KeyframeId, error: Float) -> LoopClosure:
    """A metric closure that is wrong by a pose (4, 4)."""
    T_query, T_match = (member.T_world_keyframe[k.log][k.index] for k in (query, match))
    covariance = np.diag([1e-4] * 3 + [2.5e-3] * 3)
    return LoopClosure(query, match, inverse(T_query) @ T_match @ error, covariance=covariance, metric=True)


def held(member: Member, *more: LoopClosure, config: BackendConfig | None = None) -> dict[int, str]:
    closures = dict(enumerate([*member.graph.closures, *more]))
    return held_closures(member.graph.trajectories, closures, config or settings())


MOVED = pose(np.eye(3), np.array([8.0, 0.0, 0.0]))
TURNED = pose(so3_exp(np.array([0.0, 0.0, 1.2])), np.zeros(3))


@pytest.mark.parametrize("lengths", list(Lengths))
@pytest.mark.parametrize("noise_factor", [0.4, 1.0, 3.0])
def test_right_closures_are_not_held_even_where_noise_is_understated(lengths: Lengths, noise_factor: float) -> None:
    member = two_robots(lengths, noise_factor)
    assert len(held(member)) <= (0.05 * len(member.graph.closures) if noise_factor > 1.0 else 0)


def test_a_closure_that_moves_a_robot_further_than_uncertainties_allow_is_held() -> None:
    member = two_robots()
    false = said(member, KeyframeId(FIRST, 60), KeyframeId(SECOND, 60), MOVED)
    found = held(member, false)
    assert list(found) == [len(member.graph.closures)]
    assert found[len(member.graph.closures)].startswith(
        "closure r00/60 - r01/60: held until another one agrees with it, because it would move the robots by "
    )


def test_a_closure_that_turns_a_robot_is_held_and_the_sentence_says_so() -> None:
    member = two_robots()
    (reason,) = held(member, said(member, KeyframeId(FIRST, 60), KeyframeId(SECOND, 60), TURNED)).values()
    assert "it would turn the robots by " in reason


def test_a_closure_within_a_robot_that_bends_its_way_is_held() -> None:
    member = two_robots()
    false = said(member, KeyframeId(FIRST, 10), KeyframeId(FIRST, 50), MOVED)
    assert list(held(member, false)) == [len(member.graph.closures)]


def test_it_is_released_when_a_second_one_agrees() -> None:
    member = two_robots()
    T_world = member.T_world_keyframe
    anchor = T_world[FIRST][10] @ MOVED @ inverse(T_world[FIRST][10])
    pairs = [(KeyframeId(FIRST, 10 + n), KeyframeId(FIRST, 50 + n)) for n in range(2)]
    agreeing = [
        replace(
            said(member, query, match, np.eye(4)),
            T_query_match_unscaled=inverse(T_world[FIRST][query.index]) @ anchor @ T_world[FIRST][match.index],
        )
        for query, match in pairs
    ]
    assert len(held(member, agreeing[0])) == 1
    assert held(member, *agreeing) == {}


def test_a_closure_whose_scale_would_collapse_is_held() -> None:
    member = two_robots(Lengths.GUESSED)
    T = member.T_world_keyframe
    chosen = max(
        (c for c in member.graph.closures if c.query.log != c.match.log),
        key=lambda c: float(
            np.linalg.norm(T[c.query.log][c.query.index][:3, 3] - T[c.match.log][c.match.index][:3, 3])
        ),
    )
    beside = chosen.query._replace(index=chosen.query.index + (1 if chosen.query.index == 0 else -1))
    reversed_T = inverse(T[beside.log][beside.index]) @ T[chosen.match.log][chosen.match.index]
    reversed_T[:3, 3] *= -1.0
    false = replace(chosen, query=beside, T_query_match_unscaled=reversed_T, scale_initial=1.0)
    (reason,) = held(member, false).values()
    assert "its scale would collapse" in reason


@pytest.mark.parametrize("seed", [78, 80, 91, 109])
def test_false_closures_that_agree_with_one_other_but_not_with_several_are_held(seed: int) -> None:
    """One without a length leaves its direction open, and nearly anything agrees with it."""
    found = outcome(seed)
    assert found is not None
    assert (found.damages, found.held, found.held_long) == (True, True, 0)


def test_the_only_closure_of_two_robots_is_compared_by_way_of_third_ones() -> None:
    member = two_robots(robots=3)
    third = LogId("r02")
    others = [c for c in member.graph.closures if {c.query.log, c.match.log} != {FIRST, third}]
    others += [said(member, KeyframeId(SECOND, k), KeyframeId(third, k), np.eye(4)) for k in (50, 60, 70)]
    member = replace(member, graph=PoseGraph(member.graph.trajectories, others))
    ends = KeyframeId(FIRST, 60), KeyframeId(third, 60)
    assert held(member, said(member, *ends, np.eye(4))) == {}
    assert list(held(member, said(member, *ends, MOVED))) == [len(others)]


def test_the_solution_excludes_it_warns_and_is_as_without_it() -> None:
    member = two_robots()
    false = said(member, KeyframeId(FIRST, 60), KeyframeId(SECOND, 60), MOVED)
    plain = optimise(member.graph, settings())
    solution = optimise(PoseGraph(member.graph.trajectories, [*member.graph.closures, false]), settings())
    assert isinstance(solution, GraphSolution)
    assert isinstance(plain, GraphSolution)
    assert solution.closures[-1].state is ClosureState.EXCLUDED
    assert any("held until another one agrees" in warning for warning in solution.warnings)
    moved = solution.components[0].T_map_keyframe[SECOND] - plain.components[0].T_map_keyframe[SECOND]
    assert np.abs(moved).max() < 1e-6


def test_measurements_that_count_as_given_are_not_held() -> None:
    member = two_robots()
    false = said(member, KeyframeId(FIRST, 60), KeyframeId(SECOND, 60), MOVED)
    assert held(member, false, config=settings(formulation=Formulation.BASE)) == {}


def test_directions_of_robots_far_from_each_other_are_not_taken_for_exact_ones() -> None:
    """Twenty metres apart, a direction that is known to half a degree says little of metres."""
    team = team_graph(TeamSpec(seed=1, robots=3, poses=60)).without_lengths()
    assert held_closures(team.graph.trajectories, dict(enumerate(team.graph.closures)), settings()) == {}


def test_a_false_direction_between_robots_far_from_each_other_is_held() -> None:
    team = team_graph(TeamSpec(seed=1, robots=3, poses=60)).without_lengths()
    closures = dict(enumerate(team.graph.closures))
    k, right = next((k, c) for k, c in closures.items() if c.query.log != c.match.log)
    closures[k] = replace(right, T_query_match_unscaled=right.T_query_match_unscaled @ TURNED)
    assert list(held_closures(team.graph.trajectories, closures, settings())) == [k]


def test_the_variance_of_a_direction_grows_with_the_square_of_its_length() -> None:
    closure = LoopClosure(
        KeyframeId(FIRST, 0), KeyframeId(SECOND, 0), pose(np.eye(3), np.array([1.0, 0.0, 0.0])),
        covariance=np.diag([1e-4] * 3 + [4e-4] * 3),
    )  # fmt: skip
    metric = replace(closure, metric=True)
    found = measured([0, 1], {0: closure, 1: metric}, settings()).with_lengths(np.array([20.0, 20.0]))
    np.testing.assert_allclose(found.length_m, [20.0, 1.0])
    np.testing.assert_allclose(found.translation, [0.02**2 * 20.0**2, 0.02**2])
    np.testing.assert_allclose(found.translation_at(np.array([10.0, 10.0])), [0.02**2 * 30.0**2, 0.02**2])


@pytest.mark.parametrize("every", [False, True])
def test_closures_that_are_doubted_join_nothing_and_count_where_others_agree(every: bool) -> None:
    member = two_robots()
    across = [c for c in member.graph.closures if {c.query.log, c.match.log} == {FIRST, SECOND}]
    of_one_place = across if every else across[:5]
    closures = [replace(c, doubt="it may be a twin") if c in of_one_place else c for c in member.graph.closures]
    found = optimise(PoseGraph(member.graph.trajectories, closures), settings())
    assert isinstance(found, GraphSolution)
    states = {result.state for result, c in zip(found.closures, closures, strict=True) if c.doubt}
    assert states == {ClosureState.EXCLUDED if every else ClosureState.USED}
    assert len(found.components) == (2 if every else 1)
    assert any("it may be a twin" in warning for warning in found.warnings) == every
