"""From a loaded run to its report: the numbers of report.json."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.measurements import OdometryCovariance
from flocc_agent.core.reports import ClosureAccepted, MeasurementKept, PeerRefused, RoundSolved
from flocc_agent.runtime.event_lines import Reported, UnknownFact, of_kind
from flocc_agent.runtime.facts import AgentDied, BytesCounted
from flocc_agent.stages import BOUNDS_S
from flocc_launch.datasets.commands import ODOMETRY_MADE
from flocc_launch.report.accounts import links_of, stages_by_robot, stages_of
from flocc_launch.report.model import (
    Closures,
    Expectation,
    LeaderSpan,
    Optimisations,
    RobotBytes,
    RobotReport,
    RunReport,
    Span,
    TrackError,
)
from flocc_launch.runs.alike_places import alike_places
from flocc_launch.runs.camera_doubts import camera_doubts
from flocc_launch.runs.ground_truth import frame_sentences, in_separate_frames, other_clocks
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.moments import mean_errors, moments_of
from flocc_launch.runs.right_closures import judged_closures, mean_f1
from flocc_launch.runs.timeline import (
    corrections_of,
    deaths_unasked,
    ends,
    how_it_died,
    leader_changes,
    merges_of,
    terms_led,
)
from flocc_launch.runs.tracks import RobotTrack
from flocc_launch.runs.trajectory_errors import alignment, ate_m, relative_pose_error, unaligned_ate_m
from flocc_launch.runs.version import flocc_version
from flocc_protocol.keys import Kind

Float = NDArray[np.float64]


def _odometry_made(recordings: Mapping[str, str]) -> dict[str, str]:
    """What recordings say of odometry that was made; one that is no longer there says nothing."""
    files = {robot: Path(folder) / ODOMETRY_MADE for robot, folder in recordings.items()}
    return {robot: file.read_text(encoding="utf-8").strip() for robot, file in files.items() if file.is_file()}


def build(loaded: LoadedRun) -> RunReport:
    """Compute the report of a run."""
    run, tracks = loaded.run, loaded.tracks
    robots = [robot_part(loaded, robot) for robot in loaded.robots]
    by_robot, moments = bytes_by_robot(loaded), moments_of(loaded.events, tracks)
    during = mean_errors(moments, tracks)
    apart = in_separate_frames(tracks)
    living = survivors(tracks, [robot.robot for robot in robots if robot.end == "died"])
    frames = frames_of(living)
    merges = merges_of(loaded.events, [robot for robot in loaded.robots if robot not in run.servers])
    report = RunReport(
        flocc_version=flocc_version(),
        scenario=run.scenario,
        driver=run.driver,
        seed=run.seed,
        start=run.start,
        duration_s=loaded.end_s,
        wall_s=run.wall_s,
        robots=list(loaded.robots),
        odometry_made=_odometry_made({robot: at for robot, at in run.recordings.items() if robot not in loaded.barred}),
        map_frames=frames,
        merged_after_s=merges.after_s,
        merges_taken_back=[Span(from_s=from_s, to_s=to_s) for from_s, to_s in merges.taken_back],
        closures=closures_part(loaded),
        ate_joint_m=ate_joint_m(living),
        ate_dead_m=ate_dead_m(living, tracks),
        ate_joint_odometry_m=ate_joint_odometry_m(living, aligned=False),
        ate_joint_odometry_aligned_m=ate_joint_odometry_m(living, aligned=True),
        ate_by_frame_m={frame: ate_in_frame_m(living.values(), frame) for frame in frames if not apart},
        ate_m={robot.robot: robot.corrected.ate_m for robot in robots},
        ate_odometry_m={robot.robot: robot.odometry.ate_m for robot in robots},
        iate_m=None if during is None else during.corrected_m,
        iate_odometry_m=None if during is None else during.odometry_m,
        iate_moments=0 if during is None else during.moments,
        if1=mean_f1(moments, judged_closures(loaded)),
        odometry_scale=odometry_scales(loaded),
        maps_used=[str(run.settings["map"])] if "map" in run.settings else [],
        bytes=total_bytes(by_robot),
        bytes_by_robot=by_robot,
        links=links_of(loaded.events),
        stages=stages_of(loaded.events),
        stages_by_robot=stages_by_robot(loaded.events),
        stage_bounds_s=list(BOUNDS_S),
        leaders=[
            LeaderSpan(term=span.term, leader=span.leader, from_s=span.from_s, to_s=span.to_s)
            for span in terms_led(loaded.followings)
        ],
        leader_changes=leader_changes(loaded.followings),
        optimisations=optimisations_part(loaded),
        expectations=[],
        robot_details=robots,
        deaths_unasked=deaths_unasked(loaded.events),
        doubted_cameras=sorted({doubt.robot for doubt in camera_doubts(loaded.events) if doubt.matters}),
        misplaced_cameras={d.robot: d.headline for d in camera_doubts(loaded.events) if d.withheld},
        doubted_places={alike.robot: alike.headline for alike in alike_places(loaded)},
        warnings=warnings_of(loaded),
    )
    return report.model_copy(update={"expectations": judged(run.expectations, report, registered_by(loaded))})


def with_keyframes(tracks: Iterable[RobotTrack]) -> list[RobotTrack]:
    """The tracks that have keyframes at all."""
    return [track for track in tracks if len(track)]


def survivors(tracks: Mapping[str, RobotTrack], died: Iterable[str]) -> dict[str, RobotTrack]:
    """Tracks of the robots that lived to the end; of all where none did."""
    dead = set(died)
    return {robot: track for robot, track in tracks.items() if robot not in dead} or dict(tracks)


def frames_of(tracks: Mapping[str, RobotTrack]) -> list[str]:
    """Map frames of these robots, each once."""
    return sorted({track.map_frame for track in tracks.values() if track.map_frame is not None})


def ate_dead_m(living: Mapping[str, RobotTrack], tracks: Mapping[str, RobotTrack]) -> dict[str, float]:
    """Error of each dead robot until it died: placed by its map's survivors where there are any, else by itself."""
    apart = in_separate_frames(tracks)
    errors_m = {}
    for robot, track in tracks.items():
        if robot in living:
            continue
        estimate, truth = track.corrected_and_true()
        of_map = [] if apart else with_truth_in(living.values(), track.map_frame)
        if of_map:
            T_world_map = alignment(*zip(*of_map, strict=True))
            errors_m[robot] = unaligned_ate_m([T_world_map @ estimate], [truth])
        else:
            errors_m[robot] = ate_m([estimate], [truth])
    return {robot: error_m for robot, error_m in errors_m.items() if error_m is not None}


def with_truth_in(tracks: Iterable[RobotTrack], frame: str | None) -> list[tuple[Float, Float]]:
    """Corrected and true poses of the robots in one map frame, of those that have true ones; none where no map is."""
    pairs = [track.corrected_and_true() for track in tracks if frame is not None and track.map_frame == frame]
    return [pair for pair in pairs if len(pair[1])]


def ate_joint_m(tracks: Mapping[str, RobotTrack]) -> float | None:
    """Joint ATE, or None unless every robot with keyframes is in one map frame and has ground truth."""
    moved = with_keyframes(tracks.values())
    frames = {track.map_frame for track in moved}
    if len(frames) != 1 or None in frames or not all(len(track.corrected_and_true()[1]) for track in moved):
        return None
    if in_separate_frames(tracks):
        return None
    return ate_in_frame_m(moved, frames.pop() or "")


def ate_in_frame_m(tracks: Iterable[RobotTrack], frame: str) -> float | None:
    """Joint ATE of the robots in one map frame."""
    pairs = with_truth_in(tracks, frame)
    return ate_m([estimate for estimate, _ in pairs], [truth for _, truth in pairs])


def ate_joint_odometry_m(tracks: Mapping[str, RobotTrack], aligned: bool) -> float | None:
    """Joint ATE of odometry placed at its true starts, or None unless every robot has ground truth."""
    moved = with_keyframes(tracks.values())
    pairs = [track.odometry_and_true() for track in moved]
    if not all(len(truth) for _, truth in pairs) or in_separate_frames(tracks):
        return None
    error = ate_m if aligned else unaligned_ate_m
    return error([estimate for estimate, _ in pairs], [truth for _, truth in pairs])


def track_error(estimate: Float, truth: Float) -> TrackError:
    """Errors of one robot's own trajectory."""
    rpe = relative_pose_error(estimate, truth)
    return TrackError(
        ate_m=ate_m([estimate], [truth]),
        rpe_translation_m=None if rpe is None else rpe.translation_rmse_m,
        rpe_rotation_deg=None if rpe is None else rpe.rotation_rmse_deg,
    )


def robot_part(loaded: LoadedRun, robot: str) -> RobotReport:
    """One robot's part of the report."""
    track, result = loaded.tracks[robot], loaded.results.get(robot)
    corrections = corrections_of(loaded.events, robot)
    end = ends(loaded.events).get(robot)
    return RobotReport(
        robot=robot,
        incarnation=None if result is None else result.incarnation,
        end=None if end is None else "died" if isinstance(end.fact, AgentDied) else "stopped",
        ended_s=None if end is None else end.t,
        keyframes=len(track),
        keyframes_with_ground_truth=int(track.true.sum()),
        path_length_m=track.path_length_m(),
        map_frame=track.map_frame,
        server=robot in loaded.run.servers,
        corrections=len(corrections),
        frame_changes=sum(correction.fact.frame_changed for correction in corrections),
        logs={} if result is None else dict(sorted(result.logs.items())),
        corrected=track_error(*track.corrected_and_true()),
        odometry=track_error(*track.odometry_and_true()),
    )


def closures_part(loaded: LoadedRun) -> Closures:
    """Count pairs by what became of them."""
    pairs = loaded.pairs
    rejected = Counter(pair.reason for pair in pairs if pair.rejected and pair.reason is not None)
    rounds = [event.fact for event in of_kind(loaded.events, RoundSolved)]
    return Closures(
        accepted=sum(pair.accepted for pair in pairs),
        rejected=sum(pair.rejected for pair in pairs),
        accepted_inter_robot=sum(pair.accepted and pair.inter_robot for pair in pairs),
        candidates=sum(pair.similarity is not None for pair in pairs),
        rejected_by_reason=dict(sorted(rejected.items())),
        used=rounds[-1].closures_used if rounds else None,
        rejected_by_solver=rounds[-1].closures_rejected if rounds else None,
    )


def optimisations_part(loaded: LoadedRun) -> Optimisations:
    """What the leaders' solvers did."""
    rounds = [event.fact for event in of_kind(loaded.events, RoundSolved)]
    times_s = [solved.solve_s for solved in rounds if solved.solve_s is not None]
    return Optimisations(
        rounds=len(rounds), cost=rounds[-1].cost if rounds else None, solve_s_max=max(times_s, default=None)
    )


def odometry_scales(loaded: LoadedRun) -> dict[str, float | None]:
    """Scale of each robot's odometry as the last round that could tell estimated it; None where none could."""
    scales: dict[str, float | None] = dict.fromkeys(loaded.robots)
    for event in of_kind(loaded.events, RoundSolved):
        scales.update({robot: ratio for robot, ratio in event.fact.odometry_scales.items() if robot in scales})
    return scales


def bytes_by_robot(loaded: LoadedRun) -> dict[str, RobotBytes]:
    """Bytes of each robot by kind, over all its starts: a counter that falls began again at zero."""
    sent: dict[str, Counter[str]] = {robot: Counter() for robot in loaded.robots}
    received: dict[str, Counter[str]] = {robot: Counter() for robot in loaded.robots}
    last: dict[str, BytesCounted] = {}
    for event in of_kind(loaded.events, BytesCounted):
        before = last.get(event.robot)
        if before is not None and sum(event.fact.sent.values()) < sum(before.sent.values()):
            sent.setdefault(event.robot, Counter()).update(before.sent)
            received.setdefault(event.robot, Counter()).update(before.received)
        last[event.robot] = event.fact
    for robot, counted in last.items():
        sent.setdefault(robot, Counter()).update(counted.sent)
        received.setdefault(robot, Counter()).update(counted.received)
    return {
        robot: RobotBytes(sent=dict(sorted(sent[robot].items())), received=dict(sorted(received[robot].items())))
        for robot in sorted(sent)
    }


def total_bytes(by_robot: Mapping[str, RobotBytes]) -> dict[str, int]:
    """Bytes sent by all robots, by kind."""
    total: Counter[str] = Counter()
    for robot in by_robot.values():
        total.update(robot.sent)
    return dict(sorted(total.items()))


HELD, HELD_TOLD_MAX = "held until another one agrees", 3
"""What the back end says of a lone closure, and how many of them a reader wants to see."""


def _death(event: Reported[AgentDied]) -> str:
    if event.fact.scripted:
        return f"{event.robot} was killed after {event.t:.1f} s, as the scenario asked."
    return f"{event.robot} died after {event.t:.1f} s ({how_it_died(event)})."


def warnings_of(loaded: LoadedRun) -> list[str]:
    """What a reader should see: deaths, refusals, missing results, odd truths, unknown events, the solver's last."""
    events = loaded.events
    found = [_death(event) for event in of_kind(events, AgentDied)]
    found += sorted({f"{e.robot} refused {e.fact.peer}: {e.fact.reason}." for e in of_kind(events, PeerRefused)})
    for robot in loaded.robots:
        if robot not in loaded.results:
            found.append(f"{robot} left no result; its trajectory is odometry only.")
    if loaded.barred:
        found.append(barred_sentence(loaded))
    found += [*other_clocks(loaded.tracks), *frame_sentences(loaded.tracks)]
    found += [f"{doubt.sentence} {doubt.advice}" for doubt in camera_doubts(events)]
    found += unused_measurements(loaded)
    unknown = Counter(event.fact.name for event in of_kind(events, UnknownFact))
    for name, count in sorted(unknown.items()):
        found.append(f"This version does not know events of the kind {name} ({count} in this run).")
    rounds = of_kind(events, RoundSolved)
    return found + ([f"Last optimisation: {text}" for text in told_of(rounds[-1].fact.warnings)] if rounds else [])


def unused_measurements(loaded: LoadedRun) -> list[str]:
    """That distributed mode kept what was measured besides odometry, and did not use it."""
    facts = [event.fact for event in of_kind(loaded.events, MeasurementKept)]
    kinds = Counter(fact.kind for fact in facts if fact.kind != OdometryCovariance.kind)
    if not kinds or not any(Kind.SHARED_POSES in robot.sent for robot in bytes_by_robot(loaded).values()):
        return []
    told = ", ".join(f"{count} of the kind {kind}" for kind, count in sorted(kinds.items()))
    return [f"Distributed mode used no measurements: {told} were kept only; backend.mode = 'centralised' uses them."]


def barred_sentence(loaded: LoadedRun) -> str:
    """What a run lacks whose recordings lie where this user may not look, such as in another user's cache."""
    untrue = [robot for robot in loaded.barred if loaded.tracks[robot].truth is None]
    where = f"{', '.join(loaded.barred)} lie where you may not read ({next(iter(loaded.barred.values())).parent})"
    truth = f", nor ground truth of {', '.join(untrue)}: put it into groundtruth/ of the run" if untrue else ""
    return f"The recordings of {where}, so there are no pictures of them{truth}."


def told_of(warnings: Sequence[str]) -> list[str]:
    """A solver's warnings, of which those of closures that wait for another one are told a few times only."""
    held = [text for text in warnings if HELD in text]
    more = held[HELD_TOLD_MAX:]
    rest = (
        [f"{len(more)} more closures are held until others agree with them (events.jsonl names them)"] if more else []
    )
    return [text for text in warnings if text not in more] + rest


def registered_by(loaded: LoadedRun) -> Counter[str]:
    """Accepted closures by the robot that registered them."""
    return Counter(event.fact.by or event.robot for event in of_kind(loaded.events, ClosureAccepted))


def judged(
    limits: Mapping[str, float | str], report: RunReport, registered: Mapping[str, int] | None = None
) -> list[Expectation]:
    """Hold a scenario's expectations against a report.

    `NAME_max` and `NAME_within_s` hold where the value is at most the limit, `NAME_min` where it is at least, a name
    where it is that name. What never happened within the run misses its `_within_s`; any other value that is not known
    is not judged.
    """
    values = measured(report, registered or {})
    return [
        Expectation(name=name, limit=limit, value=values.get(name), met=met(name, limit, values.get(name)))
        for name, limit in sorted(limits.items())
    ]


def met(name: str, limit: float | str, value: float | str | None) -> bool | None:
    """Whether a value keeps its limit; None where it cannot be said."""
    if value is None:
        return False if name.endswith("_within_s") else None
    if isinstance(limit, str) or isinstance(value, str):
        return value == limit
    return value >= limit if name.endswith("_min") else value <= limit


def measured(report: RunReport, registered: Mapping[str, int]) -> dict[str, float | str | None]:
    """The values that expectations can name."""
    before, after = report.ate_joint_odometry_m, report.ate_joint_m
    leader = max(report.leaders, key=lambda span: span.to_s).leader if report.leaders else None
    closures = sum(registered.values())
    return {
        "merged_within_s": report.merged_after_s,
        "ate_max_m": after,
        "ate_ratio_max": after / before if after is not None and before else None,
        "leader_changes_max": report.leader_changes,
        "closures_min": report.closures.accepted_inter_robot,
        "closures_rejected_max": report.closures.rejected,
        "frames_max": len(report.map_frames),
        "bytes_max": sum(report.bytes.values()),
        "wall_max_s": report.wall_s,
        "leader": leader,
        "deaths_max": len(report.deaths_unasked),
        "leader_registered_ratio_min": None if leader is None or not closures else registered.get(leader, 0) / closures,
    }
