"""Claim: whatever is wrong with measurements, the optimiser answers, and every pose is finite and rigid."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.screening import first_not_rigid
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import (
    WORLD,
    GraphSolution,
    LoopClosure,
    MeasuredFactor,
    OptimisationFailed,
    PoseGraph,
    Trajectory,
    landmark,
)
from flocc_agent.geometry import pose, so3_exp
from flocc_lab.bench.generated_graph import generate
from flocc_protocol.ids import KeyframeId, LogId

SEEDS = 120


def damaged(rng: np.random.Generator, closure: LoopClosure) -> LoopClosure:
    """One closure with one field that is wrong, odd, or extreme."""
    T = np.array(closure.T_query_match_unscaled)
    odd = pose(so3_exp(rng.normal(size=3) * 3), rng.normal(size=3) * 10.0 ** rng.uniform(-8, 6))
    choices = [
        replace(closure, T_query_match_unscaled=T * rng.choice([np.nan, np.inf, 0.0, 1e200])),
        replace(closure, T_query_match_unscaled=odd),
        replace(closure, T_query_match_unscaled=odd, covariance=None, metric=True),
        replace(closure, T_query_match_unscaled=np.eye(4)),
        replace(closure, T_query_match_unscaled=T[:3]),
        replace(closure, covariance=rng.normal(size=(6, 6))),
        replace(closure, covariance=np.eye(6) * 10.0 ** rng.uniform(-12, 12)),
        replace(closure, covariance=np.diag(10.0 ** rng.uniform(-9, 9, 6))),
        replace(closure, scale_initial=float(10.0 ** rng.uniform(-9, 9))),
        replace(closure, scale_initial=float(rng.choice([np.nan, -1.0, 0.0, np.inf]))),
        replace(closure, match_ratio=float(rng.choice([np.nan, -1.0, 1e9, 0.0]))),
        replace(closure, match=KeyframeId(closure.match.log, 10_000)),
        replace(closure, match=KeyframeId(LogId("ghost"), 0)),
        replace(closure, match=closure.query),
    ]
    return choices[int(rng.integers(len(choices)))]


def graph(rng: np.random.Generator) -> PoseGraph:
    robots, keyframes = int(rng.integers(1, 4)), int(rng.integers(1, 20))
    generated = generate(rng, robots, max(keyframes, 2), int(rng.integers(0, 30)), outlier_ratio=0.3).graph
    closures = [damaged(rng, c) if rng.random() < 0.3 else c for c in generated.closures]
    trajectories = dict(generated.trajectories)
    log = next(iter(trajectories))
    if rng.random() < 0.2:
        T = np.array(trajectories[log].T_odom_keyframe)
        T[int(rng.integers(len(T)))] *= rng.choice([np.nan, 0.0, 2.0])
        trajectories[log] = replace(trajectories[log], T_odom_keyframe=T)
    if rng.random() < 0.2:
        trajectories[log] = replace(trajectories[log], edge_covariances=rng.normal(size=(3, 6, 6)))
    measured = [any_factor(rng, trajectories) for _ in range(int(rng.integers(0, 12)))] if rng.random() < 0.5 else []
    return PoseGraph(trajectories, closures, tuple(measured))


def any_factor(rng: np.random.Generator, trajectories: Mapping[LogId, Trajectory]) -> MeasuredFactor:
    """Something measured, of the right form but where chance damaged it."""
    logs = list(trajectories)
    at, other = (KeyframeId(logs[int(rng.integers(len(logs)))], int(rng.integers(0, 22))) for _ in range(2))
    query = [at, landmark(WORLD), landmark(WORLD)][int(rng.integers(3))]
    match = [landmark("tag/7"), other][int(rng.integers(2))] if query == at else at
    T = pose(so3_exp(rng.normal(size=3)), 10.0 * rng.normal(size=3))
    covariance = 10.0 ** rng.uniform(-6, 6) * np.eye(int(rng.choice([3, 6])))
    if rng.random() < 0.2:
        T = T * rng.choice([np.nan, 0.0, 2.0])
    if rng.random() < 0.2:
        covariance = covariance * rng.choice([np.nan, 0.0, -1.0])
    return MeasuredFactor("any", at, query, match, T, covariance)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("part", range(4))
def test_no_measurement_makes_it_raise_or_answer_with_a_broken_pose(part: int) -> None:
    for seed in range(part * SEEDS // 4, (part + 1) * SEEDS // 4):
        rng = np.random.default_rng(seed)
        bad = graph(rng)
        config = BackendConfig(
            formulation=list(Formulation)[seed % 4],
            solver=list(Solver)[seed % 5],
            pairwise_consistency=bool(seed % 2),
            closures_to_join_min=1 + seed % 2,
        )
        earlier = optimise(replace(bad, closures=bad.closures[: len(bad.closures) // 2]), config)
        solution = optimise(bad, config, earlier if isinstance(earlier, GraphSolution) else None)
        if isinstance(solution, OptimisationFailed):
            assert solution.reason
            continue
        assert len(solution.closures) == len(bad.closures)
        assert [result.factor for result in solution.measured] == list(bad.measured)
        for component in solution.components:
            for log in component.logs:
                assert first_not_rigid(component.T_map_keyframe[log]) is None, f"seed {seed}, robot {log}"
                assert first_not_rigid(component.T_map_odom[log][None]) is None, f"seed {seed}, robot {log}"
        assert all(np.isfinite(c.residual) and 0.0 <= c.weight <= 1.0 for c in solution.closures), f"seed {seed}"
