"""Facts as lines of `events.jsonl`, and back."""

import json

import numpy as np
import pytest

from flocc_agent.core.effects import Report
from flocc_agent.core.reports import KINDS, ClosureAccepted, CorrectionApplied, KeyframeTaken, NeighbourUp, fact
from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.event_lines import BadLine, Reported, UnknownFact, line_of, of_kind, reported_of
from flocc_agent.runtime.reporting import Reporter
from flocc_protocol.ids import KeyframeId, LogId

OLD_LINES = """\
{"t": 0.068909, "robot": "r2", "event": "keyframe", "keyframe": "r2/0", "stamp_s": 0.0, "T_odom_body": [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]}
{"t": 1.0, "robot": "r1", "event": "encoding_failed", "keyframe": "r1~1f/3", "reason": "no image"}
{"t": 0.579473, "robot": "r1", "event": "candidate", "query": "r1/1", "match": "r2/2", "similarity": 0.1169}
{"t": 2.547304, "robot": "r2", "event": "closure_accepted", "query": "r2/0", "match": "r3/10", "correspondences": 270, "odometry_correspondences": 428, "ratio": 0.6308, "by": "r2", "scale_initial": 1.29, "probability": 0.185911}
{"t": 0.719368, "robot": "r2", "event": "closure_rejected", "query": "r2/2", "match": "r1/1", "correspondences": 8, "odometry_correspondences": 264, "ratio": 0.0303, "by": "r2", "reason": "few correspondences"}
{"t": 0.579473, "robot": "r1", "event": "latent_fetched", "keyframe": "r1/1", "holder": "r1"}
{"t": 0.6, "robot": "r1", "event": "latent_failed", "keyframe": "r1/1", "holder": "r1", "reason": "timeout"}
{"t": 0.6, "robot": "r1", "event": "latent_lost", "keyframe": "r1/1"}
{"t": 1.5, "robot": "r1", "event": "leader", "term": 1, "leader": "r1", "leader_log": "r1"}
{"t": 1.6, "robot": "r2", "event": "leader_lost", "term": "1:r1", "reason": "silent"}
{"t": 0.0, "robot": "r1", "event": "neighbour_up", "peer": "r2", "log": "r2~2a"}
{"t": 9.0, "robot": "r1", "event": "neighbour_down", "peer": "r2"}
{"t": 9.5, "robot": "r1", "event": "neighbour_restarted", "peer": "r2", "log": "r2"}
{"t": 9.5, "robot": "r1", "event": "peer_refused", "peer": "r4", "reason": "too many neighbours"}
{"t": 9.5, "robot": "r1", "event": "duplicate_name", "peer": "r2", "log": "r2", "reason": "two robots run with this name"}
{"t": 9.5, "robot": "r1", "event": "log_forked", "peer": "r2", "log": "r1", "reason": "others hold more of this robot's own log"}
{"t": 1.659717, "robot": "r1", "event": "optimised", "term": 1, "leader": "r1", "round": 1, "components": [["r1", "r2~2a"], ["r3"]], "keyframes": 21, "closures_used": 3, "closures_rejected": 1, "closures_excluded": 0, "cost": 0.5, "solve_s": 0.0, "warnings": ["one scale is not observable"]}
{"t": 1.7, "robot": "r1", "event": "optimisation_failed", "term": "1:r1", "round": 2, "reason": "singular"}
{"t": 1.8, "robot": "r1", "event": "round_timeout", "term": "1:r1", "round": 2}
{"t": 1.9, "robot": "r1", "event": "stale_solution", "term": "1:r1", "round": 2}
{"t": 2.0, "robot": "r1", "event": "part", "step": 3, "anchor": "r1", "neighbours": 2, "shared_poses": 5, "cost": null, "moved": null, "gap": null, "closures_used": 0, "keyframes": 9}
{"t": 1.659717, "robot": "r1", "event": "correction", "term": 1, "leader": "r1", "round": 1, "map_frame": "map/r1", "frame_changed": false, "T_map_odom": [1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]}
{"t": 1.0, "robot": "r1", "event": "bytes", "sent": {"heartbeat": 82}, "received": {"records": 64}, "loss": {"r2": 0.1}, "queues": {"inbox": 2}}
{"t": 33.1, "robot": "r1", "event": "account", "since_s": 0.0, "sent_to": {"r2": {"answer": 16}}, "received_from": {}, "lost_from": {}, "repeated_from": {}, "stages": {"encode": {"counts": [0, 4], "total_s": 0.4, "max_s": 0.2}}}
{"t": 9.0, "robot": "r3", "event": "agent_died", "signal": 9, "exit_code": null}
{"t": 33.1, "robot": "r1", "event": "agent_stopped"}
{"t": 3.0, "robot": "r1", "event": "ros2_router", "router": "tcp/127.0.0.1:7447", "connected": true}
{"t": 3.1, "robot": "r1", "event": "ros2_problem", "sentence": "/image: no camera info"}
""".splitlines()  # noqa: E501
"""A line of every kind, as commit 04961b5 wrote them."""


@pytest.mark.parametrize("line", OLD_LINES)
def test_a_line_of_an_old_run_is_read_and_all_it_said_is_written(line: str) -> None:
    old, written = json.loads(line), line_of(reported_of(line))
    assert {key: written[key] for key in old} == old


def test_every_kind_of_old_runs_is_known() -> None:
    assert {json.loads(line)["event"] for line in OLD_LINES} <= KINDS.keys()


def test_a_new_report_takes_its_definition_and_the_place_where_it_is_reported() -> None:
    @fact("door_passed")
    class DoorPassed:
        """A robot went through a door."""

        keyframe: KeyframeId
        seen_by: tuple[LogId, ...] = ()

    told = DoorPassed(keyframe=KeyframeId(LogId("r1"), 3), seen_by=(LogId("r2"), LogId("r3", 42)))
    reported = Reporter("r1", np.eye(4), steepness=4.0).reported(Report(told).fact, 2.5)
    text = json.dumps(line_of(reported))
    assert json.loads(text) == {
        "t": 2.5, "robot": "r1", "event": "door_passed", "keyframe": "r1/3", "seen_by": ["r2", "r3~2a"],
    }  # fmt: skip
    read = reported_of(text)
    assert read == Reported(2.5, "r1", told)
    assert of_kind([read], DoorPassed)[0].fact.keyframe.index == 3


def test_two_kinds_cannot_have_one_name() -> None:
    with pytest.raises(ValueError, match="NeighbourUp is told as 'neighbour_up' already"):

        @fact("neighbour_up")
        class Other:
            """Something else."""


def test_a_kind_that_nobody_knows_is_kept_with_all_that_it_says() -> None:
    line = '{"t": 2.5, "robot": "r1", "event": "teleported", "where": "mars", "path": [1, 2]}'
    read = reported_of(line)
    assert read.fact == UnknownFact("teleported", {"where": "mars", "path": [1, 2]})
    assert line_of(read) == json.loads(line)


def test_a_key_of_a_newer_version_is_ignored() -> None:
    read = reported_of('{"t": 1, "robot": "r1", "event": "neighbour_up", "peer": "r2", "colour": "red"}')
    assert read.fact == NeighbourUp(peer="r2")


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ('{"t": 1, "robot": "r1", "event": "leader", "ter', "cut off or not JSON"),
        ("[1, 2]", "top level"),
        ("[" * 100_000, "nested too deeply"),
        ('{"t": ' + "9" * 5000 + "}", "not JSON"),
        ('{"robot": "r1", "event": "agent_stopped"}', "t: Field required"),
        ('{"t": NaN, "robot": "r1", "event": "agent_stopped"}', "t: Input should be a finite number"),
        ('{"t": 1, "robot": "r1", "event": "latent_lost", "keyframe": "r1/x"}', "keyframe: "),
        ('{"t": 1, "robot": "r1", "event": "latent_lost", "keyframe": 7}', "keyframe: Value error, 7 is no text"),
        ('{"t": 1, "robot": "r1", "event": "leader_lost", "term": "1:R1"}', "term: "),
        (
            '{"t": 1, "robot": "r1", "event": "correction", "term": 1, "round": 1, "map_frame": "map/r1", '
            '"T_map_odom": [0, 0, 0, 1, 1, 0, 0]}',
            "T_map_odom: Value error, quaternion",
        ),
    ],
)
def test_a_line_that_cannot_be_read_says_why(line: str, sentence: str) -> None:
    with pytest.raises(BadLine, match=sentence):
        reported_of(line)


def test_the_driver_adds_what_the_core_cannot_know() -> None:
    T_body_camera = pose_from_tq(np.array([0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    reporter = Reporter("r1", T_body_camera, steepness=4.0)
    taken = KeyframeTaken(keyframe=KeyframeId(LogId("r1"), 0), stamp_s=0.0, T_odom_body=(2.0, 0, 0, 1.0, 0, 0, 0))
    completed = reporter.reported(taken, 1.0).fact
    assert isinstance(completed, KeyframeTaken)
    assert completed.T_odom_body == (1.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    pair = KeyframeId(LogId("r1"), 0), KeyframeId(LogId("r2"), 0)
    accepted = ClosureAccepted(query=pair[0], match=pair[1], correspondences=9, odometry_correspondences=9, ratio=1.0)
    probable = reporter.reported(accepted, 1.0).fact
    assert isinstance(probable, ClosureAccepted)
    assert probable.probability == 0.5


def test_the_driver_turns_the_poses_of_a_correction_into_the_bodys_and_rounds_them() -> None:
    T_body_camera = pose_from_tq(np.array([0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    told = CorrectionApplied(
        term=1, round=2, map_frame="map/r1", T_map_odom=(0.0, 0, 0, 1.0, 0, 0, 0),
        knots=(1, 4), T_map_body=((2.0, 0, 0, 1.0, 0, 0, 0), (3.00004, 1, 0, 0.0, 0, 0, 1.0)),
    )  # fmt: skip
    completed = Reporter("r1", T_body_camera, steepness=4.0).reported(told, 1.0)
    assert isinstance(completed.fact, CorrectionApplied)
    assert completed.fact.T_map_body == ((1.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), (3.5, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    assert reported_of(json.dumps(line_of(completed))) == completed
