"""How stiff a robot's graph holds the poses that it shares with another, in few numbers, and the mean of two such.

The penalty between two robots is best the geometric mean of how stiff either holds what they share (optimised Schwarz
methods, Gander 2006: in each direction with stiffnesses `a` and `b`, an exchange leaves `((sqrt a - sqrt b) / (sqrt a +
sqrt b))^2` of an error where the penalty is `sqrt(a b)`), and it must be the same on both sides: then the exchange is
Peaceman and Rachford's splitting (1955), which comes to rest for whatever penalty. A whole Schur complement would take
18 numbers a pair of poses; here the marginal of up to `KNOTS_MAX` of them is whole, and each other pose hangs on its
nearest knot by the marginal between these two.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import coo_array, csc_array

from flocc_agent.geometry import adjoints, inverse, poses_from_tq, quaternions
from flocc_protocol.shared_poses import KNOTS_MAX, stiffness_numbers

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_LOWER_6 = np.tril_indices(6)


@dataclass(frozen=True, slots=True, eq=False)
class SharedStiffness:
    """Information of poses that two robots share, by all that one of them knows but by the other.

    Attributes:
        knots: (6M, 6M) lower Cholesky factor of the information of the knots, in the poses' own tangents, rotation
            first (single precision keeps what a factor says definite, not what its square does).
        ties: (S-M, 6, 6) likewise of each other pose relative to its nearest knot, in the pose's own tangent.
        tied: (S-M, 7) where that pose was, seen from its knot; translation, then quaternion `w x y z`.
    """

    knots: Float
    ties: Float
    tied: Float

    def differs(self, before: "SharedStiffness") -> float:
        """Largest difference of a factor from another one of the same poses, relative to that one."""
        factors = [(self.knots, before.knots), *zip(self.ties, before.ties, strict=True)]
        return max(float(np.linalg.norm(now - then) / np.linalg.norm(then)) for now, then in factors)

    def packed(self) -> Float:
        """Its numbers (N,)."""
        ties = self.ties[:, _LOWER_6[0], _LOWER_6[1]]
        return np.concatenate([self.knots[np.tril_indices(len(self.knots))], ties.ravel(), self.tied.ravel()])

    def told(self, count: int) -> "SharedStiffness":
        """As others read it, who are told it in single precision."""
        return SharedStiffness.unpacked(self.packed().astype(np.float32).astype(float), count)

    @staticmethod
    def unpacked(numbers: Float, count: int) -> "SharedStiffness":
        """Read what `packed` wrote of so many poses.

        Raises:
            ValueError: It is not of so many poses.
        """
        if numbers.shape != (stiffness_numbers(count),):
            raise ValueError(f"{len(numbers)} numbers are not the stiffness of {count} poses")
        M = min(count, KNOTS_MAX)
        knots, ties = np.zeros((6 * M, 6 * M)), np.zeros((count - M, 6, 6))
        whole, end = 3 * M * (6 * M + 1), len(numbers) - 7 * (count - M)
        knots[np.tril_indices(6 * M)] = numbers[:whole]
        ties[:, _LOWER_6[0], _LOWER_6[1]] = numbers[whole:end].reshape(-1, 21)
        return SharedStiffness(knots, ties, numbers[end:].reshape(-1, 7))

    def check(self, count: int) -> None:
        """Refuse what is of another size, not finite or not positive definite.

        Raises:
            ValueError: It is; the sentence says what.
        """
        M = min(count, KNOTS_MAX)
        if (self.knots.shape, len(self.ties), len(self.tied)) != ((6 * M, 6 * M), count - M, count - M):
            raise ValueError(f"the stiffness is not that of {count} poses")
        diagonals = np.concatenate([np.diagonal(self.knots), np.einsum("kaa->ka", self.ties).ravel()])
        finite = all(np.all(np.isfinite(part)) for part in (self.knots, self.ties, self.tied))
        if not finite or not np.all(diagonals > 0) or not np.all(np.linalg.norm(self.tied[:, 3:], axis=1) > 0.5):
            raise ValueError("the stiffness of shared poses is not positive definite")

    def matrix(self) -> csc_array:
        """Information (6S, 6S) of all of them; mostly zero where S is large."""
        count = len(self.knots) // 6 + len(self.ties)
        knots, others, nearest = _knots(count)
        rows = rows_of(knots)
        both = (6 * np.stack([nearest, others], axis=1)[:, :, None] + np.arange(6)).reshape(len(others), 12)
        factors = np.swapaxes(_tie_jacobians(self.tied), 1, 2) @ self.ties
        values = np.concatenate([(self.knots @ self.knots.T).ravel(), (factors @ np.swapaxes(factors, 1, 2)).ravel()])
        i = np.concatenate([np.repeat(rows, len(rows)), np.repeat(both, 12, axis=1).ravel()])
        j = np.concatenate([np.tile(rows, len(rows)), np.tile(both, (1, 12)).ravel()])
        return csc_array(coo_array((values, (i, j)), shape=(6 * count, 6 * count)))


def stiffness_of(covariance: Float, T: Float) -> SharedStiffness:
    """In short what the covariance (6S, 6S) of poses at `T` (S, 4, 4) says."""
    knots, others, nearest = _knots(len(T))
    rows = rows_of(knots)
    T_knot_pose = inverse(T[nearest]) @ T[others]
    tied = np.concatenate([T_knot_pose[:, :3, 3], quaternions(T_knot_pose[:, :3, :3])], axis=1)
    ties = np.empty((len(others), 6, 6))
    for n, (k, q, difference) in enumerate(zip(others, nearest, _tie_jacobians(tied), strict=True)):
        both = rows_of(np.array([q, k]))
        ties[n] = _information_factor(difference @ covariance[np.ix_(both, both)] @ difference.T)
    return SharedStiffness(_information_factor(covariance[np.ix_(rows, rows)]), ties, tied)


def geometric_mean(lower: SharedStiffness, higher: SharedStiffness) -> SharedStiffness:
    """Of two robots' stiffnesses of the same poses, part by part; poses are tied where the lower one has them."""
    ties = [_mean_factor(a, b) for a, b in zip(lower.ties, higher.ties, strict=True)]
    knots = _mean_factor(lower.knots, higher.knots)
    return SharedStiffness(knots, np.array(ties).reshape(lower.ties.shape), lower.tied)


def _tie_jacobians(tied: Float) -> Float:
    """Jacobians (K, 6, 12) of a pose relative to its knot by the tangents of both, rotation first."""
    back = adjoints(inverse(poses_from_tq(tied)))
    return np.concatenate([-back, np.broadcast_to(np.eye(6), back.shape)], axis=2)


def _knots(count: int) -> tuple[Int, Int, Int]:
    """Which of so many poses are knots, which are not, and the nearest knot of each of those."""
    knots = np.round(np.linspace(0, count - 1, min(count, KNOTS_MAX))).astype(np.int64)
    others = np.setdiff1d(np.arange(count), knots)
    nearest = knots[np.argmin(np.abs(others[:, None] - knots), axis=1)] if len(others) else others
    return knots, others, nearest


def rows_of(poses: Int) -> Int:
    """Rows (6S,) of poses among variables of six numbers each."""
    return (6 * poses[:, None] + np.arange(6)).ravel()


def _information_factor(covariance: Float) -> Float:
    """Lower Cholesky factor of the inverse of a covariance."""
    backwards = np.linalg.cholesky(0.5 * (covariance + covariance.T)[::-1, ::-1])
    return np.ascontiguousarray(solve_triangular(backwards, np.eye(len(backwards)), lower=True).T[::-1, ::-1])


def _mean_factor(L: Float, M: Float) -> Float:
    """Lower Cholesky factor of the geometric mean of `L L^T` and `M M^T` (Pusz and Woronowicz 1975)."""
    U, roots, _ = np.linalg.svd(solve_triangular(L, M, lower=True))
    R = np.linalg.qr((L @ U * np.sqrt(roots)).T, mode="r")
    return np.ascontiguousarray((np.sign(np.diagonal(R))[:, None] * R).T)
