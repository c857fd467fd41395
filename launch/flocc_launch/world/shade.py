"""Light maps: how open each point of each surface is to the sky and to the sun. Computed once for a world.

Channel 0 is the sky's share (corners, feet of walls and narrow gaps are darker), channel 1 the sun's, with shadows.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_launch.world.scene import Pixels, Scene, Solid, Surface

Float = NDArray[np.float64]

TEXELS_PER_M = 7.0
TILE = 24
SUN = np.array([0.36, -0.42, 0.83]) / np.linalg.norm([0.36, -0.42, 0.83])
SHADOW_M = 12.0
NEAR_M = 2.5


@dataclass(frozen=True, slots=True, eq=False)
class _Solids:
    """All solids as arrays, to find the few that matter to a surface quickly."""

    centres_m: Float
    halves_m: Float
    yaws_rad: Float

    @classmethod
    def of(cls, solids: list[Solid]) -> "_Solids":
        return cls(
            np.array([solid.centre_m for solid in solids]).reshape(-1, 3),
            np.array([solid.half_m for solid in solids]).reshape(-1, 3),
            np.array([solid.yaw_rad for solid in solids]),
        )

    def chosen(self, chosen: NDArray[np.bool_]) -> "_Solids":
        return _Solids(self.centres_m[chosen], self.halves_m[chosen], self.yaws_rad[chosen])

    def without(self, index: int | None) -> NDArray[np.bool_]:
        kept = np.ones(len(self.yaws_rad), dtype=np.bool_)
        if index is not None:
            kept[index] = False
        return kept

    def within(self, low_m: Float, high_m: Float) -> NDArray[np.bool_]:
        """Which solids may reach into a box."""
        radius = np.hypot(self.halves_m[:, 0], self.halves_m[:, 1])[:, None]
        flat = (self.centres_m[:, :2] + radius > low_m[:2]) & (self.centres_m[:, :2] - radius < high_m[:2])
        over = self.centres_m[:, 2] + self.halves_m[:, 2] > low_m[2]
        return np.asarray(flat.all(axis=1) & over & (self.centres_m[:, 2] - self.halves_m[:, 2] < high_m[2]))

    def local(self, vectors: Float) -> Float:
        """Vectors (S, N, 3) in the axes of each solid."""
        c, s = np.cos(self.yaws_rad)[:, None], np.sin(self.yaws_rad)[:, None]
        x, y = vectors[..., 0], vectors[..., 1]
        return np.stack([c * x + s * y, -s * x + c * y, vectors[..., 2]], axis=-1)


def light_maps(scene: Scene) -> list[Pixels]:
    """One (H, W, 2) uint8 map per surface, in order."""
    solids = _Solids.of(scene.solids)
    return [_light_map(surface, solids) for surface in scene.surfaces]


def _light_map(surface: Surface, solids: _Solids) -> Pixels:
    if surface.glows:
        return np.full((2, 2, 2), (255, 110), dtype=np.uint8)
    points = _points(surface)
    both = np.empty((*points.shape[:2], 2))
    others = solids.chosen(solids.without(surface.solid))
    for row in range(0, points.shape[0], TILE):
        for column in range(0, points.shape[1], TILE):
            tile = (slice(row, row + TILE), slice(column, column + TILE))
            shape = points[tile].shape[:2]
            both[tile] = _light(surface, points[tile].reshape(-1, 3), others).reshape(*shape, 2)
    return np.asarray(np.clip(cv2.blur(both, (2, 2)).reshape(both.shape) * 255, 0, 255), dtype=np.uint8)


def _light(surface: Surface, points: Float, solids: _Solids) -> Float:
    """Openness to the sky and to the sun of points close to each other, (N, 2)."""
    low, high = points.min(axis=0), points.max(axis=0)
    sky = _sky(surface, points, solids.chosen(solids.within(low - NEAR_M, high + NEAR_M)))
    facing = max(float(surface.normal() @ SUN), 0.0)
    sun = np.zeros(len(points))
    if facing > 0:
        swept = np.minimum(low, low + SHADOW_M * SUN), np.maximum(high, high + SHADOW_M * SUN)
        sun = facing * _sunlit(points, solids.chosen(solids.within(*swept)))
    return np.column_stack([sky, sun])


def _points(surface: Surface) -> Float:
    """Centres of the map's texels, (H, W, 3), a little in front of the surface."""
    width, height = surface.size_m
    columns, rows = max(round(width * TEXELS_PER_M), 2), max(round(height * TEXELS_PER_M), 2)
    s, t = (np.arange(columns) + 0.5) * width / columns, (np.arange(rows) + 0.5) * height / rows
    grid = surface.origin_m + s[None, :, None] * surface.right + t[:, None, None] * surface.down
    return np.asarray(grid + 0.02 * surface.normal())


def _sky(surface: Surface, points: Float, solids: _Solids) -> Float:
    upward = 0.78 + 0.22 * float(surface.normal()[2])
    foot = 1.0 - 0.35 * np.exp(-points[:, 2] / 0.35) if abs(surface.normal()[2]) < 0.5 else np.ones(len(points))
    open_ratio = upward * foot * (0.82 + 0.18 * np.clip(points[:, 2] / 5.0, 0, 1))
    offsets = solids.local(points - solids.centres_m[:, None])
    beyond = np.maximum(np.abs(offsets) - solids.halves_m[:, None], 0.0)
    distance_m = np.sqrt(np.einsum("snk,snk->sn", beyond, beyond))
    size = np.minimum(2 * solids.halves_m[:, 2:], 1.0)
    shares = 1 - 0.4 * size * np.exp(-distance_m / 0.2) - 0.22 * size * np.exp(-distance_m / 1.0)
    return np.asarray(open_ratio * shares.prod(axis=0))


def _sunlit(points: Float, solids: _Solids) -> Float:
    """1 where the ray to the sun meets no solid, else 0, by slabs."""
    starts = solids.local(points - solids.centres_m[:, None])
    rays = solids.local(np.broadcast_to(SUN, (len(solids.yaws_rad), 1, 3)))
    rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    one, two = (-solids.halves_m[:, None] - starts) / rays, (solids.halves_m[:, None] - starts) / rays
    enters, leaves = np.minimum(one, two).max(axis=2), np.maximum(one, two).min(axis=2)
    met = (leaves > np.maximum(enters, 0.0)) & (leaves > 0.02)
    return np.where(met.any(axis=0), 0.0, 1.0)
