"""Corrections as ROS messages: `map` to `odom` and `earth` to `map` on /tf (REP 105), the path, the pose.

A covariance of flocc is that of a tangent vector, rotation first, in the frame of the pose that it belongs to. ROS
wants translation first, then rotations about the fixed axes of the parent frame.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import hat, q_wxyz_from_R
from flocc_agent.runtime.ros2.types import PATH, POSE, TEXT, TF, MessageTypes

Float = NDArray[np.float64]

EARTH = "earth"
"""REP 105's name of the Earth-centred frame."""


class Outgoing:
    """Makes the messages that a robot's correction is told with."""

    def __init__(self, types: MessageTypes, map_frame: str, odom_frame: str) -> None:
        self._types = types
        self._map_frame = map_frame
        self._odom_frame = odom_frame

    def transforms(self, T_map_odom: Float, T_earth_map: Float | None, stamp_ns: int) -> Any:
        """TFMessage with `map` to `odom`, and `earth` to `map` where that is known."""
        moved = [self._transform(self._map_frame, self._odom_frame, T_map_odom, stamp_ns)]
        if T_earth_map is not None:
            moved.append(self._transform(EARTH, self._map_frame, T_earth_map, stamp_ns))
        return self._types.new(TF, transforms=moved)

    def _transform(self, parent: str, child: str, T: Float, stamp_ns: int) -> Any:
        new = self._types.new
        q_w, q_x, q_y, q_z = (float(q) for q in q_wxyz_from_R(T[:3, :3]))
        t_x, t_y, t_z = (float(t) for t in T[:3, 3])
        return new(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            transform=new(
                "geometry_msgs/msg/Transform",
                translation=new("geometry_msgs/msg/Vector3", x=t_x, y=t_y, z=t_z),
                rotation=new("geometry_msgs/msg/Quaternion", x=q_x, y=q_y, z=q_z, w=q_w),
            ),
        )

    def path(self, T_map_body: Float, stamps_ns: list[int], stamp_ns: int) -> Any:
        """Path of (N, 4, 4) body poses, each with its own time."""
        new = self._types.new
        posed = [
            new("geometry_msgs/msg/PoseStamped", header=self.header(each_ns), pose=self.placed(T))
            for each_ns, T in zip(stamps_ns, T_map_body, strict=True)
        ]
        return new(PATH, header=self.header(stamp_ns), poses=posed)

    def pose(self, T_map_odom: Float, covariance: Float | None, T_odom_body: Float, stamp_ns: int) -> Any:
        """PoseWithCovarianceStamped of the body in the map; an unknown covariance is all zeros, as in sensor_msgs.

        Args:
            T_map_odom: (4, 4).
            covariance: (6, 6) of `T_map_odom`, rotation first, in its tangent space; None where it is unknown.
            T_odom_body: (4, 4).
            stamp_ns: Time of `T_odom_body`.
        """
        known = np.zeros((6, 6)) if covariance is None else ros_covariance(T_map_odom, covariance, T_odom_body[:3, 3])
        posed = self._types.new(
            "geometry_msgs/msg/PoseWithCovariance", pose=self.placed(T_map_odom @ T_odom_body), covariance=known.ravel()
        )
        return self._types.new(POSE, header=self.header(stamp_ns), pose=posed)

    def text(self, words: str) -> Any:
        """String."""
        return self._types.new(TEXT, data=words)

    def header(self, stamp_ns: int, frame: str | None = None) -> Any:
        """Header in a frame, that of the map where none is said."""
        sec, nanosec = divmod(stamp_ns, 10**9)
        stamp = self._types.new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._types.new("std_msgs/msg/Header", stamp=stamp, frame_id=frame or self._map_frame)

    def placed(self, T: Float) -> Any:
        """Pose of a (4, 4) matrix."""
        new = self._types.new
        q_w, q_x, q_y, q_z = (float(q) for q in q_wxyz_from_R(T[:3, :3]))
        x, y, z = (float(t) for t in T[:3, 3])
        return new(
            "geometry_msgs/msg/Pose",
            position=new("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=new("geometry_msgs/msg/Quaternion", x=q_x, y=q_y, z=q_z, w=q_w),
        )


def ros_covariance(T_map_odom: Float, covariance: Float, t_odom_body_m: Float) -> Float:
    """Covariance (6, 6) of the body's pose in the map, as ROS orders it.

    With `T_map_odom Exp(w, v)`, the body moves by `R (v + w x t_odom_body)` and turns by `R w` about the map's axes.

    Args:
        T_map_odom: (4, 4).
        covariance: (6, 6) of (w, v): rotation (rad), then translation (m), in the tangent space of `T_map_odom`.
        t_odom_body_m: (3,) where the body is in `odom`.

    Returns:
        x, y, z (m), then rotations about the fixed axes X, Y, Z (rad).
    """
    R = T_map_odom[:3, :3]
    J = np.zeros((6, 6))
    J[:3, :3], J[:3, 3:] = -R @ hat(t_odom_body_m), R
    J[3:, :3] = R
    S = J @ covariance @ J.T
    return np.asarray(0.5 * (S + S.T))
