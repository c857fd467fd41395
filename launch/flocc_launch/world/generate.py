"""`generate`: a world's recordings, one per robot, rendered by a few processes and kept for the next time."""

import hashlib
import multiprocessing
import os
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.geometry import pose
from flocc_agent.runtime.recording import write_camera
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_launch import datasets
from flocc_launch.datasets.drift import drifted
from flocc_launch.datasets.names import robot_names
from flocc_launch.world.exposure import SHUTTER_S, Sensor, light_at
from flocc_launch.world.render import Baked, Renderer, bake
from flocc_launch.world.routes import routes, walk
from flocc_launch.world.shade import light_maps
from flocc_launch.world.spec import WorldSpec
from flocc_launch.world.town import build_town

Float = NDArray[np.float64]
Progress = Callable[[int, int], None]

CHUNK_IMAGES = 12
T_BODY_CAMERA = pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.12, 0.0, 0.18]))


@dataclass(frozen=True, slots=True, eq=False)
class _Shot:
    """One image to be rendered."""

    robot: int
    frame: int
    stamp_s: float
    T_world_camera: Float
    T_later: Float
    path: Path


def generate(
    spec: WorldSpec, out: Path, *, processes: int | None = None, progress: Progress | None = None
) -> list[Path]:
    """Render a world as recordings; nothing is done where they are there already, of the same spec.

    Args:
        spec: The world.
        out: Gets one folder per robot: alpha, bravo, charlie.
        processes: How many render; None takes one per core that this process may use, at most eight.
        progress: Called with images done and images in all.

    Returns:
        The recordings' folders, one per robot.
    """
    folders = [out / name for name in robot_names(spec.robots)]
    stamp = f"{spec.model_dump_json(indent=1)}\nprogram {_program_digest()}\n"
    marker = out / "world.txt"
    if marker.exists() and marker.read_text(encoding="utf-8") == stamp:
        return folders
    marker.unlink(missing_ok=True)
    shots = []
    for index, (folder, nodes) in enumerate(zip(folders, routes(spec), strict=True)):
        shots += _prepare(spec, index, folder, walk(spec, index, nodes))
    _render(spec, shots, processes or min(len(os.sched_getaffinity(0)), 8), progress)
    marker.write_text(stamp, encoding="utf-8")
    return folders


def world_camera(spec: WorldSpec) -> Camera:
    """The camera that every robot carries."""
    focal = float(spec.width / 2 / np.tan(np.deg2rad(spec.field_of_view_deg) / 2))
    return Camera(spec.width, spec.height, focal, focal, (spec.width - 1) / 2, (spec.height - 1) / 2)


def baked_world(spec: WorldSpec) -> Baked:
    """Build the town of a spec and compute its light."""
    scene = build_town(np.random.default_rng([spec.seed, 0]), terraced=spec.terraced)
    return bake(scene, light_maps(scene))


def _program_digest() -> str:
    """Changes with the program that makes the world, so that what an older one rendered is not taken for new."""
    files = [*sorted(Path(__file__).parent.glob("*.py")), Path(datasets.__file__).parent / "drift.py"]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _prepare(spec: WorldSpec, index: int, folder: Path, truth: Trajectory) -> list[_Shot]:
    """Write everything of a recording but its images, and say which images are to be rendered."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "images").mkdir(parents=True)
    write_camera(folder / "camera.toml", world_camera(spec), T_BODY_CAMERA)
    write_tum(folder / "groundtruth.tum", truth)
    write_tum(folder / "odometry.tum", drifted(truth, spec.drift, np.random.default_rng([spec.seed, 6, index])))
    shots, lines = [], []
    for frame, stamp_s in enumerate(np.arange(0.0, truth.stamps_s[-1] - SHUTTER_S, 1.0 / spec.image_rate_hz)):
        T, T_later = truth.at(float(stamp_s)), truth.at(float(stamp_s) + SHUTTER_S)
        assert T is not None
        assert T_later is not None
        name = f"images/{frame:06d}.jpg"
        lines.append(f"{stamp_s:.9f} {name}\n")
        shots.append(_Shot(index, frame, float(stamp_s), T @ T_BODY_CAMERA, T_later @ T_BODY_CAMERA, folder / name))
    (folder / "images.txt").write_text("".join(lines), encoding="utf-8")
    return shots


def _render(spec: WorldSpec, shots: list[_Shot], processes: int, progress: Progress | None) -> None:
    chunks = [shots[i : i + CHUNK_IMAGES] for i in range(0, len(shots), CHUNK_IMAGES)]
    done = 0
    if progress is not None:
        progress(0, len(shots))
    with tempfile.TemporaryDirectory(prefix="flocc-world-") as folder:
        baked_world(spec).save(Path(folder))
        with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
            for count in pool.map(_paint, [spec] * len(chunks), chunks, [Path(folder)] * len(chunks)):
                done += count
                if progress is not None:
                    progress(done, len(shots))


def _paint(spec: WorldSpec, shots: list[_Shot], folder: Path) -> int:
    """Render some shots in a process of its own; returns how many."""
    cv2.setNumThreads(1)
    camera, renderer = world_camera(spec), _renderer(spec, folder)
    for shot in shots:
        clean = renderer.render(shot.T_world_camera, light_at(spec, shot.stamp_s))
        sensor = Sensor(spec, camera, shot.robot)
        pixels = sensor.expose(clean, shot.stamp_s, shot.frame, shot.T_world_camera, shot.T_later)
        quality = [cv2.IMWRITE_JPEG_QUALITY, spec.jpeg_quality]
        cv2.imwrite(str(shot.path), cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), quality)
    return len(shots)


@lru_cache(maxsize=1)
def _renderer(spec: WorldSpec, folder: Path) -> Renderer:
    return Renderer(Baked.load(folder), world_camera(spec))
