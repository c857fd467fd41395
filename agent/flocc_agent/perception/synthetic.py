"""A perception model without images: ground truth plus a seeded noise, outlier and scale model.

It takes the place of Describer, Encoder and Registrar in simulations of large swarms and in fast tests. What it gives
depends on the seed and the keyframes' keys only, never on the order of calls. A simulated image is a tiny one whose
pixels hold the camera's true pose and the keyframe's key (`pose_image`); `describe_pose` and `encode_pose` do without.
"""

import hashlib
import math
import struct

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import SyntheticConfig
from flocc_agent.core.interfaces import Camera, Image, OdometryPair
from flocc_agent.core.registration import (
    Registration,
    RegistrationFailed,
    RegistrationFailure,
    odometry_scale,
)
from flocc_agent.geometry import inverse, pose, so3_exp
from flocc_agent.perception.latent import BadLatent, failed_by

Float = NDArray[np.float64]

MODEL = "synthetic/1"
MAGIC = b"FLS1"
KEY_BYTES_MAX = 255
HEAD = struct.Struct("<4sIB")
POSE = struct.Struct("<12d")
IMAGE_WIDTH = 128
PLACE_DISTANCE_M = 3.0
PLACE_ANGLE_RAD = 0.7
"""Distance, and angle between viewing directions, at which the similarity of two descriptors has fallen to 0.6."""
ALIAS_CELL_M = 10.0
"""Edge of the cubes that are aliased as a whole: a room."""
VISIBILITY_DISTANCE_M = 4.0
VISIBILITY_ANGLE_RAD = 0.6
"""Distance, and angle, at which the correspondences have fallen to 0.6 of the typical number."""
CORRESPONDENCES_TYPICAL = 400
"""Correspondences of two images of one place: about what the classical front end finds."""
CORRESPONDENCES_MIN = 20
"""Fewer correspondences are no registration, as for the core."""
OUTLIER_DISTANCE_M = 10.0
"""Typical length of a wrong translation: another room."""
SIGMA_ROTATION_MIN_RAD = 1e-4
SIGMA_TRANSLATION_MIN_RATIO = 1e-3


class SyntheticPerception:
    """Describer, Encoder and Registrar of a simulated world."""

    def __init__(self, config: SyntheticConfig, seed: int) -> None:
        self._config = config
        self._seed = seed
        rng = np.random.default_rng([abs(seed), 1])
        self._frequencies = rng.standard_normal((config.dimension, 6))
        self._phases = rng.uniform(0.0, 2.0 * np.pi, config.dimension)

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        return self._config.dimension

    @property
    def model(self) -> str:
        """Identity of the method."""
        return MODEL

    def describe(self, image: Image) -> NDArray[np.float32]:
        """Describe the pose and key that an image of `pose_image` holds."""
        return self.describe_pose(*_unpacked(image.pixels.tobytes()))

    def encode(self, image: Image) -> bytes:
        """Encode the pose and key that an image of `pose_image` holds."""
        return self.encode_pose(*_unpacked(image.pixels.tobytes()))

    def describe_pose(self, T_world_camera: Float, keyframe_key: str) -> NDArray[np.float32]:
        """Descriptor (D,) of what is seen from a pose.

        Random Fourier features (Rahimi and Recht 2007) of position and viewing direction: the cosine similarity of two
        places falls like a Gaussian of distance and angle. Aliased places share the signature of another place.
        """
        config = self._config
        position = self._apparent_position(T_world_camera[:3, 3])
        place = np.concatenate([position / PLACE_DISTANCE_M, T_world_camera[:3, 2] / PLACE_ANGLE_RAD])
        signature = np.cos(self._frequencies @ place + self._phases)
        noise = self._generator("describe", keyframe_key).standard_normal(config.dimension)
        vector = signature + noise * (config.descriptor_noise_ratio * math.sqrt(0.5))
        return np.asarray(vector / np.linalg.norm(vector), np.float32)

    def encode_pose(self, T_world_camera: Float, keyframe_key: str) -> bytes:
        """Latent of what is seen from a pose: the pose and the key."""
        return _packed(T_world_camera, keyframe_key, self._config.latent_bytes)

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """Draw the registration of two latents; the same for the same seed and keys, whenever it is asked."""
        try:
            T_world_query, query_key = _unpacked(query)
            T_world_match, match_key = _unpacked(match)
            neighbour = None if odometry is None else _unpacked(odometry.latent)
        except BadLatent as error:
            return failed_by(error)
        T_query_match = inverse(T_world_query) @ T_world_match
        odometry_count, T_query_neighbour = 0, None
        if neighbour is not None:
            T_query_neighbour = inverse(T_world_query) @ neighbour[0]
            odometry_rng = self._generator("correspondences", query_key, neighbour[1])
            odometry_count = self._correspondences(T_query_neighbour, odometry_rng)
        rng = self._generator("register", query_key, match_key)
        count = self._correspondences(T_query_match, rng)
        outlier = rng.uniform() < self._config.outlier_probability
        if outlier:
            T_query_match, count = self._outlier(rng)
        if count < CORRESPONDENCES_MIN:
            detail = f"{count} correspondences, {CORRESPONDENCES_MIN} needed"
            return RegistrationFailed(RegistrationFailure.FEW_CORRESPONDENCES, detail, count, odometry_count)
        noisy, covariance_m = self._noisy(T_query_match, count, rng)
        unit_m = math.exp(self._config.scale_sigma_ratio * rng.standard_normal())
        drift = math.exp(self._config.scale_drift_sigma_ratio * rng.standard_normal())
        scale = None
        if odometry is not None and T_query_neighbour is not None:
            measured = T_query_neighbour[:3, 3] / (unit_m * drift)
            scale = odometry_scale(odometry.T_neighbour_query[:3, 3], measured)
        noisy[:3, 3] /= unit_m
        covariance_m[3:, 3:] /= unit_m**2
        return Registration(noisy, count, odometry_count, scale, covariance_m)

    def _generator(self, purpose: str, *keys: str) -> np.random.Generator:
        """Generator that only the seed, the purpose and the keys determine."""
        text = "\x00".join((str(self._seed), purpose, *keys)).encode()
        return np.random.Generator(np.random.PCG64(int.from_bytes(hashlib.blake2b(text, digest_size=16).digest())))

    def _apparent_position(self, position_m: Float) -> Float:
        """Where a place seems to be: elsewhere for aliased cubes, which share a few looks."""
        cell = np.floor(position_m / ALIAS_CELL_M)
        rng = self._generator("alias", *(str(int(index)) for index in cell))
        if rng.uniform() >= self._config.alias_probability:
            return position_m
        look = int(rng.integers(self._config.alias_places))
        inside = position_m - cell * ALIAS_CELL_M
        return np.asarray(inside + np.array([1e4 * (look + 1), 0.0, 0.0]))

    def _correspondences(self, T_a_b: Float, rng: np.random.Generator) -> int:
        """Correspondences of two images; fewer with distance and with the angle between viewing directions."""
        distance = math.sqrt(float(T_a_b[:3, 3] @ T_a_b[:3, 3])) / VISIBILITY_DISTANCE_M
        angle = math.acos(min(max(float(T_a_b[2, 2]), -1.0), 1.0)) / VISIBILITY_ANGLE_RAD
        expected = CORRESPONDENCES_TYPICAL * math.exp(-0.5 * (distance**2 + angle**2))
        return int(rng.poisson(expected))

    def _outlier(self, rng: np.random.Generator) -> tuple[Float, int]:
        """A wrong pose, and the correspondences that support it: a tenth to a half of the typical number."""
        T = pose(so3_exp(rng.standard_normal(3)), rng.standard_normal(3) * OUTLIER_DISTANCE_M)
        return T, int(CORRESPONDENCES_TYPICAL * rng.uniform(0.1, 0.5))

    def _noisy(self, T_query_match: Float, count: int, rng: np.random.Generator) -> tuple[Float, Float]:
        """Disturb a pose in the match's tangent space; with the covariance (6, 6) of the disturbance, metres."""
        weakness = math.sqrt(CORRESPONDENCES_TYPICAL / max(count, 1))
        distance = max(math.sqrt(float(T_query_match[:3, 3] @ T_query_match[:3, 3])), 0.1)
        sigma_rotation = max(self._config.rotation_sigma_rad * weakness, SIGMA_ROTATION_MIN_RAD)
        ratio = max(self._config.translation_sigma_ratio * weakness, SIGMA_TRANSLATION_MIN_RATIO)
        sigmas = np.array([sigma_rotation] * 3 + [ratio * distance] * 3)
        xi = rng.standard_normal(6) * sigmas
        return T_query_match @ pose(so3_exp(xi[:3]), xi[3:]), np.diag(sigmas**2)


def pose_image(T_world_camera: Float, keyframe_key: str) -> Image:
    """An image whose pixels hold a pose and a key, for runs that pass images."""
    data = _packed(T_world_camera, keyframe_key, 3 * IMAGE_WIDTH)
    pixels = np.frombuffer(data, np.uint8).reshape(1, IMAGE_WIDTH, 3)
    return Image(pixels, Camera(IMAGE_WIDTH, 1, 100.0, 100.0, IMAGE_WIDTH / 2, 0.5))


def moved_latent(latent: bytes, by_m: float) -> bytes:
    """A latent that says its camera stood further to its right than it did: what a camera with something on it gives.

    Raises:
        BadLatent: It is no synthetic latent.
    """
    T_world_camera, key = _unpacked(latent)
    T_world_camera[:3, 3] += by_m * T_world_camera[:3, 0]
    return _packed(T_world_camera, key, len(latent))


def _packed(T_world_camera: Float, keyframe_key: str, bytes_min: int) -> bytes:
    """Serialise a pose and a key, padded with zeros."""
    key = keyframe_key.encode()
    if len(key) > KEY_BYTES_MAX:
        raise ValueError(f"keyframe key {keyframe_key!r} is longer than {KEY_BYTES_MAX} bytes")
    data = HEAD.pack(MAGIC, 0, len(key)) + POSE.pack(*T_world_camera[:3].ravel()) + key
    size = max(len(data), bytes_min)
    return HEAD.pack(MAGIC, size, len(key)) + data[HEAD.size :] + bytes(size - len(data))


def _unpacked(data: bytes) -> tuple[Float, str]:
    """Read a pose and a key.

    Raises:
        BadLatent: The bytes are not a synthetic latent, or the pose is not finite.
    """
    if len(data) < HEAD.size + POSE.size:
        raise BadLatent("the bytes are not a synthetic latent")
    magic, size, key_bytes = HEAD.unpack_from(data)
    end = HEAD.size + POSE.size + key_bytes
    if magic != MAGIC or size != len(data) or end > len(data):
        raise BadLatent("the bytes are not a synthetic latent")
    T = np.eye(4)
    T[:3] = np.frombuffer(data, "<f8", 12, HEAD.size).reshape(3, 4)
    if not np.isfinite(T).all():
        raise BadLatent("the synthetic latent's pose is not finite")
    try:
        return T, data[HEAD.size + POSE.size : end].decode()
    except UnicodeDecodeError as error:
        raise BadLatent("the synthetic latent's key is not text") from error
