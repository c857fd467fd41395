"""Global descriptor of a place: dense patches, aggregated with a codebook learnt from generated images."""

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import ClassicalConfig
from flocc_agent.core.interfaces import Image
from flocc_agent.perception.classical.codebook import load_codebook
from flocc_agent.perception.classical.patches import dense_patches


class ClassicalDescriber:
    """Image to global place descriptor."""

    def __init__(self, config: ClassicalConfig) -> None:
        cv2.setNumThreads(1)  # global in OpenCV: one worker, one core
        self._config = config
        self._codebook = load_codebook()

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        return self._codebook.dimension

    def describe(self, image: Image) -> NDArray[np.float32]:
        """Compute a (D,) float32 descriptor of unit length; all images without texture share one."""
        grey = cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY)
        return self._codebook.describe(dense_patches(np.asarray(grey, np.uint8), image.hidden))
