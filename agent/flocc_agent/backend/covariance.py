"""Marginal covariances at the solution, from the Bayes tree of the last linearisation."""

from collections.abc import Mapping

import gtsam
import numpy as np

from flocc_agent.backend.edges import jacobians, residuals
from flocc_agent.backend.linear import LinearSolver
from flocc_agent.backend.problem import Problem
from flocc_agent.backend.solvers import WEIGHT_MIN, Solved
from flocc_agent.core.pose_graph import Trajectory
from flocc_agent.geometry import Float, hat
from flocc_protocol.ids import LogId


def adjoint(T: Float) -> Float:
    """Adjoint (6, 6) of a pose, rotation first."""
    R, t = T[:3, :3], T[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = hat(t) @ R
    return out


def keyframe_covariances(problem: Problem, solved: Solved, linear: LinearSolver, indices: list[int]) -> list[Float]:
    """Marginal covariance (6, 6) of poses in their own tangent spaces, relative to the anchor's first keyframe."""
    at = residuals(problem.edges, solved.state)
    jac = jacobians(problem.edges, at)
    sqrt_weights = np.sqrt(np.maximum(solved.weights, WEIGHT_MIN))
    graph = linear.factors(problem.edges, solved.state, at, jac, sqrt_weights)
    tree = graph.eliminateMultifrontal(gtsam.Ordering.ColamdGaussianFactorGraph(graph))
    return [
        np.zeros((6, 6)) if index == linear.fixed else np.asarray(tree.marginalCovariance(index)) for index in indices
    ]


def covariances_map_odom(
    problem: Problem, trajectories: Mapping[LogId, Trajectory], solved: Solved, linear: LinearSolver
) -> dict[LogId, Float]:
    """Marginal covariance (6, 6) of every log's `T_map_odom`, in the tangent space of that pose.

    `T_map_odom = T_map_keyframe T_odom_keyframe^-1`, so a tangent vector of the keyframe is moved by the adjoint of
    `T_odom_keyframe`.
    """
    last = [problem.offsets[log] + len(trajectories[log]) - 1 for log in problem.logs]
    moved = {}
    for log, S in zip(problem.logs, keyframe_covariances(problem, solved, linear, last), strict=True):
        Ad = adjoint(np.asarray(trajectories[log].T_odom_keyframe[-1]))
        moved[log] = 0.5 * (Ad @ S @ Ad.T + (Ad @ S @ Ad.T).T)
    return moved
