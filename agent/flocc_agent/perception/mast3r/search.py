"""Exact nearest neighbours among the descriptors of a picture.

On a CPU the picture is cut into tiles of 16x16 pixels and each query passes three sieves, none of which can lose its
winner: a cone around each tile's mean direction rules out tiles that are too far away; where most remain (rough
descriptors) and the CPU multiplies bfloat16 in hardware, rough scores with a margin for their rounding rule out more;
then float32 scores leave the tiles within rounding of the best. Among their pixels float64 decides. Unit descriptors
are compared by distance, which for them orders like the dot product.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from flocc_agent.perception.mast3r.device import cpu_has_fast_bf16

TILE_PX = 16
BLOCK_CPU = 1024
BLOCK_ACCELERATOR = 8192
QUERIES_AT_ONCE = 512
TILES_AT_ONCE = 4
DENSE_RATIO = 0.15
"""Share of (tile, query) pairs left by the cones above which scoring everything roughly is cheaper."""
COARSE_MARGIN = 2 * (2 * 2**-8 + 2**-8)
"""Twice the largest error of a bfloat16 score of unit vectors: both factors rounded (2^-8), then the result (2^-8)."""
FINE_MARGIN = 4e-6
"""Twice the largest error of a float32 score of unit vectors of 24 numbers, and of lengths that are not exactly one."""
ANGLE_MARGIN_RAD = 2e-3
"""Rounding of arc cosines of float32 scores near one."""

Search = Callable[[Tensor], Tensor]
Index = Callable[[Tensor], Search]


def exact_index(desc: Tensor) -> Search:
    """The exact search over a picture's unit descriptors (H, W, D); it maps queries (Q, D) to linear pixels (Q,)."""
    if desc.device.type == "cpu":
        return TileIndex(desc.float(), cpu_has_fast_bf16())
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


def tiles_of(height: int, width: int) -> Tensor:
    """(T, 256) linear pixels of square tiles, ascending in each; tiles that stick out repeat the border's pixels."""
    rows, columns = -(-height // TILE_PX), -(-width // TILE_PX)
    y = torch.arange(rows * TILE_PX).clamp(max=height - 1).view(rows, 1, TILE_PX, 1)
    x = torch.arange(columns * TILE_PX).clamp(max=width - 1).view(1, columns, 1, TILE_PX)
    return (y * width + x).reshape(rows * columns, TILE_PX**2)


class TileIndex:
    """Exact search over one picture's descriptors on a CPU; see the module's description.

    Args:
        desc: (H, W, D) float32, unit length.
        fast_bf16: Whether rough scores in bfloat16 pay.
    """

    def __init__(self, desc: Tensor, fast_bf16: bool) -> None:
        self._pixels = tiles_of(desc.shape[0], desc.shape[1])
        self._tiles = desc.flatten(0, 1)[self._pixels]
        self._rough = self._tiles.bfloat16() if fast_bf16 else None
        mean = torch.nn.functional.normalize(self._tiles.mean(dim=1), dim=1)
        self._centres = mean
        cosines = torch.bmm(self._tiles, mean[:, :, None])[:, :, 0].amin(dim=1)
        self._radii = cosines.clamp(-1, 1).arccos() + ANGLE_MARGIN_RAD

    def __call__(self, queries: Tensor) -> Tensor:
        """Map queries (Q, D) to their nearest pixels (Q,); the lowest of equals."""
        possible = self._within_cones(queries)
        if float(possible.float().mean()) > DENSE_RATIO and self._rough is not None:
            possible &= self._roughly_best(queries, self._rough)
        found, doubtful = self._best(queries, possible)
        unsure = doubtful.any(dim=0).nonzero()[:, 0]
        found[unsure] = self._decide(queries[unsure], doubtful[:, unsure])
        return found

    def _within_cones(self, queries: Tensor) -> Tensor:
        """(T, Q) tiles whose cone can reach a query's best score so far, that of the nearest cone's best pixel."""
        cosines = (self._centres @ queries.T).clamp(-1, 1)
        first = cosines.argmax(dim=0)
        lower = torch.empty(len(queries))
        for k, chosen in grouped(first, len(self._tiles)):
            lower[chosen] = (self._tiles[k] @ queries[chosen].T).amax(dim=0)
        reach = lower.clamp(-1, 1).arccos() + ANGLE_MARGIN_RAD
        # The arc cosine decreases: angle <= radius + reach is cosine >= cos(radius + reach), everything from pi on.
        limit = (self._radii[:, None] + reach).clamp(max=torch.pi).cos_()
        return (cosines >= limit) | (limit <= -1 + 1e-6)

    def _roughly_best(self, queries: Tensor, rough: Tensor) -> Tensor:
        """(T, Q) tiles whose bfloat16 score is within its rounding of the best."""
        best = torch.empty(len(rough), len(queries), dtype=torch.int16)
        wanted = queries.bfloat16()
        for q in range(0, len(queries), QUERIES_AT_ONCE):
            some = wanted[q : q + QUERIES_AT_ONCE]
            for k in range(0, len(rough), TILES_AT_ONCE):
                group = rough[k : k + TILES_AT_ONCE]
                # Positive bfloat16 numbers order like their bits read as int16, whose maximum is far faster; negative
                # ones do not, which matters only where the best is not positive: such queries keep every tile.
                bits = (group.flatten(0, 1) @ some.T).view(torch.int16).view(len(group), -1, len(some))
                best[k : k + TILES_AT_ONCE, q : q + QUERIES_AT_ONCE] = bits.amax(dim=1)
        scores = best.view(torch.bfloat16).float()
        top = scores.amax(dim=0)
        return (scores >= top - COARSE_MARGIN) | (top <= COARSE_MARGIN)

    def _best(self, queries: Tensor, possible: Tensor) -> tuple[Tensor, Tensor]:
        """Winners (Q,) by float32 scores, and the (T, Q) tiles to look at again where rounding could change them."""
        scores = torch.full(possible.shape, -torch.inf)
        for k, chosen in marked(possible):
            scores[k, chosen] = (self._tiles[k] @ queries[chosen].T).amax(dim=0)
        best, tile = scores.max(dim=0)
        near = scores >= best - FINE_MARGIN
        found = torch.empty(len(queries), dtype=torch.int64)
        unsure = near.sum(dim=0) > 1
        for k, chosen in grouped(tile, len(self._tiles)):
            of_tile = queries[chosen] @ self._tiles[k].T
            top, at = of_tile.max(dim=1)
            found[chosen] = self._pixels[k][at]
            unsure[chosen] |= (of_tile >= top[:, None] - FINE_MARGIN).sum(dim=1) > 1
        return found, near & unsure

    def _decide(self, queries: Tensor, tiles: Tensor) -> Tensor:
        """The nearest pixel among the remaining tiles, in float64; the lowest of equals."""
        nearest_distance = torch.full((len(queries),), torch.inf, dtype=torch.float64)
        found = torch.full((len(queries),), torch.iinfo(torch.int64).max)
        exact = queries.double()
        for k, chosen in marked(tiles):
            rows = self._tiles[k].double()
            distances = (rows * rows).sum(dim=1) - 2 * (exact[chosen] @ rows.T)
            distance, at = distances.min(dim=1)
            pixel = self._pixels[k][at]
            tied = (distance == nearest_distance[chosen]) & (pixel < found[chosen])
            closer = (distance < nearest_distance[chosen]) | tied
            nearest_distance[chosen[closer]], found[chosen[closer]] = distance[closer], pixel[closer]
        return found


def grouped(tile: Tensor, tiles: int) -> list[tuple[int, Tensor]]:
    """The places at which each tile stands in (Q,), tiles without any left out."""
    order = tile.argsort()
    counts = torch.bincount(tile, minlength=tiles).tolist()
    return [(k, part) for k, part in enumerate(torch.split(order, counts)) if counts[k]]


def marked(mask: Tensor) -> list[tuple[int, Tensor]]:
    """The queries marked for each tile of a (T, Q) mask, tiles without any left out."""
    tile, query = mask.nonzero(as_tuple=True)
    counts = torch.bincount(tile, minlength=len(mask)).tolist()
    return [(k, part) for k, part in enumerate(torch.split(query, counts)) if counts[k]]
