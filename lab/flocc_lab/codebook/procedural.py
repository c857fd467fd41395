"""Generated images to learn a codebook from: layers of textured boards, seen from several places and in other light.

No photograph takes part, so the codebook carries nobody's licence.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

WIDTH, HEIGHT = 320, 240
TEXTURE_PX = 160


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """A flat textured thing: its texture, its corners (4, 2) in pixels, and how far it moves with the camera."""

    texture: Float32
    corners_px: Float
    nearness: float


@dataclass(frozen=True, slots=True, eq=False)
class BoardScene:
    """Boards from far to near before an even background."""

    boards: tuple[Board, ...]
    background: float


def random_scene(rng: np.random.Generator) -> BoardScene:
    """Draw a scene of 10 to 40 boards."""
    count = int(rng.integers(10, 40))
    boards = tuple(random_board(rng, k / count) for k in range(count))
    return BoardScene(boards, rng.uniform(40, 200))


def random_board(rng: np.random.Generator, nearness: float) -> Board:
    """Draw a board: mostly upright, of any size, a little out of parallel."""
    size_px = np.exp(rng.uniform(np.log(25), np.log(300))) * (1 - 0.4 * nearness)
    aspect = np.exp(rng.normal(0, 0.5))
    angle_rad = rng.normal(0, 0.1) if rng.uniform() < 0.8 else rng.uniform(0, 2 * np.pi)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [size_px * aspect / 2, size_px / aspect / 2]
    corners = corners * (1 + rng.uniform(-0.25, 0.25, (4, 2)))
    centre = rng.uniform([-60, -40], [WIDTH + 60, HEIGHT + 40])
    return Board(random_texture(rng), corners @ rotation(angle_rad).T + centre, 0.3 + nearness)


def random_view(scene: BoardScene, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Render a scene (240, 320) uint8 from a random place nearby, in random light, with blur and noise."""
    shift_px = rng.uniform(-1, 1, 2) * [45, 15]
    skew = rng.normal(0, 0.03, (2, 2)) + np.eye(2)
    view = rotation(rng.normal(0, 0.05)) @ skew * np.exp(rng.normal(0, 0.12))
    centre = np.array([WIDTH / 2, HEIGHT / 2])
    image = np.full((HEIGHT, WIDTH), scene.background, np.float32)
    for board in scene.boards:
        corners = (board.corners_px + shift_px * board.nearness - centre) @ view.T + centre
        image = pasted(image, board.texture, corners)
    blurred = np.clip(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.3)), 0, 255)
    lit = 255 * (blurred / 255) ** rng.uniform(0.6, 1.5) * rng.uniform(0.5, 1.1)
    noisy = lit + rng.normal(0, rng.uniform(0.5, 4), lit.shape)
    return np.asarray(np.clip(noisy, 0, 255), np.uint8)


def pasted(image: Float32, texture: Float32, corners_px: Float) -> Float32:
    """Put a texture over an image, its corners at (4, 2) pixels."""
    side = len(texture)
    square = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32)
    M = cv2.getPerspectiveTransform(square, corners_px.astype(np.float32))
    mask = cv2.warpPerspective(np.ones_like(texture), M, (WIDTH, HEIGHT))
    return np.asarray(image * (1 - mask) + cv2.warpPerspective(texture, M, (WIDTH, HEIGHT)) * mask, np.float32)


def random_texture(rng: np.random.Generator) -> Float32:
    """Draw a texture: noise, stripes, bricks, writing, shapes or nothing, with shading."""
    n = TEXTURE_PX
    y, x = np.mgrid[0:n, 0:n].astype(float)
    kind = rng.choice(["noise", "stripes", "bricks", "writing", "shapes", "plain"])
    texture = np.full((n, n), rng.uniform(30, 225))
    if kind == "noise":
        texture += coloured_noise(rng, rng.uniform(0.6, 1.6)) * rng.uniform(5, 35)
    elif kind == "stripes":
        period = rng.uniform(6, 40)
        texture += rng.uniform(-90, 90) * (np.mod(x, period) < period * rng.uniform(0.1, 0.6))
    elif kind == "bricks":
        width, height = rng.uniform(10, 40, 2)
        joint, shifted = rng.uniform(1, 3), x + np.floor(y / height) * width / 2
        texture += rng.uniform(-80, 80) * ((np.mod(shifted, width) < joint) | (np.mod(y, height) < joint))
    elif kind == "writing":
        texture = written(texture, rng)
    elif kind == "shapes":
        texture = drawn(texture, rng)
    texture += coloured_noise(rng, 1.0) * rng.uniform(0, 8)
    slope = rng.uniform(-0.5, 0.5, 2)
    return np.asarray(texture * (1 + (slope[0] * x + slope[1] * y) / n), np.float32)


def coloured_noise(rng: np.random.Generator, exponent: float) -> Float:
    """Noise whose spectrum falls with frequency to the power of the exponent, of unit variance."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(TEXTURE_PX), np.fft.fftfreq(TEXTURE_PX)))
    frequency[0, 0] = np.inf
    noise = np.real(np.fft.ifft2(np.fft.fft2(rng.standard_normal((TEXTURE_PX, TEXTURE_PX))) / frequency**exponent))
    return np.asarray(noise / noise.std())


def written(texture: Float, rng: np.random.Generator) -> Float:
    """Write random words on a texture."""
    image = texture.astype(np.uint8)
    for _ in range(int(rng.integers(3, 25))):
        word = "".join(chr(code) for code in rng.integers(33, 123, int(rng.integers(2, 9))))
        place = (int(rng.integers(-20, TEXTURE_PX)), int(rng.integers(0, TEXTURE_PX)))
        grey, thickness = float(rng.uniform(0, 255)), int(rng.integers(1, 3))
        font, size = int(rng.integers(0, 8)), rng.uniform(0.3, 1.5)
        cv2.putText(image, word, place, font, size, (grey,), thickness, cv2.LINE_AA)
    return image.astype(float)


def drawn(texture: Float, rng: np.random.Generator) -> Float:
    """Draw random circles and rectangles on a texture."""
    image = texture.astype(np.uint8)
    for _ in range(int(rng.integers(3, 30))):
        x, y = (int(value) for value in rng.integers(0, TEXTURE_PX, 2))
        colour, thickness = (float(rng.uniform(0, 255)),), int(rng.choice([-1, 1, 2]))
        if rng.uniform() < 0.5:
            cv2.circle(image, (x, y), int(rng.integers(2, 25)), colour, thickness, cv2.LINE_AA)
        else:
            width, height = (int(value) for value in rng.integers(3, 50, 2))
            cv2.rectangle(image, (x, y), (x + width, y + height), colour, thickness)
    return image.astype(float)


def rotation(angle_rad: float) -> Float:
    """Rotation (2, 2) of the plane."""
    return np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])
