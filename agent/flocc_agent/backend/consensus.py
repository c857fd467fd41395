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
- The penalty is the geometric mean of how stiff both robots hold the shared poses (`shared_stiffness`), told in short
  after a few steps, in editions: either side uses the newest one that both have told, and none before that. While
  penalties differ, robots drive each other away: with a penalty of one side alone they came apart for good.
- What is heard replaces only a part of what was heard before (`RELAXATION`): the rest keeps its pull at the same poses.
  One half is ADMM, a whole one need not come to rest.

Unknown scales: a scale of its own is eliminated before anything else sees it (`edges`); those of clusters belong to
one pair, and so are the owner's alone. Weights of closures are the owner's as well, and constants here: decided while
robots still move, they let go of all closures, because the forces that answered them stay (docs/back-end.md).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from flocc_agent.backend.descent import LENGTHS
from flocc_agent.backend.edges import Edges, Residuals, State, jacobians, residuals, state_of
from flocc_agent.backend.problem import closure_edges, concatenate, odometry_edges
from flocc_agent.backend.shared_stiffness import SharedStiffness, geometric_mean, rows_of, stiffness_of
from flocc_agent.config import BackendConfig
from flocc_agent.core.own_part import Apart, ToldPoses
from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_agent.geometry import inverse, poses_from_tq, quaternions
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.shared_poses import STIFFNESS_EDITIONS

Float = NDArray[np.float64]
Int = NDArray[np.int64]

STIFFNESS_AFTER = (5, 12)
"""After which steps a robot says how stiff it holds its shared poses: first by a guess of its other neighbours, then by
what they said; dense graphs are at rest before the second."""
STIFFNESS_SAME = 0.05
"""One that differs by less, in its factors, is not said: a penalty need not be exact, only the same on both sides."""
RELAXATION = 0.8
"""Of what is heard; at 0.9 smallGrid3D comes apart, at 0.5 chains take half as long again."""
ANCHORING_FLOATING = 0.03
"""Part of the closures' information that holds a robot which nothing else holds, where its stiffness is asked for. With
1e-3 five robots on a mission threw each other kilometres away; with 0.1 CSAIL takes twice as long."""
ANCHORING = 1e-4
"""Part of it that both sides add to their penalty; with more, long chains bend slowly."""
ANCHORING_UNKNOWN = 0.3
"""Part of it that is the penalty while nothing is known of the neighbour's stiffness."""
ALLOWED, ALLOWED_UNKNOWN = 4.0, 100.0
"""Mean square of a disagreement, in units of the penalty, that two robots may have on their way to each other: where it
is the mean of both stiffnesses, and so at most twice the inverse of both covariances together; and before that."""
TETHER_RATIO = 1e-9
"""Of the mean stiffness, on every pose: a graph that floats has no unique step."""


@dataclass(frozen=True, slots=True, eq=False)
class Tidings:
    """What one robot tells another of the poses that both have.

    Attributes:
        T: (S, 4, 4) where it has them, in the common frame.
        force: (S, 6) gradient there of all that it knows from elsewhere; rotation first, in the pose's own tangent.
        known: Newest edition of the receiver's stiffness that it has; 0 for none.
        edition: Of the stiffness that comes with it; 0 for none.
        stiffness: How stiff it holds the shared poses by all but the receiver; None where the receiver has it.
    """

    T: Float
    force: Float
    known: int = 0
    edition: int = 0
    stiffness: SharedStiffness | None = None

    def told(self) -> ToldPoses:
        """As it travels: the first position in double, all else in single precision."""
        origin = self.T[0, :3, 3]
        rows = np.concatenate([self.T[:, :3, 3] - origin, quaternions(self.T[:, :3, :3]), self.force], axis=1)
        stiffness = np.zeros(0) if self.stiffness is None else self.stiffness.packed()
        return ToldPoses(origin, _single(rows), self.known, self.edition, _single(stiffness))

    @staticmethod
    def of(told: ToldPoses, count: int) -> "Tidings":
        """Read what is told of so many poses.

        Raises:
            ValueError: It is of another number, not finite, or holds a quaternion without direction.
        """
        rows = np.asarray(told.rows, dtype=float)
        if rows.shape != (count, 13):
            raise ValueError(f"rows of the shape {rows.shape} are not {count} shared poses")
        T = poses_from_tq(rows[:, :7])
        T[:, :3, 3] += told.base_m
        stiffness = SharedStiffness.unpacked(told.stiffness, count) if len(told.stiffness) else None
        read = Tidings(T, rows[:, 7:], told.known, told.edition, stiffness)
        read.check(count)
        return read

    def check(self, count: int) -> None:
        """Refuse what is not finite, of another size, or no stiffness.

        Raises:
            ValueError: It is; the sentence says what.
        """
        if self.T.shape != (count, 4, 4) or self.force.shape != (count, 6):
            raise ValueError(f"{len(self.T)} poses and {len(self.force)} forces are not {count} shared poses")
        if not (np.all(np.isfinite(self.T)) and np.all(np.isfinite(self.force))):
            raise ValueError("shared poses or forces are not finite")
        editions = STIFFNESS_EDITIONS
        if max(self.known, self.edition) > editions or (self.edition > 0) != (self.stiffness is not None):
            raise ValueError(f"edition {self.edition} of the stiffness of shared poses is not one of {editions}")
        if self.stiffness is not None:
            self.stiffness.check(count)


@dataclass(slots=True, eq=False)
class PairedRobot:
    """What a robot knows of one with which it shares poses.

    Attributes:
        lower: Whether the robot itself is the lower of both.
        keyframes: The poses that both have.
        index: (S,) the shared poses among its own and its copies.
        closures: (S, 6, 6) information of the closures at each, diagonal.
        penalty: (6S, 6S) sparse information by which they are held to T.
        T: (S, 4, 4) where the neighbour said that it has them; None before it was heard.
        force: (6S,) what it asks for there besides the penalty.
        ours: Own stiffness by edition.
        theirs: The neighbour's by edition.
        known: Newest own edition that the neighbour has.
        steps: Own steps since both share these poses.
        edition: Of the list of these poses.
        stiffened: Edition of both stiffnesses of which the penalty is made; 0 for none.
    """

    lower: bool
    keyframes: tuple[KeyframeId, ...]
    index: Int
    closures: Float
    penalty: csc_array
    T: Float | None = None
    force: Float = field(default_factory=lambda: np.zeros(0))
    ours: dict[int, SharedStiffness] = field(default_factory=dict)
    theirs: dict[int, SharedStiffness] = field(default_factory=dict)
    known: int = 0
    steps: int = 0
    edition: int = 0
    stiffened: int = 0

    def pull(self, T: Float) -> Float:
        """Gradient (6S,) where the shared poses are at `T`."""
        return np.asarray(self.force + self.penalty @ self._apart(T))

    def merit(self, T: Float) -> float:
        """What `pull` is the gradient of."""
        apart = self._apart(T)
        return float(self.force @ apart + 0.5 * apart @ self.penalty @ apart)

    def apart(self, T: Float) -> Apart:
        """How far the neighbour is from shared poses at `T`."""
        apart = self._apart(T)
        mean = float(apart @ self.penalty @ apart) / max(len(apart), 1)
        furthest_m = float(np.linalg.norm(apart.reshape(-1, 6)[:, 3:], axis=1).max(initial=0.0))
        return Apart(furthest_m, mean / (ALLOWED if self.stiffened else ALLOWED_UNKNOWN))

    def hear(self, told: Tidings) -> None:
        """Take a part of what the neighbour said in the place of what it said before."""
        force = told.force.ravel()
        if self.T is not None:
            force = RELAXATION * force + (1.0 - RELAXATION) * self.pull(told.T)
        self.T, self.force, self.known = told.T, force, told.known
        if told.stiffness is not None:
            self.theirs[told.edition] = told.stiffness

    def stiffen(self, T: Float) -> None:
        """Choose the penalty by what both said of their stiffness; the pull at `T`, where the poses are, stays."""
        common = max(self.ours.keys() & self.theirs.keys(), default=None)
        if common is None or common == self.stiffened:
            return
        pull = None if self.T is None else self.pull(T)
        both = (self.ours[common], self.theirs[common])
        stiffness = geometric_mean(*(both if self.lower else both[::-1]))
        self.penalty = csc_array(stiffness.matrix() + _diagonal(ANCHORING, self.closures))
        self.stiffened = common
        if pull is not None:
            self.force = pull - self.penalty @ self._apart(T)

    def _apart(self, T: Float) -> Float:
        """Tangents (6S,) from where the neighbour has the shared poses to `T`."""
        assert self.T is not None
        return _differences(self.T, T).ravel()


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

    def step(self) -> None:
        """One Gauss-Newton step, shortened where it leads up, down the own cost and what neighbours ask for."""
        H, gradient = self._normal()
        T = self.state.poses()
        for neighbour in self._heard():
            np.add.at(gradient, rows_of(neighbour.index), neighbour.pull(T[neighbour.index]))
        delta = -_factor(H).solve(gradient)
        if np.all(np.isfinite(delta)):
            self.state = self._shortened(delta, self.merit(self.state))
        told: dict[LogId, SharedStiffness] = {}
        for other, neighbour in self.neighbours.items():
            neighbour.steps += 1
            if neighbour.steps in STIFFNESS_AFTER:
                told[other] = self._stiffness(other)
        for other, stiffness in told.items():
            neighbour = self.neighbours[other]
            before = neighbour.ours.get(max(neighbour.ours, default=0))
            if before is None or stiffness.differs(before) > STIFFNESS_SAME:
                neighbour.ours[STIFFNESS_AFTER.index(neighbour.steps) + 1] = stiffness
                neighbour.stiffen(self.state.poses()[neighbour.index])

    def tell(self, other: LogId) -> Tidings:
        """What a neighbour hears after this step."""
        neighbour = self.neighbours[other]
        T = self.state.poses()[neighbour.index]
        force = np.zeros((len(T), 6)) if neighbour.T is None else -neighbour.pull(T).reshape(-1, 6)
        newest = max(neighbour.ours, default=0)
        edition = newest if newest > neighbour.known else 0
        return Tidings(T, force, max(neighbour.theirs, default=0), edition, neighbour.ours.get(edition))

    def hear(self, other: LogId, told: Tidings) -> None:
        """Take what a neighbour said.

        Raises:
            ValueError: It cannot be; nothing has changed.
        """
        neighbour = self.neighbours[other]
        told.check(len(neighbour.index))
        neighbour.hear(told)
        if told.stiffness is not None:
            neighbour.stiffen(self.state.poses()[neighbour.index])

    def apart(self, other: LogId) -> Apart:
        """How far a neighbour that was heard is."""
        neighbour = self.neighbours[other]
        return neighbour.apart(self.state.poses()[neighbour.index])

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
        return stiffness_of(_factor(H).solve(units)[rows], self.state.poses()[neighbour.index])

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


def paired(lower: bool, keyframes: Sequence[KeyframeId], information: Float, edition: int = 0) -> PairedRobot:
    """A robot of which nothing was heard yet.

    Args:
        lower: Whether the robot itself is the lower of both.
        keyframes: The poses that both have.
        information: (S, 2) of the closures at each, of rotation and translation.
        edition: Of that list.
    """
    closures = np.repeat(information, 3, axis=1)[:, :, None] * np.eye(6)
    unplaced = np.zeros(len(keyframes), dtype=np.int64)
    penalty = _diagonal(ANCHORING_UNKNOWN, closures)
    return PairedRobot(lower, tuple(keyframes), unplaced, closures, penalty, edition=edition)


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


def _diagonal(ratio: float, closures: Float) -> csc_array:
    """Information (6S, 6S) that is a part of that of closures (S, 6, 6), diagonal each."""
    return csc_array(diags_array(ratio * np.einsum("sbb->sb", closures).ravel()))


def _single(values: Float) -> Float:
    """Rounded as single precision does."""
    return np.asarray(values, dtype=np.float32)


def _differences(T: Float, there: Float) -> Float:
    """Tangent vectors (S, 6) from poses to others near them, `2 vec q` for the rotation."""
    D = inverse(T) @ there
    return np.concatenate([2.0 * quaternions(D[:, :3, :3])[:, 1:], D[:, :3, 3]], axis=1)


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
