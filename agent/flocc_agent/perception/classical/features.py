"""Local features: where they are (rays, free of distortion and of the camera's size) and what they look like.

OpenCV's SIFT with RootSIFT normalisation (Arandjelovic and Zisserman 2012), quantised to one byte per component.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import ClassicalConfig
from flocc_agent.core.interfaces import Image
from flocc_agent.perception.multiview.picture import rays_of, reduced_to

DESCRIPTOR_LENGTH = 128
QUANTISATION = 512.0
CONTRAST_THRESHOLD = 0.02
"""Of SIFT: half of OpenCV's, for dim images; with less, features do not repeat."""
"""A RootSIFT component times this fits a byte; the few above 255/512 are clipped."""


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Local features of one image.

    Attributes:
        points: (N, 2) float32, x/z and y/z in the camera frame, free of distortion.
        descriptors: (N, 128) uint8, RootSIFT times 512.
        focal_px: Mean focal length in pixels of the picture that was searched; turns rays into its pixels.
        up: (3,) direction against gravity in the camera frame, of length one; None: it is not known.
    """

    points: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    focal_px: float
    up: NDArray[np.float64] | None = None


class FeatureExtractor:
    """SIFT on the grey image, strongest first, at most `features_max`."""

    def __init__(self, config: ClassicalConfig) -> None:
        cv2.setNumThreads(1)  # global in OpenCV: one worker, one core
        self._features_max = config.features_max
        self._pixels_max = config.pixels_max
        self._sift = cv2.SIFT.create(nfeatures=config.features_max, contrastThreshold=CONTRAST_THRESHOLD)
        self._sift_all = cv2.SIFT.create(contrastThreshold=CONTRAST_THRESHOLD)

    def extract(self, image: Image) -> Features:
        """Find and describe the features of an image; an image of one colour has none."""
        grey = np.asarray(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY), np.uint8)
        reduced = reduced_to(grey, self._pixels_max)
        keypoints, sift = self._found(reduced, image.hidden)
        count = min(len(keypoints), self._features_max)
        pixels = np.array([keypoint.pt for keypoint in keypoints[:count]], np.float64).reshape(-1, 2)
        height, width = reduced.shape
        points, focal_px = rays_of(pixels, (width, height), image.camera)
        found = np.zeros((0, DESCRIPTOR_LENGTH)) if sift is None else sift[:count]
        return Features(points.astype(np.float32), root_sift(np.asarray(found, np.float32)), focal_px, image.up)

    def _found(
        self, picture: NDArray[np.uint8], hidden: NDArray[np.bool_] | None
    ) -> tuple[Sequence[cv2.KeyPoint], Any]:
        """Keypoints and their descriptors; what is hidden has none and takes none of the others' places."""
        if hidden is None:
            keypoints, sift = self._sift.detectAndCompute(picture, None)
            return keypoints, sift
        height, width = picture.shape
        shown = cv2.resize((~hidden).astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        strongest = sorted(self._sift_all.detect(picture, shown), key=lambda point: -point.response)
        keypoints, sift = self._sift_all.compute(picture, strongest[: self._features_max])
        return keypoints, sift


def root_sift(sift: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Normalise SIFT descriptors (N, 128) to RootSIFT and quantise them to bytes."""
    total = np.maximum(sift.sum(axis=1, keepdims=True), 1e-6)
    quantised = np.sqrt(sift / total) * QUANTISATION
    return np.asarray(np.minimum(np.rint(quantised), 255.0), np.uint8)
