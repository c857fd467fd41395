"""A folder or a bag of the user's own in place of a scenario file: which robots are in it, and how it is run.

One data set is cut by time into robots; a folder of several is a robot each.
"""

import re
import statistics
from pathlib import Path

from flocc_launch.datasets.bag_reader import is_bag
from flocc_launch.datasets.commands import needed_drift
from flocc_launch.datasets.detect import detect_format, is_dataset, read_source
from flocc_launch.datasets.source import DatasetError
from flocc_launch.scenario import Scenario

ROBOTS = 3
ROBOTS_MAX = 16
KEYFRAMES_WANTED = 25
DISTANCE_MIN_M, DISTANCE_MAX_M = 0.05, 0.5
ROTATION_NEAR_RAD = 0.17
NAME_LENGTH_MAX = 32


def is_own_data(path: Path) -> bool:
    """Whether a path is data rather than a scenario file."""
    return path.is_dir() or is_bag(path)


def scenario_fields(path: Path, agents: int | None = None) -> dict[str, object]:
    """Fields of a scenario that runs a data set, a bag, or a folder of one per robot.

    Args:
        path: Where the data is.
        agents: Into how many robots one data set is cut; None means three.

    Raises:
        DatasetError: There is no data set, or one of them cannot be used.
    """
    fields: dict[str, object] = {"name": robot_name(path)}
    if is_bag(path) or is_dataset(path):
        fields["dataset"] = {"source": str(path.resolve()), "robots": agents or ROBOTS}
        return {**fields, **_keyframes([path], agents or ROBOTS)}
    found = _robots(path)
    if agents is not None and agents != len(found):
        raise DatasetError(f"{path}: holds {len(found)} robots ({', '.join(found)}), not {agents}")
    fields["robots"] = {name: {"recording": str(folder.resolve())} for name, folder in found.items()}
    return {**fields, **_keyframes(list(found.values()), 1)}


def sentence(scenario: Scenario) -> str:
    """What was made of the data, for whoever gave it without a scenario."""
    dataset = scenario.dataset
    if dataset is not None:
        taken, paths = f"{dataset.source} cut by time into {dataset.robots} robots", [dataset.source]
    else:
        taken = f"{len(scenario.robots)} robots: {', '.join(scenario.robots)}"
        paths = [robot.recording for robot in scenario.robots.values() if robot.recording is not None]
    made = any(not is_bag(path) and needed_drift(read_source(path)) is not None for path in paths)
    odometry = "made of ground truth, with seeded drift" if made else "the data's own"
    return f"data: {taken}; a keyframe every {scenario.keyframes.distance_m:g} m; odometry is {odometry}"


def robot_name(path: Path) -> str:
    """A name that keys can hold, made of a folder's."""
    stem = path.resolve().stem if path.is_file() else path.resolve().name
    return re.sub(r"[^a-z0-9_-]+", "-", stem.lower()).strip("-_")[:NAME_LENGTH_MAX] or "robots"


def _robots(path: Path) -> dict[str, Path]:
    """Data sets and bags in a folder, by the robot's name."""
    entries = sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))
    folders = [entry for entry in entries if is_bag(entry) or (entry.is_dir() and is_dataset(entry))]
    if not folders:
        detect_format(path)  # says what a data set is
    if len(folders) > ROBOTS_MAX:
        raise DatasetError(f"{path}: holds {len(folders)} data sets; at most {ROBOTS_MAX} robots run on one machine")
    found: dict[str, Path] = {}
    for folder in folders:
        name = robot_name(folder)
        if name in found:
            raise DatasetError(f"{folder}: its robot would be called {name}, as that of {found[name]}")
        found[name] = folder
    return found


def _keyframes(paths: list[Path], parts: int) -> dict[str, object]:
    """Keyframes closer together where robots move little: about `KEYFRAMES_WANTED` by distance on the median path."""
    sources = [read_source(path) for path in paths if not is_bag(path)]
    moved = [source.odometry or source.truth for source in sources]
    lengths_m = [trajectory.length_m() / parts for trajectory in moved if trajectory is not None]
    distance_m = statistics.median(lengths_m) / KEYFRAMES_WANTED if lengths_m else DISTANCE_MAX_M
    if distance_m >= DISTANCE_MAX_M:
        return {}
    near_m = max(round(distance_m, 3), DISTANCE_MIN_M)
    return {"keyframes": {"distance_m": near_m, "rotation_rad": ROTATION_NEAR_RAD}}
