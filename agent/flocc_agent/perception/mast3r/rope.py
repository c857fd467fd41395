"""Two-dimensional rotary position embedding, base 100 (RoPE100).

Angles, sines and cosines are always float32 and precomputed per patch grid: angles in bfloat16 are too coarse.
"""

from functools import lru_cache

import torch
from torch import Tensor

BASE = 100.0
GRIDS_CACHED_MAX = 32

Rotation = tuple[Tensor, Tensor]


def patch_positions(grid_height: int, grid_width: int) -> Tensor:
    """(S, 2) int64 row and column of each patch, row-major, zero based."""
    y, x = torch.meshgrid(torch.arange(grid_height), torch.arange(grid_width), indexing="ij")
    return torch.stack([y.flatten(), x.flatten()], dim=1)


def rotation_of(positions: Tensor, head_dim: int) -> Rotation:
    """Cosine and signed sine tables of patch positions.

    Args:
        positions: (S, 2) row and column.
        head_dim: Channels of an attention head, a multiple of 4. The first half turns with the row, the second
            with the column; within a half of d channels, channel j is paired with channel j + d/2.

    Returns:
        cos and sin, each (S, head_dim) float32; the sine is negated for the first channel of each pair, so that
        `out = t * cos + swapped(t) * sin`.
    """
    half = head_dim // 2
    frequencies = 1.0 / BASE ** (torch.arange(0, half, 2, dtype=torch.float32) / half)
    angles = positions.to(torch.float32)[:, :, None] * frequencies.to(positions.device)
    cos, sin = angles.cos(), angles.sin()
    cos = torch.cat([cos, cos], dim=-1).flatten(1)
    sin = torch.cat([-sin, sin], dim=-1).flatten(1)
    return cos, sin


@lru_cache(maxsize=GRIDS_CACHED_MAX)
def grid_rotation(grid_height: int, grid_width: int, head_dim: int, device: torch.device) -> Rotation:
    """Tables of a whole patch grid, cached; see `rotation_of`."""
    with torch.inference_mode(False):
        cos, sin = rotation_of(patch_positions(grid_height, grid_width), head_dim)
    return cos.to(device), sin.to(device)


def rotate(tokens: Tensor, rotation: Rotation) -> Tensor:
    """Rotate queries or keys (B, heads, S, head_dim) by their positions; the result keeps their dtype."""
    cos, sin = rotation
    rotated = tokens.to(torch.float32, copy=True)
    swapped = rotated.reshape(*tokens.shape[:-1], 2, 2, -1).flip(-2).flatten(-3)
    return rotated.mul_(cos).addcmul_(swapped, sin).to(tokens.dtype)
