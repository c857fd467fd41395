"""Configuration files: paths are relative to their file, wherever they stand in it."""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from pydantic import BaseModel, ValidationError

from flocc_agent.config import AgentConfig, ConfigError, TransportConfig
from flocc_launch.scenarios.scenario import Scenario

AGENT = """
name = "r1"
folder = "state"
[source]
recording = "walks/one"
[perception.mast3r]
weights = "/models/mast3r.pth"
place_weights = "cosplace.pth"
[transport]
control_listen = ["tls/127.0.0.1:0"]
bulk_listen = ["tls/127.0.0.1:0"]
[transport.tls]
folder = "keys/r1"
"""


def test_paths_of_an_agent_start_at_its_file(tmp_path: Path) -> None:
    (tmp_path / "agent.toml").write_text(AGENT, encoding="utf-8")
    config = AgentConfig.read(tmp_path / "agent.toml")
    assert config.folder == tmp_path / "state"
    assert config.source.recording == tmp_path / "walks/one"
    assert config.perception.mast3r.weights == Path("/models/mast3r.pth")
    assert config.perception.mast3r.place_weights == tmp_path / "cosplace.pth"
    assert config.transport.tls is not None
    assert config.transport.tls.folder == tmp_path / "keys/r1"


def test_paths_of_a_scenario_start_at_its_file(tmp_path: Path) -> None:
    text = 'name = "s"\n[robots.r1]\nrecording = "one"\n[robots.r2]\nrecording = "/two"\n'
    (tmp_path / "scenario.toml").write_text(text, encoding="utf-8")
    robots = Scenario.read(tmp_path / "scenario.toml").robots
    assert [robots[name].recording for name in ("r1", "r2")] == [tmp_path / "one", Path("/two")]


def test_a_configuration_made_in_a_program_keeps_its_paths() -> None:
    assert AgentConfig(name="r1", folder=Path("state")).folder == Path("state")


def test_bulk_sessions_are_found_at_the_port_after_that_of_control() -> None:
    config = TransportConfig(multicast_address="224.0.0.224:7500")
    assert [config.multicast_group(control) for control in (True, False)] == ["224.0.0.224:7500", "224.0.0.224:7501"]


@pytest.mark.parametrize(
    "address", ["224.0.0.224", ":7446", "224.0.0.224:", "224.0.0.224:0", "224.0.0.224:65535", "10.0.0.7:7446"]
)
def test_a_multicast_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(ValueError, match="is no multicast address"):
        TransportConfig(multicast_address=address)


def annotations(section: type[BaseModel]) -> Iterator[tuple[str, Any]]:
    for name, field in section.model_fields.items():
        yield name, field.annotation


def leaves(section: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every key of a section and of those within it, the core's plain dataclasses among them."""
    for name, inner in get_type_hints(section).items() if is_dataclass(section) else annotations(section):
        if is_dataclass(inner) or (isinstance(inner, type) and issubclass(inner, BaseModel)):
            yield from leaves(inner, (*path, name))
        else:
            yield (*path, name)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_no_key_takes_a_number_that_is_not_finite_but_limits_that_may_be_infinite(value: float) -> None:
    taken = []
    for path in leaves(AgentConfig):
        given: Any = value
        for name in reversed(path):
            given = {name: given}
        with contextlib.suppress(ValidationError):
            AgentConfig.model_validate({"name": "r1", **given})
            taken.append(path)
    unlimited = [("radio", "bandwidth_bytes_s"), ("radio", "range_m")] if value == math.inf else []
    assert taken == unlimited


def test_a_swarm_with_keys_listens_with_tls_without_being_told(tmp_path: Path) -> None:
    path = tmp_path / "agent.toml"
    path.write_text('name = "r1"\n[transport.tls]\nfolder = "keys"\n')
    read = AgentConfig.read(path).transport
    assert (read.control_listen, read.bulk_listen) == (("tls/0.0.0.0:0",), ("tls/0.0.0.0:0",))
    assert TransportConfig().control_listen == ("tcp/0.0.0.0:0",)
    path.write_text('name = "r1"\n[transport]\ncontrol_listen = ["tcp/0.0.0.0:7"]\n[transport.tls]\nfolder = "keys"\n')
    with pytest.raises(ConfigError, match="with tls every endpoint begins with tls/, but there is 'tcp/0"):
        AgentConfig.read(path)
