"""Robots that hold the poses they share together: they come to rest where a central solver does, whatever is lost."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.backend.edges import residuals, state_of
from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.problem import build
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import GraphSolution, PoseGraph
from flocc_lab.bench.consensus_sweeps import Sweeps
from flocc_lab.bench.generated_graph import GeneratedGraph, Noise, generate
from flocc_lab.consensus import ConsensusPart, SharedPoses, part_of, shared_poses, solved_alone
from flocc_launch.graph_files.graph_file import ate_m
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

METRIC = Noise(scale_place_ratio=0.0, scale_own_ratio=0.0, scale_initial_ratio=0.0)
A, B, C = LogId("r00"), LogId("r01"), LogId("r02")


def config(formulation: Formulation = Formulation.BASE) -> BackendConfig:
    return BackendConfig(
        formulation=formulation, solver=Solver.LM, weight_by_probability=False, covariances=False,
        pairwise_consistency=False, relative_tolerance=1e-9,
    )  # fmt: skip


def three_robots(noise: Noise | None = METRIC) -> GeneratedGraph:
    return generate(np.random.default_rng(2), 3, 30, 45, noise=noise)


def central(graph: PoseGraph, settings: BackendConfig) -> GraphSolution:
    solution = optimise(graph, settings)
    assert isinstance(solution, GraphSolution)
    return solution


def cost(graph: PoseGraph, settings: BackendConfig, T: dict[LogId, Float]) -> float:
    """Half the sum of squares of all measurements, own scales eliminated."""
    problem = build(graph.trajectories, dict(enumerate(graph.closures)), settings)
    state = state_of(np.concatenate([T[log] for log in problem.logs]))
    return 0.5 * float(residuals(problem.edges, state).squared().sum())


def poses_of(solution: GraphSolution) -> dict[LogId, Float]:
    (component,) = solution.components
    return dict(component.T_map_keyframe)


def swept(graph: PoseGraph, settings: BackendConfig, sweeps: int, loss_ratio: float = 0.0) -> Sweeps:
    team = Sweeps(graph, settings, loss_ratio, seed=3)
    for _ in range(sweeps):
        team.sweep()
    return team


@pytest.mark.parametrize("formulation", [Formulation.BASE, Formulation.INDEPENDENT])
@pytest.mark.parametrize(("sweeps", "loss_ratio"), [(20, 0.0), (50, 0.3)])
def test_robots_come_to_the_optimum_of_a_central_solver(
    formulation: Formulation, sweeps: int, loss_ratio: float
) -> None:
    graph = three_robots(noise=METRIC if formulation is Formulation.BASE else None).graph
    settings = config(formulation)
    team = swept(graph, settings, sweeps, loss_ratio)
    assert team.refused == 0
    assert cost(graph, settings, team.T) == pytest.approx(
        cost(graph, settings, poses_of(central(graph, settings))), rel=1e-3
    )


def test_scales_of_clusters_are_the_owners_and_give_the_same_map() -> None:
    graph, settings = three_robots(noise=None).graph, config(Formulation.SMOOTHED)
    team = swept(graph, settings, 40)
    assert sum(len(part.state.scale) for part in team.parts.values()) > 0
    reference = {log: T[:, :3, 3] for log, T in poses_of(central(graph, settings)).items()}
    assert (ate_m({log: T[:, :3, 3] for log, T in team.T.items()}, reference) or 0.0) < 0.02


def test_at_rest_forces_are_opposite_and_poses_agree() -> None:
    graph = three_robots().graph
    team = swept(graph, config(), 60)
    for log, part in team.parts.items():
        for other in part.neighbours:
            mine, theirs = part.tell(other), team.parts[other].tell(log)
            assert np.abs(mine.T - theirs.T).max() < 1e-3
            scale = np.abs(mine.force).max()
            assert np.abs(mine.force + theirs.force).max() < 1e-2 * scale


def test_the_place_of_rest_does_not_depend_on_the_penalty() -> None:
    graph, settings = three_robots().graph, config()
    team = Sweeps(graph, settings)
    for part in team.parts.values():
        for neighbour in part.neighbours.values():
            neighbour.stiffness = 3.0 * neighbour.stiffness
    for _ in range(40):
        team.sweep()
    assert cost(graph, settings, team.T) == pytest.approx(
        cost(graph, settings, poses_of(central(graph, settings))), rel=1e-3
    )


def test_a_robot_without_neighbours_is_solved_alone() -> None:
    graph = three_robots().graph
    alone = PoseGraph({A: graph.trajectories[A]}, [c for c in graph.closures if c.query.log == c.match.log == A])
    T = np.asarray(graph.trajectories[A].T_odom_keyframe, dtype=float)
    part = part_of(alone, A, config(), T)
    assert part.neighbours == {}
    assert np.allclose(solved_alone(part), T, atol=1e-6)


def test_shared_poses_are_the_higher_robots_at_closures_between_two() -> None:
    graph = three_robots().graph
    of_a, of_b = shared_poses(graph, A), shared_poses(graph, B)
    assert of_a[B] == of_b[A]
    assert {keyframe.log for keyframe in of_a[B]} == {B}
    assert {keyframe.log for keyframe in of_b[C]} == {C}


def told() -> SharedPoses:
    graph = three_robots().graph
    parts = Sweeps(graph, config()).parts
    parts[A].step()
    return parts[A].tell(B)


def test_what_is_told_is_read_again_in_single_precision() -> None:
    said = told()
    assert said.spread is not None
    read = SharedPoses.unpacked(said.packed(), len(said.T))
    assert read.spread is not None
    assert np.allclose(read.T, said.T, atol=1e-5)
    assert np.allclose(read.spread, said.spread, rtol=1e-5, atol=1e-9)
    assert len(said.packed()) == 24 + 52 * len(said.T) + 84 * (len(said.T) - 1)


def listener() -> ConsensusPart:
    return Sweeps(three_robots().graph, config()).parts[B]


def test_what_cannot_be_is_refused_and_changes_nothing() -> None:
    said, part = told(), listener()
    nan = np.full_like(said.force, np.nan)
    assert said.spread is not None
    for wrong in (
        replace(said, force=nan),
        replace(said, T=np.full_like(said.T, np.inf)),
        replace(said, T=said.T[:-1], force=said.force[:-1]),
        replace(said, spread=-said.spread),
        replace(said, spread=said.spread[:-1]),
    ):
        with pytest.raises(ValueError, match=r"shared poses|spread"):
            part.hear(A, wrong)
    assert part.neighbours[A].heard is None
    assert part.neighbours[A].spread is None


@pytest.mark.parametrize("cut", [1, 40, 84])
def test_a_message_that_broke_off_is_refused(cut: int) -> None:
    said = told()
    with pytest.raises(ValueError, match="are not"):
        SharedPoses.unpacked(said.packed()[:-cut], len(said.T))
