"""Consensus of a robot's pose graph with its neighbours': poses on both sides, told with the forces on them.

After MESA (McGann, Lassak and Kaess 2023, arXiv 2310.12320) and iMESA (McGann and Kaess 2024, arXiv 2406.07371): every
robot solves its whole own graph, and poses that two robots share are held together pair by pair, by a prior that a
dual variable biases. What is different is the penalty, and with it the form of what travels:

- The lower robot of a closure owns it and keeps a copy of the other's pose. The poses of the higher robot at such
  closures are what the pair shares; no robot reads another's odometry, and nothing is pinned.
- A robot tells a neighbour, for each shared pose, where it has it (`T`) and the gradient there of everything it knows
  but by that neighbour (`force`, in the pose's own tangent, so that frames may turn). Both replace the target and the
  dual of ADMM: the receiver minimises `f(x) + force . d + penalty(x, T)` with d from T to x. At rest all d are zero and
  forces are opposite, whatever the penalty is; a message that is lost costs time only, the newest one counts.
- The penalty is the geometric mean of how stiff both robots hold the shared poses (`shared_stiffness`). The higher
  robot tells how stiff it holds them after a few steps; the lower one makes the penalty, numbered by its step, and says
  with each word by which one it was said. The higher robot answers by the penalty of the word that it heard last, or
  has not heard it. So no robot gets an answer to its own answer that was made by another penalty, whatever is lost,
  late or said twice. Where that happens they drive each other away: of robots that hold the poses with stiffnesses a
  and b, one returns `(W - b) / (W + a)` of an error and the other `(V - a) / (V + b)`, together below one for W = V,
  but without bound else.
- What is heard replaces only a part of what was heard before (`RELAXATION` in `consensus_pair.py`): the rest keeps its
  pull at the same poses. One half is ADMM, a whole one need not come to rest.

Unknown scales: a scale of its own is eliminated before anything else sees it (`edges`); those of clusters belong to
one pair, and so are the owner's alone. Weights of closures are the owner's as well, and constants here: decided while
robots still move, they let go of all closures, because the forces that answered them stay (docs/distributed-mode.md).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from flocc_agent.backend.consensus_pair import PairedRobot, Tidings, number_of
from flocc_agent.backend.descent import LENGTHS
from flocc_agent.backend.edges import NEAR_M, TINY, Edges, Residuals, State, jacobians, residuals, state_of
from flocc_agent.backend.problem import closure_edges, concatenate, initial_scale, odometry_edges
from flocc_agent.backend.shared_stiffness import SharedStiffness, rows_of, stiffness_of
from flocc_agent.config import BackendConfig
from flocc_agent.core.own_part import Apart, OwnedClosure
from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_agent.geometry import inverse
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]

ANCHORING_FLOATING = 1e-3
"""Part of the closures' information that holds a robot which nothing else holds, where its stiffness is asked for. At
each pose, so that a hundred of them hold a long chain a hundred times: with 0.03 chains take three times as long."""
TETHER_RATIO = 1e-9
"""Of the mean stiffness, on every pose: a graph that floats has no unique step."""


@dataclass(slots=True, eq=False)
class ConsensusPart:
    """One robot's part of a pose graph, and what its neighbours say.

    Attributes:
        log: The robot.
        config: Formulation and noise model.
        own: Number of its own keyframes; copies of others' come after them.
        edges: Odometry, then the closures that it owns.
        neighbours: By their log.
        state: Where it stands.
        weights: (E,) of the own edges, in [0, 1].
    """

    log: LogId
    config: BackendConfig
    own: int
    edges: Edges
    neighbours: dict[LogId, PairedRobot]
    state: State
    weights: Float

    @property
    def T(self) -> Float:
        """Poses (N, 4, 4) of the own keyframes in the common frame."""
        return self.state.poses()[: self.own]

    def step(self, number: int) -> dict[LogId, str]:
        """One Gauss-Newton step, shortened where it leads up, down the own cost and what neighbours ask for.

        Args:
            number: Of the step: higher than any before.

        Returns:
            Neighbours who told a stiffness that cannot be, and why; it counts for nothing.
        """
        H, gradient = self._normal()
        T = self.state.poses()
        for neighbour in self._heard():
            np.add.at(gradient, rows_of(neighbour.index), neighbour.pull(T[neighbour.index]))
        delta = -_factor(H).solve(gradient)
        if np.all(np.isfinite(delta)):
            self.state = self._shortened(delta, self.merit(self.state))
        for neighbour in self.neighbours.values():
            neighbour.steps += 1
        asked = [other for other, neighbour in self.neighbours.items() if neighbour.is_asked]
        refused: dict[LogId, str] = {}
        for other, stiffness in {other: self._stiffness(other) for other in asked}.items():
            try:
                self.neighbours[other].stiffen(stiffness, number, self._shared(other))
            except (ValueError, np.linalg.LinAlgError) as error:
                refused[other] = str(error)
        return refused

    def tell(self, other: LogId) -> Tidings:
        """What a neighbour hears after this step."""
        neighbour = self.neighbours[other]
        T, ours = self._shared(other), neighbour.ours
        force = np.zeros((len(T), 6)) if neighbour.T is None else -neighbour.pull(T).reshape(-1, 6)
        stiffness = None if ours is None or ours.number == neighbour.known else ours.stiffness
        return Tidings(T, force, number_of(neighbour.theirs), number_of(ours), stiffness)

    def hear(self, other: LogId, told: Tidings) -> None:
        """Take what a neighbour said.

        Raises:
            ValueError: It cannot be; nothing has changed.
        """
        told.check(len(self.neighbours[other].index))
        self.neighbours[other].hear(told, self._shared(other))

    def apart(self, other: LogId) -> Apart:
        """How far a neighbour that was heard is."""
        return self.neighbours[other].apart(self._shared(other))

    def _shared(self, other: LogId) -> Float:
        """Where it has (S, 4, 4) the poses that it shares with a neighbour."""
        return self.state.poses()[self.neighbours[other].index]

    def _heard(self) -> list[PairedRobot]:
        return [neighbour for neighbour in self.neighbours.values() if neighbour.T is not None]

    def _stiffness(self, other: LogId) -> SharedStiffness:
        """How stiff the shared poses are by all but that neighbour."""
        neighbour = self.neighbours[other]
        rows = rows_of(neighbour.index)
        H, _ = self._normal(without=neighbour)
        floating = ANCHORING_FLOATING * np.einsum("sbb->sb", neighbour.closures).ravel()
        H = csc_array(H + coo_array((floating, (rows, rows)), shape=H.shape))
        units = np.zeros((H.shape[0], len(rows)))
        units[rows, np.arange(len(rows))] = 1.0
        return stiffness_of(_factor(H).solve(units)[rows], self._shared(other))

    def merit(self, state: State | None = None) -> float:
        """What a step lowers: the own cost, and what neighbours ask for; where it stands, or elsewhere."""
        state = state or self.state
        T = state.poses()
        return self.own_cost(state) + sum(neighbour.merit(T[neighbour.index]) for neighbour in self._heard())

    def own_cost(self, state: State | None = None) -> float:
        """Half the sum of the weighted squares of what the robot owns, and of the prior on scales."""
        state = state or self.state
        at = residuals(self.edges, state, hold=False)
        prior = np.sum(((state.scale - 1.0) / self.config.scale_prior_unknown_sigma_ratio) ** 2)
        return 0.5 * (float(self.weights @ at.squared()) + float(prior))

    def _shortened(self, delta: Float, before: float) -> State:
        """The first shortened step that does not lead up, or the least bad of them."""
        best, best_cost = self.state, np.inf
        for length in LENGTHS:
            there = self.state.retract(length * delta)
            cost = self.merit(there)
            if cost < best_cost:
                best, best_cost = there, cost
            if cost <= before + 1e-12 * abs(before):
                break
        return best

    def _normal(self, without: PairedRobot | None = None) -> tuple[csc_array, Float]:
        """Normal equations of all poses, then of cluster scales, with penalties but for what neighbours ask for."""
        at = residuals(self.edges, self.state, hold=False)
        sigma = self.config.scale_prior_unknown_sigma_ratio
        H, gradient = _normal_equations(self.edges, at, self.weights, self.state, sigma)
        for neighbour in self._heard():
            if neighbour is not without:
                block, rows = neighbour.penalty.tocoo(), rows_of(neighbour.index)
                H = H + coo_array((block.data, (rows[block.row], rows[block.col])), shape=H.shape)
        return csc_array(H), gradient


@dataclass(frozen=True, slots=True, eq=False)
class PartBeginning:
    """Where a robot's part begins.

    Attributes:
        T: (N, 4, 4) its keyframes, in the common frame.
        copies: Higher robots' keyframes, likewise; those that are not here begin where the first closure sees them.
        scale: (L,) metres per network unit at which each closure begins.
        weights: (L,) of each closure.
    """

    T: Float
    copies: Mapping[KeyframeId, Float]
    scale: Float
    weights: Float


def part_of(
    log: LogId,
    config: BackendConfig,
    trajectory: Trajectory,
    owned: Sequence[LoopClosure],
    begins: PartBeginning,
    neighbours: Mapping[LogId, PairedRobot],
) -> ConsensusPart:
    """Put a robot's part together; places of the shared poses in `neighbours` are set here."""
    copies = sorted({end for c in owned for end in (c.query, c.match) if end.log != log})
    at = {KeyframeId(log, k): k for k in range(len(trajectory))}
    at |= {keyframe: len(trajectory) + k for k, keyframe in enumerate(copies)}
    zero = dict.fromkeys({end.log for c in owned for end in (c.query, c.match)}, 0)
    edges, clusters = closure_edges(owned, zero, begins.scale, config)
    if owned:
        ends = np.array([(at[c.query], at[c.match]) for c in owned])
        edges = replace(edges, i=ends[:, 0], j=ends[:, 1])
    odometry = odometry_edges(trajectory, 0, config)
    state = state_of(_with_copies(begins, owned, at, copies), clusters)
    for neighbour in neighbours.values():
        neighbour.index = np.array([at[keyframe] for keyframe in neighbour.keyframes], dtype=np.int64)
    whole = concatenate([odometry, edges])
    weights = np.concatenate([np.ones(len(odometry)), begins.weights])
    return ConsensusPart(log, config, len(trajectory), whole, dict(neighbours), state, weights)


def _with_copies(
    begins: PartBeginning, owned: Sequence[LoopClosure], at: Mapping[KeyframeId, int], copies: Sequence[KeyframeId]
) -> Float:
    """Own poses, then copies of others'."""
    poses = np.concatenate([begins.T, np.tile(np.eye(4), (len(copies), 1, 1))])
    seen = np.arange(len(poses)) < len(begins.T)
    for keyframe in copies:
        if keyframe in begins.copies:
            poses[at[keyframe]], seen[at[keyframe]] = begins.copies[keyframe], True
    for closure, metres in zip(owned, begins.scale.tolist(), strict=True):
        T_query_match = np.array(closure.T_query_match_unscaled, dtype=float)
        T_query_match[:3, 3] *= metres
        i, j = at[closure.query], at[closure.match]
        if not seen[j]:
            poses[j], seen[j] = poses[i] @ T_query_match, True
        elif not seen[i]:
            poses[i], seen[i] = poses[j] @ inverse(T_query_match), True
    return poses


def beginning_scale(owned: OwnedClosure, config: BackendConfig) -> float:
    """Metres per network unit at which a chosen closure begins.

    Where nothing but the choice tells its unit, its covariance is in that unit: poses that nearly meet would make of it
    one of micrometres. As for a leader it is at least `NEAR_M` long.
    """
    if owned.scale is None:
        return initial_scale(owned.closure, config)
    length = float(np.linalg.norm(owned.closure.T_query_match_unscaled[:3, 3]))
    return max(owned.scale, NEAR_M / max(length, TINY))


def information_by_keyframe(
    closures: Sequence[LoopClosure], scale: Float, config: BackendConfig
) -> dict[KeyframeId, Float]:
    """Isotropic information (2,), of rotation and translation, of closures between robots at each higher keyframe."""
    zero = dict.fromkeys({end.log for c in closures for end in (c.query, c.match)}, 0)
    edges, _ = closure_edges(closures, zero, scale, config)
    L = edges.sqrt_information_wide
    diagonal = np.einsum("eab,eab->eb", L, L)
    found: dict[KeyframeId, Float] = {}
    for closure, own in zip(closures, diagonal, strict=True):
        high = max(closure.query, closure.match)
        found[high] = found.get(high, np.zeros(2)) + np.array([own[:3].mean(), own[3:].mean()])
    return found


def _pose_gradient(edges: Edges, at: Residuals, weights: Float, poses: int) -> Float:
    """Gradient (poses, 6) of half the weighted squares."""
    jac, out = jacobians(edges, at), np.zeros((poses, 6))
    pulled = weights[:, None] * at.e
    np.add.at(out, edges.i, np.einsum("eab,ea->eb", jac.A_i, pulled))
    np.add.at(out, edges.j, np.einsum("eab,ea->eb", jac.A_j, pulled))
    return out


def _normal_equations(
    edges: Edges, at: Residuals, weights: Float, state: State, scale_sigma: float
) -> tuple[csc_array, Float]:
    """Information matrix and gradient of poses, then of cluster scales."""
    jac, poses, clusters = jacobians(edges, at), len(state.q), len(state.scale)
    size = 6 * poses + clusters
    scaled = np.flatnonzero(edges.cluster >= 0)
    column = 6 * poses + edges.cluster[scaled]
    blocks = [(edges.i, jac.A_i), (edges.j, jac.A_j)]
    parts = [_block(a, A, b, B, weights) for a, A in blocks for b, B in blocks]
    slopes, w = jac.a_scale[scaled], weights[scaled]
    for ends, A in blocks:
        cross = np.einsum("eab,ea,e->eb", A[scaled], slopes, w).ravel()
        rows, columns = rows_of(ends[scaled]), np.repeat(column, 6)
        parts += [(rows, columns, cross), (columns, rows, cross)]
    diagonal = np.arange(6 * poses, size)
    parts.append((column, column, w * np.sum(slopes**2, axis=1)))
    parts.append((diagonal, diagonal, np.full(clusters, scale_sigma**-2.0)))
    rows, columns, values = (np.concatenate([part[k] for part in parts]) for k in range(3))
    by_scale = np.bincount(column - 6 * poses, w * np.sum(slopes * at.e[scaled], axis=1), clusters)
    gradient = _pose_gradient(edges, at, weights, poses).ravel()
    prior = (state.scale - 1.0) / scale_sigma**2
    return csc_array(coo_array((values, (rows, columns)), shape=(size, size))), np.concatenate(
        [gradient, by_scale[:clusters] + prior]
    )


def _block(a: Int, A: Float, b: Int, B: Float, weights: Float) -> tuple[Int, Int, Float]:
    """Rows, columns and values of `A^T W B`."""
    values = np.swapaxes(A, 1, 2) @ (weights[:, None, None] * B)
    rows = np.repeat(6 * a[:, None] + np.arange(6), 6, axis=1)
    columns = np.tile(6 * b[:, None] + np.arange(6), (1, 6))
    return rows.ravel(), columns.ravel(), values.ravel()


def _factor(H: csc_array) -> SuperLU:
    """Factors of a symmetric matrix, held a little where it floats."""
    tether = TETHER_RATIO * (float(H.diagonal().mean()) or 1.0)
    held = csc_array(H + diags_array(np.full(H.shape[0], tether)))
    return splu(held, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
