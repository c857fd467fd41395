"""One linear least-squares step: Jacobians in numpy, then elimination or, for large graphs, conjugate gradients.

Elimination is GTSAM's (C++, multifrontal Cholesky). What costs time besides it is handing 10,000 small matrices over to
C++. Column-major arrays with an explicit unit noise model pass three times as fast as plain ones (measured: 36 ms
instead of 122 ms for 8,000 factors).
"""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import repeat

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from flocc_agent.backend.conjugate_gradients import Beside, Structure, System
from flocc_agent.backend.edges import Edges, Residuals, State, jacobians

Float = NDArray[np.float64]

SCALE_KEYS_FROM = 1 << 40
ITERATIVE_LOOPS_MIN = 2500
"""From so many edges beyond a tree on, conjugate gradients are faster than elimination (`flocc bench solver`)."""
ITERATIVE_POSES_MIN = 10_000
"""From so many poses on they are so with few loops, too (`flocc bench solver --keyframes 20000 --closures 2000`)."""
DISSECTED_POSES_MIN = 10_000
"""From so many poses on, nested dissection gives the order of elimination."""
DISSECTED_LOOPS_MIN = 2500
"""With so many factors beyond a tree it does so however few the poses, which are chains then."""
MARGINALS_ELIMINATED_POSES_MAX = 50_000
"""Above, elimination for the sake of covariances would take most of a gigabyte."""
TOLERANCE_RATIO = 4e-3
"""How far conjugate gradients lower the residual, in the preconditioner's norm; the step's cost is then right to its
square."""
MARGINALS_TOLERANCE_RATIO = 1e-4
BESIDE_M, BESIDE_RAD = 0.01, 1e-3
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
        iterative_poses_min: Number of poses from which on they are, however few the loops.
    """

    fixed: int
    scale_prior_sigma: float | Float
    iterative_loops_min: int = ITERATIVE_LOOPS_MIN
    iterative_poses_min: int = ITERATIVE_POSES_MIN
    _ordering: gtsam.Ordering | None = field(default=None, repr=False)
    _ordered: bytes = field(default=b"", repr=False)
    _tree: gtsam.GaussianBayesTree | None = field(default=None, repr=False)
    _tree_at: tuple[State, Float] | None = field(default=None, repr=False)
    _structure: Structure | None = field(default=None, repr=False)
    _gave_up: bool = field(default=False, repr=False)

    def step(self, edges: Edges, state: State, at: Residuals, weights: Float, damping: float = 0.0) -> Float:
        """Tangent vector (6 N + C,) that reduces the linearised, weighted cost most.

        Raises:
            SingularSystem: Something is not determined.
        """
        if self.is_iterated(edges, len(state.q)):
            found = self._iterated(edges, state, at, weights, damping)
            if found is not None:
                return found
            self._gave_up = True
        return self._eliminated(edges, state, at, weights, damping)

    @property
    def leaves_covariances(self) -> bool:
        """Whether the last step was eliminated, so that covariances cost little more."""
        return self._tree is not None

    def is_iterated(self, edges: Edges, poses: int) -> bool:
        """Whether conjugate gradients are tried first."""
        many = len(edges) - poses >= self.iterative_loops_min or poses >= self.iterative_poses_min
        return many and not self._gave_up

    def _iterated(self, edges: Edges, state: State, at: Residuals, weights: Float, damping: float) -> Float | None:
        """The step by conjugate gradients; None where they do not get there."""
        try:
            system = self._system(edges, state, at, weights, damping)
        except np.linalg.LinAlgError:
            return None
        return system.solve(system.right, TOLERANCE_RATIO)

    def _system(self, edges: Edges, state: State, at: Residuals, weights: Float, damping: float) -> System:
        if self._structure is None:
            self._structure = Structure.of(edges, len(state.q), self.fixed)
        beside = self._beside(edges, state, at, weights, damping)
        return System(self._structure, edges, state, at, weights, beside)

    def _beside(self, edges: Edges, state: State, at: Residuals, weights: Float, damping: float) -> Beside:
        """What priors and bounds of cluster scales add to the edges."""
        clusters, held = len(state.scale), at.held & (edges.cluster >= 0)
        information = 1.0 / self.scale_prior_sigma**2
        slope = weights[held] / edges.sigma[held]
        pulled = (1.0 - state.scale) * information
        pulled += np.bincount(edges.cluster[held], slope * at.bound[held], clusters)
        D = damping + information + np.bincount(edges.cluster[held], slope / edges.sigma[held], clusters)
        return Beside(self.fixed, damping, np.asarray(D), pulled)

    def _eliminated(self, edges: Edges, state: State, at: Residuals, weights: Float, damping: float) -> Float:
        """The step by elimination."""
        graph = self.factors(edges, state, at, weights)
        if graph.size() == 0:
            return np.zeros(6 * len(state.q) + len(state.scale))
        parts = [] if damping > 0 else loose(edges, weights, len(state.q), self.fixed)
        if damping > 0:
            self._damp(graph, range(len(state.q)), range(len(state.scale)), damping)
        else:
            self._damp(graph, parts, (), TETHER)
        taking_part = (weights > 0.0).tobytes()
        if self._ordering is None or taking_part != self._ordered:
            self._ordering, self._ordered = ordering(graph, len(state.q)), taking_part
        self._tree = None
        try:
            tree = graph.eliminateMultifrontal(self._ordering)
            moved = tree.optimize().vector()
        except RuntimeError as error:
            raise SingularSystem(str(error).strip().splitlines()[0]) from error
        if not np.all(np.isfinite(moved)):
            raise SingularSystem("the normal equations have no finite solution")
        if damping == 0 and not parts:
            self._tree, self._tree_at = tree, (state, weights)
        return np.concatenate([moved[: 6 * self.fixed], np.zeros(6), moved[6 * self.fixed :]])

    def marginals(self, edges: Edges, state: State, at: Residuals, weights: Float, poses: list[int]) -> list[Float]:
        """Marginal covariances (6, 6) of poses in their own tangent spaces; zero for the pose that does not move.

        They are those of the last step, where one was eliminated with these weights: it moved next to nothing.

        Raises:
            SingularSystem: Something is not determined.
        """
        moving = [pose for pose in poses if pose != self.fixed]
        try:
            if len(state.q) > MARGINALS_ELIMINATED_POSES_MAX and self.is_iterated(edges, len(state.q)):
                found = self._marginals_iterated(edges, state, at, weights, moving)
            else:
                tree = self._factorised(edges, state, at, weights)
                found = {pose: np.asarray(tree.marginalCovariance(pose)) for pose in moving}
        except (RuntimeError, np.linalg.LinAlgError) as error:
            raise SingularSystem(str(error).strip().splitlines()[0]) from error
        return [0.5 * (found[p] + found[p].T) if p in found else np.zeros((6, 6)) for p in poses]

    def scales_alone(
        self, edges: Edges, state: State, at: Residuals, weights: Float, first: int
    ) -> tuple[Float, Float]:
        """What is left of the normal equations when everything but the scales from `first` on is eliminated.

        Returns:
            Information matrix (K, K) of these scales, and its right side (K,).

        Raises:
            SingularSystem: Something else is not determined.
        """
        graph = self.factors(edges, state, at, weights)
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

    def _factorised(self, edges: Edges, state: State, at: Residuals, weights: Float) -> gtsam.GaussianBayesTree:
        if self._tree is None or self._tree_at is None or not _is_beside((state, weights), self._tree_at):
            graph = self.factors(edges, state, at, weights)
            return graph.eliminateMultifrontal(ordering(graph, len(state.q)))
        return self._tree

    def _marginals_iterated(
        self, edges: Edges, state: State, at: Residuals, weights: Float, poses: list[int]
    ) -> dict[int, Float]:
        """The same by conjugate gradients, one column at a time: elimination of many poses takes much memory."""
        system = self._system(edges, state, at, weights, 0.0)
        found = {}
        for pose in poses:
            rows = slice(6 * pose, 6 * pose + 6)
            columns = [system.solve(column, MARGINALS_TOLERANCE_RATIO) for column in system.units(rows)]
            found[pose] = np.array([np.full(6, np.nan) if x is None else x[rows] for x in columns])
        return found

    def factors(self, edges: Edges, state: State, at: Residuals, weights: Float) -> gtsam.GaussianFactorGraph:
        """Jacobian factors of all edges and of the cluster scales' priors, noise whitened."""
        graph, unit = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create(6)
        add: Callable[..., None] = graph.add
        jac = jacobians(edges, at)
        w = np.sqrt(weights)[:, None]
        whole = bool(np.all(weights == 1.0))
        A_i, A_j = (A if whole else w[:, :, None] * A for A in (jac.A_i, jac.A_j))
        a_scale, b = (w * jac.a_scale)[:, :, None], -w * at.e
        plain = (weights > 0.0) & (edges.cluster < 0) & (edges.i != self.fixed) & (edges.j != self.fixed)
        others = np.flatnonzero((weights > 0.0) & ~plain).tolist()
        of_plain = (x[plain] for x in (edges.i, A_i, edges.j, A_j, b))
        keys_i, rows_i, keys_j, rows_j, right = of_plain
        both = map(add, keys_i.tolist(), rows_i, keys_j.tolist(), rows_j, right, repeat(unit))
        deque(both, maxlen=0)
        for k in others:
            ends = ((int(edges.i[k]), A_i[k]), (int(edges.j[k]), A_j[k]))
            terms = [term for end in ends if end[0] != self.fixed for term in end]
            if edges.cluster[k] >= 0:
                terms += [SCALE_KEYS_FROM + int(edges.cluster[k]), a_scale[k]]
            add(*terms, b[k], unit)
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


def _is_beside(here: tuple[State, Float], there: tuple[State, Float]) -> bool:
    """Whether two states with weights are so alike that so are their covariances."""
    (a, weights_a), (b, weights_b) = here, there
    same = a.t.shape == b.t.shape and np.array_equal(weights_a, weights_b)
    return same and bool(np.abs(a.t - b.t).max() <= BESIDE_M and np.abs(a.q - b.q).max() <= BESIDE_RAD)


def ordering(graph: gtsam.GaussianFactorGraph, poses: int) -> gtsam.Ordering:
    """An order of elimination that fills in little.

    Nested dissection (METIS) takes longer to find, and makes a flat tree: at 100,000 poses four covariances take 0.1 s
    in it, and 15 s in that of COLAMD.
    """
    if poses < DISSECTED_POSES_MIN and graph.size() - poses < DISSECTED_LOOPS_MIN:
        return gtsam.Ordering.ColamdGaussianFactorGraph(graph)
    return gtsam.Ordering.MetisGaussianFactorGraph(graph)


def loose(edges: Edges, weights: Float, poses: int, fixed: int) -> list[int]:
    """The first pose of each part of the graph that no edge with a weight joins to the fixed pose."""
    on = weights > 0.0
    joined = coo_array((np.ones(np.count_nonzero(on), dtype=np.int8), (edges.i[on], edges.j[on])), shape=(poses, poses))
    labels = connected_components(joined, directed=False)[1]
    _, first = np.unique(labels, return_index=True)
    return [int(pose) for pose in first if labels[pose] != labels[fixed]]
