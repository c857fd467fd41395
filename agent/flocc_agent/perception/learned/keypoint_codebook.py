"""Codebook of the learned features: words and components that turn an image's features into one vector.

VLAD (Jegou et al. 2010) with intra-normalisation (Arandjelovic and Zisserman 2013) over principal components, learnt
from the project's own generated pictures (`training.py`).
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.perception.classical.codebook import vlad

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class LearnedCodebook:
    """Parameters of the place descriptor.

    Attributes:
        mean: (D,) mean feature.
        projection: (D, P) principal components.
        words: (K, P) cluster centres of projected features.
    """

    mean: Float32
    projection: Float32
    words: Float32

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        return self.words.size

    def describe(self, descriptors: Float32) -> Float32:
        """Descriptor (K P,) of unit length of an image's features (N, D)."""
        return vlad(np.asarray((descriptors - self.mean) @ self.projection, np.float32), self.words)


def codebook_path(model: str) -> Path:
    """The file of a model's codebook."""
    return Path(__file__).with_name(f"codebook_{model.partition('-')[0]}.npz")


@lru_cache(maxsize=4)
def load_codebook(model: str) -> LearnedCodebook:
    """Read the codebook of a model."""
    with np.load(codebook_path(model), allow_pickle=False) as arrays:
        return LearnedCodebook(arrays["mean"], arrays["projection"], arrays["words"])
