"""The sky: five sides of a large cube with a blue gradient, haze at the horizon and clouds."""

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_launch.world.noise import fractal_noise
from flocc_launch.world.scene import Scene, Surface

Float = NDArray[np.float64]

HALF_M = 2000.0
TEXELS = 640


def add_sky(scene: Scene, rng: np.random.Generator, centre_m: Float) -> None:
    """Put a sky around a world."""
    clouds = fractal_noise(rng, 1536, 1536, 200.0, 7, 0.55)
    for axis in ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)):
        outward = np.array(axis)
        down = np.array([0.0, 0.0, -1.0]) if outward[2] == 0 else np.array([0.0, -1.0, 0.0])
        right = np.cross(down, outward)
        origin = HALF_M * (outward - right - down) + np.array([centre_m[0], centre_m[1], 0.0])
        texture = scene.add_texture(_side(clouds, outward, right, down))
        scene.surfaces.append(Surface(origin, right, down, (2 * HALF_M, 2 * HALF_M), texture, glows=True))


def _side(clouds: NDArray[np.float32], outward: Float, right: Float, down: Float) -> NDArray[np.uint8]:
    steps = (np.arange(TEXELS) + 0.5) / TEXELS * 2 - 1
    ray = outward + steps[None, :, None] * right + steps[:, None, None] * down
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    height = np.clip(ray[..., 2], 0.02, 1)[..., None]
    colour = np.array([212, 222, 230]) + (np.array([92, 142, 206]) - np.array([212, 222, 230])) * height**0.6
    plan = (ray[..., :2] / (height + 0.25) * 300 + 768).astype(np.float32)
    cover = cv2.remap(clouds, plan[..., 0], plan[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    white = np.clip(0.9 * (cover - 0.1), 0, 0.92)[..., None]
    shaded = np.array([246, 247, 250]) - 34 * np.clip(cover - 0.9, 0, 1)[..., None]
    return np.asarray(np.clip(colour * (1 - white) + shaded * white, 0, 255), dtype=np.uint8)
