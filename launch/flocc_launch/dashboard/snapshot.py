"""What a page or a table shows of a swarm at one moment; as JSON these classes are `state.json`."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from flocc_agent.core.reports import CameraDoubted


@dataclass(frozen=True, slots=True)
class LinkView:
    """What a robot knows of its link to a peer; None where it does not know.

    Attributes:
        hears: Whether the peer's heartbeats arrive.
        loss_ratio: Share of the peer's last heartbeats that did not arrive.
        sent_bytes: Payload to the peer.
        received_bytes: Payload of the peer.
    """

    hears: bool
    loss_ratio: float | None
    sent_bytes: int | None
    received_bytes: int | None


@dataclass(frozen=True, slots=True)
class RobotView:
    """One robot as its own events tell it.

    Attributes:
        robot: Its name.
        server: Whether it has no camera, so that it is in no map.
        state: running, silent, stopped or died.
        leader: Whom it follows or that it leads.
        term: That leader's term.
        neighbours: Whom it hears.
        links: By peer.
        queues: What waits.
        map_frame: Of its last correction.
        keyframes: That it took.
        candidates: Pairs that it found.
        camera: What it doubts of its camera, the latest of each kind.
        accepted: Pairs that it accepted.
        rejected: Pairs that it rejected.
        sent: Payload by kind of message.
        sent_bytes: Payload of all kinds.
        received_bytes: Payload of all kinds.
        last_s: When it was heard of last.
        path_m: Thinned positions x y z, in the map frame or, before the first correction, in odom.
    """

    robot: str
    server: bool
    state: str
    leader: str | None
    term: int | None
    neighbours: Sequence[str]
    links: Mapping[str, LinkView]
    queues: Mapping[str, int]
    map_frame: str | None
    keyframes: int
    candidates: int
    camera: Sequence[CameraDoubted]
    accepted: int
    rejected: int
    sent: Mapping[str, int]
    sent_bytes: int
    received_bytes: int
    last_s: float
    path_m: Sequence[Sequence[float]]


@dataclass(frozen=True, slots=True)
class MapGroup:
    """Robots in one map frame; None before their first correction."""

    frame: str | None
    robots: Sequence[str]


@dataclass(frozen=True, slots=True)
class ClosureView:
    """A closure with the places of its ends, None where they are not known."""

    query: str
    match: str
    probability: float | None
    ends_m: Sequence[Sequence[float] | None]


@dataclass(frozen=True, slots=True)
class RoundView:
    """The last optimisation; see `RoundSolved`."""

    t: float
    leader: str
    round: int
    cost: float | None
    solve_s: float | None
    closures_used: int | None
    closures_rejected: int | None
    warnings: Sequence[str]


@dataclass(frozen=True, slots=True)
class Said:
    """An event as a sentence."""

    t: float
    robot: str
    text: str


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A swarm at one moment.

    Attributes:
        scenario: Of the run, or the swarm's name.
        seen_by: The robot whose view this is; None where all robots' events are known.
        t: Seconds since the start of the run.
        running: Whether it goes on.
        robots: All, by name.
        maps: Robots by map frame; those without one last.
        ranges: Groups of robots that hear each other, over others as well; two groups are a partition.
        leaders: Whom living robots follow.
        closures: Accepted ones.
        optimised: The last round, None before the first.
        recent: What was said last, newest first.
    """

    scenario: str
    seen_by: str | None
    t: float
    running: bool
    robots: Sequence[RobotView]
    maps: Sequence[MapGroup]
    ranges: Sequence[Sequence[str]]
    leaders: Sequence[str]
    closures: Sequence[ClosureView]
    optimised: RoundView | None
    recent: Sequence[Said]

    def as_json(self) -> dict[str, Any]:
        """Plain values, for `json.dumps`."""
        return asdict(self)
