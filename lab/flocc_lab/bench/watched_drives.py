"""Drives to try the watch over cameras on: robots of the recordings at hand, and of towns that nobody has seen.

A drive is one robot's keyframes in order. Where a set has no odometry, the truth stands in. Towns are drawn: houses,
the camera's angle of view and size, walking speed, light, distance between keyframes, and what kind of odometry.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import KeyframeConfig
from flocc_lab.bench.acceptance_rows import colour_sevenscenes
from flocc_lab.bench.registration_scenes import (
    RegistrationScene,
    SceneView,
    fountain,
    from_recordings,
    kitti,
    robots_beside,
    sevenscenes,
    stereo_revisits,
)
from flocc_launch.datasets.drift import DRIFTS, DriftKind
from flocc_launch.world.generate import generate
from flocc_launch.world.spec import WorldSpec

Float = NDArray[np.float64]

TOWN_ROUTE_M = 30.0
KINDS: tuple[DriftKind | None, ...] = (None, *DRIFTS)
"""Of a town's odometry; None: a generated world's own."""


@dataclass(frozen=True, slots=True)
class Drive:
    """One robot's keyframes.

    Attributes:
        recording: What it comes from; recordings are left out as a whole.
        robot: Whose it is, and how a town was drawn.
        views: In order of time.
    """

    recording: str
    robot: str
    views: tuple[SceneView, ...]


def recorded_drives(shared: Path) -> Iterator[Drive]:
    """The robots of every set of pictures with poses that is there.

    vpr_corridor has no poses, and euroc no pictures: neither says anything of a camera.
    """
    sets: dict[str, Callable[[Path], RegistrationScene]] = {
        "street": lambda folder: robots_beside(folder, 3.0),
        "herz_jesu": lambda folder: robots_beside(folder, 4.0),
        "sevenscenes": sevenscenes,
        "sevenscenes-525": lambda folder: colour_sevenscenes(folder.with_name("sevenscenes")),
        "strecha_fountain": lambda folder: alone(fountain(folder / "fountain-P11")),
        "kitti_short": lambda folder: alone(kitti(folder / "KITTI_sequence_1")),
        "loop_pairs": lambda folder: alone(stereo_revisits(folder)),
    }
    for name, read in sets.items():
        if (shared / name.split("-")[0]).is_dir():
            yield from drives_of(name, read(shared / name))


def alone(scene: RegistrationScene) -> RegistrationScene:
    """The scene as one robot's: it was one drive before it was cut."""
    return replace(scene, views=tuple(replace(view, robot="all") for view in scene.views))


def drives_of(name: str, scene: RegistrationScene) -> Iterator[Drive]:
    """One drive per robot of a scene."""
    for robot in dict.fromkeys(view.robot for view in scene.views):
        yield Drive(name, robot, tuple(view for view in scene.views if view.robot == robot))


def drawn_drives(seeds: range, folder: Path) -> Iterator[Drive]:
    """One robot in a town of its own per seed; towns are kept in the folder."""
    for seed in seeds:
        spec, keyframes, words = drawn_town(seed)
        recordings = generate(spec, folder / f"town-{seed}", processes=1)
        yield from (
            replace(drive, robot=words) for drive in drives_of(f"town {seed}", from_recordings(recordings, keyframes))
        )


def drawn_town(seed: int) -> tuple[WorldSpec, KeyframeConfig, str]:
    """A town's specification, how its robot takes keyframes, and both in words."""
    rng = np.random.default_rng([seed, 16])
    kind = KINDS[int(rng.integers(len(KINDS)))]
    width = int(rng.choice([320, 480, 640]))
    spec = WorldSpec(
        seed=seed,
        robots=1,
        route_m=TOWN_ROUTE_M,
        width=width,
        height=width * 3 // 4,
        field_of_view_deg=round(float(rng.uniform(50.0, 100.0)), 1),
        speed_mps=round(float(rng.uniform(0.8, 1.6)), 2),
        light_change=round(float(rng.uniform(0.0, 1.0)), 2),
        drift=WorldSpec().drift if kind is None else DRIFTS[kind],
    )
    keyframes = KeyframeConfig(
        distance_m=round(float(rng.uniform(0.4, 1.5)), 2), rotation_rad=round(float(rng.uniform(0.1, 0.35)), 2)
    )
    words = f"{spec.field_of_view_deg:.0f} deg, {width} px, {keyframes.distance_m} m, {kind or 'world'}"
    return spec, keyframes, words
