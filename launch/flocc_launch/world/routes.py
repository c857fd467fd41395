"""Routes through the streets and the motion along them: ground truth `T_world_body` (x forward, y left, z up).

The first three routes are laid so that robots follow each other through some streets, meet from opposite directions in
others, and come back to where they were. Further robots wander by the world's seed.
"""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import pose
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.world import layout
from flocc_launch.world.spec import WorldSpec

Float = NDArray[np.float64]
Node = tuple[int, int]

# alpha and charlie share (1,0) to (2,0) early; charlie and bravo (3,1) to (2,1); alpha and bravo (2,1) to (1,1) to
# (1,2) to (2,2) late: every stretch of drift lies in a loop over several robots. charlie comes back down the street
# that alpha walked up, so these two meet head on as well.
ROUTES: tuple[tuple[Node, ...], ...] = (
    ((0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (1, 2), (2, 2)),
    ((3, 2), (3, 1), (2, 1), (1, 1), (1, 2), (2, 2), (3, 2)),
    ((1, 1), (1, 0), (2, 0), (3, 0), (3, 1), (2, 1), (2, 0)),
)
CORNER_M = 1.7
LATERAL_M = 0.55
TURN_SLOWDOWN = 0.55
EYE_M = 1.05
BOB_M = 0.02
SWAY_RAD = np.deg2rad(7.0)


def routes(spec: WorldSpec) -> list[tuple[Node, ...]]:
    """One list of crossings per robot."""
    legs = max(round(spec.route_m / (layout.STREET_M + layout.BLOCK_M)), 1)
    found = []
    for index in range(spec.robots):
        rng = np.random.default_rng([spec.seed, 1, index])
        nodes = list(ROUTES[index]) if index < len(ROUTES) else [_random_node(rng)]
        while len(nodes) <= legs:
            nodes.append(_next_node(rng, nodes))
        found.append(tuple(nodes[: legs + 1]))
    return found


def walk(spec: WorldSpec, index: int, nodes: tuple[Node, ...]) -> Trajectory:
    """Move along a route at walking speed, slower in turns, looking about a little.

    Args:
        spec: Speeds and rates.
        index: The robot's number, for its own gait.
        nodes: Crossings in order.

    Returns:
        Ground truth `T_world_body` at the odometry's rate, from 0 s.
    """
    rng = np.random.default_rng([spec.seed, 2, index])
    path, heading, curvature = _path(nodes, rng.uniform(-LATERAL_M, LATERAL_M))
    speed = spec.speed_mps * (1 - TURN_SLOWDOWN * np.clip(np.abs(curvature) * CORNER_M, 0, 1))
    step_m = np.linalg.norm(np.diff(path, axis=0), axis=1)
    time_s = np.concatenate([[0.0], np.cumsum(step_m / (0.5 * (speed[1:] + speed[:-1])))])
    stamps_s = np.arange(0.0, time_s[-1], 1.0 / spec.odometry_rate_hz)
    x, y, yaw = (np.interp(stamps_s, time_s, values) for values in (path[:, 0], path[:, 1], heading))
    return Trajectory(stamps_s, _poses(rng, stamps_s, np.column_stack([x, y]), yaw))


def _path(nodes: tuple[Node, ...], lateral_m: float, step_m: float = 0.05) -> tuple[Float, Float, Float]:
    """Points (N, 2) every few centimetres with rounded corners, their headings (unwrapped) and curvatures."""
    corners = np.array([layout.node_m(*node) for node in nodes])
    pieces = [corners[:1]]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        enter, leave = _towards(corner, before, CORNER_M), _towards(corner, after, CORNER_M)
        ratio = np.linspace(0, 1, 33)[:, None]
        pieces.append((1 - ratio) ** 2 * enter + 2 * ratio * (1 - ratio) * corner + ratio**2 * leave)
    points = np.vstack([*pieces, corners[-1:]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    places = np.arange(0.0, length[-1], step_m)
    path = np.column_stack([np.interp(places, length, points[:, k]) for k in range(2)])
    tangent = _smoothed(np.gradient(path, axis=0), 25)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    aside = lateral_m + 0.2 * np.sin(places * 2 * np.pi / 11.0)
    path = path + aside[:, None] * np.column_stack([-np.sin(heading), np.cos(heading)])
    return path, heading, _smoothed(np.gradient(heading, step_m)[:, None], 15)[:, 0]


def _towards(start: Float, goal: Float, distance_m: float) -> Float:
    return np.asarray(start + distance_m * (goal - start) / np.linalg.norm(goal - start))


def _smoothed(values: Float, width: int) -> Float:
    """Running mean along the first axis, with the ends repeated."""
    padded = np.pad(values, ((width, width), (0, 0)), mode="edge")
    kernel = np.ones(2 * width + 1) / (2 * width + 1)
    return np.column_stack([np.convolve(padded[:, k], kernel, mode="valid") for k in range(values.shape[1])])


def _poses(rng: np.random.Generator, stamps_s: Float, xy_m: Float, yaw: Float) -> Float:
    """Poses with the gait's bob, roll and pitch, and a slow look to the left and right."""
    phase = rng.uniform(0, 2 * np.pi, 5)
    sway = SWAY_RAD * np.sin(2 * np.pi * stamps_s / 9.0 + phase[0]) * np.sin(2 * np.pi * stamps_s / 31.0 + phase[1])
    roll = np.deg2rad(0.8) * np.sin(2 * np.pi * 0.83 * stamps_s + phase[2])
    pitch = np.deg2rad(1.0) * np.sin(2 * np.pi * 0.57 * stamps_s + phase[3])
    z = EYE_M + BOB_M * np.sin(2 * np.pi * 1.7 * stamps_s + phase[4])
    poses = np.empty((len(stamps_s), 4, 4))
    for i in range(len(stamps_s)):
        R = _turn(2, yaw[i] + sway[i]) @ _turn(1, pitch[i]) @ _turn(0, roll[i])
        poses[i] = pose(R, np.array([*xy_m[i], z[i]]))
    return poses


def _turn(axis: int, angle_rad: float) -> Float:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    i, j = [k for k in range(3) if k != axis] if axis != 1 else (2, 0)
    R = np.eye(3)
    R[i, i] = R[j, j] = c
    R[i, j], R[j, i] = -s, s
    return R


def _random_node(rng: np.random.Generator) -> Node:
    return int(rng.integers(layout.COLUMNS + 1)), int(rng.integers(layout.ROWS + 1))


def _next_node(rng: np.random.Generator, nodes: list[Node]) -> Node:
    """A crossing next to the last one, not back where the robot came from."""
    column, row = nodes[-1]
    beside = [(column + 1, row), (column - 1, row), (column, row + 1), (column, row - 1)]
    inside = [(c, r) for c, r in beside if 0 <= c <= layout.COLUMNS and 0 <= r <= layout.ROWS]
    onward = [node for node in inside if len(nodes) < 2 or node != nodes[-2]]
    return onward[int(rng.integers(len(onward)))]
