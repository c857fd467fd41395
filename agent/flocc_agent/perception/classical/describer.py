"""Global descriptor of a place."""

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import ClassicalConfig
from flocc_agent.core.interfaces import Image

CELLS = 7
ORIENTATIONS = 8


class ClassicalDescriber:
    """Histogram of gradient orientations over a grid; the first version, replaced by VLAD."""

    def __init__(self, config: ClassicalConfig) -> None:
        cv2.setNumThreads(1)
        self._config = config

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        return CELLS * CELLS * ORIENTATIONS

    def describe(self, image: Image) -> NDArray[np.float32]:
        """Compute a (D,) float32 descriptor of unit length."""
        grey = cv2.resize(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY), (112, 112), interpolation=cv2.INTER_AREA)
        blurred = grey.astype(np.float32)
        dy, dx = np.gradient(blurred)
        magnitude = np.hypot(dx, dy)
        orientation = ((np.arctan2(dy, dx) / (2 * np.pi) + 1.0) * ORIENTATIONS).astype(int) % ORIENTATIONS
        cells = np.zeros((CELLS, CELLS, ORIENTATIONS), np.float32)
        rows = np.arange(112) // 16
        np.add.at(cells, (rows[:, None], rows[None, :], orientation), magnitude)
        cells /= np.linalg.norm(cells, axis=2, keepdims=True) + 8.0
        vector = cells.ravel() - cells.mean()
        norm = float(np.linalg.norm(vector))
        if norm < 1e-6:
            vector, norm = np.ones_like(vector), float(np.sqrt(len(vector)))
        return np.asarray(vector / norm, np.float32)
