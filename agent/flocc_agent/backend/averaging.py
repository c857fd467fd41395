"""A start for graphs whose odometry is too far off: rotations averaged over all edges, then positions.

Carlone et al. 2015, by GTSAM.
"""

import gtsam
import numpy as np

from flocc_agent.backend.edges import Edges, State, state_of
from flocc_agent.backend.rotations import matrices

ANCHOR_SIGMA = 1e-3


def averaged(edges: Edges, state: State, fixed: int) -> State | None:
    """Poses from GTSAM's chordal rotation averaging, the fixed one where it is; None where there is no such start."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    R = matrices(edges.q_hat)
    t = np.einsum("eij,ej->ei", R, edges.d[:, 3:])
    noise = gtsam.noiseModel.Unit.Create(6)
    for i, j, R_hat, t_hat in zip(edges.i.tolist(), edges.j.tolist(), R, t, strict=True):
        graph.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(gtsam.Rot3(R_hat), t_hat), noise))
    for n, T in enumerate(state.poses()):
        values.insert(n, gtsam.Pose3(T))
    anchor = gtsam.noiseModel.Isotropic.Sigma(6, ANCHOR_SIGMA)
    graph.add(gtsam.PriorFactorPose3(fixed, values.atPose3(fixed), anchor))
    try:
        found = gtsam.InitializePose3.initialize(graph)
        T = np.array([found.atPose3(n).matrix() for n in range(len(state.q))])
    except RuntimeError:
        return None
    if not np.all(np.isfinite(T)):
        return None
    moved = state.poses()[fixed] @ np.linalg.inv(T[fixed]) @ T
    return State(state_of(moved).q, moved[:, :3, 3].copy(), state.scale)
