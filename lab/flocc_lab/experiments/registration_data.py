"""Views and pairs of the registration experiment, encoded when they are needed and kept in bounded caches."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flocc_agent.config import KeyframeConfig, PerceptionConfig
from flocc_agent.core.interfaces import Perception
from flocc_agent.perception.backends import build_perception
from flocc_agent.runtime.recording import Recording
from flocc_lab.bench.perception_quality import ScoredPair, is_same_place
from flocc_lab.bench.registration_scenes import (
    RegistrationScene,
    fountain,
    from_recordings,
    robots_beside,
    sevenscenes,
    stereo_revisits,
)
from flocc_lab.experiments.experiment import ExperimentError, Progress, Settings
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Scenario, TracksScenario, WorldScenario

ERROR_PER_DISTANCE = 0.2
"""The paper's outliers are off by more than 2 m among pairs within 10 m."""
LATENTS_KEPT = 256
WALKS_AREA_M, WALKS_LENGTH_M = 12.0, 24.0
RESEARCH_SETS: dict[str, tuple[str, Callable[[Path], RegistrationScene]]] = {
    "sevenscenes": ("sevenscenes", sevenscenes),
    "fountain": ("strecha_fountain/fountain-P11", fountain),
    "loop_pairs": ("loop_pairs", stereo_revisits),
    "street": ("street", lambda folder: robots_beside(folder, 3.0)),
    "herz_jesu": ("herz_jesu", lambda folder: robots_beside(folder, 4.0)),
}


class RegistrationSettings(Settings):
    """Which pairs are drawn, and when a registration is wrong."""

    data: Path | None = None
    """Folder of the research sets, as ../shared/data; those of `sets` that are there are taken."""
    sets: tuple[str, ...] = ("sevenscenes", "fountain", "loop_pairs")
    """Research sets that are taken from `data`; street and herz_jesu are known, too."""
    datasets: tuple[Path, ...] = ()
    """Data sets of one robot with ground truth, each cut by time into robots."""
    recordings: tuple[Path, ...] = ()
    """Recordings of several robots with ground truth in one frame, which are registered with each other."""
    worlds: tuple[int, ...] = (7,)
    """Seeds of generated towns."""
    walks: tuple[int, ...] = ()
    """Seeds of walks without images, which only synthetic perception can see."""
    robots: int = Field(3, ge=2, le=8)
    """Robots of a town or of walks, and pieces of a data set."""
    perception: PerceptionConfig = PerceptionConfig()
    """The back-end: a configuration file whose [perception] is taken."""
    distance_m: float | None = Field(None, gt=0)
    """Largest distance of a pair; by default 10 m in towns and recordings, less in the smaller research sets."""
    error_max_m: float | None = Field(None, gt=0)
    """A registration with a larger translation error, its length made the true one, is wrong; by default a fifth of
    the distance, as the paper's 2 m at 10 m."""
    keyframe_distance_m: float = Field(0.5, gt=0)
    """Keyframes of towns and recordings."""
    pairs_max: int = Field(1500, ge=2)
    """Pairs drawn of each scene."""
    pairs_per_cell: int = Field(100, ge=1)
    """Pairs in one step of the experiment."""


def prepare_data(settings: RegistrationSettings, progress: Progress) -> None:
    """Generate the towns that are not there yet, and load everything once, so that bad data is told at once.

    Raises:
        FloccError: Data or a checkpoint cannot be used; see `make_scenes`.
    """
    for seed in settings.worlds:
        recordings(town(settings, seed), progress)
    data_of(settings)


def town(settings: RegistrationSettings, seed: int) -> Scenario:
    """A generated town with its robots."""
    return Scenario(world=WorldScenario(robots=settings.robots, seed=seed))


def make_scenes(settings: RegistrationSettings) -> dict[str, RegistrationScene]:
    """All scenes of the settings, by name; checks that each can be judged.

    Raises:
        FloccError: Data is damaged, has no ground truth, or its robots never come near each other.
    """
    found = _all_scenes(settings)
    if not found:
        raise ExperimentError("there is nothing to register: give --data, --datasets, --recordings or --worlds")
    for name, scene in found.items():
        if not near_pairs(scene, distance_m(settings, scene)):
            raise ExperimentError(
                f"{name}: no two views of different robots are within {distance_m(settings, scene):g} m of each other, "
                "so the robots do not overlap"
            )
    return found


def _all_scenes(settings: RegistrationSettings) -> dict[str, RegistrationScene]:
    keyframes = KeyframeConfig(distance_m=settings.keyframe_distance_m)
    scenes: dict[str, RegistrationScene] = {}
    if settings.data is not None:
        if not settings.data.is_dir():
            raise ExperimentError(f"{settings.data}: is not a folder")
        unknown = sorted(set(settings.sets) - set(RESEARCH_SETS))
        if unknown:
            raise ExperimentError(f"there is no research set {unknown[0]!r}; there are {', '.join(RESEARCH_SETS)}")
        for name, (part, read) in RESEARCH_SETS.items():
            if name in settings.sets and (settings.data / part).is_dir():
                scenes[name] = read(settings.data / part)
    for path in settings.datasets:
        scenes[path.name] = sevenscenes(path, settings.robots)
    if settings.recordings:
        scenes["recordings"] = _of_recordings(settings.recordings, keyframes)
    for seed in settings.worlds:
        scenes[f"town-{seed}"] = _of_recordings(list(recordings(town(settings, seed)).values()), keyframes)
    for seed in settings.walks:
        tracks = TracksScenario(robots=settings.robots, seed=seed, area_m=WALKS_AREA_M, length_m=WALKS_LENGTH_M)
        scenes[f"walks-{seed}"] = _of_recordings(list(recordings(Scenario(tracks=tracks)).values()), keyframes)
    return scenes


def _of_recordings(folders: Sequence[Path], keyframes: KeyframeConfig) -> RegistrationScene:
    """Keyframes of recordings; each must have ground truth.

    Raises:
        ExperimentError: One has none.
    """
    for folder in folders:
        if Recording.open(folder).truth is None:
            raise ExperimentError(f"{folder}: has no ground truth, so no registration in it can be judged")
    return from_recordings(list(folders), keyframes, position_error_max_m=2.0)


def distance_m(settings: RegistrationSettings, scene: RegistrationScene) -> float:
    """Largest distance of a pair in a scene."""
    return settings.distance_m or scene.position_error_max_m / ERROR_PER_DISTANCE


def error_max_m(settings: RegistrationSettings, scene: RegistrationScene) -> float:
    """Largest translation error of a right registration in a scene."""
    return settings.error_max_m or ERROR_PER_DISTANCE * distance_m(settings, scene)


def near_pairs(scene: RegistrationScene, limit_m: float) -> list[tuple[int, int]]:
    """Views of different robots that are nearer than a limit, whatever they look at."""
    positions = np.array([view.T_world_camera[:3, 3] for view in scene.views]).reshape(-1, 3)
    robots = [view.robot for view in scene.views]
    found = []
    for i in range(len(positions)):
        apart_m = np.linalg.norm(positions[i + 1 :] - positions[i], axis=1)
        found += [(i, i + 1 + int(k)) for k in np.flatnonzero(apart_m < limit_m)]
    return [(i, j) for i, j in found if robots[i] != robots[j]]


def drawn_pairs(scene: RegistrationScene, limit_m: float, pairs_max: int, seed: int) -> list[tuple[int, int]]:
    """A seeded sample of a scene's near pairs, sorted, so that neighbouring pairs share views."""
    near = near_pairs(scene, limit_m)
    if len(near) <= pairs_max:
        return near
    rng = np.random.default_rng(seed)
    return [near[k] for k in sorted(rng.choice(len(near), pairs_max, replace=False))]


class Encoded(Sequence[bytes]):
    """Latents of a scene's views, encoded when asked for; a bounded number is kept. Descriptors are all kept."""

    def __init__(self, scene: RegistrationScene, skills: Perception) -> None:
        self._scene = scene
        self._skills = skills
        self._latents: OrderedDict[int, bytes] = OrderedDict()
        self._descriptors: dict[int, NDArray[np.float32]] = {}

    def __len__(self) -> int:
        return len(self._scene.views)

    def __getitem__(self, k: int) -> bytes:  # type: ignore[override]
        if k not in self._latents:
            self._latents[k] = self._skills.encoder.encode(self._scene.views[k].image())
        self._latents.move_to_end(k)
        while len(self._latents) > LATENTS_KEPT:
            self._latents.popitem(last=False)
        return self._latents[k]

    def pair(self, i: int, j: int) -> ScoredPair:
        """A pair of views with its similarity."""
        similarity = float(self.descriptor(i) @ self.descriptor(j))
        return ScoredPair(i, j, similarity, is_same_place(self._scene, i, j))

    def descriptor(self, k: int) -> NDArray[np.float32]:
        """Descriptor of a view, (D,) of unit length."""
        if k not in self._descriptors:
            self._descriptors[k] = self._skills.describer.describe(self._scene.views[k].image())
        return self._descriptors[k]


class RegistrationData:
    """Scenes and perception of one experiment in this process."""

    def __init__(self, settings: RegistrationSettings) -> None:
        self.skills = build_perception(settings.perception)
        self.scenes = make_scenes(settings)
        self.encoded = {name: Encoded(scene, self.skills) for name, scene in self.scenes.items()}


def data_of(settings: RegistrationSettings) -> RegistrationData:
    """Data of the settings, made once in each process."""
    key = repr(settings)
    if key not in _held:
        _held.clear()
        _held[key] = RegistrationData(settings)
    return _held[key]


_held: dict[str, RegistrationData] = {}
"""Data of the last settings, by all that they say."""
