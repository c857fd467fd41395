"""What each robot's camera takes and when: keyframes of a recording, or of a walk without images."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import KeyframeConfig
from flocc_agent.core.interfaces import Image
from flocc_agent.runtime.keyframes import KeyframeSelector
from flocc_agent.runtime.measurement_file import NOTHING, RecordedMeasurements, Stamped
from flocc_agent.runtime.pictures import FULL
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.scenarios.walks import T_BODY_CAMERA, Walk

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """One keyframe to come.

    Attributes:
        stamp_s: Time of the image, counted from the recording's first frame.
        T_odom_body: (4, 4) by odometry, metres.
        load: Gives the image.
        source: Image file, or None where there is none.
        camera_key: What the image means beyond its pixels: the intrinsics.
        measured: What else was measured there.
    """

    stamp_s: float
    T_odom_body: Float
    load: Callable[[], Image]
    source: Path | None = None
    camera_key: bytes = b""
    measured: tuple[Stamped, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Playback:
    """All that one robot sees.

    Attributes:
        captures: Keyframes, in order of time.
        T_body_camera: (4, 4) where the camera sits.
        truth: `T_world_body`, None where it is not known.
        first_stamp_s: Stamp of the recording's first frame, which is played at the robot's start.
        hidden: (H, W) pixels that move with the camera.
    """

    captures: tuple[Capture, ...]
    T_body_camera: Float
    truth: Trajectory | None
    first_stamp_s: float = 0.0
    hidden: NDArray[np.bool_] | None = None

    def position_m(self, since_start_s: float) -> Float | None:
        """Where the robot truly is, (3,); before its first and after its last frame it stands."""
        if self.truth is None or not len(self.truth):
            return None
        stamps_s = self.truth.stamps_s
        stamp_s = min(max(since_start_s + self.first_stamp_s, float(stamps_s[0])), float(stamps_s[-1]))
        after = int(np.searchsorted(stamps_s, stamp_s, side="right"))
        if after in (0, len(stamps_s)):
            return np.array(self.truth.T_fixed_body[min(after, len(stamps_s) - 1), :3, 3])
        before, share = after - 1, (stamp_s - stamps_s[after - 1]) / (stamps_s[after] - stamps_s[after - 1])
        here, there = self.truth.T_fixed_body[before, :3, 3], self.truth.T_fixed_body[after, :3, 3]
        return np.asarray(here + share * (there - here))

    def lasts_s(self) -> float:
        """Time from the first frame to the end of the truth, 0 where it is not known."""
        return 0.0 if self.truth is None else float(self.truth.stamps_s[-1]) - self.first_stamp_s


def nothing() -> Playback:
    """Of a robot without a camera, such as a server."""
    return Playback((), np.eye(4), None)


def of_walk(walk: Walk, robot: str, config: KeyframeConfig, measurements: RecordedMeasurements = NOTHING) -> Playback:
    """Keyframes of a walk; their images hold the true pose for synthetic perception."""
    chosen = select(walk.odometry.T_fixed_body, config, walk.odometry.stamps_s, measurements)
    captures = tuple(_walked(walk, robot, k, measurements) for k in chosen)
    return Playback(captures, T_BODY_CAMERA, walk.truth)


def of_recording(recording: Recording, config: KeyframeConfig) -> Playback:
    """Keyframes of a recording; pixels are read when they are asked for."""
    frames = recording.frames
    measurements = recording.measurements
    chosen = select([f.T_odom_body for f in frames], config, [f.stamp_s for f in frames], measurements)
    captures = tuple(
        Capture(
            frames[k].stamp_s,
            frames[k].T_odom_body,
            lambda frame=frames[k]: recording.load_image(frame),  # type: ignore[misc]
            frames[k].image_path,
            repr(recording.model if recording.levels == FULL else (recording.model, recording.levels)).encode(),
            measurements.at(frames[k].stamp_s),
        )
        for k in chosen
    )
    return Playback(captures, recording.T_body_camera, recording.truth, frames[0].stamp_s, hidden=recording.hidden)


def select(
    poses: Iterable[Float], config: KeyframeConfig, stamps_s: Iterable[float], measurements: RecordedMeasurements
) -> list[int]:
    """Choose keyframes: the first pose, each that moved or turned enough, and those at which something was seen."""
    selector = KeyframeSelector(config)
    chosen = []
    for k, (T_odom_body, stamp_s) in enumerate(zip(poses, stamps_s, strict=True)):
        if selector.wants(T_odom_body) or measurements.keeps(float(stamp_s)):
            selector.took(T_odom_body)
            chosen.append(k)
    return chosen


def _walked(walk: Walk, robot: str, k: int, measurements: RecordedMeasurements) -> Capture:
    from flocc_agent.perception.synthetic import pose_image

    T_world_camera = walk.truth.T_fixed_body[k] @ T_BODY_CAMERA
    stamp_s = float(walk.truth.stamps_s[k])
    return Capture(
        stamp_s,
        walk.odometry.T_fixed_body[k],
        lambda: pose_image(T_world_camera, f"{robot}/{k}"),
        measured=measurements.at(stamp_s),
    )
