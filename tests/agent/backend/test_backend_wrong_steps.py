"""A wrong stretch of odometry that looks like a wrong scale is named where it is; a wrong scale is not called one."""

import re

import numpy as np
import pytest

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import GraphSolution, LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import Float, between, pose, se3_exp, so3_exp
from flocc_protocol.ids import KeyframeId, LogId

R1, R2 = LogId("r1"), LogId("r2")
SLIPPED_AT = 30
COVARIANCE = np.diag([1e-4] * 3 + [1.6e-3] * 3)


def way(rng: np.random.Generator, keyframes: int) -> Float:
    """Poses (N, 4, 4) of a robot in a plane, half a metre a step, with turns."""
    T, turn_rad = [pose(so3_exp(np.array([0.0, 0.0, rng.uniform(-0.2, 0.2)])), np.zeros(3))], 0.0
    for _ in range(keyframes - 1):
        turn_rad = float(rng.choice([-0.3, 0.0, 0.3, 0.0])) if rng.random() < 0.12 else turn_rad
        T.append(T[-1] @ se3_exp(np.array([0.0, 0.0, turn_rad, 0.5, 0.0, 0.0])))
    return np.array(T)


def odometry(rng: np.random.Generator, T: Float, slip_m: float = 0.0, steps: int = 1, scale: float = 1.0) -> Trajectory:
    """A way as wheels measure it: `slip_m` too long in some steps, or all steps too long."""
    T_odom = [np.eye(4)]
    for k, step in enumerate(between(T[:-1], T[1:])):
        noise = se3_exp(rng.normal(size=6) * np.array([1e-3, 1e-3, 3e-3, 1e-2, 1e-2, 3e-3]))
        said = step @ noise
        said[:3, 3] *= scale
        slips = SLIPPED_AT <= k < SLIPPED_AT + steps
        T_odom.append(T_odom[-1] @ said @ pose(np.eye(3), np.array([slip_m / steps if slips else 0.0, 0.0, 0.0])))
    return Trajectory(np.array(T_odom), np.tile(COVARIANCE, (len(T) - 1, 1, 1)))


def closures(rng: np.random.Generator, T1: Float, T2: Float) -> tuple[LoopClosure, ...]:
    """Without a length, as cameras make them, all along the way."""
    found = []
    for k in range(0, len(T1), 2):
        other = int(np.clip(k + rng.integers(-1, 2), 0, len(T1) - 1))
        Z = between(T1[k], T2[other]) @ se3_exp(rng.normal(size=6) * np.array([1e-2] * 3 + [3e-2] * 3))
        length_m = float(np.linalg.norm(Z[:3, 3]))
        Z[:3, 3] /= length_m
        first = length_m * float(np.exp(0.15 * rng.normal()))
        found.append(LoopClosure(KeyframeId(R1, k), KeyframeId(R2, other), Z, match_ratio=0.5, scale_initial=first))
    return tuple(found)


def told(seed: int, **wrong: float) -> str:
    """What is said of two robots that drive side by side, the second with wrong odometry."""
    rng = np.random.default_rng(seed)
    T1 = way(rng, 60)
    T2 = T1 @ pose(np.eye(3), np.array([0.3, 0.4, 0.0]))
    logs = {R1: odometry(rng, T1), R2: odometry(rng, T2, **wrong)}  # type: ignore[arg-type]
    solution = optimise(PoseGraph(logs, closures(rng, T1, T2)), BackendConfig())
    assert isinstance(solution, GraphSolution)
    assert any("measures lengths" in warning for warning in solution.warnings), "else there is nothing to be told"
    return next((warning for warning in solution.warnings if "not along the way" in warning), "")


@pytest.mark.parametrize(("seed", "steps"), [(1, 1), (2, 1), (1, 6)])
def test_wheels_that_slipped_are_named_where_they_did(seed: int, steps: int) -> None:
    named = re.search(r"r2/(\d+) to r2/(\d+)", told(seed, slip_m=3.0, steps=steps))
    assert named is not None
    first, last = (int(number) for number in named.groups())
    assert first <= SLIPPED_AT + steps // 2 <= last


@pytest.mark.parametrize(("seed", "scale"), [(4, 1.1), (3, 0.85), (5, 1.2)])
def test_a_wrong_scale_is_nothing_but_that(seed: int, scale: float) -> None:
    assert told(seed, scale=scale) == ""
