"""Which topics of a bag belong together: camera, its CameraInfo, odometry, and where the camera sits on the body.

Topics belong together by namespace, and frames by `frame_id`: a bag of several robots has the same topics under a
namespace each. The mounting is the chain of static transforms from the body that odometry moves to the frame of the
images, as a live agent takes it. Odometry may be a topic of poses, or an edge of `/tf`. What cannot be told is refused
with what there is.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice, takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.runtime.ros2.static_frames import (
    FRAMES_MAX,
    STILL_MAX,
    StaticFrames,
    pose_of_transform,
    stands_as_a_link,
)
from flocc_agent.runtime.ros2.types import BadMessage
from flocc_launch.datasets.bag_messages import CAMERA_TYPE, DEPTH_NAME, IMAGE_TYPES, POSE_TYPES, TRANSFORMS_TYPES
from flocc_launch.datasets.bag_reader import Bag, BagTopic
from flocc_launch.datasets.source import DatasetError

Float = NDArray[np.float64]

TRANSFORMS_READ_MAX = 2000
FIXED_FRAMES = ("odom", "odometry", "map", "world", "earth", "vio", "global")
BODY_FRAMES = r"base(_?(link|footprint|frame|stabilized))?|body(_?(link|frame))?|chassis(_?link)?|trunk|robot"
"""What the frame of a whole robot is called; an IMU is one of its parts, and whose pose is told stays open."""
PARTS_OF_NAMES, LETTERS_OR_DIGITS = r"[a-z0-9]+", r"[a-z]+|\d+"
WANTED_POSES = re.compile(
    r"plan|goal|setpoint|target|waypoint|initial_?pose|desired|reference|command|cmd", re.IGNORECASE
)
"""Leaves of topics that say where a robot is to be, not where it is."""
THERMAL = re.compile(r"therm|flir|boson|lepton|lwir|infrared|hadron|optris|seek|tau2", re.IGNORECASE)
"""In the names of topics of thermal cameras, which publish grey of 16 bits as 16UC1."""
TRUTH_WORDS = ("ground_truth", "groundtruth", "vicon", "mocap", "optitrack", "leica", "rtk", "gps", "gnss", "amcl")
"""In the names of topics that say where a robot is in a map, not how it moved."""


@dataclass(frozen=True, slots=True)
class Head:
    """What the first message of a topic says.

    Attributes:
        frame: Its `frame_id`, without a leading slash.
        child: The frame that it moves, or "".
        coding: Encoding or format of an image.
    """

    frame: str
    child: str
    coding: str = ""


@dataclass(frozen=True, slots=True)
class PoseSource:
    """Where odometry comes from.

    Attributes:
        topic: Of poses, or of transforms.
        edge: Of a topic of transforms, the parent's and the child's frame.
    """

    topic: BagTopic
    edge: tuple[str, str] | None = None

    def __str__(self) -> str:
        return self.topic.name if self.edge is None else f"{self.topic.name}:{self.edge[0]}.{self.edge[1]}"


@dataclass(frozen=True, slots=True)
class RobotTopics:
    """One robot's part of a bag.

    Attributes:
        name: Its namespace, or "" where the bag is one robot's.
        image: BagTopic of its camera.
        info: BagTopic of the camera's intrinsics, or None.
        poses: Odometry, or None.
    """

    name: str
    image: BagTopic
    info: BagTopic | None
    poses: PoseSource | None

    def __str__(self) -> str:
        info = self.info.name if self.info else "none"
        return (
            f"{self.name or 'the robot'}: images {self.image.name}, intrinsics {info}, odometry {self.poses or 'none'}"
        )


@dataclass(slots=True, eq=False)
class Frames:
    """What topics of transforms say.

    Attributes:
        static: Frames that do not move.
        edges: Parents and children of other transforms, with their topics.
        has_static: Whether there is any static transform.
        moved: Those of `edges` that did not stay as they were.
        named: All frames, with one that a transform connects with each.
    """

    static: StaticFrames = field(default_factory=StaticFrames)
    edges: dict[tuple[str, str], str] = field(default_factory=dict)
    has_static: bool = False
    moved: set[tuple[str, str]] = field(default_factory=set)
    named: dict[str, str] = field(default_factory=dict)
    _first: dict[tuple[str, str], tuple[Any, Float]] = field(default_factory=dict)

    @classmethod
    def of(cls, bag: Bag, topics: Sequence[BagTopic]) -> "Frames":
        """Read topics of transforms from the front, static ones and others."""
        frames = cls()
        for topic in topics:
            for _, _, raw in islice(bag.raw([topic.name]), TRANSFORMS_READ_MAX):
                try:
                    frames._take(bag.decoded(raw, topic), topic)
                except (DatasetError, BadMessage):
                    continue
        return frames

    def _take(self, message: Any, topic: BagTopic) -> None:
        for each in message.transforms:
            parent, child = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
            self.named[child] = parent
            self.named.setdefault(parent, child)
        if topic.name.rsplit("/", 1)[-1] == "tf_static":
            self.static.add(message)
            self.has_static = True
            return
        for each in message.transforms:
            edge = (each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/"))
            self.edges.setdefault(edge, topic.name)
            T = pose_of_transform(each.transform, topic.name)
            if np.abs(T - self._first.setdefault(edge, (each, T))[1]).max() > STILL_MAX:
                self.moved.add(edge)

    def carrying(self, camera: str) -> list[tuple[str, str]]:
        """Edges that move a body on which a camera sits, by transforms that do not."""
        still = [each for edge, (each, _) in self._first.items() if edge not in self.moved]
        frames = self.static.with_others(still)
        return [edge for edge in self.moved if frames.between(edge[1], camera) is not None]


@dataclass(slots=True, eq=False)
class Layout:
    """A bag's topics with what their first messages say, and its transforms."""

    bag: Bag
    left_out: list[str] = field(default_factory=list)
    _frames: dict[tuple[str, ...], Frames] = field(default_factory=dict)
    _heads: dict[str, Head | None] = field(default_factory=dict)

    @classmethod
    def of(cls, bag: Bag) -> "Layout":
        """The layout of a bag; what it holds is read where it is asked for."""
        return cls(bag)

    def frames(self, image: BagTopic | None = None) -> Frames:
        """Transforms of a camera's robot: all but those in a namespace of other cameras only (`/r2/tf`)."""
        cameras = [topic.name for topic in self._of_types(IMAGE_TYPES)]
        topics = []
        for topic in self._of_types(TRANSFORMS_TYPES):
            below = [name for name in cameras if name.startswith(f"{_parent(topic.name)}/")]
            if image is None or not below or image.name in below:
                topics.append(topic)
        key = tuple(topic.name for topic in topics)
        if key not in self._frames:
            self._frames[key] = Frames.of(self.bag, topics)
        return self._frames[key]

    def head(self, topic: BagTopic) -> Head | None:
        """What a topic's first message says, or None where it has none."""
        if topic.name not in self._heads:
            found = self.bag.first(topic.name)
            self._heads[topic.name] = None if found is None else _head(found[1])
        return self._heads[topic.name]

    def robots(self) -> list[RobotTopics]:
        """The robots of a bag: one, or one of each namespace that has images and odometry of its own.

        Raises:
            DatasetError: It is not clear which topics to take.
        """
        images = self._of_types(IMAGE_TYPES)
        groups = _by_namespace([topic.name for topic in images])
        parts = {name: [topic for topic in images if topic.name in topics] for name, topics in groups.items()}
        found = {name: self._poses_of(name, group) for name, group in parts.items()}
        own = {name: poses for name, poses in found.items() if poses is not None}
        if len({str(poses) for poses in own.values()}) < len(own) or (not own and len(parts) > 1):
            parts, own = self._told_apart_by_odometry(images)
        if len(own) > 1 or (own and len(parts) > 1):
            self.left_out = [
                f"{name} has images but no odometry of its own, and is left out" for name in parts if name not in own
            ]
            return [self._robot(name, parts[name], poses) for name, poses in own.items()]
        return [self._robot("", images, None)]

    def _told_apart_by_odometry(
        self, images: list[BagTopic]
    ) -> tuple[dict[str, list[BagTopic]], dict[str, PoseSource]]:
        """Images and odometry by what tells topics of odometry apart, as `cam_r1` and `odom_r1` of `odom_r2`."""
        for word in (PARTS_OF_NAMES, LETTERS_OR_DIGITS):
            poses = _of_distinct_words(_best(self._own_poses()), word)
            parts = {name: [t for t in images if f"-{name}-" in f"-{_words(t.name, word)}-"] for name in poses}
            taken = [topic.name for group in parts.values() for topic in group]
            if len(poses) > 1 and sorted(taken) == sorted(t.name for t in images) and all(parts.values()):
                return parts, {name: PoseSource(topic) for name, topic in poses.items()}
        return {"": images}, {}

    def _of_types(self, types: Sequence[str]) -> list[BagTopic]:
        return [topic for topic in self.bag.topics.values() if topic.type in types and topic.count != 0]

    def _poses_of(self, name: str, images: list[BagTopic]) -> PoseSource | None:
        own = [t for t in self._own_poses() if name in t.name.strip("/").split("/")[:-1]]
        if len(_best(own)) > 1:
            only(self.bag, _best(own), "odometry", "--odometry-topic")
        return self._source_of(own, images[0])

    def _source_of(self, topics: list[BagTopic], image: BagTopic) -> PoseSource | None:
        """The only topic of odometry among those of poses, else an edge of /tf, else what says where a robot is."""
        best = _best(topics)
        edge = self.edge_of(image) if all(map(is_truth, best)) else None
        return edge or (PoseSource(best[0]) if len(best) == 1 else None)

    def _robot(self, name: str, images: list[BagTopic], poses: PoseSource | None) -> RobotTopics:
        image = self.chosen_image(images)
        return RobotTopics(name, image, self.info_of(image), poses or self.chosen_poses(image))

    def chosen_image(self, images: list[BagTopic], name: str | None = None) -> BagTopic:
        """The camera's topic: the named one, or the only one that holds pictures.

        Raises:
            DatasetError: It is not there or of another type, or it is not clear which.
        """
        if name is not None:
            return named(self.bag, IMAGE_TYPES, name)
        kept = [topic for topic in images if not self._is_depth(topic)]
        if images and not kept:
            raise DatasetError(
                f"{self.bag.path}: the image topics hold depth, no pictures: {listed(images)}; name one "
                "of 16UC1 with --image-topic if it is of a thermal camera"
            )
        by_base: dict[str, BagTopic] = {}
        for topic in kept:
            base = topic.name.removesuffix("/compressed")
            best = by_base.get(base)
            if best is None or (topic.count or 0) >= (best.count or 0):
                by_base[base] = topic
        if len(by_base) > 1 and (left := _left_of(by_base)) is not None:
            return left
        return only(self.bag, list(by_base.values()), "image", "--image-topic")

    def _is_depth(self, topic: BagTopic) -> bool:
        leaf = topic.name.rsplit("/", 1)[-1]
        if leaf in ("compressedDepth", "theora"):
            return True
        head = self.head(topic)
        coding = "" if head is None else head.coding.split(";")[0].strip()
        is_thermal = THERMAL.search(topic.name) is not None and DEPTH_NAME.search(topic.name) is None
        return coding == "32FC1" or (coding == "16UC1" and not is_thermal)

    def info_of(self, image: BagTopic) -> BagTopic | None:
        """The CameraInfo of an image topic: of its namespace, else of its frame, else the only one; None where unclear.

        Raises:
            DatasetError: The one beside the images is of another frame.
        """
        infos = [t for t in self._of_types((CAMERA_TYPE,)) if not _are_of_two_cameras(t.name, image.name)]
        base = image.name.removesuffix("/compressed")
        near = [t for t in infos if t.name in (f"{base}/camera_info", f"{_parent(base)}/camera_info")]
        near = near or [t for t in infos if _parent(t.name) == _parent(base)]
        framed = [t for t in infos if self._frame(t) and self._frame(t) == self._frame(image)]
        if len(near) == 1:
            if self._frame(near[0]) and self._frame(image) and self._frame(near[0]) != self._frame(image):
                raise DatasetError(
                    f"{self.bag.path}: {near[0].name} is of frame {self._frame(near[0])}, but {image.name} of "
                    f"{self._frame(image)}; name a camera file with --camera"
                )
            return near[0]
        if len(framed) == 1:
            return framed[0]
        unframed = [t for t in infos if not (self._frame(t) and self._frame(image))]
        related = [t for t in infos if len(_by_namespace([image.name, t.name])) == 1]
        return infos[0] if len(infos) == 1 and (unframed or related) else None

    def _frame(self, topic: BagTopic) -> str:
        head = self.head(topic)
        return head.frame if head else ""

    def chosen_poses(self, image: BagTopic, name: str | None = None) -> PoseSource | None:
        """Odometry: the named topic or `TOPIC:PARENT.CHILD`, the only topic of poses, or an edge of /tf.

        Raises:
            DatasetError: It is not there or of another type, or it is not clear which.
        """
        if name is not None and ":" in name:
            return self._named_edge(name)
        if name is not None:
            return PoseSource(named(self.bag, POSE_TYPES, name))
        own = self._own_poses()
        near = [t for t in own if not self._is_another_robot(image, t)]
        if own and not near:
            raise DatasetError(
                f"{self.bag.path}: {listed(own)} is another robot's odometry than that of {image.name}, by its name or "
                "frames; name it with --odometry-topic if it is not"
            )
        return self._source_of(near, image)

    def _own_poses(self) -> list[BagTopic]:
        """Topics of a robot's poses, without those of goals and of what it sees."""
        return [
            t
            for t in self._of_types(POSE_TYPES)
            if not WANTED_POSES.search(t.name.rsplit("/", 1)[-1]) and not self._is_of_something_seen(t)
        ]

    def _is_of_something_seen(self, poses: BagTopic) -> bool:
        """Whether poses that name no child are in the frame of a camera, as those of markers and objects are."""
        head = self.head(poses)
        cameras = {self._frame(topic) for topic in self._of_types(IMAGE_TYPES)} - {""}
        return head is not None and not head.child and poses.type != "nav_msgs/msg/Odometry" and head.frame in cameras

    def _is_another_robot(self, image: BagTopic, poses: BagTopic) -> bool:
        """Whether poses are another robot's than images, by namespaces of one kind or those of frames."""
        here, there = _root(image.name), _root(poses.name)
        if here and there and here != there and self._are_siblings(here, there):
            return True
        head, camera = self.head(poses), self._frame(image)
        if head is None or self.frames(image).static.between(head.child, camera) is not None:
            return False
        roots = {_root(frame) for frame in (head.frame, head.child)} - {""}
        return bool(_root(camera) and roots) and _root(camera) not in roots

    def _are_siblings(self, one: str, other: str) -> bool:
        """Whether two namespaces are of one kind: named alike but for a number, or with topics of the same names."""
        if re.sub(r"\d+", "#", one) == re.sub(r"\d+", "#", other):
            return True
        below = [{t.partition(f"/{ns}/")[2] for t in self.bag.topics if t.startswith(f"/{ns}/")} for ns in (one, other)]
        return bool(below[0] & below[1])

    def other_poses(self, robot: RobotTopics) -> list[str]:
        """Topics of poses in a robot's namespace that are not taken as its odometry."""
        if robot.poses is None:
            return []
        return [
            topic.name
            for topic in self._of_types(POSE_TYPES)
            if topic != robot.poses.topic and (not robot.name or robot.name in topic.name.strip("/").split("/"))
        ]

    def _named_edge(self, name: str) -> PoseSource:
        topic_name, _, frames = name.partition(":")
        topic = named(self.bag, TRANSFORMS_TYPES, topic_name)
        known = Frames.of(self.bag, [topic]).edges
        found = [edge for edge in known if ".".join(edge) == frames]
        if not found:
            edges = ", ".join(f"{topic.name}:{a}.{b}" for a, b in sorted(known))
            raise DatasetError(f"{self.bag.path}: has no transform {name}; there are {edges or 'none'}")
        return PoseSource(topic, found[0])

    def edge_of(self, image: BagTopic) -> PoseSource | None:
        """The transform that moves the body on which the camera is mounted, or None."""
        camera, frames = self._frame(image), self.frames(image)
        moving = sorted(frames.carrying(camera)) if camera else []
        if not moving:
            moving = [
                e for e in frames.edges if e[0].rsplit("/", 1)[-1] in FIXED_FRAMES and (e[1], e[0]) not in frames.edges
            ]
            moving = [e for e in moving if e[1].rsplit("/", 1)[-1] not in FIXED_FRAMES]
        if len(moving) != 1:
            return None
        return PoseSource(self.bag.topics[frames.edges[moving[0]]], moving[0])

    def mounting(self, robot: RobotTopics) -> tuple[Float, str | None]:
        """`T_body_camera`, and a sentence where nothing says it.

        Raises:
            DatasetError: The bag has transforms, but none from the body to the camera.
        """
        camera = self._frame(robot.image)
        frames = self.frames(robot.image)
        body = self._body(robot.poses, frames)
        if camera == body and camera:
            return np.eye(4), None
        if body and (moved := frames.static.moved_between(body, camera)) is not None:
            raise DatasetError(
                f"{self.bag.path}: static transforms place {moved}, between {body} and {camera}, in more than one way; "
                "name a camera file with T_body_camera (--camera)"
            )
        T_body_camera = frames.static.between(body, camera) if body and camera else None
        if T_body_camera is None and body and camera and frames.edges:
            T_body_camera = self._between_on_tf(frames, body, camera)
        if T_body_camera is not None and stands_as_a_link(camera, T_body_camera):
            raise DatasetError(
                f"{self.bag.path}: {robot.image.name} is of the frame {camera}, which stands as a link does (z up), "
                "not as a camera (z forward): name a camera file with T_body_camera (--camera)"
            )
        if T_body_camera is not None:
            return T_body_camera, None
        beside = frames.named.get(camera) if camera else None
        if body and (frames.has_static or beside is not None):
            raise DatasetError(
                f"{self.bag.path}: no chain of static transforms leads from {body}, which {robot.poses} moves, to "
                f"{camera or 'none'}, the frame of {robot.image.name}; name a camera file with T_body_camera: --camera"
            )
        if beside is not None and (T_root_camera := self._on_root(robot, frames, camera)) is not None:
            return T_root_camera, (
                f"{self.bag.path}: {robot.poses} does not say which frame it moves; {frames.static.root(camera)} is "
                "taken, on which the camera sits: name a camera file with T_body_camera (--camera) if not"
            )
        if beside is not None:
            raise DatasetError(
                f"{self.bag.path}: the camera ({camera}) sits on {beside}, but {robot.poses} does not say which frame "
                "it moves; name a camera file with T_body_camera (--camera)"
            )
        return np.eye(4), (
            f"{self.bag.path}: nothing says where the camera ({camera or 'no frame'}) sits on the body "
            f"({body or 'no frame'}); they are taken as one: name a camera file with T_body_camera (--camera) if not"
        )

    def _on_root(self, robot: RobotTopics, frames: Frames, camera: str) -> Float | None:
        """The camera in the body that carries it by static transforms; None where it has no body's name.

        Poses of a topic that names a camera may be the camera's.
        """
        root = frames.static.root(camera)
        is_body = re.fullmatch(BODY_FRAMES, root.rsplit("/", 1)[-1].lower()) is not None
        names_camera = robot.poses is not None and re.search(r"cam|optical|lens|eye", robot.poses.topic.name.lower())
        return frames.static.between(root, camera) if is_body and not names_camera else None

    def _between_on_tf(self, frames: Frames, body: str, camera: str) -> Float | None:
        """`T_body_camera` where transforms that stay as they are stand on /tf, as ROS 1 repeats them; None without any.

        Raises:
            DatasetError: The camera moves on the body.
        """
        topics = list(dict.fromkeys(frames.edges.values()))
        first: dict[tuple[str, str], tuple[Any, Float]] = {}
        moving: set[tuple[str, str]] = set()
        for topic, _, raw in self.bag.raw(topics):
            try:
                for each in self.bag.decoded(raw, topic).transforms:
                    edge = (each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/"))
                    if edge not in moving and (edge in first or len(first) < FRAMES_MAX):
                        T = pose_of_transform(each.transform, topic.name)
                        if np.abs(T - first.setdefault(edge, (each, T))[1]).max() > STILL_MAX:
                            moving.add(edge)
            except (DatasetError, BadMessage):
                continue
        still = [each for edge, (each, _) in first.items() if edge not in moving]
        T_body_camera = frames.static.with_others(still).between(body, camera)
        every = [each for each, _ in first.values()]
        if T_body_camera is None and frames.static.with_others(every).between(body, camera) is not None:
            raise DatasetError(
                f"{self.bag.path}: the camera ({camera}) moves on the body ({body}), as {', '.join(topics)} says; "
                "flocc takes a fixed one: name the frame that carries it as odometry, or a camera file with "
                "T_body_camera (--camera)"
            )
        return T_body_camera

    def _body(self, poses: PoseSource | None, frames: Frames) -> str:
        if poses is None:
            return ""
        if poses.edge is not None:
            return poses.edge[1]
        head = self.head(poses.topic)
        return (head.child or _moved_in(frames, head.frame)) if head else ""


def _moved_in(frames: Frames, frame: str) -> str:
    """The frame that /tf moves in another one, through fixed ones (map, odom, base_link), or "" where unclear."""
    for _ in range(len(FIXED_FRAMES)):
        children = [child for parent, child in frames.edges if parent == frame]
        if len(children) != 1:
            break
        frame = children[0]
        if frame.rsplit("/", 1)[-1] not in FIXED_FRAMES:
            return frame
    return ""


def _head(message: Any) -> Head:
    header = getattr(message, "header", None)
    if header is None:
        return Head("", "")
    coding = getattr(message, "encoding", None) or getattr(message, "format", None) or ""
    return Head(header.frame_id.lstrip("/"), getattr(message, "child_frame_id", "").lstrip("/"), coding)


def _parent(name: str) -> str:
    return name.rsplit("/", 1)[0]


def _root(name: str) -> str:
    """The first part of the name of a topic or frame that has several, or ""."""
    first, _, rest = name.strip("/").partition("/")
    return first if rest else ""


def _words(name: str, word: str) -> str:
    return "-".join(re.findall(word, name.lower()))


def _alike(lists: list[list[str]]) -> int:
    """In how many of their first words lists are the same."""
    return sum(1 for _ in takewhile(lambda words: len(set(words)) == 1, zip(*lists, strict=False)))


def _of_distinct_words(topics: list[BagTopic], word: str) -> dict[str, BagTopic]:
    """Topics by what is between the words that all their names begin and end with; empty where one has nothing."""
    words = {topic.name: _words(topic.name, word).split("-") for topic in topics}
    front = _alike(list(words.values()))
    back = _alike([each[front:][::-1] for each in words.values()])
    between = {"-".join(words[topic.name][front : len(words[topic.name]) - back]): topic for topic in topics}
    return between if len(between) == len(topics) and all(between) else {}


def _by_namespace(names: Sequence[str]) -> dict[str, list[str]]:
    """Topics by the first part of their names in which they differ; leaves do not count."""
    parts = {name: name.strip("/").split("/")[:-1] for name in names}
    depth = 0
    while parts and all(len(p) > depth for p in parts.values()) and len({p[depth] for p in parts.values()}) == 1:
        depth += 1
    groups: dict[str, list[str]] = {}
    for name, words in parts.items():
        groups.setdefault(words[depth] if len(words) > depth else "", []).append(name)
    return groups


def _are_of_two_cameras(one: str, other: str) -> bool:
    """Whether topics lie in namespaces that differ in nothing but a number, or left and right."""
    places = [_parent(name.removesuffix("/compressed")).lower() for name in (one, other)]
    kinds = [re.sub(r"\d+|left|right|front|rear|back", "#", place) for place in places]
    return places[0] != places[1] and kinds[0] == kinds[1]


def _left_of(topics: dict[str, BagTopic]) -> BagTopic | None:
    """The left one of two cameras whose names differ in nothing else."""
    lefts = [name for name in topics if "left" in name.lower()]
    if len(topics) == 2 and len(lefts) == 1:
        other = next(name for name in topics if name != lefts[0])
        if lefts[0].lower().replace("left", "right") == other.lower():
            return topics[lefts[0]]
    return None


def _best(topics: list[BagTopic]) -> list[BagTopic]:
    """Of topics of poses those that are no ground truth, and of these odometry, as far as there are any."""
    own = [topic for topic in topics if not is_truth(topic)] or topics
    return [topic for topic in own if topic.type == "nav_msgs/msg/Odometry"] or own


def is_truth(topic: BagTopic) -> bool:
    """Whether a topic of poses is ground truth, by its name."""
    return any(word in topic.name.lower() for word in TRUTH_WORDS)


def named(bag: Bag, types: Sequence[str], name: str) -> BagTopic:
    """The topic of a name.

    Raises:
        DatasetError: It is not there, or of another type.
    """
    topic = bag.topics.get(name)
    if topic is None:
        raise DatasetError(f"{bag.path}: has no topic {name}; it has {listed(list(bag.topics.values()))}")
    if topic.type not in types:
        raise DatasetError(f"{bag.path}: topic {name} is of type {topic.type}, not one of {', '.join(types)}")
    return topic


def only(bag: Bag, fitting: list[BagTopic], what: str, option: str) -> BagTopic:
    """The only topic that fits.

    Raises:
        DatasetError: There is none, or there are several.
    """
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise DatasetError(f"{bag.path}: has {len(fitting)} {what} topics, name one with {option}: {listed(fitting)}")
    raise DatasetError(f"{bag.path}: has no {what} topic; it has {listed(list(bag.topics.values()))}")


def listed(topics: list[BagTopic]) -> str:
    """Topics as a sentence has them."""
    return ", ".join(str(topic) for topic in topics[:12]) + (" and others" if len(topics) > 12 else "") or "no topic"
