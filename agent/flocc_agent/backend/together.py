"""What several closures say together of where one keyframe is from another, free lengths and all.

One closure without a length leaves its direction open, and a false one then agrees with nearly anything. Several whose
directions differ fix the place: their predictions are fused, each with a covariance that is wide along what it leaves
open. They count where most of them agree with what comes out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

OPEN_INFORMATION = 1e-8
"""Of a place that is anywhere within ten kilometres, 1/m^2."""
FIXED_M = 1e-6
AGREEING_MIN = 3
AGREEING_RATIO = 0.75
"""So many of the predictions, and this part of them, must agree with what they say together."""


@dataclass(frozen=True, slots=True, eq=False)
class Predictions:
    """Poses that P closures each predict for K keyframes, seen from others.

    Attributes:
        R: (K, P, 3, 3) rotation.
        t: (K, P, 3) translation, m.
        rotation: (K, P) variance, rad^2.
        covariance: (K, P, 3, 3) of the translation, m^2, wide along free lengths.
        least: (K, P) variance of the translation without its free lengths, m^2.
        there: (K, P) whether there is such a prediction.
    """

    R: Float
    t: Float
    rotation: Float
    covariance: Float
    least: Float
    there: Bool

    @classmethod
    def none(cls, keyframes: int, count: int) -> "Predictions":
        """Room for so many, of which there is none."""
        shape = (keyframes, count)
        eye = np.broadcast_to(np.eye(3), (*shape, 3, 3))
        return cls(
            eye.copy(), np.zeros((*shape, 3)), np.ones(shape), eye.copy(), np.ones(shape), np.zeros(shape, dtype=bool)
        )


def side_by_side(parts: Sequence[Predictions]) -> Predictions:
    """All predictions for the same keyframes."""
    return Predictions(
        *(np.concatenate([getattr(part, f.name) for part in parts], axis=1) for f in fields(Predictions))
    )


@dataclass(frozen=True, slots=True, eq=False)
class Together:
    """What predictions say together, (K,): pose, variance of rotation, covariance of translation, whether it counts."""

    R: Float
    t: Float
    rotation: Float
    covariance: Float
    counts: Bool


def together(said: Predictions, bound: float) -> Together:
    """Fuse predictions; once more without those that disagree, beyond a squared difference of `bound`."""
    rows = np.arange(len(said.t))
    surest = np.argmin(np.where(said.there, said.rotation, np.inf), axis=1)
    R, rotation = said.R[rows, surest], said.rotation[rows, surest]
    cosine = 0.5 * (np.einsum("kpij,kij->kp", said.R, R) - 1.0)
    turned = np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2 / (said.rotation + rotation[:, None])
    agreeing = said.there & (turned <= bound)
    information = np.asarray(np.linalg.inv(said.covariance), dtype=np.float64)
    squared = turned
    for _ in range(2):
        t, covariance = _fused(said.t, information, agreeing)
        off = said.t - t[:, None]
        squared = turned + np.einsum("kpi,kpij,kpj->kp", off, information, off)
        agreeing = said.there & (squared <= bound)
    t, covariance = _fused(said.t, information, agreeing)
    shared = np.min(np.where(agreeing, said.least, np.inf), axis=1)
    count, of = agreeing.sum(axis=1), said.there.sum(axis=1)
    counts = (count >= AGREEING_MIN) & (count >= AGREEING_RATIO * of)
    shared = np.where(counts, shared, 0.0)
    return Together(R, t, rotation, covariance + shared[:, None, None] * np.eye(3), counts)


def _fused(t: Float, information: Float, taken: Bool) -> tuple[Float, Float]:
    """Mean (K, 3) and covariance (K, 3, 3) of predictions; what none of those taken tells stays wide open."""
    of_taken = np.where(taken[:, :, None, None], information, 0.0)
    covariance = np.linalg.inv(of_taken.sum(axis=1) + OPEN_INFORMATION * np.eye(3))
    weighted = np.einsum("kpij,kpj->ki", of_taken, t)
    return np.einsum("kij,kj->ki", covariance, weighted), covariance


def along(u: Float, sigma_m: Float) -> Float:
    """Covariance (..., 3, 3) of a length with a direction (..., 3) and a standard deviation (...)."""
    spread = sigma_m[..., None] * u
    return np.asarray(spread[..., :, None] * spread[..., None, :])


def with_length(
    off: Float, covariance: Float, u: Float, sigma_m: Float, shorter_max_m: Float
) -> tuple[Float, Float, Float]:
    """Squared difference (K,) of translations where lengths change by what fits best.

    Args:
        off: (K, 3) predicted minus measured.
        covariance: (K, 3, 3) of that, without the free length.
        u: (K, 3) direction of the measured translation.
        sigma_m: (K,) standard deviation of its length; 0 where it is known.
        shorter_max_m: (K,) by how much it may become shorter.

    Returns:
        The squared difference, by how much it is larger because of that bound, and the change (K,).
    """
    information, prior = np.linalg.inv(covariance), 1.0 / np.maximum(sigma_m, FIXED_M) ** 2
    towards = np.einsum("ki,kij->kj", u, information)
    stiffness = np.einsum("kj,kj->k", towards, u) + prior
    free = np.einsum("kj,kj->k", towards, off) / stiffness
    change = np.maximum(free, -shorter_max_m)
    left = off - change[:, None] * u
    squared = np.einsum("ki,kij,kj->k", left, information, left) + prior * change**2
    return squared, stiffness * (change - free) ** 2, change
