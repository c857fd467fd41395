"""`flocc agent --set KEY=VALUE`: other values for keys of a configuration file."""

from pathlib import Path

import pytest

from flocc_agent.config import AgentConfig, ConfigError, parsed_change


def write(folder: Path) -> Path:
    path = folder / "agent.toml"
    path.write_text('name = "r1"\nswarm = "yard"\n[radio]\nloss_ratio = 0.1\n')
    return path


def test_values_are_toml_or_text_as_it_stands() -> None:
    assert parsed_change("radio.loss_ratio=0.3") == ("radio.loss_ratio", 0.3)
    assert parsed_change("name=r2") == ("name", "r2")
    assert parsed_change('name = "r2"') == ("name", "r2")
    assert parsed_change("transport.multicast=false") == ("transport.multicast", False)
    assert parsed_change('transport.control_listen=["tcp/0.0.0.0:7447"]')[1] == ["tcp/0.0.0.0:7447"]
    assert parsed_change("folder=/data/a=b") == ("folder", "/data/a=b")


def test_a_change_counts_instead_of_the_file_and_beside_it(tmp_path: Path) -> None:
    changes = ["name=r2", "radio.loss_ratio=0.3", "radio.latency_s=0.05", "folder=here", "ros2.domain_id=4"]
    config = AgentConfig.read(write(tmp_path), changes)
    assert (config.name, config.swarm) == ("r2", "yard")
    assert (config.radio.loss_ratio, config.radio.latency_s) == (0.3, 0.05)
    assert config.folder == tmp_path / "here"
    assert config.ros2 is not None
    assert config.ros2.domain_id == 4


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("loss", "'loss' is no change of the configuration"),
        ("=3", "'=3' is no change"),
        ("radio.los_ratio=0.3", "the key 'radio.los_ratio' does not exist"),
        ("radio.loss_ratio=3", "radio.loss_ratio: Input should be less than or equal to 1"),
        ("swarm.name=x", "swarm.name: swarm is no table"),
        ("core.loop_closing.fetch_timeout_s=-1", "fetch_timeout_s must be positive"),
        ("core.loop_closing.correspondences_min=-1", "correspondences_min must not be negative"),
        ("core.election.leader_timeout_s=nan", "leader_timeout_s: Input should be a finite number"),
        ("folder=", "folder: a folder needs a name"),
        (
            'transport={control_listen=["tcp/0.0.0.0:7450"], bulk_listen=["tcp/0.0.0.0:7450"]}',
            "'tcp/0.0.0.0:7450' is listened at twice; control and bulk",
        ),
        ("keyframes.distance_m=true", "keyframes.distance_m: must be a number, neither true nor false"),
        ("core.rounds.period_s=true", "core.rounds.period_s: must be a number, neither true nor false"),
        ("radio.overrides=[{loss_ratio=true}]", "radio.overrides.0.loss_ratio: must be a number"),
        ("radio.overrides.loss_ratio=0.1", r"radio.overrides: is a list of tables, .* \[\[radio.overrides\]\]"),
    ],
)
def test_a_change_that_cannot_be_says_why(tmp_path: Path, change: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        AgentConfig.read(write(tmp_path), [change])
