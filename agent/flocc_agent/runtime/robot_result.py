"""`result.json`: what a robot knew at its end, as a type for who writes it and who reads it.

Unknown keys are ignored, so that a newer version may write more than this one reads; numbers are finite, quaternions of
unit length and keyframe identifiers well formed.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from flocc_agent.core.knots import bent
from flocc_agent.geometry import pose_from_tq
from flocc_protocol.ids import NAME_PATTERN, KeyframeId

Float = NDArray[np.float64]

Numbers = TypeVar("Numbers", bound=Sequence[float])

QUATERNION_TOLERANCE = 1e-3


RobotName = Annotated[str, Field(pattern=f"^(?:{NAME_PATTERN.pattern})$")]
"""It becomes the name of files."""


def with_direction(pose7: Numbers) -> Numbers:
    """Return seven numbers of a pose, or say that their quaternion is none."""
    if abs(sum(q * q for q in pose7[3:]) - 1.0) > QUATERNION_TOLERANCE:
        raise ValueError(f"quaternion {list(pose7[3:])} is not of unit length")
    return pose7


def checked_keyframe_id(text: str) -> str:
    """Return the text of a keyframe identifier, or say that it is none."""
    KeyframeId.parse(text)
    return text


Keyframe = Annotated[str, AfterValidator(checked_keyframe_id)]
"""A keyframe as text, such as `r1/12`."""
Pose7 = Annotated[list[float], Field(min_length=7, max_length=7), AfterValidator(with_direction)]
"""Seven finite numbers: translation x y z in metres, quaternion w x y z."""


POSE_ORDER = "x y z qw qx qy qz"


class Record(BaseModel):
    """Base of what stands in a run folder: frozen; unknown keys are ignored; numbers are finite."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False, use_attribute_docstrings=True)


class KeyframeResult(Record):
    """One keyframe of a robot at the end of the run."""

    index: int
    stamp_s: float
    T_odom_body: Pose7
    T_map_body: Pose7 | None = None


class ClosureKnown(Record):
    """One closure in a robot's logs at the end of the run."""

    query: Keyframe
    match: Keyframe
    T_query_match_unscaled: Pose7 | None = None
    """Pose of the match camera in the query camera; the translation in network units."""
    match_ratio: float | None = None
    scale_initial: float | None = None
    metric: bool = False
    """The translation is in metres already."""
    scale: float | None = None
    """Metres per network unit after optimisation; null where the back end estimated none."""


class LostRobot(Record):
    """Where a map has a robot that a survivor no longer heard: its last correction, which it may never have got."""

    log: str
    map_frame: str
    term: int
    round: int
    T_map_odom: Pose7
    knots: list[int] = []
    """Keyframes at which odometry was bent; none where the survivor only knows where the robot was last."""
    twists: list[Annotated[list[float], Field(min_length=6, max_length=6)]] = []
    """Of each knot: rotation (rad) and translation (m) about `about_odom_m`."""
    about_odom_m: Annotated[list[float], Field(min_length=3, max_length=3)] = [0.0, 0.0, 0.0]

    def T_map_body(self, T_odom_body: Float) -> Float:
        """Odometry of all keyframes (N, 4, 4) as the map has it."""
        T_map_odom = pose_from_tq(np.array(self.T_map_odom))
        if not self.knots or len(self.knots) != len(self.twists):
            return np.asarray(T_map_odom @ T_odom_body)
        numbers = np.arange(len(T_odom_body))
        bends = bent(np.array(self.knots), np.array(self.twists), np.array(self.about_odom_m), numbers)
        return np.asarray(T_map_odom @ bends @ T_odom_body)


class RobotResult(Record):
    """`robots/ROBOT/result.json`: what a robot knew at its end, or what its store held."""

    robot: RobotName
    incarnation: int = 0
    pose_order: str = POSE_ORDER
    """What the seven numbers of each pose `T_*` are."""
    map_frame: str | None = None
    T_map_odom: Pose7 | None = None
    T_body_camera: Pose7 | None = None
    keyframes: list[KeyframeResult] = []
    closures: list[ClosureKnown] = []
    logs: dict[str, int] = {}
    """Log -> number of its records that this robot holds."""
    lost: list[LostRobot] = []
    """Robots that it no longer heard at the end, by log."""
    best_similarities: dict[str, float] = {}
    """Robot -> best cosine similarity of any of its keyframes with one of this robot, below the threshold as well."""

    def T_odom_body(self) -> Float:
        """Odometry of all keyframes, (N, 4, 4)."""
        return stacked_poses([keyframe.T_odom_body for keyframe in self.keyframes])


def stacked_poses(rows: Iterable[Sequence[float]]) -> Float:
    """Poses (N, 4, 4) of rows of seven numbers."""
    poses = [pose_from_tq(np.array(row)) for row in rows]
    return np.array(poses) if poses else np.zeros((0, 4, 4))


def write_result(folder: Path, result: RobotResult | None) -> Path:
    """Write `result.json`, whole or not at all.

    Raises:
        OSError: There is no result yet, or the disk does not take it.
    """
    if result is None:
        raise FileNotFoundError("there is no result yet")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "result.json"
    path.with_suffix(".tmp").write_text(result.model_dump_json(), encoding="utf-8")
    path.with_suffix(".tmp").replace(path)
    return path
