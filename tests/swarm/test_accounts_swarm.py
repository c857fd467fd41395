"""What a launched swarm costs: both ends of every link agree, stages are timed, and Prometheus can read it."""

import socket
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.swarm.launching import Watch, launch

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]

NAMES = ("r1", "r2", "r3")
LATENT_BYTES = 400_000


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


def meeting() -> Scenario:
    """Three robots whose walks overlap, with latents of two pieces each."""
    return Scenario.model_validate(
        {
            "name": "accounts",
            "rate": 4.0,
            "settle_s": 3.0,
            "tracks": {"robots": 3, "seed": 3, "area_m": 12.0, "length_m": 40.0},
            "perception": {"method": "synthetic", "synthetic": {"latent_bytes": LATENT_BYTES}},
        }
    )


def free_ports_in_a_row(count: int) -> int:
    """The first of so many ports that nobody uses."""
    for first in range(20_000, 60_000, count):
        try:
            for port in range(first, first + count):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        return first
    raise AssertionError("no ports are free")


def test_three_agents_account_for_the_same_bytes_and_tell_prometheus(tmp_path: Path) -> None:
    port = free_ports_in_a_row(len(NAMES))
    pages: dict[str, str] = {}

    def scrape(seen: Watch) -> None:
        for k, agent in enumerate(seen.agents):
            if agent.running and agent.said.closures:
                pages[agent.name] = read(f"http://127.0.0.1:{port + k}/metrics") or pages.get(agent.name, "")

    report = launch(meeting(), tmp_path / "run", scrape, metrics=str(port))

    assert {(link.sender, link.receiver) for link in report.links} == {(a, b) for a in NAMES for b in NAMES if a != b}
    for link in report.links:
        assert link.sent is not None
        assert link.unaccounted is not None
        assert link.sent > 10_000
        assert abs(link.unaccounted) <= 0.01 * link.sent, link
        assert link.lost == link.repeated == 0
    latents = sum(link.by_kind["latent"].received or 0 for link in report.links if "latent" in link.by_kind)
    assert latents == pytest.approx(LATENT_BYTES * report.stages["fetch"].count, rel=0.01)

    keyframes = sum(robot.keyframes for robot in report.robot_details)
    assert report.stages["describe"].count == report.stages["encode"].count == keyframes
    assert {"register", "register_wait", "optimise", "optimise_wait", "inbox_wait"} <= set(report.stages)

    assert set(pages) == set(NAMES)
    for name, page in pages.items():
        samples = [s for family in text_string_to_metric_families(page) for s in family.samples]
        sent_to = {s.labels["peer"] for s in samples if s.name == "flocc_sent_bytes_total"}
        assert sent_to == set(NAMES) - {name}
        assert any(s.name == "flocc_stage_seconds_count" and s.labels["stage"] == "encode" for s in samples)


def read(url: str) -> str | None:
    try:
        with urllib.request.urlopen(url, timeout=2.0) as answer:
            return str(answer.read().decode())
    except (urllib.error.URLError, TimeoutError, ConnectionError):
        return None


def test_a_port_in_use_is_one_sentence_and_exit_code_2(tmp_path: Path) -> None:
    config = tmp_path / "r1.toml"
    config.write_text('name = "r1"\n[transport]\nmulticast = false\n')
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        command = [
            sys.executable,
            "-m",
            "flocc_launch.commands.main",
            "agent",
            "--config",
            str(config),
            "--metrics",
            str(port),
        ]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert ran.returncode == 2
    assert f"error: robot r1: port {port} for metrics is in use; choose another one" in ran.stderr
    assert "Traceback" not in ran.stderr
