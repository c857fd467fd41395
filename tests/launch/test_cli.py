"""The command line: bad input gives one clear sentence and exit code 2, and nothing recorded is lost."""

import logging
import socket
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.launch import synthetic_run

from flocc_launch.commands.common import show_report
from flocc_launch.commands.main import main
from flocc_launch.datasets.drift import DriftSpec
from flocc_launch.report import finish
from flocc_launch.scenarios.scenario import Scenario, TracksScenario
from flocc_launch.scenarios.walks import walks


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run `flocc` in this process and give its exit code."""
    monkeypatch.setattr(sys, "argv", ["flocc", *arguments])
    with pytest.raises(SystemExit) as left:
        main()
    code = left.value.code
    return code if isinstance(code, int) else 0


def sentence(capsys: pytest.CaptureFixture[str]) -> str:
    """What stands on standard error, which must be one line."""
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def scenario(folder: Path, text: str) -> str:
    path = folder / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_what_a_recording_has_to_say_is_said_once_in_a_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A command reads a recording for its robots, for the truth and for the report."""

    def read_thrice() -> None:
        for name in ("odometry", "odometry", "images", "odometry"):
            logging.getLogger("flocc").warning("%s: says nothing from %.1f s to %.1f s", name, 1.0, 9.0)
        sys.exit(0)

    monkeypatch.setattr(logging.root, "handlers", [])
    monkeypatch.setattr("flocc_launch.commands.main.app", lambda *_, **__: read_thrice())
    assert run(monkeypatch, "simulate") == 0
    assert run(monkeypatch, "simulate") == 0, "the next command says it again"
    said = [f"{name}: says nothing from 1.0 s to 9.0 s" for name in ("odometry", "images")]
    assert capsys.readouterr().err.splitlines() == said * 2


BAD_SCENARIOS = [
    ('name = "x"\n[world]\nseeed = 1\n', "the key 'world.seeed' does not exist"),
    ('name = "x"\n[core.election]\nhopps = 1\n[world]\n', "the key 'core.election.hopps' does not exist"),
    ('name = "Not A Name"\n[world]\n', "name: "),
    ('name = "x"\n', "there is no robot"),
    ('name = "x"\n[robots.r1]\n', "robot 'r1' has no recording"),
    ('name = "x"\n[robots.r1]\nrecording="a"\n[robots.r1]\nrecording="b"\n', "Cannot declare ('robots', 'r1') twice"),
    ('name = "x"\n[world]\n[[faults]]\nat_s=1.0\nkind="kill"\nrobots=["r9"]\n', "names robot 'r9'"),
    ('name = "x\n', "is not TOML"),
]


@pytest.mark.parametrize(("text", "said"), BAD_SCENARIOS)
@pytest.mark.parametrize("command", ["launch", "simulate"])
def test_a_bad_scenario_is_named_in_one_sentence(
    text: str,
    said: str,
    command: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = scenario(tmp_path, text)
    assert run(monkeypatch, command, path, "--out", str(tmp_path / "out")) == 2
    assert said in (line := sentence(capsys))
    assert path in line


BAD_CHANGES = [
    ("loss", "'loss' is no change of the configuration"),
    ("tracks.robotts=2", "the key 'tracks.robotts' does not exist"),
    ("radio.loss_ratio=3", "radio.loss_ratio: Input should be less than or equal to 1"),
    ("core.election.hops_max=4", "the key 'core.election.hops_max' is gone: always 8"),
]


@pytest.mark.parametrize(("change", "said"), BAD_CHANGES)
@pytest.mark.parametrize("command", ["launch", "simulate"])
def test_a_change_that_cannot_be_is_named_in_one_sentence(
    change: str,
    said: str,
    command: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = scenario(tmp_path, "[tracks]\n")
    assert run(monkeypatch, command, path, "--set", change, "--out", str(tmp_path / "out")) == 2
    assert said in sentence(capsys)


@pytest.mark.parametrize("command", ["launch", "simulate"])
def test_a_change_reaches_the_scenario(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = scenario(tmp_path, "rate = 2.0\n[tracks]\n")
    seen: list[Scenario] = []

    def stop(given: Scenario, *_: object) -> None:
        seen.append(given)
        raise KeyboardInterrupt

    monkeypatch.setattr("flocc_launch.scenarios.recordings.recordings", stop)
    changes = ["--set", "tracks.robots=2", "--set", "core.place_recognition.best_matches=3", "--set", "rate=4"]
    assert run(monkeypatch, command, path, "--out", str(tmp_path / "out"), *changes) == 130
    (read,) = seen
    assert read.tracks is not None
    assert (read.tracks.robots, read.core.place_recognition.best_matches, read.rate) == (2, 3, 4.0)


def test_a_campaign_takes_no_changes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "simulate", "--seeds", "1", "--set", "rate=2") == 2
    assert "--set" in sentence(capsys)
    for words in (("meeting",), ("--agents", "2"), ("--loss", "0"), ("--range", "5"), ("--map", "m"), ("--map-fixed",)):
        assert run(monkeypatch, "simulate", "--seeds", "1", *words) == 2
        named = words[0] if words[0].startswith("--") else "SCENARIO"
        assert f"{named} is for one of your own, without --seeds" in sentence(capsys)


def test_a_missing_scenario_names_the_shipped_ones(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "launch", "nowhere") == 2
    assert "demo" in sentence(capsys)


@pytest.mark.parametrize("command", [["evaluate"], ["doctor"]])
def test_a_missing_run_folder_is_named(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, *command, str(tmp_path / "nowhere")) == 2
    assert "nowhere" in sentence(capsys)


def test_a_folder_that_is_no_run_is_never_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    precious = tmp_path / "out" / "thesis.txt"
    precious.parent.mkdir()
    precious.write_text("three years of work", encoding="utf-8")
    assert run(monkeypatch, "simulate", "meeting", "--out", str(precious.parent)) == 2
    assert str(precious.parent) in sentence(capsys)
    assert precious.read_text(encoding="utf-8") == "three years of work"


def test_a_port_in_use_stops_an_agent_with_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        config = tmp_path / "agent.toml"
        config.write_text(f'name = "r1"\n[transport]\ncontrol_listen = ["tcp/127.0.0.1:{port}"]\n', encoding="utf-8")
        assert run(monkeypatch, "agent", "--config", str(config)) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("error: ")
    assert str(port) in said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('name = "r1"\nspeed = 3\n', "the key 'speed' does not exist"),
        ('swarm = "s"\n', "the key 'name' is missing"),
        ('name = "r1"\n[source]\nrecording = "nowhere"\n', "nowhere"),
        ('name = "r1"\n[transport]\ncontrol_listen = ["here"]\n', "is no endpoint"),
    ],
)
def test_a_bad_agent_configuration_is_named(
    text: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "agent.toml"
    config.write_text(text, encoding="utf-8")
    assert run(monkeypatch, "agent", "--config", str(config)) == 2
    assert said in capsys.readouterr().err.strip().splitlines()[-1]


def test_help_names_every_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "--help") == 0
    text = capsys.readouterr().out
    assert [c for c in ("demo", "launch", "simulate", "agent", "evaluate", "doctor", "dataset") if c not in text] == []


def test_the_drift_of_walks_is_seeded() -> None:
    first, again = (walks(TracksScenario(robots=2, seed=5), DriftSpec()) for _ in range(2))
    other = walks(TracksScenario(robots=2, seed=6), DriftSpec())
    assert np.array_equal(first[1].odometry.T_fixed_body, again[1].odometry.T_fixed_body)
    assert not np.array_equal(first[1].odometry.T_fixed_body, other[1].odometry.T_fixed_body)


def test_a_run_that_no_robot_survived_ends_with_exit_code_1(tmp_path: Path) -> None:
    report = finish(synthetic_run.write(tmp_path / "run")).model_copy(update={"expectations": []})
    show_report(report, tmp_path)
    dead = [robot.model_copy(update={"end": "died"}) for robot in report.robot_details]
    with pytest.raises(SystemExit) as left:
        show_report(report.model_copy(update={"robot_details": dead}), tmp_path)
    assert left.value.code == 1
