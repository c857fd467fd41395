"""A robot's block: derivatives, manifold, rounding, and one robot's own optimum."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import LoopClosure, OptimisationFailed, Trajectory
from flocc_agent.geometry import inverse, pose, se3_exp, so3_exp
from flocc_lab.rbcd import block_descent
from flocc_lab.rbcd.block import iterate_block
from flocc_lab.rbcd.block_descent import Block, Links
from flocc_lab.rbcd.blocks import BlockProblem, BlockStep
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
RANK = 5


def random_poses(rng: np.random.Generator, count: int) -> Float:
    return np.array([pose(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(count)])


def random_lifted(rng: np.random.Generator, count: int) -> Float:
    X = rng.normal(size=(count, 4, RANK))
    X[:, :3] = block_descent.orthonormal(X[:, :3])
    return X


def random_block(rng: np.random.Generator) -> tuple[Block, Links, Float]:
    """Six poses in a chain, and two edges to another robot, one in each direction."""
    T = random_poses(rng, 7)
    links = Links(
        np.array([0, 1, 2, 3, 4, 2, -1]), np.array([1, 2, 3, 4, 5, -1, 4]), T,
        rng.uniform(1.0, 4.0, 7), rng.uniform(1.0, 4.0, 7),
        np.concatenate([np.zeros((5, 4, RANK)), random_lifted(rng, 2)]),
    )  # fmt: skip
    return Block(6, links), links, random_lifted(rng, 6)


def test_the_quadratic_form_is_half_the_sum_of_the_edges_costs() -> None:
    block, links, X = random_block(np.random.default_rng(1))
    X_i = np.where((links.i >= 0)[:, None, None], X[links.i], links.fixed)
    X_j = np.where((links.j >= 0)[:, None, None], X[links.j], links.fixed)
    costs = block_descent.squared_residuals(X_i, X_j, links.T, links.kappa, links.tau)
    assert block.cost(X) == pytest.approx(0.5 * costs.sum())


def test_gradient_and_hessian_agree_with_differences_along_the_manifold() -> None:
    rng = np.random.default_rng(2)
    block, _, X = random_block(rng)
    V = block_descent.projected(X, rng.normal(size=X.shape))
    step = 1e-4
    costs = [block.cost(block_descent.retracted(X, s * step * V)) for s in (-1.0, 0.0, 1.0)]
    assert (costs[2] - costs[0]) / (2 * step) == pytest.approx(np.sum(block.gradient(X) * V), rel=1e-5)
    second = (costs[2] - 2 * costs[1] + costs[0]) / step**2
    assert second == pytest.approx(np.sum(block.hessian(X, block.curvature(X), V) * V), rel=1e-4)


def test_a_descent_ends_where_the_gradient_is_gone_and_every_frame_is_orthonormal() -> None:
    block, _, X = random_block(np.random.default_rng(3))
    before = np.linalg.norm(block.gradient(X))
    found = block_descent.descend(block, X, 50, 30, 1e-14)
    assert found.gradient_norm < 1e-5 * before
    assert np.allclose(found.X[:, :3] @ np.swapaxes(found.X[:, :3], 1, 2), np.eye(3))
    assert block.cost(X) > found.cost == pytest.approx(block.cost(found.X))


def test_rounding_undoes_lifting_wherever_the_frame_lies() -> None:
    rng = np.random.default_rng(4)
    T, origin = random_poses(rng, 5), random_lifted(rng, 1)[0]
    assert np.allclose(block_descent.rounded(block_descent.composed(origin, T), origin), T)
    assert np.allclose(block_descent.rounded(block_descent.lifted(T, RANK), np.eye(4, RANK)), T)


def config(solver: Solver = Solver.LM) -> BackendConfig:
    return BackendConfig(formulation=Formulation.BASE, solver=solver)


def looped(outliers: int = 0) -> BlockProblem:
    """One robot that comes back to its start and knows it, and a few closures that are wrong."""
    rng = np.random.default_rng(5)
    log = LogId("r1")
    steps = np.array([pose(so3_exp(np.array([0.0, 0.0, 0.2])), np.array([1.0, 0.0, 0.0]))] * 31)
    T = np.array([np.linalg.multi_dot([np.eye(4), *steps[:k], np.eye(4)]) for k in range(len(steps))])
    drifted = [np.eye(4)]
    for _ in range(len(T) - 1):
        drifted.append(drifted[-1] @ steps[0] @ se3_exp(rng.normal(size=6) * np.repeat([0.002, 0.02], 3)))
    pairs = [(0, 30), (1, 30), (2, 29), (3, 28)]
    closures = [
        LoopClosure(KeyframeId(log, a), KeyframeId(log, b), inverse(T[a]) @ T[b], 5.0, metric=True) for a, b in pairs
    ]
    closures += [
        LoopClosure(KeyframeId(log, k), KeyframeId(log, 20), random_poses(rng, 1)[0], 5.0, metric=True)
        for k in range(outliers)
    ]
    return BlockProblem(log, Trajectory(np.array(drifted)), tuple(closures), {}, {}, 0, True, None, {}, None)


def iterated(problem: BlockProblem, solver: Solver, iterations: int) -> BlockStep:
    for _ in range(iterations):
        step = iterate_block(config(solver), problem)
        assert isinstance(step, BlockStep)
        found, problem = step, replace(problem, state=step.state, origin=step.origin)
    return found


def test_a_robot_alone_comes_to_rest_at_its_own_optimum_in_its_own_frame() -> None:
    problem = looped()
    step = iterated(problem, Solver.LM, 5)
    assert step.finished
    assert step.moved < 1e-6
    assert np.allclose(step.T_map_keyframe[0], problem.trajectory.T_odom_keyframe[0], atol=1e-9)
    ends = inverse(step.T_map_keyframe[0]) @ step.T_map_keyframe[30]
    measured = np.asarray(problem.closures[0].T_query_match_unscaled)
    before = inverse(problem.trajectory.T_odom_keyframe[0]) @ problem.trajectory.T_odom_keyframe[30]
    assert np.linalg.norm(ends[:3, 3] - measured[:3, 3]) < 0.5 * np.linalg.norm(before[:3, 3] - measured[:3, 3])


def test_graduated_weights_reject_what_is_wrong_and_keep_what_is_right() -> None:
    step = iterated(looped(outliers=3), Solver.GNC_TLS, 150)
    weights = [step.state.weights[pair] for pair in sorted(step.state.weights)]
    wrong = {pair for pair in step.state.weights if pair.high.index == 20}
    assert step.finished
    assert {pair for pair, weight in step.state.weights.items() if weight == 0.0} == wrong
    assert sorted(set(weights)) == [0.0, 1.0]
    assert step.rejected == 3


def test_what_cannot_be_solved_is_said_and_raises_nothing() -> None:
    problem = looped()
    broken = np.array(problem.trajectory.T_odom_keyframe)
    broken[5] = 0.0
    failed = iterate_block(config(), replace(problem, trajectory=Trajectory(broken)))
    assert failed == OptimisationFailed("robot r1: odometry of keyframe 5 is not rigid")


def test_a_closure_whose_covariance_is_none_does_not_count() -> None:
    problem = looped()
    bad = replace(problem.closures[0], covariance=-np.eye(6))
    with_bad = iterated(replace(problem, closures=(bad, *problem.closures[1:])), Solver.LM, 2)
    without = iterated(replace(problem, closures=problem.closures[1:]), Solver.LM, 2)
    assert np.allclose(with_bad.T_map_keyframe, without.T_map_keyframe)
