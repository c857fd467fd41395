"""A scenario's data: every robot's recording, generated or cut once and kept under the cache folder."""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from flocc_agent.runtime.measurement_file import NAME as MEASUREMENTS
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_launch.scenarios.scenario import DatasetScenario, Scenario, SensorsScenario, TracksScenario, WorldScenario
from flocc_launch.scenarios.sensors import sense
from flocc_launch.setup.cache import cache_folder

if TYPE_CHECKING:
    from flocc_launch.scenarios.walks import Walk

RECORDING_FILES = ("images.txt", "odometry.tum", "camera.toml")
Progress = Callable[[int, int], None]


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
    elif scenario.tracks is not None:
        made = _tracks(scenario.tracks)
    found = {f"r{i + 1}": path for i, path in enumerate(made)}
    given = {
        name: _recording(robot.recording, progress, seed, name)
        for seed, (name, robot) in enumerate(scenario.robots.items())
        if robot.recording is not None
    }
    made_of_all = {**found, **given}
    return made_of_all if scenario.sensors is None else _sensed(scenario.sensors, made_of_all)


def _sensed(sensors: SensorsScenario, paths: Mapping[str, Path]) -> dict[str, Path]:
    """The same recordings with the measurements of simulated sensors beside them.

    Raises:
        FloccError: A recording has no ground truth to draw them from.
    """
    truths = {name: read_tum(path / "groundtruth.tum") for name, path in paths.items()}
    key = hashlib.sha256(f"{sensors.model_dump_json()} {sorted(map(str, paths.values()))}".encode()).hexdigest()[:12]
    made = {}
    for name, rows in sense(sensors, truths).items():
        made[name] = folder = cache_folder() / "sensed" / key / name
        folder.mkdir(parents=True, exist_ok=True)
        for file in paths[name].iterdir():
            link = folder / file.name
            if not link.exists():
                link.symlink_to(file.resolve())
        text = "".join(json.dumps(row) + "\n" for row in rows)
        (folder / MEASUREMENTS).unlink(missing_ok=True)
        (folder / MEASUREMENTS).write_text(text, encoding="utf-8")
    return made


def _world(world: WorldScenario, progress: Progress | None) -> list[Path]:
    from flocc_launch.world.generate import generate
    from flocc_launch.world.spec import WorldSpec

    spec = WorldSpec(robots=world.robots, seed=world.seed)
    key = hashlib.sha256(spec.model_dump_json().encode()).hexdigest()[:12]
    return generate(spec, cache_folder() / "worlds" / key, progress=progress)


def _dataset(dataset: DatasetScenario, progress: Progress | None) -> list[Path]:
    from flocc_launch.datasets.bag_reader import is_bag
    from flocc_launch.datasets.commands import split
    from flocc_launch.datasets.video import is_video

    is_stream = is_bag(dataset.source) or is_video(dataset.source)
    source = _recording(dataset.source, progress) if is_stream else dataset.source.resolve()
    out = _dataset_folder(source, f"{dataset.robots} {dataset.seed} {dataset.drift}")
    return split(source, out, dataset.robots, seed=dataset.seed, kind=dataset.drift, progress=progress)


def _recording(path: Path, progress: Progress | None, seed: int = 0, robot: str | None = None) -> Path:
    """The folder itself where it is a recording, else one made of the data set, bag or video.

    Args:
        path: Where the data is.
        progress: Called with images done and images in all.
        seed: Of drift.
        robot: Whose part of a bag of several robots is taken.
    """
    from flocc_launch.datasets.bag_reader import is_bag
    from flocc_launch.datasets.commands import convert, needed_drift
    from flocc_launch.datasets.detect import read_source
    from flocc_launch.datasets.source import DatasetError
    from flocc_launch.datasets.video import is_video

    if all((path / name).exists() for name in RECORDING_FILES):
        return path
    if not is_bag(path) and not is_video(path):
        out = _dataset_folder(path.resolve(), f"whole {seed}")
        return convert(path, out, drift=needed_drift(read_source(path)), seed=seed, progress=progress)
    out = _dataset_folder(path.resolve(), f"whole {robot}")
    try:
        return convert(path, out, progress=progress, robot=robot)
    except DatasetError as error:
        raise DatasetError(f"{error}; make a recording with 'flocc dataset convert', and run that") from error


def _dataset_folder(source: Path, how: str) -> Path:
    """Where a data set's recordings are kept; a data set that was changed since gets another folder."""
    files = [source] if source.is_file() else sorted(source.rglob("*"))
    stats = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.is_file()]
    key = hashlib.sha256(f"2 {source} {how} {stats}".encode()).hexdigest()[:12]
    return cache_folder() / "datasets" / f"{source.name}-{key}"


def _tracks(tracks: TracksScenario) -> list[Path]:
    """Recordings whose images hold the true pose, which is what synthetic perception sees."""
    from flocc_launch.scenarios.walks import walks

    key = hashlib.sha256(tracks.model_dump_json().encode()).hexdigest()[:12]
    folder = cache_folder() / "tracks" / key
    return [_walked(folder / f"r{i + 1}", walk) for i, walk in enumerate(walks(tracks))]


def _walked(path: Path, walk: "Walk") -> Path:
    import cv2

    from flocc_agent.perception.synthetic import pose_image
    from flocc_launch.datasets.writer import RecordingWriter
    from flocc_launch.scenarios.walks import T_BODY_CAMERA

    with RecordingWriter(path, f"walk {path.parent.name}") as writer:
        for k in range(writer.count, len(walk.truth)):
            image = pose_image(walk.truth.T_fixed_body[k] @ T_BODY_CAMERA, f"{path.name}/{k}")
            _, png = cv2.imencode(".png", image.pixels[:, :, ::-1])
            writer.add(float(walk.truth.stamps_s[k]), png.tobytes(), ".png")
            if k == 0:
                writer.write_camera(image.camera, T_BODY_CAMERA)
                writer.write_trajectories(walk.odometry, walk.truth)
    return path
