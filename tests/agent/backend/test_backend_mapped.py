"""A team in a saved map: the map's frame stays, and its poses move as their covariance allows, or not at all."""

from dataclasses import replace

import numpy as np
import pytest
from tests.agent.backend.test_backend_joining import R1, R2, R3, WORLD, closure, odometry

from flocc_agent.backend import optimiser
from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, LoopClosure, MeasuredFactor, PoseGraph, landmark
from flocc_agent.core.saved_map import SavedClosure, SavedMap
from flocc_agent.geometry import Float, between, inverse, pose, se3_exp
from flocc_protocol.ids import KeyframeId, LogId

CONFIG = BackendConfig()
EARLY = LogId("a0")
"""A robot whose name sorts before those of the map."""
INNER = [closure(R2, k, R3, k) for k in range(2, 18, 3)]
T_MAP_WORLD = inverse(WORLD[R2][0])
NOISE = np.random.default_rng(4)


def saved(is_fixed: bool = False) -> SavedMap:
    """The map of r2 and r3 by their true poses; the frame is r2's."""
    poses = {log: T_MAP_WORLD @ WORLD[log] for log in (R2, R3)}
    used = {(c.query, c.match): SavedClosure(_metres(c), 0.9) for c in INNER[1:]}
    return SavedMap((R2, R3), frozenset({R2, R3}), poses, used, is_fixed)


def _metres(c: LoopClosure) -> float:
    return float(np.linalg.norm(between(WORLD[c.query.log][c.query.index], WORLD[c.match.log][c.match.index])[:3, 3]))


def graph(closures: list[LoopClosure], opened: SavedMap | None) -> PoseGraph:
    """A new robot, which is r1 under a name that sorts first, beside the logs of the map, whose odometry is bad."""
    own = odometry()
    drift = se3_exp(np.array([0.0, 0.0, 0.02, 0.0, 0.0, 0.0]))
    bent = {}
    for log in (R2, R3):
        steps = [drift @ between(a, b) for a, b in zip(WORLD[log][:-1], WORLD[log][1:], strict=True)]
        poses = [np.eye(4)]
        for step in steps:
            poses.append(poses[-1] @ step)
        bent[log] = replace(own[log], T_odom_keyframe=np.array(poses))
    return PoseGraph({EARLY: own[R1], **bent}, closures, saved=opened)


def to_map(indices: range, of: LogId = R3) -> list[LoopClosure]:
    made = [closure(R1, k, of, k) for k in indices]
    return [replace(c, query=KeyframeId(EARLY, c.query.index)) for c in made]


def solved(given: PoseGraph, initial: GraphSolution | None = None) -> GraphSolution:
    solution = optimise(given, CONFIG, initial)
    assert isinstance(solution, GraphSolution)
    return solution


def moved_m(solution: GraphSolution, opened: SavedMap) -> float:
    """The farthest that a pose of the map lies from where it was saved."""
    T = solution.components[0].T_map_keyframe
    return max(float(np.abs(T[log] - opened.T_map_camera[log])[:, :3, 3].max()) for log in opened.logs)


def error_m(T_map_camera: Float) -> float:
    """How far the new robot is from where it truly is in the map."""
    return float(np.linalg.norm((T_map_camera - T_MAP_WORLD @ WORLD[R1])[:, :3, 3], axis=1).max())


@pytest.mark.parametrize("fixed", [False, True])
def test_a_robot_finds_itself_in_the_maps_frame_whatever_it_is_called(fixed: bool) -> None:
    opened = saved(fixed)
    solution = solved(graph([*INNER, *to_map(range(2, 18, 3))], opened))
    (component,) = solution.components
    assert component.map_frame == "map/r2"
    assert component.logs == (R2, R3, EARLY)
    assert error_m(component.T_map_keyframe[EARLY]) < 0.05
    assert moved_m(solution, opened) < (1e-12 if fixed else 0.05)
    assert [r.state for r in solution.closures[: len(INNER)]] == [
        ClosureState.REJECTED,
        *[ClosureState.USED] * (len(INNER) - 1),
    ]
    assert solution.closures[1].scale == pytest.approx(_metres(INNER[1]))
    assert all(r.state is ClosureState.USED for r in solution.closures[len(INNER) :])
    assert [r.query.log for r in solution.closures[len(INNER) :]] == [EARLY] * 6


@pytest.mark.parametrize("fixed", [False, True])
def test_odom_frames_of_the_maps_logs_are_those_of_their_own_odometry(fixed: bool) -> None:
    given = graph([*INNER, *to_map(range(2, 18, 3))], saved(fixed))
    (component,) = solved(given).components
    for log in (R2, R3):
        last = component.T_map_odom[log] @ given.trajectories[log].T_odom_keyframe[-1]
        np.testing.assert_allclose(last, component.T_map_keyframe[log][-1], atol=1e-9)


def test_without_the_map_the_frame_would_be_the_lowest_names() -> None:
    solution = solved(graph([*INNER, *to_map(range(2, 18, 3))], None))
    assert solution.components[0].map_frame == "map/a0"


def test_a_map_that_nobody_joins_is_neither_solved_nor_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[LogId]] = []
    plain = optimiser._optimise

    def noted(given: PoseGraph, *rest: object) -> object:
        asked.append(sorted(given.trajectories))
        return plain(given, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(optimiser, "_optimise", noted)
    opened = saved()
    solution = solved(graph(INNER, opened))
    assert asked == [[EARLY]]
    assert [c.map_frame for c in solution.components] == ["map/r2", "map/a0"]
    assert moved_m(solution, opened) == 0.0


def test_a_map_alone_has_no_round() -> None:
    given = graph(INNER, saved())
    solution = solved(replace(given, trajectories={log: given.trajectories[log] for log in (R2, R3)}))
    assert [c.logs for c in solution.components] == [(R2, R3)]


@pytest.mark.parametrize("fixed", [False, True])
def test_the_next_round_begins_where_the_last_one_ended(fixed: bool) -> None:
    given = graph([*INNER, *to_map(range(2, 18, 3))], saved(fixed))
    first = solved(given)
    more = replace(given, closures=[*given.closures, *to_map(range(3, 18, 3))])
    again = solved(more, initial=first)
    assert again.components[0].map_frame == "map/r2"
    assert error_m(again.components[0].T_map_keyframe[EARLY]) < 0.05
    assert again.iterations <= first.iterations


def contradiction(sigma_m: float) -> list[LoopClosure]:
    """What a team measures of a map whose other log lies 1 m off: both logs, as surely as `sigma_m`."""
    found = []
    for log, indices in ((R2, range(2, 18)), (R3, range(2, 18))):
        off = np.array([0.0, 1.0, 0.0]) if log == R3 else np.zeros(3)
        for k in indices:
            T = inverse(WORLD[R1][k]) @ pose(np.eye(3), off) @ WORLD[log][k]
            S = np.diag([1e-4] * 3 + [sigma_m**2] * 3)
            found.append(LoopClosure(KeyframeId(EARLY, k), KeyframeId(log, k), T, 1e6, covariance=S, metric=True))
    return found


def test_a_map_moves_as_far_as_its_covariance_allows() -> None:
    opened = saved()
    unsure = moved_m(solved(graph([*INNER, *contradiction(20.0)], opened)), opened)
    sure = moved_m(solved(graph([*INNER, *contradiction(0.02)], opened)), opened)
    assert 0.0 < unsure < 0.5 * sure
    assert sure > 0.2
    fixed = saved(is_fixed=True)
    assert moved_m(solved(graph([*INNER, *contradiction(0.02)], fixed)), fixed) < 1e-12


@pytest.mark.parametrize("fixed", [False, True])
def test_a_tag_that_both_saw_joins_a_robot_to_the_map(fixed: bool) -> None:
    T_world_tag = pose(np.eye(3), np.array([4.0, 2.0, 1.0]))
    S = np.diag([1e-4] * 6)

    def seen(log: LogId, k: int, world: LogId) -> MeasuredFactor:
        at = KeyframeId(log, k)
        return MeasuredFactor("tag", at, at, landmark("tag/door"), between(WORLD[world][k], T_world_tag), S)

    given = replace(graph(INNER, saved(fixed)), measured=[seen(R3, 4, R3), seen(EARLY, 5, R1)])
    solution = solved(given)
    assert [c.map_frame for c in solution.components] == ["map/r2"]
    assert error_m(solution.components[0].T_map_keyframe[EARLY]) < 0.1
    assert [r.factor for r in solution.measured] == list(given.measured)


def test_keyframes_that_a_log_has_beyond_the_map_follow_its_odometry() -> None:
    opened = saved()
    short = replace(opened, T_map_camera={**opened.T_map_camera, R3: opened.T_map_camera[R3][:15]})
    (component,) = solved(graph([*INNER, *to_map(range(2, 15, 3))], short)).components
    assert len(component.T_map_keyframe[R3]) == 20


def test_covariances_are_told_under_public_names() -> None:
    wanted = [KeyframeId(R3, 4), KeyframeId(EARLY, 3)]
    given = graph([*INNER, *to_map(range(2, 18, 3))], saved())
    solution = optimise(given, CONFIG, None, wanted)
    assert isinstance(solution, GraphSolution)
    assert set(solution.components[0].covariance_keyframe) == set(wanted)


@pytest.mark.parametrize("fixed", [False, True])
def test_what_is_measured_at_contradicted_keyframes_counts_less(fixed: bool) -> None:
    """One of six closures is off by less than makes an outlier; what it does to the robot shrinks with its weight."""
    right = to_map(range(2, 18, 3))
    changed = right[2]
    off = np.array(changed.T_query_match_unscaled) @ se3_exp(np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0]))
    closures = [*INNER, *(replace(c, T_query_match_unscaled=off) if c is changed else c for c in right)]

    def shifted_m(weights: dict[KeyframeId, float]) -> float:
        opened = replace(saved(fixed), weights=weights)
        solution = solved(graph(closures, opened))
        without = solved(graph([c for c in closures if c.query != changed.query], opened))
        assert solution.closures[closures.index(next(c for c in closures if c.query == changed.query))].weight > 0.0
        (one,), (other,) = (each.components for each in (solution, without))
        return float(np.linalg.norm((one.T_map_keyframe[EARLY] - other.T_map_keyframe[EARLY])[:, :3, 3], axis=1).max())

    shifts_m = [shifted_m({}), shifted_m({changed.match: 1 / 3}), shifted_m({KeyframeId(R3, 1): 1 / 3})]
    print(f"shifted by {shifts_m} m")
    assert shifts_m[1] < 0.6 * shifts_m[0]
    assert shifts_m[2] == shifts_m[0]
