"""Reciprocal nearest-neighbour matching of two dense descriptor fields, with the reference algorithm's result.

The search (`search.py`) is exact. Loop pairs and odometry pairs go through the same function with the same
parameters, because Eq. (1) is a ratio of their counts.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flocc_agent.perception.mast3r.search import Index, Search, exact_index

ROUNDS_MAX = 10

Int = NDArray[np.int64]
Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class MatchParameters:
    """How two images are matched.

    Attributes:
        subsample: Distance of the seeds in image 1, pixels; 8 gives at most 3072 matches at 512x384.
        border_px: Matches nearer than this to a border of either image are dropped.
        confidence_min: Matches of which either pixel's descriptor confidence is below this are dropped.
        both_directions: Also run from image 2's seeds to image 1 and unite.
    """

    subsample: int = 8
    border_px: int = 3
    confidence_min: float = 0.0
    both_directions: bool = False

    def __post_init__(self) -> None:
        if self.subsample < 1 or self.border_px < 0:
            raise ValueError("the seeds' distance must be positive and the border not negative")


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Corresponding pixels.

    Attributes:
        xy1: (N, 2) int64 column and row in image 1.
        xy2: (N, 2) int64 column and row in image 2.
    """

    xy1: Int
    xy2: Int

    def __len__(self) -> int:
        return len(self.xy1)

    def where(self, keep: NDArray[np.bool_]) -> "Matches":
        """The matches whose mark is true."""
        return Matches(self.xy1[keep], self.xy2[keep])


def seeds(height: int, width: int, subsample: int, device: torch.device) -> Tensor:
    """Linear indices of the grid of start pixels, ascending."""
    y = torch.arange(subsample // 2, height, subsample, device=device)
    x = torch.arange(subsample // 2, width, subsample, device=device)
    return (x[None, :] + width * y[:, None]).flatten()


def reciprocal_indices(
    desc_1: Tensor, desc_2: Tensor, start: Tensor, rounds: int = ROUNDS_MAX, index: Index = exact_index
) -> tuple[Tensor, Tensor, Tensor]:
    """Walk from each start to its nearest neighbour and back until nothing changes.

    Args:
        desc_1: (H1, W1, D) descriptors of image 1.
        desc_2: (H2, W2, D) descriptors of image 2.
        start: (Q,) linear indices in image 1.
        rounds: Walks there and back at most.
        index: Makes the search over an image; the default is exact.

    Returns:
        Last index in image 1 and in image 2, and whether the walk came to rest; each (Q,).
    """
    flat_1, flat_2 = desc_1.flatten(0, 1), desc_2.flatten(0, 1)
    search_1, search_2 = index(desc_1), index(desc_2)
    index_1, index_2 = start.clone(), torch.full_like(start, -1)
    active = torch.arange(len(start), device=start.device)
    for _ in range(rounds):
        active = _step(search_2, flat_1, index_1, index_2, active)
        active = _step(search_1, flat_2, index_2, index_1, active)
        if len(active) == 0:
            break
    converged = torch.ones(len(start), dtype=torch.bool, device=start.device)
    converged[active] = False
    return index_1, index_2, converged


def _step(search: Search, flat_here: Tensor, here: Tensor, there: Tensor, active: Tensor) -> Tensor:
    """Move the active walks to the other image, in place; gives those that moved."""
    if len(active) == 0:
        return active
    found = search(flat_here[here[active]])
    moved = found != there[active]
    there[active] = found
    return active[moved]


def _pixels(index: Tensor, width: int) -> Int:
    """(N, 2) column and row of linear indices."""
    linear = index.cpu().numpy().astype(np.int64)
    return np.stack([linear % width, linear // width], axis=1)


def reciprocal_matches(
    desc_1: Tensor, desc_2: Tensor, subsample: int = 8, rounds: int = ROUNDS_MAX, index: Index = exact_index
) -> Matches:
    """Reciprocal nearest neighbours from a grid of seeds in image 1, sorted and without repetition.

    Args:
        desc_1: (H1, W1, D) unit descriptors of image 1.
        desc_2: (H2, W2, D) of image 2; sizes may differ.
        subsample: Distance of the seeds, pixels.
        rounds: Walks there and back at most.
        index: Makes the search over an image.
    """
    start = seeds(desc_1.shape[0], desc_1.shape[1], subsample, desc_1.device)
    index_1, index_2, converged = reciprocal_indices(desc_1, desc_2, start, rounds, index)
    pairs = torch.unique(torch.stack([index_1[converged], index_2[converged]], dim=1), dim=0)
    return Matches(_pixels(pairs[:, 0], desc_1.shape[1]), _pixels(pairs[:, 1], desc_2.shape[1]))


def united(first: Matches, second: Matches, widths: tuple[int, int]) -> Matches:
    """Union of two sets of matches, sorted by their pixels in images 1 and 2."""
    xy1, xy2 = np.concatenate([first.xy1, second.xy1]), np.concatenate([first.xy2, second.xy2])
    linear = np.stack([xy1[:, 0] + widths[0] * xy1[:, 1], xy2[:, 0] + widths[1] * xy2[:, 1]], axis=1)
    _, kept = np.unique(linear, axis=0, return_index=True)
    return Matches(xy1[kept], xy2[kept])


def reciprocal_matches_both_ways(desc_1: Tensor, desc_2: Tensor, subsample: int = 8) -> Matches:
    """Union of the matches from image 1's seeds and from image 2's seeds."""
    there = reciprocal_matches(desc_1, desc_2, subsample)
    back = reciprocal_matches(desc_2, desc_1, subsample)
    return united(there, Matches(back.xy2, back.xy1), (desc_1.shape[1], desc_2.shape[1]))


def inside(xy: Int, height: int, width: int, border_px: int) -> NDArray[np.bool_]:
    """Whether pixels are at least so far from the border."""
    x, y = xy[:, 0], xy[:, 1]
    kept = (x >= border_px) & (x < width - border_px) & (y >= border_px) & (y < height - border_px)
    return np.asarray(kept)


def match_confidences(matches: Matches, confidence_1: Tensor, confidence_2: Tensor) -> Float32:
    """(N,) smaller of the two pixels' descriptor confidences, given (H, W) maps."""
    of_1 = confidence_1.float().cpu().numpy()[matches.xy1[:, 1], matches.xy1[:, 0]]
    of_2 = confidence_2.float().cpu().numpy()[matches.xy2[:, 1], matches.xy2[:, 0]]
    return np.asarray(np.minimum(of_1, of_2), np.float32)


def match_views(desc: tuple[Tensor, Tensor], confidence: tuple[Tensor, Tensor], parameters: MatchParameters) -> Matches:
    """Match two views with all filters applied; the count of Eq. (1) is the length of what this gives.

    Args:
        desc: (H, W, D) descriptors of each view.
        confidence: (H, W) descriptor confidences of each view.
        parameters: Seeds, directions and filters.
    """
    desc_1, desc_2 = (part if part.device.type == "cuda" else part.cpu() for part in desc)
    run = reciprocal_matches_both_ways if parameters.both_directions else reciprocal_matches
    matches = run(desc_1, desc_2, parameters.subsample)
    for_1 = inside(matches.xy1, desc[0].shape[0], desc[0].shape[1], parameters.border_px)
    for_2 = inside(matches.xy2, desc[1].shape[0], desc[1].shape[1], parameters.border_px)
    matches = matches.where(for_1 & for_2)
    if parameters.confidence_min > 0:
        matches = matches.where(match_confidences(matches, *confidence) >= parameters.confidence_min)
    return matches
