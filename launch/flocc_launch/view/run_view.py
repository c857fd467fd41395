"""`flocc view`: a run in rerun, in its viewer or as a file that the viewer opens.

Everything is logged on one timeline, seconds since the start of the run: what happened (`view_drawing`), and for a run
that is over its trajectories before and after beside ground truth, its errors, and what is left of each closure.
"""

import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.extras import to_install
from flocc_agent.geometry import inverse, pose_from_tq
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.robot_result import ClosureKnown
from flocc_launch.report.figure_charts import errors_after
from flocc_launch.report.figure_map import MapScene, scenes
from flocc_launch.runs.loaded_run import LoadedRun, load
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.view.drawing import COLOURS, GREY, TIMELINE, Colour, Drawing, confidence_colour
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]


DISK_BLOCK_BYTES = 4096


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
    loaded = load(folder)
    recording = opened(rr, loaded.run.scenario, save)
    drawing = Drawing(rr, recording, list(loaded.robots), images_of(folder))
    for event in loaded.events:
        drawing.take(event)
    for scene in scenes(loaded):
        log_scene(rr, recording, loaded, scene)
    log_errors(rr, recording, loaded)
    log_residuals(rr, recording, loaded)
    return closed(recording, save, "opened the viewer")


def closed(recording: Any, save: Path | None, shown: str) -> str:
    """End a rerun recording; what was opened or written.

    Raises:
        ViewError: The file is cut off, which rerun does not always tell.
    """
    try:
        recording.flush()
    except (RuntimeError, OSError) as error:
        raise ViewError(f"{save or 'the viewer'}: cannot be written ({error})") from error
    if save is not None and shutil.disk_usage(save.resolve().parent).free < DISK_BLOCK_BYTES:
        raise ViewError(f"{save}: the disk is full, and the file is cut off: free some room, or choose another --save")
    return shown if save is None else str(save)


def rerun_module() -> Any:
    """The rerun package, an extra.

    Raises:
        ViewError: It is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise ViewError(f"flocc view needs rerun: {to_install('view')}") from error
    return rerun


def opened(rr: Any, name: str, save: Path | None) -> Any:
    """A rerun recording that goes into a file, or into the viewer.

    Raises:
        ViewError: There is no display, the viewer cannot be opened, or the file cannot be written.
    """
    recording = rr.RecordingStream("flocc", recording_id=name)
    try:
        if save is not None:
            recording.save(save)
        elif has_display():
            recording.spawn()
        else:
            raise ViewError("there is no display to open the viewer on; write a file with --save RUN.rrd")
    except (RuntimeError, OSError) as error:
        what = "the viewer cannot be opened" if save is None else f"{save}: cannot be written"
        raise ViewError(f"{what} ({error}); write a file with --save RUN.rrd") from error
    recording.send_blueprint(blueprint())
    return recording


def blueprint() -> Any:
    """How the viewer opens: the maps, beside them the images of closures, the solver's curves, errors and events."""
    import rerun.blueprint as rrb

    images = rrb.Horizontal(
        rrb.Spatial2DView(origin="closure/query", name="closure: query"),
        rrb.Spatial2DView(origin="closure/match", name="closure: match"),
    )
    curves = rrb.Tabs(
        rrb.TimeSeriesView(origin="solver", name="solver"),
        rrb.TimeSeriesView(origin="closure", name="probability of closures"),
        rrb.TimeSeriesView(origin="residual", name="what is left of closures"),
        rrb.TimeSeriesView(origin="error_m", name="error, m"),
    )
    outside = [f"- /{name}/**" for name in ("closure", "solver", "residual", "error_m", "events")]
    scene = rrb.Spatial3DView(origin="/", contents=["+ $origin/**", *outside], name="maps")
    events = rrb.TextLogView(origin="events", name="events")
    return rrb.Blueprint(rrb.Horizontal(scene, rrb.Vertical(images, curves, events), column_shares=[2, 1]))


def has_display() -> bool:
    """Whether windows can be opened."""
    return not sys.platform.startswith("linux") or any(os.environ.get(key) for key in ("DISPLAY", "WAYLAND_DISPLAY"))


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


def log_scene(rr: Any, recording: Any, loaded: LoadedRun, scene: MapScene) -> None:
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


def closure_lines(loaded: LoadedRun, scene: MapScene) -> Iterator[tuple[Float, Colour]]:
    """Lines between the ends of accepted closures, coloured by their probability."""
    for pair in loaded.pairs:
        ends = [scene.lines_m.get(keyframe.log.robot) for keyframe in (pair.query, pair.match)]
        if not pair.accepted or ends[0] is None or ends[1] is None:
            continue
        if pair.query.index < len(ends[0]) and pair.match.index < len(ends[1]):
            line = np.array([ends[0][pair.query.index], ends[1][pair.match.index]])
            yield line, confidence_colour(pair.probability)


def log_errors(rr: Any, recording: Any, loaded: LoadedRun) -> None:
    """Error of every corrected keyframe, over the recording's time."""
    for robot, errors in errors_after(loaded).items():
        stamps_s = loaded.tracks[robot].stamps_s
        for stamp_s, error in zip(stamps_s, errors, strict=True):
            if np.isfinite(error):
                recording.set_time("recording", duration=float(stamp_s - stamps_s[0]))
                recording.log(f"error_m/{robot}", rr.Scalars(float(error)))


def log_residuals(rr: Any, recording: Any, loaded: LoadedRun) -> None:
    """How far each used closure's measurement is from the corrected poses, at the time when it was accepted."""
    accepted_s = {(str(pair.query), str(pair.match)): pair.at_s for pair in loaded.pairs if pair.accepted}
    for (query, match), (metres, radians) in sorted(residuals(loaded).items()):
        at_s = accepted_s.get((query, match))
        if at_s is not None:
            recording.set_time(TIMELINE, duration=at_s)
            recording.log("residual/translation_m", rr.Scalars(metres))
            recording.log("residual/rotation_rad", rr.Scalars(radians))


def residuals(loaded: LoadedRun) -> dict[tuple[str, str], tuple[float, float]]:
    """Translation (m) and rotation (rad) that are left of each closure whose scale the last solution knows."""
    T_map_camera = {robot: corrected_cameras(loaded, robot) for robot in loaded.results}
    closures = {
        (c.query, c.match): c for result in loaded.results.values() for c in result.closures if c.scale or c.metric
    }
    found = {}
    for ends, closure in closures.items():
        poses = [pose_of(T_map_camera, KeyframeId.parse(keyframe)) for keyframe in ends]
        if poses[0] is not None and poses[1] is not None and closure.T_query_match_unscaled is not None:
            found[ends] = left_over(closure, inverse(poses[0]) @ poses[1])
    return found


def corrected_cameras(loaded: LoadedRun, robot: str) -> Float:
    """Corrected camera poses (N, 4, 4) of one robot, NaN where it has none."""
    mounted = loaded.results[robot].T_body_camera
    T_body_camera = np.eye(4) if mounted is None else pose_from_tq(np.array(mounted))
    return np.asarray(loaded.tracks[robot].T_map_body @ T_body_camera)


def pose_of(T_map_camera: dict[str, Float], keyframe: KeyframeId) -> Float | None:
    """A keyframe's corrected camera pose (4, 4), None where it has none."""
    poses = T_map_camera.get(keyframe.log.robot)
    if poses is None or keyframe.index >= len(poses) or not np.isfinite(poses[keyframe.index]).all():
        return None
    return np.asarray(poses[keyframe.index])


def left_over(closure: ClosureKnown, T_query_match: Float) -> tuple[float, float]:
    """Translation (m) and rotation (rad) between a closure's measurement and where its cameras ended."""
    measured = pose_from_tq(np.array(closure.T_query_match_unscaled))
    translation_m = (closure.scale or 1.0) * measured[:3, 3] - T_query_match[:3, 3]
    turned = measured[:3, :3].T @ T_query_match[:3, :3]
    cosine = np.clip((np.trace(turned) - 1.0) / 2.0, -1.0, 1.0)
    return float(np.linalg.norm(translation_m)), float(np.arccos(cosine))


def known(points_m: Float) -> Float:
    """The points without those that are not known."""
    return points_m[np.isfinite(points_m).all(axis=1)]


def colour_of(loaded: LoadedRun, robot: str) -> Colour:
    """A robot's colour, as in the report."""
    return COLOURS[loaded.robots.index(robot) % len(COLOURS)] if robot in loaded.robots else GREY
