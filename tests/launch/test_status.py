"""flocc status, and the doctor of a running swarm and of an installation."""

import json
import socket
from pathlib import Path

import pytest
import typer
from tests.launch import synthetic_run
from tests.launch.synthetic_run import Synthetic
from typer.testing import CliRunner

from flocc_agent.config import ConfigError, Mast3rConfig, PerceptionConfig, TransportConfig
from flocc_agent.core.reports import CameraDoubted, ClosureAccepted
from flocc_agent.runtime.event_lines import Reported, line_of, of_kind
from flocc_launch.commands.tools import add_tools
from flocc_launch.dashboard.status_table import (
    RobotStatus,
    StatusError,
    cells_of,
    status_from,
    status_json,
    status_of_run,
    status_of_swarm,
)
from flocc_launch.doctor import Finding, Severity, finding_lines, installation, network_check
from flocc_launch.doctor.live import diagnose_live
from flocc_launch.runs.run_folder import RunFolder


def row(robot: str, neighbours: str = "", **fields: object) -> RobotStatus:
    healthy = {"leader": "r1", "term": 1, "keyframes": 5, "map_frame": "map/r1", "neighbours": neighbours.split()}
    return RobotStatus.model_validate({"robot": robot} | healthy | fields)


def apart(peer_logs: object = None, **fields: object) -> list[RobotStatus]:
    """Two robots that hear each other and are in two maps, and what the first one says on top."""
    said = {"logs": {"r1": [9, 1], "r2": [9, 1]}, "similarity_threshold": 0.5, "match_ratio_threshold": 0.3}
    peer = said | ({} if peer_logs is None else {"logs": peer_logs})
    return [row("r1", "r2", **(said | fields)), row("r2", "r1", map_frame="map/r2", **peer)]


def pair(**fields: object) -> dict[str, object]:
    return {"robots": ["r1", "r2"], "reason": "match ratio too low", **fields}


def server(name: str, neighbours: str) -> RobotStatus:
    return row(name, neighbours, keyframes=0, map_frame=None, compute_class=9)


def tools() -> typer.Typer:
    app = typer.Typer()
    add_tools(app)
    return app


def test_the_status_of_a_run_folder_is_that_of_its_robots(tmp_path: Path) -> None:
    rows = status_of_run(synthetic_run.write(tmp_path / "run", Synthetic(died=("r1", 50.0))).path)
    assert [(r.robot, r.state, r.map_frame) for r in rows] == [
        ("r1", "died", "map/r1"),
        ("r2", "stopped", "map/r1"),
        ("r3", "stopped", "map/r1"),
    ]
    assert rows[1].keyframes == 60
    made = [event.robot for event in of_kind(RunFolder.open(tmp_path / "run").events(), ClosureAccepted)]
    assert [row.accepted for row in rows] == [made.count(row.robot) for row in rows]
    assert [(row.closures, row.candidates) for row in rows] == [(None, None)] * 3, "events tell what each one did"
    assert [entry["robot"] for entry in json.loads(status_json(rows))] == ["r1", "r2", "r3"]


def test_an_agents_answer_is_read_and_a_strange_one_is_shown_as_such() -> None:
    answer = {"robot": "r2", "leader": "r1", "term": 3, "neighbours": ["r1"], "sent_bytes": 12, "new": [1]}
    known = status_from("r2", json.dumps(answer).encode())
    assert (known.leader, known.term, known.neighbours, known.closures) == ("r1", 3, ("r1",), None)
    for strange in (b"\xff", b"[]", b"null", b'{"neighbours": 3}'):
        assert status_from("r2", strange) == RobotStatus(robot="r2", state="answers in another format")


@pytest.mark.swarm
@pytest.mark.beside
def test_a_swarm_that_nobody_is_in_is_one_sentence() -> None:
    config = TransportConfig(control_listen=("tcp/127.0.0.1:0",), multicast=False)
    with pytest.raises(StatusError, match=r"swarm nobody: nobody is there: in 0\.6 s no agent"):
        status_of_swarm(config, "nobody", timeout_s=0.2)


@pytest.mark.parametrize(
    ("rows", "causes"),
    [
        ([row("r1", "r2"), row("r2", "r1")], ["merged"]),
        ([row("r1"), row("r2")], ["merged", "no-peer"]),
        ([row("r1", "r2", doubles=("r1",)), row("r2", "r1", doubles=("r1",))], ["merged", "duplicate-name"]),
        ([row("r1", "r2 r3"), row("r2", "r3"), row("r3", "r1 r2")], ["merged", "one-way-link"]),
        ([row("r1", "r2"), row("r2", "r1", keyframes=0, map_frame=None)], ["no-keyframes"]),
        ([row("r1", "r2", leader=None), row("r2", "r1", map_frame="map/r2")], ["no-leader"]),
        ([row("r1", "r2"), row("r2", "r1", leader="r2", map_frame="map/r2")], ["two-leaders"]),
        ([row("r1", "r2"), row("r2", "r1", map_frame="map/r2")], ["not-merged-yet"]),
        ([row("r1", "r2"), row("r2", "r1", refused={"refused unknown version": 3})], ["merged", "refused"]),
        ([row("r1", "r2"), row("r2", "r1", map_frame="map/r2", refused={"x": 1})], ["not-merged-yet", "refused"]),
        ([row("r1")], []),
        (apart(logs={"r1": [9, 1]}, peer_logs={"r2": [9, 1]}), ["no-descriptors"]),
        (apart(best_similarities={"r2": 0.41}), ["low-similarity"]),
        (apart(pairs=[pair(rejected=3, best_ratio=0.21)]), ["registrations-rejected"]),
        (apart(pairs=[pair(accepted=3)], solver={"components": [["r1"], ["r2"]]}), ["closures-not-connecting"]),
        (apart(pairs=[pair(accepted=3)], solver={"components": [["r1", "r2"]]}), ["not-merged-yet"]),
        (apart(pairs=[pair(accepted=3)]), ["not-merged-yet"]),
        ([row("r1", "r2 s"), row("r2", "r1 s"), server("s", "r1 r2")], ["merged"]),
        ([row("r1", "s"), server("s", "r1")], ["not-merged-yet"]),
    ],
)
def test_the_doctor_of_a_running_swarm_names_the_cause(rows: list[RobotStatus], causes: list[str]) -> None:
    assert [finding.cause for finding in diagnose_live(rows)] == causes


@pytest.mark.parametrize(
    "rows", [[row("r1"), row("r2")], [row("r1", "r2"), row("r2")]], ids=["no-peer", "one-way-link"]
)
def test_an_emulated_radio_is_no_firewall(rows: list[RobotStatus]) -> None:
    """Under `--range` advice on networks would send people the wrong way first; 5 % of loss explains nothing."""
    real = diagnose_live(rows)[1]
    assert "emulated" not in real.advice
    emulated = diagnose_live([each.model_copy(update={"emulated": "a range of 12 m"}) for each in rows])[1]
    assert emulated.cause == real.cause
    assert emulated.advice.startswith("The emulated radio may be why (a range of 12 m): change [radio]")


def test_the_figures_of_a_running_swarm_stand_in_the_sentence() -> None:
    (similar,) = diagnose_live(apart(best_similarities={"r2": 0.41}))
    assert "the best similarity so far is 0.41, below the threshold of 0.5" in similar.sentence
    (rejected,) = diagnose_live(apart(pairs=[pair(rejected=3, best_ratio=0.21)]))
    assert "the best match ratio is 0.210 (match ratio too low), R_thr is 0.3" in rejected.sentence


def test_a_port_in_use_is_found_before_the_agent_finds_it() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        (finding,) = network_check.ports(TransportConfig(control_listen=(endpoint,)))
    assert (finding.cause, finding.severity) == ("port", Severity.BLOCKS)
    assert endpoint in finding.sentence


def test_a_clock_that_was_never_set_is_found() -> None:
    assert installation.clock(86_400.0)[0].sentence == "The clock says 1970, it was never set."
    assert installation.clock(1.8e9)[0].severity is Severity.GOOD


def test_a_package_that_cannot_be_imported_is_named() -> None:
    assert installation.import_problem("flocc_does_not_exist") == "No module named 'flocc_does_not_exist'"
    assert installation.import_problem("json") is None


def test_checkpoints_are_asked_for_only_where_perception_needs_them(tmp_path: Path) -> None:
    assert [finding.severity for finding in installation.networks(PerceptionConfig())] == [Severity.GOOD]
    pytest.importorskip("torch")
    torn = tmp_path / "mast3r.pth"
    torn.write_bytes(b"PK\x03\x04 cut off")
    config = PerceptionConfig(method="mast3r", mast3r=Mast3rConfig(weights=torn, device="cpu"))
    findings = installation.networks(config)
    assert [(finding.cause, finding.severity) for finding in findings] == [
        ("torch", Severity.GOOD),
        ("checkpoint", Severity.BLOCKS),
        ("checkpoint", Severity.BLOCKS),
    ]
    assert "cpu" in findings[0].sentence
    assert str(torn) in findings[1].sentence
    assert "perception.mast3r.place_weights is not set" in findings[2].sentence


@pytest.mark.swarm
@pytest.mark.beside
def test_two_zenoh_peers_find_each_other_through_a_third() -> None:
    assert network_check.by_gossip(TransportConfig())


@pytest.mark.swarm
@pytest.mark.beside
def test_two_zenoh_peers_of_this_machine_find_each_other() -> None:
    assert network_check.two_peers(TransportConfig(), by_multicast=False)


def test_findings_read_as_lines() -> None:
    findings = [Finding("a", Severity.GOOD, "All is well."), Finding("b", Severity.BLOCKS, "It broke.", "Mend it.")]
    assert finding_lines(findings) == ["ok    All is well.", "FAIL  It broke.", "      Mend it."]


def test_the_command_line_knows_the_tools(tmp_path: Path) -> None:
    path = str(synthetic_run.write(tmp_path / "run", Synthetic(merged_s=None)).path)
    blocked = CliRunner().invoke(tools(), ["doctor", path])
    assert (blocked.exit_code, "FAIL" in blocked.stdout) == (1, True)
    well = CliRunner().invoke(tools(), ["doctor", str(synthetic_run.write(tmp_path / "well").path), "--json"])
    assert (well.exit_code, json.loads(well.stdout)[0]["cause"]) == (0, "merged")
    shown = CliRunner().invoke(tools(), ["status", path, "--json"])
    assert len(json.loads(shown.stdout)) == 3
    assert "map/r3" in CliRunner().invoke(tools(), ["status", path], env={"COLUMNS": "160"}).stdout


def test_a_status_of_nothing_says_what_to_give() -> None:
    assert isinstance(CliRunner().invoke(tools(), ["status"]).exception, ConfigError)


UPSIDE_DOWN = {"doubt": "mounting", "amount": 179.9, "where": "0 degrees about x", "pairs": 5, "withheld": True}
BUMPER = {"doubt": "overlay", "amount": 0.3, "where": "bottom", "pairs": 4}


def test_what_robots_doubt_of_their_cameras_is_in_the_table() -> None:
    rows = [row("r1", "r2", camera=[BUMPER]), row("r2", "r1", camera=[UPSIDE_DOWN])]
    assert [cells_of(each)["camera"] for each in rows] == ["overlay 30 %", "mounting 180° (kept out)"]
    assert cells_of(row("r3"))["camera"] == "-"


def test_the_doctor_of_a_running_swarm_names_a_camera_that_is_kept_out_as_what_blocks() -> None:
    rows = apart(camera=[UPSIDE_DOWN], pairs=[pair(accepted=3)])
    (finding,) = diagnose_live(rows)
    assert (finding.cause, finding.severity, finding.robots) == ("camera-turned", Severity.BLOCKS, ("r1",))
    assert finding.sentence.startswith("r1's camera is turned by 179.9 degrees against its odometry")


def test_robots_that_merged_before_a_camera_was_found_turned_are_not_believed() -> None:
    findings = diagnose_live([row("r1", "r2"), row("r2", "r1", camera=[UPSIDE_DOWN])])
    assert [finding.cause for finding in findings] == ["merged-doubtfully", "camera-turned"]
    assert "Do not believe where r2 is." in findings[0].sentence


def test_what_a_robot_leaves_out_itself_is_a_note_and_a_frozen_picture_is_not() -> None:
    frozen = {"doubt": "frozen", "amount": 10}
    findings = diagnose_live([row("r1", "r2", camera=[BUMPER]), row("r2", "r1", camera=[frozen])])
    causes = [(finding.cause, finding.severity) for finding in findings]
    assert causes == [
        ("merged", Severity.GOOD),
        ("overlay", Severity.NOTE),
        ("frozen-pictures", Severity.HINDERS),
    ]


def test_the_status_of_a_run_tells_of_cameras(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run", Synthetic())
    told = Reported(1.0, "r2", CameraDoubted(doubt="mirrored", amount=1.0, where="", pairs=5, withheld=True))
    with (folder.path / "events.jsonl").open("a", encoding="utf-8") as events:
        events.write(json.dumps(line_of(told)) + "\n")
    assert [[doubt.doubt for doubt in each.camera] for each in status_of_run(folder.path)] == [[], ["mirrored"], []]
