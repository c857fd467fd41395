"""One linear least-squares step: Jacobians in numpy, then elimination or, for large graphs, conjugate gradients.

Elimination is GTSAM's (C++, multifrontal Cholesky). What costs time besides it is handing 10,000 small matrices over to
C++. Column-major arrays with an explicit unit noise model pass three times as fast as plain ones (measured: 36 ms
instead of 122 ms for 8,000 factors).
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from flocc_agent.backend.conjugate_gradients import Structure, System, right_side
from flocc_agent.backend.edges import Edges, Jacobians, Residuals, State

Float = NDArray[np.float64]

SCALE_KEYS_FROM = 1 << 40
ITERATIVE_LOOPS_MIN = 2500
"""From so many edges beyond a tree on, conjugate gradients are faster than elimination (`flocc bench solver`)."""


TETHER = 1.0
"""Information by which a part of the graph that nothing holds stays where it is: any value gives the same step."""


class SingularSystem(Exception):
    """The normal equations have no unique solution; damp them or give up."""


@dataclass(slots=True)
class LinearSolver:
    """Solves the normal equations of one component again and again; the edges stay the same, their weights do not.

    Where conjugate gradients do not get there once, elimination does the rest: such graphs have long loops of edges
    that are as stiff as odometry, and few others, so that elimination is fast.

    Attributes:
        fixed: Index of the pose that does not move (the anchor's first keyframe).
        scale_prior_sigma: Standard deviation around 1 of all scales, or (C,) of each.
        iterative_loops_min: Number of edges beyond a tree from which on conjugate gradients are tried first.
    """

    fixed: int
    scale_prior_sigma: float | Float
    iterative_loops_min: int = ITERATIVE_LOOPS_MIN
    _ordering: gtsam.Ordering | None = field(default=None, repr=False)
    _ordered: bytes = field(default=b"", repr=False)
    _structure: Structure | None = field(default=None, repr=False)
    _gave_up: bool = field(default=False, repr=False)

    def step(
        self, edges: Edges, state: State, at: Residuals, jac: Jacobians, weights: Float, damping: float = 0.0
    ) -> Float:
        """Tangent vector (6 N + C,) that reduces the linearised, weighted cost most.

        Raises:
            SingularSystem: Something is not determined.
        """
        if len(edges) - len(state.q) >= self.iterative_loops_min and not self._gave_up:
            found = self._iterated(edges, state, at, jac, weights, damping)
            if found is not None:
                return found
            self._gave_up = True
        return self._eliminated(edges, state, at, jac, weights, damping)

    def _iterated(
        self, edges: Edges, state: State, at: Residuals, jac: Jacobians, weights: Float, damping: float
    ) -> Float | None:
        """The step by conjugate gradients; None where they do not get there."""
        if self._structure is None:
            self._structure = Structure.of(edges, len(state.q), self.fixed)
        of_scales, D = self._scale_terms(edges, state, at, jac, weights, damping)
        b = right_side(edges, at, jac, weights, len(state.q), of_scales)
        b[6 * self.fixed : 6 * self.fixed + 6] = 0.0
        try:
            system = System(self._structure, state, jac, edges.cluster, weights, D, self.fixed, damping)
        except np.linalg.LinAlgError:
            return None
        return system.solve(b)

    def _scale_terms(
        self, edges: Edges, state: State, at: Residuals, jac: Jacobians, weights: Float, damping: float
    ) -> tuple[Float, Float]:
        """What priors and bounds pull cluster scales by (C,), and the diagonal (C,) of their normal equations."""
        clusters, held = len(state.scale), at.held & (edges.cluster >= 0)
        information = 1.0 / self.scale_prior_sigma**2
        slope = weights[held] / edges.sigma[held]
        pulled = (1.0 - state.scale) * information
        pulled += np.bincount(edges.cluster[held], slope * at.bound[held], clusters)
        scaled = edges.cluster >= 0
        squares = weights[scaled] * np.einsum("ek,ek->e", jac.a_scale[scaled], jac.a_scale[scaled])
        D = damping + information + np.bincount(edges.cluster[scaled], squares, clusters)
        return pulled, np.asarray(D + np.bincount(edges.cluster[held], slope / edges.sigma[held], clusters))

    def _eliminated(
        self, edges: Edges, state: State, at: Residuals, jac: Jacobians, weights: Float, damping: float
    ) -> Float:
        """The step by elimination."""
        graph = self.factors(edges, state, at, jac, weights)
        if graph.size() == 0:
            return np.zeros(6 * len(state.q) + len(state.scale))
        if damping > 0:
            self._damp(graph, range(len(state.q)), range(len(state.scale)), damping)
        else:
            self._damp(graph, loose(edges, weights, len(state.q), self.fixed), (), TETHER)
        taking_part = (weights > 0.0).tobytes()
        if self._ordering is None or taking_part != self._ordered:
            self._ordering, self._ordered = gtsam.Ordering.ColamdGaussianFactorGraph(graph), taking_part
        try:
            moved = graph.optimize(self._ordering).vector()
        except RuntimeError as error:
            raise SingularSystem(str(error).strip().splitlines()[0]) from error
        if not np.all(np.isfinite(moved)):
            raise SingularSystem("the normal equations have no finite solution")
        return np.concatenate([moved[: 6 * self.fixed], np.zeros(6), moved[6 * self.fixed :]])

    def marginals(
        self, edges: Edges, state: State, at: Residuals, jac: Jacobians, weights: Float, poses: list[int]
    ) -> list[Float]:
        """Marginal covariances (6, 6) of poses in their own tangent spaces; zero for the pose that does not move.

        Raises:
            SingularSystem: Something is not determined.
        """
        graph = self.factors(edges, state, at, jac, weights)
        if graph.size() == 0:
            return [np.zeros((6, 6)) for _ in poses]
        try:
            tree = graph.eliminateMultifrontal(gtsam.Ordering.ColamdGaussianFactorGraph(graph))
            moving = {pose: np.asarray(tree.marginalCovariance(pose)) for pose in poses if pose != self.fixed}
        except RuntimeError as error:
            raise SingularSystem(str(error).strip().splitlines()[0]) from error
        return [0.5 * (moving[p] + moving[p].T) if p in moving else np.zeros((6, 6)) for p in poses]

    def scales_alone(
        self, edges: Edges, state: State, at: Residuals, jac: Jacobians, weights: Float, first: int
    ) -> tuple[Float, Float]:
        """What is left of the normal equations when everything but the scales from `first` on is eliminated.

        Returns:
            Information matrix (K, K) of these scales, and its right side (K,).

        Raises:
            SingularSystem: Something else is not determined.
        """
        graph = self.factors(edges, state, at, jac, weights)
        self._damp(graph, loose(edges, weights, len(state.q), self.fixed), (), TETHER)
        keys = [SCALE_KEYS_FROM + c for c in range(first, len(state.scale))]
        ordered = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(graph, keys)
        others = gtsam.Ordering()
        for n in range(ordered.size() - len(keys)):
            others.push_back(ordered.at(n))
        try:
            _, left = graph.eliminatePartialMultifrontal(others)
            information, right = left.hessian(gtsam.Ordering(keys))
        except RuntimeError as error:
            raise SingularSystem(str(error).strip().splitlines()[0]) from error
        return np.asarray(information), np.asarray(right)

    def factors(
        self, edges: Edges, state: State, at: Residuals, jac: Jacobians, weights: Float
    ) -> gtsam.GaussianFactorGraph:
        """Jacobian factors of all edges and of the cluster scales' priors, noise whitened."""
        graph, unit = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create(6)
        w = np.sqrt(weights)[:, None]
        plain = bool(np.all(weights == 1.0))
        A_i, A_j = (column_major(A if plain else w[:, :, None] * A) for A in (jac.A_i, jac.A_j))
        a_scale, b = (w * jac.a_scale)[:, :, None], -w * at.e
        fixed, add = self.fixed, graph.add
        scale_keys = np.where(edges.cluster >= 0, SCALE_KEYS_FROM + edges.cluster, -1).tolist()
        rows = zip(edges.i.tolist(), edges.j.tolist(), scale_keys, A_i, A_j, a_scale, b, weights.tolist(), strict=True)
        for i, j, key, A_of_i, A_of_j, a, right, weight in rows:
            if weight == 0.0:
                continue
            if fixed in (i, j):
                moving, A = (j, A_of_j) if i == fixed else (i, A_of_i)
                if key >= 0:
                    add(moving, A, key, a, right, unit)
                else:
                    add(moving, A, right, unit)
            elif key >= 0:
                add(i, A_of_i, j, A_of_j, key, a, right, unit)
            else:
                add(i, A_of_i, j, A_of_j, right, unit)
        self._add_scale_rows(graph, edges, state, at, w[:, 0])
        return graph

    def _add_scale_rows(
        self, graph: gtsam.GaussianFactorGraph, edges: Edges, state: State, at: Residuals, sqrt_weights: Float
    ) -> None:
        unit = gtsam.noiseModel.Unit.Create(1)
        slopes = 1.0 / np.broadcast_to(self.scale_prior_sigma, state.scale.shape)
        for c, (scale, prior) in enumerate(zip(state.scale.tolist(), slopes.tolist(), strict=True)):
            graph.add(SCALE_KEYS_FROM + c, np.full((1, 1), prior), np.array([(1.0 - scale) * prior]), unit)
        for k in np.flatnonzero(at.held & (edges.cluster >= 0)).tolist():
            slope = np.full((1, 1), -sqrt_weights[k] / edges.sigma[k])
            right = np.array([-sqrt_weights[k] * at.bound[k]])
            graph.add(SCALE_KEYS_FROM + int(edges.cluster[k]), slope, right, unit)

    def _damp(
        self, graph: gtsam.GaussianFactorGraph, poses: Iterable[int], clusters: Iterable[int], damping: float
    ) -> None:
        root = np.sqrt(damping)
        rows, zeros, unit = np.asfortranarray(root * np.eye(6)), np.zeros(6), gtsam.noiseModel.Unit.Create(6)
        for n in poses:
            if n != self.fixed:
                graph.add(n, rows, zeros, unit)
        one = gtsam.noiseModel.Unit.Create(1)
        for c in clusters:
            graph.add(SCALE_KEYS_FROM + c, np.full((1, 1), root), np.zeros(1), one)


def loose(edges: Edges, weights: Float, poses: int, fixed: int) -> list[int]:
    """The first pose of each part of the graph that no edge with a weight joins to the fixed pose."""
    on = weights > 0.0
    joined = coo_array((np.ones(np.count_nonzero(on), dtype=np.int8), (edges.i[on], edges.j[on])), shape=(poses, poses))
    labels = connected_components(joined, directed=False)[1]
    _, first = np.unique(labels, return_index=True)
    return [int(pose) for pose in first if labels[pose] != labels[fixed]]


def column_major(A: Float) -> Float:
    """The same matrices (E, n, n), each of them column-major, as Eigen wants them."""
    return np.swapaxes(np.ascontiguousarray(np.swapaxes(A, 1, 2)), 1, 2)
