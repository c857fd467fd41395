"""One linear least-squares step by preconditioned conjugate gradients: time and memory linear in the graph's size.

Elimination fills in: at 30,000 closures it takes forty times as long as at 10,000. Two levels of preconditioning make
about ten iterations enough at every size (deflation, A-DEF2 of Tang et al. 2009, J. Sci. Comput. 39):

- *chains*: odometry, which is stiffer than closures, is solved exactly as a banded matrix, closures by their blocks
  on the diagonal;
- *segments*: `SEGMENT_POSES` consecutive keyframes that move as one rigid body are the unknowns of a small system,
  solved exactly together with the cluster scales. It carries what the chains cannot: robots against one another.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.linalg.blas import dsbmv
from scipy.sparse.linalg import SuperLU, splu

from flocc_agent.backend import rotations
from flocc_agent.backend.edges import Edges, Residuals, State, jacobians, taken

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Bordered = tuple[Int, Float]
"""Indices of edges, and the products (E, 2, 14) of what pulls them and of their scale's derivative with everything."""

BAND = 12
"""Numbers below each other in the band of a chain: a pose has six, and is joined to the next one's six."""
CHUNK_EDGES = 4096
"""Edges whose Jacobians are there at a time: those of 100,000 would be fetched anew from the system in each step."""
SEGMENT_POSES = 25
ITERATIONS_LEAST, POSES_PER_ITERATION, ITERATIONS_MOST = 50, 50, 400
"""A system of more poses is worth more iterations, because its elimination costs more than in proportion."""
RIDGE_RATIO = 1e-10
"""Added to the diagonals of both preconditioners, which may be singular where the system is not."""


@dataclass(frozen=True, slots=True, eq=False)
class BlockLayout:
    """Where the blocks of a symmetric matrix's upper triangle are in the whole of it.

    Attributes:
        nodes: Number of block rows.
        above: Which of the blocks are above the diagonal.
        order: (M,) places of the whole matrix's blocks, row by row, in the blocks followed by those above its diagonal.
        indices: (M,) their block columns.
        starts: (N + 1,) where each block row begins.
    """

    nodes: int
    above: Bool
    order: Int
    indices: Int
    starts: Int

    @classmethod
    def of(cls, rows: Int, cols: Int, nodes: int) -> "BlockLayout":
        """Lay out blocks of the upper triangle, at block rows and columns (K,)."""
        above = rows < cols
        all_rows, all_cols = np.concatenate([rows, cols[above]]), np.concatenate([cols, rows[above]])
        order = np.lexsort((all_cols, all_rows))
        return cls(nodes, above, order, all_cols[order], np.searchsorted(all_rows[order], np.arange(nodes + 1)))

    def whole(self, blocks: Float) -> sparse.bsr_matrix:
        """The matrix of the blocks (K, 6, 6) of its upper triangle."""
        data = np.concatenate([blocks, np.swapaxes(blocks[self.above], 1, 2)])[self.order]
        return sparse.bsr_matrix((data, self.indices, self.starts), shape=(6 * self.nodes,) * 2)


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """Which 6x6 blocks of the normal equations are not zero; the same for all steps on some edges between nodes.

    Attributes:
        i: (E,) first node of each edge.
        j: (E,) second node of each edge, another one.
        rows: (K,) block row of each block in the upper triangle, diagonal included.
        cols: (K,) its block column.
        gather: (K, 3 E) sums up the edges' products (i, i), (j, j) and (lower, higher) into blocks.
        nodes: Number of poses or segments.
    """

    i: Int
    j: Int
    rows: Int
    cols: Int
    gather: sparse.csr_matrix
    nodes: int

    @classmethod
    def of(cls, i: Int, j: Int, nodes: int) -> "Pattern":
        """Find the blocks of edges between nodes i and j, both (E,)."""
        rows, cols = np.concatenate([i, j, np.minimum(i, j)]), np.concatenate([i, j, np.maximum(i, j)])
        blocks, place = np.unique(rows * nodes + cols, return_inverse=True)
        products = np.arange(len(place))
        gather = sparse.csr_matrix((np.ones(len(place)), (place, products)), shape=(len(blocks), len(place)))
        return cls(i, j, blocks // nodes, blocks % nodes, gather, nodes)

    def summed(self, products: Float) -> Float:
        """Blocks (K, 6, 6) of the edges' products (3, E, 6, 6): those of i, of j, and of i with j."""
        downward = self.i > self.j
        products[2, downward] = np.swapaxes(products[2, downward], 1, 2)
        return np.asarray(self.gather @ products.reshape(-1, 36)).reshape(-1, 6, 6)


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """What all steps on some edges share.

    Attributes:
        steps: Indices of the edges from a pose to the next one, each pair of poses once.
        others: Indices of all other edges.
        poses: Blocks between poses of those others.
        far: BlockLayout of those of the blocks that are in no band.
        is_far: (K,) which they are.
        segments: Blocks between segments.
        coarse: Their layout.
        segment: (N,) the segment of each pose.
        between: Indices of the edges between two segments; the others say nothing of how segments move.
    """

    steps: Int
    others: Int
    poses: Pattern
    far: BlockLayout
    is_far: Bool
    segments: Pattern
    coarse: BlockLayout
    segment: Int
    between: Int

    @classmethod
    def of(cls, edges: Edges, poses: int, fixed: int) -> "Structure":
        """Cut the chains into segments and find the blocks."""
        ahead = np.flatnonzero(edges.j == edges.i + 1)
        steps = ahead[np.unique(edges.i[ahead], return_index=True)[1]]
        others = np.setdiff1d(np.arange(len(edges)), steps)
        pattern = Pattern.of(edges.i[others], edges.j[others], poses)
        is_far = pattern.cols > pattern.rows + 1
        far = BlockLayout.of(pattern.rows[is_far], pattern.cols[is_far], poses)
        segment = segments_of(edges, poses, fixed)
        i, j = segment[edges.i], segment[edges.j]
        between = np.flatnonzero(i != j)
        segments = Pattern.of(i[between], j[between], int(segment[-1]) + 1)
        coarse = BlockLayout.of(segments.rows, segments.cols, segments.nodes)
        return cls(steps, others, pattern, far, is_far, segments, coarse, segment, between)


@dataclass(frozen=True, slots=True, eq=False)
class Beside:
    """What is in the normal equations beside the edges.

    Attributes:
        fixed: The pose that does not move.
        damping: Added to the diagonal of the poses.
        D: (C,) diagonal of the cluster scales: priors, bounds and damping.
        right: (C,) what priors and bounds pull them by.
    """

    fixed: int
    damping: float
    D: Float
    right: Float


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
    """The normal equations of one step, with both levels of the preconditioner.

    They are `[[H, B], [B^T, D]]` of poses and cluster scales; of H, the blocks of each pose and of each with the next
    one are in bands, as LAPACK takes them, and `far` has the rest.
    """

    def __init__(
        self, structure: Structure, edges: Edges, state: State, at: Residuals, weights: Float, beside: Beside
    ) -> None:
        """Build and factorise.

        Args:
            structure: Of the edges.
            edges: What was measured.
            state: Where the residuals were taken.
            at: Residuals, not yet weighted.
            weights: (E,) of the edges.
            beside: Scales, damping, and the pose that does not move.

        Raises:
            numpy.linalg.LinAlgError: A level cannot be factorised.
        """
        self._structure, self._beside, self._poses = structure, beside, len(state.q)
        self._edges, self._at, self._root = edges, at, np.sqrt(weights)
        self._bands = np.zeros((BAND, 6 * self._poses), order="F")
        self._right = np.zeros((self._poses, 6))
        self._D, self._right_scales = beside.D.copy(), beside.right.copy()
        borders = [*self._add_steps(), *self._add_others()]
        self._B = self._border(borders)
        self._blocks()[beside.fixed, :, 0] = 1.0
        self._bands[0] += beside.damping
        self._chains = self._factorised_chains()
        motions = rigid_motions(state, structure.segment)
        motions[beside.fixed] = 0.0
        self._moving, self._collecting = by_segment(motions, structure.segment)
        self._segments = self._factorised_segments(motions)

    def _blocks(self) -> Float:
        """The bands as (N, 6, 12): of each pose and column, from the diagonal down, the next pose's six last."""
        return self._bands.T.reshape(self._poses, 6, BAND)

    def _add_steps(self) -> Iterator[Bordered]:
        """Add the edges from a pose to the next."""
        blocks = self._blocks()
        for rows, G in self._products(self._structure.steps):
            first, second = as_slice(self._edges.i[rows]), as_slice(self._edges.j[rows])
            for column in range(6):
                blocks[first, column, : BAND - column] += G[:, column, column:12]
                blocks[second, column, : 6 - column] += G[:, 6 + column, 6 + column : 12]
            self._right[first] += G[:, 12, :6]
            self._right[second] += G[:, 12, 6:12]
            yield rows, G[:, 12:, :]

    def _add_others(self) -> Iterator[Bordered]:
        """Add the other edges, some into the bands, some beside them."""
        others, pattern = self._structure.others, self._structure.poses
        products, pulls, done = np.empty((3, len(others), 6, 6)), np.empty((len(others), 12)), 0
        for rows, G in self._products(others):
            part = slice(done, done + len(rows))
            products[0, part], products[1, part] = G[:, :6, :6], G[:, 6:12, 6:12]
            products[2, part] = G[:, :6, 6:12]
            pulls[part], done = G[:, 12, :12], done + len(rows)
            yield rows, G[:, 12:, :]
        for nodes, pulled in ((pattern.i, pulls[:, :6]), (pattern.j, pulls[:, 6:])):
            self._right += np.stack([np.bincount(nodes, column, self._poses) for column in pulled.T], axis=1)
        summed, bands = pattern.summed(products), self._blocks()
        on, beside = pattern.rows == pattern.cols, pattern.cols == pattern.rows + 1
        for column in range(6):
            bands[pattern.rows[on], column, : 6 - column] += summed[on, column:, column]
            bands[pattern.rows[beside], column, 6 - column : BAND - column] += summed[beside, column, :]
        self._far = self._structure.far.whole(summed[self._structure.is_far])

    def _products(self, of: Int) -> Iterator[tuple[Int, Float]]:
        """Indices of edges, and the products (E, 14, 14) of their whitened rows with one another.

        A row has both Jacobians, what pulls, and the derivative by the scale of the edge's cluster.
        """
        for begin in range(0, len(of), CHUNK_EDGES):
            indices = of[begin : begin + CHUNK_EDGES]
            edges, at, root = taken(self._edges, indices), taken(self._at, indices), self._root[indices, None]
            jac, rows = jacobians(edges, at), np.empty((len(indices), 6, 14))
            np.multiply(root[:, None], jac.A_i, out=rows[:, :, :6])
            np.multiply(root[:, None], jac.A_j, out=rows[:, :, 6:12])
            rows[:, :, 12], rows[:, :, 13] = -root * at.e, root * jac.a_scale
            rows[edges.i == self._beside.fixed, :, :6] = 0.0
            rows[edges.j == self._beside.fixed, :, 6:12] = 0.0
            yield indices, np.swapaxes(rows, 1, 2) @ rows

    def _border(self, parts: Iterable[Bordered]) -> sparse.csr_matrix:
        """B (6 N, C) of edges and the products of their pull and scale with everything; adds to the scales' own."""
        clusters = len(self._D)
        values, rows, cols = [np.zeros(0)], [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
        for indices, G in parts:
            on = np.flatnonzero(self._edges.cluster[indices] >= 0)
            if len(on) == 0:
                continue
            edges, cluster = indices[on], self._edges.cluster[indices[on]]
            nodes = np.stack([self._edges.i[edges], self._edges.j[edges]], axis=1)
            values.append(G[on, 1, :12].ravel())
            rows.append((6 * nodes[:, :, None] + np.arange(6)).ravel())
            cols.append(np.repeat(cluster, 12))
            self._D += np.bincount(cluster, G[on, 1, 13], clusters)
            self._right_scales += np.bincount(cluster, G[on, 1, 12], clusters)
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols)))
        return sparse.csr_matrix(entries, shape=(6 * self._poses, clusters))

    @property
    def right(self) -> Float:
        """Right side (6 N + C,): the negative gradient of half the weighted squares."""
        return np.concatenate([self._right.ravel(), self._right_scales])

    def units(self, rows: slice) -> Iterator[Float]:
        """Right sides (6 N + C,) with a one in each of these rows."""
        for row in range(rows.start, rows.stop):
            unit = np.zeros(6 * self._poses + len(self._D))
            unit[row] = 1.0
            yield unit

    def solve(self, b: Float, tolerance_ratio: float) -> Float | None:
        """The solution (6 N + C,) of a right side; None where the iterations do not suffice."""
        x = self._by_segments(b)
        r = b - self.times(x)
        z = self._preconditioned(r)
        p, rz = z.copy(), float(r @ z)
        goal = tolerance_ratio**2 * abs(float(b @ self._preconditioned(b)))
        for _ in range(iterations_max(self._poses)):
            if rz <= goal:
                return x
            Ap = self.times(p)
            alpha = rz / float(p @ Ap)
            x += alpha * p
            r -= alpha * Ap
            z = self._preconditioned(r)
            rz, before = float(r @ z), rz
            if not np.isfinite(rz):
                break
            p *= rz / before
            p += z
        return None

    def times(self, x: Float) -> Float:
        """The product of the normal equations with a vector (6 N + C,)."""
        n = 6 * self._poses
        out = np.empty_like(x)
        out[:n] = dsbmv(BAND - 1, 1.0, self._bands, x[:n], lower=1)
        out[:n] += self._far @ x[:n]
        if len(self._D):
            out[:n] += self._B @ x[n:]
            out[n:] = self._B.T @ x[:n] + self._D * x[n:]
        return out

    def _preconditioned(self, r: Float) -> Float:
        """Chains first, then segments on what they leave."""
        z = self._by_chains(r)
        z += self._by_segments(r - self.times(z))
        return z

    def _by_chains(self, r: Float) -> Float:
        n = 6 * self._poses
        poses = scipy.linalg.cho_solve_banded((self._chains, True), r[:n], check_finite=False)
        return np.concatenate([poses, r[n:] / self._D])

    def _by_segments(self, r: Float) -> Float:
        n, count = 6 * self._poses, 6 * self._structure.segments.nodes
        y = self._segments.solve(np.concatenate([self._collecting @ r[:n], r[n:]]))
        return np.concatenate([self._moving @ y[:count], y[count:]])

    def _factorised_chains(self) -> Float:
        """Banded Cholesky factor (12, 6 N) of the bands."""
        bands = self._bands.copy(order="F")
        bands[0] *= 1.0 + RIDGE_RATIO
        return np.asarray(scipy.linalg.cholesky_banded(bands, overwrite_ab=True, lower=True, check_finite=False))

    def _factorised_segments(self, motions: Float) -> SuperLU:
        """Factors of the system of segments that move as a whole by their poses' motions (N, 6, 6), scales included."""
        kept, pattern, clusters = self._structure.between, self._structure.segments, len(self._D)
        edges, root = taken(self._edges, kept), self._root[kept, None]
        jac = jacobians(edges, taken(self._at, kept))
        ends = [root[:, None] * (A @ motions[end]) for A, end in ((jac.A_i, edges.i), (jac.A_j, edges.j))]
        pairs = ((ends[0], ends[0]), (ends[1], ends[1]), (ends[0], ends[1]))
        blocks = pattern.summed(np.stack([np.swapaxes(A, 1, 2) @ B for A, B in pairs]))
        H = self._structure.coarse.whole(blocks)
        if self._beside.damping > 0:
            own = self._beside.damping * (self._collecting @ self._moving)
            H = H + own
        slopes, scaled = root * jac.a_scale, np.flatnonzero(edges.cluster >= 0)
        values = np.concatenate([np.einsum("eki,ek->ei", A[scaled], slopes[scaled]) for A in ends])
        nodes = np.concatenate([pattern.i[scaled], pattern.j[scaled]])
        rows, cols = (6 * nodes[:, None] + np.arange(6)).ravel(), np.repeat(np.tile(edges.cluster[scaled], 2), 6)
        B = sparse.csr_matrix((values.ravel(), (rows, cols)), shape=(6 * pattern.nodes, clusters))
        return factorised(H, B, self._D)


def as_slice(indices: Int) -> Int | slice:
    """Indices that count on without a gap as a slice, with which numpy is several times as fast."""
    first, last = int(indices[0]), int(indices[-1])
    return slice(first, last + 1) if last - first == len(indices) - 1 else indices


def by_segment(motions: Float, segment: Int) -> tuple[sparse.bsr_matrix, sparse.bsr_matrix]:
    """What moves poses (6 N) with their segments (6 S) by motions (N, 6, 6), and its transpose."""
    poses, segments = len(segment), int(segment[-1]) + 1
    shape, starts = (6 * poses, 6 * segments), np.searchsorted(segment, np.arange(segments + 1))
    moving = sparse.bsr_matrix((motions, segment, np.arange(poses + 1)), shape=shape)
    transposed = np.ascontiguousarray(np.swapaxes(motions, 1, 2))
    return moving, sparse.bsr_matrix((transposed, np.arange(poses), starts), shape=shape[::-1])


def factorised(H: sparse.bsr_matrix, B: sparse.csr_matrix, D: Float) -> SuperLU:
    """Factors of `[[H, B], [B^T, D]]`; what cannot move keeps a one on its diagonal.

    Raises:
        numpy.linalg.LinAlgError: It is singular.
    """
    diagonal = H.diagonal()
    H = H.tocsc() + sparse.diags(np.where(diagonal > 0, RIDGE_RATIO * diagonal, 1.0))
    whole = sparse.bmat([[H, B], [B.T, sparse.diags(D)]]) if len(D) else H
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
