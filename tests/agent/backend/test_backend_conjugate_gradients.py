"""Conjugate gradients against elimination: the same step, for every kind of edge."""

from functools import partial

import numpy as np
import pytest

from flocc_agent.backend import conjugate_gradients, linear
from flocc_agent.backend.conjugate_gradients import SEGMENT_POSES, segments_of
from flocc_agent.backend.edges import Edges, State, residuals, state_of
from flocc_agent.backend.initial import initial_poses
from flocc_agent.backend.linear import LinearSolver
from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.problem import Problem, build
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import GraphSolution
from flocc_lab.bench.generated_graph import GeneratedGraph, generate

FORMULATIONS = (Formulation.BASE, Formulation.INDEPENDENT, Formulation.SMOOTHED, Formulation.SHARED)


def generated(keyframes: int = 120, closures: int = 240, seed: int = 1) -> GeneratedGraph:
    return generate(np.random.default_rng(seed), 3, keyframes, closures)


def problem_of(graph: GeneratedGraph, formulation: Formulation) -> tuple[Problem, State]:
    config = BackendConfig(formulation=formulation)
    closures = dict(enumerate(graph.graph.closures))
    T_initial = initial_poses(graph.graph.trajectories, closures, 4.0, None)[0]
    problem = build(graph.graph.trajectories, closures, config)
    poses = [T_initial[log] for log in problem.logs]
    return problem, state_of(np.concatenate(poses), problem.clusters)


def steps(problem: Problem, state: State, weights: np.ndarray, hold: bool, damping: float) -> list[np.ndarray]:
    at = residuals(problem.edges, state, hold)
    solvers = (LinearSolver(0, 20.0, iterative_loops_min=least) for least in (1, 10**9))
    return [solver.step(problem.edges, state, at, weights, damping) for solver in solvers]


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Iterate until nothing is left."""
    monkeypatch.setattr(linear, "TOLERANCE_RATIO", 1e-9)
    monkeypatch.setattr(conjugate_gradients, "ITERATIONS_LEAST", 400)


def assert_same_step(iterated: np.ndarray, eliminated: np.ndarray) -> None:
    """The same but for rounding, and not because the iterations gave up and elimination did it."""
    assert not np.array_equal(iterated, eliminated)
    assert np.abs(eliminated).max() > 1e-3, "a step that tells nothing"
    np.testing.assert_allclose(iterated, eliminated, rtol=0.0, atol=1e-5 * np.abs(eliminated).max())


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("damping", [0.0, 100.0])
@pytest.mark.usefixtures("exact")
def test_both_ways_give_the_same_step(formulation: Formulation, damping: float) -> None:
    graph = generated()
    problem, state = problem_of(graph, formulation)
    weights = np.ones(len(problem.edges))
    weights[problem.closure_rows] = np.random.default_rng(1).choice([1.0, 0.3, 1e-6], len(problem.closure_ids))
    iterated, eliminated = steps(problem, state, weights, False, damping)
    assert_same_step(iterated, eliminated)
    np.testing.assert_array_equal(iterated[:6], 0.0)


@pytest.mark.usefixtures("exact")
def test_scales_that_are_held_at_their_bound_give_the_same_step() -> None:
    problem, state = problem_of(generated(), Formulation.SMOOTHED)
    folded = State(state.q, np.zeros_like(state.t), state.scale - 1.2)
    assert np.any(residuals(problem.edges, folded, hold=True).held)
    assert_same_step(*steps(problem, folded, np.ones(len(problem.edges)), True, 0.0))


def test_a_whole_solve_reaches_the_same_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = generated(keyframes=240, closures=900)
    config = BackendConfig(formulation=Formulation.SMOOTHED, solver=Solver.GNC_TLS, covariances=False)
    solutions = []
    for least in (1, 10**9):
        solver = partial(LinearSolver, iterative_loops_min=least)
        monkeypatch.setattr("flocc_agent.backend.posing.LinearSolver", solver)
        solutions.append(optimise(graph.graph, config))
    iterated, eliminated = solutions
    assert isinstance(iterated, GraphSolution)
    assert isinstance(eliminated, GraphSolution)
    assert iterated.components[0].cost == pytest.approx(eliminated.components[0].cost, rel=1e-5)
    assert [c.state for c in iterated.closures] == [c.state for c in eliminated.closures]


def test_a_system_that_needs_too_many_iterations_is_eliminated(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, state = problem_of(generated(), Formulation.INDEPENDENT)
    monkeypatch.setattr(conjugate_gradients, "ITERATIONS_MOST", 1)
    iterated, eliminated = steps(problem, state, np.ones(len(problem.edges)), False, 0.0)
    np.testing.assert_array_equal(iterated, eliminated)


def test_segments_end_where_a_chain_ends_and_the_fixed_pose_stands_alone() -> None:
    i = np.array([0, 1, 2, 5, 6])
    edges = _edges(np.concatenate([i, [0]]), np.concatenate([i + 1, [5]]))
    np.testing.assert_array_equal(segments_of(edges, 8, 0), [0, 1, 1, 1, 2, 3, 3, 3])
    long = np.arange(2 * SEGMENT_POSES + 1)
    segments = segments_of(_edges(long[:-1], long[1:]), len(long), 0)
    np.testing.assert_array_equal(np.bincount(segments), [1, SEGMENT_POSES, SEGMENT_POSES])


def _edges(i: np.ndarray, j: np.ndarray) -> Edges:
    n = len(i)
    L = np.zeros((n, 6, 6))
    return Edges(i, j, np.zeros((n, 4)), np.zeros((n, 6)), L, L, np.zeros(n), np.full(n, -1), np.zeros(n, dtype=bool))


@pytest.mark.parametrize("formulation", [Formulation.INDEPENDENT, Formulation.SMOOTHED])
def test_covariances_of_large_graphs_are_those_of_elimination(
    formulation: Formulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(linear, "MARGINALS_ELIMINATED_POSES_MAX", 0)
    problem, state = problem_of(generated(), formulation)
    at, weights = residuals(problem.edges, state, hold=False), np.ones(len(problem.edges))
    poses = [0, 119, problem.poses - 1]
    solvers = [LinearSolver(0, 20.0, iterative_loops_min=least) for least in (1, 10**9)]
    iterated, eliminated = (s.marginals(problem.edges, state, at, weights, poses) for s in solvers)
    for ours, theirs in zip(iterated, eliminated, strict=True):
        sigmas = np.sqrt(np.diag(theirs))
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-3 * np.outer(sigmas, sigmas).max())
        np.testing.assert_allclose(np.sqrt(np.diag(ours)), sigmas, rtol=1e-3)
    assert not np.array_equal(iterated[1], eliminated[1]), "both were eliminated"


def covariances(solution: GraphSolution) -> list[np.ndarray]:
    (component,) = solution.components
    found = [component.covariance_map_odom[log] for log in component.logs]
    return [S for S in found if S is not None]


def test_covariances_that_the_solver_leaves_over_are_those_of_the_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, config = generated().graph, BackendConfig(weight_by_probability=False)
    left_over = optimise(graph, config)
    monkeypatch.setattr(LinearSolver, "leaves_covariances", property(lambda _: False))
    monkeypatch.setattr(linear, "BESIDE_M", -1.0)
    anew = optimise(graph, config)
    assert isinstance(left_over, GraphSolution)
    assert isinstance(anew, GraphSolution)
    for ours, theirs in zip(covariances(left_over), covariances(anew), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0.02, atol=0.02 * np.abs(theirs).max())


def test_a_large_graph_s_covariances_stand_for_five_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    large = partial(LinearSolver, iterative_loops_min=1)
    monkeypatch.setattr("flocc_agent.backend.posing.LinearSolver", large)
    graph, config = generated().graph, BackendConfig(weight_by_probability=False)
    earlier: GraphSolution | None = None
    ages = []
    for _ in range(7):
        solution = optimise(graph, config, earlier)
        assert isinstance(solution, GraphSolution)
        ages.append(solution.components[0].covariance_rounds)
        assert len(covariances(solution)) == 3
        earlier = solution
    assert ages == [0, 1, 2, 3, 4, 0, 1]
