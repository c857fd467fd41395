"""The section of a ROS 2 robot."""

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from flocc_agent.config.network import Endpoint
from flocc_agent.config.section import Section, inner

TOPIC_PATTERN = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def checked_topic(text: str) -> str:
    """Return the name of a ROS topic or namespace, or nothing, or say how one looks.

    Raises:
        ValueError: It is no such name.
    """
    if text and not TOPIC_PATTERN.fullmatch(text):
        raise ValueError(f"{text!r} is no ROS name; one looks like /r1/odom, or odom within the namespace")
    return text


RosName = Annotated[str, AfterValidator(checked_topic)]


class Ros2Config(Section):
    """A ROS 2 robot, without a bridge node (docs/ros2.md). Relative topics lie in the namespace."""

    middleware: Literal["auto", "rclpy", "rmw_zenoh"] = "auto"
    """How the agent speaks to ROS: rclpy of the robot's own ROS, with any middleware; rmw_zenoh without ROS here; auto:
    rclpy where it can be imported."""
    router: Endpoint = "tcp/localhost:7447"
    """Where the robot's rmw_zenohd listens; unused with rclpy."""
    domain_id: int | None = Field(None, ge=0, le=232)
    """The robot's ROS_DOMAIN_ID; None takes that of the environment, else 0."""
    namespace: RosName = ""
    """Namespace of relative topics, such as /r1."""
    image_topic: RosName = "camera/image_raw"
    """sensor_msgs/Image or CompressedImage; empty where a program or a recording feeds the agent."""
    image_type: Literal["auto", "raw", "compressed"] = inner("auto")
    """Type of the image topic; auto: compressed where the topic's name ends with compressed."""
    camera_info_topic: RosName = "camera/camera_info"
    """sensor_msgs/CameraInfo with the intrinsics of the images."""
    rectified: bool = False
    """Images are rectified already (image_rect): the P of CameraInfo counts, and no distortion."""
    field_of_view_deg: float | None = Field(None, gt=0, lt=160)
    """Of a wide lens (equidistant), the width of view that is kept when images are remapped to a pinhole, degrees; None
    takes as much as there is, up to 100."""
    odometry_topic: RosName = "odom"
    """nav_msgs/Odometry, of base_frame in odom_frame; empty where a program or a recording feeds the agent."""
    fix_topic: RosName = ""
    """sensor_msgs/NavSatFix of a GNSS receiver, whose fixes tie the map to the Earth; empty: there is none."""
    grid_topic: RosName = ""
    """nav_msgs/OccupancyGrid of the robot's own mapping, in odom_frame; with those of the others (the same topic in the
    namespace that is their name) it becomes ~/merged_map. Empty: there is none."""
    map_frame: str = Field("map", min_length=1)
    """Frame that odom_frame is placed in, on /tf (REP 105)."""
    odom_frame: str = Field("odom", min_length=1)
    """Frame of the odometry; messages of another one are refused."""
    base_frame: str = Field("base_link", min_length=1)
    """Body of the odometry; messages of another one are refused."""
    camera_frame: str = ""
    """Optical frame of the images; images of another one are refused. Empty takes what the images say."""
    camera_mounting: tuple[float, float, float, float, float, float, float] | None = None
    """Optical frame in base_frame: x y z qx qy qz qw, metres; None takes it from the topic `tf_topic`_static."""
    tf_topic: RosName = "/tf"
    """Where map_frame to odom_frame is published."""
    path_topic: RosName = inner("flocc/path")
    """Where the corrected path is published, nav_msgs/Path."""
    pose_topic: RosName = inner("flocc/pose")
    """Where the corrected pose is published, geometry_msgs/PoseWithCovarianceStamped."""
    tf_period_s: float = inner(0.05, gt=0)
    """Least time between two transforms, and between two poses."""
    tf_tolerance_s: float = Field(0.1, ge=0, le=60)
    """The transform is dated so far ahead, so that it can be looked up until the next one."""
    path_period_s: float = inner(1.0, gt=0)
    """Least time between two paths."""
    path_poses_max: int = inner(1000, ge=2, le=100_000)
    """A longer path is thinned out evenly."""

    def is_compressed(self) -> bool:
        """Whether images are CompressedImage messages."""
        by_name = self.image_topic.endswith("compressed")
        return by_name if self.image_type == "auto" else self.image_type == "compressed"

    @model_validator(mode="after")
    def _is_consistent(self) -> "Ros2Config":
        if self.fix_topic and not self.image_topic:
            raise ValueError("fix_topic needs images: fixes belong to their keyframes")
        if self.image_topic and not (self.odometry_topic and self.camera_info_topic):
            raise ValueError("images need odometry_topic and camera_info_topic")
        outputs = ("tf_topic", "path_topic", "pose_topic")
        missing = [name for name in outputs if not getattr(self, name)]
        if missing:
            raise ValueError(f"{missing[0]} must not be empty")
        if self.grid_topic.startswith("/"):
            raise ValueError("grid_topic must be relative: it is the same in each robot's namespace")
        if self.map_frame == self.odom_frame:
            raise ValueError("map_frame and odom_frame must differ")
        q = self.camera_mounting[3:] if self.camera_mounting else (1.0,)
        if abs(sum(part * part for part in q) - 1.0) > 1e-2:
            raise ValueError("camera_mounting is x y z qx qy qz qw with a quaternion of unit length")
        return self
