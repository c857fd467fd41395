"""Parts of a map that only a step of odometry that nobody measured holds are named, and others are not."""

from collections.abc import Sequence

import numpy as np
import pytest
from tests.agent.backend.test_backend_joining import walk

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import GraphSolution, LoopClosure, MeasuredFactor, PoseGraph, Trajectory, landmark
from flocc_agent.geometry import between, pose
from flocc_agent.runtime.unmeasured_steps import after_pause
from flocc_protocol.ids import KeyframeId, LogId

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")
KEYFRAMES, CARRIED = 16, 10
TIGHT = 1e-4 * np.eye(6)


STARTS = {R1: ((0.0, 0.0), 0.0), R2: ((2.0, 1.0), 0.1), R3: ((1.0, -2.0), 0.2)}
WORLD = {log: walk(*start, steps=KEYFRAMES) for log, start in STARTS.items()}


def odometry(log: LogId, carried: bool) -> Trajectory:
    """In a frame of its own; one that was carried has a step that nobody measured."""
    covariances = np.full((KEYFRAMES - 1, 6, 6), np.nan)
    covariances[CARRIED - 1] = after_pause(20.0).covariance
    return Trajectory(np.array([between(WORLD[log][0], T) for T in WORLD[log]]), covariances if carried else None)


def closures(a: LogId, b: LogId, keyframes: Sequence[int]) -> list[LoopClosure]:
    """Right ones, between keyframes of the same number."""
    return [
        LoopClosure(KeyframeId(a, k), KeyframeId(b, k), between(WORLD[a][k], WORLD[b][k]), metric=True)
        for k in keyframes
    ]


def hanging(logs: Sequence[LogId], given: Sequence[LoopClosure], seen: Sequence[int] = ()) -> list[str]:
    """What is said of parts; r2 was carried, and saw a tag at some keyframes."""
    tag = pose(np.eye(3), np.array([6.0, 3.0, 1.0]))
    at = [KeyframeId(R2, k) for k in seen]
    sightings = [MeasuredFactor("tag", k, k, landmark("tag/7"), between(WORLD[R2][k.index], tag), TIGHT) for k in at]
    graph = PoseGraph({log: odometry(log, log == R2) for log in logs}, tuple(given), measured=tuple(sightings))
    solution = optimise(graph, BackendConfig())
    assert isinstance(solution, GraphSolution)
    return [warning.split(": ")[0] for warning in solution.warnings if "nothing measured ties" in warning]


BEFORE, AFTER = (2, 5, 8), (11, 13, 15)
END, BEGIN = "keyframes r2/10 to r2/15", "keyframes r2/0 to r2/9"


@pytest.mark.parametrize(
    ("given", "seen", "told"),
    [
        (closures(R1, R2, BEFORE), (), [END]),
        (closures(R1, R2, AFTER), (), [BEGIN]),
        (closures(R1, R2, BEFORE + AFTER), (), []),
        (closures(R1, R2, BEFORE), (6, 7, 12, 13), []),
        (closures(R1, R2, BEFORE), (6, 7), [END]),
        ([], (), [END]),
    ],
    ids=["not tied behind", "not tied before", "tied on both sides", "by a tag", "a tag on one side", "alone"],
)
def test_a_part_that_nothing_measured_ties_is_named(
    given: Sequence[LoopClosure], seen: Sequence[int], told: list[str]
) -> None:
    assert hanging([R1, R2], given, seen) == told


def test_who_is_joined_by_such_a_part_alone_hangs_with_it() -> None:
    told = hanging([R1, R2, R3], closures(R1, R2, BEFORE) + closures(R2, R3, AFTER))
    assert told == ["keyframes r2/10 to r2/15 and keyframes r3/0 to r3/15"]
