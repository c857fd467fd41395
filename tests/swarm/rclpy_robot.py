"""A robot made of plain rclpy nodes, without flocc: drivers that play a recording by simulated time, and a listener.

Everything is in this process; robots and clock share one context, the listener has another one. Publishing happens on
the caller's thread, listening on the executor's.
"""

import threading
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from flocc_agent.geometry import Float, pose_from_tq, tq_from_pose
from flocc_agent.runtime.recording import Frame, Recording

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
COVARIANCE = np.diag([1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4])
STANDING_PERIOD_NS = 100_000_000
"""A robot whose recording is over stands, and goes on publishing odometry."""


def stamp_of(t_ns: int) -> Time:
    """A time as ROS writes it."""
    return Time(sec=t_ns // 10**9, nanosec=t_ns % 10**9)


def ns_of(stamp: Time) -> int:
    """Nanoseconds of a stamp."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def fill(pose: Any, T: Float) -> None:
    """Write a pose into a Pose or Transform."""
    x, y, z, q_w, q_x, q_y, q_z = (float(number) for number in tq_from_pose(T))
    t, q = (pose.position, pose.orientation) if hasattr(pose, "position") else (pose.translation, pose.rotation)
    t.x, t.y, t.z, q.x, q.y, q.z, q.w = x, y, z, q_x, q_y, q_z, q_w


def matrix(pose: Any) -> Float:
    """Read a Pose or Transform."""
    t, q = (pose.position, pose.orientation) if hasattr(pose, "position") else (pose.translation, pose.rotation)
    return pose_from_tq(np.array([t.x, t.y, t.z, q.w, q.x, q.y, q.z]))


class Graph:
    """A context with an executor on a thread."""

    def __init__(self, domain_id: int) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain_id)
        self.executor = SingleThreadedExecutor(context=self.context)
        self._thread = threading.Thread(target=self.executor.spin, daemon=True)
        self._thread.start()

    def node(self, name: str, namespace: str = "") -> Any:
        """A plain node."""
        node = rclpy.create_node(name, context=self.context, namespace=namespace)
        self.executor.add_node(node)
        return node

    def close(self) -> None:
        """End all of it."""
        self.executor.shutdown(timeout_sec=2.0)
        self._thread.join(2.0)
        for node in self.executor.get_nodes():
            node.destroy_node()
        self.context.try_shutdown()


class Drivers:
    """Camera, odometry and static transforms of one robot, in a namespace and frames of its own."""

    def __init__(self, graph: Graph, name: str, recording: Recording, compressed: bool) -> None:
        self.name, self.recording, self.compressed = name, recording, compressed
        self.played = 0
        self.odometry_ns: dict[int, Float] = {}
        self.images_ns: list[int] = []
        self.node = graph.node("driver", f"/{name}")
        kind, topic = (CompressedImage, "camera/image_raw/compressed") if compressed else (Image, "camera/image_raw")
        self._images = self.node.create_publisher(kind, topic, qos_profile_sensor_data)
        self._infos = self.node.create_publisher(CameraInfo, "camera/camera_info", qos_profile_sensor_data)
        self._odometry = self.node.create_publisher(Odometry, "odom", 10)
        self._static = self.node.create_publisher(TFMessage, "/tf_static", LATCHED)
        mounted = TransformStamped()
        mounted.header.frame_id, mounted.child_frame_id = f"{name}/base_link", f"{name}/optical"
        fill(mounted.transform, recording.T_body_camera)
        self._static.publish(TFMessage(transforms=[mounted]))
        self._grid = self.node.create_publisher(OccupancyGrid, "local_map", LATCHED)

    def publish_grid(self, frame: str, marks_m: dict[tuple[float, float], int], resolution_m: float = 0.1) -> None:
        """A grid of 6 x 4 m that begins at (-1, -2) of a frame, free but for some marks."""
        cells = np.zeros((round(4 / resolution_m), round(6 / resolution_m)), dtype=np.int8)
        for (x_m, y_m), value in marks_m.items():
            cells[int((y_m + 2) / resolution_m), int((x_m + 1) / resolution_m)] = value
        grid = OccupancyGrid(data=cells.ravel().tolist())
        grid.header.frame_id = frame
        grid.info.resolution, grid.info.height, grid.info.width = resolution_m, *cells.shape
        grid.info.origin.position.x, grid.info.origin.position.y, grid.info.origin.orientation.w = -1.0, -2.0, 1.0
        self._grid.publish(grid)

    def has_agent(self) -> bool:
        """Whether somebody listens to images and odometry."""
        return all(each.get_subscription_count() > 0 for each in (self._images, self._odometry))

    def play(self, since_ns: int, start_ns: int) -> None:
        """Publish what is due."""
        frames = self.recording.frames
        while self.played < len(frames) and (frames[self.played].stamp_s - frames[0].stamp_s) * 1e9 <= since_ns:
            frame = frames[self.played]
            self._publish(frame, start_ns + round((frame.stamp_s - frames[0].stamp_s) * 1e9))
            self.played += 1
        if self.played == len(frames) and start_ns + since_ns > max(self.odometry_ns) + STANDING_PERIOD_NS:
            self._place(frames[-1].T_odom_body, start_ns + since_ns)

    def _publish(self, frame: Frame, t_ns: int) -> None:
        image = self.recording.load_image(frame)
        info = CameraInfo(height=image.camera.height, width=image.camera.width, distortion_model="plumb_bob")
        camera = image.camera
        info.k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1.0])
        info.d = [0.0] * 5
        self._infos.publish(self._headed(info, t_ns))
        self._images.publish(self._headed(self._picture(image.pixels), t_ns))
        self._place(frame.T_odom_body, t_ns)
        self.images_ns.append(t_ns)

    def _place(self, T_odom_body: Float, t_ns: int) -> None:
        """Publish odometry whose covariance grows, as that of one that integrates its errors does."""
        odometry = Odometry(child_frame_id=f"{self.name}/base_link")
        odometry.header.stamp, odometry.header.frame_id = stamp_of(t_ns), f"{self.name}/odom"
        fill(odometry.pose.pose, T_odom_body)
        odometry.pose.covariance = (COVARIANCE * (1 + len(self.odometry_ns))).ravel()
        self._odometry.publish(odometry)
        self.odometry_ns[t_ns] = T_odom_body

    def _picture(self, pixels: "np.ndarray[Any, np.dtype[np.uint8]]") -> Any:
        if self.compressed:
            _, png = cv2.imencode(".png", pixels[..., ::-1])
            return CompressedImage(format="rgb8; png compressed bgr8", data=png.tobytes())
        height, width, _ = pixels.shape
        return Image(height=height, width=width, encoding="rgb8", step=3 * width, data=pixels.tobytes())

    def _headed(self, message: Any, t_ns: int) -> Any:
        message.header.stamp, message.header.frame_id = stamp_of(t_ns), f"{self.name}/optical"
        return message

    def T_world_odom(self) -> Float:
        """Where its odometry truly begins."""
        first = self.recording.frames[0]
        truth = self.recording.ground_truth(first.stamp_s)
        assert truth is not None
        return truth @ np.linalg.inv(first.T_odom_body)


class Listener:
    """What the agents publish, as a robot's own nodes hear it."""

    def __init__(self, graph: Graph, names: Sequence[str]) -> None:
        self.node = graph.node("listener")
        self.heard: dict[str, list[Any]] = defaultdict(list)
        self._hear(TFMessage, "/tf", 100)
        for name in names:
            self._hear(Path, f"/{name}/flocc/path", LATCHED)
            self._hear(PoseWithCovarianceStamped, f"/{name}/flocc/pose", 10)
            self._hear(String, f"/{name}/flocc/map_frame", LATCHED)
            self._hear(OccupancyGrid, f"/{name}/flocc_{name}/merged_map", LATCHED)
            self._hear(MarkerArray, f"/{name}/flocc/graph", LATCHED)
        self._hear(DiagnosticArray, "/diagnostics", 10)

    def _hear(self, kind: Any, topic: str, qos: Any) -> None:
        self.node.create_subscription(kind, topic, self.heard[topic].append, qos)

    def transforms(self, child: str) -> list[TransformStamped]:
        """What /tf said of a frame, in order."""
        return [
            each for message in list(self.heard["/tf"]) for each in message.transforms if each.child_frame_id == child
        ]

    def T_map_odom(self, name: str) -> Float | None:
        """What /tf said last."""
        told = self.transforms(f"{name}/odom")
        return matrix(told[-1].transform) if told else None

    def map_frame(self, name: str) -> str | None:
        """The swarm's name of its map, as it came last."""
        told = self.heard[f"/{name}/flocc/map_frame"]
        return told[-1].data if told else None

    def merged_at(self, name: str, place_m: Float) -> int | None:
        """What an agent's merged map says of a place in it; None before there is one, or beside it."""
        told = self.heard[f"/{name}/flocc_{name}/merged_map"]
        if not told:
            return None
        info, cells = told[-1].info, np.asarray(told[-1].data)
        at = (place_m[:2] - [info.origin.position.x, info.origin.position.y]) / info.resolution
        column, row = np.floor(at).astype(int)
        if not (0 <= column < info.width and 0 <= row < info.height):
            return None
        return int(cells.reshape(info.height, info.width)[row, column])

    def markers(self, name: str) -> dict[tuple[str, int], Marker]:
        """What an agent last drew, by namespace and number."""
        return {(marker.ns, marker.id): marker for marker in self.heard[f"/{name}/flocc/graph"][-1].markers}

    def status(self, name: str) -> tuple[DiagnosticStatus, dict[str, str]]:
        """What an agent last said of itself, and its values by key."""
        told = [each for array in list(self.heard["/diagnostics"]) for each in array.status]
        one = [each for each in told if each.hardware_id == name][-1]
        return one, {value.key: value.value for value in one.values}

    def call(self, service: str, timeout_s: float = 10.0) -> Trigger.Response:
        """Call a Trigger service and wait for its answer."""
        client = self.node.create_client(Trigger, service)
        assert client.wait_for_service(timeout_s), service
        done = threading.Event()
        future = client.call_async(Trigger.Request())
        future.add_done_callback(lambda _: done.set())
        assert done.wait(timeout_s), service
        return future.result()


class SimulatedClock:
    """`/clock`, which may stand still and begin anew."""

    def __init__(self, graph: Graph) -> None:
        self._publisher = graph.node("simulator").create_publisher(Clock, "/clock", 10)

    def publish(self, t_ns: int) -> None:
        """Say what time it is."""
        self._publisher.publish(Clock(clock=stamp_of(t_ns)))
