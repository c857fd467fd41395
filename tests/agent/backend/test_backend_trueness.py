"""Covariances grow where residuals say so: noise that is understated, and drift that keeps its direction."""

import numpy as np
import pytest
from tests.agent.backend.plain_team import plain_team

from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.trueness import window_variances
from flocc_agent.core.pose_graph import GraphSolution
from flocc_lab.bench.nees import asked, uncertainty
from flocc_lab.graph_family.graphs import Member
from flocc_lab.graph_family.methods import settings


def two_robots(noise_factor: float) -> Member:
    noise = {"odometry_factor": noise_factor, "closure_factor": noise_factor}
    return plain_team(8, (120, 120), odometry=(0.004, 0.02), planar=False, **noise)


def solved(member: Member) -> GraphSolution:
    solution = optimise(member.graph, settings(covariances=True), None, asked(member.graph))
    assert isinstance(solution, GraphSolution)
    return solution


def test_where_noise_is_as_stated_nothing_is_made_larger() -> None:
    (component,) = solved(two_robots(1.0)).components
    assert all(1.0 <= factor < 1.3 for factors in component.covariance_factors.values() for factor in factors)


def test_understated_noise_is_found_and_covariances_hold_the_truth() -> None:
    member = two_robots(2.0)
    (component,) = solved(member).components
    assert all(2.5 < rotation < 6.0 for rotation, _ in component.covariance_factors.values())
    found = uncertainty(component, member.T_world_keyframe)
    assert found is not None
    assert found.whole < 20.0


def test_drift_that_keeps_its_direction_is_found_though_every_step_is_within_its_noise() -> None:
    white = np.random.default_rng(3).normal(size=(8000, 6))
    assert window_variances(white) == pytest.approx((1.0, 1.0), abs=0.5)
    drifting = 0.3 * white
    drifting[:, 3:] += np.where(np.arange(8000) // 200 % 2 == 0, 0.3, -0.3)[:, None]
    rotation, translation = window_variances(drifting)
    assert np.mean(drifting[:, 3:] ** 2) < 0.25
    assert rotation < 0.3
    assert translation > 4.0


@pytest.mark.parametrize("steps", [0, 7])
def test_of_few_steps_nothing_is_said(steps: int) -> None:
    assert window_variances(np.full((steps, 6), 3.0)) == (1.0, 1.0)
