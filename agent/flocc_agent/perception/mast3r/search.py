"""Exact nearest neighbours among the descriptors of a picture, by dot product.

Every query is compared with every pixel, but each block of pixels is first reduced to its largest score (a product
and a row maximum, both vectorised); pixels are looked at one by one only in blocks that can hold the winner. Where
the CPU multiplies bfloat16 in hardware, that first pass runs in bfloat16 with a margin that covers its rounding, so
that the result is still that of float32.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from flocc_agent.perception.mast3r.device import cpu_has_fast_bf16

BLOCK_CPU = 1024
BLOCK_ACCELERATOR = 8192
TILE_PX = 32
QUERIES_MAX = 1024
COARSE_MARGIN = 2 * (2 * 2**-8 + 2**-8)
"""Twice the largest error of a bfloat16 score of unit vectors: both factors rounded (2^-8), then the result (2^-8)."""

Search = Callable[[Tensor], Tensor]
Index = Callable[[Tensor], Search]


def exact_index(desc: Tensor) -> Search:
    """The fastest exact search over a picture's unit descriptors (H, W, D); it maps queries (Q, D) to pixels (Q,)."""
    if desc.device.type == "cpu" and desc.dtype is torch.float32 and cpu_has_fast_bf16():
        return coarse_to_fine_index(desc)
    flat = desc.flatten(0, 1)
    return lambda queries: nearest(queries, flat)


def nearest(queries: Tensor, database: Tensor) -> Tensor:
    """Index of the database row with the largest dot product, for each query; the first of equals.

    Args:
        queries: (Q, D).
        database: (N, D).

    Returns:
        (Q,) int64.
    """
    block = BLOCK_CPU if database.device.type == "cpu" else BLOCK_ACCELERATOR
    blocks = [database[k : k + block] for k in range(0, len(database), block)]
    best_of_block = torch.stack([(queries @ rows.T).amax(dim=1) for rows in blocks])
    winner = best_of_block.argmax(dim=0)
    found = torch.empty(len(queries), dtype=torch.int64, device=database.device)
    for k in np.unique(winner.cpu().numpy()).tolist():
        chosen = (winner == k).nonzero()[:, 0]
        found[chosen] = k * block + (queries[chosen] @ blocks[k].T).argmax(dim=1)
    return found


def coarse_to_fine_index(desc: Tensor) -> Search:
    """Exact search that finds the possible tiles in bfloat16 and the winner in float32.

    Tiles are square, so that pixels that look alike share a tile and few tiles remain.
    """
    pixels = tiles_of(desc.shape[0], desc.shape[1])
    fine = [desc.flatten(0, 1)[tile] for tile in pixels]
    coarse = [rows.bfloat16() for rows in fine]

    def search(queries: Tensor) -> Tensor:
        parts = [queries[k : k + QUERIES_MAX] for k in range(0, len(queries), QUERIES_MAX)]
        found = [refined(part, fine, pixels, possible_tiles(part, coarse)) for part in parts]
        return torch.cat(found) if found else torch.empty(0, dtype=torch.int64)

    return search


def tiles_of(height: int, width: int) -> list[Tensor]:
    """Linear pixel indices of square tiles, ascending within each."""
    linear = torch.arange(height * width).view(height, width)
    return [
        linear[y : y + TILE_PX, x : x + TILE_PX].flatten()
        for y in range(0, height, TILE_PX)
        for x in range(0, width, TILE_PX)
    ]


def possible_tiles(queries: Tensor, coarse: list[Tensor]) -> Tensor:
    """Which tiles can hold each query's winner, (T, Q) bool."""
    rough = queries.bfloat16()
    # Positive bfloat16 numbers order like their bits read as int16, whose maximum is far faster; negative ones do
    # not, which only matters for a query whose best score is not positive: it keeps every tile.
    best = torch.stack([(rough @ rows.T).view(torch.int16).amax(dim=1) for rows in coarse])
    scores = best.view(torch.bfloat16).float()
    top = scores.amax(dim=0)
    return (scores >= top - COARSE_MARGIN) | (top <= COARSE_MARGIN)


def refined(queries: Tensor, fine: list[Tensor], pixels: list[Tensor], possible: Tensor) -> Tensor:
    """The exact winner among the possible tiles; the lowest pixel of equals."""
    best = torch.full((len(queries),), -torch.inf)
    found = torch.full((len(queries),), torch.iinfo(torch.int64).max)
    for rows, tile, wanted in zip(fine, pixels, possible, strict=True):
        chosen = wanted.nonzero()[:, 0]
        if len(chosen) == 0:
            continue
        score, at = (queries[chosen] @ rows.T).max(dim=1)
        pixel = tile[at]
        better = (score > best[chosen]) | ((score == best[chosen]) & (pixel < found[chosen]))
        best[chosen[better]], found[chosen[better]] = score[better], pixel[better]
    return found
