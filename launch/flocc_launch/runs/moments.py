"""Where the robots thought they had been, each time that a round's corrections had arrived.

A moment is when the last robot that applied a round's correction has done so. A correction tells where some keyframes
lie, its knots; between two of them it is interpolated, before the first and after the last it stays, as in
`core/corrected.py`. Runs of versions that told no knots have `T_map_odom` alone, which moves the whole of the odometry.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.reports import CorrectionApplied, Fact, KeyframeTaken
from flocc_agent.geometry import inverse, pose_from_tq, poses_from_tq
from flocc_agent.runtime.event_lines import Reported, is_of
from flocc_launch.runs.tracks import RobotTrack
from flocc_launch.runs.trajectory_errors import ate_m, placed_at_true_start, unaligned_ate_m

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Moment:
    """What was known when a round had arrived.

    Attributes:
        t: Seconds since the start of the run.
        keyframes: Robot -> number of its keyframes; robots without any are not in it.
        corrections: Robot -> the correction that it had applied last, of the log that its keyframes are in.
    """

    t: float
    keyframes: Mapping[str, int]
    corrections: Mapping[str, CorrectionApplied]


def moments_of(events: Sequence[Reported[Fact]], tracks: Mapping[str, RobotTrack]) -> list[Moment]:
    """One moment per round of each leader, in order of time; only keyframes that are in the tracks count."""
    closing = set({_round(e.fact): k for k, e in enumerate(events) if is_of(e, CorrectionApplied)}.values())
    keyframes: dict[str, int] = {}
    corrections: dict[str, CorrectionApplied] = {}
    found: list[Moment] = []
    for k, event in enumerate(events):
        if is_of(event, KeyframeTaken):
            _take(event.fact, tracks.get(event.robot), keyframes, corrections)
        elif is_of(event, CorrectionApplied):
            corrections[event.robot] = event.fact
        if k in closing:
            found.append(Moment(event.t, dict(keyframes), dict(corrections)))
    return found


def _round(fact: CorrectionApplied) -> tuple[int, str | None, int]:
    return fact.term, fact.leader, fact.round


def _take(
    taken: KeyframeTaken,
    track: RobotTrack | None,
    keyframes: dict[str, int],
    corrections: dict[str, CorrectionApplied],
) -> None:
    """Count a keyframe; with the first one of a log, corrections of the robot's log before it are void."""
    log = taken.keyframe.log
    if track is None or log.incarnation != track.incarnation:
        return
    if taken.keyframe.index == 0:
        corrections.pop(log.robot, None)
    keyframes[log.robot] = min(max(keyframes.get(log.robot, 0), taken.keyframe.index + 1), len(track))


def poses_then(correction: CorrectionApplied, T_odom_body: Float) -> Float:
    """Where a robot's keyframes lay by one of its corrections.

    Args:
        correction: Applied last.
        T_odom_body: (N, 4, 4) of the keyframes that existed.

    Returns:
        (N, 4, 4) in the correction's map frame. Between two knots the two places are blended, so that only the
        positions are meant.
    """
    told = zip(correction.knots, correction.T_map_body, strict=False)
    known = {index: T for index, T in told if 0 <= index < len(T_odom_body)}
    if not known:
        return np.asarray(pose_from_tq(np.array(correction.T_map_odom)) @ T_odom_body)
    at = sorted(known)
    T_map_body = poses_from_tq(np.array([known[index] for index in at]))
    T_map_odom = T_map_body @ np.array([inverse(T_odom_body[index]) for index in at])
    place = np.interp(np.arange(len(T_odom_body)), at, np.arange(len(at)))
    before = np.floor(place).astype(int)
    after, share = np.ceil(place).astype(int), (place - before)[:, None, None]
    return np.asarray(((1 - share) * T_map_odom[before] + share * T_map_odom[after]) @ T_odom_body)


def errors_then_m(moment: Moment, tracks: Mapping[str, RobotTrack]) -> tuple[float, float] | None:
    """Joint ATE of the estimates of a moment, and of odometry placed at its true starts, as at the end of a run.

    Returns:
        Both in metres; None unless all robots that had keyframes were in one map frame and have ground truth.
    """
    corrections = moment.corrections
    if not moment.keyframes or not moment.keyframes.keys() <= corrections.keys():
        return None
    estimates, placed, truths = [], [], []
    for robot, count in moment.keyframes.items():
        track, true = tracks[robot], tracks[robot].true[:count]
        truths.append(track.T_world_body[:count][true])
        estimates.append(poses_then(corrections[robot], track.T_odom_body[:count])[true])
        placed.append(placed_at_true_start(track.T_odom_body[:count][true], truths[-1]))
    frames = {corrections[robot].map_frame for robot in moment.keyframes}
    corrected, odometry = ate_m(estimates, truths), unaligned_ate_m(placed, truths)
    if len(frames) > 1 or not all(map(len, truths)) or corrected is None or odometry is None:
        return None
    return corrected, odometry


@dataclass(frozen=True, slots=True)
class MeanErrors:
    """Joint ATE of the estimates and of odometry (m), each the mean over the same moments, and their number."""

    corrected_m: float
    odometry_m: float
    moments: int


def mean_errors(moments: Iterable[Moment], tracks: Mapping[str, RobotTrack]) -> MeanErrors | None:
    """Mean over the moments that have a joint ATE; None where none has."""
    found = [errors for moment in moments if (errors := errors_then_m(moment, tracks)) is not None]
    if not found:
        return None
    corrected_m, odometry_m = np.mean(found, axis=0)
    return MeanErrors(float(corrected_m), float(odometry_m), len(found))
