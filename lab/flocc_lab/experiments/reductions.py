"""Smaller forms of descriptors and latents, each as what the receiver would have of it and the bytes that travel."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flocc_protocol.arrays import Array

if TYPE_CHECKING:
    from flocc_agent.perception.classical.features import Features

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

POINT_BYTES, HALF_POINT_BYTES = 8, 4
RANK_RATIO = 1e-6
"""Directions in which samples spread less than this part of their greatest spread are rounding, not data."""


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """Principal directions, learned on data that a deployment has beforehand.

    Attributes:
        mean: (D,) of the training data.
        directions: (K, D) rows of unit length, by falling variance; N samples have at most N - 1.
    """

    mean: Float
    directions: Float

    @classmethod
    def of(cls, samples: NDArray[np.generic]) -> "Basis":
        """Learn from (N, D) samples."""
        data = np.asarray(samples, dtype=np.float64)
        mean = data.mean(axis=0)
        _, spread, directions = np.linalg.svd(data - mean, full_matrices=False)
        return cls(mean, np.asarray(directions[spread > RANK_RATIO * spread[0]]))

    def reduce(self, values: NDArray[np.generic], size: int) -> Float:
        """Coordinates (N, size) of (N, D) values."""
        return np.asarray((np.asarray(values, dtype=np.float64) - self.mean) @ self.directions[:size].T)

    def restore(self, coordinates: Float) -> Float:
        """Values (N, D) of coordinates (N, size)."""
        return np.asarray(coordinates @ self.directions[: coordinates.shape[1]] + self.mean)


def through_int8(values: Float) -> Float:
    """Each row as the wire's int8 array gives it back."""
    return np.array([Array.int8(row).numpy() for row in values]).reshape(values.shape)


def unit(values: NDArray[np.generic]) -> Float:
    """Rows of unit length."""
    data = np.asarray(values, dtype=np.float64)
    return np.asarray(data / np.maximum(np.linalg.norm(data, axis=1, keepdims=True), 1e-12))


def reduced_descriptors(descriptors: Float32, basis: Basis) -> dict[str, tuple[int, Float]]:
    """Forms of descriptors (N, D) of unit length: name -> bytes of one, and (N, D or fewer) to compare by cosine.

    A form is left out where the basis was learned on too few samples to have so many directions.
    """
    dimension = descriptors.shape[1]
    sizes = [size for size in (256, 128, 64, 32) if size < dimension and size <= len(basis.directions)]
    return {
        "fp32": (4 * dimension, unit(descriptors)),
        "fp16": (2 * dimension, unit(descriptors.astype(np.float16))),
        "int8": (dimension, unit(through_int8(descriptors.astype(np.float64)))),
        **{f"pca-{n} int8": (n, unit(through_int8(basis.reduce(descriptors, n)))) for n in sizes},
    }


def keypoint_forms(basis: Basis) -> dict[str, Callable[["Features"], tuple[int, "Features"]]]:
    """Forms of a latent of local features: name -> function to its bytes and to what the receiver has of it."""
    return {
        "all": lambda features: (_bytes(features, POINT_BYTES, 128), features),
        "fp16 points": lambda features: (_bytes(features, HALF_POINT_BYTES, 128), _half_points(features)),
        "half": lambda features: _strongest(features, 2),
        "quarter": lambda features: _strongest(features, 4),
        "pca-64": lambda features: (_bytes(features, POINT_BYTES, 64), _through(basis, features, 64)),
        "pca-32": lambda features: (_bytes(features, POINT_BYTES, 32), _through(basis, features, 32)),
    }


def _bytes(features: "Features", point_bytes: int, descriptor_bytes: int) -> int:
    return len(features.points) * (point_bytes + descriptor_bytes)


def _half_points(features: "Features") -> "Features":
    return replace(features, points=features.points.astype(np.float16).astype(np.float32))


def _strongest(features: "Features", part: int) -> tuple[int, "Features"]:
    kept = len(features.points) // part
    fewer = replace(features, points=features.points[:kept], descriptors=features.descriptors[:kept])
    return _bytes(fewer, POINT_BYTES, 128), fewer


def _through(basis: Basis, features: "Features", size: int) -> "Features":
    """Descriptors sent as coordinates in a basis, one byte each."""
    if not len(features.descriptors):
        return features
    restored = basis.restore(through_int8(basis.reduce(features.descriptors, size)))
    return replace(features, descriptors=np.clip(np.rint(restored), 0, 255).astype(np.uint8))


def latent_forms(latent: Float32) -> dict[str, tuple[int, Float32]]:
    """Forms of a MASt3R latent (S, C): name -> bytes, and the (S, C) float32 that the receiver decodes.

    fp16 and int8 are those of the wire (one scale per channel). rank-K sends the best approximation of the latent by K
    token and channel vectors, found for each latent anew, in fp16. half the tokens: of every two neighbours in a row
    one is sent, in fp16, and stands for both.
    """
    S, C = latent.shape
    u, s, vt = np.linalg.svd(latent.astype(np.float64), full_matrices=False)
    ranks = [rank for rank in (C // 2, C // 4, C // 8) if 0 < rank <= min(S, C)]
    int8_scale = np.maximum(np.abs(latent).max(axis=0) / 127.0, np.finfo(np.float32).tiny)
    return {
        "fp32": (4 * S * C, latent),
        "fp16": (2 * S * C, _half(latent)),
        "int8": (S * C + 4 * C, (np.rint(latent / int8_scale) * int8_scale).astype(np.float32)),
        **{f"rank-{rank}": (2 * rank * (S + C), _half(u[:, :rank] * s[:rank]) @ _half(vt[:rank])) for rank in ranks},
        "half the tokens": (S * C, _half(latent[np.arange(S) // 2 * 2])),
    }


def _half(values: NDArray[np.generic]) -> Float32:
    return values.astype(np.float16).astype(np.float32)
