"""Learn the logistic of Eq. (2), which maps a match ratio to the probability that a registration is right."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar

Float = NDArray[np.float64]

STEEPNESS_MIN, STEEPNESS_MAX = 1e-3, 1e3


@dataclass(frozen=True, slots=True)
class LogisticFit:
    """Maximum-likelihood logistics of one set of registrations.

    Attributes:
        steepness: k of Eq. (2), whose probability is one half at a ratio of 1; None where no positive k beats k = 0, so
            that the data contradict Eq. (2)'s midpoint.
        log_loss: Mean negative log-likelihood with it; of k = 0 (that is log 2) where there is none.
        free_steepness: k of a logistic whose midpoint is fitted too.
        free_midpoint: Ratio at which that one is one half; None where it does not rise.
        free_log_loss: Its mean negative log-likelihood.
        pairs: Registrations.
        right: Those that are right.
    """

    steepness: float | None
    log_loss: float
    free_steepness: float
    free_midpoint: float | None
    free_log_loss: float
    pairs: int
    right: int


def fit_logistic(ratios: Sequence[float], right: Sequence[bool]) -> LogisticFit | None:
    """Fit Eq. (2) to registrations; None unless there are right ones and wrong ones.

    Args:
        ratios: (N,) match ratios, Eq. (1).
        right: (N,) whether the registration is.
    """
    r, y = np.asarray(ratios, dtype=np.float64), np.asarray(right, dtype=np.float64)
    if not 0.0 < y.sum() < len(y):
        return None
    steepness = _steepness(r - 1.0, y)
    loss = log_loss(0.0 if steepness is None else steepness, 1.0, r, y)
    slope, offset = minimize(_loss_and_gradient, np.array([1.0, 0.0]), args=(r, y), jac=True, method="BFGS").x
    midpoint = float(-offset / slope) if slope > 0 else None
    free_loss, _ = _loss_and_gradient(np.array([slope, offset]), r, y)
    return LogisticFit(steepness, loss, float(slope), midpoint, free_loss, len(y), int(y.sum()))


def log_loss(steepness: float, midpoint: float, ratios: Float, right: Float) -> float:
    """Mean negative log-likelihood of a logistic."""
    return _loss_and_gradient(np.array([steepness, -steepness * midpoint]), ratios, right)[0]


def _steepness(x: Float, y: Float) -> float | None:
    """The k > 0 with the largest likelihood, None where the likelihood falls from k = 0 on (it is concave in k)."""
    if float(np.sum((y - 0.5) * x)) <= 0.0:
        return None
    found = minimize_scalar(
        lambda log_k: log_loss(float(np.exp(log_k)), 0.0, x, y),
        bounds=(np.log(STEEPNESS_MIN), np.log(STEEPNESS_MAX)),
        method="bounded",
        options={"xatol": 1e-6},
    )
    return float(np.exp(found.x))


def _loss_and_gradient(parameters: Float, r: Float, y: Float) -> tuple[float, Float]:
    """Mean of log(1 + exp(-s z)), z = slope r + offset, s = +1 for the right and -1 for the wrong ones."""
    z = parameters[0] * r + parameters[1]
    loss = float(np.mean(np.logaddexp(0.0, z) - y * z))
    residual = 1.0 / (1.0 + np.exp(-np.clip(z, -60.0, 60.0))) - y
    return loss, np.array([np.mean(residual * r), np.mean(residual)])
