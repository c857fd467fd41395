"""Renders a scene as an exact pinhole camera sees it: a depth buffer, then one pass of shading over all pixels.

For a plane with axes (s, t), the homography `inv(K [R s, R t, R o + c])` takes a pixel (u, v, 1) to (x, y, 1) / depth,
where (x, y) are texels. So depth and texture coordinates of every pixel follow from nine numbers per surface, and the
texture's footprint from their derivatives.
"""

from dataclasses import dataclass

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
SUPERSAMPLING = 1.5
TAPS = 3
SUBPIXEL_BITS = 4


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
        atlas: Textures.
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


def bake(scene: Scene, shades: list[Pixels]) -> Baked:
    """Pack a scene's textures and the light maps (one per surface) into atlases and tables."""
    atlas = pack(scene.textures)
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
        large = self._shaded(surface, maps.astype(np.float32), light)
        return np.asarray(
            cv2.resize(large, (self._camera.width, self._camera.height), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )

    def _texel_maps(self, T_camera_world: Float) -> Float:
        """Per surface, the (3, 3) map from a ray (x, y, 1) to texel coordinates over depth; zero if edge-on."""
        M = T_camera_world[:3, :3] @ self._baked.T_world_texel
        M[:, :, 2] += T_camera_world[:3, 3]
        edge_on = np.abs(np.linalg.det(M)) < 1e-12
        M[edge_on] = np.eye(3)
        maps = np.linalg.inv(M)
        maps[edge_on] = 0.0
        return np.asarray(maps)

    def _visible(self, T_world_camera: Float, T_camera_world: Float, maps: Float) -> NDArray[np.int32]:
        """Index of the nearest surface at each pixel, (H, W) int32; the first surface where there is none."""
        inverse_depth = np.zeros((self._height, self._width), dtype=np.float32)
        surface = np.zeros((self._height, self._width), dtype=np.int32)
        for index, outline in self._candidates(T_world_camera, T_camera_world):
            self._draw(index, outline, maps[index, 2], inverse_depth, surface)
        return surface

    def _candidates(self, T_world_camera: Float, T_camera_world: Float) -> list[tuple[int, Float]]:
        """Surfaces that may be seen, nearest first, with their outlines (K, 3) in the camera frame."""
        baked = self._baked
        position = T_world_camera[:3, 3]
        facing = np.einsum("nk,nk->n", position - baked.corners_m[:, 0], baked.normals) > 0
        corners = baked.corners_m @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        x, y, z = corners[..., 0], corners[..., 1], corners[..., 2]
        right, left = (self._width - self._cx) / self._fx, self._cx / self._fx
        below, above = (self._height - self._cy) / self._fy, self._cy / self._fy
        outside = (
            (z < NEAR_M).all(1)
            | (x > right * z).all(1)
            | (x < -left * z).all(1)
            | (y > below * z).all(1)
            | (y < -above * z).all(1)
        )
        chosen = np.flatnonzero(facing & ~outside)
        order = np.argsort(np.linalg.norm(corners[chosen], axis=2).min(axis=1), kind="stable")
        return [(int(i), corners[i, : baked.corner_counts[i]]) for i in chosen[order]]

    def _draw(
        self, index: int, outline: Float, depth_row: Float, inverse_depth: Float32, surface: NDArray[np.int32]
    ) -> None:
        outline = clipped(outline)
        if len(outline) < 3:
            return
        pixels = outline[:, :2] / outline[:, 2:] * (self._fx, self._fy) + (self._cx, self._cy)
        low = np.maximum(np.floor(pixels.min(axis=0)), 0).astype(int)
        high = np.minimum(np.ceil(pixels.max(axis=0)) + 1, (self._width, self._height)).astype(int)
        if np.any(low >= high):
            return
        mask = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.uint8)
        fixed = np.clip(np.round((pixels - low) * 2**SUBPIXEL_BITS), -(2**27), 2**27).astype(np.int32)
        cv2.fillConvexPoly(mask, fixed, 1, shift=SUBPIXEL_BITS)
        rows, columns = slice(low[1], high[1]), slice(low[0], high[0])
        a, b, c = depth_row.astype(np.float32)
        here = a * self._u[:, columns] + (b * self._v[rows] + c)
        nearer = (here > inverse_depth[rows, columns]) & mask.view(bool)
        np.copyto(inverse_depth[rows, columns], here, where=nearer)
        np.copyto(surface[rows, columns], index, where=nearer)

    def _shaded(self, surface: NDArray[np.int32], maps: Float32, light: Light) -> Pixels:
        u, v = self._u, self._v
        m = [np.take(np.ascontiguousarray(maps[:, i // 3, i % 3]), surface) for i in range(9)]
        depth = 1.0 / (m[6] * u + (m[7] * v + m[8]))
        x = (m[0] * u + (m[1] * v + m[2])) * depth
        y = (m[3] * u + (m[4] * v + m[5])) * depth
        across = ((m[0] - x * m[6]) * depth / self._fx, (m[3] - y * m[6]) * depth / self._fx)
        along = ((m[1] - x * m[7]) * depth / self._fy, (m[4] - y * m[7]) * depth / self._fy)
        colour = self._sampled(x, y, across, along)
        lit = self._light(surface, x, y, light)
        return np.asarray(cv2.multiply(colour, lit, dtype=cv2.CV_8U), dtype=np.uint8)

    def _sampled(
        self, x: Float32, y: Float32, across: tuple[Float32, Float32], along: tuple[Float32, Float32]
    ) -> Float32:
        """Mean of a few taps along the longer axis of each pixel's footprint, at the level of the shorter one."""
        across_sq, along_sq = across[0] ** 2 + across[1] ** 2, along[0] ** 2 + along[1] ** 2
        wide = across_sq > along_sq
        longer_x, longer_y = np.where(wide, across[0], along[0]), np.where(wide, across[1], along[1])
        longer_sq, shorter_sq = np.maximum(across_sq, along_sq), np.minimum(across_sq, along_sq)
        footprint_sq = np.maximum(shorter_sq, longer_sq / TAPS**2)
        level = np.clip(np.round(0.5 * np.log2(np.maximum(footprint_sq, 1e-12))), 0, LEVELS - 1).astype(np.int32)
        shrink = np.take((0.5 ** np.arange(LEVELS)).astype(np.float32), level)
        column, row = (np.take(corner, level) for corner in self._baked.atlas.level_corners)
        total: Float32 | None = None
        for tap in range(TAPS):
            offset = np.float32((tap - (TAPS - 1) / 2) / TAPS)
            tap_x = (x + offset * longer_x) * shrink + (column - np.float32(0.5))
            tap_y = (y + offset * longer_y) * shrink + (row - np.float32(0.5))
            sample = cv2.remap(self._baked.atlas.pixels, tap_x, tap_y, cv2.INTER_LINEAR)
            total = sample.astype(np.float32) if total is None else cv2.add(total, sample, dtype=cv2.CV_32F)
        assert total is not None
        return total

    def _light(self, surface: NDArray[np.int32], x: Float32, y: Float32, light: Light) -> Float32:
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
