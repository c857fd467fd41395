"""Claims on measured factors: they correct, join maps where they fix all that is open, and wrong ones are named."""

import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from flocc_agent.backend.measured import aligned_points
from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.geodesy import Place, T_earth_enu, T_enu_enu
from flocc_agent.core.pose_graph import (
    EARTH,
    WORLD,
    ClosureState,
    GraphSolution,
    MeasuredFactor,
    PoseGraph,
    Trajectory,
    landmark,
)
from flocc_agent.geometry import Float, inverse, pose, pose_from_tq, se3_exp, so3_exp, tq_from_pose
from flocc_protocol.ids import KeyframeId, LogId

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")
KEYFRAMES = 20
TIGHT = np.diag([1e-4] * 3 + [1e-4] * 3)
CONFIG = BackendConfig()


def truth(phase_rad: float, radius_m: float = 5.0) -> Float:
    """Poses (N, 4, 4) in the world, along an arc."""
    angles = phase_rad + 0.15 * np.arange(KEYFRAMES)
    centre = np.stack([radius_m * np.cos(angles), radius_m * np.sin(angles), 0.3 * np.sin(3 * angles)], axis=1)
    return np.array([pose(so3_exp(np.array([0.0, 0.0, a])), t) for a, t in zip(angles, centre, strict=True)])


T = {R1: truth(0.0), R2: truth(2.0, 7.0), R3: truth(4.0, 6.0)}


def graph(logs: Sequence[LogId], measured: Sequence[MeasuredFactor], drift: float = 0.0) -> PoseGraph:
    """Robots whose odometry starts anywhere, and drifts."""
    rng = np.random.default_rng(5)
    trajectories = {}
    for n, log in enumerate(logs):
        T_odom = [se3_exp(np.array([0.1 * n, -0.2, 0.5 + n, 3.0 * n, -2.0, 1.0]))]
        for step in inverse(T[log][:-1]) @ T[log][1:]:
            T_odom.append(T_odom[-1] @ step @ se3_exp(drift * rng.normal(size=6)))
        trajectories[log] = Trajectory(np.array(T_odom))
    return PoseGraph(trajectories, measured=tuple(measured))


def sighting(log: LogId, index: int, T_world_tag: Float, tag: str = "7") -> MeasuredFactor:
    at = KeyframeId(log, index)
    T_camera_tag = inverse(T[log][index]) @ T_world_tag
    return MeasuredFactor("tag", at, at, landmark(f"tag/{tag}"), T_camera_tag, TIGHT)


def twice(log: LogId, index: int, T_world_tag: Float) -> list[MeasuredFactor]:
    """A tag seen from two keyframes, one after the other."""
    return [sighting(log, index, T_world_tag), sighting(log, index + 1, T_world_tag)]


def seen(log: LogId, index: int, other: LogId, other_index: int, whole: bool) -> MeasuredFactor:
    at, match = KeyframeId(log, index), KeyframeId(other, other_index)
    T_match = inverse(T[log][index]) @ T[other][other_index]
    if whole:
        return MeasuredFactor("robot", at, at, match, T_match, TIGHT)
    return MeasuredFactor("bearing", at, at, match, pose(np.eye(3), T_match[:3, 3]), 1e-4 * np.eye(3))


def fix(log: LogId, index: int, off_m: float = 0.0) -> MeasuredFactor:
    at = KeyframeId(log, index)
    position = T[log][index][:3, 3] + np.array([off_m, 0.0, 0.0])
    return MeasuredFactor("fix", at, landmark(WORLD), at, pose(np.eye(3), position), 1e-4 * np.eye(3))


def start(log: LogId, index: int = 0) -> MeasuredFactor:
    at = KeyframeId(log, index)
    return MeasuredFactor("pose", at, landmark(WORLD), at, T[log][index], TIGHT)


def solved(given: PoseGraph, initial: GraphSolution | None = None) -> GraphSolution:
    found = optimise(given, CONFIG, initial)
    assert isinstance(found, GraphSolution)
    return found


def groups(solution: GraphSolution) -> list[list[str]]:
    return [[str(log) for log in component.logs] for component in solution.components]


def joint_error_m(solution: GraphSolution) -> float:
    """Largest distance of the first component from the truth, both put to their anchor's start."""
    (component, *_) = solution.components
    T_world_map = T[component.anchor][0] @ inverse(component.T_map_keyframe[component.anchor][0])
    return max(
        float(np.linalg.norm((T_world_map @ component.T_map_keyframe[log])[:, :3, 3] - T[log][:, :3, 3], axis=1).max())
        for log in component.logs
    )


TAG = pose(so3_exp(np.array([0.3, 0.0, 1.0])), np.array([2.0, 3.0, 1.0]))


def test_two_robots_that_saw_one_tag_end_in_one_frame() -> None:
    solution = solved(graph([R1, R2], [*twice(R1, 15, TAG), *twice(R2, 3, TAG)]))
    assert groups(solution) == [["r1", "r2"]]
    assert joint_error_m(solution) < 0.01
    assert solution.components[0].map_frame == "map/r1"
    T_map_tag = solution.components[0].T_map_landmark["tag/7"]
    T_world_map = T[R1][0] @ inverse(solution.components[0].T_map_keyframe[R1][0])
    np.testing.assert_allclose(T_world_map @ T_map_tag, TAG, atol=1e-3)
    assert [result.state for result in solution.measured] == [ClosureState.USED] * 4


@pytest.mark.parametrize("times", [(1, 1), (1, 2), (2, 1)])
def test_one_sighting_of_a_tag_alone_joins_no_maps_and_is_named(times: tuple[int, int]) -> None:
    """It may be wrong, and nothing contradicts it; a second one that agrees, or a closure, is needed on both sides."""
    once = [twice(R1, 15, TAG)[: times[0]], twice(R2, 3, TAG)[: times[1]]]
    solution = solved(graph([R1, R2], [*once[0], *once[1]]))
    assert groups(solution) == [["r1"], ["r2"]]
    lonely = [result for result in solution.measured if result.state is not ClosureState.USED]
    assert [result.reason for result in lonely] == ["fewer than 2 closures or sightings that agree join these maps"]
    assert f"{lonely[0].factor} is not used: {lonely[0].reason}" in solution.warnings
    with_tag = [component.logs for component in solution.components if "tag/7" in component.T_map_landmark]
    assert len(with_tag) == 1, "the tag stands where the other one saw it"


def test_two_tags_seen_once_each_by_both_join() -> None:
    elsewhere = TAG @ se3_exp(np.array([0.0, 0.5, 0.0, 1.0, 2.0, 0.0]))
    both = [sighting(log, k, T, tag) for log, k in ((R1, 15), (R2, 3)) for tag, T in (("7", TAG), ("8", elsewhere))]
    solution = solved(graph([R1, R2], both))
    assert groups(solution) == [["r1", "r2"]]
    assert joint_error_m(solution) < 0.01


def test_who_takes_one_sighting_as_enough_may() -> None:
    once = graph([R1, R2], [sighting(R1, 15, TAG), sighting(R2, 3, TAG)])
    solution = optimise(once, CONFIG.model_copy(update={"closures_to_join_min": 1}))
    assert isinstance(solution, GraphSolution)
    assert groups(solution) == [["r1", "r2"]]


def test_a_wrong_sighting_that_came_first_joins_nothing_and_the_next_ones_are_right() -> None:
    wrong = sighting(R2, 3, TAG @ se3_exp(np.array([0.0, 0.0, 0.4, 2.0, 0.0, 0.0])))
    seen_by_r1 = twice(R1, 15, TAG)
    assert groups(solved(graph([R1, R2], [*seen_by_r1, wrong]))) == [["r1"], ["r2"]]
    assert groups(solved(graph([R1, R2], [*seen_by_r1, wrong, sighting(R2, 4, TAG)]))) == [["r1"], ["r2"]]
    solution = solved(graph([R1, R2], [*seen_by_r1, wrong, *twice(R2, 4, TAG), sighting(R2, 6, TAG)]))
    assert groups(solution) == [["r1", "r2"]]
    assert joint_error_m(solution) < 0.01


QUARTERS = [0, 1, 2, 7, 8, 9, 14, 15, 16]
"""Keyframes that look every way."""


def other_order(T_body_tag: Float) -> Float:
    """What is read of a quaternion that was written x y z w."""
    x, y, z, w = tq_from_pose(T_body_tag)[[4, 5, 6, 3]]
    return pose_from_tq(np.array([*T_body_tag[:3, 3], x, y, z, w]))


def farther(T_body_tag: Float) -> Float:
    return pose(T_body_tag[:3, :3], 1.5 * T_body_tag[:3, 3])


@pytest.mark.parametrize(
    ("misread", "told"),
    [
        (other_order, "though positions are right: look at the order of T_body_tag's quaternion (w x y z)"),
        (inverse, "though distances are right: T_body_tag may be inverted"),
        (farther, "and all have them 1.50 times as far: a size or a unit may be wrong"),
    ],
)
def test_sightings_that_are_all_misread_are_one_sentence_that_says_how(
    misread: Callable[[Float], Float], told: str
) -> None:
    right = [sighting(R1, k, TAG) for k in QUARTERS]
    wrong = [replace(s, T_query_match=misread(s.T_query_match)) for k in QUARTERS for s in [sighting(R2, k, TAG)]]
    poses = [start(log, k) for log in (R1, R2) for k in range(KEYFRAMES)]
    solution = solved(graph([R1, R2], [*right, *wrong, *poses]))
    (warning,) = solution.warnings
    assert warning.startswith("none of the 9 sightings of tags at r2 agree with the rest of the map, ")
    assert told in warning
    assert joint_error_m(solution) < 0.01


def test_robots_that_saw_different_tags_stay_apart() -> None:
    solution = solved(graph([R1, R2], [sighting(R1, 15, TAG, "7"), sighting(R2, 3, TAG, "8")]))
    assert groups(solution) == [["r1"], ["r2"]]


def test_a_tag_seen_again_takes_drift_away() -> None:
    bare = graph([R1], [], drift=0.01)
    tagged = replace(bare, measured=tuple(sighting(R1, k, TAG) for k in (0, 1, 17, 18, 19)))
    assert joint_error_m(solved(tagged)) < 0.5 * joint_error_m(solved(bare))


def test_one_wrong_tag_sighting_among_three_is_rejected_and_named() -> None:
    wrong = sighting(R1, 18, TAG @ se3_exp(np.array([0.0, 0.0, 0.4, 2.0, 0.0, 0.0])))
    solution = solved(graph([R1], [sighting(R1, 2, TAG), wrong, sighting(R1, 10, TAG)]))
    states = [result.state for result in solution.measured]
    assert states == [ClosureState.USED, ClosureState.REJECTED, ClosureState.USED]
    assert [warning for warning in solution.warnings if warning.startswith("tag 7 at r1/18 is not used: ")]
    assert joint_error_m(solution) < 0.01


def test_one_wrong_sighting_of_a_tag_does_not_part_two_robots_that_it_joins() -> None:
    wrong = sighting(R2, 18, TAG @ se3_exp(np.array([0.0, 0.0, 0.4, 2.0, 0.0, 0.0])))
    right = [*twice(R1, 2, TAG), sighting(R2, 4, TAG), sighting(R2, 9, TAG)]
    solution = solved(graph([R1, R2], [*right, wrong]))
    assert groups(solution) == [["r1", "r2"]]
    assert [result.state is ClosureState.USED for result in solution.measured] == [True] * 4 + [False]
    assert joint_error_m(solution) < 0.01


def test_two_robots_of_which_one_saw_the_other_whole_end_in_one_frame() -> None:
    once = seen(R1, 4, R2, 7, whole=True)
    assert groups(solved(graph([R1, R2], [once]))) == [["r1"], ["r2"]]
    solution = solved(graph([R1, R2], [once, seen(R2, 8, R1, 5, whole=True)]))
    assert groups(solution) == [["r1", "r2"]]
    assert joint_error_m(solution) < 0.01


@pytest.mark.parametrize("times", [1, 2])
def test_robots_that_saw_each_other_by_too_few_bearings_are_named_not_joined(times: int) -> None:
    bearings = [seen(R1, 4 * k, R2, 7 + k, whole=False) for k in range(times)]
    solution = solved(graph([R1, R2], bearings))
    assert groups(solution) == [["r1"], ["r2"]]
    assert "robots r1 and r2 have seen each other" in " ".join(solution.warnings)
    assert {result.state for result in solution.measured} == {ClosureState.EXCLUDED}


def test_bearings_that_fix_all_six_degrees_of_freedom_join() -> None:
    bearings = [seen(R1, k, R2, k + 2, whole=False) for k in (0, 6, 12)] + [seen(R2, 9, R1, 9, whole=False)]
    solution = solved(graph([R1, R2], bearings))
    assert groups(solution) == [["r1", "r2"]]
    assert joint_error_m(solution) < 0.05


def test_one_wrong_bearing_among_many_is_rejected() -> None:
    bearings = [seen(R1, k, R2, k, whole=False) for k in range(0, 18, 3)]
    off = replace(bearings[2], T_query_match=pose(np.eye(3), bearings[2].T_query_match[:3, 3] + np.array([6.0, 0, 0])))
    solution = solved(graph([R1, R2], [*bearings[:2], off, *bearings[3:]]))
    assert [result.state is ClosureState.USED for result in solution.measured] == [True, True, False, True, True, True]
    assert joint_error_m(solution) < 0.05


def test_known_starts_put_robots_into_one_frame_and_say_where_the_world_is() -> None:
    solution = solved(graph([R1, R2], [start(R1), start(R2)]))
    assert groups(solution) == [["r1", "r2"]]
    assert joint_error_m(solution) < 0.01
    T_map_world = solution.components[0].T_map_world
    assert T_map_world is not None
    np.testing.assert_allclose(T_map_world @ T[R1][0], solution.components[0].T_map_keyframe[R1][0], atol=1e-3)


def test_fixes_take_drift_away_and_a_wrong_one_is_rejected() -> None:
    fixes = [fix(R1, k) for k in range(0, KEYFRAMES, 2)]
    bare = graph([R1], [], drift=0.01)
    wrong = [*fixes[:4], fix(R1, 8, off_m=3.0), *fixes[5:]]
    solution = solved(replace(bare, measured=tuple(wrong)))
    assert [k for k, result in enumerate(solution.measured) if result.state is not ClosureState.USED] == [4]
    (component,) = solution.components
    T_map_world = component.T_map_world
    assert T_map_world is not None
    off_m = np.linalg.norm((inverse(T_map_world) @ component.T_map_keyframe[R1] - T[R1])[:, :3, 3], axis=1)
    assert off_m.max() < 0.1


def test_fixes_of_two_robots_join_them_where_they_fix_each_ones_rotation() -> None:
    spread = [fix(log, k) for log in (R1, R2) for k in range(0, KEYFRAMES, 4)]
    assert groups(solved(graph([R1, R2], spread))) == [["r1", "r2"]]
    few = [fix(log, k) for log in (R1, R2) for k in (0, 1)]
    solution = solved(graph([R1, R2], few))
    assert groups(solution) == [["r1"], ["r2"]]
    assert {result.state for result in solution.measured} == {ClosureState.USED}
    assert all(component.T_map_world is not None for component in solution.components)


def test_geodetic_fixes_give_east_north_up_from_the_first_fix_of_the_lowest_log() -> None:
    origin = Place(48.1, 11.6, 520.0)
    measured = []
    for log in (R2, R1):
        for k in range(0, KEYFRAMES, 3):
            at, place = KeyframeId(log, k), place_at(origin, T[log][k][:3, 3])
            measured.append(MeasuredFactor("gnss", at, landmark(EARTH), at, np.eye(4), 1e-2 * np.eye(3), place))
    solution = solved(graph([R1, R2], measured))
    assert groups(solution) == [["r1", "r2"]]
    T_map_enu = solution.components[0].T_map_landmark[EARTH]
    east_north_up = (inverse(T_map_enu) @ solution.components[0].T_map_keyframe[R1])[:, :3, 3]
    first = T_enu_enu(origin, place_at(origin, T[R1][0][:3, 3]))
    np.testing.assert_allclose(east_north_up, (inverse(first) @ T[R1])[:, :3, 3], atol=0.05)


def place_at(origin: Place, enu_m: Float) -> Place:
    """The place of a point near the origin, by Newton's method on T_enu_enu."""
    guess = np.array(origin)
    for _ in range(5):
        miss = enu_m - T_enu_enu(origin, Place(*guess))[:3, 3]
        guess = guess + miss[[1, 0, 2]] * np.array([8.99e-6, 8.99e-6 / np.cos(np.radians(guess[0])), 1.0])
    return Place(*guess)


def test_the_earth_is_as_large_as_it_is() -> None:
    """Points of WGS 84 whose coordinates follow from its two axes alone."""
    np.testing.assert_allclose(T_earth_enu(Place(0.0, 0.0, 0.0))[:3, 3], [6_378_137.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(T_earth_enu(Place(90.0, 0.0, 0.0))[:3, 3], [0.0, 0.0, 6_356_752.314245], atol=1e-5)
    up = T_earth_enu(Place(0.0, 90.0, 0.0))[:3, :3]
    np.testing.assert_allclose(up, [[-1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-12)


def test_an_edge_of_exact_odometry_moves_less_than_the_others() -> None:
    bare = graph([R1], [sighting(R1, 0, TAG), sighting(R1, 19, TAG @ se3_exp(np.array([0, 0, 0, 0.5, 0, 0.0])))])
    covariances = np.full((KEYFRAMES - 1, 6, 6), np.nan)
    covariances[8] = 1e-8 * np.eye(6)
    log = replace(bare.trajectories[R1], edge_covariances=covariances)
    solution = solved(replace(bare, trajectories={R1: log}))
    poses = solution.components[0].T_map_keyframe[R1]
    steps = inverse(poses[:-1]) @ poses[1:]
    moved_m = np.linalg.norm((steps - inverse(log.T_odom_keyframe[:-1]) @ log.T_odom_keyframe[1:])[:, :3, 3], axis=1)
    assert moved_m[8] < 0.01 * np.median(moved_m)


def test_a_round_starts_from_the_one_before_with_its_landmarks() -> None:
    given = graph([R1, R2], [*twice(R1, 15, TAG), *twice(R2, 3, TAG), start(R1)])
    first = solved(given)
    again = solved(given, first)
    assert again.iterations < first.iterations
    np.testing.assert_allclose(
        again.components[0].T_map_keyframe[R2], first.components[0].T_map_keyframe[R2], atol=1e-4
    )


def test_a_metric_closure_joins_and_is_weighed() -> None:
    measured = []
    for i, j in ((3, 8), (4, 9)):
        at, match = KeyframeId(R1, i), KeyframeId(R2, j)
        measured.append(MeasuredFactor("closure", at, at, match, inverse(T[R1][i]) @ T[R2][j], TIGHT))
    assert groups(solved(graph([R1, R2], measured[:1]))) == [["r1"], ["r2"]]
    solution = solved(graph([R1, R2], measured))
    assert groups(solution) == [["r1", "r2"]]
    assert joint_error_m(solution) < 0.01


def test_a_graph_with_landmarks_is_sent_to_a_worker_and_back() -> None:
    given = graph([R1, R2], [*twice(R1, 15, TAG), *twice(R2, 3, TAG)])
    sent = pickle.loads(pickle.dumps(given))  # our own bytes
    solution = pickle.loads(pickle.dumps(solved(sent)))
    assert groups(solution) == [["r1", "r2"]]
    assert solution.measured[0].factor.match == given.measured[0].match


def test_points_on_a_line_do_not_fix_a_rotation() -> None:
    line = np.outer(np.arange(6.0), [1.0, 2.0, 0.5])
    plane = line + np.array([[0, 0, 0], [0, 1, 0], [0, 2, 1.0], [0, 0, 2], [1, 0, 0], [0, 0, 0]])
    sigmas = np.full(6, 0.1)
    assert not aligned_points(line, line, sigmas)[1]
    assert aligned_points(plane, plane, sigmas)[1]
    assert not aligned_points(plane[:2], plane[:2], sigmas[:2])[1]


def test_right_fixes_of_a_long_way_that_drifted_far_are_kept_and_wrong_ones_rejected() -> None:
    """Laid as a rigid whole, most right fixes would look wrong, and GNC would throw them out."""
    rng, count, sigma_m = np.random.default_rng(2), 1500, 2.0
    way, T_odom = [np.eye(4)], [np.eye(4)]
    for k in range(count - 1):
        step = se3_exp(np.array([0.0, 0.0, 0.05 * np.sin(k / 40), 1.0, 0.0, 0.0]))
        way.append(way[-1] @ step)
        T_odom.append(T_odom[-1] @ step @ se3_exp(np.repeat([0.02, 0.03], 3) * rng.normal(size=6)))
    wrong = set(range(50, count, 150))
    measured = []
    for k in range(0, count, 5):
        off_m = 30.0 if k in wrong else sigma_m
        at, position = KeyframeId(R1, k), way[k][:3, 3] + off_m * rng.normal(size=3)
        world = landmark(WORLD)
        measured.append(MeasuredFactor("fix", at, world, at, pose(np.eye(3), position), sigma_m**2 * np.eye(3)))
    solution = solved(PoseGraph({R1: Trajectory(np.array(T_odom))}, measured=tuple(measured)))
    rejected = {r.factor.at.index for r in solution.measured if r.state is not ClosureState.USED}
    assert rejected <= wrong
    assert len(rejected) >= len(wrong) - 2
    (component,) = solution.components
    assert component.T_map_world is not None
    off = (inverse(component.T_map_world) @ component.T_map_keyframe[R1] - np.array(way))[:, :3, 3]
    assert np.linalg.norm(off, axis=1).mean() < sigma_m
