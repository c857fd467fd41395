"""A video file, as a phone writes it: cut into images with the stamps of its frames, counted from its start.

A video says neither where the camera was nor how its lens draws. Both stand beside it: `walk.mp4` with `walk.tum` (or
`odometry.tum`) and `walk.yaml` (or `camera.yaml`); or they are named.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.camera_clock import of_pictures, told
from flocc_launch.datasets.files import camera_file, camera_files
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.pixels import JPEG_QUALITY, ImageWriter
from flocc_launch.datasets.plain import ODOMETRY_STEMS, TRAJECTORY_SUFFIXES
from flocc_launch.datasets.said_twice import see_one_trajectory
from flocc_launch.datasets.source import DatasetError, Lens
from flocc_launch.datasets.writer import Progress, RecordingWriter

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm")
WHAT_ODOMETRY = (
    "a video has no odometry: give the camera's metric trajectory with --odometry FILE (from a visual-inertial "
    "odometry, or what the phone's AR software logged), with stamps in seconds from the video's first frame"
)


@dataclass(frozen=True, slots=True)
class Video:
    """What a video's head says.

    Attributes:
        frames: How many, as the head says; some cannot be read.
        rate_hz: Frames a second, on average.
        width: Pixels.
        height: Pixels.
    """

    frames: int
    rate_hz: float
    width: int
    height: int


def is_video(path: Path) -> bool:
    """Whether a path is a video file, by its suffix."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def read_head(path: Path) -> Video:
    """Read a video's head.

    Raises:
        DatasetError: OpenCV cannot read it.
    """
    import cv2

    with _opened(path) as video:
        size = [int(video.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        return Video(max(int(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0), float(video.get(cv2.CAP_PROP_FPS)), *size)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import cv2

    video = cv2.VideoCapture(str(path))
    try:
        if not video.isOpened():
            raise DatasetError(f"{path}: cannot be read as a video; write it as MP4 with H.264, or as images")
        yield video
    finally:
        video.release()


def odometry_beside(path: Path) -> Path | None:
    """The trajectory of a video: of its own name, or one of the plain names where it is its folder's only video."""
    return next(iter(trajectories_beside_video(path)), None)


def trajectories_beside_video(path: Path) -> list[Path]:
    """Files that may be a video's trajectory, in the order in which they count."""
    alone = sum(is_video(entry) for entry in path.parent.iterdir()) == 1
    stems = (path.stem, *(ODOMETRY_STEMS if alone else ()))
    names = dict.fromkeys(f"{stem}{suffix}" for stem in stems for suffix in TRAJECTORY_SUFFIXES)
    return [path.parent / name for name in names if (path.parent / name).is_file()]


def beside_notes(
    path: Path, camera: Path | None = None, odometry: Path | None = None, form: str | None = None
) -> list[str]:
    """What lies beside a video and is not read: a second trajectory, stamps of its frames, its GPS.

    Raises:
        DatasetError: Two trajectories under one name tell different motions, and none was named.
    """
    trajectories = trajectories_beside_video(path)
    if odometry is None and len(trajectories) > 1:
        see_one_trajectory(read_trajectory(trajectories[0], form)[0], trajectories, form, [])
    read = {*files_beside(path), path, camera, odometry}
    stem = path.stem.lower()
    left = [
        file.name
        for file in sorted(path.parent.iterdir())
        if file not in read
        and (file in trajectories or (file.name.lower().startswith(stem) and not file.name[len(stem) :][:1].isalnum()))
    ]
    return [f"{path}: not used: {', '.join(left[:8])}"] if left else []


def files_beside(path: Path) -> list[Path]:
    """What is read with a video, of what stands beside it."""
    odometry = odometry_beside(path)
    own = _own_lens(path)
    return [*([odometry] if odometry else []), *([own] if own else camera_files(path.parent)[:1])]


def _own_lens(path: Path) -> Path | None:
    return next((path.with_suffix(s) for s in (".toml", ".yaml", ".yml") if path.with_suffix(s).is_file()), None)


def lens_beside(path: Path, size: tuple[int, int] | None = None) -> Lens | None:
    """The camera of a video: of its own name, or the folder's; `size` is that of the video."""
    own = _own_lens(path)
    return camera_file(path.parent, size=size) if own is None else read_lens(own, size)


def convert_video(
    path: Path,
    out: Path,
    camera: Path | None = None,
    odometry: Path | None = None,
    form: str | None = None,
    every: int = 1,
    progress: Progress | None = None,
    view_rad: float | None = None,
) -> tuple[str, ...]:
    """Write a video as a recording.

    Args:
        path: The video.
        out: The recording's folder.
        camera: Intrinsics; None takes what stands beside the video.
        odometry: Trajectory; None takes what stands beside the video.
        form: Of the trajectory.
        every: Keeps one frame of so many.
        progress: Called with frames done and frames in all.
        view_rad: Horizontal field of view that is kept of a wide lens; None takes as much as there is.

    Returns:
        What was left out, one sentence each.

    Raises:
        DatasetError: There is no odometry or no intrinsics, or the video cannot be read.
    """
    file = odometry or odometry_beside(path)
    if file is None:
        raise DatasetError(f"{path}: {WHAT_ODOMETRY}")
    head = read_head(path)
    size = (head.width, head.height)
    lens = lens_beside(path, size) if camera is None else read_lens(camera, size)
    if lens is None:
        raise DatasetError(f"{path}: intrinsics are missing; name a camera file with --camera")
    lens = replace(lens, view_rad=view_rad) if view_rad is not None else lens
    trajectory, notes = read_trajectory(file, form)
    notes = (*notes, *beside_notes(path, camera, odometry, form))
    faults = video_faults(path, file, trajectory, lens, head)
    if faults:
        raise DatasetError(faults[0])
    identity = f"video {path.resolve()} every={every} odometry={file}"
    if lens.camera.agent_camera() is None:
        identity += f" of {lens.camera} view={lens.view_rad}"
    shift_s = lens.time_shift_s
    if shift_s:
        at_frames = head.rate_hz > 0 and of_pictures(
            trajectory.stamps_s.tolist(), [k / head.rate_hz for k in range(head.frames)]
        )
        notes = (*notes, f"{path}: {told(shift_s, not at_frames)}")
        shift_s = 0.0 if at_frames else shift_s
        identity += f" shift={shift_s}"
    with RecordingWriter(out, identity) as writer:
        images = ImageWriter(lens)
        writer.write_lens(images.lens)
        writer.write_trajectories(trajectory.relative_to_first(), None)
        for number, (taken_s, encoded) in enumerate(_frames(path, every), start=1):
            stamp_s = taken_s + shift_s
            if writer.last_stamp_s is None or stamp_s > writer.last_stamp_s:
                writer.add(stamp_s, *images.written(encoded, ".jpg"))
            if progress is not None:
                progress(number * every, max(head.frames, number * every))
        if writer.count == 0:
            raise DatasetError(f"{path}: no frame of it can be read")
        lost = head.frames // every - writer.count
    notes = (*notes, *lens.notes, *_uncovered(path, trajectory, head))
    return (*notes, *([f"{path}: {lost} of {head.frames // every} frames could not be read"] if lost > 1 else []))


def video_faults(path: Path, file: Path, trajectory: Trajectory, lens: Lens | None, head: Video) -> list[str]:
    """Why a video, its trajectory and its lens do not belong together, one sentence each."""
    faults = []
    if lens is not None and (head.width, head.height) != (lens.camera.width, lens.camera.height):
        faults.append(
            f"{path}: frames are {head.width}x{head.height}, but the intrinsics are for "
            f"{lens.camera.width}x{lens.camera.height}"
        )
    covered = posed_frames(trajectory, head)
    if covered is not None and covered < min(2, head.frames):
        first_s, last_s = float(trajectory.stamps_s[0]), float(trajectory.stamps_s[-1])
        steps = f" in steps of {(last_s - first_s) / (len(trajectory) - 1):.3f} s" if len(trajectory) > 1 else ""
        duration_s = head.frames / head.rate_hz
        faults.append(
            f"{file}: the trajectory is from {first_s:.3f} s to {last_s:.3f} s{steps}, but {path.name} is from 0 s to "
            f"{duration_s:.3f} s, so that {covered or 'no'} frame has a pose; "
            "stamps are seconds and count from the video's first frame"
        )
    return faults


def posed_frames(trajectory: Trajectory, head: Video) -> int | None:
    """How many frames lie within a trajectory's time, and not in a gap of it; None where the head says no rate."""
    if head.rate_hz <= 0 or head.frames == 0:
        return None
    return sum(trajectory.at(k / head.rate_hz) is not None for k in range(head.frames))


def _uncovered(path: Path, trajectory: Trajectory, head: Video) -> list[str]:
    covered = posed_frames(trajectory, head)
    if covered is None or head.frames - covered <= 1:  # the head's rate is a mean, and the last frame may be late
        return []
    where = "outside of the trajectory's time, or in a gap of it"
    return [f"{path}: {head.frames - covered} of {head.frames} frames lie {where}: no robot uses them"]


def _frames(path: Path, every: int) -> Iterator[tuple[float, bytes]]:
    """Stamps and JPEG files of a video's frames."""
    import cv2

    with _opened(path) as video:
        number = 0
        while video.grab():
            if number % every == 0:
                stamp_s = float(video.get(cv2.CAP_PROP_POS_MSEC)) * 1e-3
                found, pixels = video.retrieve()
                if found:
                    yield stamp_s, cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
            number += 1
