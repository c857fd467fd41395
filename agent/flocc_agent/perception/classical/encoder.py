"""The classical latent: local features as bytes, 136 bytes per feature and a header of about 200 bytes."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import ClassicalConfig
from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.perception.classical.features import DESCRIPTOR_LENGTH, FeatureExtractor, Features
from flocc_agent.perception.latent import BadLatent, pack, unpack, up_of, with_up
from flocc_agent.perception.multiview.picture import at_pixels, distorted

MODEL = "classical/sift-2"
FEATURES_MAX = 10_000
POINT_MAX = 100.0
"""Largest |x/z| of a feature; beyond it lies 90 degrees off the axis."""


class ClassicalEncoder:
    """Image to latent: SIFT features with undistorted positions."""

    def __init__(self, config: ClassicalConfig) -> None:
        self._extractor = FeatureExtractor(config)

    @property
    def model(self) -> str:
        """Identity of the features; latents of one identity can be registered with each other."""
        return MODEL

    def encode(self, image: Image) -> bytes:
        """Compute the latent of an image."""
        camera = image.camera
        size_and_intrinsics = {
            "width": camera.width,
            "height": camera.height,
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        }
        bent = {"distortion": list(camera.distortion)} if any(camera.distortion) else {}
        return encode_features(self._extractor.extract(image), size_and_intrinsics | bent)

    def without(self, latent: bytes, hidden: NDArray[np.bool_]) -> bytes:
        """Give a latent of its own without the features at hidden pixels (H, W) of the camera's picture."""
        header, features = unpack(latent, MODEL).header, decode_features(latent)
        fx, fy, cx, cy = header["intrinsics"]
        camera = Camera(header["width"], header["height"], fx, fy, cx, cy, tuple(header.get("distortion", (0.0,) * 4)))
        shown = ~at_pixels(hidden, distorted(features.points.astype(np.float64), camera))
        kept = replace(features, points=features.points[shown], descriptors=features.descriptors[shown])
        return encode_features(kept, dict(header))


def encode_features(features: Features, header: dict[str, Any]) -> bytes:
    """Serialise features; the header may say more about the image they come from."""
    arrays: dict[str, NDArray[Any]] = {
        "points": features.points.astype("<f4"),
        "descriptors": features.descriptors,
    }
    return pack(MODEL, with_up({**header, "focal_px": features.focal_px}, features.up), arrays)


def decode_features(latent: bytes) -> Features:
    """Read the features of a latent.

    Raises:
        BadLatent: The latent is damaged, of another model, or its arrays do not fit together.
    """
    content = unpack(latent, MODEL)
    points, descriptors = content.arrays.get("points"), content.arrays.get("descriptors")
    focal_px = content.header.get("focal_px")
    if points is None or descriptors is None or points.dtype != np.float32 or descriptors.dtype != np.uint8:
        raise BadLatent("the latent lacks float32 points or uint8 descriptors")
    if points.shape != (len(descriptors), 2) or descriptors.shape[1:] != (DESCRIPTOR_LENGTH,):
        raise BadLatent(f"points {points.shape} and descriptors {descriptors.shape} do not fit together")
    if len(points) > FEATURES_MAX or np.any(np.abs(points) > POINT_MAX):
        raise BadLatent("the latent has too many features, or one that no camera sees")
    if not isinstance(focal_px, (int, float)) or not 1.0 <= focal_px <= 1e6:
        raise BadLatent(f"the latent's focal length {str(focal_px)[:32]} is not between 1 and 1e6 pixels")
    return Features(points, descriptors, float(focal_px), up_of(content.header))
