"""`report.json` as types. A value that is not known is null; `schema_version` grows when a key changes meaning.

The keys that other programs rely on stand in DESIGN.md section 8, all of them in docs/report.md.
"""

from flocc_launch.run_records import Record

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


class Robot(Record):
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


class Optimisations(Record):
    """What the leaders' solvers did."""

    rounds: int
    cost: float | None
    """Cost of the last one."""
    solve_s_max: float | None
    """Longest one."""


class Report(Record):
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
    map_frames: list[str]
    """Frames at the end, each named once; a robot that was never corrected adds none."""
    merged_after_s: float | None
    """When all living robots first were in one map frame (two robots at least)."""
    closures: Closures
    ate_joint_m: float | None
    """All robots, one SE(3) alignment for all; null unless every robot is in one map frame and has truth."""
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
    bytes: dict[str, int]
    """Kind -> bytes sent by all robots."""
    bytes_by_robot: dict[str, RobotBytes]
    leaders: list[LeaderSpan]
    leader_changes: int
    """How often the robots went from one leader to another, the upper median over the robots."""
    optimisations: Optimisations
    expectations: list[Expectation]
    robot_details: list[Robot]
    warnings: list[str]
