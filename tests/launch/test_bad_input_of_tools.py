"""What cannot be shown, asked, run or measured is said in one sentence, with exit code 2, before anything is done."""

import json
import socket
from pathlib import Path

import pytest
from tests.launch import synthetic_run
from tests.launch.test_cli import run, scenario, sentence

from flocc_launch.doctor.network_check import free_port
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.shipped import read_shipped
from flocc_launch.view import live_view as view_live

LOOKS = [["doctor"], ["evaluate"], ["view", "--save", "out.rrd"]]
TRACKS = 'name = "x"\n[perception]\nmethod = "synthetic"\n[tracks]\nrobots = 2\n'
TWO_ROBOTS = 'name = "x"\n[robots.r1]\nrecording = "r1"\n[robots.r2]\nrecording = "r2"\n'

BAD_SCENARIOS = [
    (TRACKS + "[tracks.routes_m]\nr7 = [[0, 0], [1, 0]]\n", "names robot 'r7', which is not one of r1 to r2"),
    (TRACKS + "[tracks.routes_m]\nr1 = [[0, 0]]\n", "at least two corners"),
    (TRACKS + "[tracks.routes_m]\nr1 = [[0, 0], [0, 0]]\n", "away from the one before"),
    (TRACKS + '[[rendezvous]]\nrobots = ["r1", "r9"]\nfrom_s = 1.0\nto_s = 2.0\n', "a rendezvous names robot 'r9'"),
    (TRACKS + '[[rendezvous]]\nrobots = ["r1"]\nfrom_s = 1.0\nto_s = 2.0\n', "rendezvous.0.robots: "),
    (TRACKS + '[[rendezvous]]\nrobots = ["r1", "r2"]\nfrom_s = 3.0\nto_s = 2.0\n', "from 3 s ends at 2 s"),
    (
        TRACKS
        + '[[rendezvous]]\nrobots = ["r1", "r2"]\nfrom_s = 1.0\nto_s = 2.0\n[[faults]]\nat_s = 1.0\nkind = "heal"\n',
        "rendezvous and partitions exclude each other",
    ),
    (TRACKS + '[expectations]\nleader = "r9"\n', "expectations.leader names robot 'r9'"),
    (TRACKS + "[expectations]\nhappiness_min = 1\n", "the key 'expectations.happiness_min' does not exist"),
]


DEEP = 50_000
EDGE = "EDGE_SE3:QUAT -1 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n"
HOSTILE_FILES = [
    ("x.toml", ["launch"], f"a = {'[' * DEEP}{']' * DEEP}\n", "is nested too deeply"),
    ("x.toml", ["launch"], ".".join(["a"] * DEEP) + " = 1\n", "has a key of more than 64 parts"),
    ("x.jrl", ["optimise", "--out", "o"], '{"a":' + "[" * DEEP + "]" * DEEP + "}", "is nested too deeply"),
    ("x.g2o", ["optimise", "--out", "o"], EDGE, "line 1: -1 is no key of a vertex"),
    ("x.jpg", ["launch"], "\xff\xd8\xff\xe0", "x.jpg: is no text, so no TOML file (byte 1)"),
]


@pytest.mark.parametrize(
    ("name", "command", "text", "said"), HOSTILE_FILES, ids=["deep", "long", "json", "negative", "picture"]
)
def test_a_file_that_its_reader_cannot_take_is_refused(
    name: str,
    command: list[str],
    text: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_text(text, encoding="latin-1")
    assert run(monkeypatch, command[0], name, *command[1:]) == 2
    assert said in sentence(capsys)


@pytest.mark.parametrize(("text", "said"), BAD_SCENARIOS)
def test_a_scenario_that_contradicts_itself_is_named(
    text: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = scenario(tmp_path, text)
    assert run(monkeypatch, "simulate", path, "--out", str(tmp_path / "out")) == 2
    assert said in (line := sentence(capsys))
    assert path in line


@pytest.mark.parametrize("driver", ["simulate", "launch"])
@pytest.mark.parametrize("name", ["ate_max_m", "ate_ratio_max"])
def test_an_error_without_ground_truth_cannot_be_expected(
    driver: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for robot, path in recordings(read_shipped("corridor")).items():
        (tmp_path / robot).mkdir()
        for file in ("odometry.tum", "camera.toml", "images.txt", "images"):
            if (path / file).exists():
                (tmp_path / robot / file).symlink_to(path / file)
    text = f"{TWO_ROBOTS}[expectations]\n{name} = 1.0\n"
    assert run(monkeypatch, driver, scenario(tmp_path, text), "--out", str(tmp_path / "out")) == 2
    assert f"expectations.{name} cannot be measured: {tmp_path / 'r1'} has no groundtruth.tum" in sentence(capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("driver", ["simulate", "launch"])
@pytest.mark.parametrize("name", ["merged_within_s", "closures_min", "leader_registered_ratio_min"])
def test_one_robot_cannot_be_expected_to_merge(
    driver: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        f"{TRACKS.replace('robots = 2', 'robots = 1')}[robots.server]\ncompute_class = 9\n[expectations]\n{name} = 1\n"
    )
    assert run(monkeypatch, driver, scenario(tmp_path, text), "--out", str(tmp_path / "out")) == 2
    assert f"expectations.{name} cannot be measured: it takes two robots with a camera" in sentence(capsys)


def test_a_fault_of_virtual_time_cannot_be_launched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = scenario(tmp_path, f'{TRACKS}[[faults]]\nat_s = 1.0\nkind = "mute"\nmessage = "records"\nvalue = 1.0\n')
    assert run(monkeypatch, "launch", path, "--out", str(tmp_path / "out")) == 2
    assert "a fault 'mute' exists on virtual time only" in sentence(capsys)


@pytest.mark.parametrize("command", LOOKS, ids=lambda command: command[0])
@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("run.json", None, "is of version 99"),
        ("run.json", '{"scenario": "synth', "run.json"),
        ("events.jsonl", '{"t": 1.0, "robot": "r1", "event": "leader", "ter', "events.jsonl:1: is cut off"),
        ("events.jsonl", "", None),
        ("robots/r2/result.json", '{"robot": "r2", "keyfra', "result.json"),
    ],
)
def test_a_run_folder_of_another_version_or_cut_off_is_named(
    command: list[str],
    file: str,
    content: str | None,
    said: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if command[0] == "view":
        pytest.importorskip("rerun")
    path = synthetic_run.write(tmp_path / "run").path
    if content is None:
        content = json.dumps(json.loads((path / "run.json").read_text()) | {"version": 99})
    (path / file).write_text(content)
    monkeypatch.chdir(tmp_path)
    code = run(monkeypatch, command[0], str(path), *command[1:])
    if said is None:
        assert code in (0, 1), "no events is a run in which nothing happened"
        return
    assert code == 2
    assert said in sentence(capsys)


@pytest.mark.parametrize("name", ["report.json.partial", "pose_graph.g2o", "trajectories/r1.tum", "odometry"])
def test_a_run_is_not_evaluated_through_links(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = synthetic_run.write(tmp_path / "run").path
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir() if name == "odometry" else elsewhere.write_text("mine")
    link = path / name
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(elsewhere)
    assert run(monkeypatch, "evaluate", str(path)) == 2
    assert f"{link}: is a link" in sentence(capsys)
    assert list(elsewhere.iterdir()) == [] if name == "odometry" else elsewhere.read_text() == "mine"


@pytest.mark.parametrize("file", ["run.json", "robots/r2/result.json"])
def test_a_robots_name_is_no_path(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = synthetic_run.write(tmp_path / "run").path
    (path / file).write_text((path / file).read_text().replace('"r2"', '"../../r2"'))
    assert run(monkeypatch, "evaluate", str(path)) == 2
    assert file in sentence(capsys)


def test_a_run_folder_without_events_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = synthetic_run.write(tmp_path / "run").path
    (path / "events.jsonl").unlink()
    assert run(monkeypatch, "doctor", str(path)) == 2
    assert "events.jsonl" in sentence(capsys)


def test_a_view_without_a_display_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun")
    for key in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(key, raising=False)
    assert run(monkeypatch, "view", str(synthetic_run.write(tmp_path / "run").path)) == 2
    assert "there is no display" in sentence(capsys)


def test_a_view_that_cannot_be_written_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun")
    out = tmp_path / "nowhere" / "run.rrd"
    assert run(monkeypatch, "view", str(synthetic_run.write(tmp_path / "run").path), "--save", str(out)) == 2
    assert str(out) in sentence(capsys)


def test_a_page_on_a_port_in_use_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(synthetic_run.write(tmp_path / "run").path)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert run(monkeypatch, "dashboard", path, "--port", str(port)) == 2
    assert f"port {port} on 127.0.0.1" in sentence(capsys)


@pytest.mark.swarm
@pytest.mark.beside
@pytest.mark.parametrize(("command", "said"), [("doctor", "nobody is there: in 1.5 s no agent"), ("view", "no ")])
def test_a_swarm_that_nobody_answers_for_is_one_sentence(
    command: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if command == "view":
        pytest.importorskip("rerun")
    monkeypatch.setattr(view_live, "SILENT_S_MAX", 0.5)
    peer = f'control = ["tcp/127.0.0.1:{free_port()}"]'
    config = tmp_path / "agent.toml"
    config.write_text(
        'name = "me"\nswarm = "nobody"\n[transport]\nmulticast = false\ncontrol_listen = ["tcp/127.0.0.1:0"]\n'
        f"[transport.roster.r1]\n{peer}\n"
    )
    more = ["--save", str(tmp_path / "run.rrd")] if command == "view" else ["--timeout", "0.5"]
    assert run(monkeypatch, command, "--config", str(config), *more) == 2
    assert sentence(capsys).startswith(f"error: swarm nobody: {said}")
