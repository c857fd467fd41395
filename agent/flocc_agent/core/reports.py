"""What a robot tells people: facts, each a frozen dataclass that is the same from the core to the report's reader.

The core wraps a fact in the effect `Report`; the driver writes it as one line of `events.jsonl`
(`runtime/event_lines.py`), and whoever reads the line gets the same class. The name given to `fact` is the line's
`event`, and its other keys are the fields: to rename one of them is to lose it in runs of older versions. Fields are
numbers, texts, identifiers, poses, and tuples or mappings of these. Nothing in the core reads a fact: what people are
told changes no robot's behaviour.
"""

from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, TypeVar, cast, dataclass_transform

from flocc_protocol.codec import Pose7
from flocc_protocol.ids import KeyframeId, LogId, Term


class Fact(Protocol):
    """Any class that `fact` registered."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


T = TypeVar("T")

_kinds: dict[str, type[Fact]] = {}
_names: dict[type, str] = {}
KINDS: Mapping[str, type[Fact]] = MappingProxyType(_kinds)
"""Every kind of fact by its name in `events.jsonl`; complete once the modules that define facts are imported."""


@dataclass_transform(frozen_default=True, kw_only_default=True)
def fact(name: str) -> Callable[[type[T]], type[T]]:
    """Make a class a fact that stands in `events.jsonl` under this name; its fields are given by keyword.

    Raises:
        ValueError: Another class has this name.
    """

    def register(cls: type[T]) -> type[T]:
        if name in _kinds:
            raise ValueError(f"{_kinds[name].__name__} is told as {name!r} already")
        made: type[T] = dataclass(frozen=True, slots=True, kw_only=True)(cls)
        _kinds[name], _names[made] = cast(type[Fact], made), name
        return made

    return register


def name_of(told: Fact) -> str:
    """The name of a fact's kind."""
    return _names[type(told)]


# Keyframes and pairs


@fact("keyframe")
class KeyframeTaken:
    """A keyframe has its record.

    Attributes:
        keyframe: Which one.
        stamp_s: Of its image, on the robot's clock.
        T_odom_body: The core, and who only listens to robots, know no body beside the camera and give the camera's
            pose; the driver, which knows where the camera sits, gives the body's.
    """

    keyframe: KeyframeId
    stamp_s: float
    T_odom_body: Pose7


@fact("encoding_failed")
class EncodingFailed:
    """A keyframe has no descriptor or latent."""

    keyframe: KeyframeId
    reason: str


CAME_APART = "they come apart instead of agreeing on the poses that they share, and go back to where they agreed"
WITHHELD = "the camera's axes are not those of its odometry, so closures would misplace the robot"
"""Why such a camera's keyframes are not encoded."""


@fact("camera_doubted")
class CameraDoubted:
    """A robot's own pictures contradict its odometry, its calibration, or each other.

    Attributes:
        doubt: "focal length", "mounting", "focal length and mounting", "mirrored", "inverted poses", "mixed frames",
            "overlay" (what moves with the camera), "frozen" (pictures that were taken before) or "standing" (pictures
            that show what one before did, though odometry goes on).
        amount: True focal length over the configured one; degrees of a mounting; share of an overlay in the picture;
            number of pictures that are frozen, or stand; 1 elsewhere.
        where: An overlay's place in the picture, or the turn about the camera's axes; else empty.
        pairs: Of consecutive keyframes that say so.
        withheld: Whether the robot offers no keyframe for closures as long as its pictures say so.
    """

    doubt: str
    amount: float
    where: str
    pairs: int
    withheld: bool = False


@fact("candidate")
class CandidateFound:
    """Two keyframes look alike."""

    query: KeyframeId
    match: KeyframeId
    similarity: float


@fact("closure_accepted")
class ClosureAccepted:
    """A candidate was registered and reached R_thr.

    Attributes:
        query: As registered.
        match: The other keyframe.
        correspondences: Of the pair.
        odometry_correspondences: Of the query and its neighbour.
        ratio: Of both, Eq. (1).
        by: The robot that registered them.
        scale_initial: Metres per network unit, None where the registration gave none.
        probability: Of Eq. (2); the driver, which knows k, adds it.
    """

    query: KeyframeId
    match: KeyframeId
    correspondences: int
    odometry_correspondences: int
    ratio: float
    by: str | None = None
    scale_initial: float | None = None
    probability: float | None = None


@fact("closure_withdrawn")
class ClosureWithdrawn:
    """A closure does not count: a robot took one of its keyframes back, as `CameraDoubted` says why.

    Attributes:
        query: As registered.
        match: The other one.
        again: Whether the pair is registered once more, with what was made anew.
    """

    query: KeyframeId
    match: KeyframeId
    again: bool


@fact("closure_rejected")
class ClosureRejected:
    """A candidate was not made a closure; counts and ratio as in `ClosureAccepted`, None where there was no pair."""

    query: KeyframeId
    match: KeyframeId
    correspondences: int | None = None
    odometry_correspondences: int | None = None
    ratio: float | None = None
    by: str | None = None
    reason: str


# Measurements


@fact("measured")
class MeasurementKept:
    """Something measured besides keyframes has its record.

    Attributes:
        kind: Such as `fix` or `tag`.
        keyframe: To which it belongs.
        of: The tag or robot that was seen, empty where there is none.
    """

    kind: str
    keyframe: KeyframeId
    of: str


@fact("measurement_refused")
class MeasurementRefused:
    """Something measured cannot be kept."""

    kind: str
    keyframe: KeyframeId
    reason: str


# Latents


@fact("latent_fetched")
class LatentArrived:
    """A latent that a candidate needs has arrived."""

    keyframe: KeyframeId
    holder: str | None = None


@fact("latent_failed")
class LatentFailed:
    """A latent that a candidate needs could not be fetched this time."""

    keyframe: KeyframeId
    holder: str | None = None
    reason: str


@fact("latent_lost")
class LatentLost:
    """A latent that candidates need exists no more."""

    keyframe: KeyframeId


@fact("log_given_up")
class LogGivenUp:
    """A log to which nothing refers, and of which nothing new came for an hour, made room for another one."""

    log: LogId


# Leadership


@fact("leader")
class LeaderFollowed:
    """This robot now follows, or is, the leader of a term."""

    term: int
    leader: str
    leader_log: LogId | None = None


@fact("leader_lost")
class LeaderLost:
    """This robot's leader fell silent or left; it follows nobody until the next `LeaderFollowed`."""

    term: Term | None = None
    reason: str | None = None


# Neighbours


@fact("neighbour_up")
class NeighbourUp:
    """Heartbeats of a peer arrive."""

    peer: str
    log: LogId | None = None


@fact("neighbour_down")
class NeighbourDown:
    """Heartbeats of a peer stopped."""

    peer: str


@fact("neighbour_restarted")
class NeighbourRestarted:
    """A peer was started again."""

    peer: str
    log: LogId


@fact("peer_refused")
class PeerRefused:
    """Something of a peer that this robot does not take."""

    peer: str
    reason: str


@fact("front_ends_differ")
class FrontEndsDiffer:
    """Another robot's latents cannot be registered with this one's; they are fetched no more."""

    peer: str


@fact("duplicate_name")
class NameTaken:
    """Two robots run with one name."""

    peer: str
    log: LogId | None = None
    reason: str


@fact("log_forked")
class LogForked:
    """A peer holds records of a log that contradict those held here."""

    peer: str
    log: LogId
    reason: str


# Optimisation


@fact("optimised")
class RoundSolved:
    """This robot, as leader, solved the pose graph.

    Attributes:
        term: Counter of its term.
        leader: Its name.
        round: Number of the round in that term.
        components: Logs of each part that closures join.
        keyframes: In all parts.
        closures_used: Closures that the solver kept.
        closures_rejected: Closures that it threw out.
        closures_excluded: Closures that it could not take in.
        measured_used: Other measurements that it kept.
        measured_not_used: Other measurements that it threw out or could not take in.
        cost: What is left of all residuals.
        solve_s: How long it took.
        odometry_scales: Robot -> measured over true length of its odometry, estimated; 1 where it is true.
        warnings: Sentences of the solver.
    """

    term: int
    leader: str | None = None
    round: int
    components: tuple[tuple[LogId, ...], ...] = ()
    keyframes: int | None = None
    closures_used: int | None = None
    closures_rejected: int | None = None
    closures_excluded: int | None = None
    measured_used: int | None = None
    measured_not_used: int | None = None
    cost: float | None = None
    solve_s: float | None = None
    odometry_scales: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


@fact("optimisation_failed")
class RoundFailed:
    """The solver gave nothing, or a part of it cannot be published; the last good solution stands."""

    term: Term
    round: int
    reason: str


@fact("round_timeout")
class RoundTimedOut:
    """A round took longer than it may; it is tried again."""

    term: Term
    round: int


@fact("map_opened")
class MapOpened:
    """A robot began with a saved map: its frame and logs, how many keyframes it has, and whether it is fixed."""

    map_frame: str
    logs: tuple[LogId, ...]
    keyframes: int
    is_fixed: bool


@fact("found_in_map")
class FoundInMap:
    """A robot's first correction in the frame of the map that it opened: so long after its start and first keyframe."""

    map_frame: str
    keyframes: int
    after_start_s: float
    after_keyframe_s: float


@fact("map_log_written")
class MapLogWritten:
    """A robot in range writes a log of the opened map, which nobody should write any more."""

    peer: str
    log: LogId


@fact("stale_solution")
class SolutionIgnored:
    """A solution came after its round was given up."""

    term: Term
    round: int


@fact("part")
class PartMoved:
    """Where this robot's own part stands, in distributed optimisation.

    Attributes:
        step: Steps that it made.
        anchor: Log whose frame its poses are in.
        neighbours: Robots with which it agrees on poses in that frame.
        shared_poses: Poses that it shares with others.
        cost: Of what it owns, None before the first step.
        moved: Largest change of a number of a pose in the last step: metres, or entries of a rotation.
        gap: Largest difference from where neighbours have the shared poses.
        closures_used: Closures that it owns and uses.
        keyframes: In its part.
    """

    step: int
    anchor: LogId
    neighbours: int
    shared_poses: int
    cost: float | None
    moved: float | None
    gap: float | None
    closures_used: int
    keyframes: int


@fact("correction")
class CorrectionApplied:
    """This robot applied a correction.

    Attributes:
        term: Counter of the term of the leader that made it.
        leader: Its name.
        round: Number of the round in that term.
        map_frame: Frame of the poses.
        frame_changed: It is another one than before.
        T_map_odom: Of the newest keyframe and all later ones.
        knots: Numbers of some of the robot's keyframes, growing; the last one that was solved for is among them.
        T_map_body: Where they lie; bodies and cameras as in `KeyframeTaken`.
    """

    term: int
    leader: str | None = None
    round: int
    map_frame: str
    frame_changed: bool = False
    T_map_odom: Pose7
    knots: tuple[int, ...] = ()
    T_map_body: tuple[Pose7, ...] = ()
