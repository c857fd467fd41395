"""Converts a bag to a recording in one pass, with memory that does not grow, and goes on where it was cut short."""

import json
import logging
from collections import Counter
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from flocc_agent.runtime.pictures import FULL, PictureError
from flocc_agent.runtime.pose_limits import oddity
from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.bag_clock import ClockChoice, choose_clock
from flocc_launch.datasets.bag_layout import Layout, PoseSource, RobotTopics, is_truth, listed, only
from flocc_launch.datasets.bag_messages import (
    CAMERA_TYPE,
    IMAGE_TYPES,
    POSE_TYPES,
    header_ns,
    image_file,
    lens_of,
    sampled_levels,
    stamp_ns,
)
from flocc_launch.datasets.bag_poses import PoseDecoder, TransformDecoder
from flocc_launch.datasets.bag_reader import Bag, BagTopic
from flocc_launch.datasets.camera_clock import of_pictures, told
from flocc_launch.datasets.covered import Covered
from flocc_launch.datasets.intrinsics import believable, read_lens
from flocc_launch.datasets.journeys import JourneyWatch
from flocc_launch.datasets.names import robot_name
from flocc_launch.datasets.pixels import ImageWriter, levels_note
from flocc_launch.datasets.source import DatasetError, Lens
from flocc_launch.datasets.stamp_gaps import StampGaps
from flocc_launch.datasets.writer import PoseWriter, Progress, RecordingWriter

logger = logging.getLogger(__name__)

CHECKPOINT_MESSAGES = 1000
STRAY = "the stamp is zero, or more than a minute off that of the others"
UNTURNED_MAX = 1000
STAMPS_TRIED = 60
"""Of the first pictures and poses, to see whether they are stamped alike."""
DAMAGED_RATIO_MAX = 0.2
"""A topic of which more messages are damaged is refused."""
JOURNEYS_MAX, JOURNEYS_RATIO_MAX = 3, 0.02
"""Odometry that begins anew more often, and in more of its messages, is of two programs."""
HEADER_BYTES = 12
"""Of a raw message before the name of its frame."""


@dataclass(frozen=True, slots=True)
class BagOptions:
    """How a bag is converted.

    Attributes:
        image_topic: None takes the only one there is.
        odometry_topic: None takes the only one there is, where `odometry` is None.
        camera: Intrinsics, TOML or YAML, or a lens; None takes the bag's CameraInfo.
        odometry: TUM file in place of a topic.
        truth: TUM file with ground truth.
        every: Keeps one image of so many.
        jpeg: Raw images are written as JPEG instead of PNM: a tenth of the size, a fraction of the speed.
        from_zero: Stamps are counted from the first image, so that recordings of different days run together.
        origin_m: Subtracted from ground truth's positions.
        form: Of `odometry` and `truth` (`trajectory_text.FORMS`); None finds out.
        published_form: Of files of a data set's own that do not name their columns.
        robot: Which robot of a bag of several, by its name; None takes the only one there is.
    """

    image_topic: str | None = None
    odometry_topic: str | None = None
    camera: Path | Lens | None = None
    odometry: Path | None = None
    truth: Path | None = None
    every: int = 1
    jpeg: bool = False
    from_zero: bool = False
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    form: str | None = None
    published_form: str | None = None
    robot: str | None = None
    view_rad: float | None = None


def convert_bag(path: Path, out: Path, options: BagOptions | None = None, progress: Progress | None = None) -> Path:
    """Write a bag as a recording, or as one of each robot where it holds several.

    Where odometry begins anew, the rest becomes another recording beside it, `OUT-2`.

    Args:
        path: The bag: a file, or a folder of its parts.
        out: The recording's folder; that of the recordings where there are several robots.
        options: Topics, and what stands in files beside the bag.
        progress: Called with images done and images in all.

    Raises:
        DatasetError: A topic is missing or unclear, too many messages cannot be used, or the bag is damaged; what was
            read until then is kept, and the message says how much.
    """
    options = options or BagOptions()
    with Bag(path) as bag:
        layout = Layout.of(bag)
        robots = _wanted(layout, options)
        if len(robots) == 1:
            _convert_robots(layout, {out: robots[0]}, options, progress)
            return out
        for robot in robots:
            logger.warning("%s: %s", path, robot)
        _convert_robots(layout, {out / robot_name(robot.name): robot for robot in robots}, options, progress)
    return out


def robots_of_bag(path: Path) -> list[RobotTopics]:
    """The robots whose topics a bag holds; one without a name where it is not clear, so that converting it says why."""
    with Bag(path) as bag:
        try:
            return Layout.of(bag).robots()
        except DatasetError:
            return []


def _wanted(layout: Layout, options: BagOptions) -> list[RobotTopics]:
    """The robots to convert: by the topics that are named, else as the bag's namespaces say."""
    bag = layout.bag
    if options.image_topic is not None or options.odometry is not None or options.odometry_topic is not None:
        images = [topic for topic in bag.topics.values() if topic.type in IMAGE_TYPES]
        image = layout.chosen_image(images, options.image_topic)
        poses = None if options.odometry is not None else layout.chosen_poses(image, options.odometry_topic)
        robots = [RobotTopics("", image, None if options.camera else layout.info_of(image), poses)]
    else:
        robots = layout.robots()
        for left in layout.left_out:
            logger.warning("%s: %s", bag.path, left)
    if options.robot is not None and len(robots) > 1:
        robots = [robot for robot in robots if robot_name(robot.name) == options.robot]
        if not robots:
            raise DatasetError(f"{bag.path}: has no robot {options.robot}; its namespaces are those of other robots")
    if options.odometry is None and any(robot.poses is None for robot in robots):
        other = only(bag, [t for t in bag.topics.values() if t.type in POSE_TYPES], "odometry", "--odometry-topic")
        raise DatasetError(
            f"{bag.path}: has no odometry: {other} is of goals or of what a camera sees, by its name or frame; name it "
            "with --odometry-topic if it is the robot's"
        )
    return robots


def _convert_robots(
    layout: Layout, robots: dict[Path, RobotTopics], options: BagOptions, progress: Progress | None
) -> None:
    """Convert robots in one pass over the bag; what is wrong with one costs no other.

    Raises:
        DatasetError: Something is wrong with the recording of a robot; of several such, the first is raised.
    """
    runs, faults = [], []
    for out, robot in robots.items():
        try:
            runs.append(_conversion(layout, robot, out, options))
        except DatasetError as error:
            faults.append(error)
    if runs:
        _pass_over(layout.bag, runs, progress)
    said: Counter[str] = Counter()
    for run in runs:
        try:
            run.judge()
            said.update(run.notes)
        except DatasetError as error:
            faults.append(error)
    for note, count in said.items():
        logger.warning("%s%s", note, f" (so for {count} robots)" if count > 1 else "")
    for fault in faults[1:]:
        logger.warning("%s", fault)
    if faults:
        raise faults[0]


def _pass_over(bag: Bag, runs: list["_Conversion"], progress: Progress | None) -> None:
    """Read the bag once, to its end; a message that cannot be used costs itself."""
    takers: dict[str, list[_Conversion]] = {}
    for run in runs:
        for name in run.topics():
            takers.setdefault(name, []).append(run)
    with ExitStack() as opened:
        for run in runs:
            run.begin()
            opened.callback(run.leave)
        starts_ns = [run.start_ns for run in runs if run.start_ns is not None]
        total = sum(run.robot.image.count or 0 for run in runs)
        for topic, bag_ns, raw in bag.raw(list(takers), min(starts_ns) if len(starts_ns) == len(runs) else None):
            for run in takers[topic.name]:
                run.take(topic, bag_ns, raw)
            if progress is not None and topic.type in IMAGE_TYPES:
                seen = sum(run.images.seen for run in runs)
                progress(seen, max(total, seen))
        for run in runs:
            run.close()


def _conversion(layout: Layout, robot: RobotTopics, out: Path, options: BagOptions) -> "_Conversion":
    lens, notes = _lens(layout, robot, options)
    lens = lens if options.view_rad is None else replace(lens, view_rad=options.view_rad)
    clock = choose_clock(layout, robot)
    identity = f"bag {layout.bag.path.resolve()} {robot.image.name} {robot.poses or options.odometry}"
    others = layout.other_poses(robot)
    if others:
        notes.append(f"{layout.bag.path}: odometry is {robot.poses}; not taken: {', '.join(others)} (--odometry-topic)")
    if robot.poses is not None and is_truth(robot.poses.topic):
        notes.append(f"{layout.bag.path}: odometry is {robot.poses}, by its name no odometry, but ground truth or GPS")
    notes += [clock.note] if clock.note else []
    shift_ns = 0
    if lens.time_shift_s:
        is_added = not clock.is_bag and not _stamps_are_shared(layout.bag, robot)
        shift_ns = round(lens.time_shift_s * 1e9) if is_added else 0
        notes.append(f"{layout.bag.path}: {told(lens.time_shift_s, is_added)}")
        identity += f" shift={shift_ns}"
    return _Conversion(layout.bag, robot, lens, options, clock, out, identity, shift_ns=shift_ns, notes=notes)


def _stamps_are_shared(bag: Bag, robot: RobotTopics) -> bool:
    """Whether odometry stamps its poses as the pictures are stamped that it was made of."""
    if robot.poses is None or robot.poses.edge is not None:
        return False
    images, poses = (
        [header_ns(message) * 1e-9 for _, message in bag.firsts(topic.name, STAMPS_TRIED)]
        for topic in (robot.image, robot.poses.topic)
    )
    return of_pictures(poses, images)


def _lens(layout: Layout, robot: RobotTopics, options: BagOptions) -> tuple[Lens, list[str]]:
    """Intrinsics and mounting: of the file that was named, else of the bag."""
    if isinstance(options.camera, Lens):
        return options.camera, []
    if options.camera is not None:
        lens = read_lens(options.camera)
        return lens, list(lens.notes)
    bag = layout.bag
    infos = [topic for topic in bag.topics.values() if topic.type == CAMERA_TYPE]
    if robot.info is None:
        found = listed(infos) if infos else f"no {CAMERA_TYPE}"
        raise DatasetError(f"{bag.path}: intrinsics are missing or unclear ({found}); name a camera file with --camera")
    first = bag.first(robot.info.name)
    if first is None:
        raise DatasetError(f"{bag.path}: topic {robot.info.name} has no message that can be read")
    T_body_camera, note = (None, None) if options.odometry else layout.mounting(robot)
    try:
        lens = believable(lens_of(first[1], robot.info, robot.image), f"topic {robot.info.name}")
    except DatasetError as error:
        raise DatasetError(f"{bag.path}: {error}; name a camera file with --camera") from error
    lens = lens if T_body_camera is None else replace(lens, T_body_camera=T_body_camera)
    return lens, [note] if note else []


@dataclass(slots=True)
class Tally:
    """What became of a topic's messages.

    Attributes:
        seen: Messages.
        damaged: Of them, those that cannot be used.
        repeated: Of them, those with the stamp of the one before.
        backwards: Of them, those that go back in time.
        reason: Of the first damaged one.
        step: Of the first that goes back.
    """

    seen: int = 0
    damaged: int = 0
    repeated: int = 0
    backwards: int = 0
    reason: str = ""
    step: str = ""

    def damage(self, reason: str) -> None:
        """Count one that cannot be used."""
        self.damaged += 1
        self.reason = self.reason or reason

    def step_back(self, last_s: float, stamp_s: float) -> None:
        """Count one that goes back in time."""
        self.backwards += 1
        self.step = self.step or f"time goes backwards, from {last_s:.6f} s to {stamp_s:.6f} s"

    def sentences(self, topic: BagTopic) -> list[str]:
        """What was left out."""
        damaged = f"topic {topic.name}: {self.damaged} of {self.seen} messages were left out: {self.reason}"
        twice = f"topic {topic.name}: {self.repeated} of {self.seen} messages repeat a stamp, and were left out"
        back = f"topic {topic.name}: {self.step}; {self.backwards} of {self.seen} messages were left out"
        told = ((damaged, self.damaged), (twice, self.repeated), (back, self.backwards))
        return [sentence for sentence, count in told if count]

    def is_too_much(self) -> bool:
        """Whether the topic cannot be trusted."""
        return self.damaged > DAMAGED_RATIO_MAX * self.seen or self.backwards > DAMAGED_RATIO_MAX * self.seen


@dataclass(slots=True, eq=False)
class _Conversion:
    """What one robot's topics of a bag become, message by message: `begin`, `take` each, `close`, `judge`.

    Attributes:
        start_ns: Bag time of the first message to take, where an earlier attempt was cut short.
        shift_ns: What is added to the stamps of pictures for those of the body's clock.
    """

    bag: Bag
    robot: RobotTopics
    lens: Lens
    options: BagOptions
    clock: ClockChoice
    out: Path
    identity: str
    zero_ns: int = 0
    shift_ns: int = 0
    images: Tally = field(default_factory=Tally)
    poses: Tally = field(default_factory=Tally)
    journey: int = 0
    watch: JourneyWatch = field(default_factory=JourneyWatch)
    notes: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    kept: int = 0
    start_ns: int | None = None
    _taken: int = 0
    _decoder: "PoseDecoder | TransformDecoder | None" = None
    _info: BagTopic | None = None
    _writer: RecordingWriter = field(init=False)
    _log: PoseWriter = field(init=False)
    _done_s: float | None = field(init=False, default=None)
    _pictures: ImageWriter = field(init=False)
    _last_pose: tuple[float, ...] = ()
    _stamps: StampGaps = field(default_factory=StampGaps)
    _frame: str | None = None
    _unturned: list[tuple[float, ...]] | None = field(default_factory=list)
    _first_info: bytes | None = None
    _infos_differ: int = 0
    _image_span_s: tuple[float, float] | None = None
    _pose_span_s: tuple[float, float] | None = None
    _covered: Covered = field(default_factory=Covered)

    def topics(self) -> list[str]:
        """Names of the topics of which messages are wanted."""
        source = self.robot.poses
        info = self.robot.info if self.options.camera is None else None
        return [topic.name for topic in (self.robot.image, source and source.topic, info) if topic]

    def begin(self) -> None:
        """Open the recording, and go on where an earlier attempt was cut short."""
        self.start_ns = self._restored()
        source, image_topic = self.robot.poses, self.robot.image
        self._decoder = None if source is None else _decoder(self.bag, source)
        self._info = self.robot.info if self.options.camera is None else None
        levels = sampled_levels(self.bag, image_topic)
        if levels != FULL:
            self.notes.append(f"{self.bag.path}: topic {image_topic.name}: {levels_note(levels)}")
        self._pictures = ImageWriter(self.lens, levels)
        self._open()

    def take(self, topic: BagTopic, bag_ns: int, raw: bytes) -> None:
        """Take one message of a wanted topic."""
        if self.start_ns is not None and bag_ns < self.start_ns:
            return
        if self._taken % CHECKPOINT_MESSAGES == 0:
            self._save(bag_ns)
        self._taken += 1
        if topic is self.robot.image:
            self._add_image(raw, bag_ns)
        elif topic is self._info:
            self._see_info(raw)
        elif self._decoder is not None:
            self._add_poses(self._decoder, raw, bag_ns)

    def _open(self) -> None:
        """Open the recording of the journey that runs."""
        out = self.out if self.journey == 0 else self.out.with_name(f"{self.out.name}-{self.journey + 1}")
        self._writer = RecordingWriter(out, f"{self.identity}{f' journey {self.journey + 1}' if self.journey else ''}")
        self._log = PoseWriter(out / "odometry.tum", self.robot.poses is not None)
        self._log.__enter__()
        self._writer.write_lens(self._pictures.lens)
        self._done_s = self._writer.last_stamp_s

    def leave(self) -> None:
        """Close the files, for a later attempt to go on."""
        self._writer.__exit__(None, None, None)
        self._log.__exit__(None, None, None)

    def close(self) -> None:
        """Finish the recording of the journey that runs."""
        writer, log = self._writer, self._log
        try:
            writer.sort()
            if self.robot.poses is not None and self.start_ns is None:
                self._covered.count(writer.path / "images.txt")
            log.finish(self.zero_ns)
            self._write_beside(writer)
        finally:
            self.leave()
        log.forget()
        (self.out / "bag_state.json").unlink(missing_ok=True)
        self.kept += writer.count

    def _see_info(self, raw: bytes) -> None:
        """See that intrinsics stay as they are; headers differ, what is behind them hardly ever."""
        body = raw[HEADER_BYTES:]
        self._first_info = self._first_info or body
        if body == self._first_info or self.robot.info is None:
            return
        try:
            found = lens_of(self.bag.decoded(raw, self.robot.info), self.robot.info, self.robot.image).camera
        except DatasetError:
            return
        self._infos_differ += found != self.lens.camera

    def _add_poses(self, decoder: "PoseDecoder | TransformDecoder", raw: bytes, bag_ns: int) -> None:
        self.poses.seen += 1
        try:
            posed = decoder(raw)
        except DatasetError as error:
            self.poses.damage(_bare(error, self.robot.poses.topic if self.robot.poses else self.robot.image))
            return
        if len(posed) == 1 and not self.clock.is_bag and self.clock.is_off(posed[0][0], bag_ns):
            self.poses.damage(STRAY)
            return
        for posed_ns, numbers in posed:
            taken_ns = bag_ns if self.clock.is_bag else posed_ns
            for is_new, good_ns, good in self.watch.take(taken_ns, numbers):
                if is_new:
                    self._begin_journey(good_ns, bag_ns)
                self._pose_span_s = _wider(self._pose_span_s, (good_ns - self.zero_ns) * 1e-9)
                if good_ns > self._log.last_ns:
                    self._see_motion(good)
                    self._covered.posed((good_ns - self.zero_ns) * 1e-9)
                if len(posed) == 1 and good_ns == self._log.last_ns and good != self._last_pose:
                    self.poses.damage("the stamp is that of the pose before")
                elif not self._log.add(good_ns, good) and len(posed) == 1:
                    self.poses.step_back(self._log.last_ns * 1e-9, good_ns * 1e-9)
                self._last_pose = good

    def _see_motion(self, numbers: tuple[float, ...]) -> None:
        """Keep positions as long as all rotations are the first one, thinned where there are many."""
        if self._unturned is None or (self._unturned and numbers[3:] != self._unturned[0][3:]):
            self._unturned = None
            return
        self._unturned.append(numbers)
        if len(self._unturned) > UNTURNED_MAX:
            del self._unturned[1::2]

    def _begin_journey(self, stamp_ns: int, bag_ns: int) -> None:
        """Go on in another recording, since odometry is of another frame from here."""
        self.close()
        self.journey += 1
        self._open()
        self._save(bag_ns)
        self.notes.append(
            f"{self.bag.path}: topic {self.robot.poses}: odometry begins anew at {stamp_ns * 1e-9:.3f} s; what follows "
            f"is in {self._writer.path}"
        )

    def _add_image(self, raw: bytes, bag_ns: int) -> None:
        tally, topic = self.images, self.robot.image
        tally.seen += 1
        if (tally.seen - 1) % self.options.every:
            return
        try:
            message = self.bag.decoded(raw, topic)
            self._see_frame(message.header.frame_id)
            taken_ns = bag_ns if self.clock.is_bag else stamp_ns(message.header)
            if taken_ns == 0 or (not self.clock.is_bag and self.clock.is_off(taken_ns, bag_ns)):
                raise DatasetError(STRAY)
            taken_ns += self.shift_ns
            if self.options.from_zero and self.zero_ns == 0:
                self.zero_ns = taken_ns
            stamp_s = (taken_ns - self.zero_ns) * 1e-9
            if self._done_s is not None and stamp_s <= self._done_s + 1e-9:
                return
            if stamp_s == self._writer.last_stamp_s:
                tally.repeated += 1
                return
            if not self._stamps.fits(taken_ns):
                tally.step_back(self._writer.last_stamp_s or 0.0, stamp_s)
                return
            self._writer.add(stamp_s, *self._encoded(message))
            self._image_span_s = _wider(self._image_span_s, stamp_s)
        except DatasetError as error:
            tally.damage(_bare(error, topic))

    def _see_frame(self, frame: str) -> None:
        """See that images are of the frame of the first one.

        Raises:
            DatasetError: They are of another, as of another camera on the same topic.
        """
        self._frame = frame if self._frame is None else self._frame
        if frame != self._frame:
            raise DatasetError(f"an image is of the frame {frame or 'no name'}, the first one of {self._frame}")

    def _encoded(self, message: Any) -> tuple[bytes, str]:
        encoded, suffix = image_file(message, self.robot.image, self.options.jpeg)
        try:
            return self._pictures.written(encoded, suffix)
        except PictureError as error:
            raise DatasetError(f"topic {self.robot.image.name}: {error}") from error

    def _restored(self) -> int | None:
        """Bag time to go on from, or None at the start."""
        path = self.out / "bag_state.json"
        if not path.exists() or not (self.out / "images.txt").exists():
            return None
        state = json.loads(path.read_text(encoding="utf-8"))
        self.zero_ns, self.journey = state["zero_ns"], state["journey"]
        self.images, self.poses = Tally(**state["images"]), Tally(**state["poses"])
        return int(state["bag_ns"])

    def _save(self, bag_ns: int) -> None:
        """Note where to go on, once all that came before is written; a file is there whole or not at all."""
        self._writer.flush()
        self._log.flush()
        tallies = {"images": asdict(self.images), "poses": asdict(self.poses)}
        state = {"bag_ns": bag_ns, "zero_ns": self.zero_ns, "journey": self.journey, **tallies}
        path = self.out / "bag_state.json"
        partial = path.with_suffix(".part")
        partial.write_text(json.dumps(state), encoding="utf-8")
        partial.replace(path)

    def _write_beside(self, writer: RecordingWriter) -> None:
        """Write what stands in files beside the bag."""
        odometry, truth = self._beside(self.options.odometry), self._beside(self.options.truth)
        if truth is not None:
            truth.T_fixed_body[:, :3, 3] -= self.options.origin_m
        writer.write_trajectories(odometry, truth)

    def _beside(self, path: Path | None) -> Trajectory | None:
        """A trajectory in a file beside the bag."""
        if path is None:
            return None
        trajectory, notes = read_trajectory(path, self.options.form, otherwise=self.options.published_form)
        self.notes.extend(notes)
        return _shifted(trajectory, self.zero_ns)

    def judge(self) -> None:
        """Tell what was left out, and raise where it was too much."""
        if self.watch.outliers:
            jumps = f"{self.watch.outliers} single poses jump, and were left out"
            self.notes.append(f"{self.bag.path}: topic {self.robot.poses}: {jumps}")
        if self.journey > JOURNEYS_MAX and self.journey > JOURNEYS_RATIO_MAX * self.poses.seen:
            self.faults.append(
                f"{self.bag.path}: topic {self.robot.poses}: odometry begins anew {self.journey} times in "
                f"{self.poses.seen} messages, as where two programs publish on one topic; record one of them"
            )
        self.notes.extend(f"{self.bag.path}: {note}" for note in self._covered.told(f"odometry ({self.robot.poses})"))
        unturned = np.array(self._unturned or np.empty((0, 7)))
        if (odd := oddity(unturned[:, :3], unturned[:, 3:])) is not None:
            self.notes.append(f"{self.bag.path}: topic {self.robot.poses}: {odd}")
        tallies = [(self.images, self.robot.image)]
        if self.robot.poses is not None:
            tallies.append((self.poses, self.robot.poses.topic))
        for tally, topic in tallies:
            sentences = [f"{self.bag.path}: {sentence}" for sentence in tally.sentences(topic)]
            (self.faults if tally.is_too_much() else self.notes).extend(sentences)
            if tally.seen == 0:
                self.faults.append(f"{self.bag.path}: topic {topic.name} has no message")
        if self._infos_differ and self.robot.info is not None:
            self.faults.append(
                f"{self.bag.path}: topic {self.robot.info.name}: intrinsics differ from the first ones in "
                f"{self._infos_differ} messages, as of a camera that zooms; name a camera file with --camera"
            )
        apart = self._apart()
        if apart is not None:
            self.faults.append(apart)
        if self.bag.gap is not None:
            self._judge_gap(self.bag.gap, [tally_of for tally_of in tallies if tally_of[1].count is not None])
        if self.bag.damage is not None:
            self.faults.append(self.bag.damage)
        if self.faults:
            raise DatasetError(f"{self.faults[0]}; {self.kept} images were kept in {self.out}")

    def _judge_gap(self, gap: str, tallies: list[tuple[Tally, BagTopic]]) -> None:
        """Tell how many messages a damaged part of the bag cost; it is a fault where they are too many."""
        lost = [(topic, (topic.count or 0) - tally.seen) for tally, topic in tallies]
        told = ", ".join(f"{count} of {topic.count} of {topic.name}" for topic, count in lost if count > 0)
        too_many = any(count > DAMAGED_RATIO_MAX * (topic.count or 0) for topic, count in lost)
        (self.faults if too_many else self.notes).append(f"{gap}; lost: {told or 'nothing'}")

    def _apart(self) -> str | None:
        """A sentence where no image lies within odometry's time."""
        images, poses = self._image_span_s, self._pose_span_s
        if images is None or poses is None or (images[0] <= poses[1] and poses[0] <= images[1]):
            return None
        return (
            f"{self.bag.path}: images of {self.robot.image.name} are from {images[0]:.3f} s to {images[1]:.3f} s, "
            f"but odometry of {self.robot.poses} is from {poses[0]:.3f} s to {poses[1]:.3f} s, "
            f"{images[0] - poses[0]:+.3f} s apart: their clocks differ"
        )


def _wider(span_s: tuple[float, float] | None, stamp_s: float) -> tuple[float, float]:
    return (stamp_s, stamp_s) if span_s is None else (min(span_s[0], stamp_s), max(span_s[1], stamp_s))


def _decoder(bag: Bag, source: PoseSource) -> PoseDecoder | TransformDecoder:
    return PoseDecoder(bag, source.topic) if source.edge is None else TransformDecoder(bag, source.topic, source.edge)


def _bare(error: Exception, topic: BagTopic) -> str:
    """What went wrong, without the topic's name, which the sentence around it says."""
    return str(error).rpartition(f"topic {topic.name}: ")[2]


def _shifted(trajectory: Trajectory, zero_ns: int) -> Trajectory:
    return Trajectory(trajectory.stamps_s - zero_ns * 1e-9, np.array(trajectory.T_fixed_body))
