"""Passages: closures of one place that agree with each other and were turned away together.

A right closure that closes a long loop is far off at first, by all that odometry drifted on the way, and a search lets
go of it where others pull first. Its residual says nothing then: it is measured in the closure's own covariance. What
it would cost to take the passage in does say something, and one factorisation of the normal equations tells it of all
passages: with residuals r, Jacobian J and the covariance P of the poses that the others give, the least cost rises by

    1/2 r^T (I + J P J^T)^-1 r     (whitened; linear in the poses),

which is the residual measured in the closure's covariance and in all that odometry and the other closures allow.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import splu

from flocc_agent.backend.alignment import evenly
from flocc_agent.backend.descent import Objective
from flocc_agent.backend.edges import State, jacobians, residuals, taken
from flocc_agent.backend.linear import SingularSystem

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

ASKED_MAX = 2
"""Closures of a passage that are asked, its ends: they agree with each other, and fewer never cost more."""
TETHER = 1e-6
"""Information by which what nothing holds stays where it is."""
SLACK = 1.5
"""A passage is tried where it costs at most so many times what it saves: the prediction is linear, turns are not."""
TRIED_MAX = 8
"""Passages that are tried from one solution, the most promising ones first."""
PASSAGES_MAX = 100
"""Passages that are asked, those with most votes."""


def passages(objective: Objective, state: State, chosen: Bool, votes: Float, groups: Int) -> Iterator[Bool]:
    """The closures (L,) of passages that are not chosen and would save more than they cost, or nearly so.

    None of graphs that conjugate gradients solve: factorising them takes long.

    Args:
        objective: What is minimised.
        state: Where a search ended.
        chosen: (L,) closures that it uses.
        votes: (L,) of each closure.
        groups: (L,) number of the group of closures of one place that agree, of each closure.
    """
    if objective.linear.is_iterated(objective.edges, len(state.q)):
        return
    found = [~chosen & (groups == group) for group in np.unique(groups[~chosen])]
    if objective.held is not None:
        found = [members for members in found if members.sum() > 1 or not np.any(members & objective.held)]
    found = sorted(found, key=lambda members: -votes[members].sum())[:PASSAGES_MAX]
    if not found:
        return
    saved = np.array([0.5 * (votes * objective.bounds())[members].sum() for members in found])
    asked = [objective.closures.start + evenly(np.flatnonzero(members), ASKED_MAX) for members in found]
    try:
        costs = added_costs(objective, state, objective.weights(chosen.astype(float)), asked)
    except SingularSystem:
        return
    promising = np.flatnonzero(costs <= SLACK * saved)
    for n in promising[np.argsort((costs - saved)[promising], kind="stable")][:TRIED_MAX].tolist():
        yield found[n]


def added_costs(objective: Objective, state: State, weights: Float, groups: Sequence[Int]) -> Float:
    """By how much the least cost rises where each of some groups of edges takes part, too; linear in the poses.

    Args:
        objective: What is minimised.
        state: An optimum for the weights.
        weights: (E,) of all edges.
        groups: Numbers of the edges of each group.

    Returns:
        (K,) one cost of each group.

    Raises:
        SingularSystem: The factorisation fails.
    """
    hold, fixed = objective.has_directions, 6 * objective.linear.fixed
    moving = np.delete(np.arange(6 * len(state.q) + len(state.scale)), np.arange(fixed, fixed + 6))
    rows = np.flatnonzero(weights > 0.0)
    A = _jacobian(objective, state, rows, hold)[:, moving]
    by_edge = diags_array(np.repeat(weights[rows], 6))
    sigma = np.broadcast_to(objective.linear.scale_prior_sigma, state.scale.shape)
    prior = np.concatenate([np.full(len(moving) - len(state.scale), TETHER), 1.0 / sigma**2])
    H = csc_array(A.T @ by_edge @ A + diags_array(prior))
    try:
        factors = splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:
        raise SingularSystem(str(error)) from error
    costs = []
    for group in groups:
        J = _jacobian(objective, state, group, hold)[:, moving]
        r = residuals(taken(objective.edges, group), state, hold).e.ravel()
        S = np.eye(len(r)) + J @ factors.solve(J.T.toarray())
        costs.append(0.5 * float(r @ np.linalg.solve(S, r)))
    return np.array(costs)


def _jacobian(objective: Objective, state: State, rows: Int, hold: bool) -> csc_array:
    """Derivatives (6 E, 6 N + C) of the whitened residuals of some edges."""
    edges, poses = taken(objective.edges, rows), len(state.q)
    by = jacobians(edges, residuals(edges, state, hold))
    n, six = len(rows), np.arange(6)
    row = np.broadcast_to((6 * np.arange(n)[:, None] + six)[:, :, None], (n, 6, 6))
    entries = [
        (values, row, np.broadcast_to((6 * ends[:, None] + six)[:, None, :], (n, 6, 6)))
        for values, ends in ((by.A_i, edges.i), (by.A_j, edges.j))
    ]
    scaled = edges.cluster >= 0
    of_scale = np.broadcast_to((6 * poses + edges.cluster[scaled])[:, None], (int(scaled.sum()), 6))
    entries.append((by.a_scale[scaled], row[scaled][:, :, 0], of_scale))
    values, i, j = (np.concatenate([np.ravel(entry[k]) for entry in entries]) for k in range(3))
    return csc_array(coo_array((values, (i, j)), shape=(6 * n, 6 * poses + len(state.scale))))
