"""Pictures of textured walls with known camera poses, and networks where their weights are there."""

import importlib.util

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.config import LearnedConfig
from flocc_agent.core.interfaces import Camera, Describer, Encoder, Image, Registrar
from flocc_agent.geometry import inverse
from flocc_agent.perception.learned import build
from flocc_agent.perception.learned.weight_sources import WEIGHT_FILES, weights_folder
from flocc_lab.codebook.procedural import random_texture

Float = NDArray[np.float64]

MODELS = ("aliked-lightglue", "xfeat-lighterglue")
SMALL = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
WALLS = (((-9.0, -6.0), 18.0, 9.0), ((-4.0, -2.5), 3.5, 6.5), ((0.3, -0.8), 3.0, 5.0), ((-2.0, 0.4), 2.0, 4.0))
"""Upright squares from far to near: upper left corner (x, y), side, distance z, metres."""


def front_end(model: str) -> tuple[Describer, Encoder, Registrar]:
    """The front end, or a skipped test that says what is missing."""
    for name in ("torch", "kornia"):
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"{name} is not installed (extra 'learned')")
    folder = weights_folder()
    missing = [file.name for file in WEIGHT_FILES if not (folder / file.name).is_file()]
    if missing:
        pytest.skip(f"{folder} has no {missing[0]}: 'flocc weights get learned' brings it")
    return build(LearnedConfig.model_validate({"model": model}))


def textures(seed: int) -> list[NDArray[np.float32]]:
    """A texture for each wall."""
    rng = np.random.default_rng(seed)
    return [random_texture(rng) for _ in WALLS]


def view(walls: list[NDArray[np.float32]], T_world_camera: Float, camera: Camera = SMALL) -> Image:
    """Render the walls from a pose."""
    T = inverse(T_world_camera)
    picture = np.full((camera.height, camera.width), 110, np.float32)
    for texture, ((x, y), side_m, z) in zip(walls, WALLS, strict=True):
        scale = side_m / len(texture)
        T_wall = np.array([[scale, 0, x], [0, scale, y], [0, 0, z], [0, 0, 1.0]])
        H = camera.K() @ (T @ T_wall)[:3]
        size = (camera.width, camera.height)
        mask = cv2.warpPerspective(np.ones_like(texture), H, size, flags=cv2.INTER_AREA)
        picture = picture * (1 - mask) + mask * cv2.warpPerspective(texture, H, size, flags=cv2.INTER_AREA)
    grey = np.clip(picture, 0, 255).astype(np.uint8)
    return Image(np.repeat(grey[:, :, None], 3, axis=2), camera)
