"""Learned local features of one image, and the latent that carries them.

Positions are uint16 in 1/64 pixel of the picture that was searched, descriptors int8, strongest features first; the
header has the camera. 70 kB for 1024 features of 64 numbers, 135 kB for 128.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.perception.latent import BadLatent, pack, unpack, up_of, with_up
from flocc_agent.perception.multiview.picture import rays_of

Float32 = NDArray[np.float32]

FEATURES_MAX = 1024
POSITION_STEPS = 64
"""Positions in this fraction of a pixel: far below the features' own noise of half a pixel."""
SIDE_MAX_PX = 1023
"""What uint16 can hold in such steps."""
QUANTUM_LEVELS = 127
LENGTH_MIN = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class LearnedFeatures:
    """Local features of one image.

    Attributes:
        pixels: (N, 2) float32 in the searched picture, what the matcher sees.
        points: (N, 2) float32, x/z and y/z in the camera frame, free of distortion.
        descriptors: (N, D) float32 of unit length.
        size_px: Width and height of the searched picture.
        focal_px: Mean focal length in its pixels.
        up: (3,) direction against gravity in the camera frame, of length one; None: it is not known.
    """

    pixels: Float32
    points: Float32
    descriptors: Float32
    size_px: tuple[int, int]
    focal_px: float
    up: NDArray[np.float64] | None = None


def write_features(
    model: str,
    pixels: Float32,
    descriptors: Float32,
    size_px: tuple[int, int],
    camera: Camera,
    up: NDArray[np.float64] | None = None,
) -> bytes:
    """Serialise what a network found in a picture of this size, which was made from the camera's image."""
    steps = np.clip(np.rint(pixels * POSITION_STEPS), 0, np.iinfo(np.uint16).max)
    largest = float(np.abs(descriptors).max()) if descriptors.size else 1.0
    levels = np.rint(descriptors * (QUANTUM_LEVELS / max(largest, LENGTH_MIN)))
    header = {
        "size_px": list(size_px),
        "camera": [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion],
    }
    return pack(model, with_up(header, up), {"pixels": steps.astype("<u2"), "descriptors": levels.astype(np.int8)})


def read_features(latent: bytes, model: str, descriptor_length: int) -> LearnedFeatures:
    """Read the features of a latent.

    Raises:
        BadLatent: The latent is damaged, of another model, or its parts do not fit together.
    """
    content = unpack(latent, model)
    steps, levels = content.arrays.get("pixels"), content.arrays.get("descriptors")
    if steps is None or levels is None or steps.dtype != np.uint16 or levels.dtype != np.int8:
        raise BadLatent("the latent lacks uint16 positions or int8 descriptors")
    if steps.shape != (len(levels), 2) or levels.shape[1:] != (descriptor_length,) or len(levels) > FEATURES_MAX:
        raise BadLatent(f"positions {steps.shape} and descriptors {levels.shape} do not fit together")
    size_px = _size(content.header.get("size_px"))
    camera = _camera(content.header.get("camera"))
    pixels = np.minimum(steps.astype(np.float32) / POSITION_STEPS, np.array(size_px, np.float32))
    lengths = np.linalg.norm(levels.astype(np.float32), axis=1, keepdims=True)
    descriptors = levels / np.maximum(lengths, 1.0)
    points, focal_px = rays_of(pixels.astype(np.float64), size_px, camera)
    up = up_of(content.header)
    return LearnedFeatures(pixels, points.astype(np.float32), descriptors.astype(np.float32), size_px, focal_px, up)


def _size(value: Any) -> tuple[int, int]:
    if not isinstance(value, list) or len(value) != 2 or not all(type(v) is int for v in value):
        raise BadLatent("the latent does not say how large its picture is")
    if not all(1 <= side <= SIDE_MAX_PX for side in value):
        raise BadLatent(f"the latent's picture of {value[0]}x{value[1]} pixels is impossible")
    return value[0], value[1]


def _camera(value: Any) -> Camera:
    numbers = value if isinstance(value, list) else []
    if len(numbers) != 10 or not all(isinstance(number, (int, float)) for number in numbers):
        raise BadLatent("the latent does not say what its camera is")
    try:
        width, height, fx, fy, cx, cy, *distortion = numbers
        return Camera(int(width), int(height), fx, fy, cx, cy, tuple(distortion))
    except (ValueError, OverflowError) as error:
        raise BadLatent(f"the latent's camera is impossible: {error}") from error
