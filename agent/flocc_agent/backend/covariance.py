"""Marginal covariances at the solution, from the normal equations of the last linearisation."""

import logging
from collections.abc import Mapping, Sequence

import numpy as np

from flocc_agent.backend.descent import Objective, Solved
from flocc_agent.backend.edges import residuals
from flocc_agent.backend.linear import SingularSystem
from flocc_agent.backend.problem import Problem
from flocc_agent.backend.trueness import Inflation
from flocc_agent.core.pose_graph import Component, Trajectory
from flocc_agent.geometry import Float, adjoint
from flocc_protocol.ids import KeyframeId, LogId

logger = logging.getLogger(__name__)

COVARIANCE_MAX = 1e30
COVARIANCE_ROUNDS = 5
"""Of a large graph every so many rounds' covariances are computed: they cost as much as a round that adds little."""
EVERY_ROUND_POSES_MAX = 2000
"""Of a smaller graph that was eliminated every round's are."""


def covariances_of(
    problem: Problem,
    objective: Objective,
    solved: Solved,
    trajectories: Mapping[LogId, Trajectory],
    wanted: Sequence[KeyframeId],
    larger: Mapping[LogId, Inflation],
) -> tuple[dict[LogId, Float | None], dict[KeyframeId, Float]]:
    """Marginal covariances (6, 6), relative to the anchor's first keyframe, made larger as residuals say.

    Returns:
        Of every log's `T_map_odom` in the tangent space of that pose (None where not configured or computable), and of
        the wanted keyframes in their own tangent spaces. With `T_map_odom = T_map_keyframe T_odom_keyframe^-1`, a
        tangent vector of the last keyframe is moved by the adjoint of its `T_odom_keyframe`.
    """
    of_logs: dict[LogId, Float | None] = dict.fromkeys(problem.logs)
    if not objective.config.covariances:
        return of_logs, {}
    last = [KeyframeId(log, len(trajectories[log]) - 1) for log in problem.logs]
    every = [*last, *(keyframe for keyframe in wanted if keyframe.index < len(trajectories[keyframe.log]))]
    try:
        marginals = keyframe_covariances(objective, solved, [problem.index(keyframe) for keyframe in every])
    except SingularSystem as error:
        logger.warning("%s: no covariances, the graph is too badly conditioned: %.80s", problem.logs[0], error)
        return of_logs, {}
    marginals = [larger[keyframe.log].of(S) for keyframe, S in zip(every, marginals, strict=True)]
    for keyframe, S in zip(last, marginals, strict=False):
        Ad = adjoint(np.asarray(trajectories[keyframe.log].T_odom_keyframe[-1], dtype=float))
        of_logs[keyframe.log] = _usable(Ad @ S @ Ad.T)
    of_wanted = zip(every[len(last) :], marginals[len(last) :], strict=True)
    return of_logs, {keyframe: S for keyframe, S in of_wanted if _usable(S) is not None}


def kept_covariances(
    objective: Objective, problem: Problem, earlier: Component | None, wanted: Sequence[KeyframeId]
) -> Mapping[LogId, Float | None] | None:
    """The earlier round's covariances of the same logs, where they stand for this one; None where they are due.

    They do for `COVARIANCE_ROUNDS` rounds of a large graph, and where the solver does not leave them over.
    """
    are_cheap = objective.linear.leaves_covariances and problem.poses <= EVERY_ROUND_POSES_MAX
    if earlier is None or wanted or are_cheap:
        return None
    stand = earlier.covariance_rounds + 1 < COVARIANCE_ROUNDS and earlier.logs == problem.logs
    known = all(earlier.covariance_map_odom.get(log) is not None for log in problem.logs)
    return earlier.covariance_map_odom if stand and known else None


def keyframe_covariances(objective: Objective, solved: Solved, indices: Sequence[int]) -> list[Float]:
    """Marginal covariance (6, 6) of poses in their own tangent spaces; zero for the pose that does not move."""
    at = residuals(objective.edges, solved.state)
    return objective.linear.marginals(objective.edges, solved.state, at, solved.weights, list(indices))


def _usable(S: Float) -> Float | None:
    """A covariance, or None for what rounding made of it in a badly conditioned graph."""
    return S if np.all(np.isfinite(S)) and np.all(np.diag(S) >= 0) and np.max(S) < COVARIANCE_MAX else None
