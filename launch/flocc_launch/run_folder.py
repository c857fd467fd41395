"""The folder of one run: what the drivers write into it, and typed readers for it.

    run.json                    who ran, on what, with which settings and seed
    events.jsonl                what happened, one JSON object per line, sorted by time, all robots together
    robots/ROBOT/result.json    what a robot knew at its end

`flocc_launch.report.finish` adds the rest. Readers ignore keys that they do not know, so that a driver may
write more; a key that is missing, torn or of another type is a `RunFolderError` that names the file.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from flocc_agent.geometry import pose_from_tq
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]


def with_direction(pose7: list[float]) -> list[float]:
    """Return seven numbers of a pose, or say that their quaternion is none."""
    if abs(sum(q * q for q in pose7[3:]) - 1.0) > QUATERNION_TOLERANCE:
        raise ValueError(f"quaternion {pose7[3:]} is not of unit length")
    return pose7


def checked_keyframe(text: str) -> str:
    """Return the text of a keyframe identifier, or say that it is none."""
    KeyframeId.parse(text)
    return text


QUATERNION_TOLERANCE = 1e-3
Keyframe = Annotated[str, AfterValidator(checked_keyframe)]
"""A keyframe as text, such as `r1/12`."""
Pose7 = Annotated[list[float], Field(min_length=7, max_length=7), AfterValidator(with_direction)]
"""Seven finite numbers: translation x y z in metres, quaternion w x y z."""

RUN_VERSION = 1


class RunFolderError(FloccError):
    """A run folder that cannot be read or written; the message names the file."""


class Record(BaseModel):
    """Base of what stands in a run folder: frozen; unknown keys are ignored; numbers are finite."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False, use_attribute_docstrings=True)


class Run(Record):
    """`run.json`: what was started."""

    version: int = RUN_VERSION
    """Version of this folder's layout."""
    scenario: str
    """Name of the scenario."""
    seed: int | None = None
    """Seed of everything that is drawn; null where nothing was seeded."""
    robots: list[str]
    """Robot names."""
    start: str | float | None = None
    """Wall clock at t = 0: ISO 8601 or Unix seconds; null on virtual time."""
    driver: Literal["launch", "simulate", "agent"] | None = None
    """What ran the agents."""
    recordings: dict[str, str] = {}
    """Robot -> folder of its recording; relative paths start at the run folder."""
    radio: dict[str, Any] = {}
    """Settings of the link model: loss, latency, bandwidth, range, as the scenario gave them."""
    settings: dict[str, Any] = {}
    """Other settings worth reading beside the result, nested as in the configuration."""
    expectations: dict[str, float] = {}
    """Expectation -> limit, of the scenario."""
    duration_s: float | None = None
    """End of the run on the clock of `events.jsonl`; null where the last event is the end."""
    wall_s: float | None = None
    """Wall time that the run took; null where nobody measured it."""


def setting_number(settings: Mapping[str, Any], name: str) -> float | None:
    """The number that stands under a name at any depth of nested settings; None where there is none."""
    for key, value in settings.items():
        if key == name and isinstance(value, int | float):
            return float(value)
        found = setting_number(value, name) if isinstance(value, dict) else None
        if found is not None:
            return found
    return None


class Event(Record):
    """One line of `events.jsonl`; the subclasses are the kinds of event."""

    t: float
    """Seconds since the run started, on the run's clock (virtual or real)."""
    robot: str
    """The robot that it happened on."""
    event: str
    """Kind of event."""


class KeyframeCaptured(Event):
    """`keyframe`: a robot took a keyframe."""

    keyframe: Keyframe
    stamp_s: float
    T_odom_body: Pose7


class CandidateFound(Event):
    """`candidate`: two keyframes look alike."""

    query: Keyframe
    match: Keyframe
    similarity: float


class ClosureAccepted(Event):
    """`closure_accepted`: a candidate was registered and passed R_thr."""

    query: Keyframe
    match: Keyframe
    ratio: float
    probability: float
    correspondences: int
    odometry_correspondences: int
    scale_initial: float | None = None
    by: str | None = None


class ClosureRejected(Event):
    """`closure_rejected`: a candidate was not made a closure."""

    query: Keyframe
    match: Keyframe
    ratio: float | None = None
    reason: str


class LeaderFollowed(Event):
    """`leader`: this robot now follows (or is) the leader of a term; null when it follows none."""

    term: int | str | None
    leader: str | None


class LeaderLost(Event):
    """`leader_lost`: this robot's leader fell silent or left; it follows nobody until the next `leader`."""

    term: int | str | None = None
    reason: str | None = None


class NeighbourUp(Event):
    """`neighbour_up`: heartbeats of a peer arrive."""

    peer: str


class NeighbourDown(Event):
    """`neighbour_down`: heartbeats of a peer stopped."""

    peer: str


class GraphOptimised(Event):
    """`optimised`: this robot, as leader, solved the pose graph."""

    term: int | str
    round: int
    components: Any = None
    keyframes: int | None = None
    closures_used: int | None = None
    closures_rejected: int | None = None
    cost: float | None = None
    solve_s: float | None = None
    warnings: list[str] = []


class CorrectionApplied(Event):
    """`correction`: this robot applied a correction."""

    term: int | str
    round: int
    map_frame: str
    T_map_odom: Pose7
    frame_changed: bool = False


class BytesCounted(Event):
    """`bytes`: bytes by kind since the robot started; cumulative, the last one counts."""

    sent: dict[str, int]
    received: dict[str, int]


class PeerRefused(Event):
    """`peer_refused`: a peer that this robot does not talk to."""

    peer: str
    reason: str


class NameTaken(Event):
    """`duplicate_name`: two robots run with one name."""

    peer: str
    reason: str


class LatentFetched(Event):
    """`latent_fetched`: a latent that a candidate needs has arrived."""

    keyframe: Keyframe
    holder: str | None = None


class LatentFailed(Event):
    """`latent_failed`: a latent that a candidate needs could not be fetched this time."""

    keyframe: Keyframe
    holder: str | None = None
    reason: str


class EncodingFailed(Event):
    """`encoding_failed`: a keyframe has no descriptor or latent."""

    keyframe: Keyframe
    reason: str


class OptimisationFailed(Event):
    """`optimisation_failed`: the solver gave nothing; the last good solution stands."""

    term: int | str
    round: int
    reason: str


class AgentDied(Event):
    """`agent_died`: an agent ended without being asked to."""

    signal: int | str | None = None
    exit_code: int | None = None


class AgentStopped(Event):
    """`agent_stopped`: an agent ended in order."""


EVENT_TYPES: Mapping[str, type[Event]] = {
    "keyframe": KeyframeCaptured,
    "candidate": CandidateFound,
    "closure_accepted": ClosureAccepted,
    "closure_rejected": ClosureRejected,
    "leader": LeaderFollowed,
    "leader_lost": LeaderLost,
    "neighbour_up": NeighbourUp,
    "neighbour_down": NeighbourDown,
    "optimised": GraphOptimised,
    "correction": CorrectionApplied,
    "bytes": BytesCounted,
    "peer_refused": PeerRefused,
    "duplicate_name": NameTaken,
    "latent_fetched": LatentFetched,
    "latent_failed": LatentFailed,
    "encoding_failed": EncodingFailed,
    "optimisation_failed": OptimisationFailed,
    "agent_died": AgentDied,
    "agent_stopped": AgentStopped,
}


class KeyframeResult(Record):
    """One keyframe of a robot at the end of the run."""

    index: int
    stamp_s: float
    T_odom_body: Pose7
    T_map_body: Pose7 | None = None


class ClosureKnown(Record):
    """One closure in a robot's logs at the end of the run."""

    query: Keyframe
    match: Keyframe
    T_query_match_unscaled: Pose7 | None = None
    """Pose of the match camera in the query camera; the translation in network units."""
    match_ratio: float | None = None
    scale_initial: float | None = None
    metric: bool = False
    """The translation is in metres already."""
    scale: float | None = None
    """Metres per network unit after optimisation; null where the back end estimated none."""


class RobotResult(Record):
    """`robots/ROBOT/result.json`: what a robot knew at its end, or what its store held."""

    robot: str
    incarnation: int = 0
    map_frame: str | None = None
    T_map_odom: Pose7 | None = None
    T_body_camera: Pose7 | None = None
    keyframes: list[KeyframeResult] = []
    closures: list[ClosureKnown] = []
    logs: dict[str, int] = {}
    """Log -> number of its records that this robot holds."""
    best_similarities: dict[str, float] = {}
    """Robot -> best cosine similarity of any of its keyframes with one of this robot, below the threshold as well."""

    def T_odom_body(self) -> Float:
        """Odometry of all keyframes, (N, 4, 4)."""
        return stacked_poses([keyframe.T_odom_body for keyframe in self.keyframes])


def stacked_poses(rows: Iterable[list[float]]) -> Float:
    """Poses (N, 4, 4) of rows of seven numbers."""
    poses = [pose_from_tq(np.array(row)) for row in rows]
    return np.array(poses) if poses else np.zeros((0, 4, 4))


E = TypeVar("E", bound=Event)
R = TypeVar("R", bound=Record)


@dataclass(frozen=True, slots=True)
class RunFolder:
    """A run's folder on disk."""

    path: Path

    @classmethod
    def create(cls, path: Path) -> "RunFolder":
        """Make the folder for a new run.

        Raises:
            RunFolderError: It cannot be made, or it holds a run already.
        """
        if (path / "run.json").exists():
            raise RunFolderError(f"{path}: holds a run already; give another folder")
        try:
            (path / "robots").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunFolderError(f"{path}: cannot be made: {error.strerror}") from error
        return cls(path)

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """Open the folder of a run that was started.

        Raises:
            RunFolderError: There is no run in it, or one of another version.
        """
        if not path.is_dir():
            raise RunFolderError(f"{path}: is not a folder")
        if not (path / "run.json").is_file():
            raise RunFolderError(f"{path}: has no run.json, so it is not the folder of a run")
        folder = cls(path)
        version = folder.run().version
        if version != RUN_VERSION:
            raise RunFolderError(f"{path / 'run.json'}: is of version {version}, this flocc reads {RUN_VERSION}")
        return folder

    def write_run(self, run: Run) -> None:
        """Write `run.json`; call it again at the end to add what was measured."""
        write_json(self.path / "run.json", run.model_dump(mode="json"))

    def write_events(self, events: Iterable[Mapping[str, Any]]) -> None:
        """Write `events.jsonl`, sorted by time and then robot; events of one robot keep their order."""
        ordered = sorted(events, key=lambda event: (float(event["t"]), str(event["robot"])))
        lines = [json.dumps(event, allow_nan=False) + "\n" for event in ordered]
        (self.path / "events.jsonl").write_text("".join(lines), encoding="utf-8")

    def write_result(self, result: RobotResult) -> None:
        """Write `robots/ROBOT/result.json`."""
        path = self.path / "robots" / result.robot / "result.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, result.model_dump(mode="json"))

    def run(self) -> Run:
        """Read `run.json`.

        Raises:
            RunFolderError: It cannot be read.
        """
        return read_record(self.path / "run.json", Run)

    def events(self) -> list[Event]:
        """Read `events.jsonl`; a kind that this version does not know comes back as a plain `Event`.

        Raises:
            RunFolderError: The file is missing, or a line is cut off, not JSON or lacks a key.
        """
        return list(self.iterate_events())

    def iterate_events(self) -> Iterator[Event]:
        """Read `events.jsonl` line by line; as `events`."""
        path = self.path / "events.jsonl"
        for number, line in enumerate(read_text(path).splitlines(), start=1):
            yield event_from_line(line, f"{path}:{number}")

    def result(self, robot: str) -> RobotResult | None:
        """Read a robot's `result.json`; None where it left none.

        Raises:
            RunFolderError: It is there and cannot be read.
        """
        path = self.path / "robots" / robot / "result.json"
        return read_record(path, RobotResult) if path.exists() else None

    def results(self) -> dict[str, RobotResult]:
        """Read the results of all robots that left one, by name, sorted."""
        found = {robot: self.result(robot) for robot in sorted(self.run().robots)}
        return {robot: result for robot, result in found.items() if result is not None}

    def recording(self, robot: str) -> Path | None:
        """Folder of a robot's recording, or None where the run names none."""
        name = self.run().recordings.get(robot)
        return None if name is None else (self.path / name)


def of_kind(events: Iterable[Event], kind: type[E]) -> list[E]:
    """The events of one kind, in their order."""
    return [event for event in events if isinstance(event, kind)]


def event_from_line(line: str, where: str) -> Event:
    """Read one line of `events.jsonl`.

    Raises:
        RunFolderError: It is cut off, not JSON or lacks a key; the message starts with `where`.
    """
    try:
        fields = json.loads(line)
    except json.JSONDecodeError as error:
        raise RunFolderError(f"{where}: is cut off or not JSON: {error.msg}") from error
    kind = fields.get("event") if isinstance(fields, dict) else None
    return validated(fields, EVENT_TYPES.get(kind, Event) if isinstance(kind, str) else Event, where)


def validated(fields: Any, record: type[R], where: str) -> R:
    """Check decoded JSON against a record.

    Raises:
        RunFolderError: A key is missing or of another type; the message names `where` and the key.
    """
    try:
        return record.model_validate(fields)
    except ValidationError as error:
        complaint = error.errors()[0]
        key = ".".join(str(part) for part in complaint["loc"]) or "(top level)"
        raise RunFolderError(f"{where}: {key}: {complaint['msg']}") from error


def read_text(path: Path) -> str:
    """Read a text file of the folder.

    Raises:
        RunFolderError: It is missing or unreadable.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RunFolderError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def read_record(path: Path, record: type[R]) -> R:
    """Read a JSON file of the folder.

    Raises:
        RunFolderError: It is missing, cut off, not JSON, or lacks a key.
    """
    try:
        fields = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise RunFolderError(f"{path}: is cut off or not JSON: {error.msg}") from error
    return validated(fields, record, str(path))


def write_json(path: Path, fields: Any) -> None:
    """Write JSON in one step, so that no reader sees half a file."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(fields, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    partial.replace(path)
