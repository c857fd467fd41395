"""Occupancy grids of several robots in one: pure arithmetic on arrays.

A cell is unknown (-1), or its probability of being occupied (0 to 100). Where grids overlap, the highest counts: what
one robot saw as an obstacle stays one. Cells of the result are looked up in the parts, so that nothing is left open
between turned cells; occupied cells of the parts are drawn into it besides, so that a coarser result loses none.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse

Float = NDArray[np.float64]
Cells = NDArray[np.int8]

UNKNOWN = -1
OCCUPIED_MIN = 50
CELLS_MAX = 16_000_000
CHUNK_ROWS = 256


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A grid in a plane of its own.

    Attributes:
        cells: (H, W), row by row from the origin.
        resolution_m: Edge of a cell.
        T_frame_origin: (4, 4) of the corner of the first cell.
    """

    cells: Cells
    resolution_m: float
    T_frame_origin: Float

    def size_m(self) -> Float:
        """Width and height, (2,)."""
        return self.resolution_m * np.array(self.cells.shape[::-1], dtype=float)


class TooLarge(ValueError):
    """The parts lie too far apart for one grid."""


def merged(parts: Sequence[tuple[Float, Grid]], resolution_m: float) -> Grid:
    """One grid of all, its rows along the axes of the map.

    Args:
        parts: (4, 4) pose in the map of the frame of each grid, and the grid; heights and tilts are left out.
        resolution_m: Of the result.

    Returns:
        The grid; its origin is a whole number of cells from that of the map, so that it does not shimmer.

    Raises:
        TooLarge: It would have more than `CELLS_MAX` cells.
    """
    placed = [(flat(T @ grid.T_frame_origin), grid) for T, grid in parts]
    corners = np.concatenate([_corners(T, grid) for T, grid in placed])
    low = np.floor(corners.min(axis=0) / resolution_m).astype(int)
    width, height = np.ceil(corners.max(axis=0) / resolution_m).astype(int) - low
    if width * height > CELLS_MAX:
        raise TooLarge(f"the merged map would have {width}x{height} cells of {resolution_m:g} m")
    cells = np.full((height, width), UNKNOWN, dtype=np.int8)
    for T, grid in placed:
        _look_up(cells, low, resolution_m, T, grid)
        _draw_occupied(cells, low, resolution_m, T, grid)
    T_map_origin = np.eye(4)
    T_map_origin[:2, 3] = low * resolution_m
    return Grid(cells, resolution_m, T_map_origin)


def flat(T: Float) -> Float:
    """A pose moved into the plane z = 0: its heading about z and where it is, (4, 4)."""
    yaw_rad = np.arctan2(T[1, 0], T[0, 0])
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    flattened = np.eye(4)
    flattened[:2, :2] = [[cosine, -sine], [sine, cosine]]
    flattened[:2, 3] = T[:2, 3]
    return flattened


def _corners(T: Float, grid: Grid) -> Float:
    """Corners of a grid in the map, (4, 2)."""
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    return _moved(T, unit * grid.size_m())


def _moved(T: Float, points: NDArray[Any]) -> Float:
    """Points (N, 2) moved within the plane."""
    return np.asarray(points @ T[:2, :2].T + T[:2, 3])


def _look_up(cells: Cells, low: NDArray[np.int_], resolution_m: float, T: Float, grid: Grid) -> None:
    """Take over what a part says of the centre of each cell."""
    T_grid_map = inverse(T)
    box = _corners(T, grid) / resolution_m - low
    (left, bottom), (right, top) = np.floor(box.min(axis=0)).astype(int), np.ceil(box.max(axis=0)).astype(int)
    columns = np.arange(max(left, 0), min(right, cells.shape[1]))
    for first in range(max(bottom, 0), min(top, cells.shape[0]), CHUNK_ROWS):
        rows = np.arange(first, min(first + CHUNK_ROWS, top, cells.shape[0]))
        centres = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2) + low + 0.5
        seen = np.floor(_moved(T_grid_map, centres * resolution_m) / grid.resolution_m).astype(int)
        inside = ((seen >= 0) & (seen < grid.cells.shape[::-1])).all(axis=1)
        told = np.full(len(seen), UNKNOWN, dtype=np.int8)
        told[inside] = grid.cells[seen[inside, 1], seen[inside, 0]]
        part = cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        np.maximum(part, told.reshape(part.shape), out=part)


def _draw_occupied(cells: Cells, low: NDArray[np.int_], resolution_m: float, T: Float, grid: Grid) -> None:
    """Draw the centres of a part's occupied cells."""
    rows, columns = np.nonzero(grid.cells >= OCCUPIED_MIN)
    centres = (np.stack([columns, rows], axis=1) + 0.5) * grid.resolution_m
    at = np.floor(_moved(T, centres) / resolution_m).astype(int) - low
    at = np.clip(at, 0, np.array(cells.shape[::-1]) - 1)
    np.maximum.at(cells, (at[:, 1], at[:, 0]), grid.cells[rows, columns])
