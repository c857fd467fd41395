"""All relative measurements of a component as arrays: residuals and Jacobians for every edge at once.

An edge joins two poses. With `R_ij = R_i^T R_j`, `p = R_i^T (t_j - t_i)` and a relative scale gamma (1 at the
initial scale) the residual is

    e = [ 2 vec(q(R_hat^T R_ij)) ; R_hat^T p - gamma * d ],     d = scale_initial * R_hat^T t_hat

Its rotation part agrees with the logarithm to third order (|2 sin(theta/2)| against theta), is bounded, and its
squared norm is half the squared chordal distance of SE-Sync. Its translation part is linear in the scale, with
derivative -R_hat^T t_hat (DESIGN.md section 7), so that Gaussian scales are eliminated exactly:

- a scale `gamma ~ N(c, sigma^2)` of its own turns the covariance into `Sigma + sigma^2 d d^T` (widened edge);
- what is left is the cluster's scale c: one variable for many closures, or the constant 1.

A scale of odometry is asked for in another form: what was measured is noisy, and a factor of it is found too small, as
in any regression on what is noisy. There c divides the poses, `e = [ 2 vec(q(R_hat^T R_ij)) ; R_hat^T p / c - d ]`.

Where nothing is known of a closure's unit its uncertainty is known in that unit alone: a direction is a direction,
however long. In metres such an edge costs less the nearer its poses are, and many of them shrink the map. At the end it
is told by its angle theta instead, with `q = R_hat^T p` and u its whitened direction,

    e_t = (2 sin(theta / 2) |L d| n + (|q| / |d| - 1) / sigma * u) |q| / sqrt(|q|^2 + NEAR_M^2),   n across u:

the chord grows up to half a turn, so that there is a way back from the side, where a sine's slope is zero; poses that
coincide have no direction, so that what is nearer than `NEAR_M` counts in metres, the wide prior on lengths, too: else
its slope grows without bound there, and two poses that meet make the system singular. The search is made in metres at
a length that is fitted to neighbours, where scales may pass through zero (`residuals`, `hold`).

A scale is kept above `GAMMA_MIN`: an edge whose best scale lies below is held there, and pays for the distance to c.
Updates are on the right: `R <- R Exp(omega)`, `t <- t + R v`; the tangent order is rotation, translation.
"""

from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend import rotations
from flocc_agent.geometry import quaternions

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

GAMMA_MIN = 1e-3
TINY, ROOM_MIN = 1e-12, 1e-9
NEAR_M = 1.0
"""Poses that are nearer say little by their direction: they are counted as if they were so far apart."""
HALF_TURN_COSINE = 1e-4
"""Cosine of half a rotation error below which that error is a half turn, where its square has no slope."""
NUDGE_RAD = 3e-3
NO_CLUSTER = -1


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Poses and cluster scales of one component.

    Attributes:
        q: (N, 4) unit quaternions, w first.
        t: (N, 3) metres.
        scale: (C,) relative scales of clusters, around 1.
    """

    q: Float
    t: Float
    scale: Float

    def retract(self, delta: Float) -> "State":
        """Move by a tangent vector (6 N + C,): poses first, six numbers each, then cluster scales."""
        n = len(self.q)
        xi = delta[: 6 * n].reshape(n, 6)
        q = rotations.multiply(self.q, rotations.exponential(xi[:, :3]))
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        t = self.t + np.einsum("nij,nj->ni", rotations.matrices(self.q), xi[:, 3:])
        return State(q, t, self.scale + delta[6 * n :])

    def poses(self) -> Float:
        """The poses as (N, 4, 4)."""
        T = np.zeros((len(self.q), 4, 4))
        T[:, :3, :3] = rotations.matrices(self.q)
        T[:, :3, 3] = self.t
        T[:, 3, 3] = 1.0
        return T


def state_of(T: Float, clusters: int = 0) -> State:
    """State of poses (N, 4, 4) with every cluster at its initial scale."""
    return State(quaternions(T[:, :3, :3]), T[:, :3, 3].copy(), np.ones(clusters))


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Relative measurements of one component.

    Attributes:
        i: (E,) index of the first pose.
        j: (E,) index of the second pose.
        q_hat: (E, 4) measured rotation `R_i_j`.
        d: (E, 6) derivative of the measurement by gamma: zeros, then `scale_initial * R_hat^T t_hat`.
        sqrt_information: (E, 6, 6) with `L^T L` the information of the measurement without its scale.
        sqrt_information_wide: (E, 6, 6) the same with the edge's own scale eliminated; equal where it has none.
        sigma: (E,) standard deviation of the own scale around c; 0 where it has none.
        cluster: (E,) index of the cluster scale, or -1 for the constant 1.
        divides: (E,) whether a scale divides the poses, instead of multiplying the measurement: that of odometry (sigma
            is 0), or an own one of which nothing is known: those edges are directions.
    """

    i: Int
    j: Int
    q_hat: Float
    d: Float
    sqrt_information: Float
    sqrt_information_wide: Float
    sigma: Float
    cluster: Int
    divides: Bool

    def __len__(self) -> int:
        return len(self.i)


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """What every edge says at a state.

    Attributes:
        e: (E, 6) whitened residuals.
        held: (E,) whether the scale is held at its lower bound.
        bound: (E,) whitened distance of a held scale to its cluster's scale, else 0.
        q_error: (E, 4) rotation error, w not negative.
        p: (E, 3) position of the second pose in the first.
        L: (E, 6, 6) the square-root information that was used, over the scale where that divides the poses.
        rho: (E,) one over the scale that divides the poses, else 1.
    """

    e: Float
    held: Bool
    bound: Float
    q_error: Float
    p: Float
    L: Float
    rho: Float

    def squared(self) -> Float:
        """Squared Mahalanobis norms (E,)."""
        return np.asarray(np.einsum("ei,ei->e", self.e, self.e) + self.bound**2)


@dataclass(frozen=True, slots=True, eq=False)
class Jacobians:
    """Whitened derivatives of the residuals: `A_i`, `A_j` (E, 6, 6) and `a_scale` (E, 6) by the cluster's scale.

    Each matrix is column-major.
    """

    A_i: Float
    A_j: Float
    a_scale: Float


def cluster_scales(edges: Edges, state: State) -> Float:
    """Scale c (E,) around which each edge's own scale lies."""
    if len(state.scale) == 0:
        return np.ones(len(edges))
    return np.where(edges.cluster >= 0, state.scale[np.maximum(edges.cluster, 0)], 1.0)


def _unscaled(edges: Edges, state: State) -> tuple[Float, Float, Float]:
    """Residuals (E, 6) at gamma = 0, rotation errors and relative positions."""
    q_i_inverse = rotations.conjugate(state.q[edges.i])
    q_ij = rotations.multiply(q_i_inverse, state.q[edges.j])
    q_error = rotations.multiply(rotations.conjugate(edges.q_hat), q_ij)
    q_error = np.where(q_error[:, :1] < 0, -q_error, q_error)
    p = np.einsum("eij,ej->ei", rotations.matrices(q_i_inverse), state.t[edges.j] - state.t[edges.i])
    R_hat_inverse = rotations.matrices(rotations.conjugate(edges.q_hat))
    return np.concatenate([2.0 * q_error[:, 1:], np.einsum("eij,ej->ei", R_hat_inverse, p)], axis=1), q_error, p


def residuals(edges: Edges, state: State, hold: bool = True) -> Residuals:
    """Whitened residuals of all edges, own scales eliminated.

    Without `hold`, for the search, scales may pass their lower bound and directions are told in metres.
    """
    e0, q_error, p = _unscaled(edges, state)
    c = cluster_scales(edges, state)
    e = np.einsum("eij,ej->ei", edges.sqrt_information_wide, e0 - c[:, None] * edges.d)
    gamma = own_scales(edges, e, c)
    held = (edges.sigma > 0) & (gamma < GAMMA_MIN) & hold
    bound = np.zeros(len(edges))
    L = edges.sqrt_information_wide
    if np.any(held):
        L = np.where(held[:, None, None], edges.sqrt_information, L)
        e[held] = np.einsum("eij,ej->ei", L[held], e0[held] - GAMMA_MIN * edges.d[held])
        bound[held] = (GAMMA_MIN - c[held]) / edges.sigma[held]
    rho = np.ones(len(edges))
    rows = np.flatnonzero(edges.divides & (edges.sigma == 0))
    if len(rows):
        L, rho[rows] = L.copy(), 1.0 / c[rows]
        L[rows, :, 3:] *= rho[rows, None, None]
        measured = np.einsum("eij,ej->ei", edges.sqrt_information[rows], edges.d[rows])
        e[rows] = np.einsum("eij,ej->ei", L[rows], e0[rows]) - measured
    rows = np.flatnonzero(directions(edges) & hold)
    if len(rows):
        L, bound[rows], held[rows] = L.copy(), 0.0, False
        e[rows], L[rows] = _angles(taken(edges, rows), e0[rows])
    return Residuals(e, held, bound, q_error, p, L, rho)


def directions(edges: Edges) -> Bool:
    """Which edges (E,) measure a direction, in whose unit their uncertainty is told."""
    return edges.divides & (edges.sigma > 0)


def _angles(edges: Edges, e0: Float) -> tuple[Float, Float]:
    """Whitened residuals (E, 6) of directions, and what poses enter by (E, 6, 6); e0 are those at gamma = 0."""
    L, q = edges.sqrt_information, e0[:, 3:]
    by_rho = np.einsum("eij,ej->ei", L[:, :, 3:], q)
    measured = np.einsum("eij,ej->ei", L, edges.d)
    far, size = np.linalg.norm(by_rho, axis=1), np.linalg.norm(measured, axis=1)
    far = np.maximum(far, TINY)
    u, ahead = by_rho / far[:, None], measured / size[:, None]
    cosine = np.einsum("ei,ei->e", u, ahead)
    room = np.maximum(1.0 + cosine, ROOM_MIN)
    length_m, d_m = np.maximum(np.linalg.norm(q, axis=1), TINY), np.linalg.norm(edges.d, axis=1)
    spread_m = np.sqrt(length_m**2 + NEAR_M**2)
    apart = length_m / spread_m
    chord = np.sqrt(2.0 / room) * apart
    sine = (size * cosine)[:, None] * u - measured
    prior = (length_m / d_m - 1.0) / edges.sigma * apart
    nearness_by_q = q * (NEAR_M / (length_m * spread_m))[:, None] ** 2
    e = np.einsum("eij,ej->ei", L[:, :, :3], e0[:, :3]) + chord[:, None] * sine + prior[:, None] * u
    u_by_q = (L[:, :, 3:] - u[:, :, None] * np.einsum("ei,eij->ej", u, L[:, :, 3:])[:, None, :]) / far[:, None, None]
    sideways = np.einsum("eij,ei->ej", u_by_q, measured)
    by_length = q / (spread_m * d_m * edges.sigma)[:, None] + prior[:, None] * nearness_by_q + chord[:, None] * sideways
    by_chord = nearness_by_q - (0.5 / (room * size))[:, None] * sideways
    by_pose = L.copy()
    by_pose[:, :, 3:] = (chord * size * cosine + prior)[:, None, None] * u_by_q
    by_pose[:, :, 3:] += u[:, :, None] * by_length[:, None, :]
    by_pose[:, :, 3:] += (chord[:, None] * sine)[:, :, None] * by_chord[:, None, :]
    return e, by_pose


def off_half_turns(edges: Edges, state: State) -> State:
    """Turn poses a little whose edges are wrong by half a turn: `2 vec(q)` is stationary there, at its worst."""
    _, q_error, _ = _unscaled(edges, state)
    delta = np.zeros(6 * len(state.q) + len(state.scale))
    for k in np.flatnonzero(q_error[:, 0] < HALF_TURN_COSINE).tolist():
        axis = q_error[k, 1:] / np.linalg.norm(q_error[k, 1:])
        later = max(int(edges.i[k]), int(edges.j[k]))
        if later == edges.i[k]:
            q_ij = rotations.multiply(rotations.conjugate(state.q[edges.i[k]][None]), state.q[edges.j[k]][None])
            axis = -rotations.matrices(q_ij)[0] @ axis
        delta[6 * later : 6 * later + 3] = NUDGE_RAD * axis
    return state.retract(delta) if delta.any() else state


def own_scales(edges: Edges, e_wide: Float, c: Float) -> Float:
    """Best scale (E,) of each edge, given residuals whitened with the wide information: the posterior mean."""
    whitened_d = np.einsum("eij,ej->ei", edges.sqrt_information_wide, edges.d)
    return np.asarray(c + edges.sigma**2 * np.einsum("ei,ei->e", whitened_d, e_wide))


def scales_at(edges: Edges, state: State) -> Float:
    """Relative scale (E,) of every edge at a state, not below `GAMMA_MIN`."""
    e0, _, _ = _unscaled(edges, state)
    c = cluster_scales(edges, state)
    e = np.einsum("eij,ej->ei", edges.sqrt_information_wide, e0 - c[:, None] * edges.d)
    scales = np.where(edges.sigma > 0, np.maximum(own_scales(edges, e, c), GAMMA_MIN), c)
    rows, q = directions(edges), e0[:, 3:]
    ahead = np.einsum("ei,ei->e", q, edges.d[:, 3:]) > 0.0
    lengths = np.linalg.norm(q[rows], axis=1) / np.linalg.norm(edges.d[rows], axis=1)
    scales[rows] = np.where(ahead[rows], np.maximum(lengths, GAMMA_MIN), GAMMA_MIN)
    return scales


def jacobians(edges: Edges, at: Residuals) -> Jacobians:
    """Derivatives of the whitened residuals, in the right tangent spaces of both poses."""
    R_hat_inverse = rotations.matrices(rotations.conjugate(edges.q_hat))
    R_error = rotations.matrices(at.q_error)
    J_r = rotations.hats(at.q_error[:, 1:]) + at.q_error[:, 0, None, None] * np.eye(3)
    J = np.zeros((len(edges), 6, 12))
    # R_ij^T = R_error^T R_hat^T
    J[:, :3, :3] = -J_r @ np.swapaxes(R_error, 1, 2) @ R_hat_inverse
    J[:, 3:, :3] = R_hat_inverse @ rotations.hats(at.p)
    J[:, 3:, 3:6] = -R_hat_inverse
    J[:, :3, 6:9] = J_r
    J[:, 3:, 9:] = R_error
    A = np.swapaxes(np.swapaxes(J, 1, 2) @ np.swapaxes(at.L, 1, 2), 1, 2)
    return Jacobians(A[:, :, :6], A[:, :, 6:], scale_slopes(edges, at))


def scale_slopes(edges: Edges, at: Residuals) -> Float:
    """Whitened derivatives (E, 6) of the residuals by the scale of the edge's cluster; zero where it has none."""
    slopes = np.zeros((len(edges), 6))
    on = np.flatnonzero((edges.cluster >= 0) & ~at.held & ~edges.divides)
    slopes[on] = -np.einsum("eij,ej->ei", at.L[on], edges.d[on])
    rows = np.flatnonzero(edges.divides & (edges.cluster >= 0))
    q = np.einsum("eji,ej->ei", rotations.matrices(edges.q_hat[rows]), at.p[rows])
    slopes[rows] = -at.rho[rows, None] * np.einsum("eij,ej->ei", at.L[rows, :, 3:], q)
    return slopes


Record = TypeVar("Record", Edges, Residuals)


def taken(record: Record, rows: Int | slice) -> Record:
    """Some of the edges, or what they say."""
    return type(record)(*(getattr(record, field.name)[rows] for field in fields(record)))
