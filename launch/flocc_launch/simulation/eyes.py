"""Perception on virtual time: the same back ends as everywhere, asked once per image and per pair.

What a back end finds depends on images and parameters only. With a cache folder it is kept on disk, under the hash of
all that it depends on, so that a scenario with images runs again in seconds.
"""

import hashlib
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from flocc_agent import perception as perception_package
from flocc_agent.config import PerceptionConfig
from flocc_agent.core.interfaces import OdometryPair, Perception
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.perception.backends import OWN
from flocc_launch.simulation.virtual_playback import Capture
from flocc_protocol.arrays import Array

Float = NDArray[np.float64]


class ImageEyes:
    """A perception back-end that looks at captures."""

    def __init__(self, perception: Perception, config: PerceptionConfig, cache: Path | None) -> None:
        self._perception = perception
        self._cache = cache if config.method in OWN else None  # of a stranger's code nobody knows what it depends on
        self._config_key = b"" if self._cache is None else repr(config).encode() + _code_hash()

    def encode(self, capture: Capture) -> tuple[Array, bytes]:
        """Descriptor and latent of a keyframe."""
        if self._cache is None or capture.source is None:
            image = capture.load()
            return self._perception.describe(image), self._perception.encode(image)
        path = self._path(b"image", capture.source.read_bytes(), capture.camera_key)
        if path.exists():
            dtype, shape, data, scale, latent = msgpack.unpackb(path.read_bytes())
            return Array(dtype, tuple(shape), data, scale), latent
        image = capture.load()
        d, latent = self._perception.describe(image), self._perception.encode(image)
        _write(path, [d.dtype, list(d.shape), d.data, d.scale, latent])
        return d, latent

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """Register the match's latent with the query's."""
        if self._cache is None:
            return self._perception.register(query, match, odometry)
        neighbour = (odometry.latent, odometry.T_neighbour_query.tobytes()) if odometry else ()
        path = self._path(b"pair", query, match, *neighbour)
        if path.exists():
            return _result(msgpack.unpackb(path.read_bytes()))
        result = self._perception.register(query, match, odometry)
        _write(path, _fields(result))
        return result

    def _path(self, *parts: bytes) -> Path:
        """Where something is kept that depends on the configuration and these parts."""
        assert self._cache is not None
        digest = hashlib.blake2b(digest_size=20)
        for part in (self._config_key, *parts):
            digest.update(len(part).to_bytes(8, "little"))
            digest.update(part)
        name = digest.hexdigest()
        return self._cache / name[:2] / name[2:]


def _code_hash() -> bytes:
    """Of the perception code: another version finds other things."""
    digest = hashlib.blake2b(digest_size=20)
    for folder in perception_package.__path__:
        for source in sorted(Path(folder).rglob("*.py")):
            digest.update(source.read_bytes())
    return digest.digest()


def _write(path: Path, fields: Any) -> None:
    """Write in one step, so that no other run reads half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    partial.write_bytes(msgpack.packb(fields))
    partial.replace(path)


def _fields(result: Registration | RegistrationFailed) -> list[Any]:
    if isinstance(result, RegistrationFailed):
        return [result.failure.name, result.detail, result.correspondences, result.odometry_correspondences]
    covariance = None if result.covariance is None else result.covariance.astype(np.float64).tobytes()
    T = result.T_query_match_unscaled.astype(np.float64).tobytes()
    return [T, covariance, result.correspondences, result.odometry_correspondences, result.scale_initial]


def _result(fields: list[Any]) -> Registration | RegistrationFailed:
    if len(fields) == 4:
        name, detail, correspondences, odometry_correspondences = fields
        return RegistrationFailed(RegistrationFailure[name], detail, correspondences, odometry_correspondences)
    T, covariance, correspondences, odometry_correspondences, scale_initial = fields
    return Registration(
        _matrix(T, 4),
        correspondences,
        odometry_correspondences,
        scale_initial,
        None if covariance is None else _matrix(covariance, 6),
    )


def _matrix(data: bytes, size: int) -> Float:
    return np.frombuffer(data).reshape(size, size).copy()
