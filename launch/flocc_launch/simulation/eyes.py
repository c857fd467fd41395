"""Perception on virtual time: the same back ends as everywhere."""

from pathlib import Path

from flocc_agent.composition import Perception
from flocc_agent.config import PerceptionConfig
from flocc_agent.core.interfaces import OdometryPair
from flocc_agent.core.registration import Registration, RegistrationFailed
from flocc_launch.simulation.playback import Capture
from flocc_protocol.arrays import Array


class ImageEyes:
    """A perception back-end that looks at captures."""

    def __init__(self, perception: Perception, config: PerceptionConfig, cache: Path | None) -> None:
        self._perception = perception

    def encode(self, capture: Capture) -> tuple[Array, bytes]:
        """Descriptor and latent of a keyframe."""
        encoded = self._perception.encode(capture.load())
        return encoded.descriptor, encoded.latent

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """Register the match's latent with the query's."""
        return self._perception.register(query, match, odometry)
