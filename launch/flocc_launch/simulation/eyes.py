"""Perception on virtual time: the same back ends as everywhere, asked once per image and per pair.

What a back end finds depends on images and parameters only. With a cache folder it is kept on disk, under the hash of
all that it depends on, so that a scenario with images runs again in seconds.
"""

import hashlib
from dataclasses import fields
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


CACHE_FORM = b"2"
"""Changes with what a file of the cache holds."""


class ImageEyes:
    """A perception back-end that looks at captures."""

    def __init__(self, perception: Perception, config: PerceptionConfig, cache: Path | None) -> None:
        self._perception = perception
        self._cache = cache if config.method in OWN else None  # of a stranger's code nobody knows what it depends on
        self._config_key = b"" if self._cache is None else CACHE_FORM + repr(config).encode() + _code_hash()

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
        _write(path, _packed(result))
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


def _packed(result: Registration | RegistrationFailed) -> list[Any]:
    """Every field of a result, so that one from the cache is the one that was computed."""
    values = [getattr(result, field.name) for field in fields(result)]
    return [type(result).__name__, [_plain(value) for value in values]]


def _plain(value: Any) -> Any:
    if isinstance(value, RegistrationFailure):
        return value.name
    if isinstance(value, np.ndarray):
        return [list(value.shape), value.astype(np.float64).tobytes()]
    return value.item() if isinstance(value, np.generic) else value


def _result(packed: list[Any]) -> Registration | RegistrationFailed:
    name, values = packed
    if name == RegistrationFailed.__name__:
        return RegistrationFailed(RegistrationFailure[values[0]], *values[1:])
    read: list[Any] = [_matrix(*value) if isinstance(value, list) else value for value in values]
    return Registration(*read)


def _matrix(shape: list[int], data: bytes) -> Float:
    return np.frombuffer(data).reshape(shape).copy()
