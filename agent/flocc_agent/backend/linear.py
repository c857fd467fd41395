"""One linear least-squares step: Jacobians in numpy, elimination in GTSAM's C++ (multifrontal Cholesky)."""

from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.edges import Edges, Jacobians, Residuals, State

Float = NDArray[np.float64]

SCALE_KEYS_FROM = 1 << 40


class SingularSystem(Exception):
    """The normal equations have no unique solution; damp them or give up."""


@dataclass(slots=True)
class LinearSolver:
    """Solves the normal equations of one component again and again, with one elimination ordering.

    Attributes:
        fixed: Index of the pose that does not move (the anchor's first keyframe).
        scale_prior_sigma: Standard deviation of a cluster's scale around 1.
        solves: How many systems were solved.
    """

    fixed: int
    scale_prior_sigma: float
    solves: int = 0
    _ordering: gtsam.Ordering | None = field(default=None, repr=False)

    def step(
        self, edges: Edges, state: State, at: Residuals, jac: Jacobians, sqrt_weights: Float, damping: float
    ) -> Float:
        """Solve for the tangent vector (6 N + C,) that reduces the linearised cost most.

        Raises:
            SingularSystem: Something is not determined.
        """
        graph = self.factors(edges, state, at, jac, sqrt_weights)
        if damping > 0:
            self._damp(graph, len(state.q), len(state.scale), damping)
        self.solves += 1
        if self._ordering is None:
            self._ordering = gtsam.Ordering.ColamdGaussianFactorGraph(graph)
        try:
            delta = graph.optimize(self._ordering)
        except RuntimeError as error:
            raise SingularSystem(str(error).splitlines()[0]) from error
        return self._unpack(delta)

    def factors(
        self, edges: Edges, state: State, at: Residuals, jac: Jacobians, sqrt_weights: Float
    ) -> gtsam.GaussianFactorGraph:
        """Jacobian factors of all edges and of the cluster scales' priors, noise whitened."""
        graph = gtsam.GaussianFactorGraph()
        w = sqrt_weights[:, None, None]
        A_i, A_j, b = w * jac.A_i, w * jac.A_j, -sqrt_weights[:, None] * at.e
        a_scale = (sqrt_weights[:, None] * jac.a_scale)[:, :, None]
        fixed, add = self.fixed, graph.add
        scale_keys = np.where(edges.cluster >= 0, SCALE_KEYS_FROM + edges.cluster, -1).tolist()
        for k, (i, j, scale_key) in enumerate(zip(edges.i.tolist(), edges.j.tolist(), scale_keys, strict=True)):
            if scale_key >= 0:
                if i == fixed:
                    add(j, A_j[k], scale_key, a_scale[k], b[k])
                elif j == fixed:
                    add(i, A_i[k], scale_key, a_scale[k], b[k])
                else:
                    add(i, A_i[k], j, A_j[k], scale_key, a_scale[k], b[k])
            elif i == fixed:
                add(j, A_j[k], b[k])
            elif j == fixed:
                add(i, A_i[k], b[k])
            else:
                add(i, A_i[k], j, A_j[k], b[k])
        self._add_scale_rows(graph, edges, state, at, sqrt_weights)
        return graph

    def _add_scale_rows(
        self, graph: gtsam.GaussianFactorGraph, edges: Edges, state: State, at: Residuals, sqrt_weights: Float
    ) -> None:
        one = np.full((1, 1), 1.0 / self.scale_prior_sigma)
        for c, scale in enumerate(state.scale.tolist()):
            graph.add(SCALE_KEYS_FROM + c, one, np.array([(1.0 - scale) / self.scale_prior_sigma]))
        for k in np.flatnonzero(at.held & (edges.cluster >= 0)).tolist():
            slope = np.full((1, 1), -sqrt_weights[k] / edges.sigma[k])
            graph.add(SCALE_KEYS_FROM + int(edges.cluster[k]), slope, np.array([-sqrt_weights[k] * at.bound[k]]))

    def _damp(self, graph: gtsam.GaussianFactorGraph, poses: int, clusters: int, damping: float) -> None:
        root = np.sqrt(damping)
        pose_rows, pose_zeros = root * np.eye(6), np.zeros(6)
        for n in range(poses):
            if n != self.fixed:
                graph.add(n, pose_rows, pose_zeros)
        for c in range(clusters):
            graph.add(SCALE_KEYS_FROM + c, np.full((1, 1), root), np.zeros(1))

    def _unpack(self, delta: gtsam.VectorValues) -> Float:
        """Values in key order, with zeros at the fixed pose."""
        moved = delta.vector()
        return np.concatenate([moved[: 6 * self.fixed], np.zeros(6), moved[6 * self.fixed :]])
