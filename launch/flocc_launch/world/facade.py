"""Fronts of houses: a material, rows of equal windows, a door or a shop, and what time has left on the wall."""

from dataclasses import dataclass

import numpy as np

from flocc_launch.world import materials
from flocc_launch.world.details import (
    WindowStyle,
    graffiti,
    paint_door,
    paint_window,
    paste,
    poster,
    rectangle,
    shaded,
    sign,
)
from flocc_launch.world.materials import Colour, Masonry
from flocc_launch.world.scene import Pixels

TEXELS_PER_M = 88.0
STOREY_M = 2.9
PLASTERS: tuple[Colour, ...] = (
    (222, 206, 170), (206, 178, 140), (196, 204, 198), (214, 170, 142), (178, 190, 206), (226, 222, 212),
)  # fmt: skip
WOODS: tuple[Colour, ...] = ((240, 238, 230), (92, 62, 44), (52, 84, 70), (64, 80, 112), (120, 46, 42))
WALLS = (
    materials.BRICK_RED,
    materials.BRICK_YELLOW,
    materials.STONE,
    materials.BRICK_DARK,
    materials.SANDSTONE,
)
PLAIN_PROBABILITY = 0.3
SHOP_PROBABILITY = 0.35


@dataclass(frozen=True, slots=True)
class House:
    """One house's style, the same on all of its sides.

    Attributes:
        wall: Masonry, or the tone of a plastered wall.
        window: All windows.
        door: Colour of its doors.
        plinth: Stone at its foot.
        storeys: How many.
        slate: Whether the roof is slate or red tiles.
    """

    wall: Masonry | Colour
    window: WindowStyle
    door: Colour
    plinth: Masonry
    storeys: int
    slate: bool

    def height_m(self) -> float:
        """Height of the eaves."""
        return 0.5 + STOREY_M * self.storeys


@dataclass(frozen=True, slots=True, eq=False)
class Front:
    """A painted front and where things stand out of it.

    Attributes:
        pixels: (H, W, 3) uint8.
        sills_m: Left, height above ground and width of each window's sill.
        door_m: Left edge of the door, or None.
        shop_m: Left and right edge of the shop, or None.
    """

    pixels: Pixels
    sills_m: tuple[tuple[float, float, float], ...]
    door_m: float | None
    shop_m: tuple[float, float] | None


def random_house(rng: np.random.Generator) -> House:
    """Draw a house's style."""
    plain = rng.random() < PLAIN_PROBABILITY
    wood = WOODS[rng.integers(len(WOODS))]
    window = WindowStyle(
        width_m=float(rng.choice([0.85, 1.0, 1.15])),
        height_m=float(rng.choice([1.25, 1.45, 1.6])),
        panes=((2, 2), (2, 3), (1, 2), (3, 3))[rng.integers(4)],
        frame=wood,
        surround=((214, 204, 184), (176, 168, 154), (150, 96, 76))[rng.integers(3)],
        shutters=WOODS[rng.integers(1, len(WOODS))] if rng.random() < 0.35 else None,
    )
    return House(
        wall=PLASTERS[rng.integers(len(PLASTERS))] if plain else WALLS[rng.integers(len(WALLS))],
        window=window,
        door=WOODS[rng.integers(1, len(WOODS))],
        plinth=(materials.STONE, materials.SANDSTONE)[rng.integers(2)],
        storeys=int(rng.choice([1, 2, 2])),
        slate=bool(rng.random() < 0.4),
    )


def paint_wall(rng: np.random.Generator, width_m: float, height_m: float, wall: Masonry | Colour, k: float) -> Pixels:
    """Paint a bare wall of one material."""
    rows, columns = round(height_m * k), round(width_m * k)
    if isinstance(wall, Masonry):
        colour = materials.masonry(rng, rows, columns, k, wall)
    else:
        colour = materials.plaster(rng, rows, columns, k, wall)
    return np.asarray(np.clip(colour, 0, 255), dtype=np.uint8)


def paint_front(rng: np.random.Generator, width_m: float, house: House) -> Front:
    """Paint one front of a house; its texture is `TEXELS_PER_M`."""
    k, height_m = TEXELS_PER_M, house.height_m()
    pixels = paint_wall(rng, width_m, height_m, house.wall, k)
    foot = paint_wall(rng, width_m, 0.45, house.plinth, k)
    paste(pixels, foot, 0, pixels.shape[0] - foot.shape[0])
    _bands(pixels, house, k)
    bays = max(int(width_m / 1.9), 1)
    centres = (np.arange(bays) + 0.5) * width_m / bays
    door_bay = int(rng.integers(bays)) if rng.random() < 0.7 else None
    shop = bays >= 2 and rng.random() < SHOP_PROBABILITY
    sills = []
    for storey in range(house.storeys):
        for bay, centre_m in enumerate(centres):
            if storey == 0 and (shop or bay == door_bay):
                continue
            sills.append(_window(rng, pixels, house, float(centre_m), storey, k))
    shop_m = _shop(rng, pixels, house, width_m, k) if shop else None
    door_m = None
    if door_bay is not None and not shop:
        door_m = float(centres[door_bay]) - 0.55
        paint_door(rng, pixels, door_m * k, k, house.door, house.window.surround)
    _traces(rng, pixels, k)
    return Front(pixels, tuple(sills), door_m, shop_m)


def _bands(pixels: Pixels, house: House, k: float) -> None:
    rows, columns = pixels.shape[:2]
    for storey in range(1, house.storeys + 1):
        y = rows - (0.5 + STOREY_M * storey) * k
        rectangle(pixels, (0, y, columns, 0.16 * k), house.window.surround)
        rectangle(pixels, (0, y + 0.16 * k, columns, 0.035 * k), shaded(house.window.surround, 0.55))


def _window(
    rng: np.random.Generator, pixels: Pixels, house: House, centre_m: float, storey: int, k: float
) -> tuple[float, float, float]:
    style = house.window
    low_m = 0.5 + STOREY_M * storey + 0.75
    x, y = (centre_m - style.width_m / 2) * k, pixels.shape[0] - (low_m + style.height_m) * k
    paint_window(rng, pixels, x, y, k, style)
    drip = pixels[round(y + (style.height_m + 0.15) * k) : round(y + (style.height_m + 0.7) * k)]
    for side in (x - 0.1 * k, x + style.width_m * k):
        stain = drip[:, max(round(side), 0) : round(side + 0.1 * k)]
        fade = np.linspace(0.82, 1.0, stain.shape[0])[:, None, None] if stain.shape[0] else 1.0
        stain[...] = (stain * fade).astype(np.uint8)
    return centre_m - style.width_m / 2, low_m, style.width_m


def _shop(rng: np.random.Generator, pixels: Pixels, house: House, width_m: float, k: float) -> tuple[float, float]:
    """A shop window over most of the ground floor, with a sign above it and goods behind it."""
    rows = pixels.shape[0]
    left_m, right_m = 0.4, width_m - 0.4
    rectangle(pixels, (left_m * k, rows - 2.55 * k, (right_m - left_m) * k, 2.55 * k), house.door)
    paste(pixels, sign(rng, round(0.5 * k), round((right_m - left_m - 0.3) * k)), (left_m + 0.15) * k, rows - 3.1 * k)
    panes = max(int((right_m - left_m) / 1.3), 1)
    wide_m = (right_m - left_m - 0.1) / panes
    for pane in range(panes):
        style = WindowStyle(wide_m - 0.25, 1.6, (1, 1), shaded(house.door, 1.2), shaded(house.door, 0.8), None)
        x = (left_m + 0.18 + pane * wide_m) * k
        paint_window(rng, pixels, x, rows - 2.35 * k, k, style)
        for _ in range(int(rng.integers(2, 6))):
            tall, across = rng.uniform(0.15, 0.45), rng.uniform(0.12, 0.3)
            goods = poster(rng, max(round(tall * k), 6), max(round(across * k), 6))
            paste(pixels, goods, x + rng.uniform(0.1, max(wide_m - 0.6, 0.2)) * k, rows - (0.85 + tall) * k)
    return left_m, right_m


def _traces(rng: np.random.Generator, pixels: Pixels, k: float) -> None:
    """Posters and graffiti where there is room, and the dirt that rain throws up."""
    rows, columns = pixels.shape[:2]
    for _ in range(int(rng.integers(0, 4))):
        tall = rng.uniform(0.6, 1.1)
        bill = poster(rng, round(tall * k), round(tall * 0.7 * k))
        paste(pixels, bill, rng.uniform(0, max(columns - bill.shape[1], 1)), rows - rng.uniform(1.2, 2.0) * k)
    if rng.random() < 0.4:
        size = rng.uniform(0.3, 0.6) * k
        graffiti(rng, pixels, rng.uniform(size, max(columns - size, size + 1)), rows - rng.uniform(0.6, 1.2) * k, size)
    dirt = np.linspace(1.0, 0.72, round(0.7 * k))[:, None, None]
    foot = pixels[rows - len(dirt) :]
    foot[...] = (foot * dirt[: len(foot)]).astype(np.uint8)
