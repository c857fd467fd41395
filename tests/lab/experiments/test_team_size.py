"""The size of the team: its smallest version, and how errors are read off solutions and held to the plot."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flocc_agent.core.pose_graph import ClosureResult, ClosureState, Component, GraphSolution
from flocc_agent.geometry import inverse, pose
from flocc_lab.experiments.experiment import Verdict
from flocc_lab.experiments.runner import run_experiment
from flocc_lab.experiments.team_size import (
    ALONE,
    METRIC,
    TEAM_SIZE,
    UNKNOWN,
    cells,
    f1_of,
    findings,
    robot_errors_m,
)
from flocc_lab.graph_family.team_walks import TeamGraph, TeamSpec, team_graph


def true_solution(team: TeamGraph, moved_m: float = 0.0) -> GraphSolution:
    """All robots in the frame of the first, the last one off by a way along z."""
    logs = tuple(team.T_world_keyframe)
    first = inverse(team.T_world_keyframe[logs[0]][0])
    poses = {log: first @ T for log, T in team.T_world_keyframe.items()}
    poses[logs[-1]] = pose(np.eye(3), np.array([0.0, 0.0, moved_m])) @ poses[logs[-1]]
    closures = tuple(ClosureResult(c.query, c.match, ClosureState.USED, 1.0, None, 0.0) for c in team.graph.closures)
    return GraphSolution((Component(logs, poses, {}, {}),), closures)


def test_the_truth_has_no_error_after_alignment_and_that_of_the_prior_without() -> None:
    team = team_graph(TeamSpec(1, 3, 60))
    assert robot_errors_m(team, true_solution(team), align=True) == pytest.approx([0.0] * 3, abs=1e-9)
    placed = robot_errors_m(team, true_solution(team), align=False)
    assert 1e-3 < max(placed) < 0.2


def test_a_robot_that_is_off_is_seen_and_alignment_shares_it() -> None:
    team = team_graph(TeamSpec(1, 3, 60))
    errors = robot_errors_m(team, true_solution(team, 1.0), align=False)
    assert errors[2] == pytest.approx(1.0, abs=0.1)
    assert max(errors[:2]) < 0.2
    shared = robot_errors_m(team, true_solution(team, 1.0), align=True)
    assert 0.05 < np.sum(np.square(shared)) < np.sum(np.square(errors))
    assert max(shared) < max(errors)


def test_f1_counts_wrong_closures_that_are_used() -> None:
    team = team_graph(TeamSpec(1, 3, 60, outlier_ratio=0.5))
    right = int(np.count_nonzero(team.is_right))
    assert f1_of(team, true_solution(team)) == pytest.approx(2 * right / (len(team.is_right) + right))
    assert f1_of(team.alone().until(1), GraphSolution((), ())) is None


def test_large_teams_have_fewer_graphs_and_runs_share_their_graphs() -> None:
    settings = TEAM_SIZE.settings.model_validate({"robots": [12, 24], "graphs": 4, "graphs_large": 2})
    found = [(cell.parameters["robots"], cell.run) for cell in cells(settings) if cell.parameters["arm"] == ALONE]
    assert found == [(12, 0), (12, 1), (12, 2), (12, 3), (24, 0), (24, 1)]


def level(robots: int, arm: str, mean_m: float, sum_m: float, published_m: float | None) -> dict[str, Any]:
    return {"robots": robots, "arm": arm, "iate_mean_m": mean_m, "iate_sum_m": sum_m, "published_m": published_m}


def test_one_aggregation_has_to_fit_all_sizes() -> None:
    fits = [level(3, METRIC, 0.17, 0.5, 0.17), level(6, METRIC, 0.13, 0.8, 0.14)]
    assert [f.verdict for f in findings(fits)] == [Verdict.CONFIRMED]
    each_its_own = [level(3, METRIC, 0.17, 0.5, 0.17), level(6, METRIC, 0.02, 0.14, 0.14)]
    assert [f.verdict for f in findings(each_its_own)] == [Verdict.CONTRADICTED]


def test_unknown_scales_are_held_to_their_ratio() -> None:
    rows = [level(6, METRIC, 0.14, 1.0, 0.14), level(6, UNKNOWN, 0.19, 1.0, None)]
    assert [f.verdict for f in findings(rows)] == [Verdict.CONFIRMED, Verdict.CONTRADICTED]


def test_the_smallest_version_runs_and_a_team_is_better_than_robots_alone(tmp_path: Path) -> None:
    settings = TEAM_SIZE.settings.model_validate(TEAM_SIZE.quick)
    result = run_experiment(TEAM_SIZE, settings, 1, tmp_path / "out")
    assert result.errors == []
    assert len(result.rows) == result.cells == 6
    by_arm = {arm: [row for row in result.rows if row["arm"] == arm] for arm in (ALONE, METRIC, UNKNOWN)}
    for alone, metric in zip(by_arm[ALONE], by_arm[METRIC], strict=True):
        assert metric["iate_placed_m"] < alone["iate_placed_m"]
    assert all(row["components"] == (3 if row["arm"] == ALONE else 1) for row in result.rows)
    assert {f"team-size.{kind}" for kind in ("csv", "md", "png", "svg")} <= {
        p.name for p in (tmp_path / "out").iterdir()
    }
