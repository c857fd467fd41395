"""A saved map on disk, for those who read it: docs/maps.md says what each file is.

    map.json             what it is: its frame, logs, camera models, front end; names and checksums of the other files
    records-HASH.bin     the logs, byte for byte as robots signed them
    solution-HASH.npz    poses, covariances, and the closures that the solution used
    latents-HASH.sqlite  latents by keyframe

Whoever saves a map writes the other files first and `map.json` last, in one step, so that there is always the old map
or the new one. Nothing here writes: the database is opened as one that nobody changes.
"""

import hashlib
import io
import json
import sqlite3
import struct
import threading
import zipfile
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from flocc_agent.core.gossip import Sealer
from flocc_agent.core.pose_graph import map_frame
from flocc_agent.core.saved_map import SavedClosure, SavedMap
from flocc_agent.geometry import poses_from_tq
from flocc_protocol.codec import Pose7
from flocc_protocol.errors import DecodeError, FloccError
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import SEALED_RECORD_BYTES_MAX

Float = NDArray[np.float64]

MAP_FORMAT = 1
MANIFEST = "map.json"
OF_MISSION = ("robots", "store", "robot.sqlite")
"""What stands in the folder of a run, of an agent, or of a store."""
LENGTH = struct.Struct("<I")
LATENT_TABLE = "CREATE TABLE latents(keyframe TEXT PRIMARY KEY, sha256 BLOB NOT NULL, data BLOB NOT NULL) WITHOUT ROWID"
UPPER = 21
"""Numbers in the upper triangle of a pose's covariance."""
QUATERNION_MIN = 1e-6
OTHER_VIEW_RATIO = 1.5
"""A lens that sees so much more or less than those of the map finds fewer places in it."""


class BadMap(FloccError):
    """A folder that is no map, or one that cannot be used here; the message names it."""


class MapPart(BaseModel):
    """Base of what `map.json` holds; keys of later versions are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class FileSum(MapPart):
    """One of the other files."""

    name: str
    bytes: int
    sha256: str


class LensModel(MapPart):
    """Intrinsics of a log's camera, pixels."""

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: float = Field(gt=0.0, allow_inf_nan=False)
    fy: float = Field(gt=0.0, allow_inf_nan=False)
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def view_ratio(self) -> float:
        """Half the width over the focal length: how wide it sees."""
        return self.width / (2.0 * self.fx)


class SavedLogEntry(MapPart):
    """One log."""

    log: str
    records: int = Field(ge=0)
    bytes: int = Field(ge=0)
    keyframes: int = Field(default=0, ge=0)
    camera: LensModel | None = None
    T_body_camera: Pose7 | None = None

    @field_validator("T_body_camera")
    @classmethod
    def _is_pose(cls, given: Pose7 | None) -> Pose7 | None:
        if given is not None and not _are_poses(np.array([given])):
            raise ValueError("T_body_camera is no pose")
        return given

    @property
    def id(self) -> LogId:
        """Its identifier."""
        return LogId.parse(self.log)


class MapFrontEnd(MapPart):
    """What descriptors and latents were made by."""

    method: str | None = None
    model: str | None = None
    dimension: int | None = None
    settings: dict[str, Any] = Field(default_factory=dict)


class MapManifest(MapPart):
    """`map.json`.

    Attributes:
        format: Of this folder.
        name: For people.
        edition: 1 for a new map; one more each time a team that worked in it saved it anew.
        frame: Name of the map frame, which keeps it.
        made_by: Version of flocc.
        swarm: Name of the swarm that made it, as far as it is known.
        signed: Records carry their writers' signatures.
        front_end: What made descriptors and latents.
        back_end: Configuration by which its solution was made.
        logs: In the order of the file of records; those with poses first, the anchor at the head.
        poses: How many of the logs have poses.
        latents: How many keyframes have a latent.
        pruned: Latents were left out on purpose, and such keyframes are no candidates.
        closures: How many the solution used.
        left_out: Logs of the swarm that are not part of it, with the reason.
        contradicted: Keyframes that several logs contradict, and which.
        records: File of the logs.
        solution: File of the solution.
        latent_file: File of the latents.
    """

    format: int
    kind: Literal["flocc map"] = "flocc map"
    name: str
    edition: int = Field(default=1, ge=1)
    frame: str
    made_by: str = ""
    swarm: str | None = None
    signed: bool = False
    front_end: MapFrontEnd = MapFrontEnd()
    back_end: dict[str, Any] = Field(default_factory=dict)
    logs: tuple[SavedLogEntry, ...]
    poses: int
    latents: int = 0
    pruned: bool = False
    closures: int = 0
    left_out: dict[str, str] = Field(default_factory=dict)
    contradicted: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    records: FileSum
    solution: FileSum
    latent_file: FileSum


class MapFolder:
    """A map that was opened for reading; `MapFolder.open` gives one."""

    def __init__(self, path: Path, manifest: MapManifest) -> None:
        self.path = path
        self.manifest = manifest
        self._lock = threading.Lock()
        self._latents: sqlite3.Connection | None = None

    @classmethod
    def open(cls, path: Path) -> "MapFolder":
        """Read a map's manifest, and check that its files are there.

        Raises:
            BadMap: It is no map, of another version, or cut off.
        """
        manifest = read_manifest(path)
        for each in (manifest.records, manifest.solution, manifest.latent_file):
            _check_size(path, each)
        return cls(path, manifest)

    def close(self) -> None:
        """Close the database; safe to call twice."""
        with self._lock:
            if self._latents is not None:
                self._latents.close()
                self._latents = None

    def check_whole(self) -> None:
        """Read all of it, latents too, and see that it is what was saved.

        Raises:
            BadMap: A file was altered, or does not fit the others.
        """
        _ = self.records, self.solution
        _check_sum(self.path, self.manifest.latent_file)
        count = len(self.latent_keyframes())
        if count != self.manifest.latents:
            file = self.path / self.manifest.latent_file.name
            raise BadMap(f"{file}: holds {count} latents, and {self.manifest.latents} were saved")

    # Logs

    @cached_property
    def records(self) -> dict[LogId, tuple[bytes, ...]]:
        """The records of every log, as their writers signed them.

        Raises:
            BadMap: The file was altered, or is not as long as the manifest says.
        """
        file = self.path / self.manifest.records.name
        data = _checked(self.path, self.manifest.records)
        found: dict[LogId, tuple[bytes, ...]] = {}
        offset = 0
        for entry in self.manifest.logs:
            records = []
            for _ in range(entry.records):
                if offset + LENGTH.size > len(data):
                    raise BadMap(f"{file}: ends within log {entry.log}; it does not fit {MANIFEST}")
                (length,) = LENGTH.unpack_from(data, offset)
                if length > SEALED_RECORD_BYTES_MAX:
                    raise BadMap(f"{file}: holds a record that no robot wrote")
                records.append(data[offset + LENGTH.size : offset + LENGTH.size + length])
                offset += LENGTH.size + length
            found[entry.id] = tuple(records)
        if offset != len(data):
            raise BadMap(f"{file}: does not end where its last log does; it does not fit {MANIFEST}")
        return found

    def closed(self) -> frozenset[LogId]:
        """All its logs."""
        return frozenset(entry.id for entry in self.manifest.logs)

    def check_keys(self, sealer: Sealer | None) -> None:
        """Whether this swarm would believe the map's logs, by the first record of each.

        Raises:
            BadMap: It would not.
        """
        if self.manifest.signed and sealer is None:
            raise BadMap(f"{self.path}: its logs are signed, and this swarm has no keys")
        if sealer is None:
            return
        for log, records in self.records.items():
            try:
                if records:
                    sealer.opened(log, 0, records[0])
            except DecodeError as error:
                raise BadMap(f"{self.path}: is of a swarm with other keys: log {log}: {error}") from error

    def check_front_end(self, method: str | None, model: str) -> None:
        """Whether a front end can compare and register its own keyframes with those of the map.

        Raises:
            BadMap: It cannot.
        """
        made = self.manifest.front_end
        if None not in (made.method, method) and made.method != method:
            raise BadMap(f"{self.path}: was made with perception.method {made.method!r}, and this is {method!r}")
        if made.model is not None and made.model != model:
            raise BadMap(f"{self.path}: its latents are of {made.model!r}, and this front end makes {model!r}")

    def other_lens(self, camera: LensModel) -> str | None:
        """A sentence where a lens sees much more or less than those of the map; None where one is alike."""
        known = [entry.camera for entry in self.manifest.logs if entry.camera is not None]
        ratios = [camera.view_ratio() / each.view_ratio() for each in known]
        if not ratios or any(1 / OTHER_VIEW_RATIO <= ratio <= OTHER_VIEW_RATIO for ratio in ratios):
            return None
        degrees = [np.degrees(2 * np.arctan(lens.view_ratio())) for lens in (known[0], camera)]
        return (
            f"{self.path}: was taken by lenses of {degrees[0]:.0f} degrees and this one has {degrees[1]:.0f}: "
            "fewer of its places will be found again"
        )

    # Latents

    def latent(self, keyframe: KeyframeId) -> bytes | None:
        """A latent; None where the map has none, or a damaged one."""
        for sha256, data in self._read("SELECT sha256, data FROM latents WHERE keyframe = ?", (str(keyframe),)):
            if isinstance(data, bytes) and hashlib.sha256(data).digest() == sha256:
                return data
        return None

    def latent_keyframes(self) -> list[KeyframeId]:
        """Keyframes that have one, sorted.

        Raises:
            BadMap: The file was altered.
        """
        try:
            return sorted(KeyframeId.parse(name) for (name,) in self._read("SELECT keyframe FROM latents"))
        except (ValueError, TypeError) as error:
            raise BadMap(f"{self.path / self.manifest.latent_file.name}: names a keyframe: {error}") from error

    def _read(self, query: str, parameters: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        path = self.path / self.manifest.latent_file.name
        try:
            with self._lock:
                if self._latents is None:
                    uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
                    self._latents = sqlite3.connect(uri, uri=True, check_same_thread=False)
                return self._latents.execute(query, parameters).fetchall()
        except sqlite3.Error as error:
            raise BadMap(f"{path}: cannot be read: {error}") from error

    # Solution

    @cached_property
    def solution(self) -> Mapping[str, NDArray[Any]]:
        """Arrays of the solution, by name.

        Raises:
            BadMap: The file was altered, or does not fit the manifest.
        """
        file = self.path / self.manifest.solution.name
        data = _checked(self.path, self.manifest.solution)
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                found = {name: arrays[name] for name in arrays.files}
        except (ValueError, OSError, EOFError, KeyError, AttributeError, zipfile.BadZipFile) as error:
            raise BadMap(f"{file}: cannot be read: {error}") from error
        unfit = _unfit(found, self.manifest.poses)
        if unfit is not None:
            raise BadMap(f"{file}: does not fit the map: its {unfit} are not what a map has")
        return found

    def poses(self) -> dict[LogId, Float]:
        """Camera poses (N, 4, 4) of each log that has some, the anchor first."""
        entries = self.manifest.logs[: self.manifest.poses]
        return {entry.id: poses_from_tq(self.solution[f"poses{k}"]) for k, entry in enumerate(entries)}

    def covariances(self) -> dict[LogId, NDArray[np.float32]]:
        """Upper triangles (N, 21) of the marginal covariance of each camera pose, NaN where there is none."""
        entries = self.manifest.logs[: self.manifest.poses]
        return {entry.id: self.solution[f"covariances{k}"] for k, entry in enumerate(entries)}

    def used_closures(self) -> dict[tuple[KeyframeId, KeyframeId], SavedClosure]:
        """The closures of the solution."""
        logs = [entry.id for entry in self.manifest.logs]
        ends, values = self.solution["closures"].tolist(), self.solution["closure_values"].tolist()
        return {
            (KeyframeId(logs[q], i), KeyframeId(logs[m], j)): SavedClosure(scale if scale > 0 else None, weight)
            for (q, i, m, j), (scale, weight) in zip(ends, values, strict=True)
        }

    def saved(self, is_fixed: bool = False) -> SavedMap:
        """The map as the core takes it.

        Raises:
            BadMap: The solution does not fit the logs.
        """
        try:
            poses = self.poses()
            weights = {
                KeyframeId.parse(keyframe): 1.0 / (1 + len(logs))
                for keyframe, logs in self.manifest.contradicted.items()
            }
            return SavedMap(tuple(poses), self.closed(), poses, self.used_closures(), is_fixed, weights)
        except (KeyError, IndexError, ValueError) as error:
            raise BadMap(f"{self.path / self.manifest.solution.name}: does not fit the map: {error}") from error


def longer_copy(one: tuple[bytes, ...], other: tuple[bytes, ...]) -> tuple[bytes, ...] | None:
    """The longer of two copies of a log; None where neither is the other's beginning."""
    both = min(len(one), len(other))
    return max(one, other, key=len) if one[:both] == other[:both] else None


def read_manifest(path: Path) -> MapManifest:
    """Read `map.json`.

    Raises:
        BadMap: There is none, or it is cut off, of another format, or names a file elsewhere.
    """
    file = path / MANIFEST
    if not path.is_dir():
        raise BadMap(f"{path}: is not a folder")
    if not file.is_file() and any((path / part).exists() for part in OF_MISSION):
        raise BadMap(f"{path}: is of a mission and no map yet: flocc map save {path} --out FOLDER makes one of it")
    if not file.is_file():
        raise BadMap(f"{path}: has no {MANIFEST}: it is no map, or saving it did not end")
    try:
        fields = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BadMap(f"{file}: is cut off or not JSON: {error}") from error
    if not isinstance(fields, dict) or fields.get("kind") != "flocc map":
        raise BadMap(f"{file}: is not of a flocc map")
    if fields.get("format") != MAP_FORMAT:
        raise BadMap(f"{file}: is of format {fields.get('format')!r}, and this flocc reads {MAP_FORMAT}")
    try:
        manifest = MapManifest.model_validate(fields)
        ids = [entry.id for entry in manifest.logs]
        manifest.model_dump_json()  # a text that could not be written again
    except (ValidationError, ValueError) as error:
        said = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise BadMap(f"{file}: cannot be used: {said}") from error
    if not 1 <= manifest.poses <= len(ids) or len(set(ids)) != len(ids):
        raise BadMap(f"{file}: lists its logs twice, or none with poses")
    if manifest.frame != map_frame(ids[0]):
        raise BadMap(f"{file}: is of frame {manifest.frame!r}, and its first log is of {map_frame(ids[0])!r}")
    for each in (manifest.records, manifest.solution, manifest.latent_file):
        if Path(each.name).name != each.name:
            raise BadMap(f"{file}: names a file elsewhere: {each.name[:80]!r}")
    return manifest


def _check_size(path: Path, of: FileSum) -> None:
    file = path / of.name
    if not file.is_file():
        raise BadMap(f"{file}: is missing; the map is not whole")
    if file.stat().st_size != of.bytes:
        raise BadMap(f"{file}: has {file.stat().st_size} bytes, and {of.bytes} were saved: it is cut off or altered")


def _are_poses(rows: NDArray[Any]) -> bool:
    """Whether rows (N, 7) are finite positions and quaternions that have a direction."""
    finite = rows.ndim == 2 and rows.shape[1] == 7 and rows.dtype.kind == "f" and bool(np.isfinite(rows).all())
    return finite and bool((np.abs(rows[:, 3:]).max(axis=1, initial=0.0) > QUATERNION_MIN).all())


def _unfit(arrays: Mapping[str, NDArray[Any]], logs: int) -> str | None:
    """Name of the first array of a solution that is missing or of another shape; None where all fit."""
    lengths = []
    for k in range(logs):
        poses, covariances = arrays.get(f"poses{k}"), arrays.get(f"covariances{k}")
        if poses is None or not _are_poses(poses):
            return f"poses{k}"
        if covariances is None or covariances.shape != (len(poses), UPPER) or covariances.dtype.kind != "f":
            return f"covariances{k}"
        lengths.append(len(poses))
    ends, values = arrays.get("closures"), arrays.get("closure_values")
    if ends is None or ends.ndim != 2 or ends.shape[1] != 4 or ends.dtype.kind != "i":
        return "closures"
    of, at = ends[:, [0, 2]], ends[:, [1, 3]]
    if bool(((of < 0) | (of >= logs)).any()) or bool(((at < 0) | (at >= np.array(lengths)[of])).any()):
        return "closures"
    if values is None or values.shape != (len(ends), 2) or not bool(np.isfinite(values).all()):
        return "closure_values"
    return None


def _check_sum(path: Path, of: FileSum) -> None:
    """Whether a file that is too large to hold is what was saved."""
    try:
        with (path / of.name).open("rb") as file:
            digest = hashlib.file_digest(file, "sha256")
    except OSError as error:
        raise BadMap(f"{path / of.name}: cannot be read: {error.strerror}") from error
    if digest.hexdigest() != of.sha256:
        raise BadMap(f"{path / of.name}: is not what was saved: its checksum is another one")


def _checked(path: Path, of: FileSum) -> bytes:
    """A file's content, if it is what was saved."""
    try:
        data = (path / of.name).read_bytes()
    except OSError as error:
        raise BadMap(f"{path / of.name}: cannot be read: {error.strerror}") from error
    if hashlib.sha256(data).hexdigest() != of.sha256:
        raise BadMap(f"{path / of.name}: is not what was saved: its checksum is another one")
    return data
