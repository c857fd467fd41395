"""One closure joins no maps, and a wrong first closure does not outlive the right ones that follow it."""

import numpy as np

from flocc_agent.backend.joining import too_few
from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import Float, between, pose, so3_exp
from flocc_protocol.ids import KeyframeId, LogId

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")


def walk(start_m: tuple[float, float], turn_rad: float, steps: int = 20) -> Float:
    """Poses (N, 4, 4) in the world: a gentle curve, one metre a step."""
    x, y = start_m
    poses = []
    for k in range(steps):
        heading = turn_rad + 0.08 * k
        poses.append(pose(so3_exp(np.array([0.0, 0.0, heading])), np.array([x, y, 0.0])))
        x, y = x + np.cos(heading), y + np.sin(heading)
    return np.array(poses)


WORLD = {R1: walk((0.0, 0.0), 0.0), R2: walk((2.0, 1.0), 0.1), R3: walk((1.0, -2.0), 0.2)}


def odometry() -> dict[LogId, Trajectory]:
    """Every robot starts in its own frame at the identity."""
    return {log: Trajectory(np.array([between(poses[0], T) for T in poses])) for log, poses in WORLD.items()}


def closure(a: LogId, i: int, b: LogId, j: int, ratio: float = 0.35) -> LoopClosure:
    """A right closure, of unknown scale."""
    T = between(WORLD[a][i], WORLD[b][j])
    T[:3, 3] /= np.linalg.norm(T[:3, 3])
    return LoopClosure(KeyframeId(a, i), KeyframeId(b, j), T, match_ratio=ratio)


def wrong(a: LogId, i: int, b: LogId, j: int) -> LoopClosure:
    """A closure that is right in nothing, and surer of itself than the right ones."""
    T = pose(so3_exp(np.array([0.3, 0.2, 2.5])), np.array([0.0, 0.6, 0.8]))
    return LoopClosure(KeyframeId(a, i), KeyframeId(b, j), T, match_ratio=0.6, scale_initial=8.0)


def solved(closures: list[LoopClosure], initial: GraphSolution | None = None) -> GraphSolution:
    solution = optimise(PoseGraph(odometry(), closures), BackendConfig(), initial)
    assert isinstance(solution, GraphSolution)
    return solution


def frames(solution: GraphSolution) -> list[list[str]]:
    return [[str(log) for log in component.logs] for component in solution.components]


JOIN_2_3 = [closure(R2, k, R3, k) for k in range(2, 18, 3)]
JOIN_1_3 = [closure(R1, k, R3, k) for k in range(2, 18, 3)]


def test_a_single_closure_joins_no_maps_and_says_why() -> None:
    solution = solved([*JOIN_2_3, wrong(R1, 5, R2, 9)])
    assert frames(solution) == [["r1"], ["r2", "r3"]]
    assert solution.closures[-1].state is ClosureState.REJECTED
    assert "fewer than 2 closures" in solution.closures[-1].reason


def test_right_closures_win_over_a_wrong_one_that_came_first() -> None:
    trusting = BackendConfig(closures_to_join_min=1)
    first = optimise(PoseGraph(odometry(), [*JOIN_2_3, wrong(R1, 5, R2, 9)]), trusting)
    assert isinstance(first, GraphSolution)
    assert frames(first) == [["r1", "r2", "r3"]]
    later = solved([*JOIN_2_3, wrong(R1, 5, R2, 9), *JOIN_1_3], initial=first)
    assert frames(later) == [["r1", "r2", "r3"]]
    states = [result.state for result in later.closures]
    assert states[len(JOIN_2_3)] is ClosureState.EXCLUDED  # held: the way through r3 contradicts it
    assert states[len(JOIN_2_3) + 1 :] == [ClosureState.USED] * len(JOIN_1_3)


def test_closures_of_several_pairs_join_groups_together() -> None:
    ids = dict(enumerate([*JOIN_2_3, closure(R1, 4, R2, 5), closure(R1, 7, R3, 8)]))
    assert too_few([R1, R2, R3], ids, 2) == []
    assert too_few([R1, R2, R3], {k: c for k, c in ids.items() if k != len(ids) - 1}, 2) == [len(JOIN_2_3)]
    assert too_few([R1, R2, R3], ids, 7) == sorted(ids)


def test_a_ring_of_robots_with_one_closure_each_is_joined_and_a_chain_of_them_is_not() -> None:
    ring = [closure(R1, 4, R2, 5), closure(R2, 9, R3, 8), closure(R3, 14, R1, 13)]
    assert too_few([R1, R2, R3], dict(enumerate(ring)), 2) == []
    assert too_few([R1, R2, R3], dict(enumerate(ring)), 3) == [0, 1, 2]
    assert too_few([R1, R2, R3], dict(enumerate(ring[:2])), 2) == [0, 1]


def test_two_rings_that_one_closure_connects_stay_apart() -> None:
    a, b = [[LogId(f"{side}{k}") for k in range(3)] for side in "ab"]
    rings = [closure_of(x, y) for logs in (a, b) for x, y in zip(logs, logs[1:] + logs[:1], strict=True)]
    closures = dict(enumerate([*rings, closure_of(a[0], b[0])]))
    assert too_few([*a, *b], closures, 2) == [len(rings)]


def closure_of(a: LogId, b: LogId) -> LoopClosure:
    return LoopClosure(KeyframeId(a, 0), KeyframeId(b, 0), np.eye(4))
