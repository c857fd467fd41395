"""`flocc agent --dashboard`: one agent serves its own view of the swarm, of all robots that it knows of."""

import json
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from tests.launch.test_cli import run
from tests.launch.test_dashboard import browse, rows

from flocc_agent.config import AgentConfig, PerceptionConfig, SourceConfig
from flocc_launch.doctor.network_check import free_port
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.shipped import read_shipped
from flocc_launch.swarm.processes import loopback_transports

START_S = 60.0


def state_of(url: str) -> dict[str, Any]:
    try:
        with urllib.request.urlopen(url + "state.json", timeout=5.0) as answer:
            state: dict[str, Any] = json.load(answer)
            return state
    except OSError:
        return {"robots": []}


def is_merged(state: dict[str, Any]) -> bool:
    frames = {robot["map_frame"] for robot in state["robots"]}
    return len(state["robots"]) == 2 and len(frames) == 1 and None not in frames and len(state["closures"]) > 3


@pytest.mark.swarm
@pytest.mark.beside
@pytest.mark.slow
def test_one_agent_shows_every_robot_of_its_swarm(tmp_path: Path) -> None:
    scenario = read_shipped("heterogeneous")
    paths, transports = recordings(scenario), loopback_transports(["r1", "r2"])
    url = f"http://127.0.0.1:{free_port()}/"
    agents = []
    for name in ("r1", "r2"):
        source = SourceConfig(recording=paths[name].resolve(), rate=4.0)
        config = AgentConfig(
            name=name,
            incarnation=0,
            source=source,
            transport=transports[name],
            perception=PerceptionConfig(method="synthetic"),
        )
        path = tmp_path / f"{name}.json"
        path.write_text(config.model_dump_json(), encoding="utf-8")
        page = ["--dashboard", url.removeprefix("http://").strip("/")] if name == "r2" else []
        command = [sys.executable, "-m", "flocc_launch.commands.main", "agent", "--config", str(path), *page]
        agents.append(subprocess.Popen(command, stderr=subprocess.DEVNULL))
    try:
        deadline_s = time.monotonic() + START_S
        while not is_merged(state := state_of(url)):
            assert time.monotonic() < deadline_s, state
            time.sleep(0.2)
        shown = rows(browse(url, tmp_path / "profile"))
        state = state_of(url)
    finally:
        for agent in agents:
            agent.send_signal(signal.SIGTERM)
        codes = [agent.wait(timeout=20.0) for agent in agents]
    assert codes == [0, 0]
    assert sorted(shown) == ["r1", "r2"]
    assert {row["leader"] for row in shown.values()} == {"r1"}
    assert {row["frame"] for row in shown.values()} == {"map/r1"}
    assert state["seen_by"] == "r2"
    by_name = {robot["robot"]: robot for robot in state["robots"]}
    assert all(len(by_name[name]["path_m"]) > 10 for name in ("r1", "r2"))
    assert by_name["r2"]["links"]["r1"]["hears"]
    assert by_name["r2"]["links"]["r1"]["loss_ratio"] is not None


@pytest.mark.parametrize("where", ["here", "127.0.0.1:99999", "127.0.0.1:"])
def test_an_address_that_is_none_is_one_sentence(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "agent", "--config", agent_file(tmp_path), "--dashboard", where) == 2
    assert (
        capsys.readouterr().err.strip().splitlines()[-1].startswith(f"error: dashboard: '{where}' is not [HOST:]PORT")
    )


def test_a_port_in_use_stops_the_agent_before_it_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert run(monkeypatch, "agent", "--config", agent_file(tmp_path), "--dashboard", str(port)) == 2
        assert run(monkeypatch, "launch", "meeting", "--out", str(tmp_path / "run"), "--dashboard", str(port)) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert said == [f"error: dashboard: port {port} on 127.0.0.1: Address already in use; choose another"] * 2


def agent_file(folder: Path) -> str:
    path = folder / "agent.toml"
    path.write_text('name = "r1"\n', encoding="utf-8")
    return str(path)
