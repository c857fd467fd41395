"""Registration of a candidate pair: its result, and the paper's Eqs. (1), (2) and (6)."""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from flocc_protocol.ids import INDEX_MAX

Float = NDArray[np.float64]

ODOMETRY_CORRESPONDENCES_MIN = 20
"""Least denominator of Eq. (1): else a blurred odometry pair would make every loop look certain."""
ODOMETRY_TRANSLATION_UNSCALED_MIN = 1e-6


def match_ratio(loop_correspondences: int, odometry_correspondences: int) -> float:
    """Correspondences of the loop pair over those of the odometry pair, Eq. (1).

    A smaller denominator than `ODOMETRY_CORRESPONDENCES_MIN` is raised to it. Whoever shows or weighs a ratio takes it
    from here, so that a person reads the number that was compared with R_thr.

    Args:
        loop_correspondences: Count for (query i, match j); >= 0.
        odometry_correspondences: Count for (query i-1, query i); >= 0.

    Returns:
        The ratio, >= 0.

    Raises:
        ValueError: A count is negative.
    """
    if loop_correspondences < 0 or odometry_correspondences < 0:
        raise ValueError("counts of correspondences must not be negative")
    return loop_correspondences / max(odometry_correspondences, ODOMETRY_CORRESPONDENCES_MIN)


def closure_probability(ratio: float, steepness: float) -> float:
    """Map a match ratio to the probability that a loop closure is correct, Eq. (2).

    Args:
        ratio: Loop-pair matches over odometry-pair matches, Eq. (1); >= 0.
        steepness: k of the logistic; larger trusts good ratios more.

    Returns:
        Probability in (0, 1); 0.5 at a ratio of 1.

    Raises:
        ValueError: The ratio is negative or not finite.
    """
    if not math.isfinite(ratio) or ratio < 0:
        raise ValueError(f"match ratio {ratio} must be finite and not negative")
    x = min(max(steepness * (ratio - 1.0), -60.0), 60.0)
    return 1.0 / (1.0 + math.exp(-x))


def odometry_scale(t_odometry_m: Float, t_odometry_unscaled: Float) -> float | None:
    """Metres per network unit from the odometry pair, the factor of Eq. (6).

    Args:
        t_odometry_m: (3,) translation of the odometry pair from odometry, metres.
        t_odometry_unscaled: (3,) the same translation from registration, network units.

    Returns:
        The factor, > 0, or None where the pair gives no scale (no motion, or nothing measured).
    """
    measured = float(np.linalg.norm(t_odometry_unscaled))
    metric = float(np.linalg.norm(t_odometry_m))
    if not (math.isfinite(measured) and math.isfinite(metric)):
        return None
    if measured < ODOMETRY_TRANSLATION_UNSCALED_MIN or metric <= 0.0:
        return None
    return metric / measured


class RegistrationFailure(Enum):
    """Why a pair of latents gave no relative pose."""

    FEW_CORRESPONDENCES = "few correspondences"
    NO_MODEL = "no relative pose fits the correspondences"
    DEGENERATE = "the correspondences do not fix a relative pose"
    UNCONVINCING = "less evidence than the front end's wrong pairs may have"
    BAD_LATENT = "a latent is damaged or of another model"
    OTHER_FRONT_END = "the latents are of different front ends"
    OUT_OF_MEMORY = "out of memory"
    CRASHED = "the registration failed with an internal error"


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """What registering (query, match) gave.

    Attributes:
        T_query_match_unscaled: (4, 4) pose of the match camera in the query camera; its translation is in
            network units (for a two-view method: any length, made comparable with `scale_initial`).
        correspondences: Verified correspondences of the loop pair, the numerator of Eq. (1).
        odometry_correspondences: The same count for the odometry pair of the query, the denominator of Eq. (1).
        scale_initial: Metres per network unit by Eq. (6); None where the odometry pair gave none.
        covariance: (6, 6) covariance (rotation rad, translation in network units) in the tangent space of the
            match, or None where the method gives none.
        confidence: Mean confidence that the network gives the loop pair's points; None of other methods.
        odometry_confidence: The same of the odometry pair.
        judged_ratio: Evidence over what its front end's own rule asks, >= 1, where that accepted it; it then takes the
            place of Eq. (1), so that R_thr does not decide and weights do not depend on how dense keyframes are.
    """

    T_query_match_unscaled: Float
    correspondences: int
    odometry_correspondences: int
    scale_initial: float | None
    covariance: Float | None = None
    confidence: float | None = None
    odometry_confidence: float | None = None
    judged_ratio: float | None = None

    def __post_init__(self) -> None:
        _check_counts(self.correspondences, self.odometry_correspondences)
        covariance = np.eye(6) if self.covariance is None else self.covariance
        if not _is_matrix(self.T_query_match_unscaled, 4) or not _is_matrix(covariance, 6):
            raise ValueError("a registration has a pose (4, 4) and a covariance (6, 6) or None, arrays of numbers")
        for number in (self.scale_initial, self.judged_ratio):
            if not isinstance(number, float | int | np.number | None):
                raise ValueError(f"scale and ratio of a registration are numbers or None, not {number!r}")


@dataclass(frozen=True, slots=True)
class RegistrationFailed:
    """Registration came to an end without a relative pose.

    Attributes:
        failure: The kind of failure.
        detail: One sentence for people.
        correspondences: How many there were.
        odometry_correspondences: Count of the odometry pair where it was computed.
    """

    failure: RegistrationFailure
    detail: str = ""
    correspondences: int = 0
    odometry_correspondences: int = 0

    def __post_init__(self) -> None:
        _check_counts(self.correspondences, self.odometry_correspondences)
        if not isinstance(self.failure, RegistrationFailure):
            raise ValueError(f"{self.failure!r} is no RegistrationFailure")


def _is_matrix(value: object, side: int) -> bool:
    return isinstance(value, np.ndarray) and value.shape == (side, side) and value.dtype.kind in "fiu"


def _check_counts(*counts: int) -> None:
    if any(not isinstance(count, int | np.integer) or not 0 <= count <= INDEX_MAX for count in counts):
        raise ValueError(f"counts of correspondences are whole numbers from 0 to {INDEX_MAX}, not {counts}")
