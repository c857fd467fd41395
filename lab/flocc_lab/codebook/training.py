"""Learn the codebook from generated images: `python -m flocc_lab.codebook.training --out FILE`.

The file in the package was made with the defaults; a few minutes on one core.
"""

import argparse
import logging
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.perception.classical.codebook import (
    CODEBOOK_PATH,
    Codebook,
    nearest_words,
    save_codebook,
    vlad,
)
from flocc_agent.perception.classical.patches import dense_patches
from flocc_lab.codebook.procedural import random_scene, random_view

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

WORDS = 64
PATCH_COMPONENTS = 48
DIMENSION = 384
SCENES = 1200
VIEWS = 3
PATCHES_PER_IMAGE = 120
"""Patches of an image that take part in clustering."""
CLUSTERING_ROUNDS = 15
RIDGE = 1e-3
"""Variance within scenes that is added everywhere, relative to its trace."""


def train(scenes: int, seed: int, words_count: int = WORDS, dimension: int = DIMENSION) -> Codebook:
    """Learn a codebook from generated scenes."""
    rng = np.random.default_rng(seed)
    images = [[random_view(scene, rng) for _ in range(VIEWS)] for scene in (random_scene(rng) for _ in range(scenes))]
    sample = np.concatenate([_sample(dense_patches(views[0]), rng) for views in images])
    mean, projection = principal_components(sample, PATCH_COMPONENTS)
    words = clustered((sample - mean) @ projection, words_count, rng)
    logger.info("%d words from %d patches", len(words), len(sample))
    aggregated = [[_aggregated(dense_patches(view), mean, projection, words) for view in views] for views in images]
    vlad_mean, vlad_projection = discriminants(np.array(aggregated), dimension)
    return Codebook(mean, projection, words, vlad_mean, vlad_projection)


def principal_components(sample: Float32, count: int) -> tuple[Float32, Float32]:
    """Mean (D,) and leading components (D, count), each divided by the fourth root of its variance."""
    mean = sample.mean(axis=0)
    variances, axes = np.linalg.eigh(np.cov((sample - mean).T))
    leading = axes[:, ::-1][:, :count] / np.maximum(variances[::-1][:count], 1e-12) ** 0.25
    return mean.astype(np.float32), leading.astype(np.float32)


def clustered(sample: Float32, count: int, rng: np.random.Generator) -> Float32:
    """Centres (count, D) of k-means."""
    centres = sample[rng.choice(len(sample), count, replace=False)].copy()
    for _ in range(CLUSTERING_ROUNDS):
        nearest = nearest_words(sample, centres)
        for k in range(count):
            members = sample[nearest == k]
            if len(members):
                centres[k] = members.mean(axis=0)
    return centres


def discriminants(vlads: Float32, dimension: int) -> tuple[Float32, Float32]:
    """Mean (D,) and projection (D, dimension) of VLADs (scenes, views, D).

    Differences between the views of a scene are whitened; what remains are the directions in which scenes differ most.
    """
    mean = vlads.mean(axis=(0, 1))
    within = (vlads - vlads.mean(axis=1, keepdims=True)).reshape(-1, vlads.shape[2]).astype(float)
    covariance = within.T @ within / len(within)
    covariance += RIDGE * np.trace(covariance) * np.eye(len(covariance))
    whitening = np.linalg.inv(np.linalg.cholesky(covariance)).T
    between = (vlads.mean(axis=1) - mean) @ whitening
    _, axes = np.linalg.eigh(between.T @ between / len(between))
    projection = whitening @ axes[:, ::-1][:, :dimension]
    return mean.astype(np.float32), projection.astype(np.float32)


def main() -> None:
    """Learn a codebook and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=CODEBOOK_PATH, help="file to write, .npz")
    parser.add_argument("--scenes", type=int, default=SCENES, help="generated scenes")
    parser.add_argument("--seed", type=int, default=1, help="of the generated scenes")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO)
    cv2.setNumThreads(1)
    save_codebook(train(arguments.scenes, arguments.seed), arguments.out)


def _aggregated(patches: Float32, mean: Float32, projection: Float32, words: Float32) -> Float32:
    """VLAD of an image's patches."""
    return vlad(np.asarray((patches - mean) @ projection, np.float32), words)


def _sample(patches: Float32, rng: np.random.Generator) -> Float32:
    """At most `PATCHES_PER_IMAGE` of an image's patches."""
    count = min(len(patches), PATCHES_PER_IMAGE)
    return patches[rng.choice(len(patches), count, replace=False)]


if __name__ == "__main__":
    main()
