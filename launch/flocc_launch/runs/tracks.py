"""One robot's keyframes at the end of a run, beside the truth where it is known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.reports import Fact, KeyframeTaken
from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.event_lines import Reported, of_kind
from flocc_agent.runtime.robot_result import RobotResult, stacked_poses
from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.runs.trajectory_errors import associate, placed_at_true_start

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
    folder: RunFolder, results: Mapping[str, RobotResult], events: Sequence[Reported[Fact]]
) -> dict[str, RobotTrack]:
    """Put together every robot's track; one that left no result has the odometry of its `keyframe` events."""
    taken = of_kind(events, KeyframeTaken)
    tracks = {}
    for robot in sorted(folder.run().robots):
        truth = ground_truth(folder, robot)
        if robot in results:
            tracks[robot] = track_of_result(results[robot], truth)
        else:
            tracks[robot] = track_of_events([event.fact for event in taken if event.robot == robot], robot, truth)
    return tracks


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
    return RobotTrack(robot, incarnation, map_frame, stamps_s, T_odom_body, corrected, T_map_body, true, T_world_body)


def ground_truth(folder: RunFolder, robot: str) -> Trajectory | None:
    """True body poses of a robot, from its recording or as its driver left them; None if unknown."""
    recording = folder.recording(robot)
    places = [folder.path / "groundtruth" / f"{robot}.tum"]
    if recording is not None:
        places.insert(0, recording / "groundtruth.tum")
    found: Path | None = next((place for place in places if place.is_file()), None)
    return None if found is None else read_tum(found)
