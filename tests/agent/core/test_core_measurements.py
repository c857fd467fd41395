"""Claims on measurements: each belongs to its keyframe, waits for it, and is refused with a reason where it cannot."""

from pathlib import Path

import numpy as np
import pytest
from tests.agent.core.virtual_time import Robots, answer

from flocc_agent.core.effects import Effect, Encode
from flocc_agent.core.events import Event, KeyframeEncodingFailed, Measured
from flocc_agent.core.measurement_text import measurement_of
from flocc_agent.core.measurements import (
    WAITING_MAX,
    BadMeasurement,
    Fix,
    MetricClosure,
    OdometryCovariance,
    PoseFix,
    RobotBearing,
    RobotSighting,
    StartPose,
    TagSighting,
)
from flocc_agent.core.reports import MeasurementRefused
from flocc_agent.geometry import Float, inverse, pose, se3_exp, se3_log, so3_exp
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import (
    FixRecord,
    KeyframeRecord,
    OdometryCovarianceRecord,
    Record,
    RobotBearingRecord,
    TagSightingRecord,
)

T_SOME = pose(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
T_MOUNT = pose(so3_exp(np.array([-1.2, 0.0, -1.2])), np.array([0.2, 0.0, 0.1]))
SPREAD = np.diag([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])


def fix(x_m: float) -> Fix:
    return Fix(np.array([x_m, 0.0, 0.0]), np.eye(3))


def own_log(robots: Robots, name: str = "r1") -> list[Record]:
    return list(robots.cores[name].gossip.logs[LogId(name)].records)


def kinds(robots: Robots) -> list[tuple[str, int]]:
    return [
        (type(record).__name__, record.index)
        for record in own_log(robots)
        if isinstance(record, KeyframeRecord | FixRecord | TagSightingRecord | OdometryCovarianceRecord)
    ]


def unable(robots: Robots, name: str, effect: Effect) -> Event | None:
    """Every second keyframe cannot be encoded."""
    if isinstance(effect, Encode) and effect.keyframe.index % 2 == 1:
        return KeyframeEncodingFailed(effect.keyframe, "too dark")
    return answer(effect)


def test_a_fix_waits_for_its_keyframe_and_follows_its_record() -> None:
    robots = Robots()
    robots.add("r1")
    for k in range(3):
        robots.capture("r1", 5.0 * k, look=k)
        robots.put("r1", Measured(fix(5.0 * k), k))
    assert own_log(robots) == []
    robots.run(1.0)
    assert kinds(robots) == [(kind, k) for k in range(3) for kind in ("KeyframeRecord", "FixRecord")]


def test_a_keyframe_that_failed_to_encode_keeps_its_odometry_and_what_was_measured_there() -> None:
    robots = Robots(work=unable)
    robots.add("r1")
    for k in range(3):
        robots.capture("r1", 5.0 * k, look=k)
        robots.put("r1", Measured(fix(5.0 * k), k))
    robots.run(1.0)
    assert kinds(robots) == [(kind, k) for k in range(3) for kind in ("KeyframeRecord", "FixRecord")]
    fixes = [record for record in own_log(robots) if isinstance(record, FixRecord)]
    assert [float(record.position_m.numpy()[0]) for record in fixes] == [0.0, 5.0, 10.0]


def test_a_measurement_of_a_keyframe_that_is_recorded_is_appended_at_once() -> None:
    robots = Robots()
    robots.add("r1")
    for k in range(2):
        robots.capture("r1", 5.0 * k, look=k)
    robots.run(1.0)
    robots.put("r1", Measured(TagSighting("7", np.eye(4), np.eye(6)), 0))
    assert kinds(robots)[-1] == ("TagSightingRecord", 0)


def test_what_belongs_to_no_keyframe_is_refused_with_a_reason() -> None:
    robots = Robots()
    robots.add("r1")
    robots.put("r1", Measured(fix(0.0), 0))
    robots.put("r1", Measured(fix(0.0), 3))
    robots.capture("r1", 0.0, look=0)
    robots.run(1.0)
    robots.put("r1", Measured(OdometryCovariance(np.eye(6)), 0))
    reasons = [refused.reason for refused in robots.facts("r1", MeasurementRefused)]
    assert reasons == ["there is no such keyframe", "odometry: the first keyframe has no edge before it"]


def test_a_known_start_waits_for_the_first_keyframe() -> None:
    robots = Robots()
    robots.add("r1")
    robots.put("r1", Measured(StartPose(np.eye(4), np.eye(6)), 0))
    robots.capture("r1", 0.0, look=0)
    robots.run(1.0)
    assert [type(record).__name__ for record in own_log(robots)] == ["KeyframeRecord", "PoseFixRecord"]


def test_as_many_measurements_wait_for_a_keyframe_as_the_limit_says() -> None:
    robots = Robots(work=lambda robots, name, effect: None)
    robots.add("r1")
    robots.capture("r1", 0.0, look=0)
    for _ in range(WAITING_MAX + 1):
        robots.put("r1", Measured(fix(0.0), 0))
    (refused,) = robots.facts("r1", MeasurementRefused)
    assert refused.reason == f"{WAITING_MAX} others wait for this keyframe"
    held, most = robots.cores["r1"].sizes()["measurements"]
    assert held == most == WAITING_MAX


@pytest.mark.parametrize("seed", range(20))
def test_in_any_order_each_fix_stands_behind_its_own_keyframe(seed: int) -> None:
    """Fixes of earlier, last and failed keyframes, while encodings end or not: x says whose each is."""
    rng = np.random.default_rng(seed)
    robots = Robots(work=unable)
    robots.add("r1")
    given, wanted = 0, []
    for _ in range(60):
        match rng.integers(3):
            case 0:
                robots.capture("r1", 5.0 * given, look=given)
                given += 1
            case 1 if given:
                index = int(rng.integers(given))
                robots.put("r1", Measured(fix(5.0 * index), index))
                wanted.append(index)
            case _:
                robots.run(float(rng.uniform(0.0, 0.15)))
    robots.run(1.0)
    keyframes: list[float] = []
    fixes: list[int] = []
    for record in own_log(robots):
        if isinstance(record, KeyframeRecord):
            keyframes.append(record.T_odom_camera[0])
        elif isinstance(record, FixRecord):
            assert keyframes[record.index] == float(record.position_m.numpy()[0])
            fixes.append(record.index)
    assert keyframes == [5.0 * k for k in range(given)]
    assert sorted(fixes) == sorted(wanted)


# --- what users give -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "values", "complaint"),
    [
        ("fix", {"position_m": [0, 0], "covariance_m2": [1, 1, 1]}, "no position in a local frame"),
        ("fix", {"position_m": [0, 0, 0], "covariance_m2": [1, -1, 1]}, "not positive definite"),
        ("fix", {"position_m": [0, 0, 0]}, "fix: covariance_m2 is missing"),
        ("fix", {"position_m": [0, 0, 0], "covariance_m2": [1, 1, 1], "colour": 1}, "'colour' is not one of"),
        ("gnss", {"latitude_deg": 91, "longitude_deg": 0, "altitude_m": 0, "covariance_m2": [1, 1, 1]}, "no place"),
        ("tag", {"tag": "", "T_body_tag": [0, 0, 0, 1, 0, 0, 0], "covariance": [1] * 6}, "a name has 1 to 64"),
        ("tag", {"tag": "7", "T_body_tag": [0, 0, 0, 1], "covariance": [1] * 6}, "pose is not finite and rigid"),
        ("tag", {"tag": "7", "T_body_tag": [0, 0, 0, 0, 0, 0, 0], "covariance": [1] * 6}, "tag: "),
        ("robot", {"robot": "R 2", "T_body_robot": [0, 0, 0, 1, 0, 0, 0], "covariance": [1] * 6}, "robot name 'R 2'"),
        ("bearing", {"robot": "r2", "bearing": [0, 0, 0], "range_m": 1, "bearing_sigma_rad": 1, "range_sigma_m": 1},
         "no direction"),
        ("bearing", {"robot": "r2", "bearing": [1, 0, 0], "range_m": -1, "bearing_sigma_rad": 1, "range_sigma_m": 1},
         "range_m must be positive"),
        ("bearing", {"robot": "r2", "bearing": [1, 0, 0], "range_m": "x", "bearing_sigma_rad": 1, "range_sigma_m": 1},
         "wrong type"),
        ("closure", {"match": "nobody", "T_query_match": [0, 0, 0, 1, 0, 0, 0], "covariance": [1] * 6}, "closure: "),
        ("odometry", {"covariance": [1, 1, 1]}, "not a finite (6, 6) matrix"),
        ("smell", {}, "'smell' is no kind of measurement"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused_with_a_reason(kind: str, values: dict[str, object], complaint: str) -> None:
    with pytest.raises(BadMeasurement) as caught:
        measurement_of(kind, values)
    assert complaint in str(caught.value)


def test_the_text_form_of_every_kind_is_read() -> None:
    T = [1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]
    rows: list[tuple[str, dict[str, object]]] = [
        ("fix", {"position_m": [1, 2, 3], "covariance_m2": [1, 1, 1]}),
        ("fix", {"position_m": [1, 2, 3], "covariance_m2": [1, 0, 0, 0, 1, 0, 0, 0, 1], "R_world_body": [1, 0, 0, 0]}),
        ("gnss", {"latitude_deg": 48.1, "longitude_deg": 11.6, "altitude_m": 520.0, "covariance_m2": [1, 1, 4]}),
        ("pose", {"T_world_body": T, "covariance": [1] * 6}),
        ("start", {"T_world_body": T, "covariance": [1] * 6}),
        ("tag", {"tag": "7", "T_body_tag": T, "covariance": [1] * 6}),
        ("robot", {"robot": "r2", "T_body_robot": T, "covariance": [1] * 6}),
        (
            "bearing",
            {"robot": "r2", "bearing": [1, 0, 0], "range_m": 4.0, "bearing_sigma_rad": 0.1, "range_sigma_m": 1},
        ),
        ("closure", {"match": "r2/5", "T_query_match": T, "covariance": np.eye(6).ravel().tolist()}),
        ("odometry", {"covariance": [1] * 6}),
    ]
    for kind, values in rows:
        measurement = measurement_of(kind, values)
        assert measurement.kind == kind
        measurement.in_camera(T_MOUNT).record(KeyframeId(LogId("r1"), 3))


def moved(T: Float, xi: Float) -> Float:
    return np.asarray(T @ se3_exp(xi))


@pytest.mark.parametrize("axis", range(6))
def test_a_covariance_is_moved_to_the_camera_as_the_pose_is(axis: int) -> None:
    """A small error of the body's pose is, in the camera's tangent, what the moved covariance says."""
    xi = np.zeros(6)
    xi[axis] = 1e-4
    of_body = PoseFix(T_SOME, np.outer(xi, xi) + 1e-14 * np.eye(6))
    T_world_camera = T_SOME @ T_MOUNT
    seen = se3_log(inverse(T_world_camera) @ moved(T_SOME, xi) @ T_MOUNT)
    np.testing.assert_allclose(of_body.in_camera(T_MOUNT).covariance, np.outer(seen, seen), atol=1e-12)


def test_a_robot_seen_is_turned_into_its_camera_seen_from_this_camera() -> None:
    T_other_mount = pose(np.eye(3), np.array([0.0, 0.0, 0.5]))
    seen = RobotSighting("r2", T_SOME, SPREAD, T_other_mount).in_camera(T_MOUNT)
    np.testing.assert_allclose(seen.T_body_robot, inverse(T_MOUNT) @ T_SOME @ T_other_mount)


def test_a_closure_of_bodies_is_turned_into_one_of_cameras() -> None:
    closure = MetricClosure(KeyframeId(LogId("r2"), 3), T_SOME, SPREAD).in_camera(T_MOUNT)
    np.testing.assert_allclose(closure.T_query_match, inverse(T_MOUNT) @ T_SOME @ T_MOUNT)


def test_a_bearing_and_range_becomes_a_position_with_its_spread_along_and_across() -> None:
    bearing = RobotBearing("r2", np.array([2.0, 0.0, 0.0]), 10.0, 0.01, 0.5).in_camera(np.eye(4))
    record = bearing.record(KeyframeId(LogId("r1"), 3))
    assert isinstance(record, RobotBearingRecord)
    np.testing.assert_allclose(record.position_m.numpy(), [10.0, 0.0, 0.0])
    np.testing.assert_allclose(record.covariance_m2.numpy(), np.diag([0.25, 0.01, 0.01]).ravel(), atol=1e-12)


@pytest.mark.parametrize("kind", ["TagSighting", "RobotSighting", "RobotBearing", "GeodeticFix"])
def test_a_kind_of_measurement_touches_at_most_four_source_files(kind: str) -> None:
    """Simulated sensors and the positions' file format aside, which name some kinds for reasons of their own."""
    roots = [
        Path(__file__).parents[3] / root for root in ("protocol", "agent/flocc_agent/core", "agent/flocc_agent/backend")
    ]
    touched = [path for root in roots for path in root.rglob("*.py") if kind in path.read_text(encoding="utf-8")]
    assert 3 <= len(touched) <= 4, touched
