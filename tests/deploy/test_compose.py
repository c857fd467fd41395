"""compose.yaml: valid by the specification's schema, and its containers' command starts agents that hear each other."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from tests.deploy import compose_schema

from flocc_agent.config import AgentConfig, RadioConfig
from flocc_launch.datasets.names import robot_names
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.setup.credentials import make_keys

ROOT = Path(__file__).parents[2]
COMPOSE = ROOT / "docker" / "compose.yaml"
SECURE = ROOT / "docker" / "compose.secure.yaml"
ROBOTS = ("alpha", "bravo", "charlie")


@pytest.mark.parametrize("path", [COMPOSE, SECURE], ids=lambda path: path.name)
def test_it_is_valid_by_the_specification(path: Path) -> None:
    assert compose_schema.faults(compose_schema.read(path)) == []


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ({"servces": {}}, "has no key 'servces'"),
        ({"services": {"a": {"imge": "x"}}}, "has no key 'imge'"),
        ({"services": {"a": {"image": 3}}}, "is no string"),
        ({"services": {"a": {"read_only": "yes"}}}, "is no boolean"),
        ({"services": {"a": {"cap_drop": ["ALL", "ALL"]}}}, "repeats an item"),
        ({"services": []}, "is no object"),
    ],
)
def test_the_schema_finds_what_is_wrong(broken: dict[str, Any], said: str) -> None:
    assert said in " ".join(compose_schema.faults(broken))


def service(name: str, environment: dict[str, str] | None = None) -> dict[str, Any]:
    found: dict[str, Any] = compose_schema.read(COMPOSE, environment)["services"][name]
    return found


def test_every_robot_is_hardened_and_keeps_its_data() -> None:
    for name in ROBOTS:
        found = service(name)
        assert found["hostname"] == name
        assert (found["read_only"], found["cap_drop"], found["init"]) == (True, ["ALL"], True)
        assert found["security_opt"] == ["no-new-privileges:true"]
        assert "data:/data" in found["volumes"]
        assert "recordings:/recordings:ro" in found["volumes"]
    declared = compose_schema.read(COMPOSE)["volumes"]
    assert set(declared) == {"data", "recordings"}


def test_the_robots_are_those_of_the_world_that_it_renders() -> None:
    world = service("world")["entrypoint"]
    assert world[:2] == ["python", "-c"]
    compile(world[2], "world", "exec")
    assert "WorldSpec(robots=3)" in world[2]
    assert tuple(robot_names(3)) == ROBOTS


def test_what_is_mounted_from_here_is_there() -> None:
    sources = [each.split(":")[0] for name in ROBOTS for each in service(name)["volumes"] if each.startswith(".")]
    assert sources
    assert all((COMPOSE.parent / source).is_file() for source in sources)
    build = service("alpha")["build"]
    assert (COMPOSE.parent / build["context"] / build["dockerfile"]).is_file()


def arguments(name: str, environment: dict[str, str] | None = None) -> list[str]:
    """What a container's shell makes of its command, with `flocc` replaced by a program that prints it."""
    found = service(name, environment)
    shell, option, command = found["entrypoint"]
    given = {**found["environment"], "HOSTNAME": name, "PATH": os.environ["PATH"]}
    told = command.replace("exec flocc", "printf '%s\\n'")
    ran = subprocess.run([shell, option, told], env=given, capture_output=True, text=True, check=True)
    return ran.stdout.splitlines()


def configured(name: str, environment: dict[str, str] | None = None) -> AgentConfig:
    """The configuration of a container's agent."""
    words = arguments(name, environment)
    assert words[:3] == ["agent", "--config", "/etc/flocc/agent.toml"]
    assert set(words[3::2]) == {"--set"}
    return AgentConfig.read(ROOT / "docker/agent.toml", words[4::2])


def test_each_container_has_its_own_name_and_folders() -> None:
    for name in ROBOTS:
        config = configured(name)
        assert (config.name, config.folder, config.source.recording) == (
            name,
            Path("/data") / name,
            Path("/recordings") / name,
        )
        assert config.radio.loss_ratio == RadioConfig().loss_ratio


def test_the_link_model_comes_from_the_environment() -> None:
    radio = configured("bravo", {"LOSS": "0.3", "LATENCY": "0.1", "JITTER": "0.02", "RANGE": "12"}).radio
    assert (radio.loss_ratio, radio.latency_s, radio.jitter_s, radio.range_m) == (0.3, 0.1, 0.02, 12.0)
    assert configured("bravo", {"BANDWIDTH": "20000"}).radio.bandwidth_bytes_s == 20_000.0
    assert configured("bravo", {"OPTIONS": "--set perception.method=synthetic"}).perception.method == "synthetic"


def test_the_secure_variant_gives_each_container_its_own_keys_and_nothing_else(tmp_path: Path) -> None:
    services = compose_schema.read(SECURE, {"KEYS": str(tmp_path)})["services"]
    assert set(services) == set(ROBOTS)
    make_keys(tmp_path, "compose", ROBOTS)
    for name, found in services.items():
        (volume,) = found["volumes"]
        assert volume == f"{tmp_path}/{name}:/etc/flocc/keys:ro"
        config = configured(name, {"OPTIONS": found["environment"]["OPTIONS"]})
        assert config.transport.tls is not None
        assert config.transport.tls.folder == Path("/etc/flocc/keys")
        assert config.transport.control_listen == config.transport.bulk_listen == ("tls/0.0.0.0:0",)


@pytest.mark.swarm
@pytest.mark.beside
@pytest.mark.slow
@pytest.mark.parametrize("is_secure", [False, True], ids=["plain", "secure"])
def test_the_containers_commands_start_agents_that_hear_each_other(tmp_path: Path, is_secure: bool) -> None:
    scenario = Scenario.model_validate({"name": "c", "tracks": {"robots": 2, "length_m": 20.0, "area_m": 8.0}})
    (tmp_path / "recordings").mkdir()
    for name, made in zip(ROBOTS, recordings(scenario).values(), strict=False):
        (tmp_path / "recordings" / name).symlink_to(made)
    if is_secure:
        make_keys(tmp_path / "keys", "compose", ROBOTS)
    running = [started(name, tmp_path, is_secure) for name in ROBOTS[:2]]
    events = [tmp_path / "data" / name / "events.jsonl" for name in ROBOTS[:2]]
    ends_s = time.monotonic() + 60.0
    while time.monotonic() < ends_s and not all(_hears(path) for path in events):
        time.sleep(0.2)
    for process in running:
        process.terminate()
    said = [process.communicate(timeout=30)[1] for process in running]
    assert [process.returncode for process in running] == [0, 0], said
    assert all(_hears(path) for path in events), said


def started(name: str, folder: Path, is_secure: bool) -> "subprocess.Popen[str]":
    """What a container runs, on loopback, with the container's folders below `folder`."""
    options = "--set transport.interface=lo --set perception.method=synthetic --set source.rate=4"
    if is_secure:
        options += " " + compose_schema.read(SECURE)["services"][name]["environment"]["OPTIONS"]
    places = {
        "/etc/flocc/keys": folder / "keys" / name,
        "/etc/flocc": ROOT / "docker",
        "/data": folder / "data",
        "/recordings": folder / "recordings",
    }
    words = arguments(name, {"OPTIONS": options, "LATENCY": "0.01"})
    for inside, outside in places.items():
        words = [re.sub(f"(^|=){inside}", rf"\g<1>{outside}", word) for word in words]
    return subprocess.Popen(
        [sys.executable, "-m", "flocc_launch.commands.main", *words], stderr=subprocess.PIPE, text=True
    )


def _hears(path: Path) -> bool:
    return path.exists() and '"event":"neighbour' in path.read_text()


def test_the_secure_file_is_an_addition_to_the_first() -> None:
    first, more = (compose_schema.loaded(path) for path in (COMPOSE, SECURE))
    assert set(more["services"]) <= set(first["services"])
