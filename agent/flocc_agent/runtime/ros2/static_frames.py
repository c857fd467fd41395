"""Where the camera sits on the body, from /tf_static: a bounded tree of frames that do not move."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse, pose_from_tq
from flocc_agent.runtime.ros2.types import BadMessage
from flocc_agent.runtime.trajectory import QUATERNION_NORM_TOLERANCE
from flocc_protocol.codec import COORDINATE_MAX

Float = NDArray[np.float64]

FRAMES_MAX = 4096
DEPTH_MAX = 64
STILL_MAX = 1e-4
"""By how much a transform that stays as it is may differ from an earlier one: metres, and parts of a rotation."""
LINK_UP_MIN = math.cos(math.radians(45))
"""How far along the body's z axis that of a link must point to be the link's own, not where a camera looks."""
POSITION_MAX_M = COORDINATE_MAX / 4
"""So that a camera on such a body is still within what may be sent."""


class StaticFrames:
    """Frames by name, each with its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Float]] = {}
        self._moved: set[str] = set()

    def add(self, message: Any) -> None:
        """Take in a TFMessage of /tf_static; one that is bad does not take the others with it.

        Raises:
            BadMessage: A transform is not rigid, or there are too many frames.
        """
        fault: BadMessage | None = None
        for stamped in message.transforms:
            try:
                self._add(stamped)
            except BadMessage as error:
                fault = fault or error
        if fault is not None:
            raise fault

    def _add(self, stamped: Any) -> None:
        child, parent = stamped.child_frame_id.lstrip("/"), stamped.header.frame_id.lstrip("/")
        if child not in self._parents and len(self._parents) >= FRAMES_MAX:
            raise BadMessage(f"/tf_static has more than {FRAMES_MAX} frames")
        T_parent_child = pose_of_transform(stamped.transform, f"/tf_static: {parent} to {child}")
        before = self._parents.get(child)
        if before is not None and (before[0] != parent or np.abs(before[1] - T_parent_child).max() > STILL_MAX):
            self._moved.add(child)
        self._parents[child] = (parent, T_parent_child)

    def with_others(self, transforms: Sequence[Any]) -> "StaticFrames":
        """These frames and those of other TransformStamped messages, which do not move either; its own count first.

        Raises:
            BadMessage: A transform is not rigid, or there are too many frames.
        """
        both = StaticFrames()
        for stamped in transforms:
            both._add(stamped)
        both._parents.update(self._parents)
        return both

    def moved_between(self, a: str, b: str) -> str | None:
        """A frame of the chain between two that was given more than one place, or None."""
        return min(self._moved & (set(self._ancestors(a)) ^ set(self._ancestors(b))), default=None)

    def root(self, frame: str) -> str:
        """The frame on which all sit that carry a frame; itself where none carries it."""
        return list(self._ancestors(frame))[-1]

    def between(self, a: str, b: str) -> Float | None:
        """`T_a_b`, or None where no chain of static transforms connects the two."""
        of_a, of_b = self._ancestors(a), self._ancestors(b)
        common = next((frame for frame in of_b if frame in of_a), None)
        return None if common is None else inverse(of_a[common]) @ of_b[common]

    def _ancestors(self, frame: str) -> dict[str, Float]:
        """Pose of a frame in each of its ancestors, itself first."""
        found = {frame: np.eye(4)}
        T = np.eye(4)
        for _ in range(DEPTH_MAX):
            if frame not in self._parents:
                break
            frame, T_parent_child = self._parents[frame]
            if frame in found:
                break
            T = T_parent_child @ T
            found[frame] = T
        return found


def stands_as_a_link(frame: str, T_body_frame: Float) -> bool:
    """Whether a frame is called a link and stands as links do, z up (REP 103): a camera looks along its z, not up.

    Args:
        frame: Name of the frame that images are said to be of.
        T_body_frame: (4, 4) its pose in a body whose z points up.
    """
    is_link = frame.lower().rstrip("_0123456789").endswith("link") and "optical" not in frame.lower()
    return is_link and bool(T_body_frame[2, 2] > LINK_UP_MIN)


def pose_of_transform(transform: Any, where: str) -> Float:
    """Pose of a Transform message.

    Raises:
        BadMessage: It is no pose.
    """
    t, q = transform.translation, transform.rotation
    return pose_of_numbers((t.x, t.y, t.z, q.x, q.y, q.z, q.w), where)


def pose_of_numbers(numbers: tuple[float, ...], where: str) -> Float:
    """Pose of `x y z qx qy qz qw`, as ROS writes it.

    Raises:
        BadMessage: A number is not finite or too large to be sent, or the quaternion is not of unit length.
    """
    x, y, z, qx, qy, qz, qw = (float(number) for number in numbers)
    norm = math.hypot(qx, qy, qz, qw)
    is_unit = abs(norm - 1.0) <= QUATERNION_NORM_TOLERANCE
    if not (is_unit and all(abs(each) < POSITION_MAX_M for each in (x, y, z))):
        raise BadMessage(f"{where}: position ({x:g}, {y:g}, {z:g}) with a quaternion of length {norm:.3g} is no pose")
    return pose_from_tq(np.array([x, y, z, qw, qx, qy, qz]))
