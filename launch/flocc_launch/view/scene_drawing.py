"""What a run does, as messages of Foxglove's schemas: into an MCAP file, to a live viewer, or both, by one writer.

/tf                 world -> each map frame, a map frame -> ROBOT/odom (corrections), ROBOT/odom -> ROBOT (odometry)
/ROBOT/before       keyframes as odometry has them, placed by the first correction
/ROBOT/after        keyframes as the corrections have them
/ROBOT/keyframes    their images
/graph              closures by confidence, links, robots and who leads
/events             sentences
/status             the state of all robots, as the dashboard has it

Maps that have not merged lie over each other at `world`. All rates and sizes are bounded.
"""

import dataclasses
import json
from collections.abc import Iterator, Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.reports import CorrectionApplied, Fact, KeyframeTaken
from flocc_agent.extras import to_install
from flocc_agent.geometry import pose_from_tq, tq_from_pose
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.facts import AgentDied
from flocc_agent.runtime.recording import Frame, Recording, RecordingError
from flocc_launch.dashboard.state import SwarmState, place_of
from flocc_launch.dashboard.words import sentence_of
from flocc_launch.view.drawing import COLOURS, GREEN, GREY, Colour, confidence_colour, place
from flocc_protocol.errors import FloccError

Float = NDArray[np.float64]

WORLD = "world"
POSES_MAX = 1000
PATHS_PERIOD_S = 1.0
GRAPH_PERIOD_S = 1.0
STATUS_PERIOD_S = 1.0
CLOSURES_DRAWN_MAX = 1000
IMAGES_BYTES_MAX = 40_000_000
IMAGE_BYTES_MAX = 100_000
IMAGE_WIDTH_MAX = 640
AS_IT_STANDS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}
JPEG_QUALITY = 75
ROBOTS_MAX = 256


class FoxgloveMissing(FloccError):
    """The package that writes these messages is not installed."""


def foxglove_module() -> Any:
    """The foxglove package, an extra.

    Raises:
        FoxgloveMissing: It is not installed.
    """
    try:
        import foxglove
        import foxglove.channels
        import foxglove.messages
    except ImportError as error:
        raise FoxgloveMissing(f"MCAP and Foxglove need foxglove-sdk: {to_install('mcap')}") from error
    return foxglove


class SceneDrawing:
    """Takes events in order of time and logs what they change."""

    def __init__(
        self, foxglove: Any, context: Any, robots: list[str], images: Mapping[str, Recording], epoch_ns: int
    ) -> None:
        """Begin with an empty scene.

        Args:
            foxglove: The package.
            context: Its context, with the sinks that take the messages.
            robots: Names, for their colours.
            images: Recordings of the robots whose images are at hand.
            epoch_ns: Start of the run, nanoseconds since 1970.
        """
        self._foxglove, self._m = foxglove, foxglove.messages
        self._context = context
        self._robots = sorted(robots)
        self._images = images
        self._epoch_ns = epoch_ns
        self._state = SwarmState(self._robots)
        self._T_odom_body: dict[str, dict[int, Float]] = {}
        self._corrections: dict[str, CorrectionApplied] = {}
        self._first_T_map_odom: dict[str, Float] = {}
        self._channels: dict[str, Any] = {}
        self._due_s: dict[str, float] = {}
        self._images_bytes = 0
        self._cursors: dict[str, int] = {}
        self._known_frames: set[str] = set()

    def take(self, event: Reported[Fact]) -> None:
        """Log what one event changes."""
        self._state.apply(event)
        fact, at_ns = event.fact, self._epoch_ns + round(event.t * 1e9)
        if isinstance(fact, KeyframeTaken):
            self._T_odom_body.setdefault(event.robot, {})[fact.keyframe.index] = pose_from_tq(
                np.array(fact.T_odom_body)
            )
            if fact.keyframe.index == 0:
                self._T_odom_body[event.robot] = {0: self._T_odom_body[event.robot][0]}
            self._transforms(event.robot, at_ns)
            self._image(event.robot, fact.stamp_s, at_ns)
        if isinstance(fact, CorrectionApplied):
            self._corrections[event.robot] = fact
            self._first_T_map_odom.setdefault(event.robot, pose_from_tq(np.array(fact.T_map_odom)))
            self._transforms(event.robot, at_ns)
        if self._is_due(event.robot, event.t, PATHS_PERIOD_S):
            self._paths(event.robot, at_ns)
        if self._is_due("/graph", event.t, GRAPH_PERIOD_S):
            self._graph(at_ns)
        if self._is_due("/status", event.t, STATUS_PERIOD_S):
            self.status(event.t)
        said = sentence_of(event)
        if said is not None:
            self._say(event, f"{event.robot}: {said}", at_ns)

    def finish(self, after: Mapping[str, Float], t: float) -> None:
        """Log all of it once more as it ended.

        Args:
            after: Robot to (N, 4, 4) corrected body poses of its keyframes; rows that are not known are NaN.
            t: End of the run, seconds.
        """
        at_ns = self._epoch_ns + round(t * 1e9)
        for robot in self._robots:
            self._paths(robot, at_ns)
            known = after[robot][np.isfinite(after[robot]).all(axis=(1, 2))] if robot in after else np.zeros((0, 4, 4))
            if len(known):
                self._poses(f"/{robot}/after", self._map_frame(robot), known, at_ns)
                self._state.place(robot, {k: T[:3, 3] for k, T in enumerate(after[robot]) if np.isfinite(T).all()})
        self._graph(at_ns)
        self.status(t)

    def status(self, t: float) -> None:
        """Log the state of all robots as JSON."""
        channel = self._channel("/status", self._json)
        fields = dataclasses.asdict(self._state.snapshot(t, "run"))
        for robot in fields["robots"]:
            robot.pop("path_m")  # it stands in /ROBOT/after
        fields.pop("closures")
        channel.log(fields, log_time=self._epoch_ns + round(t * 1e9))

    # Frames

    def _map_frame(self, robot: str) -> str:
        return self._state.robots[robot].map_frame or f"{robot}/unplaced"

    def _transforms(self, robot: str, at_ns: int) -> None:
        """Where a robot's odometry lies in its map, and the robot in its odometry."""
        frame, T_map_odom = self._map_frame(robot), self._state.robots[robot].T_map_odom
        told = [self._transform(frame, f"{robot}/odom", T_map_odom, at_ns)]
        if frame not in self._known_frames and len(self._known_frames) < ROBOTS_MAX:
            self._known_frames.add(frame)
            told.insert(0, self._transform(WORLD, frame, np.eye(4), at_ns))
        keyframes = self._T_odom_body.get(robot)
        if keyframes:
            told.append(self._transform(f"{robot}/odom", robot, keyframes[max(keyframes)], at_ns))
        self._log("/tf", "FrameTransforms", self._m.FrameTransforms(transforms=told), at_ns)

    def _transform(self, parent: str, child: str, T: Float, at_ns: int) -> Any:
        t, q = self._place(T)
        return self._m.FrameTransform(
            timestamp=self._time(at_ns), parent_frame_id=parent, child_frame_id=child, translation=t, rotation=q
        )

    # Paths

    def _paths(self, robot: str, at_ns: int) -> None:
        odometry = self._T_odom_body.get(robot)
        if not odometry or robot not in self._corrections:
            return
        before = self._first_T_map_odom[robot] @ np.stack([odometry[index] for index in sorted(odometry)])
        self._poses(f"/{robot}/before", self._map_frame(robot), before, at_ns)
        self._poses(f"/{robot}/after", self._map_frame(robot), self._corrected(robot, odometry), at_ns)

    def _corrected(self, robot: str, odometry: Mapping[int, Float]) -> Float:
        """Poses that the last correction says itself, then those that odometry has added, (N, 4, 4)."""
        correction = self._corrections[robot]
        told = [pose_from_tq(np.array(T)) for T in correction.T_map_body]
        last = max(correction.knots, default=-1)
        T_map_odom = pose_from_tq(np.array(correction.T_map_odom))
        newer = [T_map_odom @ odometry[index] for index in sorted(odometry) if index > last]
        return np.stack([*told, *newer]) if told or newer else np.zeros((0, 4, 4))

    def _poses(self, topic: str, frame: str, poses: Float, at_ns: int) -> None:
        step = max(1, -(-len(poses) // POSES_MAX))
        chosen = sorted({*range(0, len(poses), step), len(poses) - 1} - {-1})
        told = [self._pose(poses[k]) for k in chosen]
        message = self._m.PosesInFrame(timestamp=self._time(at_ns), frame_id=frame, poses=told)
        self._log(topic, "PosesInFrame", message, at_ns)

    # Graph

    def _graph(self, at_ns: int) -> None:
        """Closures, links and robots; each entity takes the place of the one before it."""
        closures, colours = list[Any](), list[Any]()
        for ends, probability in self._joined():
            closures += [self._point(end) for end in ends]
            colours += [self._colour(confidence_colour(probability))] * 2
        links = [self._point(end) for ends in self._links() for end in ends]
        entities = [
            self._entity("closures", at_ns, lines=[self._lines(closures, colours)]),
            self._entity("links", at_ns, lines=[self._lines(links, [self._colour(GREEN)] * len(links))]),
            *(self._robot(robot, at_ns) for robot in self._robots if self._state.robots[robot].positions_odom_m),
        ]
        self._log("/graph", "SceneUpdate", self._m.SceneUpdate(entities=entities), at_ns)

    def _joined(self) -> Iterator[tuple[list[list[float]], float | None]]:
        """Closures with both ends placed in one map."""
        for keyframes, probability in list(self._state.closures.items())[-CLOSURES_DRAWN_MAX:]:
            robots = [self._state.robots.get(keyframe.log.robot) for keyframe in keyframes]
            frames = {robot.map_frame for robot in robots if robot is not None}
            ends = [place_of(self._state, keyframe) for keyframe in keyframes]
            if len(frames) == 1 and None not in frames:
                known = [end for end in ends if end is not None]
                if len(known) == 2:
                    yield known, probability

    def _links(self) -> Iterator[list[list[float]]]:
        """Robots of one map that hear each other."""
        for name, robot in sorted(self._state.robots.items()):
            for peer in sorted(robot.neighbours):
                other = self._state.robots.get(peer)
                if other is None or name >= peer or name not in other.neighbours or robot.map_frame != other.map_frame:
                    continue
                ends = [end for end in (place(robot), place(other)) if end is not None]
                if len(ends) == 2 and robot.map_frame is not None:
                    yield ends

    def _robot(self, robot: str, at_ns: int) -> Any:
        leads = self._state.robots[robot].leader == robot
        size_m = 0.5 if leads else 0.3
        colour = self._colour(self._colour_of(robot))
        upright = self._m.Quaternion(x=0, y=0, z=0, w=1)
        here = self._m.Pose(position=self._vector(np.zeros(3)), orientation=upright)
        above = self._m.Pose(position=self._vector(np.array([0.0, 0.0, 0.6])), orientation=upright)
        ball = self._m.SpherePrimitive(pose=here, size=self._vector(np.full(3, size_m)), color=colour)
        text = self._m.TextPrimitive(
            pose=above, billboard=True, font_size=14, scale_invariant=True, color=colour, text=f"{robot}{' ★' * leads}"
        )
        return self._entity(f"robot/{robot}", at_ns, frame=robot, spheres=[ball], texts=[text])

    def _lines(self, points: list[Any], colours: list[Any]) -> Any:
        kind = self._m.LinePrimitiveLineType.LineList
        return self._m.LinePrimitive(type=kind, thickness=2.0, scale_invariant=True, points=points, colors=colours)

    def _entity(self, name: str, at_ns: int, frame: str = WORLD, **primitives: list[Any]) -> Any:
        return self._m.SceneEntity(
            timestamp=self._time(at_ns), frame_id=frame, id=name, frame_locked=True, **primitives
        )

    # Images

    def _image(self, robot: str, stamp_s: float, at_ns: int) -> None:
        """The image of a keyframe, while there is room."""
        recording = self._images.get(robot)
        if recording is None or self._images_bytes >= IMAGES_BYTES_MAX:
            return
        frames, k = recording.frames, self._cursors.get(robot, 0)
        k = 0 if k < len(frames) and frames[k].stamp_s > stamp_s + 1e-3 else k
        while k + 1 < len(frames) and frames[k].stamp_s < stamp_s - 1e-3:
            k += 1
        self._cursors[robot] = k
        try:
            data, form = _compressed(recording, frames[k])
        except (OSError, RecordingError):
            return
        self._images_bytes += len(data)
        message = self._m.CompressedImage(timestamp=self._time(at_ns), frame_id=robot, data=data, format=form)
        self._log(f"/{robot}/keyframes", "CompressedImage", message, at_ns)

    # Words

    def _say(self, event: Reported[Fact], sentence: str, at_ns: int) -> None:
        level = self._m.LogLevel.Error if isinstance(event.fact, AgentDied) else self._m.LogLevel.Info
        message = self._m.Log(timestamp=self._time(at_ns), level=level, message=sentence, name=event.robot)
        self._log("/events", "Log", message, at_ns)

    # Plumbing

    def _is_due(self, what: str, t: float, period_s: float) -> bool:
        if t < self._due_s.get(what, 0.0):
            return False
        self._due_s[what] = t + period_s
        return True

    def _log(self, topic: str, schema: str, message: Any, at_ns: int) -> None:
        make = getattr(self._foxglove.channels, f"{schema}Channel")
        self._channel(topic, make).log(message, log_time=at_ns)

    def _channel(self, topic: str, make: Any) -> Any:
        if topic not in self._channels:
            self._channels[topic] = make(topic, context=self._context)
        return self._channels[topic]

    def _json(self, topic: str, context: Any) -> Any:
        return self._foxglove.Channel(topic, schema={"type": "object"}, message_encoding="json", context=context)

    def _colour_of(self, robot: str) -> Colour:
        return COLOURS[self._robots.index(robot) % len(COLOURS)] if robot in self._robots else GREY

    def _colour(self, colour: Colour) -> Any:
        red, green, blue = (value / 255 for value in colour)
        return self._m.Color(r=red, g=green, b=blue, a=1.0)

    def _time(self, at_ns: int) -> Any:
        return self._m.Timestamp(sec=at_ns // 10**9, nsec=at_ns % 10**9)

    def _point(self, position_m: list[float]) -> Any:
        return self._m.Point3(x=position_m[0], y=position_m[1], z=position_m[2])

    def _vector(self, v: Float) -> Any:
        return self._m.Vector3(x=float(v[0]), y=float(v[1]), z=float(v[2]))

    def _place(self, T: Float) -> tuple[Any, Any]:
        x, y, z, q_w, q_x, q_y, q_z = (float(number) for number in tq_from_pose(T))
        return self._m.Vector3(x=x, y=y, z=z), self._m.Quaternion(x=q_x, y=q_y, z=q_z, w=q_w)

    def _pose(self, T: Float) -> Any:
        t, q = self._place(T)
        return self._m.Pose(position=t, orientation=q)


def _compressed(recording: Recording, frame: Frame) -> tuple[bytes, str]:
    """An image as a viewer takes it, and its format: a small file as it stands, any other as a JPEG.

    Raises:
        OSError: The file cannot be read.
        RecordingError: It is no image.
    """
    form = AS_IT_STANDS.get(frame.image_path.suffix.lower())
    if form is not None and frame.image_path.stat().st_size <= IMAGE_BYTES_MAX:
        return frame.image_path.read_bytes(), form
    image: NDArray[Any] = np.ascontiguousarray(recording.load_image(frame).pixels[..., ::-1])
    if image.shape[1] > IMAGE_WIDTH_MAX:
        height = max(1, round(image.shape[0] * IMAGE_WIDTH_MAX / image.shape[1]))
        image = cv2.resize(image, (IMAGE_WIDTH_MAX, height), interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return bytes(data.tobytes()), "jpeg"


def layout(robots: list[str]) -> str:
    """A Foxglove layout for these messages, as the app imports it: the scene, images, events and status."""
    topics: dict[str, Any] = {"/graph": {"visible": True}}
    for k, robot in enumerate(robots[:ROBOTS_MAX]):
        colour = "#{:02x}{:02x}{:02x}".format(*COLOURS[k % len(COLOURS)])
        topics[f"/{robot}/after"] = {"visible": True, "type": "line", "lineWidth": 0.08, "gradient": [colour, colour]}
        topics[f"/{robot}/before"] = {"visible": False, "type": "line", "lineWidth": 0.04, "gradient": [colour, colour]}
    panels: dict[str, Any] = {
        "3D!map": {"followTf": WORLD, "followMode": "follow-none", "topics": topics, "scene": {}, "transforms": {}},
        "RosOut!events": {"topicToRender": "/events", "searchTerms": [], "minLogLevel": 1},
        "RawMessages!status": {"topicPath": "/status", "diffEnabled": False},
    }
    images = [f"Image!{robot}" for robot in robots[:4]]
    for robot, panel in zip(robots, images, strict=False):
        panels[panel] = {"imageMode": {"imageTopic": f"/{robot}/keyframes"}}
    right: Any = {"first": "RosOut!events", "second": "RawMessages!status", "direction": "column"}
    for panel in reversed(images):
        right = {"first": panel, "second": right, "direction": "column", "splitPercentage": 30}
    split = {"first": "3D!map", "second": right, "direction": "row", "splitPercentage": 65}
    fields = {"configById": panels, "globalVariables": {}, "userNodes": {}, "playbackConfig": {"speed": 1}}
    return json.dumps({**fields, "layout": split}, indent=1) + "\n"
