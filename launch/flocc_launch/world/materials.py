"""What walls, floors and roofs are made of: (rows, columns, 3) float32 colours, 0 to 255."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_launch.world.noise import fractal_noise

Float32 = NDArray[np.float32]
Colour = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Masonry:
    """Units laid in courses: bricks, stones, slabs, boards or tiles.

    Attributes:
        length_m: Of a unit, along the course.
        height_m: Of a course.
        joint_m: Width of the joints.
        tones: Colours that units are drawn from.
        joint: Colour of the joints.
        variation: Deviation of a unit's brightness.
        stagger: Shift of every second course, as a part of a unit.
        relief: How strongly edges are lit above and shaded below.
    """

    length_m: float
    height_m: float
    joint_m: float
    tones: tuple[Colour, ...]
    joint: Colour
    variation: float = 14.0
    stagger: float = 0.5
    relief: float = 12.0


BRICK_RED = Masonry(0.26, 0.085, 0.012, ((150, 74, 56), (164, 86, 62), (134, 64, 50), (172, 100, 76)), (168, 158, 144))
BRICK_YELLOW = Masonry(0.26, 0.085, 0.012, ((196, 164, 110), (182, 150, 98), (206, 178, 128)), (158, 148, 130))
BRICK_DARK = Masonry(0.28, 0.085, 0.012, ((92, 76, 70), (78, 66, 64), (110, 86, 76)), (140, 134, 126))
STONE = Masonry(
    0.62, 0.31, 0.016, ((168, 160, 144), (152, 146, 134), (182, 172, 152), (140, 136, 128)), (108, 102, 94), 12
)
SANDSTONE = Masonry(0.52, 0.26, 0.012, ((206, 182, 140), (194, 168, 126), (214, 194, 156)), (150, 130, 102), 9)
COBBLE = Masonry(
    0.17, 0.13, 0.02, ((128, 124, 118), (112, 108, 106), (142, 134, 124), (104, 104, 108)), (70, 66, 60), 16
)
SLABS = Masonry(0.8, 0.8, 0.014, ((166, 160, 150), (156, 150, 142), (176, 168, 156)), (112, 106, 98), 8, 0.0, 8)
BOARDS = Masonry(2.2, 0.17, 0.01, ((138, 100, 62), (124, 88, 54), (152, 112, 72)), (60, 42, 28), 12, 0.37)
ROOF_RED = Masonry(
    0.24, 0.2, 0.02, ((158, 78, 52), (142, 68, 48), (172, 92, 62), (128, 66, 50)), (84, 44, 34), 14, 0.5, 20
)
ROOF_SLATE = Masonry(0.3, 0.2, 0.014, ((88, 94, 104), (76, 82, 92), (100, 104, 112)), (48, 52, 60), 10, 0.5, 16)


def masonry(rng: np.random.Generator, rows: int, columns: int, texels_per_m: float, kind: Masonry) -> Float32:
    """Lay units in courses, each with a tone of its own, weathered."""
    height, length = kind.height_m * texels_per_m, kind.length_m * texels_per_m
    y = np.arange(rows, dtype=np.float32)[:, None] / np.float32(height)
    course = np.floor(y).astype(np.int32)
    shift = (kind.stagger * (course % 2) + 0.013 * (course * 7 % 5)).astype(np.float32)
    x = np.arange(columns, dtype=np.float32)[None, :] / np.float32(length) + shift
    unit = np.floor(x).astype(np.int32)
    shape = (int(course.max()) + 1, int(unit.max()) + 1)
    tones = np.array(kind.tones, dtype=np.float32)[rng.integers(len(kind.tones), size=shape)]
    tones += rng.normal(0, kind.variation, shape).astype(np.float32)[..., None]
    colour = tones[np.broadcast_to(course, unit.shape), unit]
    across = (y - course.astype(np.float32)) * np.float32(height)
    along = (x - unit.astype(np.float32)) * np.float32(length)
    joint = max(kind.joint_m * texels_per_m, 0.8)
    edge = np.minimum(np.minimum(along, length - along), np.minimum(across, height - across))
    relief = kind.relief * ((across < 2 * joint).astype(np.float32) - (across > height - 1.5 * joint))
    colour = colour + np.broadcast_to(relief, unit.shape)[..., None]
    mortar = np.clip((joint - edge) / joint + 0.3, 0, 1).astype(np.float32)[..., None]
    colour = colour * (1 - mortar) + np.array(kind.joint, dtype=np.float32) * mortar
    return weathered(rng, colour.astype(np.float32), texels_per_m)


def weathered(rng: np.random.Generator, colour: Float32, texels_per_m: float, strength: float = 1.0) -> Float32:
    """Add grain, patches of lighter and darker tone, and a few stains."""
    rows, columns = colour.shape[:2]
    grain = 5.0 * fractal_noise(rng, rows, columns, 6.0, 3)
    patches = 9.0 * fractal_noise(rng, rows, columns, 0.9 * texels_per_m, 5)
    stains = -22.0 * np.clip(fractal_noise(rng, rows, columns, 0.5 * texels_per_m, 4) - 1.1, 0, 1.5)
    return np.asarray(colour + np.float32(strength) * (grain + patches + stains)[..., None], dtype=np.float32)


def plaster(rng: np.random.Generator, rows: int, columns: int, texels_per_m: float, tone: Colour) -> Float32:
    """A painted wall with little texture: faint patches and some hairline cracks."""
    colour = np.broadcast_to(np.array(tone, dtype=np.float32), (rows, columns, 3)).copy()
    colour += (4.0 * fractal_noise(rng, rows, columns, 1.4 * texels_per_m, 4))[..., None]
    colour += (1.8 * fractal_noise(rng, rows, columns, 4.0, 2))[..., None]
    for _ in range(max(int(rows * columns / texels_per_m**2 / 4), 1)):
        crack(rng, colour, texels_per_m)
    return colour


def crack(rng: np.random.Generator, colour: Float32, texels_per_m: float) -> None:
    """Draw one hairline crack into a wall."""
    rows, columns = colour.shape[:2]
    steps = rng.integers(8, 22)
    turn = np.cumsum(rng.normal(0, 0.5, steps)) + rng.uniform(0, 2 * np.pi)
    points = np.cumsum(np.column_stack([np.cos(turn), np.sin(turn)]) * 0.06 * texels_per_m, axis=0)
    points += rng.uniform((0, 0), (columns, rows))
    dark = [float(c) for c in colour.mean(axis=(0, 1)) * 0.72]
    cv2.polylines(colour, [np.round(points * 8).astype(np.int32)], False, dark, 1, cv2.LINE_AA, 3)


def leaves(rng: np.random.Generator, rows: int, columns: int, texels_per_m: float) -> Float32:
    """A clipped hedge."""
    light = fractal_noise(rng, rows, columns, 0.09 * texels_per_m, 3, 0.9)
    broad = fractal_noise(rng, rows, columns, 0.6 * texels_per_m, 3)
    dark, bright = np.array([34, 56, 26], dtype=np.float32), np.array([104, 138, 62], dtype=np.float32)
    mix = np.clip(0.42 + 0.24 * light + 0.08 * broad, 0, 1)[..., None]
    return np.asarray(dark + (bright - dark) * mix, dtype=np.float32)
