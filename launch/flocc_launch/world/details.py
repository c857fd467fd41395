"""Things painted on walls: windows, doors, posters, signs, graffiti. All draw into (H, W, 3) uint8 pixels."""

from dataclasses import dataclass

import cv2
import numpy as np

from flocc_launch.world.materials import Colour
from flocc_launch.world.noise import fractal_noise
from flocc_launch.world.scene import Pixels

WORDS = tuple(
    """
    MARKET JAZZ CIRCUS CAFE BAKERY BOOKS SALE EXPO OPERA TEA FISH WINE RADIO CLOCKS FLOWERS TAILOR CINEMA HOTEL
    BIKES TOYS MUSIC BREAD SPICES PAPER GLASS HATS MAPS CHESS
    """.split()  # noqa: SIM905
)
FONTS = (cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_SIMPLEX)


@dataclass(frozen=True, slots=True)
class WindowStyle:
    """How all windows of one house look.

    Attributes:
        width_m: Of the opening.
        height_m: Of the opening.
        panes: Columns and rows of glass.
        frame: Colour of the wood.
        surround: Colour of the stone around it.
        shutters: Colour of the shutters, or None.
    """

    width_m: float
    height_m: float
    panes: tuple[int, int]
    frame: Colour
    surround: Colour
    shutters: Colour | None


def rectangle(
    pixels: Pixels, box: tuple[float, float, float, float], colour: Colour, thickness: int = cv2.FILLED
) -> None:
    """Draw a rectangle (left, top, width, height), texels."""
    x, y, width, height = box
    corner, opposite = (round(x), round(y)), (round(x + width) - 1, round(y + height) - 1)
    cv2.rectangle(pixels, corner, opposite, [float(c) for c in colour], thickness)


def shaded(colour: Colour, factor: float) -> Colour:
    """A darker or lighter colour."""
    return (min(colour[0] * factor, 255), min(colour[1] * factor, 255), min(colour[2] * factor, 255))


def paint_window(rng: np.random.Generator, pixels: Pixels, x: float, y: float, k: float, style: WindowStyle) -> None:
    """Draw a window with its top left corner at (x, y) texels; `k` is texels per metre."""
    width, height, frame = style.width_m * k, style.height_m * k, 0.06 * k
    border = 0.13 * k
    rectangle(pixels, (x - border, y - border, width + 2 * border, height + 2 * border), style.surround)
    rectangle(
        pixels, (x - border, y - border, width + 2 * border, height + 2 * border), shaded(style.surround, 0.75), 1
    )
    rectangle(pixels, (x - 0.03 * k, y - 0.03 * k, width + 0.06 * k, height + 0.06 * k), (46, 42, 40))
    rectangle(pixels, (x, y, width, height), style.frame)
    _paint_glass(rng, pixels, round(x + frame), round(y + frame), round(width - 2 * frame), round(height - 2 * frame))
    columns, rows = style.panes
    for column in range(1, columns):
        rectangle(pixels, (x + column * width / columns - frame / 2, y, frame, height), style.frame)
    for row in range(1, rows):
        rectangle(pixels, (x, y + row * height / rows - frame / 2, width, frame), style.frame)
    if style.shutters is not None:
        for left in (x - border - 0.42 * width, x + width + border):
            _paint_shutter(pixels, left, y, 0.42 * width, height, k, style.shutters)


def _paint_glass(rng: np.random.Generator, pixels: Pixels, x: int, y: int, width: int, height: int) -> None:
    if width < 2 or height < 2:
        return
    fall = np.linspace(1.0, 0.45, height, dtype=np.float32)[:, None, None]
    reflected = 20 * fractal_noise(rng, height, width, 0.5 * width + 2, 3)[..., None]
    glass = np.array([92, 112, 132], dtype=np.float32) * fall + reflected
    curtain = rng.random()
    if curtain < 0.6:
        part = int(width * rng.uniform(0.14, 0.34))
        folds = 12 * np.sin(np.arange(part) * rng.uniform(0.6, 1.2))[None, :, None]
        tone = np.array([[190, 184, 168], [170, 150, 140], [150, 168, 172]])[rng.integers(3)]
        glass[:, :part] = tone + folds
        glass[:, width - part :] = tone + folds
    elif curtain < 0.75:
        drop = int(height * rng.uniform(0.2, 0.7))
        glass[:drop] = np.array([196, 188, 166]) + 10 * np.sin(np.arange(drop) * 1.1)[:, None, None]
    region = pixels[max(y, 0) : y + height, max(x, 0) : x + width]
    region[...] = np.clip(glass[: region.shape[0], : region.shape[1]], 0, 255).astype(np.uint8)


def _paint_shutter(pixels: Pixels, x: float, y: float, width: float, height: float, k: float, colour: Colour) -> None:
    rectangle(pixels, (x, y, width, height), colour)
    step = max(0.07 * k, 3.0)
    for row in range(int(height / step)):
        rectangle(pixels, (x + 0.12 * width, y + row * step, 0.76 * width, step / 3), shaded(colour, 0.62))
    rectangle(pixels, (x, y, width, height), shaded(colour, 0.5), 1)


def paint_door(rng: np.random.Generator, pixels: Pixels, x: float, k: float, colour: Colour, surround: Colour) -> None:
    """Draw a door of 1.1 by 2.2 m that stands on the ground, its left edge at x texels."""
    rows = pixels.shape[0]
    width, height, border = 1.1 * k, 2.2 * k, 0.16 * k
    y = rows - height
    rectangle(pixels, (x - border, y - border, width + 2 * border, height + border), surround)
    rectangle(pixels, (x - border, y - border, width + 2 * border, height + border), shaded(surround, 0.7), 1)
    rectangle(pixels, (x, y, width, height), shaded(colour, 0.55))
    rectangle(pixels, (x + 0.04 * k, y + 0.04 * k, width - 0.08 * k, height), colour)
    for column in range(2):
        for row, (top, tall) in enumerate(((0.16, 0.62), (0.92, 0.44), (1.5, 0.52))):
            box = (x + (0.14 + 0.44 * column) * k, y + top * k, 0.36 * k, tall * k)
            rectangle(pixels, box, (92, 110, 124) if row == 0 and rng.random() < 0.5 else shaded(colour, 0.84))
            rectangle(pixels, box, shaded(colour, 0.55), 1)
    cv2.circle(
        pixels, (round(x + 0.96 * k), round(y + 1.2 * k)), max(round(0.035 * k), 1), (214, 186, 96), -1, cv2.LINE_AA
    )


def poster(rng: np.random.Generator, rows: int, columns: int) -> Pixels:
    """A bill unlike any other: a background, shapes, a title and some lines."""
    hue = rng.uniform(0, 180)
    tones = _palette(rng, hue)
    pixels = np.empty((rows, columns, 3), dtype=np.uint8)
    blend = np.linspace(0, 1, rows)[:, None, None]
    pixels[...] = (tones[0] * (1 - blend) + tones[1] * blend).astype(np.uint8)
    for _ in range(int(rng.integers(5, 11))):
        _shape(rng, pixels, tones[rng.integers(2, len(tones))])
    _title(rng, pixels, WORDS[rng.integers(len(WORDS))], (0.06, 0.2), tones[-1])
    for row in range(int(rng.integers(2, 5))):
        y = round(rows * (0.80 + 0.045 * row))
        length = round(columns * rng.uniform(0.4, 0.85))
        cv2.line(pixels, (round(columns * 0.08), y), (length, y), tones[-1].tolist(), max(rows // 90, 1), cv2.LINE_AA)
    cv2.rectangle(pixels, (0, 0), (columns - 1, rows - 1), (232, 228, 218), max(rows // 50, 1))
    return pixels


def _palette(rng: np.random.Generator, hue: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    hues = (hue + np.array([0, rng.uniform(-20, 20), 90, 60, 120, 90, 0])) % 180
    saturation = rng.integers(90, 220, len(hues))
    value = np.array([210, 170, 235, 120, 200, 60, 245 if rng.random() < 0.5 else 35])
    hsv = np.column_stack([hues, saturation, value]).astype(np.uint8)[None]
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0], dtype=float)


def _shape(rng: np.random.Generator, pixels: Pixels, tone: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> None:
    rows, columns = pixels.shape[:2]
    centre = (int(rng.uniform(0.1, 0.9) * columns), int(rng.uniform(0.25, 0.78) * rows))
    size = max(int(rng.uniform(0.06, 0.26) * columns), 2)
    kind, colour = rng.integers(4), tone.tolist()
    if kind == 0:
        cv2.circle(pixels, centre, size, colour, -1, cv2.LINE_AA)
    elif kind == 1:
        cv2.circle(pixels, centre, size, colour, max(size // 4, 1), cv2.LINE_AA)
    elif kind == 2:
        angle = rng.uniform(0, 2 * np.pi) + np.arange(3) * 2 * np.pi / 3
        points = np.array(centre) + 1.3 * size * np.column_stack([np.cos(angle), np.sin(angle)])
        cv2.fillPoly(pixels, [np.round(points).astype(np.int32)], colour, cv2.LINE_AA)
    else:
        box = cv2.boxPoints((centre, (2.4 * size, 0.5 * size), float(rng.uniform(0, 180))))
        cv2.fillPoly(pixels, [np.round(box).astype(np.int32)], colour, cv2.LINE_AA)


def _title(
    rng: np.random.Generator,
    pixels: Pixels,
    word: str,
    band: tuple[float, float],
    tone: "np.ndarray[tuple[int], np.dtype[np.float64]]",
) -> None:
    """Write a word as large as a band of the height (top, bottom; parts of the whole) allows."""
    rows, columns = pixels.shape[:2]
    font = FONTS[rng.integers(len(FONTS))]
    (width, height), _ = cv2.getTextSize(word, font, 1.0, 2)
    scale = min(0.86 * columns / width, (band[1] - band[0]) * rows / height)
    x, y = round((columns - scale * width) / 2), round((band[0] + band[1]) / 2 * rows + scale * height / 2)
    thickness = max(round(1.6 * scale), 1)
    cv2.putText(pixels, word, (x, y), font, scale, tone.tolist(), thickness, cv2.LINE_AA)


def sign(rng: np.random.Generator, rows: int, columns: int) -> Pixels:
    """A shop's sign: one word on a board."""
    tones = _palette(rng, rng.uniform(0, 180))
    board = tones[rng.integers(2, 6)]
    pixels = np.empty((rows, columns, 3), dtype=np.uint8)
    pixels[...] = board.astype(np.uint8)
    bright = np.array([244.0, 238.0, 214.0]) if board.mean() < 140 else np.array([40.0, 34.0, 32.0])
    cv2.rectangle(pixels, (2, 2), (columns - 3, rows - 3), bright.tolist(), max(rows // 24, 1))
    _title(rng, pixels, WORDS[rng.integers(len(WORDS))], (0.22, 0.78), bright)
    return pixels


def graffiti(rng: np.random.Generator, pixels: Pixels, x: float, y: float, size: float) -> None:
    """Spray a tag: a thick curl with an outline, centred at (x, y) texels."""
    steps = np.linspace(0, 1, 40)
    turn = np.cumsum(rng.normal(0, 0.75, 40))
    curve = np.column_stack([steps * 2 - 1 + 0.3 * np.cos(turn), 0.45 * np.sin(turn * 1.3) + 0.15 * np.cos(turn)])
    points = [np.round((np.array([x, y]) + curve * size) * 8).astype(np.int32)]
    fill, edge = _palette(rng, rng.uniform(0, 180))[[2, 5]]
    cv2.polylines(pixels, points, False, edge.tolist(), max(round(size * 0.2), 2), cv2.LINE_AA, 3)
    cv2.polylines(pixels, points, False, fill.tolist(), max(round(size * 0.12), 1), cv2.LINE_AA, 3)


def paste(pixels: Pixels, patch: Pixels, x: float, y: float) -> None:
    """Put a patch with its top left corner at (x, y) texels, cut at the edges."""
    left, top = max(round(x), 0), max(round(y), 0)
    region = pixels[top : top + patch.shape[0], left : left + patch.shape[1]]
    region[...] = patch[: region.shape[0], : region.shape[1]]
