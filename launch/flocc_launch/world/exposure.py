"""From what falls into the lens to the pixels that a robot stores: light, blur, vignette, colour balance and noise."""

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.geometry import so3_exp, so3_log
from flocc_launch.world.render import Light
from flocc_launch.world.scene import Pixels
from flocc_launch.world.spec import WorldSpec

Float = NDArray[np.float64]

AMBIENT = np.array([0.74, 0.79, 0.88])
SUN = np.array([1.25, 1.12, 0.92])
SHUTTER_S = 0.012
BLUR_TAPS = 3
CLOUD_PERIOD_S = 38.0


def light_at(spec: WorldSpec, stamp_s: float) -> Light:
    """The light of the moment, the same for all robots: clouds dim the sun and whiten the sky."""
    rng = np.random.default_rng([spec.seed, 3])
    phases = rng.uniform(0, 2 * np.pi, 3)
    waves = [
        np.sin(2 * np.pi * stamp_s / (CLOUD_PERIOD_S * k) + p) for k, p in zip((1.0, 0.43, 2.3), phases, strict=True)
    ]
    cover = spec.light_change * float(np.clip(0.45 + 0.45 * waves[0] + 0.2 * waves[1] + 0.25 * waves[2], 0, 1))
    ambient, sun = AMBIENT * (1 + 0.18 * cover) + [0.03 * cover, 0.01 * cover, 0], SUN * (1 - 0.8 * cover)
    return Light((ambient[0], ambient[1], ambient[2]), (sun[0], sun[1], sun[2]))


class Sensor:
    """One robot's camera: its own gain and colour balance, which wander, its vignette and its noise."""

    def __init__(self, spec: WorldSpec, camera: Camera, index: int) -> None:
        self._spec = spec
        self._camera = camera
        self._index = index
        rng = np.random.default_rng([spec.seed, 4, index])
        self._gain = 1.0 + spec.light_change * rng.uniform(-0.12, 0.14)
        self._balance = 1.0 + spec.light_change * rng.uniform(-0.05, 0.05, 3)
        self._phase = rng.uniform(0, 2 * np.pi)
        u = (np.arange(camera.width) - camera.cx) / camera.fx
        v = (np.arange(camera.height) - camera.cy) / camera.fy
        cosine_sq = 1.0 / (1.0 + u[None, :] ** 2 + v[:, None] ** 2)
        self._vignette = (0.62 + 0.38 * cosine_sq).astype(np.float32)[..., None]

    def expose(self, pixels: Pixels, stamp_s: float, frame: int, T_world_camera: Float, T_later: Float) -> Pixels:
        """Turn a sharp, clean view into an image.

        Args:
            pixels: (H, W, 3) uint8 RGB.
            stamp_s: When.
            frame: The image's number, for its noise.
            T_world_camera: (4, 4) pose of the camera when the shutter opens.
            T_later: (4, 4) pose one shutter time later.
        """
        if self._spec.motion_blur:
            pixels = self._blurred(pixels, T_world_camera[:3, :3].T @ T_later[:3, :3])
        wave = self._spec.light_change * 0.1 * np.sin(2 * np.pi * stamp_s / 47.0 + self._phase)
        factor = (self._balance * (self._gain + wave)).astype(np.float32) * self._vignette
        rng = np.random.default_rng([self._spec.seed, 5, self._index, frame])
        noise = rng.standard_normal(pixels.shape[:2], dtype=np.float32)[..., None] * np.float32(self._spec.noise_sigma)
        return np.asarray(np.clip(pixels * factor + noise, 0, 255), dtype=np.uint8)

    def _blurred(self, pixels: Pixels, R_before_after: Float) -> Pixels:
        """Mean of views turned by parts of a rotation, which is what an open shutter sees of distant things."""
        turned = so3_log(R_before_after)
        if np.linalg.norm(turned) * self._camera.fx < 0.5:
            return pixels
        K = self._camera.K()
        total = np.zeros(pixels.shape, dtype=np.float32)
        for part in np.linspace(-0.5, 0.5, BLUR_TAPS):
            H = K @ so3_exp(part * turned) @ np.linalg.inv(K)
            view = cv2.warpPerspective(
                pixels, H, (self._camera.width, self._camera.height), borderMode=cv2.BORDER_REPLICATE
            )
            total += view
        return np.asarray(total / BLUR_TAPS + 0.5, dtype=np.uint8)
