"""How many keys there are, that each says what it does, and that what was a key says what replaced it.

A key is counted as issue 13 counts it: one row of the agent's tables of docs/configuration.md. That gave 230 rows at
commit 04961b5; a link's keys count again where an override has them. A scenario's rows are those of docs/scenarios.md.
"""

import dataclasses
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel

from flocc_agent.config import AgentConfig, ConfigError, put_value, validated
from flocc_agent.config.removed import REMOVED
from flocc_agent.core.parameters import INNER, CoreParameters, GossipParameters, LoopClosingParameters
from flocc_lab.reference.configuration_page import FIRST, inner_models, reference, section
from flocc_lab.reference.scenario_page import keys
from flocc_launch.scenarios.scenario import Scenario

AGENT_KEYS_MAX = 120
BOTH_KEYS_MAX = 182
"""The limit is on the agent's; a scenario's own say what data there are, what goes wrong and what is hoped: 44 at
04961b5, 16 of simulated sensors, `dataset.drift` and `expectations.deaths_max`."""
ROW = re.compile(r"^\| `([\w.]+)` \| (.*?) \| (.*) \|$")


def rows(lines: list[str]) -> dict[str, str]:
    """Key to description."""
    found = [ROW.match(line) for line in lines]
    return {row[1]: row[3] for row in found if row is not None}


AGENT = rows(section(AgentConfig, "", set()))
OWN = rows(keys().splitlines())


def test_the_agent_has_at_most_120_keys() -> None:
    assert len(AGENT) <= AGENT_KEYS_MAX, "a further key needs a reason: who turns it, and when"


def test_agent_and_scenario_do_not_grow_together() -> None:
    assert len(AGENT) + len(OWN) <= BOTH_KEYS_MAX
    assert not AGENT.keys() & OWN.keys() - {"name", "seed", "bandwidth_bytes_s"}


@pytest.mark.parametrize("key", [*AGENT, *OWN])
def test_every_key_says_what_it_does(key: str) -> None:
    assert len(({**AGENT, **OWN})[key].split()) >= 2


def test_the_page_begins_with_ten_keys_that_exist() -> None:
    assert len(FIRST) == len({key for key, _, _ in FIRST}) == 10
    assert [key for key, _, _ in FIRST if key not in AGENT] == []
    page = reference()
    assert page.index(FIRST[0][0]) < page.index("## Agent")


@pytest.mark.parametrize("key", REMOVED)
def test_a_key_that_is_gone_says_what_replaced_it(key: str) -> None:
    fields: dict[str, object] = {"name": "r1"}
    put_value(fields, f"{key}.x" if key in {"core.gossip", "core.distributed"} else key, 1)
    said = f"agent.toml: the key '{key}' is gone: {REMOVED[key]}"
    with pytest.raises(ConfigError, match=re.escape(said)):
        validated(AgentConfig, fields, "agent.toml")
    del fields["name"]
    if not key.startswith(("source", "transport", "ros2")):
        with pytest.raises(ConfigError, match=re.escape(f"'{key}' is gone")):
            Scenario.of({"tracks": {}, **fields}, {}, Path("s.toml"))
    assert [known for known in AGENT if known == key or known.startswith(f"{key}.")] == []


def test_a_key_that_is_gone_is_found_in_a_list_of_tables() -> None:
    text = 'name = "r1"\n[[radio.overrides]]\nsender = "r2"\n[[radio.overrides]]\nqueue_bytes_max = 1\n'
    with pytest.raises(ConfigError, match=r"'radio\.overrides\.queue_bytes_max' is gone"):
        validated(AgentConfig, tomllib.loads(text), "agent.toml")


def test_parameters_that_are_no_keys_are_not_written() -> None:
    core = CoreParameters(gossip=GossipParameters(logs_max=2), loop_closing=LoopClosingParameters(candidates_max=3))
    config = AgentConfig(name="r1", core=core, backend={"gnc_step": 1.5})
    assert (config.core, config.backend.gnc_step) == (core, 1.5)
    fields = config.model_dump(mode="json")
    read = validated(AgentConfig, fields, "agent.json")
    assert (read.core, read.backend.gnc_step) == (CoreParameters(), 2.0)


def test_what_is_written_holds_the_keys_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "agent.json").write_text(AgentConfig(name="r1").model_dump_json(), encoding="utf-8")
    assert AgentConfig.read(tmp_path / "agent.json") == AgentConfig(name="r1")


@pytest.mark.parametrize("page", ["configuration_page", "scenario_page"])
def test_help_of_a_page_is_help(page: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", f"flocc_lab.reference.{page}", "--help"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60)
    assert ran.stdout.startswith(f"usage: python -m flocc_lab.reference.{page}")
    assert list(tmp_path.iterdir()) == []


def inner_defaults(model: type, prefix: str = "") -> dict[str, object]:
    """Dotted names of the numbers that a program may give and no file, with their defaults."""
    found: dict[str, object] = {}
    if issubclass(model, BaseModel):
        found |= {f"{prefix}{name}": info.default for name, info in model.model_fields.items() if info.exclude}
    elif dataclasses.is_dataclass(model):
        found |= {f"{prefix}{f.name}": f.default for f in dataclasses.fields(model) if INNER in f.metadata}
    for name, below in inner_models(model, deep=False):
        found |= inner_defaults(below, f"{prefix}{name}.")
    return found


@pytest.mark.parametrize(("key", "default"), inner_defaults(AgentConfig).items())
def test_what_only_programs_give_is_told_with_its_value(key: str, default: object) -> None:
    """`core.gossip` and `core.distributed` are gone as a whole."""
    said = REMOVED[".".join(key.split(".")[:2]) if key.startswith(("core.gossip", "core.distributed")) else key]
    number = re.match(r"always ([\d.e-]+)( MiB| KiB)?", said)
    if number is not None:
        unit = {" MiB": 1024**2, " KiB": 1024, None: 1}[number[2]]
        assert float(number[1]) * unit == default, key
