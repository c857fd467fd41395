"""What a robot measures besides keyframes: one door in.

Rules: a measurement belongs to one keyframe and is never tied to another; it waits for that keyframe's record, and
becomes the record after it. A measurement that cannot be used is refused where it is made, with a reason. What is
given by users speaks of the robot's body; `in_camera` turns it into what records and the pose graph speak of.

A new kind is: a class here with a place in `Measurement`, its record in `flocc_protocol.records`, and one function of
the record's type in `core.factors`.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.effects import Report
from flocc_agent.core.reports import MeasurementKept, MeasurementRefused
from flocc_agent.geometry import adjoint, inverse, is_rigid, pose, pose7, upper_triangle
from flocc_protocol.arrays import Array
from flocc_protocol.codec import COORDINATE_MAX
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId, LogId, checked_name
from flocc_protocol.records import (
    ALTITUDE_MAX_M,
    TAG_LENGTH_MAX,
    FixRecord,
    GeodeticFixRecord,
    MeasurementRecord,
    MetricClosureRecord,
    OdometryCovarianceRecord,
    PoseFixRecord,
    RobotBearingRecord,
    RobotSightingRecord,
    TagSightingRecord,
    encode_record,
)

Float = NDArray[np.float64]

CONDITION_MAX = 1e12
"""Largest ratio of a covariance's eigenvalues: beyond it the matrix is numerically singular."""
VARIANCE_MIN, VARIANCE_MAX = 1e-18, 1e18
"""Eigenvalues of a covariance (m^2 or rad^2): beyond them it says nothing that a solver's numbers can hold."""
WAITING_MAX = 64
"""Measurements that may wait for one keyframe."""


class BadMeasurement(FloccError, ValueError):
    """A measurement that cannot be used; the robot goes on without it."""


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """An absolute position in a local world frame, such as GNSS in a local frame of the user's own.

    Attributes:
        position_m: (3,) of the camera; of the body where the rotation is given.
        covariance_m2: (3, 3), positive definite.
        R_world_body: (3, 3) rotation of the body in that frame, or None where it is not measured.
        rotation_sigma_rad: Standard deviation of the rotation.
    """

    kind: ClassVar[str] = "fix"
    position_m: Float
    covariance_m2: Float
    R_world_body: Float | None = None
    rotation_sigma_rad: float = 0.05

    def __post_init__(self) -> None:
        _check_position(self.kind, self.position_m)
        _check_covariance(self.kind, self.covariance_m2, 3)
        if self.R_world_body is not None:
            _check_pose(self.kind, _posed(self.R_world_body, self.position_m))
            _check_positive(self.kind, "rotation_sigma_rad", self.rotation_sigma_rad)

    def in_camera(self, T_body_camera: Float) -> "Fix | PoseFix":
        """A whole pose becomes the camera's; a position is the camera's already."""
        if self.R_world_body is None:
            return self
        R = np.asarray(self.R_world_body, dtype=float)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = self.rotation_sigma_rad**2 * np.eye(3)
        covariance[3:, 3:] = R.T @ np.asarray(self.covariance_m2) @ R
        return PoseFix(pose(R, np.asarray(self.position_m)), covariance).in_camera(T_body_camera)

    def record(self, keyframe: KeyframeId) -> MeasurementRecord:
        """As the keyframe's log keeps it."""
        return FixRecord(keyframe.index, _array(self.position_m), _array(self.covariance_m2))


@dataclass(frozen=True, slots=True, eq=False)
class GeodeticFix:
    """A GNSS fix on the WGS 84 ellipsoid, of the camera.

    Attributes:
        latitude_deg: North is positive.
        longitude_deg: East is positive.
        altitude_m: Above the ellipsoid.
        covariance_m2: (3, 3) east, north, up; positive definite.
    """

    kind: ClassVar[str] = "gnss"
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    covariance_m2: Float

    def __post_init__(self) -> None:
        limits = (90.0, 180.0, ALTITUDE_MAX_M)
        values = (self.latitude_deg, self.longitude_deg, self.altitude_m)
        if not all(abs(value) <= limit for value, limit in zip(values, limits, strict=True)):
            raise BadMeasurement(f"gnss: latitude, longitude and altitude {values} are no place on Earth")
        _check_covariance(self.kind, self.covariance_m2, 3)

    def in_camera(self, T_body_camera: Float) -> "GeodeticFix":  # noqa: ARG002  # a position has no rotation to use
        """The same."""
        return self

    def record(self, keyframe: KeyframeId) -> MeasurementRecord:
        """As the keyframe's log keeps it."""
        place = (float(self.latitude_deg), float(self.longitude_deg), float(self.altitude_m))
        return GeodeticFixRecord(keyframe.index, *place, _array(self.covariance_m2))


@dataclass(frozen=True, slots=True, eq=False)
class PoseFix:
    """The body's whole pose in a local world frame.

    Attributes:
        T_world_body: (4, 4).
        covariance: (6, 6) in the tangent of that pose, rotation first; positive definite.
    """

    kind: ClassVar[str] = "pose"
    T_world_body: Float
    covariance: Float

    def __post_init__(self) -> None:
        _check_pose(self.kind, self.T_world_body)
        _check_covariance(self.kind, self.covariance, 6)

    def in_camera(self, T_body_camera: Float) -> "PoseFix":
        """The camera's pose."""
        return replace(
            self,
            T_world_body=self.T_world_body @ T_body_camera,
            covariance=_seen_from(inverse(T_body_camera), self.covariance),
        )

    def record(self, keyframe: KeyframeId) -> MeasurementRecord:
        """As the keyframe's log keeps it."""
        return PoseFixRecord(keyframe.index, pose7(self.T_world_body), upper_triangle(self.covariance, "f8"))


@dataclass(frozen=True, slots=True, eq=False)
class StartPose(PoseFix):
    """A known start: the whole pose of the first keyframe, which may be given before that keyframe is."""

    kind: ClassVar[str] = "start"


@dataclass(frozen=True, slots=True, eq=False)
class TagSighting:
    """A fiducial tag: one landmark, the same for all robots.

    Attributes:
        tag: Its name.
        T_body_tag: (4, 4) pose of the tag in the body.
        covariance: (6, 6) in the tangent of that pose, rotation first; positive definite.
    """

    kind: ClassVar[str] = "tag"
    tag: str
    T_body_tag: Float
    covariance: Float

    def __post_init__(self) -> None:
        tag: object = self.tag
        if not isinstance(tag, str | int | np.integer) or isinstance(tag, bool) or not str(tag).isprintable():
            raise BadMeasurement(f"tag: {tag!r} is no name")
        if not 1 <= len(str(self.tag)) <= TAG_LENGTH_MAX:
            raise BadMeasurement(f"tag: a name has 1 to {TAG_LENGTH_MAX} characters, not {len(str(self.tag))}")
        _check_pose(self.kind, self.T_body_tag)
        _check_covariance(self.kind, self.covariance, 6)

    def in_camera(self, T_body_camera: Float) -> "TagSighting":
        """The tag's pose in the camera."""
        return replace(self, T_body_tag=inverse(T_body_camera) @ self.T_body_tag)

    def record(self, keyframe: KeyframeId) -> MeasurementRecord:
        """As the keyframe's log keeps it."""
        return TagSightingRecord(
            keyframe.index, str(self.tag), pose7(self.T_body_tag), upper_triangle(self.covariance, "f8")
        )


@dataclass(frozen=True, slots=True, eq=False)
class RobotSighting:
    """Another robot seen directly, with its whole pose. Stamps of both robots must be on one clock.

    Attributes:
        robot: Its name.
        T_body_robot: (4, 4) pose of its body in this one's.
        covariance: (6, 6) in the tangent of that pose, rotation first; positive definite.
        T_robot_camera: (4, 4) where its camera sits on its body; None: as on this robot.
    """

    kind: ClassVar[str] = "robot"
    robot: str
    T_body_robot: Float
    covariance: Float
    T_robot_camera: Float | None = None

    def __post_init__(self) -> None:
        _check_robot(self.kind, self.robot)
        _check_pose(self.kind, self.T_body_robot)
        _check_covariance(self.kind, self.covariance, 6)
        if self.T_robot_camera is not None:
            _check_pose(self.kind, self.T_robot_camera)

    def in_camera(self, T_body_camera: Float) -> "RobotSighting":
        """The pose of its camera in this one's."""
        T_robot_camera = T_body_camera if self.T_robot_camera is None else self.T_robot_camera
        return replace(
            self,
            T_body_robot=inverse(T_body_camera) @ self.T_body_robot @ T_robot_camera,
            covariance=_seen_from(inverse(T_robot_camera), self.covariance),
        )

    def record(self, keyframe: KeyframeId) -> MeasurementRecord:
        """As the keyframe's log keeps it."""
        _check_other(self.kind, self.robot, keyframe)
        return RobotSightingRecord(
            keyframe.index, self.robot, pose7(self.T_body_robot), upper_triangle(self.covariance, "f8")
        )


@dataclass(frozen=True, slots=True, eq=False)
class RobotBearing:
    """Another robot seen directly, by bearing and range to its camera. Stamps of both must be on one clock.

    Attributes:
        robot: Its name.
        bearing: (3,) direction in this robot's body, of any length.
        range_m: Distance.
        bearing_sigma_rad: Standard deviation of the direction.
        range_sigma_m: Standard deviation of the distance.
    """

    kind: ClassVar[str] = "bearing"
    robot: str
    bearing: Float
    range_m: float
    bearing_sigma_rad: float
    range_sigma_m: float
    _T_camera_body: Float | None = None

    def __post_init__(self) -> None:
        _check_robot(self.kind, self.robot)
        direction = np.asarray(self.bearing, dtype=float)
        if direction.shape != (3,) or not 1e-9 < np.linalg.norm(direction) < np.inf:
            raise BadMeasurement(f"bearing: {direction.tolist()} is no direction")
        for name in ("range_m", "bearing_sigma_rad", "range_sigma_m"):
            _check_positive(self.kind, name, getattr(self, name))

    def in_camera(self, T_body_camera: Float) -> "RobotBearing":
        """The same, with the mount."""
        return replace(self, _T_camera_body=inverse(T_body_camera))

    def record(self, keyframe: KeyframeId) -> MeasurementRecord:
        """As the keyframe's log keeps it: a position with its covariance, in the camera."""
        _check_other(self.kind, self.robot, keyframe)
        T = np.eye(4) if self._T_camera_body is None else self._T_camera_body
        u = T[:3, :3] @ np.asarray(self.bearing, dtype=float) / np.linalg.norm(self.bearing)
        along = np.outer(u, u)
        across_sigma_m = self.range_m * self.bearing_sigma_rad
        covariance = across_sigma_m**2 * (np.eye(3) - along) + self.range_sigma_m**2 * along
        return RobotBearingRecord(keyframe.index, self.robot, _array(self.range_m * u + T[:3, 3]), _array(covariance))


@dataclass(frozen=True, slots=True, eq=False)
class MetricClosure:
    """A registration of a user's own (lidar, stereo, depth) between two keyframes, in metres.

    Attributes:
        match: The other keyframe, of any robot.
        T_query_match: (4, 4) pose of the match's body in that of this measurement's keyframe.
        covariance: (6, 6) in the tangent of that pose, rotation first; positive definite.
        T_match_camera: (4, 4) where the camera sits on the match's body; None: as on this robot.
    """

    kind: ClassVar[str] = "closure"
    match: KeyframeId
    T_query_match: Float
    covariance: Float
    T_match_camera: Float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.match, KeyframeId):
            raise BadMeasurement(f"closure: match {self.match!r} is no KeyframeId")
        _check_pose(self.kind, self.T_query_match)
        _check_covariance(self.kind, self.covariance, 6)
        if self.T_match_camera is not None:
            _check_pose(self.kind, self.T_match_camera)

    def in_camera(self, T_body_camera: Float) -> "MetricClosure":
        """The pose of the match's camera in the query's."""
        T_match_camera = T_body_camera if self.T_match_camera is None else self.T_match_camera
        return replace(
            self,
            T_query_match=inverse(T_body_camera) @ self.T_query_match @ T_match_camera,
            covariance=_seen_from(inverse(T_match_camera), self.covariance),
        )

    def record(self, keyframe: KeyframeId) -> MeasurementRecord:
        """As the keyframe's log keeps it."""
        if keyframe == self.match:
            raise BadMeasurement(f"closure: {keyframe} cannot be registered with itself")
        return MetricClosureRecord(
            keyframe, self.match, pose7(self.T_query_match), upper_triangle(self.covariance, "f8")
        )


@dataclass(frozen=True, slots=True, eq=False)
class OdometryCovariance:
    """How exact the odometry was from the keyframe before to this one.

    Attributes:
        covariance: (6, 6) in the tangent of the later body pose, rotation first; positive definite.
    """

    kind: ClassVar[str] = "odometry"
    covariance: Float

    def __post_init__(self) -> None:
        _check_covariance(self.kind, self.covariance, 6)

    def in_camera(self, T_body_camera: Float) -> "OdometryCovariance":
        """In the tangent of the later camera pose."""
        return OdometryCovariance(_seen_from(inverse(T_body_camera), self.covariance))

    def record(self, keyframe: KeyframeId) -> MeasurementRecord:
        """As the keyframe's log keeps it."""
        if keyframe.index == 0:
            raise BadMeasurement("odometry: the first keyframe has no edge before it")
        return OdometryCovarianceRecord(keyframe.index, upper_triangle(self.covariance, "f8"))


Measurement = (
    Fix
    | GeodeticFix
    | PoseFix
    | StartPose
    | TagSighting
    | RobotSighting
    | RobotBearing
    | MetricClosure
    | OdometryCovariance
)

WHOLE_POSES = {
    TagSighting.kind: ("sightings of tags", "T_body_tag"),
    RobotSighting.kind: ("sightings of robots", "T_body_robot"),
    PoseFix.kind: ("poses in the world", "T_world_body"),
    MetricClosure.kind: ("closures of its own", "T_query_match"),
}
"""By kind: what measurements of a whole pose are called together, and the pose of each."""


def _check_pose(kind: str, T: Float) -> None:
    T = np.asarray(T, dtype=float)
    if T.shape != (4, 4) or not is_rigid(T) or not np.all(np.abs(T[:3, 3]) < COORDINATE_MAX):
        raise BadMeasurement(f"{kind}: the pose is not finite and rigid, or beyond {COORDINATE_MAX:g} m")


def _check_position(kind: str, position_m: Float) -> None:
    position = np.asarray(position_m, dtype=float)
    if position.shape != (3,) or not np.all(np.abs(position) < COORDINATE_MAX):
        raise BadMeasurement(f"{kind}: {position.tolist()} is no position in a local frame")


def _check_covariance(kind: str, covariance: Float, side: int) -> None:
    matrix = np.asarray(covariance, dtype=float)
    if matrix.shape != (side, side) or not np.all(np.isfinite(matrix)):
        raise BadMeasurement(f"{kind}: the covariance is not a finite ({side}, {side}) matrix")
    low, high = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[[0, -1]]
    symmetric = np.abs(matrix - matrix.T).max() <= 1e-6 * np.abs(matrix).max()
    if not symmetric or low <= 0 or low <= high / CONDITION_MAX:
        raise BadMeasurement(f"{kind}: the covariance is not positive definite")
    if low < VARIANCE_MIN or high > VARIANCE_MAX:
        raise BadMeasurement(f"{kind}: the covariance is not within {VARIANCE_MIN:g} and {VARIANCE_MAX:g}")


def _check_positive(kind: str, name: str, value: float) -> None:
    if not 0 < value < COORDINATE_MAX:
        raise BadMeasurement(f"{kind}: {name} must be positive, not {value}")


def _check_robot(kind: str, robot: str) -> None:
    if not isinstance(robot, str):
        raise BadMeasurement(f"{kind}: {robot!r} is no name of a robot")
    try:
        checked_name(robot)
    except FloccError as error:
        raise BadMeasurement(f"{kind}: {error}") from error


def _check_other(kind: str, robot: str, keyframe: KeyframeId) -> None:
    if robot == keyframe.log.robot:
        raise BadMeasurement(f"{kind}: a robot does not see itself")


def _posed(R: Float, position_m: Float) -> Float:
    R = np.asarray(R, dtype=float)
    return pose(R, np.asarray(position_m, dtype=float)) if R.shape == (3, 3) else np.zeros((4, 4))


def _seen_from(T: Float, covariance: Float) -> Float:
    """A covariance moved into another tangent of a rigid body, by the adjoint of `T`."""
    A = adjoint(T)
    moved = A @ np.asarray(covariance, dtype=float) @ A.T
    return np.asarray(0.5 * (moved + moved.T))


def _array(values: Float) -> Array:
    return Array.of(np.asarray(values, dtype=float).ravel(), "f8")


def belongs_to(measurement: Measurement, own: LogId, index: int) -> KeyframeId:
    """The keyframe that a measurement made at keyframe `index` belongs to."""
    return KeyframeId(own, 0 if isinstance(measurement, StartPose) else index)


def record_of(measurement: Measurement, keyframe: KeyframeId) -> MeasurementRecord:
    """The record of what was measured at a keyframe.

    Raises:
        BadMeasurement: No log may hold it: the other robots would refuse it.
    """
    try:
        record = measurement.record(keyframe)
        encode_record(record)
    except BadMeasurement:
        raise
    except ValueError as error:
        raise BadMeasurement(f"{measurement.kind}: {error}") from error
    return record


def measurement_report(measurement: Measurement, keyframe: KeyframeId) -> Report:
    """What was measured, for people."""
    return Report(MeasurementKept(kind=measurement.kind, keyframe=keyframe, of=name_of(measurement)))


def measurement_refused(measurement: Measurement, keyframe: KeyframeId, reason: str) -> Report:
    """What cannot be kept, with the reason."""
    return Report(MeasurementRefused(kind=measurement.kind, keyframe=keyframe, reason=reason))


def name_of(measurement: Measurement) -> str:
    """What was seen: the name of a tag or robot, or a keyframe; empty for a fix."""
    match measurement:
        case TagSighting(tag):
            return str(tag)
        case RobotSighting(robot) | RobotBearing(robot):
            return robot
        case MetricClosure(match):
            return str(match)
        case _:
            return ""
