"""What the runtime asks of a perception back-end: Describer, Encoder, Registrar, and `Perception`, all three.

A latent travels as `bytes`: a back-end's own header (format version, model identity, sizes, intrinsics), then its
arrays. Only the back-end that wrote a latent reads it, and it refuses another model's.
"""

from dataclasses import dataclass
from numbers import Integral
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.registration import Registration, RegistrationFailed
from flocc_agent.core.reports import CameraDoubted
from flocc_protocol.arrays import Array
from flocc_protocol.records import checked_descriptor

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole intrinsics with radial-tangential distortion (OpenCV's k1 k2 p1 p2), in pixels of the full image."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not all(isinstance(side, Integral) for side in (self.width, self.height)):
            raise ValueError(f"camera size {self.width!r}x{self.height!r} must be two whole numbers")
        if len(self.distortion) != 4:
            raise ValueError(f"camera distortion must be k1, k2, p1, p2, not {len(self.distortion)} numbers")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera size {self.width}x{self.height} must be positive")
        values = np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion])
        if not np.all(np.isfinite(values)) or self.fx <= 0 or self.fy <= 0:
            raise ValueError("camera intrinsics must be finite and focal lengths positive")

    def K(self) -> Float:
        """Calibration matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """What a camera saw.

    Attributes:
        pixels: (H, W, 3) uint8 in RGB order.
        camera: That took them.
        hidden: (H, W) pixels that move with the camera and show no scene; None: there are none.
        up: (3,) direction against gravity in the camera frame, of length one; None: it is not known.
    """

    pixels: NDArray[np.uint8]
    camera: Camera
    hidden: NDArray[np.bool_] | None = None
    up: Float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.pixels, np.ndarray):
            raise ValueError(f"image is no array but {type(self.pixels).__name__}")
        expected = (self.camera.height, self.camera.width, 3)
        if self.hidden is not None and (self.hidden.shape != expected[:2] or self.hidden.dtype != np.bool_):
            raise ValueError(f"hidden is {self.hidden.shape} {self.hidden.dtype}, its camera says {expected[:2]} bool")
        if self.pixels.shape != expected or self.pixels.dtype != np.uint8:
            raise ValueError(f"image is {self.pixels.shape} {self.pixels.dtype}, its camera says {expected} uint8")


@dataclass(frozen=True, slots=True, eq=False)
class OdometryPair:
    """A consecutive keyframe of the query's own robot, with what odometry says of the pair.

    Attributes:
        latent: Latent of the neighbouring keyframe (i-1, or i+1 for a robot's first keyframe).
        T_neighbour_query: (4, 4) metric pose of the query camera in the neighbour's camera, from odometry.
        key: Identifies the (neighbour, query) pair, for a cache of odometry-pair results.
    """

    latent: bytes
    T_neighbour_query: Float
    key: str


class Describer(Protocol):
    """Image to global place descriptor."""

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        ...

    def describe(self, image: Image) -> NDArray[np.float32]:
        """Compute a (D,) float32 descriptor of unit length; cosine similarity compares two of them."""
        ...


class Encoder(Protocol):
    """Image to latent."""

    @property
    def model(self) -> str:
        """Identity of the method and its weights; latents of one identity can be registered with each other."""
        ...

    def encode(self, image: Image) -> bytes:
        """Compute the latent of an image."""
        ...


@runtime_checkable
class PictureEncoder(Encoder, Protocol):
    """An encoder whose latents may hold the picture as well, which the receiver can encode by itself."""

    @property
    def encode_s(self) -> float | None:
        """Smoothed time to encode one picture, seconds; None where a latent is always fetched rather than encoded."""
        ...

    def part(self, latent: bytes, encode_bytes: int | None, /) -> bytes:
        """Cut what this robot stored of a keyframe down to what it sends.

        Args:
            latent: What `encode` gave.
            encode_bytes: What the link carries while the asker encodes a picture; None where it wants no picture.
        """
        ...


@runtime_checkable
class MaskingEncoder(Encoder, Protocol):
    """An encoder that can take out of a latent what turned out later to move with the camera."""

    def without(self, latent: bytes, hidden: NDArray[np.bool_], /) -> bytes:
        """Give a latent of its own without the features at hidden pixels.

        Args:
            latent: What `encode` gave.
            hidden: (H, W) of the camera's picture.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class SeenMatches:
    """Points that look alike in two images, for people to look at.

    Attributes:
        query: (K, 2) x/z and y/z of each point in the query's camera, free of distortion.
        match: (K, 2) the same points in the match's camera.
        agree: (K,) which of them fit one relative pose.
    """

    query: Float
    match: Float
    agree: NDArray[np.bool_]


class Registrar(Protocol):
    """Two latents to correspondences and a relative pose up to scale."""

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """Register the match's latent with the query's.

        Args:
            query: Latent of this robot's keyframe i.
            match: Latent of the other robot's keyframe j.
            odometry: The query's odometry pair for Eqs. (1) and (6); None where the robot has one keyframe only.

        Returns:
            The relative pose up to scale, or why there is none. Raises nothing for bad latents of a peer.
        """
        ...


@runtime_checkable
class MatchTelling(Registrar, Protocol):
    """A registrar that can tell which points it matched."""

    def matches(self, query: bytes, match: bytes, /) -> SeenMatches:
        """Match two latents of its own.

        Raises:
            BadLatent: A latent is damaged or of another model.
        """
        ...


@dataclass(frozen=True, slots=True)
class Perception:
    """A perception back-end, whole: what an agent sees with. Its three parts may be one object.

    Workers call it, from one thread per kind of work; `describe` and `encode` come once per keyframe.
    """

    describer: Describer
    encoder: Encoder
    registrar: Registrar

    def describe(self, image: Image) -> Array:
        """Compute an image's place descriptor, as it travels: (D,) int8.

        Raises:
            ValueError: The describer gave what no record holds.
        """
        return checked_descriptor(Array.int8(np.asarray(self.describer.describe(image), dtype=float)))

    def encode(self, image: Image) -> bytes:
        """Compute the latent of an image.

        Raises:
            TypeError: The encoder gave no bytes.
        """
        latent = self.encoder.encode(image)
        if not isinstance(latent, bytes):
            raise TypeError(f"a latent is bytes, not {type(latent).__name__}")
        return latent

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """Register the match's latent with the query's.

        Raises:
            TypeError: The registrar gave no result.
        """
        result = self.registrar.register(query, match, odometry)
        if not isinstance(result, Registration | RegistrationFailed):
            raise TypeError(f"a registration is a Registration or RegistrationFailed, not {type(result).__name__}")
        return result

    def matches(self, query: bytes, match: bytes) -> SeenMatches | None:
        """Give what the registrar matched in two latents; None where it cannot tell."""
        return self.registrar.matches(query, match) if isinstance(self.registrar, MatchTelling) else None

    def part(self, latent: bytes, encode_bytes: int | None) -> bytes:
        """Give what is sent of a stored latent; see `PictureEncoder.part`."""
        return self.encoder.part(latent, encode_bytes) if isinstance(self.encoder, PictureEncoder) else latent

    def without(self, latent: bytes, hidden: NDArray[np.bool_]) -> bytes:
        """Give a latent without what is hidden, where the encoder can; see `MaskingEncoder.without`."""
        return self.encoder.without(latent, hidden) if isinstance(self.encoder, MaskingEncoder) else latent

    def encode_s(self) -> float | None:
        """Tell how long encoding a received picture takes, seconds; None where pictures are not wanted."""
        return self.encoder.encode_s if isinstance(self.encoder, PictureEncoder) else None


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeLook:
    """What became of a keyframe's image.

    Attributes:
        descriptor: None where it was not encoded.
        latent: The same.
        fault: Why it was not.
        doubts: What is odd about the camera, told for the first time.
        hidden: (H, W) what moves with the camera, where that is told with this keyframe: the latents before show it.
        withdrawn: So many keyframes before this one showed what is not the scene, as this one tells.
    """

    descriptor: Array | None
    latent: bytes | None
    fault: str = ""
    doubts: tuple[CameraDoubted, ...] = ()
    hidden: NDArray[np.bool_] | None = None
    withdrawn: int = 0


class ImageWatch(Protocol):
    """Looks at one robot's images, in the order in which they were taken."""

    def look(self, perception: Perception, image: Image, T_odom_camera: Float) -> KeyframeLook:
        """Describe and encode an image, and tell what is odd about the camera."""
        ...
