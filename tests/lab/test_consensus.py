"""Robots that hold the poses they share together: they come to rest where a central solver does, whatever is lost."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.backend.consensus import ConsensusPart
from flocc_agent.backend.consensus_pair import STIFFNESS_AFTER, Tidings
from flocc_agent.backend.edges import residuals, state_of
from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.problem import build
from flocc_agent.backend.shared_stiffness import geometric_mean, stiffness_of
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.own_part import HEAD_BYTES, ROW_BYTES
from flocc_agent.core.pose_graph import GraphSolution, PoseGraph
from flocc_agent.geometry import hats
from flocc_lab.bench.consensus_sweeps import Sweeps
from flocc_lab.bench.generated_graph import GeneratedGraph, Noise, generate
from flocc_lab.consensus_graphs import part_of_graph, shared_poses, solved_alone
from flocc_launch.graph_files.graph_file import ate_m
from flocc_protocol.ids import LogId
from flocc_protocol.shared_poses import KNOTS_MAX, stiffness_numbers

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


@pytest.mark.parametrize("lower_is_heard", [True, False])
def test_where_every_contact_breaks_off_after_its_first_message_robots_come_to_rest_no_worse_than_alone(
    lower_is_heard: bool,
) -> None:
    drawn = three_robots()
    parts = Sweeps(drawn.graph, config()).parts
    ways = [{log: part.T for log, part in parts.items()}]
    for number in range(1, 41):
        for log, part in parts.items():
            part.step(number)
            for other in part.neighbours:
                if (log < other) == lower_is_heard:
                    count = len(part.neighbours[other].index)
                    parts[other].hear(log, Tidings.of(part.tell(other).told(), count))
        ways.append({log: part.T for log, part in parts.items()})
    for log in parts:
        assert np.abs(ways[-1][log] - ways[-10][log]).max() < 1e-4
        alone_m, agreed_m = (ate_m({log: way[log][:, :3, 3]}, drawn.truth_m()) or 0.0 for way in (ways[0], ways[-1]))
        assert agreed_m < 1.05 * alone_m
    assert any(np.abs(ways[-1][log] - ways[0][log]).max() > 0.01 for log in parts)


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
            neighbour.closures = 1000.0 * neighbour.closures
            neighbour.penalty = 3.0 * neighbour.penalty
    for _ in range(40):
        team.sweep()
    assert cost(graph, settings, team.T) == pytest.approx(
        cost(graph, settings, poses_of(central(graph, settings))), rel=1e-3
    )


def test_a_robot_without_neighbours_is_solved_alone() -> None:
    graph = three_robots().graph
    alone = PoseGraph({A: graph.trajectories[A]}, [c for c in graph.closures if c.query.log == c.match.log == A])
    T = np.asarray(graph.trajectories[A].T_odom_keyframe, dtype=float)
    part = part_of_graph(alone, A, config(), T, {})
    assert part.neighbours == {}
    assert np.allclose(solved_alone(part), T, atol=1e-6)


def test_shared_poses_are_the_higher_robots_at_closures_between_two() -> None:
    graph = three_robots().graph
    of_a, of_b = shared_poses(graph, A), shared_poses(graph, B)
    assert of_a[B] == of_b[A]
    assert {keyframe.log for keyframe in of_a[B]} == {B}
    assert {keyframe.log for keyframe in of_b[C]} == {C}


def told() -> Tidings:
    parts = Sweeps(three_robots().graph, config()).parts
    for number in range(STIFFNESS_AFTER[0]):
        parts[B].step(number + 1)
    return parts[B].tell(A)


def test_what_is_told_is_read_again_in_single_precision() -> None:
    said = told()
    assert said.stiffness is not None
    assert (said.number, said.known) == (STIFFNESS_AFTER[0], 0)
    read = Tidings.of(said.told(), len(said.T))
    assert read.stiffness is not None
    assert (read.number, read.known) == (said.number, 0)
    assert np.allclose(read.T, said.T, atol=1e-5)
    assert np.allclose(read.stiffness.matrix().toarray(), said.stiffness.matrix().toarray(), rtol=1e-4, atol=1e-2)
    assert said.told().size_bytes == HEAD_BYTES + ROW_BYTES * len(said.T) + 4 * stiffness_numbers(len(said.T))


def test_stiffness_and_penalty_are_told_until_the_other_has_them() -> None:
    parts = Sweeps(three_robots().graph, config()).parts
    for number in range(STIFFNESS_AFTER[0]):
        parts[B].step(number + 1)
    for _ in range(2):
        assert parts[B].tell(A).stiffness is not None
    parts[A].hear(B, parts[B].tell(A))
    for number in range(STIFFNESS_AFTER[0]):
        assert parts[A].tell(B).number == 0
        parts[A].step(number + 1)
    assert parts[A].tell(B).stiffness is not None
    parts[B].hear(A, parts[A].tell(B))
    assert parts[B].tell(A).stiffness is None
    parts[A].hear(B, parts[B].tell(A))
    assert parts[A].tell(B).stiffness is None
    assert parts[A].tell(B).number == parts[B].tell(A).known == STIFFNESS_AFTER[0]


class LateTeam:
    """Robots that step when they like, whose messages are lost, late, said twice, and which may go back to before.

    As on a mission a robot takes only the newest word of a neighbour, and that once.
    """

    def __init__(self, graph: PoseGraph, seed: int, loss_ratio: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.parts = Sweeps(graph, config()).parts
        self.loss_ratio = loss_ratio
        self.number = 0
        self.before = deepcopy(self.parts)
        self.went_back = 0
        self.post: list[tuple[int, LogId, LogId, Tidings, Float]] = []
        self.heard: dict[tuple[LogId, LogId], int] = {}
        self.penalties: list[tuple[LogId, LogId, Float, Float]] = []

    def turn(self, calm: bool) -> None:
        """Somebody may go back, half of them hear what came and step."""
        if not calm and self.rng.random() < 0.15:
            log = list(self.parts)[self.rng.integers(len(self.parts))]
            self.parts[log] = deepcopy(self.before[log])
            self.went_back += 1
        if self.rng.random() < 0.1:
            self.before = deepcopy(self.parts)
        self.number += 1
        for log, part in self.parts.items():
            if self.rng.random() < 0.5:
                self.hear(log, part)
                assert part.step(self.number) == {}
                self.tell(log, part)

    def hear(self, log: LogId, part: ConsensusPart) -> None:
        for other in part.neighbours:
            came = [
                word
                for word in self.post
                if word[1:3] == (other, log) and word[0] + self.rng.poisson(1.0) < self.number
            ]
            new = [word for word in came if word[0] > self.heard.get((other, log), 0)]
            if new:
                said_at, _, _, told, penalty = max(new, key=lambda word: word[0])
                self.heard[other, log] = said_at
                part.hear(other, told)
                if part.neighbours[other].T is told.T and not part.neighbours[other].lower:
                    self.penalties.append((log, other, part.neighbours[other].penalty.toarray(), penalty))

    def tell(self, log: LogId, part: ConsensusPart) -> None:
        for other, neighbour in part.neighbours.items():
            if self.rng.random() >= self.loss_ratio:
                told = Tidings.of(part.tell(other).told(), len(neighbour.index))
                self.post.append((self.number, log, other, told, neighbour.penalty.toarray()))


@pytest.mark.parametrize(("seed", "loss_ratio"), [(1, 0.0), (2, 0.5)])
def test_a_higher_robot_answers_by_the_penalty_of_the_word_that_it_answers(seed: int, loss_ratio: float) -> None:
    graph = generate(np.random.default_rng(2), 3, 12, 18, noise=METRIC).graph
    team = LateTeam(graph, seed, loss_ratio)
    for k in range(120):
        team.turn(calm=k > 60)
    assert team.went_back > 3
    assert len(team.penalties) > 30
    for log, other, mine, told in team.penalties:
        assert np.allclose(mine, told, rtol=1e-6, atol=1e-6), f"{log} answered {other} by another penalty"
    for log, part in team.parts.items():
        for other, neighbour in part.neighbours.items():
            there = team.parts[other].neighbours[log]
            assert neighbour.version == there.version > 0
            assert np.allclose(neighbour.penalty.toarray(), there.penalty.toarray(), rtol=1e-6, atol=1e-6)
    found = cost(graph, config(), team_poses(team.parts))
    assert found == pytest.approx(cost(graph, config(), poses_of(central(graph, config()))), rel=1e-3)


def team_poses(parts: dict[LogId, ConsensusPart]) -> dict[LogId, Float]:
    return {log: part.T for log, part in parts.items()}


def test_what_a_lower_robot_said_by_a_penalty_that_is_not_here_counts_for_nothing() -> None:
    said, part = replace(told(), number=7, stiffness=None), listener()
    part.hear(A, said)
    assert part.neighbours[A].T is None
    assert part.tell(A).known == 0


def test_a_stiffness_without_a_mean_is_refused_and_not_asked_again() -> None:
    parts = Sweeps(three_robots().graph, config()).parts
    said = told()
    assert said.stiffness is not None
    tiny = replace(said.stiffness, knots=1e-300 * said.stiffness.knots)
    parts[A].hear(B, replace(said, stiffness=tiny))
    refused = [parts[A].step(number + 1) for number in range(STIFFNESS_AFTER[0] + 1)]
    assert [list(names) for names in refused] == [[]] * (STIFFNESS_AFTER[0] - 1) + [[B], []]
    assert parts[A].tell(B).number == 0


def listener() -> ConsensusPart:
    return Sweeps(three_robots().graph, config()).parts[B]


def test_what_cannot_be_is_refused_and_changes_nothing() -> None:
    said, part = told(), listener()
    assert said.stiffness is not None
    knots = said.stiffness.knots
    for wrong in (
        replace(said, force=np.full_like(said.force, np.nan)),
        replace(said, T=np.full_like(said.T, np.inf)),
        replace(said, T=said.T[:-1], force=said.force[:-1]),
        replace(said, stiffness=replace(said.stiffness, knots=-knots)),
        replace(said, stiffness=replace(said.stiffness, knots=knots[:-6, :-6])),
        replace(said, number=0),
    ):
        with pytest.raises(ValueError, match=r"shared poses|stiffness"):
            part.hear(A, wrong)
    assert part.neighbours[A].T is None
    assert part.neighbours[A].theirs is None


def test_what_broke_off_is_refused() -> None:
    said = told()
    whole, count = said.told(), len(said.T)
    for cut in (replace(whole, rows=whole.rows[:-1]), replace(whole, stiffness=whole.stiffness[:-1])):
        with pytest.raises(ValueError, match="are not"):
            Tidings.of(cut, count)


def test_a_mean_of_stiffnesses_is_the_geometric_one() -> None:
    rng = np.random.default_rng(5)
    T = np.asarray(three_robots().graph.trajectories[A].T_odom_keyframe, dtype=float)[: KNOTS_MAX + 4]
    stiff, soft = (stiffness_of(k * np.eye(6 * len(T)), T) for k in (1.0, 100.0))
    mean = geometric_mean(stiff, soft)
    assert np.allclose(mean.matrix().toarray(), 0.1 * stiff.matrix().toarray())
    root = rng.normal(size=(6 * len(T), 6 * len(T)))
    drawn = stiffness_of(root @ root.T, T)
    G, A_, B_ = geometric_mean(stiff, drawn).knots, stiff.knots, drawn.knots
    G = G @ G.T
    assert np.allclose(G @ np.linalg.inv(A_ @ A_.T) @ G, B_ @ B_.T, rtol=1e-6, atol=1e-9)


def test_what_hangs_on_a_knot_keeps_its_covariance_relative_to_it() -> None:
    T = np.asarray(three_robots().graph.trajectories[A].T_odom_keyframe, dtype=float)[: KNOTS_MAX + 4]
    root = np.random.default_rng(6).normal(size=(6 * len(T), 6 * len(T)))
    covariance = root @ root.T
    whole = stiffness_of(covariance[: 6 * KNOTS_MAX, : 6 * KNOTS_MAX], T[:KNOTS_MAX])
    assert np.allclose(np.linalg.inv(whole.matrix().toarray()), covariance[: 6 * KNOTS_MAX, : 6 * KNOTS_MAX], rtol=1e-6)
    there = np.linalg.inv(stiffness_of(covariance, T).matrix().toarray())
    others = [k for k in range(len(T)) if k not in np.round(np.linspace(0, len(T) - 1, KNOTS_MAX))]
    for k in others:
        q = min((0, k - 1), key=lambda n: abs(n - k))
        back = np.zeros((6, 6))
        D = np.linalg.inv(T[k]) @ T[q]
        back[:3, :3] = back[3:, 3:] = D[:3, :3]
        back[3:, :3] = hats(D[None, :3, 3])[0] @ D[:3, :3]
        J = np.hstack([-back, np.eye(6)])
        rows = np.r_[6 * q : 6 * q + 6, 6 * k : 6 * k + 6]
        assert np.allclose(
            J @ there[np.ix_(rows, rows)] @ J.T, J @ covariance[np.ix_(rows, rows)] @ J.T, rtol=1e-6, atol=1e-6
        )
