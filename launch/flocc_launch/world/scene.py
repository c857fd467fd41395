"""What a world is made of: flat textured surfaces that are seen, and solids that cast shadows.

World frame: x east, y north, z up, metres. A surface is a rectangle with its own axes, right and down as seen from its
front; a polygon may cut a part out of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Pixels = NDArray[np.uint8]

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A flat surface, seen from its front only.

    Attributes:
        origin_m: (3,) top left corner, world.
        right: (3,) unit vector.
        down: (3,) unit vector, orthogonal to `right`.
        size_m: Width and height.
        texture: Index into the scene's textures, which is stretched over the rectangle.
        outline_m: (K, 2) convex polygon in (right, down) coordinates; None is the whole rectangle.
        solid: Index of the solid that it belongs to, which does not shade it.
        glows: Whether light and shadow leave it alone, as the sky.
    """

    origin_m: Float
    right: Float
    down: Float
    size_m: tuple[float, float]
    texture: int
    outline_m: Float | None = None
    solid: int | None = None
    glows: bool = False

    def corners_m(self) -> Float:
        """Outline in the world, (K, 3)."""
        width, height = self.size_m
        outline = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)
        outline = outline if self.outline_m is None else self.outline_m
        return np.asarray(self.origin_m + outline[:, :1] * self.right + outline[:, 1:] * self.down)

    def normal(self) -> Float:
        """(3,) unit vector out of the front."""
        return np.cross(self.down, self.right)


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """An upright box that casts shadows.

    Attributes:
        centre_m: (3,).
        half_m: (3,) half of its length, width and height.
        yaw_rad: Turned about the vertical.
    """

    centre_m: Float
    half_m: Float
    yaw_rad: float = 0.0

    def plan_m(self) -> Float:
        """Corners (4, 2) in the plan, counter-clockwise from the rear right."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
        return np.asarray(self.centre_m[:2] + signs * self.half_m[:2] @ np.array([[c, s], [-s, c]]))


@dataclass(slots=True, eq=False)
class Scene:
    """Surfaces, their textures and the solids behind them; grows while a world is built."""

    textures: list[Pixels] = field(default_factory=list)
    surfaces: list[Surface] = field(default_factory=list)
    solids: list[Solid] = field(default_factory=list)

    def add_texture(self, pixels: Pixels) -> int:
        """Keep (H, W, 3) uint8 RGB pixels and return their index."""
        self.textures.append(np.ascontiguousarray(pixels, dtype=np.uint8))
        return len(self.textures) - 1

    def add_wall(
        self, start_m: Float, end_m: Float, low_m: float, high_m: float, texture: int, solid: int | None = None
    ) -> None:
        """Add an upright rectangle over the way from start to end in the plan; its front is to the right of that way.

        Seen from the front, `start` is on the left, so the texture's left column stands there.
        """
        along = (end_m[:2] - start_m[:2]) / np.linalg.norm(end_m[:2] - start_m[:2])
        self.surfaces.append(
            Surface(
                origin_m=np.array([start_m[0], start_m[1], high_m]),
                right=np.array([along[0], along[1], 0.0]),
                down=-UP,
                size_m=(float(np.linalg.norm(end_m[:2] - start_m[:2])), high_m - low_m),
                texture=texture,
                solid=solid,
            )
        )

    def add_solid(self, solid: Solid) -> int:
        """Keep a solid and return its index."""
        self.solids.append(solid)
        return len(self.solids) - 1

    def add_box(self, solid: Solid, sides: Sequence[int], top: int | None = None) -> None:
        """Add a box that is seen: four sides (textures in order, repeated as needed) and, if given, its top."""
        index = self.add_solid(solid)
        corners = solid.plan_m()
        low, high = float(solid.centre_m[2] - solid.half_m[2]), float(solid.centre_m[2] + solid.half_m[2])
        for k in range(4):
            self.add_wall(corners[k], corners[(k + 1) % 4], low, high, sides[k % len(sides)], index)
        if top is not None:
            self.add_floor(corners[3], corners[2], corners[0], high, top, index)

    def add_floor(
        self, origin_m: Float, right_m: Float, down_m: Float, z_m: float, texture: int, solid: int | None = None
    ) -> None:
        """Add a level rectangle that is seen from above; three of its corners in the plan."""
        right, down = right_m[:2] - origin_m[:2], down_m[:2] - origin_m[:2]
        width, height = float(np.linalg.norm(right)), float(np.linalg.norm(down))
        self.surfaces.append(
            Surface(
                origin_m=np.array([origin_m[0], origin_m[1], z_m]),
                right=np.array([*(right / width), 0.0]),
                down=np.array([*(down / height), 0.0]),
                size_m=(width, height),
                texture=texture,
                solid=solid,
            )
        )
