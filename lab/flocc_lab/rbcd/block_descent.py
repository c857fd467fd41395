"""Riemannian block-coordinate descent: one robot's part of a distributed pose-graph optimisation.

After Tian et al. 2021 (Distributed Certifiably Correct Pose-Graph Optimization) and Tian et al. 2022 (Kimera-Multi):
rotations are relaxed to orthonormal 3-frames in r dimensions, so that a pose is `X = [Y p]`, Y in St(3, r), p in R^r,
and an edge costs `kappa |Y_j - Y_i R|^2 + tau |p_j - p_i - Y_i t|^2`. With the poses of other robots held fixed, a
robot's block is a quadratic form on a product of manifolds. It is descended by Riemannian trust regions: truncated
conjugate gradients, preconditioned with the block's own sparse factorised quadratic form.

Arrays hold transposed poses, (n, 4, r): three rows of Y^T, then p^T. Scales are constants here: RBCD knows none.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

Float = NDArray[np.float64]
Int = NDArray[np.int64]

REGULARISATION_RATIO = 1e-9
FACTORS_MAX = 32
RADIUS_FACTOR = 2.0
GRADIENT_RATIO = 0.05
ACCEPT_RATIO = 0.1
REJECTIONS_MAX = 12


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Measurements that concern a block; each has at least one end in it.

    Attributes:
        i: (E,) index of the first pose in the block, or -1 where it belongs to another robot.
        j: (E,) the same for the second pose.
        T: (E, 4, 4) measured pose of the second in the first, metric.
        kappa: (E,) weight of the rotation, weight of the robust loop included.
        tau: (E,) weight of the translation, likewise.
        fixed: (E, 4, r) the other robot's pose, where there is one.
    """

    i: Int
    j: Int
    T: Float
    kappa: Float
    tau: Float
    fixed: Float


def lifted(T: Float, rank: int) -> Float:
    """Poses (n, 4, 4) as (n, 4, r): the first three of r dimensions are the frame's own."""
    X = np.zeros((len(T), 4, rank))
    X[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
    X[:, 3, :3] = T[:, :3, 3]
    return X


def composed(origin: Float, T: Float) -> Float:
    """Poses (n, 4, 4) in a frame that lies at a lifted pose (4, r), as (n, 4, r)."""
    return np.asarray(np.swapaxes(T, -1, -2) @ origin)


def rounded(X: Float, origin: Float) -> Float:
    """Nearest poses (n, 4, 4), in the frame that lies at a lifted pose (4, r), to lifted ones."""
    T = np.zeros((len(X), 4, 4))
    U, _, Vt = np.linalg.svd(origin[:3] @ np.swapaxes(X[:, :3], 1, 2))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    T[:, :3, :3] = U @ Vt
    T[:, :3, 3] = (X[:, 3] - origin[3]) @ origin[:3].T
    T[:, 3, 3] = 1.0
    return T


def orthonormal(Y: Float) -> Float:
    """Nearest orthonormal frames (n, 3, r), rows orthonormal: the polar retraction."""
    values, vectors = np.linalg.eigh(Y @ np.swapaxes(Y, 1, 2))
    inverse_root = (vectors / np.sqrt(np.maximum(values, 1e-12))[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return np.asarray(inverse_root @ Y)


def squared_residuals(X_i: Float, X_j: Float, T: Float, kappa: Float, tau: Float) -> Float:
    """Cost (E,) of edges between lifted poses (E, 4, r): `kappa |Y_j - Y_i R|^2 + tau |p_j - p_i - Y_i t|^2`."""
    e = X_j - np.swapaxes(T, 1, 2) @ X_i
    return np.asarray(kappa * np.sum(e[:, :3] ** 2, axis=(1, 2)) + tau * np.sum(e[:, 3] ** 2, axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Stiffness:
    """Quadratic part of a block, with its factorisation; the same as long as measurements and weights are."""

    Q: csc_array
    factor: SuperLU


class Block:
    """The quadratic form `f(X) = <X, Q X> / 2 + <X, G> + constant` of one robot's poses, half the sum of edge costs."""

    def __init__(self, poses: int, links: Links) -> None:
        self.poses = poses
        self.rank = links.fixed.shape[2]
        values = (links.i, links.j, links.T, links.kappa, links.tau)
        stiffness = _stiffness(poses, *(np.ascontiguousarray(each).tobytes() for each in values))
        self._Q, self._factor = stiffness.Q, stiffness.factor
        self._G, self._constant = _linear(poses, links)

    def cost(self, X: Float) -> float:
        """Half the sum of the edges' costs."""
        x = self._flat(X)
        return float(np.sum(x * (0.5 * (self._Q @ x) + self._G)) + self._constant)

    def gradient(self, X: Float) -> Float:
        """Riemannian gradient (n, 4, r)."""
        return projected(X, self._euclidean(X))

    def _flat(self, X: Float) -> Float:
        return X.reshape(4 * self.poses, self.rank)

    def _euclidean(self, X: Float) -> Float:
        return np.asarray(self._Q @ self._flat(X) + self._G).reshape(X.shape)

    def hessian(self, X: Float, S: Float, V: Float) -> Float:
        """Riemannian Hessian at X along V; S (n, 3, 3) is the symmetric part of gradient times frame."""
        H = np.asarray(self._Q @ self._flat(V)).reshape(V.shape)
        H[:, :3] -= S @ V[:, :3]
        return projected(X, H)

    def preconditioned(self, X: Float, V: Float) -> Float:
        """Approximate inverse Hessian along V."""
        return projected(X, self._factor.solve(self._flat(V)).reshape(V.shape))

    def curvature(self, X: Float) -> Float:
        """S (n, 3, 3) of `hessian`."""
        S = self._euclidean(X)[:, :3] @ np.swapaxes(X[:, :3], 1, 2)
        return 0.5 * (S + np.swapaxes(S, 1, 2))


@lru_cache(maxsize=FACTORS_MAX)
def _stiffness(poses: int, i: bytes, j: bytes, T: bytes, kappa: bytes, tau: bytes) -> Stiffness:
    """Q (4n, 4n) and its factors, of arrays as bytes: they are the same in most iterations."""
    shaped = np.frombuffer(T).reshape(-1, 4, 4)
    Omega = _weights(np.frombuffer(kappa), np.frombuffer(tau))
    Q = _quadratic(poses, np.frombuffer(i, dtype=np.int64), np.frombuffer(j, dtype=np.int64), shaped, Omega)
    diagonal = Q.diagonal()
    shift = diags_array(np.full(len(diagonal), REGULARISATION_RATIO * float(diagonal.mean()) or 1.0))
    factor = splu(
        csc_array(Q + shift), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return Stiffness(Q, factor)


def _weights(kappa: Float, tau: Float) -> Float:
    """Diagonal weights (E, 4, 4) of rotation columns and translation."""
    Omega = np.zeros((len(kappa), 4, 4))
    Omega[:, [0, 1, 2], [0, 1, 2]] = kappa[:, None]
    Omega[:, 3, 3] = tau
    return Omega


def _quadratic(poses: int, i: Int, j: Int, T: Float, Omega: Float) -> csc_array:
    """Q (4n, 4n): with `X_j - X_i T` as the error, `T Omega T^T`, `Omega` and `-T Omega` are its blocks."""
    first, second = i >= 0, j >= 0
    both = first & second
    coupling = -(T @ Omega)[both]
    parts = [
        (i[first], i[first], (T @ Omega @ np.swapaxes(T, 1, 2))[first]),
        (j[second], j[second], Omega[second]),
        (i[both], j[both], coupling),
        (j[both], i[both], np.swapaxes(coupling, 1, 2)),
    ]
    rows = np.concatenate([np.repeat(4 * a[:, None] + np.arange(4), 4, axis=1).ravel() for a, _, _ in parts])
    columns = np.concatenate([np.tile(4 * b[:, None] + np.arange(4), (1, 4)).ravel() for _, b, _ in parts])
    values = np.concatenate([block.ravel() for _, _, block in parts])
    return csc_array(coo_array((values, (rows, columns)), shape=(4 * poses, 4 * poses)))


def _linear(poses: int, links: Links) -> tuple[Float, float]:
    """G (4n, r) and the constant of a block, from the poses of others."""
    Omega = _weights(links.kappa, links.tau)
    G = np.zeros((poses, 4, links.fixed.shape[2]))
    constant = 0.0
    only_i, only_j = (links.i >= 0) & (links.j < 0), (links.j >= 0) & (links.i < 0)
    T, W, X = links.T[only_i], Omega[only_i], links.fixed[only_i]
    np.add.at(G, links.i[only_i], -T @ W @ X)
    constant += float(np.sum(X * (W @ X)))
    T, W, X = links.T[only_j], Omega[only_j], links.fixed[only_j]
    moved = np.swapaxes(T, 1, 2) @ X
    np.add.at(G, links.j[only_j], -W @ moved)
    constant += float(np.sum(moved * (W @ moved)))
    return G.reshape(4 * poses, -1), 0.5 * constant


def projected(X: Float, V: Float) -> Float:
    """Project (n, 4, r) onto the tangent space at X."""
    out = V.copy()
    S = V[:, :3] @ np.swapaxes(X[:, :3], 1, 2)
    out[:, :3] -= 0.5 * (S + np.swapaxes(S, 1, 2)) @ X[:, :3]
    return out


def retracted(X: Float, V: Float) -> Float:
    """Move along a tangent vector and back onto the manifold."""
    out = X + V
    out[:, :3] = orthonormal(out[:, :3])
    return out


@dataclass(frozen=True, slots=True)
class Descended:
    """A block after some trust-region steps.

    Attributes:
        X: (n, 4, r) the new poses.
        cost: Half the sum of edge costs there.
        gradient_norm: Norm of the Riemannian gradient where it stopped.
        steps: Accepted steps.
    """

    X: Float
    cost: float
    gradient_norm: float
    steps: int


def descend(block: Block, X: Float, steps_max: int, inner_max: int, tolerance: float) -> Descended:
    """Riemannian trust-region descent of a block (Absil et al. 2007), for at most so many steps.

    Args:
        block: The quadratic form.
        X: (n, 4, r) start.
        steps_max: Trust-region steps, accepted or not.
        inner_max: Conjugate-gradient iterations per step.
        tolerance: Stop when a step lowers the cost by less than this part of it.
    """
    cost, steps, gradient = block.cost(X), 0, block.gradient(X)
    radius = RADIUS_FACTOR * float(np.sqrt(np.sum(gradient * block.preconditioned(X, gradient))))
    for _ in range(steps_max + REJECTIONS_MAX):
        V, at_boundary, predicted = _truncated_cg(block, X, gradient, radius, inner_max)
        candidate = retracted(X, V)
        there = block.cost(candidate)
        ratio = (cost - there) / max(predicted, 1e-300)
        if cost - there <= 0 or ratio < ACCEPT_RATIO:
            if predicted <= tolerance * abs(cost):
                break
            radius *= 0.25
            continue
        if ratio > 0.75 and at_boundary:
            radius *= 2.0
        decrease, X, cost, steps = cost - there, candidate, there, steps + 1
        gradient = block.gradient(X)
        if decrease <= tolerance * abs(cost) or steps >= steps_max:
            break
    return Descended(X, cost, float(np.linalg.norm(gradient)), steps)


def _truncated_cg(block: Block, X: Float, gradient: Float, radius: float, inner_max: int) -> tuple[Float, bool, float]:
    """Steihaug-Toint: a tangent vector within the radius (in the preconditioner's norm) that lowers the model."""
    S = block.curvature(X)
    V, HV = np.zeros_like(X), np.zeros_like(X)
    r = gradient
    z = block.preconditioned(X, r)
    d, rz = -z, float(np.sum(r * z))
    start = np.sqrt(max(rz, 0.0))
    vMv = vMd = 0.0
    dMd = rz
    for _ in range(inner_max):
        Hd = block.hessian(X, S, d)
        dHd = float(np.sum(d * Hd))
        alpha = rz / dHd if dHd > 0 else np.inf
        beyond = vMv + 2 * alpha * vMd + alpha**2 * dMd if np.isfinite(alpha) else np.inf
        if dHd <= 0 or beyond >= radius**2:
            s = (-vMd + np.sqrt(max(vMd**2 + dMd * (radius**2 - vMv), 0.0))) / max(dMd, 1e-300)
            V, HV = V + s * d, HV + s * Hd
            return V, True, -float(np.sum(gradient * V) + 0.5 * np.sum(V * HV))
        V, HV = V + alpha * d, HV + alpha * Hd
        r = r + alpha * Hd
        z = block.preconditioned(X, r)
        rz_next = float(np.sum(r * z))
        vMv = beyond
        if np.sqrt(max(rz_next, 0.0)) <= GRADIENT_RATIO * start:
            break
        beta = rz_next / rz
        vMd = beta * (vMd + alpha * dMd)
        dMd = rz_next + beta**2 * dMd
        d, rz = -z + beta * d, rz_next
    return V, False, -float(np.sum(gradient * V) + 0.5 * np.sum(V * HV))
