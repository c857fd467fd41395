"""The occupancy grids of all robots in one map, as ROS messages: which are heard, where they lie, what is published.

Each robot's own mapping publishes its grid in its odom frame, on the same topic in its namespace, which is its name.
The last grid of each is kept as it came; it is read and drawn anew when a grid or a correction has come.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import Ros2Config
from flocc_agent.config.ros2 import TOPIC_PATTERN
from flocc_agent.core.corrected import CorrectedLog
from flocc_agent.runtime.ros2.merged_grid import CELLS_MAX, Grid, TooLarge, merged
from flocc_agent.runtime.ros2.node import RosNode
from flocc_agent.runtime.ros2.outgoing import Outgoing
from flocc_agent.runtime.ros2.problems import Problems
from flocc_agent.runtime.ros2.static_frames import pose_of_numbers
from flocc_agent.runtime.ros2.topics import Qos
from flocc_agent.runtime.ros2.types import GRID, BadMessage, MessageTypes

Float = NDArray[np.float64]

ROBOTS_MAX = 16
LATCHED = Qos(1, transient_local=True)
MERGED_TOPIC = "~/merged_map"
RESOLUTION_MIN_M, RESOLUTION_MAX_M = 1e-3, 100.0


class MergedMaps:
    """Hears grids and merges them."""

    def __init__(self, config: Ros2Config, robot: str, types: MessageTypes, node: RosNode, problems: Problems) -> None:
        """Hear the robot's own grid, where one is configured.

        Args:
            config: Topic and frames.
            robot: Name of this robot.
            types: Reads and makes messages.
            node: Where grids come from and go to.
            problems: Takes what is wrong.
        """
        self._config = config
        self._robot = robot
        self._types = types
        self._node = node
        self._problems = problems
        self._outgoing = Outgoing(types, config.map_frame, config.odom_frame)
        self._payloads: dict[str, bytes] = {}
        self._topics: dict[str, str] = {}
        self._grids: dict[str, tuple[bytes, Grid]] = {}
        self._complaints: list[tuple[str, str]] = []
        self._poses: dict[str, Float] = {}
        self.changed = False
        self._publisher = node.publisher(MERGED_TOPIC, GRID, LATCHED) if config.grid_topic else None
        self.follow({robot: None})

    def follow(self, robots: Mapping[str, object]) -> None:
        """Hear the grids of these robots, too; blocks for a moment."""
        for robot in sorted(robots):
            if self._publisher is None or robot in self._topics or len(self._topics) >= ROBOTS_MAX:
                continue
            topic = self._config.grid_topic
            named = topic if robot == self._robot else f"/{robot.replace('-', '_')}/{topic}"
            if TOPIC_PATTERN.fullmatch(named) is None:  # a robot may be called 2nd, a namespace may not
                self._topics[robot] = named
                self._complaints.append((named, f"robot {robot!r} has no ROS namespace of its name; no grid of it"))
                continue
            self._topics[robot] = self._node.subscribe(named, GRID, LATCHED, self._keep(robot)).name

    def is_due(self, logs: Mapping[str, CorrectedLog]) -> bool:
        """Whether a grid, a robot or a correction has come since the last time."""
        if self._publisher is None:
            return False
        poses = {robot: log.T_map_odom for robot, log in logs.items()}
        same = poses.keys() == self._poses.keys() and all(np.array_equal(T, self._poses[r]) for r, T in poses.items())
        due, self._poses = self.changed or not same, poses
        return due

    def publish(self, logs: Mapping[str, CorrectedLog], stamp_ns: int) -> None:
        """Publish the merged map of the robots in this frame; nothing before the first grid.

        Args:
            logs: Robot to its log as it is corrected, of all robots in the map.
            stamp_ns: Time of the map.
        """
        self.changed = False
        parts = [(logs[robot].T_map_odom, grid) for robot in sorted(logs) if (grid := self._grid(robot)) is not None]
        if self._publisher is None or not parts:
            return
        own = self._grid(self._robot)
        resolution_m = min(grid.resolution_m for _, grid in parts) if own is None else own.resolution_m
        try:
            self._publisher.put(self._message(merged(parts, resolution_m), stamp_ns))
        except TooLarge as error:
            self._complaints.append((MERGED_TOPIC, f"{error}; at most {CELLS_MAX} are made"))

    def complain(self) -> None:
        """Say what was wrong with grids; apart from `publish`, which may run on any thread."""
        for where, sentence in self._complaints:
            self._problems.refuse("grid", where, sentence)
        self._complaints.clear()

    def _keep(self, robot: str) -> Callable[[bytes], None]:
        def keep(payload: bytes) -> None:
            self._payloads[robot] = payload
            self.changed = True

        return keep

    def _grid(self, robot: str) -> Grid | None:
        """The last grid of a robot; None where none came that can be used."""
        payload = self._payloads.get(robot)
        if payload is None:
            return None
        if robot not in self._grids or self._grids[robot][0] is not payload:
            try:
                grid = grid_of(self._types.read(payload, GRID), self._frame_of(robot))
            except BadMessage as error:
                del self._payloads[robot]
                self._complaints.append((self._topics.get(robot, GRID), str(error)))
                return None
            self._grids[robot] = (payload, grid)
        return self._grids[robot][1]

    def _frame_of(self, robot: str) -> str:
        """Odom frame of a robot: named as this robot's, with the other's name in place of its own."""
        parts = self._config.odom_frame.split("/")
        return "/".join(robot if part == self._robot else part for part in parts)

    def _message(self, grid: Grid, stamp_ns: int) -> Any:
        height, width = grid.cells.shape
        header, pose = self._outgoing.header(stamp_ns), self._outgoing.placed(grid.T_frame_origin)
        info = self._types.new(
            "nav_msgs/msg/MapMetaData",
            map_load_time=header.stamp,
            resolution=grid.resolution_m,
            width=width,
            height=height,
            origin=pose,
        )
        return self._types.new(GRID, header=header, info=info, data=grid.cells.ravel())


def grid_of(message: Any, frame: str) -> Grid:
    """A grid of an OccupancyGrid message.

    Raises:
        BadMessage: It is in another frame, its size does not fit its cells, or its resolution or origin is none.
    """
    info, told = message.info, message.header.frame_id.lstrip("/")
    if told != frame:
        raise BadMessage(f"the grid is in frame {told!r}, but {frame!r} is needed (docs/ros2.md#nav2)")
    if not RESOLUTION_MIN_M <= info.resolution <= RESOLUTION_MAX_M:
        raise BadMessage(f"a grid with cells of {info.resolution:g} m")
    if info.width * info.height != len(message.data) or not 0 < len(message.data) <= CELLS_MAX:
        raise BadMessage(f"a grid of {info.width}x{info.height} with {len(message.data)} cells")
    p, q = info.origin.position, info.origin.orientation
    T = pose_of_numbers((p.x, p.y, p.z, q.x, q.y, q.z, q.w), "the grid's origin")
    cells = np.asarray(message.data, dtype=np.int8).reshape(info.height, info.width)
    return Grid(np.clip(cells, -1, 100), float(info.resolution), T)
