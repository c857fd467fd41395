"""Plan of the town: blocks of houses with streets around them, one block left open as a square."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

COLUMNS, ROWS = 3, 2
BLOCK_M = 9.6
STREET_M = 5.2
SQUARE = (1, 1)
RING_M = 6.0


@dataclass(frozen=True, slots=True)
class Plot:
    """Ground for one house, a rectangle in the plan, and which of its sides are seen.

    Attributes:
        low_m: South-west corner.
        high_m: North-east corner.
        fronts: Of south, east, north and west (0 to 3) those that face a street.
    """

    low_m: tuple[float, float]
    high_m: tuple[float, float]
    fronts: tuple[int, ...]

    def corners_m(self) -> Float:
        """(4, 2), counter-clockwise from the south-west; side k runs from corner k to k + 1."""
        (x0, y0), (x1, y1) = self.low_m, self.high_m
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def size_m() -> tuple[float, float]:
    """Extent of the streets and blocks, from the origin to the east and to the north."""
    return (COLUMNS + 1) * STREET_M + COLUMNS * BLOCK_M, (ROWS + 1) * STREET_M + ROWS * BLOCK_M


def node_m(column: int, row: int) -> Float:
    """Middle of a crossing, (2,)."""
    step = STREET_M + BLOCK_M
    return np.array([column * step + STREET_M / 2, row * step + STREET_M / 2])


def block_low_m(column: int, row: int) -> Float:
    """South-west corner of a block, (2,)."""
    step = STREET_M + BLOCK_M
    return np.array([column * step + STREET_M, row * step + STREET_M])


def plots(rng: np.random.Generator) -> list[Plot]:
    """Plots of all houses: four to a block, and a ring around the town; no two fronts are quite in line."""
    found = []
    for column in range(COLUMNS):
        for row in range(ROWS):
            if (column, row) != SQUARE:
                found += _block(rng, block_low_m(column, row))
    return found + _ring(rng)


def alike(seed: int) -> list[tuple[int, Plot]]:
    """Plots of a town whose blocks follow one plan, each with the number of its house's kind; fronts are in line."""
    blocks = [(column, row) for column in range(COLUMNS) for row in range(ROWS) if (column, row) != SQUARE]
    found = [
        (kind, plot)
        for block in blocks
        for kind, plot in enumerate(_block(np.random.default_rng([seed, 0]), block_low_m(*block)))
    ]
    return found + [(4 + k % 2, plot) for k, plot in enumerate(_ring(None))]


def _block(rng: np.random.Generator, low_m: Float) -> list[Plot]:
    split_x, split_y = low_m + BLOCK_M * rng.uniform(0.42, 0.58, 2)
    high_m = low_m + BLOCK_M
    quarters = [
        ((low_m[0], low_m[1]), (split_x, split_y), (0, 3)),
        ((split_x, low_m[1]), (high_m[0], split_y), (0, 1)),
        ((split_x, split_y), (high_m[0], high_m[1]), (1, 2)),
        ((low_m[0], split_y), (split_x, high_m[1]), (2, 3)),
    ]
    return [_set_back(rng, low, high, fronts) for low, high, fronts in quarters]


def _set_back(
    rng: np.random.Generator, low: tuple[float, float], high: tuple[float, float], fronts: tuple[int, ...]
) -> Plot:
    (x0, y0), (x1, y1) = low, high
    back = {front: float(rng.uniform(0.0, 0.35)) for front in fronts}
    x0, x1 = x0 + back.get(3, 0.0), x1 - back.get(1, 0.0)
    y0, y1 = y0 + back.get(0, 0.0), y1 - back.get(2, 0.0)
    return Plot((x0, y0), (x1, y1), fronts)


def _ring(rng: np.random.Generator | None) -> list[Plot]:
    """Houses on all four edges; each faces inwards. Without a generator they are of one width, and in line."""
    width, height = size_m()
    found = []
    for start, end in _pieces(rng, width):
        found.append(Plot((start, -RING_M), (end, -_set_back_m(rng)), (2,)))
        found.append(Plot((start, height + _set_back_m(rng)), (end, height + RING_M), (0,)))
    for start, end in _pieces(rng, height):
        found.append(Plot((-RING_M, start), (-_set_back_m(rng), end), (1,)))
        found.append(Plot((width + _set_back_m(rng), start), (width + RING_M, end), (3,)))
    return found


def _set_back_m(rng: np.random.Generator | None) -> float:
    return 0.0 if rng is None else float(rng.uniform(0, 0.4))


def _pieces(rng: np.random.Generator | None, length_m: float) -> list[tuple[float, float]]:
    count = round(length_m / 6.2)
    cuts = np.linspace(0, length_m, count + 1)
    if rng is not None:
        cuts[1:-1] += rng.uniform(-0.8, 0.8, count - 1)
    return [(float(a), float(b)) for a, b in pairwise(cuts)]
