"""Things that stand in the streets: crates, barrels, benches, planters, lamps, stalls, a fountain."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_launch.world import materials
from flocc_launch.world.details import poster, rectangle, sign
from flocc_launch.world.facade import paint_wall
from flocc_launch.world.materials import Colour, leaves
from flocc_launch.world.scene import Pixels, Scene, Solid, Surface

Float = NDArray[np.float64]

TEXELS_PER_M = 110.0


@dataclass(frozen=True, slots=True)
class Wardrobe:
    """Indices of the textures that props share."""

    crates: tuple[int, ...]
    barrel: int
    lid: int
    stone: int
    hedges: tuple[int, ...]
    iron: int
    lantern: int
    boards: int
    water: int
    canopies: tuple[int, ...]
    fruit: tuple[int, ...]


def wardrobe(rng: np.random.Generator, scene: Scene) -> Wardrobe:
    """Paint the textures that props share."""
    add = scene.add_texture
    canopies: tuple[Colour, ...] = ((186, 52, 44), (42, 92, 140), (58, 120, 70), (206, 150, 46))
    return Wardrobe(
        crates=tuple(add(_crate(rng)) for _ in range(5)),
        barrel=add(_barrel(rng)),
        lid=add(paint_wall(rng, 0.6, 0.6, materials.BOARDS, TEXELS_PER_M)),
        stone=add(paint_wall(rng, 2.0, 0.6, materials.STONE, TEXELS_PER_M)),
        hedges=tuple(add(_hedge(rng)) for _ in range(3)),
        iron=add(np.full((64, 32, 3), (52, 56, 60), dtype=np.uint8)),
        lantern=add(np.full((32, 32, 3), (250, 236, 190), dtype=np.uint8)),
        boards=add(paint_wall(rng, 1.6, 0.8, materials.BOARDS, TEXELS_PER_M)),
        water=add(_water(rng)),
        canopies=tuple(add(_canopy(tone)) for tone in canopies),
        fruit=tuple(add(_fruit(rng)) for _ in range(4)),
    )


def add_prism(
    scene: Scene, centre_m: Float, radius_m: float, low_m: float, high_m: float, side: int, top: int, sides: int = 8
) -> None:
    """Add an upright prism, as a barrel or a basin; `side` goes once around each side."""
    half = np.array([0.86 * radius_m, 0.86 * radius_m, (high_m - low_m) / 2])
    solid = scene.add_solid(Solid(np.array([*centre_m[:2], (low_m + high_m) / 2]), half))
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    ring = centre_m[:2] + radius_m * np.column_stack([np.cos(angles), np.sin(angles)])
    for k in range(sides):
        scene.add_wall(ring[k], ring[(k + 1) % sides], low_m, high_m, side, solid)
    outline = (ring - centre_m[:2]) * (1, -1) + radius_m
    scene.surfaces.append(
        Surface(
            origin_m=np.array([centre_m[0] - radius_m, centre_m[1] + radius_m, high_m]),
            right=np.array([1.0, 0.0, 0.0]),
            down=np.array([0.0, -1.0, 0.0]),
            size_m=(2 * radius_m, 2 * radius_m),
            texture=top,
            outline_m=outline,
            solid=solid,
        )
    )


def box(centre_m: Float, size_m: tuple[float, float, float], low_m: float = 0.0, yaw_rad: float = 0.0) -> Solid:
    """An upright box that stands at a height over a place in the plan."""
    half = np.array(size_m) / 2
    return Solid(np.array([centre_m[0], centre_m[1], low_m + half[2]]), half, yaw_rad)


def add_crates(rng: np.random.Generator, scene: Scene, at_m: Float, yaw_rad: float, own: Wardrobe) -> None:
    """Add a crate, often with a second one on top or beside it."""
    size = float(rng.uniform(0.5, 0.8))
    turned = yaw_rad + rng.uniform(-0.3, 0.3)
    texture = own.crates[rng.integers(len(own.crates))]
    scene.add_box(box(at_m, (size, size, size), 0.0, turned), [texture], texture)
    if rng.random() < 0.5:
        small = size * float(rng.uniform(0.6, 0.85))
        texture = own.crates[rng.integers(len(own.crates))]
        scene.add_box(box(at_m, (small, small, small), size, turned + rng.uniform(-0.5, 0.5)), [texture], texture)


def add_barrels(rng: np.random.Generator, scene: Scene, at_m: Float, along: Float, own: Wardrobe) -> None:
    """Add one or two barrels."""
    for k in range(int(rng.integers(1, 3))):
        radius, height = float(rng.uniform(0.24, 0.32)), float(rng.uniform(0.75, 0.95))
        add_prism(scene, at_m + along * 0.66 * k, radius, 0.0, height, own.barrel, own.lid)


def add_planter(rng: np.random.Generator, scene: Scene, at_m: Float, yaw_rad: float, own: Wardrobe) -> None:
    """Add a stone trough with a clipped hedge."""
    length, tall = float(rng.uniform(1.0, 1.8)), float(rng.uniform(0.5, 1.1))
    scene.add_box(box(at_m, (length, 0.5, 0.45), 0.0, yaw_rad), [own.stone], own.stone)
    hedge = own.hedges[rng.integers(len(own.hedges))]
    scene.add_box(box(at_m, (length - 0.1, 0.42, tall), 0.45, yaw_rad), [hedge], hedge)


def add_bench(scene: Scene, at_m: Float, yaw_rad: float, own: Wardrobe) -> None:
    """Add a bench with its back to the wall."""
    back = at_m + 0.2 * np.array([-np.sin(yaw_rad), np.cos(yaw_rad)])
    scene.add_box(box(at_m, (1.5, 0.42, 0.08), 0.42, yaw_rad), [own.boards], own.boards)
    scene.add_box(box(back, (1.5, 0.06, 0.45), 0.5, yaw_rad), [own.boards], own.boards)
    for side in (-0.6, 0.6):
        foot = at_m + side * np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
        scene.add_box(box(foot, (0.08, 0.4, 0.42), 0.0, yaw_rad), [own.iron])


def add_lamp(scene: Scene, at_m: Float, own: Wardrobe) -> None:
    """Add a lamp post."""
    scene.add_box(box(at_m, (0.26, 0.26, 0.35)), [own.stone], own.stone)
    scene.add_box(box(at_m, (0.09, 0.09, 2.6), 0.35), [own.iron])
    scene.add_box(box(at_m, (0.24, 0.24, 0.34), 2.95), [own.lantern], own.iron)
    scene.add_box(box(at_m, (0.32, 0.32, 0.08), 3.29), [own.iron], own.iron)


def add_board(rng: np.random.Generator, scene: Scene, at_m: Float, yaw_rad: float, own: Wardrobe) -> None:
    """Add an advertising board: two bills back to back on a stone foot."""
    bills = [scene.add_texture(poster(rng, 160, 110)) for _ in range(2)]
    scene.add_box(box(at_m, (1.1, 0.3, 0.18), 0.0, yaw_rad), [own.stone], own.stone)
    scene.add_box(box(at_m, (1.0, 0.14, 1.45), 0.18, yaw_rad), [bills[0], own.iron, bills[1], own.iron], own.iron)


def add_stall(rng: np.random.Generator, scene: Scene, at_m: Float, yaw_rad: float, own: Wardrobe) -> None:
    """Add a market stall: a table with fruit, four posts and a striped roof."""
    along, across = np.array([np.cos(yaw_rad), np.sin(yaw_rad)]), np.array([-np.sin(yaw_rad), np.cos(yaw_rad)])
    front = scene.add_texture(sign(rng, 84, 220))
    scene.add_box(box(at_m, (2.0, 0.9, 0.8), 0.0, yaw_rad), [front, own.boards], own.boards)
    for k in range(3):
        fruit = own.fruit[rng.integers(len(own.fruit))]
        place = at_m + (k - 1) * 0.62 * along
        scene.add_box(box(place, (0.54, 0.7, 0.2), 0.8, yaw_rad), [own.lid], fruit)
    for i in (-1, 1):
        for j in (-1, 1):
            scene.add_box(box(at_m + i * along + 0.55 * j * across, (0.07, 0.07, 2.3), 0.0, yaw_rad), [own.boards])
    canopy = own.canopies[rng.integers(len(own.canopies))]
    add_slope(scene, at_m - 1.15 * along, at_m + 1.15 * along, across, 0.8, 2.75, 2.25, canopy)
    scene.add_solid(box(at_m, (2.3, 1.5, 0.1), 2.35, yaw_rad))


def add_slope(
    scene: Scene,
    start_m: Float,
    end_m: Float,
    across: Float,
    reach_m: float,
    ridge_m: float,
    eaves_m: float,
    texture: int,
    both: bool = True,
) -> None:
    """Add a roof of cloth over a ridge from start to end, seen from above and below; one slope or two."""
    for side in (-1.0, 1.0) if both else (-1.0,):
        a, b = (start_m, end_m) if side < 0 else (end_m, start_m)
        outward = np.array([*(side * across * reach_m), eaves_m - ridge_m])
        length, drop = float(np.linalg.norm(b - a)), float(np.linalg.norm(outward))
        right, down = np.array([*((b - a) / length), 0.0]), outward / drop
        top = np.array([*a, ridge_m])
        scene.surfaces.append(Surface(top, right, down, (length, drop), texture))
        scene.surfaces.append(Surface(top + right * length, -right, down, (length, drop), texture))


def add_fountain(scene: Scene, at_m: Float, own: Wardrobe) -> None:
    """Add an eight-sided basin with a column in its middle."""
    add_prism(scene, at_m, 1.5, 0.0, 0.55, own.stone, own.stone)
    add_prism(scene, at_m, 1.3, 0.55, 0.57, own.stone, own.water)
    add_prism(scene, at_m, 0.32, 0.57, 1.5, own.stone, own.stone)
    add_prism(scene, at_m, 0.7, 1.5, 1.68, own.stone, own.water)
    add_prism(scene, at_m, 0.18, 1.68, 2.4, own.stone, own.stone)


def _crate(rng: np.random.Generator) -> Pixels:
    pixels = paint_wall(rng, 0.75, 0.75, materials.BOARDS, TEXELS_PER_M)
    rows, columns = pixels.shape[:2]
    bar = round(0.08 * TEXELS_PER_M)
    tone = (166, 124, 80)
    cv2.line(pixels, (0, rows), (columns, 0), (112, 80, 50), bar + 2, cv2.LINE_AA)
    cv2.line(pixels, (0, rows), (columns, 0), tone, bar, cv2.LINE_AA)
    cv2.rectangle(pixels, (bar // 2, bar // 2), (columns - bar // 2, rows - bar // 2), tone, bar)
    cv2.rectangle(pixels, (bar, bar), (columns - bar, rows - bar), (104, 74, 46), 1)
    label = poster(rng, round(0.24 * TEXELS_PER_M), round(0.3 * TEXELS_PER_M))
    y, x = int(rng.integers(bar, rows - bar - label.shape[0])), int(rng.integers(bar, columns - bar - label.shape[1]))
    pixels[y : y + label.shape[0], x : x + label.shape[1]] = label
    return pixels


def _barrel(rng: np.random.Generator) -> Pixels:
    pixels = np.ascontiguousarray(np.rot90(paint_wall(rng, 0.9, 0.25, materials.BOARDS, TEXELS_PER_M)))
    rows, columns = pixels.shape[:2]
    for y in (0.08, 0.3, 0.66, 0.88):
        rectangle(pixels, (0, y * rows, columns, 0.055 * rows), (70, 72, 76))
    return pixels


def _hedge(rng: np.random.Generator) -> Pixels:
    return np.asarray(np.clip(leaves(rng, 110, 165, TEXELS_PER_M), 0, 255), dtype=np.uint8)


def _water(rng: np.random.Generator) -> Pixels:
    colour = np.array([84, 122, 138]) + 12 * rng.standard_normal((24, 24, 1))
    ripples = cv2.resize(np.clip(colour, 0, 255).astype(np.uint8), (160, 160), interpolation=cv2.INTER_CUBIC)
    return np.asarray(ripples, dtype=np.uint8)


def _canopy(tone: Colour) -> Pixels:
    pixels = np.full((72, 184, 3), (236, 230, 214), dtype=np.uint8)
    for stripe in range(0, 184, 46):
        rectangle(pixels, (stripe, 0, 23, 72), tone)
    return pixels


def _fruit(rng: np.random.Generator) -> Pixels:
    tone = np.array([(206, 60, 40), (224, 146, 36), (112, 158, 54), (214, 196, 70)][rng.integers(4)], dtype=float)
    pixels = np.full((80, 60, 3), (58, 40, 28), dtype=np.uint8)
    for _ in range(90):
        centre = (int(rng.integers(60)), int(rng.integers(80)))
        colour = np.clip(tone + rng.normal(0, 18, 3), 0, 255)
        cv2.circle(pixels, centre, 5, (colour * 0.7).tolist(), -1, cv2.LINE_AA)
        cv2.circle(pixels, (centre[0] - 1, centre[1] - 1), 3, colour.tolist(), -1, cv2.LINE_AA)
    return pixels
