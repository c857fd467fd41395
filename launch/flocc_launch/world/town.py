"""Builds the town: houses on their plots, what juts out of their fronts, and what stands in the streets."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from flocc_launch.world import layout, materials, props
from flocc_launch.world.details import sign
from flocc_launch.world.facade import Front, House, paint_front, paint_wall, random_house
from flocc_launch.world.layout import Plot
from flocc_launch.world.noise import fractal_noise
from flocc_launch.world.props import Wardrobe, box
from flocc_launch.world.scene import Pixels, Scene, Solid, Surface
from flocc_launch.world.sky import add_sky

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

FLOOR_TEXELS_PER_M = 56.0
ROOF_TEXELS_PER_M = 40.0
OVERHANG_M = 0.3


def build_town(rng: np.random.Generator, *, terraced: bool = False) -> Scene:
    """Build the whole scene; the same generator state gives the same town.

    Args:
        rng: What everything random is drawn from.
        terraced: All blocks are built by one plan; what stands in the streets is drawn for each house all the same.
    """
    scene = Scene()
    width, height = layout.size_m()
    add_sky(scene, rng, np.array([width / 2, height / 2]))
    _add_ground(rng, scene)
    own = props.wardrobe(rng, scene)
    if terraced:
        seed = int(rng.integers(2**32))
        for kind, plot in layout.alike(seed):
            _add_house(rng, scene, plot, own, np.random.default_rng([seed, 1, kind]))
    else:
        for plot in layout.plots(rng):
            _add_house(rng, scene, plot, own, rng)
    _add_square(rng, scene, own)
    return scene


def _add_ground(rng: np.random.Generator, scene: Scene) -> None:
    width, height = layout.size_m()
    k = FLOOR_TEXELS_PER_M
    ground = paint_wall(rng, width + 1, height + 1, materials.COBBLE, k)
    square = paint_wall(rng, layout.BLOCK_M, layout.BLOCK_M, materials.SLABS, k)
    x, y = layout.block_low_m(*layout.SQUARE) + 0.5
    top = round((height + 1 - y - layout.BLOCK_M) * k)
    ground[top : top + square.shape[0], round(x * k) : round(x * k) + square.shape[1]] = square
    _lay_pavements(rng, ground, k)
    texture = scene.add_texture(ground)
    low, right = np.array([-0.5, height + 0.5]), np.array([width + 0.5, height + 0.5])
    scene.add_floor(low, right, np.array([-0.5, -0.5]), 0.0, texture)


def _lay_pavements(rng: np.random.Generator, ground: Pixels, k: float) -> None:
    """Lay slabs along the houses and patch the cobbles with tar here and there."""
    height_m, patch = ground.shape[0] / k, paint_wall(rng, 16.0, 12.0, materials.SLABS, k)
    repeats = (ground.shape[0] // patch.shape[0] + 1, ground.shape[1] // patch.shape[1] + 1, 1)
    slabs = np.tile(patch, repeats)[: ground.shape[0], : ground.shape[1]]
    x = (np.arange(ground.shape[1], dtype=np.float32) / np.float32(k) - np.float32(0.5))[None, :]
    y = (height_m - 0.5 - np.arange(ground.shape[0], dtype=np.float32) / np.float32(k))[:, None]
    step = layout.STREET_M + layout.BLOCK_M
    from_middle = np.minimum(_from_middle(x, step), _from_middle(y, step))
    pavement = (from_middle > layout.STREET_M / 2 - 0.95) & (from_middle < layout.STREET_M / 2 + 1.0)
    ground[pavement] = slabs[pavement]
    curb = np.abs(from_middle - (layout.STREET_M / 2 - 0.95)) < 0.05
    ground[curb] = (ground[curb] * 0.6).astype(np.uint8)
    tar = fractal_noise(rng, ground.shape[0], ground.shape[1], 2.2 * k, 3) > 1.9
    tar &= from_middle < layout.STREET_M / 2 - 1.0
    grain = 82 + 6 * fractal_noise(rng, ground.shape[0], ground.shape[1], 4.0, 2)
    ground[tar] = np.clip(grain[tar], 0, 255)[:, None].astype(np.uint8)


def _from_middle(along: Float32, step: float) -> Float32:
    """Distance from the middle of the nearest street, metres."""
    return np.asarray(np.abs((along - layout.STREET_M / 2 + step / 2) % step - step / 2), dtype=np.float32)


def _add_house(
    rng: np.random.Generator, scene: Scene, plot: Plot, own: Wardrobe, of_house: np.random.Generator
) -> None:
    """Build a house by its own generator, and put things before it by the town's."""
    house = random_house(of_house)
    corners, high_m = plot.corners_m(), house.height_m()
    size = np.array([*(corners[2] - corners[0]), high_m])
    solid = scene.add_solid(Solid(np.array([*corners.mean(axis=0), high_m / 2]), size / 2))
    stone = scene.add_texture(paint_wall(of_house, 0.5, high_m, house.plinth, 60.0))
    bare = scene.add_texture(paint_wall(of_house, 3.0, 3.0, house.wall, 40.0))
    for side in range(4):
        start, end = corners[side], corners[(side + 1) % 4]
        if side not in plot.fronts:
            scene.add_wall(start, end, 0.0, high_m, bare, solid)
            continue
        front = paint_front(of_house, float(np.linalg.norm(end - start)), house)
        scene.add_wall(start, end, 0.0, high_m, scene.add_texture(front.pixels), solid)
        _add_relief(of_house, scene, start, end, house, front, stone, own)
        _add_street_things(rng, scene, start, end, front, own)
    _add_roof(of_house, scene, plot, house)


def _add_roof(rng: np.random.Generator, scene: Scene, plot: Plot, house: House) -> None:
    """A hipped roof with eaves, its ridge along the longer side."""
    kind = materials.ROOF_SLATE if house.slate else materials.ROOF_RED
    centre, extent = plot.corners_m().mean(axis=0), np.ptp(plot.corners_m(), axis=0) + 2 * OVERHANG_M
    rise, half = 0.42 * float(extent.min()), extent / 2
    eaves_m = house.height_m()
    texture = scene.add_texture(
        paint_wall(rng, float(extent.max()), float(extent.min()) * 0.66, kind, ROOF_TEXELS_PER_M)
    )
    ridge = half - half.min()
    low, high = centre - half, centre + half
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    cover = np.array([0.8 * half[0], 0.8 * half[1], 0.3 * rise])
    solid = scene.add_solid(Solid(np.array([*centre, eaves_m + 0.3 * rise]), cover))
    for side in range(4):
        a, b = corners[side], corners[(side + 1) % 4]
        _add_roof_side(scene, a, b, (float(half.min()), rise), float(ridge[side % 2]), eaves_m, texture, solid)
    wood = scene.add_texture(np.full((16, 16, 3), (84, 66, 52), dtype=np.uint8))
    scene.surfaces.append(
        Surface(np.array([*low, eaves_m]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), (extent[0], extent[1]), wood)
    )


def _add_roof_side(
    scene: Scene,
    a: Float,
    b: Float,
    pitch_m: tuple[float, float],
    ridge_half_m: float,
    eaves_m: float,
    texture: int,
    solid: int,
) -> None:
    (run_m, rise_m), length = pitch_m, float(np.linalg.norm(b - a))
    right = np.array([*((b - a) / length), 0.0])
    inward = np.array([-right[1], right[0], 0.0])
    slope_m = float(np.hypot(run_m, rise_m))
    down = -(inward * run_m + np.array([0, 0, rise_m])) / slope_m
    origin = np.array([*a, eaves_m]) - down * slope_m
    middle = length / 2
    outline = np.array([[middle - ridge_half_m, 0], [middle + ridge_half_m, 0], [length, slope_m], [0, slope_m]])
    scene.surfaces.append(Surface(origin, right, down, (length, slope_m), texture, outline, solid))


def _add_relief(
    rng: np.random.Generator,
    scene: Scene,
    start: Float,
    end: Float,
    house: House,
    front: Front,
    stone: int,
    own: Wardrobe,
) -> None:
    """Sills, corner pillars, a hanging sign and an awning: what stands out of a front."""
    along = (end - start) / np.linalg.norm(end - start)
    outward, length = np.array([along[1], -along[0]]), float(np.linalg.norm(end - start))
    yaw = float(np.arctan2(along[1], along[0]))
    for left_m, low_m, width_m in front.sills_m:
        at = start + along * (left_m + width_m / 2) + outward * 0.08
        scene.add_box(box(at, (width_m + 0.24, 0.16, 0.1), low_m - 0.1, yaw), [own.stone], own.stone)
    if rng.random() < 0.5:
        for place in (0.2, length - 0.2):
            scene.add_box(
                box(start + along * place + outward * 0.07, (0.36, 0.16, house.height_m()), 0.0, yaw), [stone]
            )
    if rng.random() < 0.45:
        at = start + along * rng.uniform(0.5, length - 0.5) + outward * 0.42
        board = scene.add_texture(sign(rng, 60, 80))
        scene.add_box(box(at, (0.07, 0.7, 0.52), 2.75, yaw), [own.iron, board], own.iron)
    if front.shop_m is not None:
        left, right = (start + along * s for s in front.shop_m)
        canopy = own.canopies[rng.integers(len(own.canopies))]
        props.add_slope(scene, left, right, -outward, 0.85, 2.6, 2.25, canopy, both=False)
        scene.add_solid(
            box((left + right) / 2 + 0.42 * outward, (float(np.linalg.norm(right - left)), 0.85, 0.08), 2.4, yaw)
        )


def _add_street_things(
    rng: np.random.Generator, scene: Scene, start: Float, end: Float, front: Front, own: Wardrobe
) -> None:
    """Put things along a front, but not before its door."""
    along = (end - start) / np.linalg.norm(end - start)
    outward, yaw = np.array([along[1], -along[0]]), float(np.arctan2(along[1], along[0]))
    for place in _places(rng, float(np.linalg.norm(end - start)), front):
        at = start + along * place + outward * rng.uniform(0.42, 0.55)
        kind = rng.random()
        if kind < 0.28:
            props.add_crates(rng, scene, at, yaw, own)
        elif kind < 0.44:
            props.add_barrels(rng, scene, at, along, own)
        elif kind < 0.66:
            props.add_planter(rng, scene, at, yaw, own)
        elif kind < 0.78:
            props.add_bench(scene, at, yaw, own)
        elif kind < 0.9:
            props.add_lamp(scene, at + 0.3 * outward, own)
        else:
            props.add_board(rng, scene, at, yaw, own)


def _places(rng: np.random.Generator, length_m: float, front: Front) -> Iterator[float]:
    place = float(rng.uniform(0.7, 1.6))
    while place < length_m - 0.7:
        if front.door_m is None or not front.door_m - 0.9 < place < front.door_m + 2.0:
            yield place
        place += float(rng.uniform(1.6, 3.2))


def _add_square(rng: np.random.Generator, scene: Scene, own: Wardrobe) -> None:
    """The square: a fountain, stalls, hedges, pillars and boards."""
    low = layout.block_low_m(*layout.SQUARE)
    centre = low + layout.BLOCK_M / 2
    props.add_fountain(scene, centre, own)
    for k in range(4):
        yaw = k * np.pi / 2
        side = np.array([np.sin(yaw), -np.cos(yaw)])
        along = np.array([np.cos(yaw), np.sin(yaw)])
        props.add_stall(rng, scene, centre + 3.4 * side + rng.uniform(-0.5, 0.5) * along, yaw, own)
        props.add_board(rng, scene, centre + 3.3 * side + 2.2 * along, yaw + rng.uniform(-0.4, 0.4), own)
        props.add_planter(rng, scene, centre + 3.2 * side - 2.3 * along, yaw, own)
        corner = centre + 4.1 * (side + along)
        props.add_prism(scene, corner, 0.3, 0.0, 3.0, own.stone, own.stone)
        scene.add_box(box(corner, (0.8, 0.8, 0.25), 3.0), [own.stone], own.stone)
        props.add_crates(rng, scene, centre + 2.0 * (side + along), yaw, own)
