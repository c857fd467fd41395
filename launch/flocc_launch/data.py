"""A scenario's data: every robot's recording, generated or cut once and kept under the cache folder."""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

from flocc_launch.scenario import DatasetScenario, Scenario, WorldScenario

Progress = Callable[[int, int], None]


def cache_folder() -> Path:
    """Where generated data is kept: FLOCC_CACHE, or flocc's folder in the user's cache."""
    given = os.environ.get("FLOCC_CACHE")
    return Path(given) if given else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "flocc"


def recordings(scenario: Scenario, progress: Progress | None = None) -> dict[str, Path]:
    """The recording of each robot that has one, generated or cut where needed.

    Raises:
        FloccError: The data set cannot be used.
    """
    made: list[Path] = []
    if scenario.world is not None:
        made = _world(scenario.world, progress)
    elif scenario.dataset is not None:
        made = _dataset(scenario.dataset, progress)
    found = {f"r{i + 1}": path for i, path in enumerate(made)}
    given = {name: robot.recording for name, robot in scenario.robots.items() if robot.recording is not None}
    return {**found, **given}


def _world(world: WorldScenario, progress: Progress | None) -> list[Path]:
    from flocc_launch.world import WorldSpec, generate

    spec = WorldSpec(robots=world.robots, seed=world.seed)
    key = hashlib.sha256(spec.model_dump_json().encode()).hexdigest()[:12]
    return generate(spec, cache_folder() / "worlds" / key, progress)


def _dataset(dataset: DatasetScenario, progress: Progress | None) -> list[Path]:
    from flocc_launch.datasets.commands import split

    source = dataset.source.resolve()
    key = hashlib.sha256(f"{source} {dataset.robots} {dataset.seed}".encode()).hexdigest()[:12]
    out = cache_folder() / "datasets" / f"{source.name}-{key}"
    return split(source, out, dataset.robots, seed=dataset.seed, progress=progress)
