"""Codebook: what turns an image's patches into one vector, learnt from generated images (`flocc_lab.codebook`).

VLAD (Jegou et al. 2010) with intra-normalisation (Arandjelovic and Zisserman 2013), then a projection that keeps
what differs between scenes and weakens what differs between views of one scene.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.perception.classical.patches import PATCH_LENGTH

Float32 = NDArray[np.float32]

CODEBOOK_PATH = Path(__file__).with_name("codebook.npz")
LENGTH_MIN = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Codebook:
    """Parameters of the global descriptor.

    Attributes:
        patch_mean: (128,) mean patch.
        patch_projection: (128, P) principal components of patches, half whitened.
        words: (K, P) cluster centres of projected patches.
        vlad_mean: (K P,) mean VLAD.
        vlad_projection: (K P, D) projection of VLADs.
    """

    patch_mean: Float32
    patch_projection: Float32
    words: Float32
    vlad_mean: Float32
    vlad_projection: Float32

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        return int(self.vlad_projection.shape[1])

    def describe(self, patches: Float32) -> Float32:
        """Descriptor (D,) of unit length of an image's patches (N, 128)."""
        centred = vlad(self.projected(patches), self.words) - self.vlad_mean
        return unit(np.asarray(centred @ self.vlad_projection))

    def projected(self, patches: Float32) -> Float32:
        """Principal components (N, P) of patches (N, 128)."""
        return np.asarray((patches - self.patch_mean) @ self.patch_projection, np.float32)


def vlad(projected: Float32, words: Float32) -> Float32:
    """Sum of patches' differences to their nearest word, word by word, each of unit length: (K P,)."""
    nearest = nearest_words(projected, words)
    membership = np.zeros((len(words), len(projected)), np.float32)
    membership[nearest, np.arange(len(projected))] = 1.0
    residuals = membership @ projected - membership.sum(axis=1, keepdims=True) * words
    lengths = np.linalg.norm(residuals, axis=1, keepdims=True)
    return unit((residuals / np.maximum(lengths, LENGTH_MIN)).ravel())


def nearest_words(projected: Float32, words: Float32) -> NDArray[np.intp]:
    """Index (N,) of the nearest word of each projected patch."""
    return np.asarray((projected @ words.T - 0.5 * (words * words).sum(axis=1)).argmax(axis=1))


def unit(vector: Float32) -> Float32:
    """Vector of length one; a zero vector stays."""
    return np.asarray(vector / max(float(np.linalg.norm(vector)), LENGTH_MIN), np.float32)


def save_codebook(codebook: Codebook, path: Path) -> None:
    """Write a codebook; the large projection as bytes with a scale per column."""
    scale = np.abs(codebook.vlad_projection).max(axis=0) / 127.0
    np.savez_compressed(
        path,
        patch_mean=codebook.patch_mean,
        patch_projection=codebook.patch_projection,
        words=codebook.words,
        vlad_mean=codebook.vlad_mean,
        vlad_projection=np.rint(codebook.vlad_projection / scale).astype(np.int8),
        vlad_projection_scale=scale.astype(np.float32),
    )


@lru_cache(maxsize=4)
def load_codebook(path: Path = CODEBOOK_PATH) -> Codebook:
    """Read a codebook of `save_codebook`."""
    with np.load(path, allow_pickle=False) as arrays:
        codebook = Codebook(
            arrays["patch_mean"],
            arrays["patch_projection"],
            arrays["words"],
            arrays["vlad_mean"],
            arrays["vlad_projection"].astype(np.float32) * arrays["vlad_projection_scale"],
        )
    assert codebook.patch_mean.shape == (PATCH_LENGTH,), "the codebook belongs to other patches"
    return codebook
