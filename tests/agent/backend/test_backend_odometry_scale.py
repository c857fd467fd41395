"""Scales of odometry: found, applied where they are demanded, told; left alone where odometry is true."""

from collections.abc import Mapping
from dataclasses import replace
from typing import NoReturn

import numpy as np
import pytest
from tests.agent.backend.plain_team import plain_team

from flocc_agent.backend import odometry_scale
from flocc_agent.backend.descent import Objective, Solved
from flocc_agent.backend.edges import State
from flocc_agent.backend.odometry_scale import SolvedWithScales, believed
from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.placing import Places
from flocc_agent.backend.solvers import solve_once
from flocc_agent.config import BackendConfig, Formulation
from flocc_agent.core.pose_graph import (
    ClosureState,
    Component,
    GraphSolution,
    OptimisationFailed,
    PoseGraph,
    stretched,
)
from flocc_lab.graph_family.family_spec import Lengths
from flocc_lab.graph_family.graphs import Member
from flocc_lab.graph_family.judge import judged
from flocc_lab.graph_family.methods import answer_of, settings
from flocc_lab.graph_family.team_walks import TeamSpec, team_graph
from flocc_protocol.ids import LogId

FIRST, SECOND = LogId("r00"), LogId("r01")


def measured(lengths: Lengths, seed: int = 5, closures: int = 120) -> Member:
    """Three robots with true odometry and a few wrong closures."""
    return plain_team(seed, (120, 130, 110), lengths=lengths, closures=closures, outliers=0.1)


def with_stretched(member: Member, ratios: Mapping[LogId, float]) -> Member:
    graph = member.graph
    ways = {log: stretched(t, ratios.get(log, 1.0)) for log, t in graph.trajectories.items()}
    return replace(member, graph=PoseGraph(ways, graph.closures))


def solved(member: Member, config: BackendConfig | None = None, initial: GraphSolution | None = None) -> GraphSolution:
    solution = optimise(member.graph, config or settings(), initial)
    assert isinstance(solution, GraphSolution)
    return solution


def component(solution: GraphSolution) -> Component:
    (joined,) = solution.components
    return joined


def ate_m(member: Member, solution: GraphSolution) -> float:
    answer = answer_of(solution, 0.0)
    return judged(member, "", answer, answer).ate_m


@pytest.mark.parametrize("ratio", [0.9, 0.95, 1.05, 1.1])
def test_a_robot_that_measures_too_long_or_too_short_costs_nothing(ratio: float) -> None:
    true = measured(Lengths.METRIC)
    off = with_stretched(true, {SECOND: ratio})
    solution = solved(off)
    scales = component(solution).odometry_scales
    assert [log for log, scale in scales.items() if scale.is_applied] == [SECOND]
    assert scales[SECOND].ratio == pytest.approx(ratio, abs=0.01)
    assert ate_m(off, solution) <= 1.3 * max(ate_m(true, solved(true)), 0.05)


def test_scales_are_not_believed_that_move_or_turn_closures_away_once_they_are_applied(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What refuses them here is measured in `test_closures_that_agree_and_pull_move_what_is_old`."""
    pairs: list[tuple[SolvedWithScales, SolvedWithScales]] = []

    def noted(before: SolvedWithScales, applied: SolvedWithScales) -> bool:
        pairs.append((before, applied))
        return False

    monkeypatch.setattr(odometry_scale, "believed", noted)
    member = plain_team(5, (120, 130, 110), lengths=Lengths.METRIC, closures=120)
    solution = solved(with_stretched(member, {SECOND: 0.97}))
    assert not any(scale.is_applied for scale in component(solution).odometry_scales.values())
    before, applied = pairs[0]
    assert believed(before, applied)
    moved = replace(applied.estimates, scale=applied.estimates.scale + 4.0 * np.hypot(before.estimates.sigma, 0.005))
    assert not believed(before, replace(applied, estimates=moved))
    fewer, none = applied.solved.weights.copy(), applied.solved.weights.copy()
    none[applied.posed.problem.closure_rows][:] = 0.0
    fewer[applied.posed.problem.closure_rows.start] = 0.0
    assert not believed(before, replace(applied, solved=replace(applied.solved, weights=none)))
    assert believed(before, replace(applied, solved=replace(applied.solved, weights=fewer)))  # paid for by the others
    assert not believed(applied, replace(applied, solved=replace(applied.solved, weights=fewer)))


def test_true_odometry_is_left_alone_and_nobody_is_warned() -> None:
    solution = solved(measured(Lengths.METRIC))
    scales = component(solution).odometry_scales
    assert sorted(scales) == [FIRST, SECOND, LogId("r02")]
    assert not any(scale.is_applied for scale in scales.values())
    assert all(abs(scale.ratio - 1.0) < 0.015 for scale in scales.values())
    assert not [warning for warning in solution.warnings if "lengths" in warning]


def test_the_warning_names_robot_and_per_cent() -> None:
    solution = solved(with_stretched(measured(Lengths.METRIC), {SECOND: 1.1}))
    (warning,) = [warning for warning in solution.warnings if "lengths" in warning]
    assert warning.startswith("odometry of robot r01 measures lengths ")
    assert " % too long" in warning
    assert warning.endswith("its poses are corrected")


def test_without_a_measurement_in_metres_only_ratios_are_found() -> None:
    off = with_stretched(measured(Lengths.GUESSED), {SECOND: 1.08})
    solution = solved(off)
    scales = component(solution).odometry_scales
    assert all(scale.is_applied and not scale.is_metric for scale in scales.values())
    assert np.mean([1.0 / scale.ratio for scale in scales.values()]) == pytest.approx(1.0, abs=1e-6)
    assert scales[SECOND].ratio / scales[FIRST].ratio == pytest.approx(1.08, abs=0.06)
    assert any("nothing was measured in metres" in warning for warning in solution.warnings)


def test_the_ways_themselves_are_as_long_as_the_scales_say() -> None:
    off = with_stretched(measured(Lengths.GUESSED), {SECOND: 1.08})
    joined = component(solved(off))
    for log, scale in joined.odometry_scales.items():
        lengths_m = [
            np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum()
            for T in (off.graph.trajectories[log].T_odom_keyframe, joined.T_map_keyframe[log])
        ]
        assert lengths_m[0] / lengths_m[1] == pytest.approx(scale.ratio, abs=0.01)


def test_measurements_that_count_as_given_keep_their_lengths() -> None:
    off = with_stretched(measured(Lengths.METRIC), {SECOND: 1.1})
    solution = solved(off, settings(formulation=Formulation.BASE))
    for joined in solution.components:
        assert not any(scale.is_applied for scale in joined.odometry_scales.values())


def test_a_warm_round_begins_with_the_scales_that_were_found() -> None:
    off = with_stretched(measured(Lengths.METRIC), {SECOND: 1.1})
    first = solved(off)
    again = solved(off, initial=first)
    assert component(again).odometry_scales[SECOND].is_applied
    assert again.iterations < first.iterations / 3
    moved_m = component(again).T_map_keyframe[SECOND] - component(first).T_map_keyframe[SECOND]
    assert np.abs(moved_m).max() < 0.02


def test_odometry_that_is_true_does_not_seem_too_long_where_its_steps_are_noisy() -> None:
    """A factor of what is noisy is found too small: that is 2 % here, and 0.4 % where the scale divides the poses."""
    ratios = []
    for seed in (1, 1001):
        found = optimise(team_graph(TeamSpec(seed=seed, robots=3, poses=100)).graph, settings())
        assert not isinstance(found, OptimisationFailed)
        ratios += [scale.ratio for component in found.components for scale in component.odometry_scales.values()]
    assert len(ratios) == 6
    assert abs(float(np.mean(ratios)) - 1.0) < 0.01


def test_what_most_closures_tell_surely_is_not_searched_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """One in twenty closures is wrong: no scale explains them."""

    def searched(*_: object) -> NoReturn:
        raise AssertionError("searched again")

    monkeypatch.setattr(odometry_scale, "solve_once", searched)
    member = plain_team(5, (120, 130, 110), lengths=Lengths.METRIC, closures=120, outliers=0.05)
    solution = solved(member)
    states = [closure.state is ClosureState.USED for closure in solution.closures]
    assert 0 < np.count_nonzero(~member.is_right) <= states.count(False)
    assert len(solution.components) == 1


def test_a_robot_that_uses_few_of_its_closures_is_searched_for_with_all_scales_free(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []

    def searched(objective: Objective, state: State, places: Places) -> Solved:
        asked.append(len(state.scale))
        return solve_once(objective, state, places)

    monkeypatch.setattr(odometry_scale, "solve_once", searched)
    solved(plain_team(5, (120, 130, 110), lengths=Lengths.METRIC, closures=120, outliers=0.5))
    assert asked == [3]
