"""Scenarios that come with flocc, by name, and scenario files of the user."""

from collections.abc import Callable, Mapping
from pathlib import Path

from flocc_agent.config import ConfigError
from flocc_launch.datasets.other_kinds import kind_of_file
from flocc_launch.scenarios.own_data import OwnData, is_own_data
from flocc_launch.scenarios.scenario import Scenario

FOLDER = Path(__file__).parent


def names() -> list[str]:
    """Names of the shipped scenarios, sorted."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def read_shipped(name: str, changes: Mapping[str, object] | None = None) -> Scenario:
    """Read a shipped scenario.

    Raises:
        ConfigError: There is none of that name.
    """
    path = FOLDER / f"{name}.toml"
    if not path.exists():
        raise ConfigError(f"{name}: is neither a file nor a shipped scenario ({', '.join(names())})")
    return Scenario.read(path, changes)


def read_scenario(
    text: str, changes: Mapping[str, object], agents: int | None = None, tell: Callable[[str], None] | None = None
) -> Scenario:
    """Read a scenario file, or a shipped scenario by its name.

    Args:
        text: Path or name; a folder or a bag is the user's own data.
        changes: Keys that the command line overrides.
        agents: Number of robots of its world, data set or tracks.
        tell: Takes a sentence about what was made of the user's own data.

    Raises:
        DatasetError: The user's own data cannot be used.
        ConfigError: It cannot be read, or it has no robots that could be counted anew.
    """
    if text not in names() and is_own_data(Path(text)):
        own = OwnData.open(Path(text), agents)
        if tell is not None:
            tell(own.sentence())
        return Scenario.of(own.fields(), changes, Path(text))
    if Path(text).suffix != ".toml" and Path(text).is_file() and (kind := kind_of_file(Path(text))) is not None:
        raise ConfigError(f"{text}: {kind}")
    read = Scenario.read if Path(text).suffix == ".toml" or Path(text).is_file() else None
    scenario = read(Path(text), changes) if read else read_shipped(text, changes)
    if agents is None:
        return scenario
    source = next((key for key in ("world", "dataset", "tracks") if getattr(scenario, key) is not None), None)
    if source is None:
        raise ConfigError(f"{text}: its robots are listed one by one; --agents cannot change their number")
    counted = {**changes, f"{source}.robots": agents}
    return read(Path(text), counted) if read else read_shipped(text, counted)
