"""How well a number tells right registrations from wrong ones: precision and recall over all its thresholds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Precision and recall of accepting what scores at least a threshold.

    Attributes:
        thresholds: (K,) every score that occurs, falling.
        precision: (K,) share of the accepted that is right.
        recall: (K,) share of the right that is accepted, rising to 1.
        right_share: Precision of accepting everything: what a number without any meaning reaches on average.
        roc_auc: Probability that a right one scores higher than a wrong one (a tie counts half).
    """

    thresholds: Float
    precision: Float
    recall: Float
    right_share: float
    roc_auc: float

    @property
    def average_precision(self) -> float:
        """Area under the curve, as a sum of steps of recall."""
        return float(np.sum(np.diff(self.recall, prepend=0.0) * self.precision))

    def best(self) -> int:
        """The threshold with the largest F1, the harmonic mean of precision and recall."""
        return int(np.argmax(self.precision * self.recall / (self.precision + self.recall + 1e-12)))

    def first_with_precision(self, precision_min: float) -> int | None:
        """The lowest threshold with at least this precision, None where there is none."""
        reaching = np.flatnonzero(self.precision >= precision_min)
        return int(reaching[-1]) if len(reaching) else None


def curve(scores: Sequence[float] | Float, right: Sequence[bool] | NDArray[np.bool_]) -> Curve | None:
    """Precision and recall over thresholds; None unless there are right ones and wrong ones.

    Args:
        scores: (N,) larger should mean right.
        right: (N,) whether it is.
    """
    is_right = np.asarray(right, dtype=bool)
    if is_right.all() or not is_right.any():
        return None
    given = np.asarray(scores, dtype=np.float64)
    order = np.argsort(-given, kind="stable")
    last_of_ties = np.append(np.flatnonzero(np.diff(given[order])), len(order) - 1)
    accepted_right = np.cumsum(is_right[order])[last_of_ties].astype(np.float64)
    accepted = last_of_ties + 1.0
    all_right = float(is_right.sum())
    true_positive, false_positive = accepted_right / all_right, (accepted - accepted_right) / (len(order) - all_right)
    return Curve(
        given[order][last_of_ties],
        accepted_right / accepted,
        true_positive,
        all_right / len(order),
        float(np.trapezoid(np.append(0.0, true_positive), np.append(0.0, false_positive))),
    )
