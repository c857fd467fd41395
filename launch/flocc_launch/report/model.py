"""`report.json` as types. A value that is not known is null; `schema_version` grows when a key changes meaning.

The keys that other programs rely on stand in DESIGN.md section 8, all of them in docs/report.md.
"""

from pydantic import Field

from flocc_agent.runtime.robot_result import Record

SCHEMA_VERSION = 1


class Closures(Record):
    """Pairs of keyframes, each pair counted once."""

    accepted: int
    """Pairs that some robot registered and accepted."""
    rejected: int
    """Candidate pairs that were registered, or given up, and not accepted by anybody."""
    accepted_inter_robot: int
    """Accepted pairs of two robots."""
    candidates: int
    """Pairs whose descriptors were similar enough."""
    rejected_by_reason: dict[str, int]
    """Reason -> rejected pairs."""
    used: int | None
    """Closures that the last optimisation used."""
    rejected_by_solver: int | None
    """Closures that the last optimisation rejected as outliers."""


class Span(Record):
    """A time from its beginning to its end."""

    from_s: float
    to_s: float


class LeaderSpan(Record):
    """One term: who led, and from the first robot that followed to the last one that stopped."""

    term: int | str | None
    leader: str
    from_s: float
    to_s: float


class Expectation(Record):
    """One expectation of the scenario."""

    name: str
    limit: float | str
    value: float | str | None
    met: bool | None
    """Null where it could not be measured."""


class TrackError(Record):
    """Errors of one robot's trajectory, of keyframes with ground truth only."""

    ate_m: float | None
    """Translation RMSE after this robot's own SE(3) alignment; `evo_ape tum --align` gives the same."""
    rpe_translation_m: float | None
    """RMSE of the motion from one keyframe to the next."""
    rpe_rotation_deg: float | None
    """RMSE of the turn from one keyframe to the next."""


class RobotReport(Record):
    """One robot at the end of the run."""

    robot: str
    incarnation: int | None
    end: str | None
    """'stopped', 'died' or null where nobody saw its end."""
    ended_s: float | None
    """When it stopped or died."""
    keyframes: int
    keyframes_with_ground_truth: int
    path_length_m: float
    map_frame: str | None
    corrections: int
    """Corrections that it applied."""
    server: bool = False
    """It has no camera, so that it takes no keyframes and is in no map."""
    frame_changes: int
    """Times that its map frame changed under it."""
    logs: dict[str, int]
    """Log -> records that it holds."""
    corrected: TrackError
    odometry: TrackError


class RobotBytes(Record):
    """Bytes of one robot by kind of message."""

    sent: dict[str, int]
    received: dict[str, int]


class KindBytes(Record):
    """One kind of message on one link."""

    sent: int | None
    received: int | None


class LinkBytes(Record):
    """Payload bytes from one robot to another, as both counted them; null where the robot left no account."""

    sender: str
    receiver: str
    sent: int | None
    """Counted by the sender; a broadcast counts on every link that it had then."""
    received: int | None
    """Counted by the receiver."""
    lost: int | None
    """Counted by the receiver: arrived, but the emulated radio or a limit kept it from the robot."""
    repeated: int | None
    """Counted by the receiver: copies that the emulated radio made; they are part of `received`."""
    unaccounted: int | None
    """sent + repeated - received - lost: lost by the real network, or on its way at the end."""
    by_kind: dict[str, KindBytes]


class StageTime(Record):
    """How long one stage of the work took."""

    count: int
    total_s: float
    median_s: float
    """Within its bucket by straight line, as is `p90_s`."""
    p90_s: float
    max_s: float
    counts: list[int]
    """Per bucket of `stage_bounds_s`, and one more for what took longer."""


class Optimisations(Record):
    """What the leaders' solvers did."""

    rounds: int
    cost: float | None
    """Cost of the last one."""
    solve_s_max: float | None
    """Longest one."""


class RunReport(Record):
    """`report.json`."""

    schema_version: int = SCHEMA_VERSION
    flocc_version: str
    scenario: str
    driver: str | None
    seed: int | None
    start: str | float | None
    duration_s: float
    """Length of the run on its own clock."""
    wall_s: float | None
    robots: list[str]
    odometry_made: dict[str, str] = Field(default_factory=dict)
    """Robot -> how its odometry was made of ground truth, where its data set had none."""
    map_frames: list[str]
    """Frames of the robots that lived to the end, each named once; a robot that was never corrected adds none."""
    merged_after_s: float | None
    """From when on all living robots were in one map frame (two robots at least), until the end."""
    merges_taken_back: list[Span] = Field(default_factory=list)
    """From when to when they were before, where a robot left the frame again."""
    closures: Closures
    ate_joint_m: float | None
    """All robots that lived to the end (all, where none did), one SE(3) alignment for all; null unless each of them is
    in one map frame and has truth."""
    ate_dead_m: dict[str, float] = Field(default_factory=dict)
    """Robot that died -> its error until it died, placed in the world by the survivors where it was in their map, else
    after its own alignment."""
    ate_joint_odometry_m: float | None
    """The same of odometry alone, each robot placed at its true first pose and not aligned further."""
    ate_joint_odometry_aligned_m: float | None
    """As before, then one SE(3) alignment for all: never larger, so the harder figure to beat."""
    ate_by_frame_m: dict[str, float | None]
    """Map frame -> joint ATE of the robots in it."""
    ate_m: dict[str, float | None]
    """Robot -> ATE of its corrected trajectory after its own SE(3) alignment."""
    ate_odometry_m: dict[str, float | None]
    """Robot -> the same of its odometry."""
    iate_m: float | None = None
    """Joint ATE of what was believed during the run, the mean over all rounds that found one joint map."""
    iate_odometry_m: float | None = None
    """The same, over the same moments, of odometry that starts at its true first poses."""
    iate_moments: int = 0
    """Rounds over which both are averaged."""
    if1: float | None = None
    """F1 of the closures kept against those that agree with ground truth, the mean over all rounds."""
    odometry_scale: dict[str, float | None] = Field(default_factory=dict)
    """Robot -> measured over true length of its odometry, 1 where it is true; null where nobody could estimate it."""
    maps_used: list[str] = Field(default_factory=list)
    """Maps of earlier runs that this one began with; this version begins every run without one."""
    bytes: dict[str, int]
    """Kind -> bytes sent by all robots."""
    bytes_by_robot: dict[str, RobotBytes]
    links: list[LinkBytes] = Field(default_factory=list)
    """Payload bytes on every link, as both ends counted them."""
    stages: dict[str, StageTime] = Field(default_factory=dict)
    """Stage of the work -> how long it took, all robots together."""
    stages_by_robot: dict[str, dict[str, StageTime]] = Field(default_factory=dict)
    stage_bounds_s: list[float] = Field(default_factory=list)
    """Upper ends of the buckets of all `counts`."""
    leaders: list[LeaderSpan]
    leader_changes: int
    """How often the robots went from one leader to another, the upper median over the robots."""
    optimisations: Optimisations
    expectations: list[Expectation]
    robot_details: list[RobotReport]
    deaths_unasked: list[str] = Field(default_factory=list)
    """Robots whose agents died without a fault of the scenario or an operator's order, once for each death."""
    doubted_cameras: list[str] = Field(default_factory=list)
    """Robots whose pictures contradict their odometry or calibration, or are frozen; the warnings say how."""
    misplaced_cameras: dict[str, str] = Field(default_factory=dict)
    """Those of them whose camera's axes are not their odometry's -> how, in a sentence; kept out of closures."""
    doubted_places: dict[str, str] = Field(default_factory=dict)
    """Robots that hang on their map by one place that looks like another one -> what shows it."""
    warnings: list[str]

    def has_truth(self) -> bool:
        """Whether any robot's errors are known."""
        return any(e is not None for r in self.robot_details for e in (r.corrected.ate_m, r.odometry.ate_m))
