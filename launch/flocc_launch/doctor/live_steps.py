"""Why two robots of a running swarm are in two maps: the chain of steps of `steps`, as far as answers tell of it."""

from collections.abc import Callable, Sequence

from flocc_agent.runtime.status import PairStatus
from flocc_launch.dashboard.status_table import RobotStatus
from flocc_launch.doctor.finding import Finding, Severity, blocked
from flocc_launch.doctor.held_joins import join_held
from flocc_launch.doctor.merge_evidence import held_records
from flocc_launch.runs.plain_numbers import number

Rows = Sequence[RobotStatus]
Step = Callable[[Rows, RobotStatus, RobotStatus], Finding | None]


def apart(rows: Rows) -> list[Finding]:
    """For the two robots of different maps that came furthest, the first step that failed; nothing where none did."""
    moving = [row for row in rows if not is_server(row)]
    stopped = [
        (number_of, found)
        for k, a in enumerate(moving)
        for b in moving[k + 1 :]
        if a.map_frame is None or a.map_frame != b.map_frame
        for number_of, found in [first_failure(rows, a, b)]
    ]
    if not stopped or any(found is None for _, found in stopped):
        return []
    furthest = max(stopped, key=lambda stop: stop[0])[1]
    return [] if furthest is None else [furthest]


def first_failure(rows: Rows, a: RobotStatus, b: RobotStatus) -> tuple[int, Finding | None]:
    """The first step that failed between two robots, with its number."""
    for number_of, step in enumerate(STEPS):
        found = step(rows, a, b)
        if found is not None:
            return number_of, found
    return len(STEPS), None


def is_server(row: RobotStatus) -> bool:
    """Whether it takes no keyframes because it is no robot that moves."""
    return row.keyframes == 0 and row.compute_class > 0


def pair_of(rows: Rows, a: RobotStatus, b: RobotStatus) -> PairStatus:
    """What anybody knows of two robots; the one who knows most counts."""
    found = [pair for row in rows for pair in row.pairs if set(pair.robots) == {a.robot, b.robot}]
    return max(found, key=lambda pair: pair.accepted + pair.rejected, default=PairStatus(robots=(a.robot, b.robot)))


def exchanged_no_records(_: Rows, a: RobotStatus, b: RobotStatus) -> Finding | None:
    """Neither holds the other's keyframes."""
    counts = [{log: entry[0] for log, entry in row.logs.items() if entry} for row in (a, b)]
    if not all(counts) or held_records(counts[0], b.robot) or held_records(counts[1], a.robot):
        return None
    return blocked(
        "no-descriptors",
        f"{a.robot} and {b.robot} hold no records of each other, so no descriptors were exchanged.",
        "Let them stay in range for longer, or raise the bandwidth or lower the loss of the link.",
        a.robot,
        b.robot,
    )


def looked_different(rows: Rows, a: RobotStatus, b: RobotStatus) -> Finding | None:
    """Records met, but no two keyframes were similar enough."""
    pair = pair_of(rows, a, b)
    known = [row.best_similarities.get(other.robot) for row, other in ((a, b), (b, a))]
    best = max((value for value in known if value is not None), default=None)
    limit = a.similarity_threshold
    if pair.accepted or pair.rejected or best is None or limit is None or best >= limit:
        return None
    return blocked(
        "low-similarity",
        f"No keyframe of {a.robot} looks like one of {b.robot}: the best similarity so far is {best:.2f}, below the "
        f"threshold of {limit:g}.",
        "If they did see the same place, lower core.place_recognition.similarity_threshold or use a stronger "
        "descriptor; else let their routes overlap.",
        a.robot,
        b.robot,
    )


def rejected_all(rows: Rows, a: RobotStatus, b: RobotStatus) -> Finding | None:
    """Registrations were made and all of them refused."""
    pair = pair_of(rows, a, b)
    if pair.accepted or not pair.rejected:
        return None
    limit = "" if a.match_ratio_threshold is None else f", R_thr is {a.match_ratio_threshold:g}"
    return blocked(
        "registrations-rejected",
        f"All {pair.rejected} registrations between {a.robot} and {b.robot} were rejected so far; the best match ratio "
        f"is {number(pair.best_ratio)} ({pair.reason}){limit}.",
        "If these pairs do show one place, use the learned or the mast3r front end, which see further; "
        "else raise core.place_recognition.similarity_threshold to save the work.",
        a.robot,
        b.robot,
    )


def solver_dropped_closures(rows: Rows, a: RobotStatus, b: RobotStatus) -> Finding | None:
    """The leader's solver has closures and keeps the two in separate parts."""
    leaders = {row.robot: row for row in rows}
    leader = leaders.get(a.leader or "")
    solver = None if leader is None else leader.solver
    accepted = pair_of(rows, a, b).accepted
    parts = [] if solver is None else [set(part) for part in solver.components]
    if solver is None or not accepted or any({a.robot, b.robot} <= part for part in parts):
        return None
    if not all(any(robot in part for part in parts) for robot in (a.robot, b.robot)):
        return None
    held = join_held(solver.warnings, a.robot, b.robot)
    if held is not None:
        return held
    warned = f" The solver warns: {solver.warnings[0]}." if solver.warnings else ""
    return Finding(
        "closures-not-connecting",
        Severity.BLOCKS,
        f"{accepted} closures between {a.robot} and {b.robot} were accepted, but the last solution of {a.leader} keeps "
        f"them in separate parts ({solver.closures_used} closures used, {solver.closures_rejected} rejected).{warned}",
        "The closures contradict each other or odometry, or are too few: check the camera's "
        "intrinsics and T_body_camera, and that odometry is metric.",
        (a.robot, b.robot),
    )


STEPS: tuple[Step, ...] = (exchanged_no_records, looked_different, rejected_all, solver_dropped_closures)
