"""What can be turned on a generated world."""

from pydantic import Field

from flocc_agent.config import Section
from flocc_launch.datasets.drift import DriftSpec


class WorldSpec(Section):
    """A town with streets, houses and a square, robots that walk through it, and how well they know where they are."""

    seed: int = Field(0, ge=0)
    """Everything random follows from it: houses, routes after the third robot, light, noise and drift."""
    robots: int = Field(3, ge=1, le=32)
    """How many walk through the town at the same time, each on its own route."""
    image_rate_hz: float = Field(2.0, gt=0)
    """Images per second; with the speed it sets how far apart they are."""
    odometry_rate_hz: float = Field(20.0, gt=0)
    """Odometry and ground truth poses per second."""
    speed_mps: float = Field(1.2, gt=0)
    """Walking speed on straight streets; robots slow down where they turn."""
    route_m: float = Field(95.0, gt=5)
    """Length of a route, about; longer ones turn at more crossings. Drift grows with it."""
    width: int = Field(640, ge=64)
    """Image width, pixels."""
    height: int = Field(480, ge=48)
    """Image height, pixels."""
    field_of_view_deg: float = Field(80.0, gt=20, lt=130)
    """Horizontal angle of view."""
    terraced: bool = False
    """All blocks are built by one plan, house by house alike: only what stands in the streets tells places apart."""
    light_change: float = Field(1.0, ge=0, le=1)
    """0: the same light for all; 1: clouds pass, and each camera has an exposure and colour balance of its own."""
    motion_blur: bool = True
    """Blur images along the camera's rotation while the shutter is open."""
    noise_sigma: float = Field(2.5, ge=0)
    """Standard deviation of the sensor's noise, in grey values of 255."""
    jpeg_quality: int = Field(92, ge=30, le=100)
    """Of the image files."""
    drift: DriftSpec = DriftSpec()
    """How each robot's odometry departs from the truth."""
