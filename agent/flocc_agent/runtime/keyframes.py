"""Keyframe selection: an image becomes a keyframe when the robot moved or turned enough since the last one."""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import KeyframeConfig
from flocc_agent.geometry import angle_rad, between

Float = NDArray[np.float64]


class KeyframeSelector:
    """Remembers where the last keyframe was taken."""

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self._T_odom_last: Float | None = None

    def wants(self, T_odom_body: Float) -> bool:
        """Whether an image taken here should be a keyframe; the first one always."""
        if self._T_odom_last is None:
            return True
        T_last_body = between(self._T_odom_last, T_odom_body)
        moved = float(np.linalg.norm(T_last_body[:3, 3])) >= self._config.distance_m
        return moved or angle_rad(T_last_body[:3, :3]) >= self._config.rotation_rad

    def missed(self) -> None:
        """What was to become a keyframe could not be used: the next image is wanted wherever it was taken."""
        self._T_odom_last = None

    def took(self, T_odom_body: Float) -> None:
        """A keyframe was taken here."""
        self._T_odom_last = T_odom_body
