"""Learn a codebook from generated pictures: `python -m flocc_agent.perception.learned.keypoint_training MODEL`.

The files in the package were made with the defaults; no photograph took part. A minute with XFeat, four with ALIKED.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from flocc_agent.perception.classical.procedural import random_scene, random_view
from flocc_agent.perception.classical.training import clustered
from flocc_agent.perception.learned.keypoint_codebook import LearnedCodebook, codebook_path
from flocc_agent.perception.learned.networks import VARIANTS, Networks
from flocc_agent.perception.learned.weight_sources import weights_folder

Float32 = NDArray[np.float32]

WORDS = 16
COMPONENTS = 32
PICTURES = 100
FEATURES_PER_PICTURE = 300
"""The strongest features of a picture that take part."""


def train(networks: Networks, pictures: int, seed: int) -> LearnedCodebook:
    """Learn a codebook from generated pictures."""
    rng = np.random.default_rng(seed)
    sample = np.concatenate([_strongest(networks, rng) for _ in range(pictures)])
    mean = sample.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((sample - mean).T))
    projection = axes[:, ::-1][:, :COMPONENTS].astype(np.float32)
    words = clustered(np.asarray((sample - mean) @ projection, np.float32), WORDS, rng)
    return LearnedCodebook(mean.astype(np.float32), projection, words)


def _strongest(networks: Networks, rng: np.random.Generator) -> Float32:
    grey = random_view(random_scene(rng), rng)
    return networks.detect(np.repeat(grey[:, :, None], 3, axis=2))[1][:FEATURES_PER_PICTURE]


def save_codebook(codebook: LearnedCodebook, path: Path) -> None:
    """Write a codebook."""
    np.savez_compressed(path, mean=codebook.mean, projection=codebook.projection, words=codebook.words)


def main() -> None:
    """Learn a model's codebook and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", choices=sorted(VARIANTS))
    parser.add_argument("--out", type=Path, help="file to write, .npz; the package's without")
    parser.add_argument("--pictures", type=int, default=PICTURES, help="generated pictures")
    parser.add_argument("--seed", type=int, default=1, help="of the generated pictures")
    arguments = parser.parse_args()
    networks = Networks(VARIANTS[arguments.model], weights_folder(), torch.device("cpu"))
    codebook = train(networks, arguments.pictures, arguments.seed)
    save_codebook(codebook, arguments.out or codebook_path(arguments.model))


if __name__ == "__main__":
    main()
