"""What moves with the camera is not the scene: parts of the picture that stay at their pixel while the robot turns.

The picture is looked at in small cells. A cell is tested against an earlier picture where the turn between the two, by
odometry, must have moved whatever is out there by several pixels, at whatever depth: a robot that goes to the right and
turns to the left keeps something in view, and there it tests nothing. Compared are the gradients along that shift, so
that an edge in its direction, such as a horizon, counts for nothing, and of fine structure only: a broad blob resembles
itself a few pixels on. What is out there correlates with nothing on average; what moves with the camera always does, if
it lets the scene shine through, or if a part of it changes, only a little less. A robot that only drives straight shows
nothing, and nothing is hidden.

Two pictures whose cells all stay show the same from the same place. Where they are equal to the last pixel it is one
picture, which came twice: a camera's noise is never the same. Where they are not, the robot stood still.
"""

import hashlib
from collections import deque
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.geometry import angle_rad, between

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

SIDE_PX = 320
"""Longer side that pictures are brought to."""
CELL_PX = 8
WINDOW_PX = 15
"""Side of what is compared around a cell's centre."""
CONTRAST_MIN = 3.0
"""Standard deviation, of 256 grey levels, below which a window is flat."""
CORNER_MIN = 2.0
"""Smaller eigenvalue of a window's gradients: with less it is an edge at best."""
SHIFT_MIN_PX = 4.0
"""A motion that moves what a cell shows by less, at some depth, tests nothing."""
NEAR_STEPS = 3.0
NEAR_MIN_M = 0.3
"""The nearest that something may be: so many lengths of the motion between two pictures, and at least the second."""
FINE_SIGMA_PX = 3.0
"""What is smoother is left out: it resembles itself where it has moved by few pixels."""
BEYOND_PX = 10
"""Three times the former and a bit."""
GRADIENT_MIN = 1.25
"""Grey levels a pixel, root mean square in a window along the shift, below which noise decides."""
MOVED_MIN_M = 0.05
DRIFT_RATIO = 0.05
"""Odometry may be off by so much of the way and of the turns between two pictures: who is back sees the same again."""
SAME_NCC = 0.97
SAME_SHARE = 0.95
CELLS_MIN = 12
"""With fewer cells with corners nobody can say that two pictures are the same."""
EARLIER_MAX = 6
"""Earlier pictures kept to compare with."""
TESTS_MIN = 6
STAYED_MIN = 0.3
STAYED_CHANCE = 3.0
"""Mean correlation of a cell that stays: at least the first, and the second over the number of tests more."""
SUPPORT_MIN = 3.0
"""Cells that stay, of the nine around one, itself among them: one or two are chance."""
TESTS_MAX = 40
"""Old tests fade beyond this: dirt may be wiped off."""


class Repeat(Enum):
    """How a picture can be one that was seen before, though by odometry the robot is elsewhere."""

    SAME_PICTURE = "same picture"
    """Equal to the last pixel: the stream is frozen."""
    SAME_VIEW = "same view"
    """Another picture of the same: the robot stands still, and odometry goes on."""


@dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    """A reduced picture, what its windows have, how the camera stood, and its way to there in m and rad.

    `digest` is of all pixels before they were reduced.
    """

    digest: bytes
    grey: Float32
    mean: Float32
    deviation: Float32
    has_corners: Mask
    gradient: tuple[Float32, Float32]
    squares: tuple[Float32, Float32, Float32]
    T_odom_camera: Float
    way: tuple[float, float]


class OverlayFinder:
    """Cells of one camera's pictures that stay."""

    def __init__(self, camera: Camera) -> None:
        factor = SIDE_PX / max(camera.width, camera.height)
        self._size = max(round(camera.width * factor), WINDOW_PX), max(round(camera.height * factor), WINDOW_PX)
        self._centres = _centres(self._size)
        columns, rows = self._centres
        x = (columns / factor - camera.cx) / camera.fx
        y = (rows / factor - camera.cy) / camera.fy
        grid_x, grid_y = np.meshgrid(x, y)
        self._rays = np.stack([grid_x, grid_y, np.ones_like(grid_x)], axis=-1)
        self._focal_px = camera.fx * factor
        self._earlier: deque[_Picture] = deque(maxlen=EARLIER_MAX)
        self._T_odom_last: Float | None = None
        self._path_m = self._turned_rad = 0.0
        self._tests = np.zeros(grid_x.shape)
        self._stayed = np.zeros(grid_x.shape)

    def add(self, grey: NDArray[np.uint8], T_odom_camera: Float) -> Repeat | None:
        """Look at the next picture; whether it shows the same as one before, though the robot moved by odometry.

        Args:
            grey: (H, W) of the whole picture.
            T_odom_camera: (4, 4) where the camera was, by odometry, metres.
        """
        T_last = np.eye(4) if self._T_odom_last is None else between(self._T_odom_last, T_odom_camera)
        self._T_odom_last = T_odom_camera
        self._path_m += float(np.linalg.norm(T_last[:3, 3]))
        self._turned_rad += angle_rad(T_last[:3, :3])
        now = self._picture(grey, T_odom_camera)
        same = [earlier.digest for earlier in self._earlier if self._is_same(now, earlier)]
        if same:
            return Repeat.SAME_PICTURE if now.digest in same else Repeat.SAME_VIEW
        for earlier in self._earlier:
            self._test(now, earlier)
        self._earlier.append(now)
        return None

    def mask(self, size_px: tuple[int, int]) -> Mask:
        """(H, W) pixels of a picture of this width and height that move with the camera."""
        cells = self.cells().astype(np.uint8)
        whole = np.kron(cells, np.ones((CELL_PX, CELL_PX), np.uint8))[: self._size[1], : self._size[0]]
        return np.asarray(cv2.resize(whole, size_px, interpolation=cv2.INTER_NEAREST) > 0)

    def cells(self) -> Mask:
        """(rows, columns) cells that stay, with those around them."""
        stays = (self._tests >= TESTS_MIN) & (self._stayed >= STAYED_MIN * self._tests + STAYED_CHANCE)
        near = cv2.filter2D(stays.astype(np.float32), -1, np.ones((3, 3), np.float32), borderType=cv2.BORDER_CONSTANT)
        stays &= near >= SUPPORT_MIN
        return np.asarray(cv2.dilate(stays.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)

    def _picture(self, grey: NDArray[np.uint8], T_odom_camera: Float) -> _Picture:
        reduced = cv2.resize(grey, self._size, interpolation=cv2.INTER_AREA).astype(np.float32)
        mean = self._averaged(reduced)
        deviation = np.sqrt(np.maximum(self._averaged(reduced * reduced) - mean * mean, 0.0))
        corners = self._at(np.asarray(cv2.cornerMinEigenVal(reduced, WINDOW_PX)))
        has_corners = (deviation > CONTRAST_MIN) & (corners > CORNER_MIN)
        right, down = _fine_gradient(reduced)
        squares = self._averaged(right * right), self._averaged(right * down), self._averaged(down * down)
        way = self._path_m, self._turned_rad
        digest = hashlib.blake2b(grey.tobytes(), digest_size=16).digest()
        return _Picture(digest, reduced, mean, deviation, has_corners, (right, down), squares, T_odom_camera, way)

    def _test(self, now: _Picture, earlier: _Picture) -> None:
        """Add how much of each cell stays between two pictures, of those that the motion must have moved."""
        shift = self._least_shift_px(between(now.T_odom_camera, earlier.T_odom_camera))
        length = np.linalg.norm(shift, axis=-1)
        along = shift / np.maximum(length, 1e-6)[..., None]
        (right, down), (right_before, down_before) = now.gradient, earlier.gradient
        crossed = self._averaged(right * down_before + down * right_before)
        both = _along(along, (self._averaged(right * right_before), 0.5 * crossed, self._averaged(down * down_before)))
        squares = [np.maximum(_along(along, one.squares), 0.0) for one in (now, earlier)]
        tested = (length > SHIFT_MIN_PX) & (np.maximum(*squares) > GRADIENT_MIN**2)
        self._tests += tested
        self._stayed += tested * both / np.maximum(np.sqrt(squares[0] * squares[1]), 0.5 * GRADIENT_MIN**2)
        fades = self._tests > TESTS_MAX
        self._tests[fades] *= 0.5
        self._stayed[fades] *= 0.5

    def _least_shift_px(self, T_now_earlier: Float) -> Float:
        """(rows, columns, 2) by how much the motion moves what lies in each cell, at the depth that it moves least.

        Whatever lies between the nearest depth and infinity moves along this direction by at least as much.
        """
        moved_m = T_now_earlier[:3, 3]
        far = self._rays @ T_now_earlier[:3, :3].T
        near = far + moved_m / max(NEAR_STEPS * float(np.linalg.norm(moved_m)), NEAR_MIN_M)
        first, last = self._shift_px(far), self._shift_px(near)
        way = last - first
        at = -np.sum(first * way, axis=-1) / np.maximum(np.sum(way * way, axis=-1), 1e-12)
        return np.asarray(first + np.clip(at, 0.0, 1.0)[..., None] * way)

    def _shift_px(self, rays: Float) -> Float:
        """(rows, columns, 2) from each cell's own ray to that, in the reduced picture."""
        depth = np.maximum(rays[..., 2], 1e-3)[..., None]
        return np.asarray((rays[..., :2] / depth - self._rays[..., :2]) * self._focal_px)

    def _is_same(self, now: _Picture, earlier: _Picture) -> bool:
        if not self._moved(now, earlier):
            return False
        corners = now.has_corners & earlier.has_corners
        either = now.has_corners | earlier.has_corners
        if int(corners.sum()) < CELLS_MIN or corners.sum() < SAME_SHARE * either.sum():
            return False
        return float(np.mean(self._similarity(now, earlier)[corners] > SAME_NCC)) > SAME_SHARE

    def _moved(self, now: _Picture, earlier: _Picture) -> bool:
        """Whether the robot is elsewhere by more than odometry drifts on the way: two pictures cannot be one then."""
        T = between(now.T_odom_camera, earlier.T_odom_camera)
        drift_m, drift_rad = (DRIFT_RATIO * abs(b - a) for a, b in zip(earlier.way, now.way, strict=True))
        is_away = float(np.linalg.norm(T[:3, 3])) > MOVED_MIN_M + drift_m
        return is_away or angle_rad(T[:3, :3]) * self._focal_px > SHIFT_MIN_PX + drift_rad * self._focal_px

    def _similarity(self, now: _Picture, earlier: _Picture) -> Float32:
        """Normalised cross-correlation of the windows at the same pixels."""
        covariance = self._averaged(now.grey * earlier.grey) - now.mean * earlier.mean
        return np.asarray(covariance / np.maximum(now.deviation * earlier.deviation, CONTRAST_MIN**2))

    def _averaged(self, values: Float32) -> Float32:
        return self._at(np.asarray(cv2.boxFilter(values, -1, (WINDOW_PX, WINDOW_PX))))

    def _at(self, values: NDArray[np.generic]) -> Float32:
        columns, rows = self._centres
        return np.asarray(values[np.ix_(rows, columns)], np.float32)


def _fine_gradient(grey: Float32) -> tuple[Float32, Float32]:
    """(H, W) grey levels a pixel to the right and down, without what is smooth.

    Slopes go on beyond the border: where they ended there, every border would be an edge that stays.
    """
    beyond = np.pad(grey, BEYOND_PX, mode="reflect", reflect_type="odd")
    fine = beyond - cv2.GaussianBlur(beyond, (0, 0), FINE_SIGMA_PX)
    right, down = (cv2.Sobel(fine, cv2.CV_32F, *axis, scale=0.125) for axis in ((1, 0), (0, 1)))
    inside = slice(BEYOND_PX, -BEYOND_PX)
    return np.asarray(right[inside, inside], np.float32), np.asarray(down[inside, inside], np.float32)


def _along(direction: Float, products: tuple[Float32, Float32, Float32]) -> Float:
    """The mean product (rows, columns) of two gradients' parts in a direction.

    Args:
        direction: (rows, columns, 2) right and down, of length one.
        products: Mean products of both parts to the right, of right and down, and of both down.
    """
    right, down = direction[..., 0], direction[..., 1]
    return np.asarray(products[0] * right**2 + 2.0 * products[1] * right * down + products[2] * down**2)


def _centres(size: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Columns and rows of the cells' centres."""
    columns, rows = (np.arange(CELL_PX // 2, side, CELL_PX, dtype=np.intp) for side in size)
    return columns, rows


def place_of(cells: Mask) -> str:
    """Where in the picture cells lie, in words: the parts of a third of its height or width that hold most of them."""
    rows, columns = np.nonzero(cells)
    if not len(rows):
        return "nowhere"
    vertical = _part(rows / len(cells), ("top", "middle", "bottom"))
    horizontal = _part(columns / cells.shape[1], ("left", "middle", "right"))
    if vertical and horizontal:
        return f"{vertical} {horizontal}" if vertical != horizontal else "middle"
    return vertical or horizontal or "several places"


def _part(shares: Float, names: tuple[str, str, str]) -> str:
    """The third of a side in which nearly all lie; empty where there is none."""
    inside = [np.mean((shares >= k / 3.0 - 0.05) & (shares < (k + 1) / 3.0 + 0.05)) for k in range(3)]
    best = int(np.argmax(inside))
    return names[best] if inside[best] > 0.85 else ""
