"""Takes the distortion out of pictures where an agent's camera cannot say it: for recordings, bags and live robots."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.lenses import CameraModel, LensKind, pixel_map, straight_camera


class Straightener:
    """Remaps the pictures of one camera.

    Attributes:
        model: How the pictures were taken.
        camera: The agent's camera of what `apply` gives.
        is_needed: Whether `apply` changes anything.
    """

    def __init__(self, model: CameraModel, view_rad: float | None = None) -> None:
        """Prepare; the map is computed once, with the first picture.

        Args:
            model: How the pictures were taken.
            view_rad: Horizontal field of view of a wide lens's remapped pictures; None takes as much as there is.

        Raises:
            ValueError: The lens does not see so much.
        """
        self.model = model
        self.camera: Camera = straight_camera(model, view_rad)
        self.is_needed = model.agent_camera() is None
        self._map: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None

    def apply(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Remap a picture of the model's size, grey or in colour, of 8 or 16 bits."""
        import cv2

        if not self.is_needed:
            return pixels
        if self._map is None:
            self._map = self._pixel_map()
        return np.asarray(cv2.remap(pixels, *self._map, cv2.INTER_LINEAR))

    def _pixel_map(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where each pixel of what `apply` gives is found in a picture as it was taken."""
        import cv2

        model = self.model
        if model.kind is not LensKind.PINHOLE:
            return pixel_map(model, self.camera)
        K, size = model.K(), (model.width, model.height)
        x, y = cv2.initUndistortRectifyMap(K, np.array(model.distortion), np.eye(3), K, size, cv2.CV_32FC1)
        return np.asarray(x, dtype=np.float32), np.asarray(y, dtype=np.float32)
