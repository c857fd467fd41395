"""Renders a scene as an exact pinhole camera sees it: a depth buffer, then one pass of shading over all pixels.

For a plane with axes (s, t), the homography `inv(K [R s, R t, R o + c])` takes a pixel (u, v, 1) to (x, y, 1) / depth,
where (x, y) are texels. So depth and texture coordinates of every pixel follow from nine numbers per surface, and the
texture's footprint from their derivatives.
"""

import math
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.geometry import inverse
from flocc_launch.world.atlas import LEVELS, Atlas, pack
from flocc_launch.world.scene import Pixels, Scene

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

NEAR_M = 0.05
SUPERSAMPLING = 1.25
BAND_ROWS = 40
TAPS = 4
SUBPIXEL_BITS = 4
SMALLEST_PIXELS = 1.5


@dataclass(frozen=True, slots=True)
class Light:
    """What falls on the scene at one moment, linear; 1 is the brightness at which a texture looks as painted.

    Attributes:
        ambient: Red, green, blue of the sky's light.
        sun: Red, green, blue of the sun's light where nothing shades it.
    """

    ambient: tuple[float, float, float]
    sun: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Baked:
    """A scene made ready for rendering.

    Attributes:
        atlas: Textures, red, green, blue and one more, because four channels are sampled much faster than three.
        shade: (H, W, 2) uint8 atlas of light: openness to the sky, openness to the sun.
        T_world_texel: (N, 3, 3) per surface: columns right and down per texel and origin, metres, world.
        corners_m: (N, K, 3) outlines, repeated to equal length.
        corner_counts: (N,) true number of corners.
        normals: (N, 3).
        shade_map: (4, N) float32: scales and offsets in x and y that take texels to the atlas of light.
    """

    atlas: Atlas
    shade: Pixels
    T_world_texel: Float
    corners_m: Float
    corner_counts: NDArray[np.int64]
    normals: Float
    shade_map: Float32

    def save(self, folder: Path) -> None:
        """Write every array to a file of its own, for other processes to map."""
        for field in fields(self.atlas):
            np.save(folder / f"atlas_{field.name}.npy", getattr(self.atlas, field.name))
        for field in fields(self)[1:]:
            np.save(folder / f"{field.name}.npy", getattr(self, field.name))

    @classmethod
    def load(cls, folder: Path) -> "Baked":
        """Map what `save` wrote; the large atlases are shared with other processes."""
        atlas = Atlas(*(np.load(folder / f"atlas_{f.name}.npy", mmap_mode="r") for f in fields(Atlas)))
        return cls(atlas, *(np.load(folder / f"{f.name}.npy", mmap_mode="r") for f in fields(cls)[1:]))


def bake(scene: Scene, shades: list[Pixels]) -> Baked:
    """Pack a scene's textures and the light maps (one per surface) into atlases and tables."""
    atlas = pack([np.dstack([texture, texture[..., :1]]) for texture in scene.textures])
    shade = pack(shades, levels=1)
    texels = [scene.textures[surface.texture].shape for surface in scene.surfaces]
    per_texel = [s.size_m[0] / shape[1] for s, shape in zip(scene.surfaces, texels, strict=True)]
    down_per_texel = [s.size_m[1] / shape[0] for s, shape in zip(scene.surfaces, texels, strict=True)]
    T = np.empty((len(scene.surfaces), 3, 3))
    shade_map = np.empty((4, len(scene.surfaces)), dtype=np.float32)
    for i, surface in enumerate(scene.surfaces):
        x, y = atlas.offsets[surface.texture]
        right, down = surface.right * per_texel[i], surface.down * down_per_texel[i]
        T[i] = np.column_stack([right, down, surface.origin_m - right * x - down * y])
        ratio_x, ratio_y = shades[i].shape[1] / texels[i][1], shades[i].shape[0] / texels[i][0]
        shade_map[:, i] = (ratio_x, ratio_y, shade.offsets[i][0] - ratio_x * x, shade.offsets[i][1] - ratio_y * y)
    outlines = [surface.corners_m() for surface in scene.surfaces]
    counts = np.array([len(outline) for outline in outlines])
    corners = np.array([np.vstack([o, np.repeat(o[-1:], counts.max() - len(o), axis=0)]) for o in outlines])
    normals = np.array([surface.normal() for surface in scene.surfaces])
    return Baked(atlas, shade.pixels, T, corners, counts, normals, shade_map)


class Renderer:
    """Draws a baked scene with one camera."""

    def __init__(self, baked: Baked, camera: Camera) -> None:
        self._baked = baked
        self._camera = camera
        self._width = round(camera.width * SUPERSAMPLING)
        self._height = round(camera.height * SUPERSAMPLING)
        ratio_x, ratio_y = self._width / camera.width, self._height / camera.height
        self._fx, self._fy = float(camera.fx * ratio_x), float(camera.fy * ratio_y)
        self._cx, self._cy = (camera.cx + 0.5) * ratio_x - 0.5, (camera.cy + 0.5) * ratio_y - 0.5
        self._u = ((np.arange(self._width) - self._cx) / self._fx).astype(np.float32)[None, :]
        self._v = ((np.arange(self._height) - self._cy) / self._fy).astype(np.float32)[:, None]

    def render(self, T_world_camera: Float, light: Light) -> Pixels:
        """Draw one view.

        Args:
            T_world_camera: (4, 4) pose of the camera (x right, y down, z forward), metres.
            light: What falls on the scene.

        Returns:
            (H, W, 3) uint8 RGB pixels of the camera's size.
        """
        T_camera_world = inverse(T_world_camera)
        maps = self._texel_maps(T_camera_world)
        surface = self._visible(T_world_camera, T_camera_world, maps)
        maps32 = np.ascontiguousarray(maps.reshape(-1, 9).T, dtype=np.float32)
        bands = [slice(row, row + BAND_ROWS) for row in range(0, self._height, BAND_ROWS)]
        large = np.vstack([self._shaded(surface[band], self._v[band], maps32, light) for band in bands])
        return np.asarray(
            cv2.resize(large, (self._camera.width, self._camera.height), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )

    def _texel_maps(self, T_camera_world: Float) -> Float:
        """Per surface, the (3, 3) map from a ray (x, y, 1) to texels over depth: an inverse, by cofactors."""
        M = T_camera_world[:3, :3] @ self._baked.T_world_texel
        M[:, :, 2] += T_camera_world[:3, 3]
        right, down, origin = M[..., 0], M[..., 1], M[..., 2]
        rows = np.stack([_cross(down, origin), _cross(origin, right), _cross(right, down)], axis=1)
        determinant = np.einsum("nk,nk->n", origin, rows[:, 2])
        edge_on = np.abs(determinant) < 1e-12
        return np.asarray(rows / np.where(edge_on, np.inf, determinant)[:, None, None])

    def _visible(self, T_world_camera: Float, T_camera_world: Float, maps: Float) -> NDArray[np.intp]:
        """Index of the nearest surface at each pixel, (H, W); the first surface where there is none."""
        inverse_depth = np.zeros((self._height, self._width), dtype=np.float32)
        surface = np.zeros((self._height, self._width), dtype=np.intp)
        for index, outline, nearest in self._candidates(T_world_camera, T_camera_world):
            self._draw(index, outline, nearest, maps[index, 2], inverse_depth, surface)
        return surface

    def _candidates(self, T_world_camera: Float, T_camera_world: Float) -> list[tuple[int, Float, float]]:
        """Surfaces that may be seen, nearest first: index, outline (K, 2) in pixels, greatest inverse depth."""
        baked = self._baked
        facing = np.einsum("nk,nk->n", T_world_camera[:3, 3] - baked.corners_m[:, 0], baked.normals) > 0
        corners = baked.corners_m @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        nearest_m = corners[..., 2].min(axis=1)
        facing &= corners[..., 2].max(axis=1) > NEAR_M
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = corners[..., :2] / corners[..., 2:] * (self._fx, self._fy) + (self._cx, self._cy)
        low, high = pixels.min(axis=1), pixels.max(axis=1)
        whole = facing & (nearest_m >= NEAR_M) & np.all((high > 0) & (low < (self._width, self._height)), axis=1)
        whole &= np.ptp(pixels, axis=1).max(axis=1) > SMALLEST_PIXELS
        found = [(int(i), pixels[i, : baked.corner_counts[i]], 1 / float(nearest_m[i])) for i in np.flatnonzero(whole)]
        for i in np.flatnonzero(facing & (nearest_m < NEAR_M)):
            outline = clipped(corners[i, : baked.corner_counts[i]])
            found.append(
                (int(i), outline[:, :2] / outline[:, 2:] * (self._fx, self._fy) + (self._cx, self._cy), np.inf)
            )
        return sorted(found, key=lambda candidate: -candidate[2])

    def _draw(
        self,
        index: int,
        outline: Float,
        nearest: float,
        depth_row: Float,
        inverse_depth: Float32,
        surface: NDArray[np.intp],
    ) -> None:
        (left, top), (right, bottom) = outline.min(axis=0).tolist(), outline.max(axis=0).tolist()
        x0, x1 = max(math.floor(left), 0), min(math.ceil(right) + 1, self._width)
        y0, y1 = max(math.floor(top), 0), min(math.ceil(bottom) + 1, self._height)
        if x0 >= x1 or y0 >= y1:
            return
        drawn = inverse_depth[y0:y1, x0:x1]
        if nearest < drawn.min():
            return
        mask = np.zeros(drawn.shape, dtype=np.uint8)
        fixed = np.round((outline - (x0, y0)) * 2**SUBPIXEL_BITS).astype(np.int32)
        cv2.fillConvexPoly(mask, fixed, 1, shift=SUBPIXEL_BITS)
        a, b, c = (float(value) for value in depth_row)
        here = a * self._u[:, x0:x1] + (b * self._v[y0:y1] + c)
        nearer = (here > drawn) & mask.view(bool)
        np.copyto(drawn, here, where=nearer)
        np.copyto(surface[y0:y1, x0:x1], index, where=nearer)

    def _shaded(self, surface: NDArray[np.intp], v: Float32, maps: Float32, light: Light) -> Pixels:
        """Colours of a band of rows; bands are small enough for their arrays to stay in the cache."""
        u, m = self._u, [np.take(row, surface) for row in maps]
        depth: Float32 = np.reciprocal(m[6] * u + (m[7] * v + m[8]))
        x: Float32 = (m[0] * u + (m[1] * v + m[2])) * depth
        y: Float32 = (m[3] * u + (m[4] * v + m[5])) * depth
        across = ((m[0] - x * m[6]) * depth / self._fx, (m[3] - y * m[6]) * depth / self._fx)
        along = ((m[1] - x * m[7]) * depth / self._fy, (m[4] - y * m[7]) * depth / self._fy)
        colour = self._sampled(x, y, across, along)
        lit = self._light(surface, x, y, light)
        return np.asarray(cv2.multiply(colour.astype(np.float32), lit, dtype=cv2.CV_8U), dtype=np.uint8)

    def _sampled(
        self, x: Float32, y: Float32, across: tuple[Float32, Float32], along: tuple[Float32, Float32]
    ) -> NDArray[np.uint16]:
        """Sum of a few taps along the longer axis of each pixel's footprint, at the level of the shorter one."""
        across_sq, along_sq = across[0] ** 2 + across[1] ** 2, along[0] ** 2 + along[1] ** 2
        wide = (across_sq > along_sq).astype(np.float32)
        longer_x, longer_y = (b + wide * (a - b) for a, b in zip(across, along, strict=True))
        footprint_sq = np.maximum(np.minimum(across_sq, along_sq), np.maximum(across_sq, along_sq) / TAPS**2)
        level = np.clip(0.5 * np.log2(np.maximum(footprint_sq, 1e-12)) + 0.5, 0, LEVELS - 1).astype(np.intp)
        shrink = np.take((0.5 ** np.arange(LEVELS)).astype(np.float32), level)
        column, row = (np.take(corner, level) for corner in self._baked.atlas.level_corners)
        x, y = x * shrink + (column - np.float32(0.5)), y * shrink + (row - np.float32(0.5))
        longer_x, longer_y = longer_x * shrink, longer_y * shrink
        total = np.zeros((*x.shape, 4), dtype=np.uint16)
        for tap in range(TAPS):
            offset = np.float32((tap - (TAPS - 1) / 2) / TAPS)
            sample = cv2.remap(self._baked.atlas.pixels, x + offset * longer_x, y + offset * longer_y, cv2.INTER_LINEAR)
            cv2.add(total, sample, total, dtype=cv2.CV_16U)
        return np.asarray(cv2.cvtColor(total, cv2.COLOR_RGBA2RGB), dtype=np.uint16)

    def _light(self, surface: NDArray[np.intp], x: Float32, y: Float32, light: Light) -> Float32:
        """Factor of each pixel's colour, (H, W, 3); the root, as pixel values are taken with a gamma of two."""
        ratio_x, ratio_y, offset_x, offset_y = (np.take(table, surface) for table in self._baked.shade_map)
        shade_x, shade_y = x * ratio_x + (offset_x - np.float32(0.5)), y * ratio_y + (offset_y - np.float32(0.5))
        shade = cv2.remap(self._baked.shade, shade_x, shade_y, cv2.INTER_LINEAR).astype(np.float32)
        weights = np.column_stack([light.ambient, light.sun]).astype(np.float32) / np.float32(255.0 * TAPS**2)
        return np.asarray(cv2.sqrt(cv2.transform(shade, weights)), dtype=np.float32)


def clipped(outline: Float, near_m: float = NEAR_M) -> Float:
    """The part of a convex polygon (K, 3), camera frame, that lies in front of the near plane."""
    kept = []
    for i, corner in enumerate(outline):
        following = outline[(i + 1) % len(outline)]
        if corner[2] >= near_m:
            kept.append(corner)
        if (corner[2] >= near_m) != (following[2] >= near_m):
            ratio = (near_m - corner[2]) / (following[2] - corner[2])
            kept.append(corner + ratio * (following - corner))
    return np.array(kept).reshape(-1, 3)


def _cross(a: Float, b: Float) -> Float:
    """Cross products of (N, 3) and (N, 3)."""
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )
