"""`flocc view`: a run in rerun, as a recording that its viewer opens or as a live window.

Everything is logged on one timeline, seconds since the start of the run: odometry as it was taken, map frames as they
merge, closures with both images, leaders, neighbours, and at the end the corrected trajectories beside ground truth.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.recording import Frame, Recording
from flocc_launch.dashboard.words import sentence_of
from flocc_launch.report.figure_charts import errors_after
from flocc_launch.report.figure_map import Scene, scenes
from flocc_launch.report.load import LoadedRun, load
from flocc_launch.run_folder import RunFolder
from flocc_launch.run_records import ClosureAccepted, CorrectionApplied, KeyframeCaptured
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]

TIMELINE = "run"
IMAGES_MAX = 200
COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (181, 80, 143), (201, 138, 0), (58, 155, 217), (107, 95, 199))
GREY = (130, 138, 146)


class ViewError(FloccError):
    """The run cannot be shown; one sentence says why."""


def view(folder: RunFolder, save: Path | None = None) -> str:
    """Show a run folder.

    Args:
        folder: The run.
        save: Where to write an `.rrd` file; None opens the viewer, which needs a display.

    Returns:
        What was opened or written.

    Raises:
        ViewError: rerun is not installed, or there is no display.
    """
    rr = rerun_module()
    recording = rr.RecordingStream("flocc", recording_id=folder.run().scenario)
    if save is None:
        try:
            recording.spawn()
        except (RuntimeError, OSError) as error:
            raise ViewError(f"the viewer cannot be opened ({error}); write a file with --save RUN.rrd") from error
    else:
        recording.save(save)
    log_run(rr, recording, load(folder), images_of(folder))
    recording.flush()
    return "opened the viewer" if save is None else str(save)


def rerun_module() -> Any:
    """The rerun package, an extra.

    Raises:
        ViewError: It is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise ViewError("flocc view needs rerun: pip install 'flocc[view]'") from error
    return rerun


def images_of(folder: RunFolder) -> dict[str, Recording]:
    """Recordings with images, by robot; a recording that cannot be read is left out."""
    found = {}
    for robot in folder.run().robots:
        path = folder.recording(robot)
        try:
            if path is not None:
                found[robot] = Recording.open(path)
        except FloccError:
            continue
    return found


def log_run(rr: Any, recording: Any, loaded: LoadedRun, images: dict[str, Recording]) -> None:
    """Log a whole run: first what moved and happened, then how it ended."""
    log_events(rr, recording, loaded)
    log_closure_images(rr, recording, loaded, images)
    for scene in scenes(loaded):
        log_scene(rr, recording, loaded, scene)
    log_errors(rr, recording, loaded)


def log_events(rr: Any, recording: Any, loaded: LoadedRun) -> None:
    """Odometry in its robot's frame, map frames over time, and sentences."""
    taken: dict[str, list[Float]] = {}
    for event in loaded.events:
        recording.set_time(TIMELINE, duration=event.t)
        where = f"live/{event.robot}"
        if isinstance(event, KeyframeCaptured):
            taken.setdefault(event.robot, []).append(np.array(event.T_odom_body[:3]))
            line = rr.LineStrips3D([np.array(taken[event.robot])], colors=[colour_of(loaded, event.robot)])
            recording.log(f"{where}/odometry", line)
        elif isinstance(event, CorrectionApplied):
            T = pose_from_tq(np.array(event.T_map_odom))
            recording.log(where, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        said = sentence_of(event)
        if said is not None:
            recording.log("events", rr.TextLog(f"{event.robot}: {said}", color=colour_of(loaded, event.robot)))


def log_closure_images(rr: Any, recording: Any, loaded: LoadedRun, images: dict[str, Recording]) -> None:
    """The two images of each accepted closure, when it was accepted; at most `IMAGES_MAX` closures."""
    accepted = [event for event in loaded.events if isinstance(event, ClosureAccepted)]
    for event in accepted[:IMAGES_MAX]:
        recording.set_time(TIMELINE, duration=event.t)
        for side, keyframe in (("query", event.query), ("match", event.match)):
            found = frame_of(loaded, images, KeyframeId.parse(keyframe))
            if found is not None:
                source, frame = found
                recording.log(f"closure/{side}", rr.Image(source.load_image(frame).pixels).compress(jpeg_quality=80))
        recording.log("closure/probability", rr.Scalars(event.probability))


def frame_of(loaded: LoadedRun, images: dict[str, Recording], keyframe: KeyframeId) -> tuple[Recording, Frame] | None:
    """The recording's frame that a keyframe was, None where it is not known."""
    source, track = images.get(keyframe.log.robot), loaded.tracks.get(keyframe.log.robot)
    if source is None or track is None or keyframe.index >= len(track):
        return None
    frame = min(source.frames, key=lambda frame: abs(frame.stamp_s - track.stamps_s[keyframe.index]))
    return source, frame


def log_scene(rr: Any, recording: Any, loaded: LoadedRun, scene: Scene) -> None:
    """Trajectories of one scene of the report, with ground truth and closures; they hold at any time."""
    place = scene.name.lower().replace(", in ", "/").replace(" ", "_")
    for robot, points in scene.lines_m.items():
        line = rr.LineStrips3D([known(points)], colors=[colour_of(loaded, robot)])
        recording.log(f"{place}/{robot}", line, static=True)
    for robot, points in scene.truth_m.items():
        recording.log(f"{place}/truth/{robot}", rr.LineStrips3D([known(points)], colors=[GREY]), static=True)
    if scene.with_closures:
        drawn = list(closure_lines(loaded, scene))
        strips, colours = [line for line, _ in drawn], [colour for _, colour in drawn]
        recording.log(f"{place}/closures", rr.LineStrips3D(strips, colors=colours), static=True)


def closure_lines(loaded: LoadedRun, scene: Scene) -> Iterator[tuple[Float, tuple[int, int, int]]]:
    """Lines between the ends of accepted closures, from blue (probability 0) to yellow (1)."""
    for pair in loaded.pairs:
        ends = [scene.lines_m.get(keyframe.log.robot) for keyframe in (pair.query, pair.match)]
        if not pair.accepted or ends[0] is None or ends[1] is None:
            continue
        if pair.query.index < len(ends[0]) and pair.match.index < len(ends[1]):
            p = 0.5 if pair.probability is None else pair.probability
            yield (
                np.array([ends[0][pair.query.index], ends[1][pair.match.index]]),
                (int(254 * p), int(34 + 198 * p), 78),
            )


def log_errors(rr: Any, recording: Any, loaded: LoadedRun) -> None:
    """Error of every corrected keyframe, over the recording's time."""
    for robot, errors in errors_after(loaded).items():
        stamps_s = loaded.tracks[robot].stamps_s
        for stamp_s, error in zip(stamps_s, errors, strict=True):
            if np.isfinite(error):
                recording.set_time("recording", duration=float(stamp_s - stamps_s[0]))
                recording.log(f"error_m/{robot}", rr.Scalars(float(error)))


def known(points_m: Float) -> Float:
    """The points without those that are not known."""
    return points_m[np.isfinite(points_m).all(axis=1)]


def colour_of(loaded: LoadedRun, robot: str) -> tuple[int, int, int]:
    """A robot's colour, as in the report."""
    return COLOURS[loaded.robots.index(robot) % len(COLOURS)] if robot in loaded.robots else GREY
