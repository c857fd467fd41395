"""A perception back-end that looks everything up: candidates and registrations of an earlier run or a benchmark.

An image holds only its keyframe's name (`name_image`). A descriptor has one entry per recorded pair, so that exactly
the recorded pairs look alike; what is registered is what the file says of the pair, with its scale or without.

The file is JSON: `{"format": "flocc-recorded/1", "keyframes": [NAME, ...], "pairs": [{"query": NAME, "match": NAME,
"T_query_match": [x, y, z, qw, qx, qy, qz], "covariance": [21 numbers] or null}, ...]}`, translations in metres,
covariances as upper triangles by rows, rotation first.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import RecordedConfig
from flocc_agent.core.interfaces import Camera, Image, OdometryPair
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.geometry import hat, in_units, inverse, is_rigid, pose_from_tq, symmetric
from flocc_agent.perception.latent import BadLatent, failed_by
from flocc_protocol.errors import FloccError

Float = NDArray[np.float64]

FORMAT = "flocc-recorded/1"
MODEL = "recorded/1"
MAGIC = b"FLR1"
IMAGE_WIDTH = 32
NAME_BYTES_MAX = 3 * IMAGE_WIDTH - len(MAGIC) - 1
DIMENSION_MAX = 2048
CORRESPONDENCES = 100
"""Correspondences of a recorded pair and of every odometry pair: the match ratio of Eq. (1) is 1."""


class BadRecordedFile(FloccError):
    """The file of recorded registrations cannot be used; the message names it and the entry."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedPair:
    """What was registered: the metric pose of the match in the query, and its covariance (6, 6) or None."""

    T_query_match: Float
    covariance: Float | None

    def reversed(self) -> "RecordedPair":
        """The same measurement seen from the match."""
        T = self.T_query_match
        if self.covariance is None:
            return RecordedPair(inverse(T), None)
        R = T[:3, :3]
        adjoint = np.block([[R, np.zeros((3, 3))], [hat(T[:3, 3]) @ R, R]])
        return RecordedPair(inverse(T), adjoint @ self.covariance @ adjoint.T)


class RecordedPerception:
    """Describer, Encoder and Registrar of what was recorded."""

    def __init__(self, config: RecordedConfig) -> None:
        """Read the file.

        Raises:
            BadRecordedFile: There is none, or it is damaged.
        """
        if config.file is None:
            raise BadRecordedFile("perception.recorded.file names no file of recorded registrations")
        self._keeps_scale = config.scale == "kept"
        keyframes, self._pairs = read_recorded(config.file)
        entries: dict[str, list[int]] = {}
        for k, (query, match) in enumerate(self._pairs):
            entries.setdefault(query, []).append(k)
            entries.setdefault(match, []).append(k)
        lonely = [name for name in keyframes if name not in entries]
        for k, name in enumerate(lonely, start=len(self._pairs)):
            entries[name] = [k % DIMENSION_MAX]
        self._entries = entries
        self._dimension = min(max(len(self._pairs) + len(lonely), 1), DIMENSION_MAX)

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        return self._dimension

    @property
    def model(self) -> str:
        """Identity of the method."""
        return MODEL

    def describe(self, image: Image) -> NDArray[np.float32]:
        """Unit vector (D,) with an entry for each recorded pair of the keyframe."""
        name = name_of(image.pixels.tobytes())
        found = self._entries.get(name)
        if found is None:
            raise BadRecordedFile(f"keyframe {name!r} is not in the file of recorded registrations")
        vector = np.zeros(self._dimension, np.float32)
        vector[found] = 1.0 / np.sqrt(len(found))
        return vector

    def encode(self, image: Image) -> bytes:
        """The keyframe's name."""
        return _named(name_of(image.pixels.tobytes()))

    def register(
        self,
        query: bytes,
        match: bytes,
        odometry: OdometryPair | None,  # noqa: ARG002 - the interface's; what is recorded needs none
    ) -> Registration | RegistrationFailed:
        """Look the pair up, in either direction."""
        try:
            names = name_of(query), name_of(match)
        except BadLatent as error:
            return failed_by(error)
        found = self._pairs.get(names)
        if found is None and (backwards := self._pairs.get((names[1], names[0]))) is not None:
            found = backwards.reversed()
        if found is None:
            return RegistrationFailed(RegistrationFailure.FEW_CORRESPONDENCES, "not recorded", 0, CORRESPONDENCES)
        T = found.T_query_match.copy()
        if self._keeps_scale:
            return Registration(T, CORRESPONDENCES, CORRESPONDENCES, 1.0, found.covariance)
        unit_m = float(np.linalg.norm(T[:3, 3])) or 1.0
        T[:3, 3] /= unit_m
        covariance = None if found.covariance is None else in_units(found.covariance, unit_m)
        return Registration(T, CORRESPONDENCES, CORRESPONDENCES, None, covariance)


def read_recorded(path: Path) -> tuple[list[str], dict[tuple[str, str], RecordedPair]]:
    """Read names of keyframes and recorded pairs.

    Raises:
        BadRecordedFile: The file is missing, damaged, has more pairs than a descriptor has entries, or a pose that is
            not rigid.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BadRecordedFile(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise BadRecordedFile(f"{path}: is not a file of recorded registrations ({FORMAT})")
    try:
        names = [str(name) for name in data["keyframes"]]
        pairs = {(str(entry["query"]), str(entry["match"])): _pair(entry) for entry in data["pairs"]}
    except (KeyError, TypeError, ValueError) as error:
        raise BadRecordedFile(f"{path}: has a damaged entry: {error!r}") from error
    if len(pairs) > DIMENSION_MAX:
        raise BadRecordedFile(f"{path}: has {len(pairs)} pairs, more than {DIMENSION_MAX}")
    return names, pairs


def _pair(entry: dict[str, Any]) -> RecordedPair:
    T = pose_from_tq(np.array(entry["T_query_match"], dtype=float))
    if not is_rigid(T):
        raise ValueError("a pose that is not rigid")
    covariance = entry["covariance"]
    return RecordedPair(T, None if covariance is None else symmetric(np.array(covariance, dtype=float)))


def name_image(name: str) -> Image:
    """An image whose pixels hold a keyframe's name, for runs that pass images."""
    data = _named(name)
    pixels = np.frombuffer(data + bytes(3 * IMAGE_WIDTH - len(data)), np.uint8).reshape(1, IMAGE_WIDTH, 3)
    return Image(pixels, Camera(IMAGE_WIDTH, 1, 100.0, 100.0, IMAGE_WIDTH / 2, 0.5))


def _named(name: str) -> bytes:
    encoded = name.encode()
    if len(encoded) > NAME_BYTES_MAX:
        raise ValueError(f"keyframe name {name!r} is longer than {NAME_BYTES_MAX} bytes")
    return MAGIC + bytes([len(encoded)]) + encoded


def name_of(data: bytes) -> str:
    """Read a keyframe's name from pixels or from a latent.

    Raises:
        BadLatent: The bytes hold no name.
    """
    start = len(MAGIC) + 1
    if data[: len(MAGIC)] != MAGIC or len(data) < start or len(data) < start + data[len(MAGIC)]:
        raise BadLatent("the bytes hold no recorded keyframe's name")
    try:
        return data[start : start + data[len(MAGIC)]].decode()
    except UnicodeDecodeError as error:
        raise BadLatent("the recorded keyframe's name is not text") from error
