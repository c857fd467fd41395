"""The systemd unit: understood by systemd, hardened, and what it starts ends in order on SIGTERM."""

import configparser
import json
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
UNIT = ROOT / "deploy" / "flocc-agent.service"
EXPOSURE_MAX = 2.5


class Unit(configparser.RawConfigParser):
    """A unit's sections; of a key that is repeated the last one is kept."""

    def __init__(self) -> None:
        super().__init__(strict=False, interpolation=None)

    def optionxform(self, optionstr: str) -> str:
        """Keys keep their case."""
        return optionstr


def service() -> dict[str, str]:
    unit = Unit()
    unit.read(UNIT)
    return dict(unit["Service"])


def test_it_is_restarted_but_not_for_a_bad_configuration() -> None:
    found = service()
    assert found["Restart"] == "on-failure"
    assert found["RestartPreventExitStatus"] == "2"
    assert found["KillSignal"] == "SIGTERM"
    assert float(found["TimeoutStopSec"]) >= 20
    assert found["User"] == "flocc"


@pytest.fixture
def local_unit(tmp_path: Path) -> Path:
    """The unit with this environment's program and a user that exists here."""
    flocc = Path(sys.executable).parent / "flocc"
    text = UNIT.read_text().replace("/opt/flocc/bin/flocc", str(flocc))
    path = tmp_path / UNIT.name
    path.write_text(text.replace("User=flocc", "User=daemon").replace("Group=flocc", "Group=daemon"))
    return path


def analyze(*arguments: str) -> str:
    """What systemd-analyze says; skips where there is none."""
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd-analyze is not installed")
    ran = subprocess.run([program, *arguments], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout + ran.stderr


def test_systemd_understands_it(local_unit: Path) -> None:
    assert analyze("verify", str(local_unit)).strip() == ""


def test_systemd_finds_it_little_exposed(local_unit: Path) -> None:
    if "--offline" not in analyze("--help"):
        pytest.skip("this systemd cannot judge a unit that is not installed")
    told = analyze("security", "--offline=true", "--no-pager", str(local_unit))
    exposure = float(told.split("Overall exposure level")[1].split(":")[1].split()[0])
    assert exposure <= EXPOSURE_MAX, told


@pytest.mark.swarm
@pytest.mark.beside
@pytest.mark.slow
def test_what_it_starts_hands_over_and_ends_on_sigterm(tmp_path: Path) -> None:
    config = tmp_path / "agent.toml"
    config.write_text(
        'name = "r1"\n[transport]\nmulticast = false\ngossip = false\n'
        'control_listen = ["tcp/127.0.0.1:0"]\nbulk_listen = ["tcp/127.0.0.1:0"]\n'
    )
    program, *words = shlex.split(service()["ExecStart"])
    assert program == "/opt/flocc/bin/flocc"
    places = {"/etc/flocc/agent.toml": str(config), "folder=/var/lib/flocc": f"folder={tmp_path / 'state'}"}
    command = [sys.executable, "-m", "flocc_launch.commands.main", *(places.get(word, word) for word in words)]
    agent = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    events = tmp_path / "state" / "events.jsonl"
    ends_s = time.monotonic() + 30.0
    while time.monotonic() < ends_s and not (events.exists() and '"leader"' in events.read_text()):
        time.sleep(0.1)
    agent.send_signal(getattr(signal, service()["KillSignal"]))
    _, said = agent.communicate(timeout=float(service()["TimeoutStopSec"]))
    assert agent.returncode == 0, said
    assert "Traceback" not in said
    lines = [json.loads(line) for line in events.read_text().splitlines()]
    assert lines[-1]["event"] == "agent_stopped"
    assert "handover" in next(line for line in reversed(lines) if line["event"] == "bytes")["sent"]
    assert (tmp_path / "state" / "result.json").is_file()
