"""What can lie over a robot's pictures, by kind: functions of the picture's number, so that some of them change.

`share` is how much of the picture is touched. A kind that stays is the same at all times; a propeller turns, and a
clock counts. `offset_px` moves what is drawn, as two robots of one make show the same part at other pixels.
"""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta

import cv2
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Float = NDArray[np.float64]
Overlay = Callable[[Bytes, int], Bytes]
"""Of a picture (H, W, 3) and its number; what the camera gives."""

BLOCK_PX = 8
WATERMARK_OPACITY = 0.35
DIRT_OPACITY = 0.8
SHADOW = 0.45
"""How bright what lies in a propeller's shadow is."""
BLADES = 2
CLOCK_STARTS = datetime(2024, 5, 17, 9, 58, 7, tzinfo=UTC)
CLOCK_STEP = timedelta(seconds=0.73)


def overlay(kind: str, size: tuple[int, int], share: float, seed: int, offset_px: tuple[int, int] = (0, 0)) -> Overlay:
    """What does it to the pictures of one camera.

    Args:
        kind: One of `KINDS`.
        size: Width and height of the pictures.
        share: Of the picture that is touched, about.
        seed: Another one looks otherwise.
        offset_px: By how much what is drawn lies farther right and down.
    """
    return KINDS[kind](size, share, np.random.default_rng([seed, 99]), offset_px)


def _bumper(size: tuple[int, int], share: float, rng: np.random.Generator, offset_px: tuple[int, int]) -> Overlay:
    """What a robot shows of itself in the lower part, full of corners."""
    width, height = size
    rows = round(height * share)
    blocks = rng.integers(0, 256, (max(rows // BLOCK_PX, 2), width // BLOCK_PX), dtype=np.uint8)
    shown = np.asarray(cv2.resize(blocks, (width, rows), interpolation=cv2.INTER_CUBIC), np.uint8)
    shown = _moved(shown, (offset_px[0], 0))
    return lambda pixels, _: np.concatenate([pixels[: height - rows], np.repeat(shown[..., None], 3, axis=2)])


def _watermark(size: tuple[int, int], share: float, rng: np.random.Generator, offset_px: tuple[int, int]) -> Overlay:
    """A semi-transparent band of writing across the middle."""
    width, height = size
    ink = np.zeros((height, width), np.uint8)
    first, last = round(height * (0.5 - share / 2)), round(height * (0.5 + share / 2))
    for row in range(first + 24, last + 1, 26):
        cv2.putText(ink, _letters(rng, width // 14), (2, row), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 255, 2)
    return _blended(_moved(ink, offset_px), WATERMARK_OPACITY, 255.0)


def _vignette(size: tuple[int, int], share: float, rng: np.random.Generator, offset_px: tuple[int, int]) -> Overlay:
    """Darker towards the corners."""
    del rng
    radius = _radius(size, offset_px)
    reach = np.quantile(radius, 1.0 - share)
    light = 1.0 - 0.9 * np.clip((radius - reach) / (radius.max() - reach), 0.0, 1.0)
    return lambda pixels, _: (pixels * light[..., None]).astype(np.uint8)


def _letterbox(size: tuple[int, int], share: float, rng: np.random.Generator, offset_px: tuple[int, int]) -> Overlay:
    """Black bars above and below, with a thin frame and a maker's mark in the lower one."""
    width, height = size
    rows = max(round(height * share / 2), 14)
    shown = np.zeros((height, width), np.uint8)
    cv2.rectangle(shown, (3, 3), (width - 4, height - 4), 90, 1)
    cv2.putText(shown, _letters(rng, 12), (10, height - 6), cv2.FONT_HERSHEY_SIMPLEX, rows / 50, 220, 1)
    shown = _moved(shown, (offset_px[0], 0))
    hides = np.zeros((height, width), np.bool_)
    hides[:rows] = hides[height - rows :] = True
    return lambda pixels, _: np.where(hides[..., None], shown[..., None], pixels)


def _dirt(size: tuple[int, int], share: float, rng: np.random.Generator, offset_px: tuple[int, int]) -> Overlay:
    """Blurred drops and specks all over the lens until they touch so much of the picture."""
    width, height = size
    ink = np.zeros((height, width), np.uint8)
    while float(np.mean(ink > 0)) < share:
        centre = int(rng.integers(width)), int(rng.integers(height))
        axes = int(rng.integers(3, 24)), int(rng.integers(3, 24))
        cv2.ellipse(ink, centre, axes, float(rng.uniform(0, 180)), 0, 360, int(rng.integers(90, 256)), -1)
    ink = np.asarray(cv2.GaussianBlur(ink, (0, 0), 2.5), np.uint8)
    return _blended(_moved(ink, offset_px), DIRT_OPACITY, 35.0)


def _circle(size: tuple[int, int], share: float, rng: np.random.Generator, offset_px: tuple[int, int]) -> Overlay:
    """Black outside a circle, as under a fisheye lens."""
    del rng
    radius = _radius(size, offset_px)
    shown = radius <= np.quantile(radius, 1.0 - share)
    return lambda pixels, _: np.where(shown[..., None], pixels, np.uint8(0))


def _propeller(size: tuple[int, int], share: float, rng: np.random.Generator, offset_px: tuple[int, int]) -> Overlay:
    """The shadow of blades that turn about a hub above the picture's upper edge, sharp, and elsewhere each time."""
    width, height = size
    hub = width // 2 + offset_px[0], -height // 8
    phases = rng.uniform(0, 2 * np.pi, 997)

    def shadowed(pixels: Bytes, k: int) -> Bytes:
        dark = np.zeros((height, width), np.uint8)
        for blade in range(2 * BLADES):
            angle = phases[k % len(phases)] + blade * np.pi / BLADES
            half = share * np.pi / (2 * BLADES)
            edge = hub + 4 * width * np.array([[np.cos(a), np.sin(a)] for a in (angle - half, angle + half)])
            corners = np.vstack([[hub], edge])
            cv2.fillPoly(dark, [corners.astype(np.int32)], 255)
        return np.asarray(np.where(dark[..., None] > 0, pixels * SHADOW, pixels), np.uint8)

    return shadowed


def _clock(size: tuple[int, int], share: float, rng: np.random.Generator, offset_px: tuple[int, int]) -> Overlay:
    """Opaque lines of figures that count: the time, and what an autopilot burns in."""
    width, height = size
    rows = max(round(height * share), 26)
    values = rng.uniform(0, 999, (997, 40))

    def counted(pixels: Bytes, k: int) -> Bytes:
        band = np.zeros((rows, width), np.uint8)
        stamp = f"{CLOCK_STARTS + k * CLOCK_STEP:%Y-%m-%d %H:%M:%S.%f}"[:-4]
        for n, row in enumerate(range(22, rows + 1, 26)):
            line = stamp if n == 0 else f"ALT {values[k % 997, n]:7.2f} HDG {values[k % 997, n + 1]:5.1f} BAT 87%"
            cv2.putText(band, line, (4, row), cv2.FONT_HERSHEY_SIMPLEX, width / 640, 255, 2)
        band = _moved(band, (offset_px[0], 0))
        return np.concatenate([pixels[: height - rows], np.repeat(band[..., None], 3, axis=2)])

    return counted


KINDS: dict[str, Callable[[tuple[int, int], float, np.random.Generator, tuple[int, int]], Overlay]] = {
    "bumper": _bumper,
    "watermark": _watermark,
    "vignette": _vignette,
    "letterbox": _letterbox,
    "dirt": _dirt,
    "circle": _circle,
    "propeller": _propeller,
    "clock": _clock,
}


def _blended(ink: Bytes, opacity: float, level: float) -> Overlay:
    """Pictures that are drawn towards one grey level where there is ink."""
    weight = (opacity / 255.0 * ink)[..., None]
    return lambda pixels, _: (pixels * (1.0 - weight) + level * weight).astype(np.uint8)


def _moved(drawn: Bytes, offset_px: tuple[int, int]) -> Bytes:
    return np.roll(drawn, offset_px[::-1], axis=(0, 1))


def _radius(size: tuple[int, int], offset_px: tuple[int, int]) -> Float:
    width, height = size
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return np.asarray(np.hypot(x - width / 2 - offset_px[0], y - height / 2 - offset_px[1]))


def _letters(rng: np.random.Generator, count: int) -> str:
    return "".join(chr(65 + int(c)) for c in rng.integers(0, 26, count))
