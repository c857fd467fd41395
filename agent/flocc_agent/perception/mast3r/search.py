"""Exact nearest neighbours among the descriptors of a picture.

On a CPU the picture is cut into blocks of four tiles of 16x16 pixels, and each query passes three sieves, none of which
can lose its winner: cones around the tiles' mean directions rule out blocks that are too far away; where many remain
(rough descriptors) and the CPU multiplies bfloat16 in hardware, rough scores with a margin for their rounding rule out
more; then float32 scores find the best. Where rounding could change it, float64 decides. Unit descriptors are compared
by distance, which for them orders like the dot product.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from flocc_agent.perception.mast3r.device import cpu_has_fast_bf16

TILE_PX = 16
BLOCK_PX = 32
TILES_PER_BLOCK = 4
NO_PIXEL = 2**62
ROWS_CPU = 1024
ROWS_ACCELERATOR = 8192
QUERIES_AT_ONCE = 512
DENSE_RATIO = 0.15
"""Share of (block, query) pairs left by the cones above which scoring everything roughly is cheaper."""
COARSE_MARGIN = 2 * (2 * 2**-8 + 2**-8)
"""Twice the largest error of a bfloat16 score of unit vectors: both factors rounded (2^-8), then the result (2^-8)."""
FINE_MARGIN = 4e-6
"""Twice the largest error of a float32 score of unit vectors of 24 numbers, and of lengths that are not exactly one."""
COSINE_MARGIN = 1e-6
ANGLE_MARGIN_RAD = 2e-3
"""Rounding of arc cosines of float32 scores near one."""

Search = Callable[[Tensor], Tensor]
Index = Callable[[Tensor], Search]


def exact_index(desc: Tensor) -> Search:
    """The exact search over a picture's unit descriptors (H, W, D); it maps queries (Q, D) to linear pixels (Q,)."""
    if desc.device.type == "cpu":
        return BlockIndex(desc.float(), cpu_has_fast_bf16())
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
    block = ROWS_CPU if database.device.type == "cpu" else ROWS_ACCELERATOR
    blocks = [database[k : k + block] for k in range(0, len(database), block)]
    best_of_block = torch.stack([(queries @ rows.T).amax(dim=1) for rows in blocks])
    winner = best_of_block.argmax(dim=0)
    found = torch.empty(len(queries), dtype=torch.int64, device=database.device)
    for k in np.unique(winner.cpu().numpy()).tolist():
        chosen = (winner == k).nonzero()[:, 0]
        found[chosen] = k * block + (queries[chosen] @ blocks[k].T).argmax(dim=1)
    return found


def blocks_of(height: int, width: int) -> Tensor:
    """(B, 1024) linear pixels of blocks of 32x32, four tiles of 16x16 each, one tile after the other.

    Blocks that stick out of the picture repeat its border's pixels.
    """
    rows, columns = -(-height // BLOCK_PX), -(-width // BLOCK_PX)
    y = torch.arange(rows * BLOCK_PX).clamp(max=height - 1).view(rows, 1, 2, 1, TILE_PX, 1)
    x = torch.arange(columns * BLOCK_PX).clamp(max=width - 1).view(1, columns, 1, 2, 1, TILE_PX)
    return (y * width + x).reshape(rows * columns, BLOCK_PX**2)


class BlockIndex:
    """Exact search over one picture's descriptors on a CPU; see the module's description.

    Args:
        desc: (H, W, D) float32, unit length.
        fast_bf16: Whether rough scores in bfloat16 pay.
    """

    def __init__(self, desc: Tensor, fast_bf16: bool) -> None:
        self._pixels = blocks_of(desc.shape[0], desc.shape[1])
        self._blocks = desc.flatten(0, 1)[self._pixels]
        self._rough = self._blocks.bfloat16() if fast_bf16 else None
        tiles = self._blocks.view(-1, TILE_PX**2, desc.shape[2])
        self._centres = torch.nn.functional.normalize(tiles.mean(dim=1), dim=1)
        cosines = torch.bmm(tiles, self._centres[:, :, None])[:, :, 0].amin(dim=1)
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
        """(B, Q) blocks with a tile whose cone can reach a query's score in the block of the nearest cone."""
        cosines = queries @ self._centres.T
        first = cosines.argmax(dim=1) // TILES_PER_BLOCK
        lower = torch.empty(len(queries))
        for k, chosen in grouped(first, len(self._blocks)):
            lower[chosen] = (self._blocks[k] @ queries[chosen].T).amax(dim=0)
        reach = lower.clamp(-1, 1).arccos() + ANGLE_MARGIN_RAD
        # The arc cosine decreases: angle <= radius + reach is cosine >= cos(radius + reach), everything from pi on.
        of_reach, of_radius = (torch.stack([x.cos(), x.sin()], dim=1) for x in (reach, self._radii))
        tiles = cosines >= (of_reach * torch.tensor([1.0, -1.0])) @ of_radius.T - COSINE_MARGIN
        if float(reach.max() + self._radii.max()) >= torch.pi:
            tiles |= reach[:, None] + self._radii >= torch.pi
        return tiles.view(len(queries), -1, TILES_PER_BLOCK).any(dim=2).T.contiguous()

    def _roughly_best(self, queries: Tensor, rough: Tensor) -> Tensor:
        """(B, Q) blocks whose bfloat16 score is within its rounding of the best."""
        best = torch.empty(len(rough), len(queries), dtype=torch.int16)
        wanted = queries.bfloat16()
        for q in range(0, len(queries), QUERIES_AT_ONCE):
            some = wanted[q : q + QUERIES_AT_ONCE].T
            for k, block in enumerate(rough):
                # Positive bfloat16 numbers order like their bits read as int16, whose maximum is far faster; negative
                # ones do not, which matters only where the best is not positive: such queries keep every block.
                best[k, q : q + QUERIES_AT_ONCE] = (block @ some).view(torch.int16).amax(dim=0)
        scores = best.view(torch.bfloat16).float()
        top = scores.amax(dim=0)
        return (scores >= top - COARSE_MARGIN) | (top <= COARSE_MARGIN)

    def _best(self, queries: Tensor, possible: Tensor) -> tuple[Tensor, Tensor]:
        """Winners (Q,) by float32 scores, and the (B, Q) blocks to look at again where rounding could change them."""
        scores = torch.full(possible.shape, -torch.inf)
        for k, chosen in marked(possible):
            scores[k, chosen] = (self._blocks[k] @ queries[chosen].T).amax(dim=0)
        best, block = scores.max(dim=0)
        near = scores >= best - FINE_MARGIN
        found = torch.empty(len(queries), dtype=torch.int64)
        unsure = near.sum(dim=0) > 1
        for k, chosen in grouped(block, len(self._blocks)):
            of_block = queries[chosen] @ self._blocks[k].T
            top, at = of_block.max(dim=1)
            found[chosen] = self._pixels[k][at]
            unsure[chosen] |= (of_block >= top[:, None] - FINE_MARGIN).sum(dim=1) > 1
        return found, near & unsure

    def _decide(self, queries: Tensor, blocks: Tensor) -> Tensor:
        """The nearest pixel among the remaining blocks, in float64; the lowest of equals."""
        nearest_distance = torch.full((len(queries),), torch.inf, dtype=torch.float64)
        found = torch.full((len(queries),), NO_PIXEL)
        exact = queries.double()
        for k, chosen in marked(blocks):
            rows = self._blocks[k].double()
            distances = (rows * rows).sum(dim=1) - 2 * (exact[chosen] @ rows.T)
            distance = distances.amin(dim=1)
            pixel = self._pixels[k].where(distances == distance[:, None], NO_PIXEL).amin(dim=1)
            tied = (distance == nearest_distance[chosen]) & (pixel < found[chosen])
            closer = (distance < nearest_distance[chosen]) | tied
            nearest_distance[chosen[closer]], found[chosen[closer]] = distance[closer], pixel[closer]
        return found


def grouped(block: Tensor, blocks: int) -> list[tuple[int, Tensor]]:
    """The places at which each block stands in (Q,), blocks without any left out."""
    order = block.argsort()
    counts = torch.bincount(block, minlength=blocks).tolist()
    return [(k, part) for k, part in enumerate(torch.split(order, counts)) if counts[k]]


def marked(mask: Tensor) -> list[tuple[int, Tensor]]:
    """The queries marked for each block of a (B, Q) mask, blocks without any left out."""
    block, query = mask.nonzero(as_tuple=True)
    counts = torch.bincount(block, minlength=len(mask)).tolist()
    return [(k, part) for k, part in enumerate(torch.split(query, counts)) if counts[k]]
