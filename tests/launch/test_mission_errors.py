"""iATE and iF1: what counts during a mission, on runs whose answers are known by hand."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.launch import synthetic_run
from tests.launch.synthetic_run import Synthetic

from flocc_agent.core.reports import CorrectionApplied, Fact, KeyframeTaken
from flocc_agent.geometry import pose, pose7, pose_from_tq, so3_exp
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.robot_result import ClosureKnown
from flocc_launch.report import RunReport, evaluate, finish
from flocc_launch.runs.loaded_run import load
from flocc_launch.runs.moments import mean_errors, moments_of, poses_then
from flocc_launch.runs.right_closures import Judged, agrees, mean_f1, points_along
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.runs.tracks import RobotTrack
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]


def line(y_m: float, step_m: float = 1.0, length: int = 4) -> Float:
    """Poses along x at one y, all turned alike."""
    return np.array([pose(np.eye(3), np.array([step_m * k, y_m, 0.0])) for k in range(length)])


def track(robot: str, T_odom_body: Float, T_world_body: Float, incarnation: int = 0) -> RobotTrack:
    count = len(T_odom_body)
    every, none = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
    nowhere: Float = np.full_like(T_odom_body, np.nan)
    return RobotTrack(
        robot, incarnation, None, np.arange(count, dtype=np.float64), T_odom_body, none, nowhere, every, T_world_body
    )


def taken(t: float, robot: str, index: int, incarnation: int = 0) -> Reported[Fact]:
    keyframe = KeyframeId(LogId(robot, incarnation), index)
    return Reported(t, robot, KeyframeTaken(keyframe=keyframe, stamp_s=t, T_odom_body=pose7(np.eye(4))))


def corrected(t: float, robot: str, round_: int, y_m: float, frame: str = "map/r1") -> Reported[Fact]:
    T_map_odom = pose7(pose(np.eye(3), np.array([0.0, y_m, 0.0])))
    fact = CorrectionApplied(term=1, leader="r1", round=round_, map_frame=frame, T_map_odom=T_map_odom)
    return Reported(t, robot, fact)


def two_lines(step_m: float = 1.0) -> dict[str, RobotTrack]:
    """r1 along y = 0, r2 along y = 2, both with odometry from the origin; that of r2 has another scale."""
    return {"r1": track("r1", line(0), line(0)), "r2": track("r2", line(0, step_m), line(2))}


def both_take(count: int, t: float = 0.0) -> list[Reported[Fact]]:
    return [taken(t + 0.1 * k, robot, k) for k in range(count) for robot in ("r1", "r2")]


def test_the_joint_error_of_each_round_is_averaged() -> None:
    events = [
        *both_take(2),
        corrected(1.0, "r1", 1, 0.0),  # r2 has no correction yet: no joint map
        corrected(2.0, "r1", 2, 0.0),
        corrected(2.1, "r2", 2, 5.0),  # 3 m too far: 1.5 m each, once both are aligned together
        *both_take(4, 3.0),
        corrected(4.0, "r1", 3, 0.0),
        corrected(4.1, "r2", 3, 2.5),  # half a metre too far
    ]
    tracks = two_lines()
    moments = moments_of(events, tracks)
    assert [moment.t for moment in moments] == [1.0, 2.1, 4.1]
    assert [dict(moment.keyframes) for moment in moments] == [{"r1": 2, "r2": 2}] * 2 + [{"r1": 4, "r2": 4}]
    mean = mean_errors(moments, tracks)
    assert mean is not None
    assert (mean.corrected_m, mean.odometry_m) == pytest.approx((0.5 * (1.5 + 0.25), 0.0), abs=1e-9)
    assert mean.moments == 2


def test_odometry_counts_the_keyframes_that_existed() -> None:
    tracks = two_lines(step_m=2.0)
    events = [
        *both_take(2),
        corrected(1.0, "r1", 1, 0.0),
        corrected(1.0, "r2", 1, 2.0),
        *both_take(4, 2.0),
        corrected(3.0, "r1", 2, 0.0),
        corrected(3.0, "r2", 2, 2.0),
    ]
    mean = mean_errors(moments_of(events, tracks), tracks)
    assert mean is not None
    # r2 is 0 and 1 m off, then 0, 1, 2 and 3 m; r1 is right.
    assert mean.odometry_m == pytest.approx(0.5 * (np.sqrt(1 / 4) + np.sqrt(14 / 8)), abs=1e-9)


@pytest.mark.parametrize("events", [
    [*both_take(2), corrected(1.0, "r1", 1, 0.0)],
    [*both_take(2), corrected(1.0, "r1", 1, 0.0), corrected(1.1, "r2", 1, 0.0, "map/r2")],
    [corrected(1.0, "r1", 1, 0.0)],
    [],
], ids=["one robot uncorrected", "two frames", "no keyframe", "nothing"])  # fmt: skip
def test_without_one_map_nothing_is_averaged(events: list[Reported[Fact]]) -> None:
    tracks = two_lines()
    assert mean_errors(moments_of(events, tracks), tracks) is None


def test_a_robot_without_ground_truth_makes_the_error_unknown() -> None:
    tracks = two_lines()
    tracks["r2"].true[:] = False
    events = [*both_take(2), corrected(1.0, "r1", 1, 0.0), corrected(1.0, "r2", 1, 2.0)]
    assert mean_errors(moments_of(events, tracks), tracks) is None


def test_a_log_that_ended_and_its_corrections_do_not_count() -> None:
    tracks = {"r1": track("r1", line(0), line(0), incarnation=7)}
    old = [taken(0.0, "r1", 0), taken(0.1, "r1", 1), corrected(0.2, "r1", 1, 0.0)]
    assert mean_errors(moments_of(old, tracks), tracks) is None
    new = [taken(1.0, "r1", 0, incarnation=7), taken(1.1, "r1", 1, incarnation=7)]
    moments = moments_of([*old, *new, corrected(2.0, "r1", 2, 0.0)], tracks)
    assert [(dict(m.keyframes), len(m.corrections)) for m in moments] == [({}, 1), ({"r1": 2}, 1)]
    (between,) = moments_of([*old[:2], *new, corrected(2.0, "r1", 2, 0.0)], tracks)
    assert between.corrections.keys() == {"r1"}


def test_between_two_knots_the_correction_is_interpolated_and_stays_behind_the_last() -> None:
    odometry, truth = line(0, step_m=1.5, length=7), line(3, step_m=1.0, length=7)
    knots = (0, 2, 5)
    fact = CorrectionApplied(
        term=1, round=1, map_frame="map/r1", T_map_odom=pose7(np.eye(4)),
        knots=knots, T_map_body=tuple(pose7(truth[k]) for k in knots),
    )  # fmt: skip
    poses = poses_then(fact, odometry)
    np.testing.assert_allclose(poses[:6], truth[:6], atol=1e-12)
    np.testing.assert_allclose(poses[6, :3, 3], truth[5, :3, 3] + [1.5, 0, 0], atol=1e-12)
    early = poses_then(fact, odometry[:2])  # only the first knot is known yet
    np.testing.assert_allclose(early[1, :3, 3], truth[0, :3, 3] + [1.5, 0, 0], atol=1e-12)


def test_knots_that_do_not_fit_their_poses_are_left_out() -> None:
    fact = CorrectionApplied(
        term=1, round=1, map_frame="map/r1", T_map_odom=pose7(line(2)[0]), knots=(-1, 9, 0), T_map_body=()
    )
    np.testing.assert_allclose(poses_then(fact, line(0)), line(2), atol=1e-12)


# Closures


def test_f1_of_each_round_is_averaged() -> None:
    closures = [
        Judged(at_s=0.5, right=True, kept=True),
        Judged(at_s=1.5, right=False, kept=True),
        Judged(at_s=1.6, right=True, kept=False),
        Judged(at_s=1.7, right=False, kept=False),
    ]
    tracks = two_lines()
    events = [*both_take(2), *(corrected(t, "r1", k, 0.0) for k, t in enumerate((0.2, 1.0, 2.0)))]
    # No closure yet; one that is right: 1; one hit, one false alarm, one miss: 1 / 2.
    assert mean_f1(moments_of(events, tracks), closures) == pytest.approx(0.75)
    assert mean_f1(moments_of(events, tracks), []) is None
    assert mean_f1([], closures) is None


@pytest.mark.parametrize(
    ("measured", "true", "along"),
    [
        ((2.0, 0.0, 0.0), (1.0, 0.0, 0.0), True),
        ((1.0, 0.26, 0.0), (1.0, 0.0, 0.0), True),
        ((1.0, 0.28, 0.0), (1.0, 0.0, 0.0), False),
        ((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), False),
        ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), False),
        ((-1.0, 0.0, 0.0), (0.1, 0.0, 0.0), True),
    ],
    ids=["longer", "14.6 degrees", "15.6 degrees", "opposite", "nowhere", "too near to judge"],
)
def test_a_direction_is_right_within_15_degrees(measured: Any, true: Any, along: bool) -> None:
    assert points_along(np.array(measured), np.array(true)) is along


def turned(closure: ClosureKnown, degrees: float) -> ClosureKnown:
    assert closure.T_query_match_unscaled is not None
    T = pose_from_tq(np.array(closure.T_query_match_unscaled))
    T[:3, :3] = T[:3, :3] @ so3_exp(np.array([0.0, 0.0, np.deg2rad(degrees)]))
    return closure.model_copy(update={"T_query_match_unscaled": list(pose7(T))})


def test_a_rotation_is_right_within_5_degrees(tmp_path: Path) -> None:
    loaded = load(synthetic_run.write(tmp_path / "run"))
    closure = loaded.results["r1"].closures[0]
    assert [agrees(turned(closure, d), loaded) for d in (0.0, 4.9, 5.1, -30.0)] == [True, True, False, False]
    nobody = closure.model_copy(update={"query": "r9/0"})
    assert agrees(nobody, loaded) is None
    assert agrees(closure.model_copy(update={"T_query_match_unscaled": None}), loaded) is None


def with_closures(folder: RunFolder, changed: dict[str, ClosureKnown]) -> RunReport:
    """Finish a run again whose robots hold other closures, by query and match."""
    for path in (folder.path / "robots").glob("*/result.json"):
        result = json.loads(path.read_text())
        result["closures"] = [changed[f"{c['query']} {c['match']}"].model_dump() for c in result["closures"]]
        path.write_text(json.dumps(result))
    return finish(RunFolder.open(folder.path))


def test_if1_of_a_run_whose_every_third_closure_is_wrong(tmp_path: Path) -> None:
    made = Synthetic()
    folder = synthetic_run.write(tmp_path / "run", made)
    assert finish(folder).if1 == 1.0
    closures = {f"{c.query} {c.match}": c for c in made.closures}
    wrong = set(list(closures)[::3])
    broken = {key: turned(c, 20.0) if key in wrong else c for key, c in closures.items()}
    report = with_closures(folder, broken)
    accepted = {f"{e['query']} {e['match']}": e["t"] for e in made.events if e["event"] == "closure_accepted"}
    last: dict[int, float] = {}
    for event in made.events:
        if event["event"] == "correction":
            last[event["round"]] = max(event["t"], last.get(event["round"], 0.0))
    f1s = []
    for t in last.values():
        kept = [key for key in accepted if accepted[key] <= t]
        right = [key for key in kept if key not in wrong]
        f1s += [2 * len(right) / (len(kept) + len(right))] if kept else []
    assert report.if1 == pytest.approx(np.mean(f1s))
    assert report.if1 is not None
    assert report.if1 < 0.9
    # The solver lets go of all that are wrong, and only of these.
    settled = {key: c.model_copy(update={"scale": None if key in wrong else 2.0}) for key, c in broken.items()}
    settled_report = with_closures(folder, settled)
    assert settled_report.if1 is not None
    assert settled_report.if1 > 0.99


# Report


def test_the_report_shows_both_beside_the_final_error(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    report = finish(folder)
    written = json.loads((folder.path / "report.json").read_text())
    assert written["iate_m"] == report.iate_m
    assert report.iate_m is not None
    assert report.iate_odometry_m is not None
    assert (written["odometry_scale"], written["maps_used"]) == (dict.fromkeys(report.robots), [])
    html, text = (folder.path / "report.html").read_text(), evaluate(folder.path)
    assert f"mean ATE during the run; F1 of closures {report.if1:.2f}" in html
    assert "during the run" in html
    assert f"during it     ATE {report.iate_m:.2f} m; odometry {report.iate_odometry_m:.2f} m" in text


def test_without_ground_truth_both_are_unknown(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run", Synthetic(with_truth=False))
    report = finish(folder)
    assert (report.iate_m, report.iate_odometry_m, report.iate_moments, report.if1) == (None, None, 0, None)
    assert "during it" not in evaluate(folder.path)
