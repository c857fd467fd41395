"""The swarm's map as visualization_msgs/MarkerArray: RViz shows keyframes, closures, robots and leader by itself.

Every array begins by deleting what the one before drew, so nothing stays behind when maps merge. Positions of other
robots are those of their cameras: where a camera sits on its body, only its robot knows.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.corrected import CorrectedLog
from flocc_agent.core.registration import closure_probability
from flocc_agent.core.robot import Robot
from flocc_agent.runtime.evidence import judgements
from flocc_agent.runtime.ros2.types import MARKERS, MessageTypes
from flocc_protocol.ids import KeyframeId
from flocc_protocol.records import ClosureRecord

Float = NDArray[np.float64]
Colour = tuple[float, float, float]

SPHERE, LINE_STRIP, LINE_LIST, TEXT_ABOVE, POINTS = 2, 4, 5, 9, 8
ADD, DELETE_ALL = 0, 3
KEYFRAMES_MAX = 400
"""Keyframes drawn of each robot, thinned evenly."""
CLOSURES_MAX = 1000
ROBOTS_MAX = 64
ABOVE_M = np.array([0.0, 0.0, 0.6])
COLOURS: tuple[Colour, ...] = (
    (0.0, 0.45, 0.7), (0.84, 0.37, 0.0), (0.0, 0.62, 0.45), (0.71, 0.31, 0.56), (0.79, 0.54, 0.0), (0.23, 0.61, 0.85)
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class KnownClosure:
    """An accepted closure and how probably it is right; None where that is not known."""

    query: KeyframeId
    match: KeyframeId
    probability: float | None


def known_closures(robot: Robot, steepness: float) -> list[KnownClosure]:
    """Closures of all logs that a robot holds, each pair once.

    Args:
        robot: The core; only read, so any thread may.
        steepness: k of Eq. (2).
    """
    records = (record for record in judgements(robot) if isinstance(record, ClosureRecord))
    return [
        KnownClosure(record.query, record.match, closure_probability(record.match_ratio, steepness))
        for record in {(record.query, record.match): record for record in records}.values()
    ]


class Markers:
    """Makes marker arrays in one frame."""

    def __init__(self, types: MessageTypes, frame: str) -> None:
        self._new = types.new
        self._frame = frame

    def array(
        self,
        logs: Mapping[str, CorrectedLog],
        closures: Iterable[KnownClosure],
        leader: str | None,
        stamp_ns: int,
    ) -> Any:
        """MarkerArray of a map.

        Args:
            logs: Robot to its corrected log, of all robots in this map.
            closures: Those that are known; those with an end outside of the map are left out.
            leader: Whom this robot follows.
            stamp_ns: Time of the array.
        """
        drawn = sorted(logs)[:ROBOTS_MAX]
        made = [self._marker("", 0, SPHERE, stamp_ns, action=DELETE_ALL)]
        for k, robot in enumerate(drawn):
            made += self._robot(robot, k, logs[robot], robot == leader, stamp_ns)
        made.append(self._closures({robot: logs[robot] for robot in drawn}, closures, stamp_ns))
        return self._new(MARKERS, markers=made)

    def _robot(self, robot: str, k: int, log: CorrectedLog, leads: bool, stamp_ns: int) -> list[Any]:
        """Keyframes, the line through them, a ball at the last one, and the name above it."""
        step = max(1, -(-len(log) // KEYFRAMES_MAX))
        chosen = sorted({*range(0, len(log), step), len(log) - 1} - {-1})
        places = [T[:3, 3] for index in chosen if (T := log.pose_of(index)) is not None]
        if not places:
            return []
        colour, here = COLOURS[k % len(COLOURS)], places[-1]
        points = [self._point(place) for place in places]
        size_m = 0.5 if leads else 0.3
        text = f"{robot}{' (leads)' * leads}"
        return [
            self._marker(f"path/{robot}", 0, LINE_STRIP, stamp_ns, colour, (0.05, 0.0, 0.0), points=points),
            self._marker(f"keyframes/{robot}", 0, POINTS, stamp_ns, colour, (0.12, 0.12, 0.0), points=points),
            self._marker("robots", 2 * k, SPHERE, stamp_ns, colour, (size_m,) * 3, at=here),
            self._marker("robots", 2 * k + 1, TEXT_ABOVE, stamp_ns, colour, (0.0, 0.0, 0.4), here + ABOVE_M, text=text),
        ]

    def _closures(self, logs: Mapping[str, CorrectedLog], closures: Iterable[KnownClosure], stamp_ns: int) -> Any:
        """Lines between the ends of closures, from blue (probability 0) to yellow (1)."""
        points, colours = list[Any](), list[Any]()
        for closure in list(closures)[-CLOSURES_MAX:]:
            ends = [place_of(logs, keyframe) for keyframe in (closure.query, closure.match)]
            known = [end for end in ends if end is not None]
            if len(known) == 2:
                points += [self._point(end) for end in known]
                colours += [self._colour(confidence(closure.probability))] * 2
        return self._marker("closures", 0, LINE_LIST, stamp_ns, scale=(0.03, 0.0, 0.0), points=points, colors=colours)

    def _marker(
        self,
        namespace: str,
        number: int,
        kind: int,
        stamp_ns: int,
        colour: Colour = (1.0, 1.0, 1.0),
        scale: tuple[float, ...] = (1.0, 1.0, 1.0),
        at: Sequence[float] | Float = (0.0, 0.0, 0.0),
        action: int = ADD,
        **fields: Any,
    ) -> Any:
        """A marker with everything that this kind does not need left empty."""
        new = self._new
        sec, nanosec = divmod(stamp_ns, 10**9)
        stamp = new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        nothing = np.zeros(0, dtype=np.uint8)
        upright = new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        header = new("std_msgs/msg/Header", stamp=stamp, frame_id=self._frame)
        empty: dict[str, Any] = {
            "points": [],
            "colors": [],
            "texture_resource": "",
            "texture": new("sensor_msgs/msg/CompressedImage", header=header, format="", data=nothing),
            "uv_coordinates": [],
            "text": "",
            "mesh_resource": "",
            "mesh_file": new("visualization_msgs/msg/MeshFile", filename="", data=nothing),
            "mesh_use_embedded_materials": False,
        }
        return new(
            "visualization_msgs/msg/Marker",
            header=header,
            ns=namespace,
            id=number,
            type=kind,
            action=action,
            pose=new("geometry_msgs/msg/Pose", position=self._point(at), orientation=upright),
            scale=new("geometry_msgs/msg/Vector3", x=scale[0], y=scale[1], z=scale[2]),
            color=self._colour(colour),
            lifetime=new("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
            frame_locked=False,
            **{**empty, **fields},
        )

    def _point(self, place: Sequence[float] | Float) -> Any:
        x, y, z = (float(number) for number in place)
        return self._new("geometry_msgs/msg/Point", x=x, y=y, z=z)

    def _colour(self, colour: Colour) -> Any:
        red, green, blue = colour
        return self._new("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0)


def place_of(logs: Mapping[str, CorrectedLog], keyframe: KeyframeId) -> Float | None:
    """Where a keyframe lies; None where its log, an earlier journey's for one, is none of these."""
    log = logs.get(keyframe.log.robot)
    T = None if log is None or log.log != keyframe.log else log.pose_of(keyframe.index)
    return None if T is None else np.asarray(T[:3, 3])


def confidence(probability: float | None) -> Colour:
    """From blue (0) to yellow (1), as in the report."""
    p = 0.5 if probability is None else probability
    return p, 0.13 + 0.77 * p, 0.3
