"""What RViz and a robot monitor are told: markers drawn from their own fields, a robot's state judged."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flocc_agent.core.corrected import CorrectedLog, RecordedOdometry
from flocc_agent.core.log_copy import LogCopy
from flocc_agent.geometry import pose, pose7, so3_exp
from flocc_agent.runtime.ros2.diagnostics import ERROR, OK, WARN, diagnostics, judged
from flocc_agent.runtime.ros2.markers import ABOVE_M, KEYFRAMES_MAX, KnownClosure, Markers
from flocc_agent.runtime.ros2.types import MessageTypes
from flocc_agent.runtime.status import AgentStatus
from flocc_protocol.ids import KeyframeId, LogId, Term
from flocc_protocol.messages import LogCorrection
from flocc_protocol.records import KeyframeRecord, encode_record

TYPES = MessageTypes()
T_MAP_ODOM = {
    "r1": pose(np.eye(3), np.zeros(3)),
    "r2": pose(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([2.0, -1.0, 0.0])),
}


def corrected_log(robot: str, keyframes: int, incarnation: int = 0) -> CorrectedLog:
    """A log along x of its odometry, a keyframe per metre, moved as a whole."""
    log = LogId(robot, incarnation)
    copy = LogCopy()
    for k in range(keyframes):
        T = pose7(pose(np.eye(3), np.array([float(k), 0.0, 0.0])))
        copy.append(encode_record(KeyframeRecord(k, float(k), T, None)))
    term = Term(1, LogId("r2"))
    correction = LogCorrection(log, term, 1, term.leader, pose7(T_MAP_ODOM[robot]))
    return CorrectedLog(correction, RecordedOdometry(copy))


def closure(query: int, match: int, probability: float | None = None, incarnation: int = 0) -> KnownClosure:
    """A closure between the two robots."""
    return KnownClosure(KeyframeId(LogId("r1", incarnation), query), KeyframeId(LogId("r2"), match), probability)


def by_name(array: Any) -> dict[tuple[str, int], Any]:
    return {(marker.ns, marker.id): marker for marker in array.markers}


def xyz(point: Any) -> list[float]:
    return [point.x, point.y, point.z]


LOGS = {"r1": corrected_log("r1", 6), "r2": corrected_log("r2", 5)}


def test_an_array_first_deletes_what_was_drawn_before() -> None:
    first = Markers(TYPES, "map").array({}, [], None, 0).markers[0]
    assert first.action == first.DELETEALL


def test_robots_paths_and_closures_lie_where_the_corrections_say() -> None:
    told = by_name(Markers(TYPES, "map").array(LOGS, [closure(1, 2, 1.0), closure(0, 4, 0.0)], "r2", 3_000_000_007))
    path = told["path/r2", 0]
    assert path.type == path.LINE_STRIP
    np.testing.assert_allclose([xyz(p) for p in path.points], [[2, -1 + k, 0] for k in range(5)], atol=1e-6)
    assert [xyz(p) for p in told["keyframes/r2", 0].points] == [xyz(p) for p in path.points]
    np.testing.assert_allclose(xyz(told["robots", 2].pose.position), [2, 3, 0], atol=1e-6)
    np.testing.assert_allclose(xyz(told["robots", 3].pose.position), np.array([2, 3, 0]) + ABOVE_M, atol=1e-6)
    assert [told["robots", k].text for k in (1, 3)] == ["r1", "r2 (leads)"]
    assert told["robots", 2].scale.x > told["robots", 0].scale.x
    lines = told["closures", 0]
    assert lines.type == lines.LINE_LIST
    np.testing.assert_allclose([xyz(p) for p in lines.points], [[1, 0, 0], [2, 1, 0], [0, 0, 0], [2, 3, 0]], atol=1e-6)
    assert [colour.r for colour in lines.colors] == [1.0, 1.0, 0.0, 0.0]
    assert {(m.header.frame_id, m.header.stamp.sec, m.header.stamp.nanosec) for m in told.values()} == {("map", 3, 7)}
    assert all(abs(m.pose.orientation.w) == 1.0 for m in told.values())


def test_closures_with_an_end_that_is_not_in_the_map_are_left_out() -> None:
    elsewhere = KnownClosure(KeyframeId(LogId("r1"), 0), KeyframeId(LogId("r9"), 0), None)
    told = by_name(
        Markers(TYPES, "map").array(LOGS, [elsewhere, closure(0, 99), closure(0, 1, incarnation=7)], "r1", 0)
    )
    assert told["closures", 0].points == []


def test_a_long_journey_is_thinned_and_ends_where_it_ends() -> None:
    told = by_name(Markers(TYPES, "map").array({"r1": corrected_log("r1", 5 * KEYFRAMES_MAX + 3)}, [], None, 0))
    points = told["path/r1", 0].points
    assert KEYFRAMES_MAX / 2 < len(points) <= KEYFRAMES_MAX + 1
    assert points[-1].x == 5 * KEYFRAMES_MAX + 2


def test_markers_are_written_and_drawn_from_their_own_fields(tmp_path: Path) -> None:
    array = Markers(TYPES, "map").array(LOGS, [closure(1, 2, 1.0), closure(0, 4, 0.3)], "r2", 0)
    read = TYPES.read(TYPES.written(array), "visualization_msgs/msg/MarkerArray")
    draw(read, tmp_path / "markers.png")
    assert (tmp_path / "markers.png").stat().st_size > 5000


def draw(array: Any, path: Path) -> None:
    """Markers as RViz draws them, from above."""
    pyplot = pytest.importorskip("matplotlib.pyplot")
    figure, axes = pyplot.subplots(figsize=(8, 6))
    for marker in array.markers:
        colour = (marker.color.r, marker.color.g, marker.color.b)
        points = np.array([xyz(point) for point in marker.points]).reshape(-1, 3)
        if marker.action == marker.DELETEALL:
            axes.clear()
        elif marker.type == marker.LINE_STRIP:
            axes.plot(points[:, 0], points[:, 1], color=colour, linewidth=40 * marker.scale.x)
        elif marker.type == marker.POINTS:
            axes.plot(points[:, 0], points[:, 1], "s", color=colour, markersize=60 * marker.scale.x)
        elif marker.type == marker.LINE_LIST:
            for k in range(0, len(points), 2):
                c = marker.colors[k]
                axes.plot(*points[k : k + 2, :2].T, color=(c.r, c.g, c.b), linewidth=40 * marker.scale.x)
        elif marker.type == marker.SPHERE:
            centre = (marker.pose.position.x, marker.pose.position.y)
            axes.add_patch(pyplot.Circle(centre, marker.scale.x / 2, color=colour))
        elif marker.type == marker.TEXT_VIEW_FACING:
            axes.text(marker.pose.position.x, marker.pose.position.y, marker.text, color=colour)
    axes.set_aspect("equal")
    figure.savefig(path, dpi=80)
    pyplot.close(figure)


GOOD = AgentStatus(robot="r1", leader="r2", term=4, neighbours=("r2",), keyframes=7, map_frame="map/r2")


@pytest.mark.parametrize(
    ("changes", "warnings", "connected", "level", "said"),
    [
        ({}, (), True, OK, "follows r2, term 4, in map/r2"),
        ({"leader": "r1"}, (), True, OK, "leads, term 4, in map/r2"),
        ({"neighbours": ()}, (), True, OK, "follows r2, term 4, in map/r2, hears no other robot"),
        ({}, ("the scale collapsed",), True, WARN, "the solver warns: the scale collapsed"),
        ({"sizes": {"inbox": (95, 100)}}, (), True, WARN, "nearly full: inbox"),
        ({"map_frame": None}, (), True, WARN, "is in no map yet: no correction has come"),
        ({"keyframes": 0}, (), True, WARN, "has taken no keyframe yet; 'refused' says what was left out"),
        ({"leader": None}, (), True, WARN, "follows no leader"),
        ({}, (), False, ERROR, "nothing of the robot's ROS is reached"),
        ({"disk_failure": "no space left"}, ("x",), False, ERROR, "the disk fails: no space left"),
    ],
)
def test_the_worst_thing_is_said(
    changes: dict[str, Any], warnings: tuple[str, ...], connected: bool, level: int, said: str
) -> None:
    status = GOOD.model_copy(update=changes)
    assert judged(status, warnings, connected) == (level, said)
    array = diagnostics(TYPES, status, warnings, {"image": 5}, connected, 5_000_000_001)
    (one,) = TYPES.read(TYPES.written(array), "diagnostic_msgs/msg/DiagnosticArray").status
    assert (one.level, one.message, one.name, one.hardware_id) == (level, said, "flocc: r1", "r1")
    values = {value.key: value.value for value in one.values}
    assert values["heard: image"] == "5"
    assert values["leader"] == (status.leader or "")
    assert array.header.stamp.nanosec == 1
