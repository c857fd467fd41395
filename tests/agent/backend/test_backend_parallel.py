"""Pairs of robots whose distance nothing observes are named; others are not."""

from dataclasses import replace

import pytest

from flocc_agent.backend.optimiser import optimise
from flocc_agent.core.pose_graph import GraphSolution
from flocc_lab.graph_family.family_spec import Lengths, Spec, drawn
from flocc_lab.graph_family.graphs import made
from flocc_lab.graph_family.methods import settings


def unobserved(spec: Spec) -> list[str]:
    solution = optimise(made(spec).graph, settings())
    assert isinstance(solution, GraphSolution)
    return [warning for warning in solution.warnings if warning.startswith("the distance between robots")]


def spec_of(seed: int, parallel: bool) -> Spec:
    spec = replace(drawn(seed), keyframes=(100, 90), scale_off=(1.0, 1.0), outliers=0.0, groups=0, weak=False)
    return replace(spec, parallel=parallel, opposite=False, lengths=Lengths.UNIT, closures=40, odometry_factor=1.0)


@pytest.mark.parametrize("seed", [96, 110, 257])
def test_two_parallel_lines_are_named(seed: int) -> None:
    (warning,) = unobserved(spec_of(seed, parallel=True))
    assert warning.startswith("the distance between robots r00 and r01 is not observable: ")


@pytest.mark.parametrize("seed", [1, 2, 4])
def test_robots_that_see_each_other_from_several_sides_are_not_named(seed: int) -> None:
    assert unobserved(spec_of(seed, parallel=False)) == []


def test_a_known_length_leaves_nothing_open() -> None:
    assert unobserved(replace(spec_of(110, parallel=True), lengths=Lengths.METRIC)) == []
