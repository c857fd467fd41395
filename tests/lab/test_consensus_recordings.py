"""Robots that choose closures without lengths pair by pair, and then agree on a recording, beside a leader."""

from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.backend.consensus import beginning_scale
from flocc_agent.config import Solver
from flocc_agent.core.own_part import OwnedClosure
from flocc_agent.core.pose_graph import LoopClosure
from flocc_agent.geometry import pose
from flocc_lab.bench.consensus_recordings import agreed, chosen, solved
from flocc_lab.bench.consensus_sweeps import Sweeps
from flocc_lab.bench.generated_graph import generate
from flocc_lab.consensus_graphs import least_cost, part_of_graph, whole_of
from flocc_launch.graph_files import GraphFile
from flocc_launch.graph_files.graph_file import ate_m
from flocc_launch.graph_files.optimise import file_config, positions
from flocc_protocol.ids import KeyframeId, LogId

CONFIG = file_config(None, Solver.LM, None)
A, B = LogId("a"), LogId("b")


def drawn_recording() -> GraphFile:
    """Three robots whose closures tell no lengths."""
    drawn = generate(np.random.default_rng(702), 3, 60, 45, scale_known=False)
    return GraphFile(drawn.graph, drawn.truth_m()).with_unit_scale()


def test_robots_without_lengths_agree_where_a_leader_puts_them_though_messages_are_lost() -> None:
    file = drawn_recording()
    leader_m = ate_m(positions(solved(file.graph, CONFIG)), file.truth_m)
    assert leader_m is not None
    owned = chosen(file.graph, CONFIG)
    assert len(owned) > 30
    found = agreed(file, owned, 25, 0.3, 1)
    after = found.settled(1.1 * leader_m)
    assert after is not None
    assert found.bytes_at[after - 1] < 1e6
    assert abs(found.above) < 0.01


def test_what_robots_own_together_is_one_part_that_has_all_closures() -> None:
    graph = drawn_recording().graph
    parts = Sweeps(graph, CONFIG, chosen=chosen(graph, CONFIG)).parts
    whole = whole_of(parts)
    assert whole.own == sum(len(t) for t in graph.trajectories.values())
    assert len(whole.edges) == whole.own - 3 + len(graph.closures)
    between = whole.edges.j - whole.edges.i != 1
    firsts = dict(zip(graph.trajectories, (0, 60, 120), strict=True))
    ends = {(firsts[c.query.log] + c.query.index, firsts[c.match.log] + c.match.index) for c in graph.closures}
    assert set(zip(whole.edges.i[between].tolist(), whole.edges.j[between].tolist(), strict=True)) == ends
    assert least_cost(parts) < whole.own_cost()


@pytest.mark.parametrize(("length_m", "begins_m"), [(0.003, 1.0), (7.0, 7.0)])
def test_a_choice_where_two_robots_nearly_meet_makes_no_closure_of_micrometres(
    length_m: float, begins_m: float
) -> None:
    unit = pose(np.eye(3), np.array([0.0, 0.5, 0.0]))
    closure = LoopClosure(KeyframeId(A, 1), KeyframeId(B, 1), unit, covariance=1e-4 * np.eye(6))
    owned = OwnedClosure(closure, 1.0, 2.0 * length_m, np.eye(4))
    assert beginning_scale(owned, CONFIG) == pytest.approx(2.0 * begins_m)
    assert beginning_scale(replace(owned, scale=None), CONFIG) == 1.0


def test_a_closure_of_one_that_was_chosen_with_a_weight_counts_by_it() -> None:
    graph = drawn_recording().graph
    owned = {c: replace(each, weight=0.25) for c, each in chosen(graph, CONFIG).items()}
    log = min(graph.trajectories)
    part = part_of_graph(graph, log, CONFIG, np.asarray(graph.trajectories[log].T_odom_keyframe), owned)
    assert set(part.weights.tolist()) == {0.25, 1.0}
