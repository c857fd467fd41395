"""One robot's keyframes at the end of a run, beside the truth where it is known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.reports import Fact, KeyframeTaken
from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.event_lines import Reported, is_of, of_kind
from flocc_agent.runtime.facts import AgentDied
from flocc_agent.runtime.robot_result import LostRobot, RobotResult, stacked_poses
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.runs.timeline import ends
from flocc_launch.runs.trajectory_errors import associate, placed_at_true_start
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class RobotTrack:
    """Keyframes of one robot.

    Attributes:
        robot: Its name.
        incarnation: Of the log that these keyframes are in.
        map_frame: Frame of `T_map_body`, None where the robot was never corrected.
        stamps_s: (N,) on the recording's clock.
        T_odom_body: (N, 4, 4) odometry.
        corrected: (N,) which keyframes have a pose in the map frame.
        T_map_body: (N, 4, 4); the rows that are not corrected are NaN.
        true: (N,) which keyframes have ground truth.
        T_world_body: (N, 4, 4) ground truth; the rows without it are NaN.
        truth: All of the ground truth, on whatever clock it is.
    """

    robot: str
    incarnation: int
    map_frame: str | None
    stamps_s: Float
    T_odom_body: Float
    corrected: Mask
    T_map_body: Float
    true: Mask
    T_world_body: Float
    truth: Trajectory | None = None

    def __len__(self) -> int:
        return len(self.stamps_s)

    def corrected_and_true(self) -> tuple[Float, Float]:
        """Corrected poses and ground truth of the keyframes that have both, each (K, 4, 4)."""
        both = self.corrected & self.true
        return self.T_map_body[both], self.T_world_body[both]

    def odometry_and_true(self) -> tuple[Float, Float]:
        """Odometry, placed at its true first pose, and ground truth of the keyframes that have it, (K, 4, 4)."""
        truth = self.T_world_body[self.true]
        return placed_at_true_start(self.T_odom_body[self.true], truth), truth

    def path_length_m(self) -> float:
        """Length of the odometry from keyframe to keyframe."""
        return float(np.linalg.norm(np.diff(self.T_odom_body[:, :3, 3], axis=0), axis=1).sum())


def tracks_of(
    truths: Mapping[str, Trajectory | None], results: Mapping[str, RobotResult], events: Sequence[Reported[Fact]]
) -> dict[str, RobotTrack]:
    """Put together every robot's track; one that left no result has the odometry of its `keyframe` events.

    One that died before it was corrected, or in another map, is where survivors have it that no longer heard it.
    """
    taken = of_kind(events, KeyframeTaken)
    lost, died = lost_robots(results), {name for name, end in ends(events).items() if is_of(end, AgentDied)}
    tracks = {}
    for robot, truth in sorted(truths.items()):
        if robot in results:
            track = track_of_result(results[robot], truth)
        else:
            track = track_of_events([event.fact for event in taken if event.robot == robot], robot, truth)
        there = lost.get(str(LogId(robot, track.incarnation)))
        if robot in died and there is not None and len(track) and there.map_frame != track.map_frame:
            at = there.T_map_body(track.T_odom_body)
            track = completed(robot, track.incarnation, there.map_frame, track.stamps_s, track.T_odom_body, at, truth)
        tracks[robot] = track
    return tracks


def lost_robots(results: Mapping[str, RobotResult]) -> dict[str, LostRobot]:
    """Where survivors have each log that they no longer heard; best by who solved it, then by the latest round."""
    told = [lost for _, result in sorted(results.items()) for lost in result.lost]
    return {lost.log: lost for lost in sorted(told, key=lambda lost: (bool(lost.knots), lost.term, lost.round))}


def track_of_result(result: RobotResult, truth: Trajectory | None) -> RobotTrack:
    """Track of a robot that left a result; a keyframe after the last correction moves with `T_map_odom`."""
    stamps_s = np.array([keyframe.stamp_s for keyframe in result.keyframes])
    T_odom_body = result.T_odom_body()
    T_map_body = np.full_like(T_odom_body, np.nan)
    for k, keyframe in enumerate(result.keyframes):
        if keyframe.T_map_body is not None:
            T_map_body[k] = pose_from_tq(np.array(keyframe.T_map_body))
        elif result.T_map_odom is not None:
            T_map_body[k] = pose_from_tq(np.array(result.T_map_odom)) @ T_odom_body[k]
    return completed(result.robot, result.incarnation, result.map_frame, stamps_s, T_odom_body, T_map_body, truth)


def track_of_events(keyframes: list[KeyframeTaken], robot: str, truth: Trajectory | None) -> RobotTrack:
    """Track of a robot that left no result: odometry only."""
    stamps_s = np.array([taken.stamp_s for taken in keyframes])
    T_odom_body = stacked_poses([taken.T_odom_body for taken in keyframes])
    incarnation = keyframes[-1].keyframe.log.incarnation if keyframes else 0
    return completed(robot, incarnation, None, stamps_s, T_odom_body, np.full_like(T_odom_body, np.nan), truth)


def completed(
    robot: str,
    incarnation: int,
    map_frame: str | None,
    stamps_s: Float,
    T_odom_body: Float,
    T_map_body: Float,
    truth: Trajectory | None,
) -> RobotTrack:
    """Put a track together with the ground truth at its stamps."""
    T_world_body = np.full_like(T_odom_body, np.nan)
    true: Mask = np.zeros(len(stamps_s), dtype=bool)
    if truth is not None:
        true, poses = associate(stamps_s, truth)
        T_world_body[true] = poses
    corrected: Mask = np.asarray(np.isfinite(T_map_body).all(axis=(1, 2)))
    return RobotTrack(
        robot, incarnation, map_frame, stamps_s, T_odom_body, corrected, T_map_body, true, T_world_body, truth
    )
