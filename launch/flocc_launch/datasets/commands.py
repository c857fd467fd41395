"""What `flocc dataset info | convert | split` do: look at a data set, turn it into recordings, cut it into robots."""

import logging
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flocc_agent.lenses import CameraModel, LensKind
from flocc_agent.runtime.pictures import FULL
from flocc_agent.runtime.recording import MASK, read_mask
from flocc_agent.runtime.straightening import Straightener
from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.bag_convert import BagOptions, convert_bag
from flocc_launch.datasets.bag_layout import Layout
from flocc_launch.datasets.bag_messages import IMAGE_TYPES
from flocc_launch.datasets.bag_reader import Bag, is_bag
from flocc_launch.datasets.clocks import ClockFit, measured
from flocc_launch.datasets.cut import cut
from flocc_launch.datasets.detect import check_times, not_taken, read_source, team_folder
from flocc_launch.datasets.drift import DriftKind, DriftSpec, drifted, fitted, kind_of, summary
from flocc_launch.datasets.names import robot_names
from flocc_launch.datasets.picture_check import seen_faults
from flocc_launch.datasets.plain import ODOMETRY_STEMS, TRUTH_STEMS, expected_files, taken_file
from flocc_launch.datasets.source import DatasetError, Source
from flocc_launch.datasets.truth_clock import truth_faults
from flocc_launch.datasets.unread import unused
from flocc_launch.datasets.video import (
    WHAT_ODOMETRY,
    beside_notes,
    convert_video,
    is_video,
    lens_beside,
    odometry_beside,
    posed_frames,
    read_head,
    video_faults,
)
from flocc_launch.datasets.writer import Progress, write_source
from flocc_protocol.errors import FloccError

logger = logging.getLogger(__name__)

COUNTS_FOR = {
    "--format": ("folder",),
    "--image-topic": ("bag",),
    "--odometry-topic": ("bag",),
    "--truth": ("bag",),
    "--every": ("bag", "video"),
    "--jpeg": ("bag",),
    "--time-offset": ("folder",),
}
"""Options of `convert` that say something of some kinds of sources only."""
ODOMETRY_MADE = "odometry_made.txt"
"""In a recording: how its odometry was made of ground truth."""


@dataclass(frozen=True, slots=True)
class Info:
    """What a data set holds; values not known are None.

    Attributes:
        path: The folder.
        format: Which reader read it.
        images: How many.
        posed: How many of them lie within the trajectory's time, and not in a gap of it.
        from_s: Stamp of the first image.
        to_s: Stamp of the last image.
        camera: Intrinsics.
        odometry_poses: Poses that odometry has.
        truth_poses: Poses that the ground truth has.
        length_m: Distance travelled, by ground truth or else by odometry.
        faults: What is wrong with it, one sentence each.
        topics: Of a bag, with types and numbers of messages.
        notes: What was left out, or concluded where nothing said it.
        robots: Of a bag, which topics belong together.
        odometry_file: Where odometry was read, where it has a file of its own.
        truth_file: The same of ground truth.
    """

    path: Path
    format: str
    images: int
    posed: int | None
    from_s: float
    to_s: float
    camera: CameraModel | None
    odometry_poses: int | None
    truth_poses: int | None
    length_m: float | None
    faults: tuple[str, ...]
    topics: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()
    odometry_file: Path | None = None
    truth_file: Path | None = None


def info(path: Path, format_name: str | None = None, form: str | None = None) -> Info:
    """Look at a data set without writing anything.

    Args:
        path: The folder or bag.
        format_name: One of `READERS`; None detects it.
        form: Of trajectories (`trajectory_text.FORMS`); None finds out.

    Raises:
        DatasetError: Unknown, or nothing in it can be used.
    """
    if is_bag(path):
        return _bag_info(path)
    if is_video(path):
        return _video_info(path)
    source = read_source(path, format_name, form=form)
    travelled = source.truth or source.odometry
    return Info(
        path=path,
        format=source.format,
        images=len(source.images),
        posed=_posed(source, travelled),
        from_s=source.images[0][0],
        to_s=source.images[-1][0],
        camera=source.lens.camera if source.lens else None,
        odometry_poses=len(source.odometry) if source.odometry else None,
        truth_poses=len(source.truth) if source.truth else None,
        length_m=travelled.length_m() if travelled else None,
        faults=(*source.faults, *_missing(source), *_mask_faults(source), *_seen(source, form is not None)),
        notes=(*source.notes, *unused(source)),
        odometry_file=taken_file(path, ODOMETRY_STEMS) if source.odometry else None,
        truth_file=taken_file(path, TRUTH_STEMS) if source.truth else None,
    )


def _mask_faults(source: Source) -> list[str]:
    """Why a folder's mask cannot be used."""
    try:
        if source.lens is not None:
            read_mask(source.path / MASK, Straightener(source.lens.camera, source.lens.view_rad))
    except (FloccError, ValueError) as error:
        return [str(error)]
    return []


def _tell_uncovered(source: Source, moved: Trajectory) -> None:
    """Log how many images no pose covers: nothing fails, but no robot uses them."""
    covered, count = _posed(source, moved), len(source.images)
    if covered is not None and covered < count:
        where = "outside of the trajectory's time, or in a gap of it"
        logger.warning("%s: %d of %d images lie %s: no robot uses them", source.path, count - covered, count, where)


def _posed(source: Source, trajectory: Trajectory | None) -> int | None:
    if trajectory is None:
        return None
    return sum(trajectory.at(stamp_s) is not None for stamp_s, _ in source.images)


def _missing(source: Source) -> list[str]:
    """What a recording needs and the data set does not have."""
    motion, lens = source.odometry or source.truth, source.lens
    lacks = f"{source.path}: has neither odometry nor ground truth ({expected_files(source.path)})"
    return [*([] if motion else [lacks]), *([] if lens else [f"{source.path}: intrinsics are missing"])]


def info_lines(found: Info) -> Iterator[tuple[str, str]]:
    """Yield names and values of what was found, for people."""
    camera, poses = found.camera, {"odometry": found.odometry_poses, "ground truth": found.truth_poses}
    files = {"odometry": found.odometry_file, "ground truth": found.truth_file}
    yield "path", str(found.path)
    yield "format", found.format
    covered = "" if found.posed in (None, found.images) else f"; {found.posed} of them within the trajectory"
    yield "images", f"{found.images}, from {found.from_s:.3f} s to {found.to_s:.3f} s{covered}"
    if found.format == "bag":
        yield from (("topic", topic) for topic in found.topics)
        yield from (("robot", robot) for robot in found.robots)
    else:
        yield "camera", "none" if camera is None else _told(camera)
        yield from ((name, _poses_told(count, files[name])) for name, count in poses.items())
        yield "length", "not known" if found.length_m is None else f"{found.length_m:.1f} m"
    yield from (("note", note) for note in found.notes)
    yield from (("fault", fault) for fault in found.faults)


def _poses_told(count: int | None, file: Path | None) -> str:
    return "none" if count is None else f"{count} poses" + (f", {file.name}" if file is not None else "")


def _told(camera: CameraModel) -> str:
    kind = "" if camera.kind is LensKind.PINHOLE else f"{camera.kind}, "
    return f"{kind}{camera.width}x{camera.height}, fx {camera.fx:g} fy {camera.fy:g}"


def _bag_info(path: Path) -> Info:
    with Bag(path) as bag:
        images, start_ns, end_ns = _images_of(bag)
        robots, faults = _robots_of(Layout.of(bag))
        return Info(
            path=path,
            format="bag",
            images=images,
            posed=None,
            from_s=start_ns * 1e-9,
            to_s=end_ns * 1e-9,
            camera=None,
            odometry_poses=None,
            truth_poses=None,
            length_m=None,
            faults=((bag.damage,) if bag.damage else ()) + tuple(faults),
            topics=tuple(str(topic) for topic in bag.topics.values()),
            robots=tuple(robots),
        )


def _images_of(bag: Bag) -> tuple[int, int, int]:
    """How many images a bag has, and its first and last time: of its index, else of its images, which are counted."""
    topics = [topic for topic in bag.topics.values() if topic.type in IMAGE_TYPES]
    if bag.start_ns is not None and bag.end_ns is not None:
        return sum(topic.count or 0 for topic in topics), bag.start_ns, bag.end_ns
    count, start_ns, end_ns = 0, 0, 0
    for _, stamp_ns, _ in bag.raw([topic.name for topic in topics]):
        count, start_ns, end_ns = count + 1, start_ns or stamp_ns, max(end_ns, stamp_ns)
    return count, start_ns, end_ns


def _robots_of(layout: Layout) -> tuple[list[str], list[str]]:
    """Which topics belong together, one sentence for each robot, and why a bag cannot be converted as it is."""
    try:
        robots = layout.robots()
    except DatasetError as error:
        return [], [str(error)]
    sentences, faults = [], []
    for robot in robots:
        sentences.append(str(robot))
        try:
            layout.mounting(robot)
        except DatasetError as error:
            faults.append(str(error))
    return sentences, faults


def _video_info(path: Path) -> Info:
    head, odometry, lens = read_head(path), odometry_beside(path), lens_beside(path)
    trajectory = None if odometry is None else read_trajectory(odometry)[0]
    lacks = [
        *([f"{path}: {WHAT_ODOMETRY}"] if odometry is None else []),
        *([f"{path}: intrinsics are missing; name a camera file with --camera"] if lens is None else []),
        *([] if odometry is None or trajectory is None else video_faults(path, odometry, trajectory, lens, head)),
    ]
    return Info(
        path=path,
        format="video",
        images=head.frames,
        posed=None if trajectory is None else posed_frames(trajectory, head),
        from_s=0.0,
        to_s=max(head.frames - 1, 0) / head.rate_hz if head.rate_hz > 0 else 0.0,
        camera=lens.camera if lens else None,
        odometry_poses=None if trajectory is None else len(trajectory),
        truth_poses=None,
        length_m=None if trajectory is None else trajectory.length_m(),
        faults=tuple(lacks),
        notes=tuple(beside_notes(path)),
    )


def infos(path: Path, format_name: str | None = None, form: str | None = None) -> Iterator[Info]:
    """Look at what a path holds: one data set, bag or video, or those of a team in a folder.

    Raises:
        DatasetError: Nothing that is known is there; or, after all others of a team, some of it cannot be used.
    """
    team = team_folder(path) if format_name is None else {}
    if not team:
        yield info(path, format_name, form)
        return
    unusable = []
    for robot, entry in team.items():
        try:
            yield info(entry, None, form)
        except FloccError as error:
            logger.warning("%s", error)
            unusable.append(robot)
    others = not_taken(path, team)
    if others:
        logger.warning("%s: not taken, because they are no data set, bag or video: %s", path, ", ".join(others[:12]))
    if unusable:
        raise DatasetError(f"{path}: {len(unusable)} of {len(team)} robots cannot be used: {', '.join(unusable[:12])}")


def clock(path: Path, odometry: Path | None = None, camera: Path | None = None, form: str | None = None) -> ClockFit:
    """Measure how far a data set's pictures and its trajectory (or another one) are apart in time.

    Raises:
        DatasetError: There is no trajectory or calibration, or the pictures do not tell.
    """
    source = read_source(path, None, camera, form if odometry is None else None, None, odometry)
    trajectory = source.odometry or source.truth if odometry is None else read_trajectory(odometry, form)[0]
    if trajectory is None:
        raise DatasetError(f"{path}: has neither odometry nor ground truth ({expected_files(path)})")
    return measured(source.images, source.lens.camera if source.lens else None, trajectory)


def convert(
    path: Path,
    out: Path,
    *,
    format_name: str | None = None,
    camera: Path | None = None,
    odometry: Path | None = None,
    drift: DriftSpec | None = None,
    seed: int = 0,
    image_topic: str | None = None,
    odometry_topic: str | None = None,
    truth: Path | None = None,
    every: int = 1,
    jpeg: bool = False,
    form: str | None = None,
    robot: str | None = None,
    view_deg: float | None = None,
    time_offset_s: float = 0.0,
    progress: Progress | None = None,
) -> Path:
    """Write a data set or a bag as one recording; a conversion that was cut short goes on where it ended.

    Args:
        path: The data set.
        out: The recording's folder.
        format_name: One of `READERS`; None detects it.
        camera: Intrinsics, TOML or YAML, in place of the folder's.
        odometry: TUM trajectory of the robot's odometry, in place of the folder's.
        drift: Makes odometry from the ground truth; None takes the folder's odometry, else the truth itself.
        seed: Of the drift.
        image_topic: Of a bag; None takes the only one there is.
        odometry_topic: Of a bag; None takes the only one there is.
        truth: TUM file with ground truth, for a bag.
        every: Of a bag, keeps one image of so many.
        jpeg: Of a bag, writes raw images as JPEG instead of lossless PNM.
        form: Of trajectories in text (`trajectory_text.FORMS`); None finds out.
        robot: Of a bag of several robots, the one to convert; None converts all, each into a folder in `out`.
        view_deg: Horizontal field of view that is kept of a wide lens, degrees; None takes as much as there is.
        time_offset_s: Added to the stamps of a folder's odometry and ground truth.
        progress: Called with images done and images in all.

    Returns:
        The recording's folder.

    Raises:
        DatasetError: Nothing can be used; or a part was bad, and the message says so and what was kept.
    """
    kind = "bag" if is_bag(path) else "video" if is_video(path) else "folder"
    given = {
        "--format": format_name is not None,
        "--image-topic": image_topic is not None,
        "--odometry-topic": odometry_topic is not None,
        "--truth": truth is not None,
        "--every": every != 1,
        "--jpeg": jpeg,
        "--time-offset": time_offset_s != 0.0,
    }
    if path.exists():
        _refuse_unused(path, kind, [option for option, is_given in given.items() if is_given])
    if not math.isfinite(time_offset_s):
        raise DatasetError(f"--time-offset must be a finite number of seconds, not {time_offset_s}")
    if kind == "bag":
        options = BagOptions(
            image_topic,
            odometry_topic,
            camera,
            odometry,
            truth,
            every,
            jpeg,
            form=form,
            robot=robot,
            view_rad=None if view_deg is None else math.radians(view_deg),
        )
        return convert_bag(path, out, options, progress)
    if kind == "video":
        view_rad = None if view_deg is None else math.radians(view_deg)
        for note in convert_video(path, out, camera, odometry, form, every, progress, view_rad):
            logger.warning("%s", note)
        return out
    own_form = form if odometry is None else None
    source = _viewed(read_source(path, format_name, camera, own_form, time_offset_s, odometry), view_deg)
    _tell(source, camera, odometry)
    identity = _identity(
        f"convert time_offset_s={time_offset_s}" if time_offset_s else "convert", path, source, drift, seed
    )
    own = None if odometry is None else _given_odometry(source, odometry, form, time_offset_s)
    _see_pictures(source, own, form is not None)
    moved = own or _odometry(source, drift, np.random.default_rng([seed, 0]))
    _tell_uncovered(source, moved)
    write_source(source, out, moved, identity, progress)
    _note_drift(out, drift if own is None else None)
    _complain(source, out, len(source.images))
    return out


def _refuse_unused(path: Path, kind: str, options: Sequence[str]) -> None:
    """Refuses options that say nothing of such a source: what a person asked for is never left undone in silence."""
    for option in options:
        if kind not in COUNTS_FOR[option]:
            kinds = " and ".join(f"a {each}" for each in COUNTS_FOR[option])
            raise DatasetError(f"{path}: is a {kind}, but {option} counts for {kinds} only; leave it out")


def split(
    path: Path,
    out: Path,
    robots: int = 3,
    *,
    seed: int = 0,
    drift: DriftSpec | None = None,
    overlap_s: float = 0.0,
    format_name: str | None = None,
    camera: Path | None = None,
    form: str | None = None,
    kind: DriftKind | None = None,
    view_deg: float | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Cut one data set by time into recordings of several robots, which then run at the same time.

    Every part starts at 0 s, with its odometry at the identity. A data set without odometry gets it from its ground
    truth, with seeded drift.

    Args:
        path: The data set, or a recording.
        out: Gets one folder per robot: alpha, bravo, charlie.
        robots: How many parts.
        seed: Of the drift; each robot has its own.
        drift: Makes odometry from the ground truth; None takes the data set's own, else `needed_drift`.
        kind: What carried the camera, where odometry is made; None tells it by the data set and the motion.
        overlap_s: How much longer each part is than its share, at its end.
        format_name: One of `READERS`; None detects it.
        camera: Intrinsics in place of the folder's.
        form: Of trajectories in text (`trajectory_text.FORMS`); None finds out.
        view_deg: Horizontal field of view that is kept of a wide lens, degrees; None takes as much as there is.
        progress: Called with images done and images in all.

    Returns:
        The recordings' folders, in order of time.

    Raises:
        DatasetError: Nothing can be used, there are fewer images than robots, or a part was bad; the good one is kept.
    """
    source = _viewed(read_source(path, format_name, camera, form), view_deg)
    _tell(source, camera)
    _see_pictures(source, None, form is not None)
    if not 1 <= robots <= len(source.images) // 2:
        raise DatasetError(f"{path}: {len(source.images)} images cannot be cut into {robots} robots")
    identity = _identity(f"split overlap_s={overlap_s}", path, source, drift or needed_drift(source, kind), seed)
    folders = []
    for index, name in enumerate(robot_names(robots)):
        part = cut(source, index, robots, overlap_s)
        rng = np.random.default_rng([seed, index])
        spec = drift or needed_drift(part, kind)
        moved = _odometry(part, spec, rng)
        write_source(part, out / name, moved, f"{identity} part {index + 1} of {robots}", progress)
        _note_drift(out / name, spec)
        folders.append(out / name)
    _complain(source, out, len(source.images))
    return folders


def needed_drift(source: Source, kind: DriftKind | None = None) -> DriftSpec | None:
    """How odometry is made of ground truth where a data set has none of its own; None where it has.

    Args:
        source: The data set, or a robot's part of it.
        kind: What carried the camera; None tells it by the data set and the motion.
    """
    if source.odometry is not None or source.truth is None:
        return None
    return fitted(kind or kind_of(source.format, source.truth), source.truth.length_m())


def _note_drift(recording: Path, spec: DriftSpec | None) -> None:
    """Say in a recording how its odometry was made, for the report of a run."""
    if spec is not None:
        (recording / ODOMETRY_MADE).write_text(summary(spec) + "\n", encoding="utf-8")


def _viewed(source: Source, view_deg: float | None) -> Source:
    """The source with the field of view that is wanted of its lens."""
    if view_deg is None or source.lens is None:
        return source
    return replace(source, lens=replace(source.lens, view_rad=math.radians(view_deg)))


def _tell(source: Source, *given: Path | None) -> None:
    """Log what was left out or concluded, and what lies there unread; a conversion goes on."""
    _log(source.notes)
    _log(unused(source, *given))


def _log(notes: Iterable[str]) -> None:
    for note in notes:
        logger.warning("%s", note)


def _see_pictures(source: Source, given: Trajectory | None, is_settled: bool) -> None:
    """Log what pictures contradict of the trajectory that is used.

    Raises:
        DatasetError: As `seen_faults`.
    """
    trajectory = given or source.odometry or source.truth
    if trajectory is not None:
        _log((*seen_faults(source, trajectory, is_settled), *truth_faults(source, trajectory)))


def _seen(source: Source, is_settled: bool) -> tuple[str, ...]:
    """The same in sentences, where nothing is converted."""
    trajectory = source.odometry or source.truth
    try:
        if trajectory is None:
            return ()
        return (*seen_faults(source, trajectory, is_settled), *truth_faults(source, trajectory))
    except DatasetError as error:
        return (str(error),)


def _given_odometry(source: Source, path: Path, form: str | None, time_offset_s: float) -> Trajectory:
    read, notes = read_trajectory(path, form, [stamp_s for stamp_s, _ in source.images])
    given = read.later(time_offset_s)
    _log(note for note in notes if note not in source.notes)
    check_times(source, given, path)
    return given.relative_to_first()


def _odometry(source: Source, drift: DriftSpec | None, rng: np.random.Generator) -> Trajectory:
    if drift is not None:
        if source.truth is None:
            raise DatasetError(f"{source.path}: has no ground truth to make drifting odometry from")
        return drifted(source.truth, drift, rng, source.up_world)
    found = source.odometry or source.truth
    if found is None:
        raise DatasetError(
            f"{source.path}: has neither odometry nor ground truth ({expected_files(source.path)}); "
            "name a TUM file with flocc dataset convert --odometry"
        )
    return found.relative_to_first()


def _complain(source: Source, out: Path, count: int) -> None:
    if source.faults:
        raise DatasetError(f"{source.faults[0]}; the {count} images that are good were kept in {out}")


def _identity(command: str, path: Path, source: Source, drift: DriftSpec | None, seed: int) -> str:
    errors = drift.model_dump_json() if drift is not None else "default"
    lens, changed = source.lens, ""
    if lens is not None and (lens.camera.agent_camera() is None or source.levels != FULL):
        changed = f" of {lens.camera} view={lens.view_rad} {source.levels}"
    if lens is not None and lens.time_shift_s:
        changed += f" shift={lens.time_shift_s}"
    return f"{command} {path.resolve()} format={source.format} drift={errors} seed={seed}{changed}"
