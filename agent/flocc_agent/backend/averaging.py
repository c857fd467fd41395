"""A start for graphs whose odometry is too far off: rotations averaged over all edges, then positions.

Carlone et al. 2015: the relaxation that forgets that rotations are orthonormal is linear, and its rows do not mix, so
that one matrix of three unknowns per pose serves all three; so do positions, given rotations, one unknown per pose.
Every edge counts alike.
"""

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from flocc_agent.backend.edges import Edges, State
from flocc_agent.backend.rotations import matrices
from flocc_agent.geometry import quaternions

Float = NDArray[np.float64]
Int = NDArray[np.int64]

POLAR_STEPS_MAX = 20
POLAR_TOLERANCE = 1e-12
DETERMINANT_MIN = 1e-3
"""Below, Newton's steps to the nearest rotation are many, or end in a reflection."""


def averaged(edges: Edges, state: State, fixed: int) -> State | None:
    """Poses of averaged rotations, the fixed one where it is; None where there is no such start."""
    R_hat = matrices(edges.q_hat)
    t_hat = np.einsum("eij,ej->ei", R_hat, edges.d[:, 3:])
    moving = np.delete(np.arange(len(state.q)), fixed)
    try:
        R = _rotations(edges, R_hat, matrices(state.q[fixed : fixed + 1])[0], moving)
        if R is None:
            return None
        t = _positions(edges, np.einsum("eij,ej->ei", R[edges.i], t_hat), state.t[fixed], moving)
    except RuntimeError:
        return None
    return State(quaternions(R), t, state.scale) if np.all(np.isfinite(t)) else None


def _rotations(edges: Edges, R_hat: Float, R_fixed: Float, moving: Int) -> Float | None:
    """Rotations (N, 3, 3) nearest to the relaxed ones, of whose transposes `X_j = R_hat^T X_i` is asked."""
    X = _solved(edges, -R_hat, np.zeros((len(moving) + 1, 3, 3)), R_fixed.T, moving)
    return np.swapaxes(nearest_rotations(X), 1, 2) if np.all(np.isfinite(X)) else None


def nearest_rotations(X: Float) -> Float:
    """The rotations (N, 3, 3) nearest to matrices: by Newton's steps, or by singular values where one is flat."""
    flat = np.einsum("ni,ni->n", X[:, 0], _cofactors(X)[:, 0]) < DETERMINANT_MIN
    u, _, vt = np.linalg.svd(X[flat])
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    R = X.copy()
    R[flat] = u @ vt
    for _ in range(POLAR_STEPS_MAX):
        cofactors = _cofactors(R)
        before, R = R, 0.5 * (R + cofactors / np.einsum("ni,ni->n", R[:, 0], cofactors[:, 0])[:, None, None])
        if np.abs(R - before).max() < POLAR_TOLERANCE:
            break
    return R


def _positions(edges: Edges, steps: Float, t_fixed: Float, moving: Int) -> Float:
    """Positions (N, 3) that agree best with the steps (E, 3) of all edges."""
    poses = len(moving) + 1
    pulled = [np.bincount(edges.j, column, poses) - np.bincount(edges.i, column, poses) for column in steps.T]
    links = np.full((len(edges), 1, 1), -1.0)
    return _solved(edges, links, np.stack(pulled, axis=1)[:, None, :], t_fixed[None, :], moving)[:, 0]


def _solved(edges: Edges, links: Float, right: Float, of_fixed: Float, moving: Int) -> Float:
    """Unknowns (N, n, 3) of the Laplacian whose blocks between i and j are the links (E, n, n); one is given.

    Raises:
        RuntimeError: It is singular.
    """
    poses, n = right.shape[:2]
    order = np.argsort(edges.i, kind="stable")
    starts = np.searchsorted(edges.i[order], np.arange(poses + 1))
    above = sparse.bsr_matrix((links[order], edges.j[order], starts), shape=(n * poses,) * 2).tocsr()
    degrees = np.bincount(edges.i, minlength=poses) + np.bincount(edges.j, minlength=poses)
    whole = (above + above.T + sparse.diags(np.repeat(degrees.astype(float), n))).tocsc()
    fixed = np.setdiff1d(np.arange(poses), moving)
    free, held = ((n * nodes[:, None] + np.arange(n)).ravel() for nodes in (moving, fixed))
    columns = whole[:, free]
    found = np.empty((poses, n, 3))
    pulled = right.reshape(-1, 3)[free] - columns[held].T @ of_fixed
    factors = splu(columns[free], "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    found[moving] = factors.solve(np.asarray(pulled)).reshape(-1, n, 3)
    found[fixed] = of_fixed
    return found


def _cofactors(X: Float) -> Float:
    """Cofactors of matrices (N, 3, 3): those of a rotation are itself."""
    (a, b, c), out = np.moveaxis(X, (1, 2), (0, 1)), np.empty_like(X)
    for row, (u, v) in enumerate(((b, c), (c, a), (a, b))):
        for k in range(3):
            out[:, row, k] = u[k - 2] * v[k - 1] - u[k - 1] * v[k - 2]
    return out
