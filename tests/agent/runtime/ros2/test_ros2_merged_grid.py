"""Occupancy grids of several robots in one: against the definition, cell by cell, on drawn grids and poses."""

from typing import Any

import numpy as np
import pytest
from tests.agent.runtime.ros2.test_ros2_markers import corrected_log

from flocc_agent.config import Ros2Config
from flocc_agent.geometry import inverse, pose, so3_exp
from flocc_agent.runtime.facts import RosProblem
from flocc_agent.runtime.ros2 import merged_grid
from flocc_agent.runtime.ros2.merged_grid import Grid, TooLarge, flat, merged
from flocc_agent.runtime.ros2.merged_maps import MergedMaps, grid_of
from flocc_agent.runtime.ros2.outgoing import Outgoing
from flocc_agent.runtime.ros2.problems import Problems
from flocc_agent.runtime.ros2.topics import Qos, Topic
from flocc_agent.runtime.ros2.types import GRID, BadMessage, MessageTypes

TYPES = MessageTypes()


def planar(x: float, y: float, yaw_rad: float) -> Any:
    return pose(so3_exp(np.array([0.0, 0.0, yaw_rad])), np.array([x, y, 0.0]))


def somewhere(rng: np.random.Generator) -> Any:
    x, y, yaw_rad = rng.uniform(-3, 3, 3).tolist()
    return planar(x, y, yaw_rad)


def drawn(rng: np.random.Generator, resolution_m: float) -> Grid:
    """A grid of unknown, free and occupied cells."""
    cells = rng.choice(np.array([-1, 0, 30, 100], dtype=np.int8), size=(int(rng.integers(5, 20)), 12))
    return Grid(cells, resolution_m, somewhere(rng))


def looked_up(grid: Grid, T_map_frame: Any, place: Any) -> int:
    """What a grid says of a place in the map, one by one."""
    there = inverse(flat(T_map_frame @ grid.T_frame_origin)) @ np.array([*place, 0.0, 1.0])
    column, row = np.floor(there[:2] / grid.resolution_m).astype(int)
    inside = 0 <= row < grid.cells.shape[0] and 0 <= column < grid.cells.shape[1]
    return int(grid.cells[row, column]) if inside else -1


@pytest.mark.parametrize("seed", range(10))
def test_each_cell_is_the_highest_of_the_parts_and_no_obstacle_is_lost(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts = [(somewhere(rng), drawn(rng, r)) for r in (0.1, 0.25)]
    result = merged(parts, 0.1)
    height, width = result.cells.shape
    for row in range(height):
        for column in range(width):
            place = (np.array([column, row]) + 0.5) * 0.1 + result.T_frame_origin[:2, 3]
            assert result.cells[row, column] >= max(looked_up(grid, T, place) for T, grid in parts)
    for T, grid in parts:
        for row, column in np.argwhere(grid.cells == 100):
            centre = flat(T @ grid.T_frame_origin) @ [*((np.array([column, row]) + 0.5) * grid.resolution_m), 0, 1]
            at = np.floor((centre[:2] - result.T_frame_origin[:2, 3]) / 0.1).astype(int)
            assert result.cells[at[1], at[0]] == 100
    unknown = result.cells == -1
    assert unknown.any()
    assert not unknown.all()


def test_one_grid_that_is_not_turned_stays_as_it_is() -> None:
    rng = np.random.default_rng(3)
    grid = Grid(drawn(rng, 0.5).cells, 0.5, planar(1.0, -2.0, 0.0))
    result = merged([(planar(0.5, 0.5, 0.0), grid)], 0.5)
    np.testing.assert_array_equal(result.cells, grid.cells)
    np.testing.assert_allclose(result.T_frame_origin[:2, 3], [1.5, -1.5])


def test_a_correction_moves_the_part_and_not_the_lattice() -> None:
    grid = Grid(np.full((4, 4), 100, dtype=np.int8), 0.1, np.eye(4))
    for x_m in (0.0, 0.31, 7.77):
        result = merged([(planar(x_m, 0.0, 0.3), grid)], 0.1)
        origin = result.T_frame_origin[:2, 3] / 0.1
        np.testing.assert_allclose(origin, np.round(origin), atol=1e-6)


def test_parts_that_lie_too_far_apart_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(merged_grid, "CELLS_MAX", 1000)
    grid = Grid(np.zeros((10, 10), dtype=np.int8), 1.0, np.eye(4))
    with pytest.raises(TooLarge, match=r"would have 110x10 cells of 1 m"):
        merged([(np.eye(4), grid), (planar(100.0, 0.0, 0.0), grid)], 1.0)


def message(frame: str, cells: Any, resolution_m: float = 0.5) -> Any:
    outgoing = Outgoing(TYPES, frame, "odom")
    header = outgoing.header(10**9)
    info = TYPES.new(
        "nav_msgs/msg/MapMetaData",
        map_load_time=header.stamp,
        resolution=resolution_m,
        width=cells.shape[1],
        height=cells.shape[0],
        origin=outgoing.placed(planar(0.0, 0.0, 0.0)),
    )
    return TYPES.new(GRID, header=header, info=info, data=cells.ravel())


CELLS = np.array([[0, 100, -1], [0, 0, 50]], dtype=np.int8)


@pytest.mark.parametrize(
    ("frame", "change", "said"),
    [
        ("map", {}, r"the grid is in frame 'map', but 'r1/odom' is needed"),
        ("r1/odom", {"width": 7}, r"a grid of 7x2 with 6 cells"),
        ("r1/odom", {"resolution": 0.0}, r"cells of 0 m"),
        ("r1/odom", {"resolution": float("nan")}, r"cells of nan m"),
    ],
)
def test_a_grid_that_cannot_be_used_is_refused(frame: str, change: dict[str, Any], said: str) -> None:
    grid = message(frame, CELLS)
    for key, value in change.items():
        setattr(grid.info, key, value)
    with pytest.raises(BadMessage, match=said):
        grid_of(grid, "r1/odom")


class Node:
    """Stands for a ROS node."""

    def __init__(self) -> None:
        self.subscribed: dict[str, Any] = {}
        self.put: list[Any] = []

    def publisher(self, *_: Any) -> Any:
        outer = self

        class Publisher:
            def put(self, message: Any) -> None:
                outer.put.append(message)

        return Publisher()

    def subscribe(self, topic: str, type_name: str, qos: Qos, on_payload: Any) -> Topic:
        self.subscribed[topic] = on_payload
        return Topic(topic, type_name, "", qos)


def test_grids_of_all_robots_of_the_map_are_heard_and_drawn_where_corrections_say() -> None:
    node, facts = Node(), list[Any]()
    config = Ros2Config(grid_topic="local_map", odom_frame="r1/odom")
    maps = MergedMaps(config, "r1", TYPES, node, Problems(facts.append))  # type: ignore[arg-type]
    logs = {"r1": corrected_log("r1", 2), "r2": corrected_log("r2", 2)}
    maps.publish(logs, 0)
    assert node.put == []
    maps.follow(logs)
    maps.follow(logs)
    assert list(node.subscribed) == ["local_map", "/r2/local_map"]
    node.subscribed["local_map"](TYPES.written(message("r1/odom", CELLS)))
    node.subscribed["/r2/local_map"](TYPES.written(message("r2/odom", CELLS)))
    assert [maps.changed] == [True]
    assert [maps.is_due(logs), maps.is_due(logs)] == [True, True]
    maps.publish(logs, 5 * 10**9)
    assert [maps.changed] == [False]
    assert not maps.is_due(logs)
    assert maps.is_due({"r1": logs["r1"]}), "a robot has left the map"
    (told,) = node.put
    parts = [(log.T_map_odom, Grid(CELLS, 0.5, np.eye(4))) for log in logs.values()]
    np.testing.assert_array_equal(told.data.reshape(told.info.height, told.info.width), merged(parts, 0.5).cells)
    assert (told.header.frame_id, told.header.stamp.sec) == ("map", 5)
    node.subscribed["/r2/local_map"](TYPES.written(message("map", CELLS)))
    maps.publish(logs, 6 * 10**9)
    maps.complain()
    assert [fact.sentence for fact in facts if isinstance(fact, RosProblem)] == [
        "/r2/local_map: the grid is in frame 'map', but 'r2/odom' is needed (docs/ros2.md#nav2)"
    ]
    assert len(node.put) == 2


def test_a_robot_whose_name_is_no_namespace_is_said_and_not_heard() -> None:
    node, facts = Node(), list[Any]()
    maps = MergedMaps(Ros2Config(grid_topic="local_map"), "r1", TYPES, node, Problems(facts.append))  # type: ignore[arg-type]
    for _ in range(2):
        maps.follow({"2nd": None, "r-2": None})
        maps.complain()
    assert list(node.subscribed) == ["local_map", "/r_2/local_map"]
    assert [fact.sentence for fact in facts] == [
        "/2nd/local_map: robot '2nd' has no ROS namespace of its name; no grid of it"
    ]


def test_without_a_grid_topic_nothing_is_heard() -> None:
    node = Node()
    maps = MergedMaps(Ros2Config(), "r1", TYPES, node, Problems(lambda _: None))  # type: ignore[arg-type]
    maps.follow({"r2": None})
    assert node.subscribed == {}
    with pytest.raises(ValueError, match="grid_topic must be relative"):
        Ros2Config(grid_topic="/map")
