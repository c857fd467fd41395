"""Converts a bag to a recording in one pass, with memory that does not grow, and goes on where it was cut short."""

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flocc_agent.runtime.pictures import PictureError
from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.bag_messages import (
    CAMERA_TYPE,
    IMAGE_TYPES,
    POSE_TYPES,
    image_file,
    lens_of,
    stamp_ns,
)
from flocc_launch.datasets.bag_poses import PoseDecoder
from flocc_launch.datasets.bag_reader import Bag, BagTopic
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.pixels import ImageWriter
from flocc_launch.datasets.source import DatasetError, Lens
from flocc_launch.datasets.writer import PoseWriter, Progress, RecordingWriter

logger = logging.getLogger(__name__)

CHECKPOINT_MESSAGES = 200


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


def convert_bag(path: Path, out: Path, options: BagOptions | None = None, progress: Progress | None = None) -> Path:
    """Write one robot's part of a bag as a recording.

    Args:
        path: The bag: a file, or a ROS 2 folder.
        out: The recording's folder.
        options: Topics, and what stands in files beside the bag.
        progress: Called with images done and images in all.

    Raises:
        DatasetError: A topic is missing or unclear, a message cannot be used, or the bag is damaged; what was read
            until then is kept, and the message says how much.
    """
    options = options or BagOptions()
    with Bag(path) as bag:
        image_topic = chosen(bag, IMAGE_TYPES, options.image_topic, "image", "--image-topic")
        odometry_topic = None
        if options.odometry is None:
            odometry_topic = chosen(bag, POSE_TYPES, options.odometry_topic, "odometry", "--odometry-topic")
        lens = _lens(bag, image_topic, options.camera)
        identity = (
            f"bag {path.resolve()} {image_topic.name} {odometry_topic.name if odometry_topic else options.odometry}"
        )
        with (
            RecordingWriter(out, identity) as writer,
            PoseWriter(out / "odometry.tum", odometry_topic is not None) as log,
        ):
            run = _Conversion(bag, image_topic, odometry_topic, lens, options, writer, log)
            run.convert(progress)
    return out


def chosen(bag: Bag, types: Sequence[str], name: str | None, what: str, option: str) -> BagTopic:
    """The topic to take: the named one, or the only one of fitting type.

    Raises:
        DatasetError: It is not there, is of another type, or it is not clear which.
    """
    fitting = [topic for topic in bag.topics.values() if topic.type in types]
    if name is not None:
        topic = bag.topics.get(name)
        if topic is None:
            raise DatasetError(f"{bag.path}: has no topic {name}; it has {_listed(list(bag.topics.values()))}")
        if topic.type not in types:
            raise DatasetError(f"{bag.path}: topic {name} is of type {topic.type}, not one of {', '.join(types)}")
        return topic
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise DatasetError(f"{bag.path}: has {len(fitting)} {what} topics, name one with {option}: {_listed(fitting)}")
    raise DatasetError(f"{bag.path}: has no {what} topic; it has {_listed(list(bag.topics.values()))}")


def _listed(topics: list[BagTopic]) -> str:
    return ", ".join(str(topic) for topic in topics[:12]) + (" and others" if len(topics) > 12 else "") or "no topic"


def _lens(bag: Bag, image_topic: BagTopic, camera: Path | Lens | None) -> Lens:
    if isinstance(camera, Lens):
        return camera
    if camera is not None:
        return read_lens(camera)
    infos = [topic for topic in bag.topics.values() if topic.type == CAMERA_TYPE]
    prefix = image_topic.name.rsplit("/", 1)[0]
    near = [t for t in infos if prefix.startswith(t.name.rsplit("/", 1)[0]) or t.name.startswith(prefix)] or infos
    if len(near) != 1:
        found = _listed(infos) if infos else f"no {CAMERA_TYPE}"
        raise DatasetError(f"{bag.path}: intrinsics are missing or unclear ({found}); name a camera file with --camera")
    for topic, _, message in bag.messages([near[0].name]):
        return lens_of(message, topic)
    raise DatasetError(f"{bag.path}: topic {near[0].name} has no message")


@dataclass(slots=True, eq=False)
class _Conversion:
    """One pass over a bag."""

    bag: Bag
    image_topic: BagTopic
    odometry_topic: BagTopic | None
    lens: Lens
    options: BagOptions
    writer: RecordingWriter
    log: PoseWriter
    images: ImageWriter = field(init=False)
    zero_ns: int = 0
    images_seen: int = 0
    faults: list[str] = field(default_factory=list)

    def convert(self, progress: Progress | None) -> None:
        """Read to the end, or to the first message that cannot be used."""
        self.images = ImageWriter(self.lens)
        self.writer.write_lens(self.images.lens)
        state_path = self.writer.path / "bag_state.json"
        start_ns = self._restored(state_path)
        done_s = self.writer.last_stamp_s
        names = [topic.name for topic in (self.image_topic, self.odometry_topic) if topic is not None]
        total = self.image_topic.count or 0
        pose_topic = self.odometry_topic
        decoders = {} if pose_topic is None else {pose_topic.name: PoseDecoder(self.bag, pose_topic)}
        try:
            for number, (topic, bag_ns, message) in enumerate(self.bag.messages(names, start_ns, decoders)):
                if number % CHECKPOINT_MESSAGES == 0:
                    self._save(state_path, bag_ns)
                if topic is self.image_topic:
                    self._add_image(message, bag_ns, done_s)
                    if progress is not None:
                        progress(self.images_seen, max(total, self.images_seen))
                else:
                    for posed in message:
                        self.log.add(*posed)
        except DatasetError as error:
            prefix = "" if str(error).startswith(str(self.bag.path)) else f"{self.bag.path}: "
            self.faults.insert(0, f"{prefix}{error}")
        self._finish()
        state_path.unlink(missing_ok=True)
        self.log.forget()

    def _add_image(self, message: Any, bag_ns: int, done_s: float | None) -> None:
        self.images_seen += 1
        taken_ns = stamp_ns(message.header) or bag_ns
        if self.options.from_zero and self.zero_ns == 0:
            self.zero_ns = taken_ns
        stamp_s = (taken_ns - self.zero_ns) * 1e-9
        if (self.images_seen - 1) % self.options.every or (done_s is not None and stamp_s <= done_s + 1e-9):
            return
        last_s = self.writer.last_stamp_s
        if last_s is not None and stamp_s <= last_s:
            self._once(f"time goes backwards, from {last_s:.6f} s to {stamp_s:.6f} s; such images were left out")
            return
        encoded, suffix = image_file(message, self.image_topic, self.options.jpeg)
        try:
            written = self.images.written(encoded, suffix)
        except PictureError as error:
            raise DatasetError(f"topic {self.image_topic.name}: {error}") from error
        self.writer.add(stamp_s, *written)

    def _once(self, fault: str) -> None:
        sentence = f"{self.bag.path}: topic {self.image_topic.name}: {fault}"
        if not any("time goes backwards" in known for known in self.faults):
            self.faults.append(sentence)

    def _restored(self, path: Path) -> int | None:
        """Bag time to go on from, or None at the start."""
        if not path.exists() or self.writer.count == 0:
            return None
        state = json.loads(path.read_text(encoding="utf-8"))
        self.zero_ns, self.images_seen = state["zero_ns"], state["images_seen"]
        return int(state["bag_ns"])

    def _save(self, path: Path, bag_ns: int) -> None:
        """Note where to go on, once all that came before is written; a file is there whole or not at all."""
        self.writer.flush()
        self.log.flush()
        state = {"bag_ns": bag_ns, "zero_ns": self.zero_ns, "images_seen": self.images_seen}
        partial = path.with_suffix(".part")
        partial.write_text(json.dumps(state), encoding="utf-8")
        partial.replace(path)

    def _finish(self) -> None:
        """Write what stands in files beside the bag, and raise the first fault."""
        self.log.finish(self.zero_ns)
        odometry = self._beside(self.options.odometry)
        truth = self._beside(self.options.truth)
        if truth is not None:
            truth.T_fixed_body[:, :3, 3] -= self.options.origin_m
        self.writer.write_trajectories(odometry, truth)
        if self.bag.damage is not None:
            self.faults.append(self.bag.damage)
        if self.writer.count == 0 and not self.faults:
            self.faults.append(f"{self.bag.path}: topic {self.image_topic.name} has no message")
        if self.faults:
            raise DatasetError(f"{self.faults[0]}; {self.writer.count} images were kept in {self.writer.path}")

    def _beside(self, path: Path | None) -> Trajectory | None:
        """A trajectory in a file beside the bag."""
        if path is None:
            return None
        trajectory, notes = read_trajectory(path, self.options.form, otherwise=self.options.published_form)
        for note in notes:
            logger.warning("%s", note)
        return _shifted(trajectory, self.zero_ns)


def _shifted(trajectory: Trajectory, zero_ns: int) -> Trajectory:
    return Trajectory(trajectory.stamps_s - zero_ns * 1e-9, np.array(trajectory.T_fixed_body))
