"""Which closures a swarm would not have registered, and what two solves say of it."""

import numpy as np
import pytest

from flocc_agent.core.pose_graph import LoopClosure, PoseGraph, Trajectory
from flocc_agent.core.spared import STRETCH, TIED_MIN
from flocc_lab.bench.closure_density import kept_by_density
from flocc_lab.bench.spared_closures import kept_of, of_scenario, walk_scenario
from flocc_protocol.ids import KeyframeId, LogId

R1, R2 = LogId("r1"), LogId("r2")
KEYFRAMES = 12


def road(off_m: float) -> PoseGraph:
    """Two robots side by side, each keyframe tied to so many of the other's that no stretch is weak.

    Closures are off by so much, each in another direction.
    """
    T = np.tile(np.eye(4), (KEYFRAMES, 1, 1))
    T[:, 0, 3] = np.arange(KEYFRAMES)
    ends = [(i, (i + k) % KEYFRAMES) for i in range(KEYFRAMES) for k in range(2 * int(TIED_MIN))]
    closures = []
    for number, (i, j) in enumerate(ends):
        S = np.eye(4)
        S[:3, 3] = j - i + off_m * np.cos(number), 1.0 + off_m * np.sin(number), 0.0
        closures.append(LoopClosure(KeyframeId(R1, i), KeyframeId(R2, j), S, metric=True))
    return PoseGraph({R1: Trajectory(T), R2: Trajectory(T)}, tuple(closures))


def test_closures_of_one_stretch_are_left_out_once_enough_agree() -> None:
    graph = road(0.0)
    kept = kept_of(graph)
    assert len(kept) < len(graph.closures)
    assert kept == sorted(set(kept))
    assert kept_of(graph, 0) == list(range(len(graph.closures)))


def test_where_closures_contradict_all_are_kept() -> None:
    graph = road(20.0)
    assert len(kept_of(graph)) == len(graph.closures)


def test_a_bound_on_density_leaves_as_many_at_both_ends_of_what_it_leaves_out() -> None:
    graph = road(0.0)
    kept = kept_by_density(graph, 1.0)
    assert kept_by_density(graph, 0.0) == []
    assert kept_by_density(graph, 100.0) == list(range(len(graph.closures)))
    assert 0 < len(kept) < len(graph.closures)
    ends = [end for k in kept for end in (graph.closures[k].query, graph.closures[k].match)]
    for k in set(range(len(graph.closures))) - set(kept):
        for end in (graph.closures[k].query, graph.closures[k].match):
            stretch = range(max(end.index - STRETCH, 0), min(end.index + STRETCH + 1, KEYFRAMES))
            assert sum(each.log == end.log and each.index in stretch for each in ends) >= len(stretch)


@pytest.mark.slow
def test_a_swarm_is_run_with_all_pairs_and_with_some_spared() -> None:
    row = of_scenario("walk 1", walk_scenario(1, robots=3, length_m=60.0, area_m=10.0))
    assert 0 < row["registered"] < row["closures"]
    assert row["ratio"] <= 1.5
