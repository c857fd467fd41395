"""Keyed random weights: every tensor is a pure function of a seed, its name and its shape.

They stand in for the official checkpoints, which this project neither holds nor fetches: exactness is shown with
them, and tests run the whole path on them.
"""

import hashlib
import re

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

MAST3R_SEED = 20240
COSPLACE_SEED = 19

_ALIAS = re.compile(r"\.scratch\.layer_rn\.(\d)\.")


def canonical(key: str) -> str:
    """One name for the convolutions that the checkpoint lists twice: `layer_rn.0` is `layer1_rn`."""
    return _ALIAS.sub(lambda found: f".scratch.layer{int(found[1]) + 1}_rn.", key)


def keyed_normal(seed: int, key: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Standard normal numbers of a name, the same on every machine."""
    digest = hashlib.sha256(f"{seed}|{canonical(key)}".encode()).digest()
    generator = np.random.Generator(np.random.PCG64(int.from_bytes(digest[:16], "little")))
    return generator.standard_normal(shape, dtype=np.float32)


def keyed_weight(seed: int, key: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """A parameter or buffer, scaled so that activations neither vanish nor explode."""
    n = keyed_normal(seed, key, shape)
    if key.endswith(("bias", "running_mean")) or key == "mask_token":
        return np.float32(0.1) * n
    if key.endswith("running_var"):
        return np.float32(1) + np.float32(0.5) * np.abs(n)
    if key.endswith("aggregation.1.p"):
        return np.float32(3) + np.float32(0.1) * n
    if len(shape) == 1:
        return np.float32(1) + np.float32(0.1) * n
    if key.endswith("dpt.head.4.weight"):
        return n * np.float32(0.15 / np.sqrt(np.prod(shape[1:])))
    if re.search(r"act_postprocess\.[01]\.1\.weight$", key):
        return n * np.float32(1 / np.sqrt(shape[0]))
    return n * np.float32(1 / np.sqrt(np.prod(shape[1:])))


def keyed_state(module: nn.Module, seed: int) -> dict[str, Tensor]:
    """A complete state for a module (which may be on the meta device); aliases share their tensor."""
    state: dict[str, Tensor] = {}
    shared: dict[str, Tensor] = {}
    for key, like in module.state_dict().items():
        if key.endswith("num_batches_tracked"):
            state[key] = torch.zeros((), dtype=torch.int64)
            continue
        name = canonical(key)
        if name not in shared:
            shared[name] = torch.from_numpy(keyed_weight(seed, key, tuple(like.shape)))
        state[key] = shared[name]
    return state


def keyed_image(seed: int, key: str, batch: int, height: int, width: int) -> NDArray[np.float32]:
    """A smooth picture with noise, (batch, 3, height, width) in [-1, 1]."""
    x = np.arange(width, dtype=np.float32)[None, :]
    y = np.arange(height, dtype=np.float32)[:, None]
    base = np.stack([np.sin(x / 17 + c) * np.cos(y / 23 - c) for c in range(3)])
    noise = keyed_normal(seed, key, (batch, 3, height, width))
    image = np.float32(0.6) * base + np.float32(0.25) * noise
    return np.clip(image, -1, 1).astype(np.float32)
