"""What an agent says of itself to whoever asks: its own program, the launcher, an operator.

It travels as JSON, so it is checked where it is read; what a reader does not know it ignores, what an older agent does
not say has its default.
"""

from pydantic import BaseModel, ConfigDict


class StageBrief(BaseModel):
    """How long one stage of the work took."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    count: int = 0
    median_s: float = 0.0
    p90_s: float = 0.0
    max_s: float = 0.0


class CameraStatus(BaseModel):
    """What a robot doubts of its own camera, as `CameraDoubted` tells it."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    doubt: str
    amount: float = 1.0
    where: str = ""
    pairs: int = 0
    withheld: bool = False


class AgentStatus(BaseModel):
    """What one robot does now.

    Attributes:
        t: Seconds since the start of the run.
        robot: Its name.
        log: The log that it writes, NAME or NAME#INCARNATION.
        leader: Robot that it follows or that it is, None while there is none.
        term: Counter of that leader's term.
        role: What it is doing about leadership.
        neighbours: Robots in range.
        keyframes: Keyframes in its own log.
        closures: Loop closures in all logs that it holds.
        candidates: Pairs that it is to register and can.
        map_frame: Frame of the correction that it applied, None before the first.
        round: Round of that correction.
        logs: Log -> (records held, chained checksum).
        sent_bytes: Payload sent, a broadcast once.
        received_bytes: Payload that reached it.
        loss: Neighbour -> share of its last heartbeats that did not arrive.
        queues: What waits: events, images, candidates.
        sizes: Queue, table or cache -> (how much is in it, its maximum).
        heartbeat_gap_s: Longest time lately between two heartbeats, own ("sent") and of a neighbour ("heard").
        links: Table of traffic -> peer -> payload bytes.
        stages: Stage of the work -> how long it took.
        refused: Reason -> messages refused or dropped.
        busy: Images, fetches, registrations or rounds are under way, or its recording goes on.
        playing: Its recording goes on.
        disk_failure: Why it can no longer write to its disk, None while it can.
        doubles: Names under which it heard two robots, its own among them.
        in_map: Whether it has found itself in the map that it opened, a sentence; None where it opened none.
        camera: What it doubts of its camera, the latest of each kind.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    t: float = 0.0
    robot: str
    log: str = ""
    leader: str | None = None
    term: int | None = None
    role: str = ""
    neighbours: tuple[str, ...] = ()
    keyframes: int = 0
    closures: int = 0
    candidates: int = 0
    map_frame: str | None = None
    round: int | None = None
    logs: dict[str, tuple[int, int]] = {}
    sent_bytes: int = 0
    received_bytes: int = 0
    loss: dict[str, float] = {}
    queues: dict[str, int] = {}
    sizes: dict[str, tuple[int, int]] = {}
    heartbeat_gap_s: dict[str, float] = {}
    links: dict[str, dict[str, int]] = {}
    stages: dict[str, StageBrief] = {}
    refused: dict[str, int] = {}
    busy: bool = False
    playing: bool = False
    disk_failure: str | None = None
    in_map: str | None = None
    doubles: tuple[str, ...] = ()
    camera: tuple[CameraStatus, ...] = ()


class PairStatus(BaseModel):
    """What came of the pairs of keyframes of two robots, as the logs that one robot holds tell.

    Attributes:
        robots: The two, sorted.
        accepted: Pairs that became closures.
        rejected: Pairs that were registered, or given up, and refused.
        best_ratio: Best match ratio of those that were refused, Eq. (1).
        reason: Why the best one was refused.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    robots: tuple[str, str]
    accepted: int = 0
    rejected: int = 0
    best_ratio: float | None = None
    reason: str | None = None


class SolverStatus(BaseModel):
    """What the last solution that a robot made used and warned of.

    Attributes:
        components: Robots of each part that closures join.
        closures_used: Closures that the solver kept.
        closures_rejected: All others.
        warnings: Its first sentences.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    components: list[list[str]] = []
    closures_used: int = 0
    closures_rejected: int = 0
    warnings: list[str] = []


class MergeStatus(BaseModel):
    """What a robot can tell an operator who asks why maps have not merged.

    Attributes:
        best_similarities: Robot -> best similarity of its keyframes with one of this robot, below the threshold too.
        similarity_threshold: Of place recognition.
        match_ratio_threshold: R_thr.
        pairs: By two robots.
        solver: Of the last own solution, None where it made none.
        emulated: What of its radio is emulated, in words; None where messages come as the network brings them.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    best_similarities: dict[str, float] = {}
    similarity_threshold: float | None = None
    match_ratio_threshold: float | None = None
    pairs: list[PairStatus] = []
    solver: SolverStatus | None = None
    emulated: str | None = None
