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
from flocc_agent.core.interfaces import ImageWatch, KeyframeLook, OdometryPair, Perception
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.core.reports import CameraDoubted
from flocc_agent.perception.backends import OWN
from flocc_agent.perception.watch.camera_watch import CameraWatch
from flocc_launch.simulation.virtual_playback import Capture
from flocc_protocol.arrays import Array

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]


CACHE_FORM = b"6"
"""Changes with what a file of the cache holds."""


class ImageEyes:
    """A perception back-end that looks at captures."""

    def __init__(self, perception: Perception, config: PerceptionConfig, cache: Path | None) -> None:
        self._perception = perception
        self.up_odom = config.odometry_up
        self.cache = cache if config.method in OWN else None  # of a stranger's code nobody knows what it depends on
        self._config_key = b"" if self.cache is None else CACHE_FORM + repr(config).encode() + _code_hash()

    def watch(self, hidden: Mask | None) -> "CachedWatch":
        """What looks at one robot's captures."""
        return CachedWatch(self, hidden)

    def looked(self, watch: ImageWatch, capture: Capture, T_odom_camera: Float) -> KeyframeLook:
        """Look at a capture's image."""
        return watch.look(self._perception, capture.load(), T_odom_camera)

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """Register the match's latent with the query's."""
        if self.cache is None:
            return self._perception.register(query, match, odometry)
        neighbour = (odometry.latent, odometry.T_neighbour_query.tobytes()) if odometry else ()
        path = self.path(b"pair", query, match, *neighbour)
        if path.exists():
            return _result(msgpack.unpackb(path.read_bytes()))
        result = self._perception.register(query, match, odometry)
        _write(path, _packed(result))
        return result

    def without(self, latent: bytes, hidden: Mask) -> bytes:
        """Give a latent without what is hidden, (H, W)."""
        return self._perception.without(latent, hidden)

    def path(self, *parts: bytes) -> Path:
        """Where something is kept that depends on the configuration and these parts."""
        assert self.cache is not None
        digest = hashlib.blake2b(digest_size=20)
        for part in (self._config_key, *parts):
            digest.update(len(part).to_bytes(8, "little"))
            digest.update(part)
        name = digest.hexdigest()
        return self.cache / name[:2] / name[2:]


class CachedWatch:
    """Looks at one robot's captures in order; what it saw is kept under the hash of all captures so far.

    A watch remembers. Where the cache knows the answer the image is only noted, and looked at once a later one is not
    known.
    """

    def __init__(self, eyes: ImageEyes, hidden: Mask | None) -> None:
        self._eyes = eyes
        self._watch = CameraWatch(hidden, eyes.up_odom)
        self._history = hashlib.blake2b(b"" if hidden is None else hidden.tobytes(), digest_size=20)
        self._unseen: list[tuple[Capture, Float]] = []

    def look(self, capture: Capture, T_odom_camera: Float) -> KeyframeLook:
        """Describe and encode a keyframe, and tell what is odd about the camera."""
        if self._eyes.cache is None or capture.source is None:
            return self._eyes.looked(self._watch, capture, T_odom_camera)
        for part in (capture.source.read_bytes(), capture.camera_key, T_odom_camera.tobytes()):
            self._history.update(hashlib.blake2b(part).digest())
        path = self._eyes.path(b"image", self._history.digest())
        if path.exists():
            self._unseen.append((capture, T_odom_camera))
            return _looked(msgpack.unpackb(path.read_bytes()))
        for unseen, T in self._unseen:
            self._eyes.looked(self._watch, unseen, T)
        self._unseen.clear()
        looked = self._eyes.looked(self._watch, capture, T_odom_camera)
        _write(path, _packed_look(looked))
        return looked


def _packed_look(looked: KeyframeLook) -> list[Any]:
    d = looked.descriptor
    descriptor = None if d is None else [d.dtype, list(d.shape), d.data, d.scale]
    doubts = [[d.doubt, d.amount, d.where, d.pairs, d.withheld] for d in looked.doubts]
    hidden = None if looked.hidden is None else [list(looked.hidden.shape), np.packbits(looked.hidden).tobytes()]
    return [descriptor, looked.latent, looked.fault, doubts, hidden, looked.withdrawn]


def _looked(packed: list[Any]) -> KeyframeLook:
    descriptor, latent, fault, doubts, hidden, withdrawn = packed
    array = None if descriptor is None else Array(descriptor[0], tuple(descriptor[1]), *descriptor[2:])
    told = tuple(
        CameraDoubted(doubt=doubt, amount=amount, where=where, pairs=n, withheld=withheld)
        for doubt, amount, where, n, withheld in doubts
    )
    return KeyframeLook(array, latent, fault, told, None if hidden is None else _mask(*hidden), withdrawn)


def _mask(shape: list[int], data: bytes) -> Mask:
    bits = np.unpackbits(np.frombuffer(data, np.uint8), count=shape[0] * shape[1])
    return bits.reshape(shape).astype(np.bool_)


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
