"""One linear least-squares step by preconditioned conjugate gradients: time and memory linear in the graph's size.

Elimination fills in: at 30,000 closures it takes forty times as long as at 10,000. Two levels of preconditioning make
about ten iterations enough at every size (deflation, A-DEF2 of Tang et al. 2009, J. Sci. Comput. 39):

- *chains*: odometry, which is stiffer than closures, is solved exactly as a banded matrix, closures by their blocks
  on the diagonal;
- *segments*: `SEGMENT_POSES` consecutive keyframes that move as one rigid body are the unknowns of a small system,
  solved exactly together with the cluster scales. It carries what the chains cannot: robots against one another.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu

from flocc_agent.backend import rotations
from flocc_agent.backend.edges import Edges, Jacobians, Residuals, State

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

SEGMENT_POSES = 25
ITERATIONS_LEAST, POSES_PER_ITERATION, ITERATIONS_MOST = 50, 50, 400
"""A system of more poses is worth more iterations, because its elimination costs more than in proportion."""
TOLERANCE_RATIO = 4e-3
"""How far the residual falls, in the preconditioner's norm; the step's cost is then right to its square."""
RIDGE_RATIO = 1e-10
"""Added to the diagonals of both preconditioners, which may be singular where the system is not."""


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """Which 6x6 blocks of the normal equations are not zero; the same for all steps on some edges between nodes.

    Attributes:
        nodes: Number of poses or segments.
        i: (E,) first node of each edge.
        j: (E,) second node of each edge, another one.
        rows: (K,) block row of each block in the upper triangle, diagonal included.
        cols: (K,) its block column.
        gather: (K, 3 E) sums up the edges' products (i, i), (j, j) and (lower, higher) into blocks.
        order: (M,) places of the whole matrix's blocks, row by row, in `blocks` followed by those above its diagonal.
        indices: (M,) their block columns.
        starts: (N + 1,) where each block row begins.
    """

    nodes: int
    i: Int
    j: Int
    rows: Int
    cols: Int
    gather: sparse.csr_matrix
    order: Int
    indices: Int
    starts: Int

    @classmethod
    def of(cls, i: Int, j: Int, nodes: int) -> "Pattern":
        """Find the blocks of edges between nodes i and j, both (E,)."""
        rows, cols = np.concatenate([i, j, np.minimum(i, j)]), np.concatenate([i, j, np.maximum(i, j)])
        blocks, place = np.unique(rows * nodes + cols, return_inverse=True)
        products = np.arange(len(place))
        gather = sparse.csr_matrix((np.ones(len(place)), (place, products)), shape=(len(blocks), len(place)))
        rows, cols = blocks // nodes, blocks % nodes
        above = rows < cols
        all_rows, all_cols = np.concatenate([rows, cols[above]]), np.concatenate([cols, rows[above]])
        order = np.lexsort((all_cols, all_rows))
        starts = np.searchsorted(all_rows[order], np.arange(nodes + 1))
        return cls(nodes, i, j, rows, cols, gather, order, all_cols[order], starts)


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """`[[H, B], [B^T, D]]` of nodes (six unknowns each) and cluster scales.

    Attributes:
        blocks: (K, 6, 6) blocks of H in the upper triangle, in the pattern's order.
        H: (6 N, 6 N) of the nodes.
        B: (6 N, C) between nodes and scales.
        D: (C,) of the scales.
    """

    blocks: Float
    H: sparse.bsr_matrix
    B: sparse.csr_matrix
    D: Float

    def times(self, x: Float) -> Float:
        """The product with a vector (6 N + C,)."""
        n = self.H.shape[0]
        if len(self.D) == 0:
            return np.asarray(self.H @ x)
        return np.concatenate([self.H @ x[:n] + self.B @ x[n:], self.B.T @ x[:n] + self.D * x[n:]])


def normal_equations(
    pattern: Pattern, A_i: Float, A_j: Float, a_scale: Float, cluster: Int, D: Float, added: Float
) -> NormalEquations:
    """Sum up the products of whitened Jacobians (E, 6, 6), and (E, 6) by the scale of an edge's cluster or of none.

    `added` (N, 6, 6) or (6, 6) goes onto the diagonal blocks.
    """
    A_i_transposed, A_j_transposed = (np.ascontiguousarray(np.swapaxes(A, 1, 2)) for A in (A_i, A_j))
    products = np.empty((3, len(A_i), 6, 6))
    np.matmul(A_i_transposed, A_i, out=products[0])
    np.matmul(A_j_transposed, A_j, out=products[1])
    np.matmul(A_i_transposed, A_j, out=products[2])
    downward = pattern.i > pattern.j
    products[2, downward] = np.swapaxes(products[2, downward], 1, 2)
    blocks = np.asarray(pattern.gather @ products.reshape(-1, 36)).reshape(-1, 6, 6)
    on = pattern.rows == pattern.cols
    blocks[on] += added[pattern.rows[on]] if added.ndim == 3 else added
    return NormalEquations(blocks, symmetric(pattern, blocks), _border(pattern, A_i, A_j, a_scale, cluster, len(D)), D)


def symmetric(pattern: Pattern, blocks: Float) -> sparse.bsr_matrix:
    """The whole matrix of the blocks (K, 6, 6) of its upper triangle."""
    above = np.swapaxes(blocks[pattern.rows < pattern.cols], 1, 2)
    data = np.concatenate([blocks, above])[pattern.order]
    return sparse.bsr_matrix((data, pattern.indices, pattern.starts), shape=(6 * pattern.nodes,) * 2)


def _border(pattern: Pattern, A_i: Float, A_j: Float, a_scale: Float, cluster: Int, clusters: int) -> sparse.csr_matrix:
    """Products (6 N, C) of the nodes' Jacobians with those by the scales."""
    scaled = np.flatnonzero(cluster >= 0)
    values = np.concatenate([np.einsum("eki,ek->ei", A[scaled], a_scale[scaled]) for A in (A_i, A_j)])
    nodes = np.concatenate([pattern.i[scaled], pattern.j[scaled]])
    rows = (6 * nodes[:, None] + np.arange(6)).ravel()
    cols = np.repeat(np.tile(cluster[scaled], 2), 6)
    return sparse.csr_matrix((values.ravel(), (rows, cols)), shape=(6 * pattern.nodes, clusters))


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """What all steps on some edges share.

    Attributes:
        poses: Blocks between poses.
        segments: Blocks between segments.
        segment: (N,) the segment of each pose.
        between: Indices of the edges between two segments; the others say nothing of how segments move.
    """

    poses: Pattern
    segments: Pattern
    segment: Int
    between: Int

    @classmethod
    def of(cls, edges: Edges, poses: int, fixed: int) -> "Structure":
        """Cut the chains into segments and find the blocks."""
        segment = segments_of(edges, poses, fixed)
        i, j = segment[edges.i], segment[edges.j]
        between = np.flatnonzero(i != j)
        of_segments = Pattern.of(i[between], j[between], int(segment[-1]) + 1)
        return cls(Pattern.of(edges.i, edges.j, poses), of_segments, segment, between)


def segments_of(edges: Edges, poses: int, fixed: int) -> Int:
    """Segment (N,) of each pose: consecutive poses that edges join one to the next, at most `SEGMENT_POSES`.

    The fixed pose is a segment of its own, so that every segment moves as a whole or not at all.
    """
    joined = np.zeros(poses, dtype=bool)
    neighbours = np.abs(edges.i - edges.j) == 1
    joined[np.maximum(edges.i, edges.j)[neighbours]] = True
    joined[fixed : fixed + 2] = False
    chain_start = np.maximum.accumulate(np.where(joined, 0, np.arange(poses)))
    begins = (np.arange(poses) - chain_start) % SEGMENT_POSES == 0
    return np.asarray(np.cumsum(begins) - 1, dtype=np.int64)


class System:
    """The normal equations of one step, with both levels of the preconditioner."""

    def __init__(
        self,
        structure: Structure,
        state: State,
        jac: Jacobians,
        cluster: Int,
        weights: Float,
        D: Float,
        fixed: int,
        damping: float,
    ) -> None:
        """Build and factorise.

        Args:
            structure: Of the edges.
            state: Where the Jacobians were taken.
            jac: Whitened, not yet weighted.
            cluster: (E,) cluster of each edge's scale, or -1.
            weights: (E,) of the edges.
            D: (C,) of the scales: edges, priors and damping.
            fixed: The pose that does not move.
            damping: Added to the diagonal of the poses.

        Raises:
            numpy.linalg.LinAlgError: A level cannot be factorised.
        """
        self._structure, self._fixed = structure, fixed
        root = np.sqrt(weights)[:, None, None]
        A_i, A_j = root * jac.A_i, root * jac.A_j
        A_i[structure.poses.i == fixed] = 0.0
        A_j[structure.poses.j == fixed] = 0.0
        a_scale = root[:, 0] * jac.a_scale
        self._normal = normal_equations(structure.poses, A_i, A_j, a_scale, cluster, D, damping * np.eye(6))
        self._chains = self._factorised_chains()
        self._motions = rigid_motions(state, structure.segment)
        self._motions[fixed] = 0.0
        damped = damping * self._summed(np.swapaxes(self._motions, 1, 2) @ self._motions)
        kept, ends = structure.between, (structure.poses.i, structure.poses.j)
        at_i, at_j = (A[kept] @ self._motions[end[kept]] for A, end in zip((A_i, A_j), ends, strict=True))
        coarse = normal_equations(structure.segments, at_i, at_j, a_scale[kept], cluster[kept], D, damped)
        self._segments = factorised(coarse)

    def solve(self, b: Float) -> Float | None:
        """The step (6 N + C,) for a right side; None where the iterations do not suffice."""
        x = self._by_segments(b)
        r = b - self._normal.times(x)
        z = self._preconditioned(r)
        p, rz = z.copy(), float(r @ z)
        goal = TOLERANCE_RATIO**2 * abs(float(b @ self._preconditioned(b)))
        for _ in range(iterations_max(self._structure.poses.nodes)):
            if rz <= goal:
                return x
            Ap = self._normal.times(p)
            alpha = rz / float(p @ Ap)
            x += alpha * p
            r -= alpha * Ap
            z = self._preconditioned(r)
            rz, before = float(r @ z), rz
            if not np.isfinite(rz):
                break
            p = z + (rz / before) * p
        return None

    def _preconditioned(self, r: Float) -> Float:
        """Chains first, then segments on what they leave."""
        z = self._by_chains(r)
        return z + self._by_segments(r - self._normal.times(z))

    def _by_chains(self, r: Float) -> Float:
        n = self._normal.H.shape[0]
        poses = scipy.linalg.cho_solve_banded((self._chains, True), r[:n], check_finite=False)
        return np.concatenate([poses, r[n:] / self._normal.D])

    def _by_segments(self, r: Float) -> Float:
        n, count = self._normal.H.shape[0], self._structure.segments.nodes
        forces = self._summed(np.einsum("nki,nk->ni", self._motions, r[:n].reshape(-1, 6)))
        y = self._segments.solve(np.concatenate([forces.ravel(), r[n:]]))
        moved = y[: 6 * count].reshape(-1, 6)[self._structure.segment]
        return np.concatenate([np.einsum("nki,ni->nk", self._motions, moved).ravel(), y[6 * count :]])

    def _summed(self, of_poses: Float) -> Float:
        """Sums (S, ...) over the poses (N, ...) of each segment."""
        segment, count = self._structure.segment, self._structure.segments.nodes
        columns = of_poses.reshape(len(segment), -1).T
        sums = np.stack([np.bincount(segment, column, count) for column in columns], axis=1)
        return np.asarray(sums, dtype=np.float64).reshape(count, *of_poses.shape[1:])

    def _factorised_chains(self) -> Float:
        """Banded Cholesky factor (12, 6 N) of the diagonal blocks and of those between consecutive poses."""
        pattern, blocks = self._structure.poses, self._normal.blocks
        diagonal, below = np.zeros((2, pattern.nodes, 6, 6))
        on = pattern.rows == pattern.cols
        diagonal[pattern.rows[on]] = blocks[on]
        beside = pattern.cols == pattern.rows + 1
        below[pattern.rows[beside]] = np.swapaxes(blocks[beside], 1, 2)
        diagonal[self._fixed] = np.eye(6)
        band = np.zeros((12, 6 * pattern.nodes))
        for column in range(6):
            for row in range(column, 6):
                band[row - column, column::6] = diagonal[:, row, column]
            for row in range(6):
                band[6 + row - column, column::6] = below[:, row, column]
        band[0] *= 1.0 + RIDGE_RATIO
        return np.asarray(scipy.linalg.cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False))


def factorised(normal: NormalEquations) -> SuperLU:
    """Factors of the segments' system, scales included; a segment that cannot move keeps a one on its diagonal.

    Raises:
        numpy.linalg.LinAlgError: It is singular.
    """
    diagonal = normal.H.diagonal()
    H = normal.H.tocsc() + sparse.diags(np.where(diagonal > 0, RIDGE_RATIO * diagonal, 1.0))
    whole = sparse.bmat([[H, normal.B], [normal.B.T, sparse.diags(normal.D)]]) if len(normal.D) else H
    try:
        return splu(whole.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:
        raise np.linalg.LinAlgError(str(error)) from error


def iterations_max(poses: int) -> int:
    """After how many iterations elimination would have been faster."""
    return min(max(ITERATIONS_LEAST, poses // POSES_PER_ITERATION), ITERATIONS_MOST)


def rigid_motions(state: State, segment: Int) -> Float:
    """How each pose (N, 6, 6) moves, in its own tangent space, when its segment moves about its centre."""
    R_inverse = np.swapaxes(rotations.matrices(state.q), 1, 2)
    sizes = np.bincount(segment)
    centre = np.stack([np.bincount(segment, column) / sizes for column in state.t.T], axis=1)
    out = np.zeros((len(segment), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = R_inverse
    out[:, 3:, :3] = -R_inverse @ rotations.hats(state.t - centre[segment])
    return out


def right_side(edges: Edges, at: Residuals, jac: Jacobians, weights: Float, poses: int, of_scales: Float) -> Float:
    """Negative gradient (6 N + C,) of half the weighted squares; `of_scales` (C,) is what priors and bounds add."""
    pulled = -weights[:, None] * at.e
    of_poses = np.zeros((poses, 6))
    for nodes, A in ((edges.i, jac.A_i), (edges.j, jac.A_j)):
        per_edge = np.einsum("eki,ek->ei", A, pulled)
        of_poses += np.stack([np.bincount(nodes, column, poses) for column in per_edge.T], axis=1)
    scaled = edges.cluster >= 0
    by_scale = np.einsum("ek,ek->e", jac.a_scale[scaled], pulled[scaled])
    return np.concatenate([of_poses.ravel(), of_scales + np.bincount(edges.cluster[scaled], by_scale, len(of_scales))])
