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
- The best penalty is what the neighbour's graph is like, seen from the shared poses (optimised Schwarz methods, Gander
  2006): its Schur complement. It is told in short as the covariances of each shared pose in the one before (`spread`),
  the tree whose marginals are right, and is given to the back end as between factors: free of gauge, 84 bytes a pose.
- What a tree leaves out is anchored: each pose by a part `anchoring` of its closures' information. That part is
  measured on what the neighbour says: where its poses moved by d and its forces by g, its stiffness along d is g . d
  (a secant, as in the spectral penalties of Xu et al. 2017).

Unknown scales: a scale of its own is eliminated before anything else sees it (`edges`); those of clusters belong to
one pair, and so are the owner's alone. Weights of closures are the owner's as well, and constants here: decided while
robots still move, they let go of all closures, because the forces that answered them stay (docs/back-end.md).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from flocc_agent.backend.descent import LENGTHS
from flocc_agent.backend.edges import Edges, Residuals, State, jacobians, residuals, state_of, taken
from flocc_agent.backend.problem import (
    closure_edges,
    concatenate,
    initial_scale,
    odometry_edges,
    plain_edges,
    sqrt_informations,
)
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import LoopClosure, PoseGraph
from flocc_agent.geometry import hats, inverse, poses_from_tq, quaternions
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]

SPREAD_TOLD = (0, 1, 4)
"""After which steps a robot tells how its shared poses hang together: by then its graph has its shape."""
ANCHORING_MIN, ANCHORING_START, ANCHORING_MAX = 0.02, 0.3, 1.0
"""Parts of the closures' information: with less, dense graphs come apart; more holds long chains back."""
SECANTS_FROM = 6
"""From so many messages of a neighbour on their differences say how stiff it is; before, everything moves at once."""
SECANT_POWER = 0.5
APART_FACTOR = 4.0
"""By how much anchors grow where both sides come apart again."""
TETHER_RATIO = 1e-9
"""Of the mean stiffness, on every pose: a graph that floats has no unique step."""
ALONE_STEPS_MAX = 20
ALONE_TOLERANCE_RATIO = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class SharedPoses:
    """What one robot tells another of the poses that both have.

    Attributes:
        T: (S, 4, 4) where it has them, in the common frame.
        force: (S, 6) gradient there of all that it knows from elsewhere; rotation first, in the pose's own tangent.
        spread: (S-1, 6, 6) covariance of each pose relative to the one before, or None: as told before.
    """

    T: Float
    force: Float
    spread: Float | None = None

    def packed(self) -> bytes:
        """As it would travel: the first position in double, all else in single precision."""
        origin = self.T[0, :3, 3]
        turned = quaternions(self.T[:, :3, :3])
        rows = np.concatenate([self.T[:, :3, 3] - origin, turned, self.force], axis=1)
        upper = np.triu_indices(6)
        spread = np.zeros(0) if self.spread is None else self.spread[:, upper[0], upper[1]]
        return origin.astype("<f8").tobytes() + rows.astype("<f4").tobytes() + spread.astype("<f4").tobytes()

    @staticmethod
    def unpacked(payload: bytes, count: int) -> "SharedPoses":
        """Read what `packed` wrote of so many poses.

        Raises:
            ValueError: It has another length, is not finite, or holds a quaternion without direction.
        """
        ends = (24, 24 + 52 * count, 24 + 52 * count + 84 * (count - 1))
        if count < 1 or len(payload) not in ends[1:]:
            raise ValueError(f"{len(payload)} bytes are not {count} shared poses")
        rows = np.frombuffer(payload[24 : ends[1]], "<f4").astype(float).reshape(count, 13)
        T = poses_from_tq(rows[:, :7])
        T[:, :3, 3] += np.frombuffer(payload[:24], "<f8")
        spread = None
        if len(payload) == ends[2]:
            spread = np.zeros((count - 1, 6, 6))
            upper = np.triu_indices(6)
            spread[:, upper[0], upper[1]] = np.frombuffer(payload[ends[1] :], "<f4").reshape(count - 1, 21)
            spread += np.swapaxes(np.triu(spread, 1), 1, 2)
        told = SharedPoses(T, rows[:, 7:], spread)
        told.check(count)
        return told

    def check(self, count: int) -> None:
        """Refuse what is not finite, of another size, or no covariance.

        Raises:
            ValueError: It is; the sentence says what.
        """
        if self.T.shape != (count, 4, 4) or self.force.shape != (count, 6):
            raise ValueError(f"{len(self.T)} poses and {len(self.force)} forces are not {count} shared poses")
        if not (np.all(np.isfinite(self.T)) and np.all(np.isfinite(self.force))):
            raise ValueError("shared poses or forces are not finite")
        if self.spread is None:
            return
        if self.spread.shape != (count - 1, 6, 6) or not np.all(np.isfinite(self.spread)):
            raise ValueError(f"the spread is not that of {count} poses")
        if count > 1 and np.linalg.eigvalsh(self.spread).min() <= 0:
            raise ValueError("the spread of shared poses is not positive definite")


@dataclass(slots=True, eq=False)
class PairedRobot:
    """What a robot knows of one with which it shares poses.

    Attributes:
        index: (S,) the shared poses among its own and its copies.
        stiffness: (S, 6, 6) information of the closures at each, diagonal.
        heard: What the neighbour said last; None before.
        spread: What it said last of that.
        anchoring: Part of the closures' information by which each pose is anchored.
        messages: How often it was heard.
        apart: How far its poses were from one's own, in the anchors' measure.
        priors: The penalty, as edges.
    """

    index: Int
    stiffness: Float
    heard: SharedPoses | None = None
    spread: Float | None = None
    anchoring: float = ANCHORING_START
    messages: int = 0
    apart: float = np.inf
    priors: Edges | None = None


@dataclass(slots=True, eq=False)
class ConsensusPart:
    """One robot's part of a pose graph, and what its neighbours say.

    Attributes:
        log: The robot.
        config: Formulation and noise model.
        own: Number of its own keyframes; copies of others' come after them, then the origin of the common frame.
        edges: Odometry, then the closures that it owns.
        closures: Rows of the closures in `edges`.
        neighbours: By their log.
        state: Where it stands.
        weights: (E,) of the own edges, in [0, 1].
    """

    log: LogId
    config: BackendConfig
    own: int
    edges: Edges
    closures: slice
    neighbours: dict[LogId, PairedRobot]
    state: State
    weights: Float
    steps: int = 0

    @property
    def T(self) -> Float:
        """Poses (N, 4, 4) of the own keyframes in the common frame."""
        return self.state.poses()[: self.own]

    def step(self) -> None:
        """One Gauss-Newton step, shortened where it leads up, down the own cost and what neighbours ask for."""
        held = self._edges()
        weights = np.ones(len(held))
        weights[: len(self.edges)] = self.weights
        at = residuals(held, self.state, hold=False)
        H, gradient = self._normal(held, at, weights)
        gradient = gradient + self._forces()
        delta = -_factor(H).solve(gradient)
        if np.all(np.isfinite(delta)):
            self.state = self._shortened(held, weights, delta, self._merit(held, weights, self.state))
        self.steps += 1

    def tell(self, other: LogId) -> SharedPoses:
        """What a neighbour hears after this step."""
        neighbour = self.neighbours[other]
        spread = self.spread(other) if self.steps - 1 in SPREAD_TOLD else None
        return SharedPoses(self.state.poses()[neighbour.index], self._force(neighbour), spread)

    def hear(self, other: LogId, told: SharedPoses) -> None:
        """Take what a neighbour said in the place of what it said before.

        Raises:
            ValueError: It cannot be; nothing has changed.
        """
        neighbour = self.neighbours[other]
        told.check(len(neighbour.index))
        if told.spread is not None:
            neighbour.spread = told.spread
        apart = _squares(neighbour, told.T, self.state.poses()[neighbour.index])
        if apart > neighbour.apart:
            neighbour.anchoring = min(ANCHORING_MAX, APART_FACTOR * neighbour.anchoring)
        elif neighbour.heard is not None and neighbour.messages >= SECANTS_FROM:
            neighbour.anchoring = _measured_anchoring(neighbour, neighbour.heard, told)
        neighbour.apart = apart
        neighbour.heard, neighbour.messages = told, neighbour.messages + 1
        neighbour.priors = _priors(neighbour, told, len(self.state.q) - 1)

    def spread(self, other: LogId) -> Float:
        """Covariance (S-1, 6, 6) of each shared pose relative to the one before, by all but that neighbour."""
        index = self.neighbours[other].index
        held = self._edges(without=other)
        weights = np.ones(len(held))
        weights[: len(self.edges)] = self.weights
        H, _ = self._normal(held, residuals(held, self.state, hold=False), weights)
        rows = (6 * index[:, None] + np.arange(6)).ravel()
        units = np.zeros((H.shape[0], len(rows)))
        units[rows, np.arange(len(rows))] = 1.0
        covariance = _factor(H).solve(units)[rows]
        Ad = _relative_adjoints(self.state.poses()[index])
        spread = np.empty((len(index) - 1, 6, 6))
        for k, back in enumerate(Ad):
            block = covariance[6 * k : 6 * k + 12, 6 * k : 6 * k + 12]
            difference = np.hstack([-back, np.eye(6)])
            spread[k] = difference @ block @ difference.T
        return 0.5 * (spread + np.swapaxes(spread, 1, 2))

    def _edges(self, without: LogId | None = None) -> Edges:
        """The own edges, then the penalties of the neighbours."""
        told = [n.priors for log, n in self.neighbours.items() if log != without and n.priors is not None]
        return concatenate([self.edges, *told])

    def _forces(self) -> Float:
        """Gradient of what neighbours say besides penalties."""
        forces = np.zeros((len(self.state.q) - 1, 6))
        for neighbour in self.neighbours.values():
            if neighbour.heard is not None:
                np.add.at(forces, neighbour.index, neighbour.heard.force)
        return np.concatenate([forces.ravel(), np.zeros(len(self.state.scale))])

    def _force(self, neighbour: PairedRobot) -> Float:
        """Gradient (S, 6) of everything but by this neighbour: at rest the opposite of what is by it."""
        if neighbour.heard is None or neighbour.priors is None:
            return np.zeros((len(neighbour.index), 6))
        at = residuals(neighbour.priors, self.state)
        by_pose = _pose_gradient(neighbour.priors, at, np.ones(len(neighbour.priors)), len(self.state.q))
        return -(by_pose[neighbour.index] + neighbour.heard.force)

    def _merit(self, held: Edges, weights: Float, state: State) -> float:
        at = residuals(held, state, hold=False)
        prior = np.sum(((state.scale - 1.0) / self.config.scale_prior_unknown_sigma_ratio) ** 2)
        cost = 0.5 * (float(weights @ at.squared()) + float(prior))
        T = state.poses()
        for neighbour in self.neighbours.values():
            if neighbour.heard is not None:
                cost += float(np.sum(neighbour.heard.force * _differences(neighbour.heard.T, T[neighbour.index])))
        return cost

    def _shortened(self, held: Edges, weights: Float, delta: Float, before: float) -> State:
        """The first shortened step that does not lead up, or the least bad of them."""
        split = 6 * (len(self.state.q) - 1)
        delta = np.concatenate([delta[:split], np.zeros(6), delta[split:]])
        best, best_cost = self.state, np.inf
        for length in LENGTHS:
            there = self.state.retract(length * delta)
            cost = self._merit(held, weights, there)
            if cost < best_cost:
                best, best_cost = there, cost
            if cost <= before + 1e-12 * abs(before):
                break
        return best

    def _normal(self, held: Edges, at: Residuals, weights: Float) -> tuple[csc_array, Float]:
        """Normal equations of all poses but the origin, then of cluster scales."""
        return _normal_equations(held, at, weights, self.state, self.config.scale_prior_unknown_sigma_ratio)


def shared_poses(graph: PoseGraph, log: LogId) -> dict[LogId, list[KeyframeId]]:
    """Keyframes that a robot shares, by the other robot: those of the higher robot at their closures, sorted."""
    found: dict[LogId, set[KeyframeId]] = {}
    for closure in graph.closures:
        low, high = sorted((closure.query, closure.match))
        if low.log != high.log and log in (low.log, high.log):
            found.setdefault(low.log if log == high.log else high.log, set()).add(high)
    return {other: sorted(keyframes) for other, keyframes in sorted(found.items())}


def part_of(graph: PoseGraph, log: LogId, config: BackendConfig, T: Float) -> ConsensusPart:
    """Begin a robot's part of a graph.

    Args:
        graph: Odometry and closures; only the robot's own odometry and closures of its own are read.
        log: The robot.
        config: Formulation and noise model.
        T: (N, 4, 4) where its keyframes begin, in the common frame.
    """
    trajectory = graph.trajectories[log]
    owned = [c for c in graph.closures if min(c.query.log, c.match.log) == log]
    copies = sorted({end for c in owned for end in (c.query, c.match) if end.log != log})
    at = {KeyframeId(log, k): k for k in range(len(trajectory))}
    at |= {keyframe: len(trajectory) + k for k, keyframe in enumerate(copies)}
    scale = np.array([initial_scale(c, config) for c in owned])
    edges, clusters = closure_edges(owned, dict.fromkeys(graph.trajectories, 0), scale, config)
    if owned:
        ends = np.array([(at[c.query], at[c.match]) for c in owned])
        edges = replace(edges, i=ends[:, 0], j=ends[:, 1])
    odometry = odometry_edges(trajectory, 0, config)
    rows = slice(len(odometry), len(odometry) + len(owned))
    state = state_of(_with_copies(T, owned, at, scale, len(copies)), clusters)
    stiffness = _stiffness_by_keyframe(graph.closures, config)
    neighbours = {
        other: PairedRobot(np.array([at[k] for k in keyframes]), np.array([stiffness[k] for k in keyframes]))
        for other, keyframes in shared_poses(graph, log).items()
    }
    whole = concatenate([odometry, edges])
    return ConsensusPart(log, config, len(trajectory), whole, rows, neighbours, state, np.ones(len(whole)))


def solved_alone(part: ConsensusPart) -> Float:
    """Poses (N, 4, 4) of a robot by its odometry and the closures within it; nothing else is known yet."""
    own = np.flatnonzero((part.edges.i < part.own) & (part.edges.j < part.own))
    closures = slice(int(np.searchsorted(own, part.closures.start)), len(own))
    alone = replace(
        part,
        edges=taken(part.edges, own),
        closures=closures,
        neighbours={},
        state=state_of(np.concatenate([part.T, np.eye(4)[None]]), len(part.state.scale)),
        weights=np.ones(len(own)),
    )
    cost = np.inf
    for _ in range(ALONE_STEPS_MAX):
        alone.step()
        before, cost = cost, alone._merit(alone.edges, alone.weights, alone.state)
        if before - cost <= ALONE_TOLERANCE_RATIO * cost:
            break
    return alone.T


def _with_copies(T: Float, owned: list[LoopClosure], at: Mapping[KeyframeId, int], scale: Float, count: int) -> Float:
    """Own poses, copies of others' where the first closure sees them, and the origin."""
    poses = np.concatenate([T, np.tile(np.eye(4), (count + 1, 1, 1))])
    seen = np.arange(len(poses)) < len(T)
    for closure, metres in zip(owned, scale.tolist(), strict=True):
        T_query_match = np.array(closure.T_query_match_unscaled, dtype=float)
        T_query_match[:3, 3] *= metres
        i, j = at[closure.query], at[closure.match]
        if not seen[j]:
            poses[j], seen[j] = poses[i] @ T_query_match, True
        elif not seen[i]:
            poses[i], seen[i] = poses[j] @ inverse(T_query_match), True
    return poses


def _stiffness_by_keyframe(closures: Sequence[LoopClosure], config: BackendConfig) -> dict[KeyframeId, Float]:
    """Isotropic information (6, 6) of the closures between robots at each keyframe of a higher robot."""
    between = [c for c in closures if c.query.log != c.match.log]
    zero = {end.log: 0 for c in between for end in (c.query, c.match)}
    edges, _ = closure_edges(between, zero, np.array([initial_scale(c, config) for c in between]), config)
    L = edges.sqrt_information_wide
    diagonal = np.einsum("eab,eab->eb", L, L)
    found: dict[KeyframeId, Float] = {}
    for closure, own in zip(between, diagonal, strict=True):
        isotropic = np.diag(np.repeat([own[:3].mean(), own[3:].mean()], 3))
        high = max(closure.query, closure.match)
        found[high] = found.get(high, np.zeros((6, 6))) + isotropic
    return found


def _differences(T: Float, there: Float) -> Float:
    """Tangent vectors (S, 6) from poses to others near them, `2 vec q` for the rotation."""
    D = inverse(T) @ there
    return np.concatenate([2.0 * quaternions(D[:, :3, :3])[:, 1:], D[:, :3, 3]], axis=1)


def _relative_adjoints(T: Float) -> Float:
    """Adjoints (S-1, 6, 6) that take a pose's tangent to that of the next pose."""
    back = inverse(T[1:]) @ T[:-1]
    out = np.zeros((len(back), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = back[:, :3, :3]
    out[:, 3:, :3] = hats(back[:, :3, 3]) @ back[:, :3, :3]
    return out


def _priors(neighbour: PairedRobot, told: SharedPoses, origin: int) -> Edges:
    """The penalty around what was told: between factors by the spread, and anchors."""
    index, T = neighbour.index, told.T
    anchors = plain_edges(np.full(len(index), origin), index, T, np.sqrt(neighbour.anchoring) * _anchors(neighbour))
    if neighbour.spread is None or len(index) < 2:
        return anchors
    relative = inverse(T[:-1]) @ T[1:]
    return concatenate([plain_edges(index[:-1], index[1:], relative, sqrt_informations(neighbour.spread)), anchors])


def _anchors(neighbour: PairedRobot) -> Float:
    """Square roots (S, 6, 6) of the information by which each shared pose is anchored, at an anchoring of 1."""
    return np.sqrt(neighbour.stiffness)


def _squares(neighbour: PairedRobot, T: Float, there: Float) -> float:
    """Squared distance between shared poses in two places, weighed by the anchors."""
    return float(np.sum((_anchors(neighbour) @ _differences(T, there)[:, :, None]) ** 2))


def _measured_anchoring(neighbour: PairedRobot, before: SharedPoses, told: SharedPoses) -> float:
    """How much of the anchors the neighbour's own stiffness comes to, along the way that it has just moved."""
    d = _differences(before.T, told.T)
    work = float(np.sum(d * (told.force - before.force)))
    if neighbour.spread is not None and len(d) > 1:
        stretched = d[1:] - np.einsum("kab,kb->ka", _relative_adjoints(told.T), d[:-1])
        work -= float(np.sum(stretched * np.linalg.solve(neighbour.spread, stretched[..., None])[..., 0]))
    whole = _squares(neighbour, before.T, told.T)
    measured = min(max(work / whole, ANCHORING_MIN), ANCHORING_MAX) if whole > 0 else neighbour.anchoring
    return float(neighbour.anchoring ** (1.0 - SECANT_POWER) * measured**SECANT_POWER)


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
    """Information matrix and gradient of poses without the last one, which is the origin, then cluster scales."""
    jac, poses, clusters = jacobians(edges, at), len(state.q) - 1, len(state.scale)
    size = 6 * poses + clusters
    scaled = np.flatnonzero(edges.cluster >= 0)
    column = 6 * poses + edges.cluster[scaled]
    blocks = [(edges.i, jac.A_i), (edges.j, jac.A_j)]
    parts = [_block(a, A, b, B, weights, poses) for a, A in blocks for b, B in blocks]
    slopes, w = jac.a_scale[scaled], weights[scaled]
    for ends, A in blocks:
        cross = np.einsum("eab,ea,e->eb", A[scaled], slopes, w)
        kept = ends[scaled] < poses
        rows = (6 * ends[scaled][:, None] + np.arange(6))[kept].ravel()
        columns = np.repeat(column[kept], 6)
        parts += [(rows, columns, cross[kept].ravel()), (columns, rows, cross[kept].ravel())]
    diagonal = np.arange(6 * poses, size)
    parts.append((column, column, w * np.sum(slopes**2, axis=1)))
    parts.append((diagonal, diagonal, np.full(clusters, scale_sigma**-2.0)))
    rows, columns, values = (np.concatenate([part[k] for part in parts]) for k in range(3))
    by_scale = np.bincount(column - 6 * poses, w * np.sum(slopes * at.e[scaled], axis=1), clusters)
    gradient = _pose_gradient(edges, at, weights, poses + 1)[:poses].ravel()
    prior = (state.scale - 1.0) / scale_sigma**2
    return csc_array(coo_array((values, (rows, columns)), shape=(size, size))), np.concatenate(
        [gradient, by_scale[:clusters] + prior]
    )


def _block(a: Int, A: Float, b: Int, B: Float, weights: Float, poses: int) -> tuple[Int, Int, Float]:
    """Rows, columns and values of `A^T W B`, without those of the origin."""
    kept = (a < poses) & (b < poses)
    values = np.swapaxes(A[kept], 1, 2) @ (weights[kept, None, None] * B[kept])
    rows = np.repeat(6 * a[kept][:, None] + np.arange(6), 6, axis=1)
    columns = np.tile(6 * b[kept][:, None] + np.arange(6), (1, 6))
    return rows.ravel(), columns.ravel(), values.ravel()


def _factor(H: csc_array) -> SuperLU:
    """Factors of a symmetric matrix, held a little where it floats."""
    tether = TETHER_RATIO * float(H.diagonal().mean())
    held = csc_array(H + diags_array(np.full(H.shape[0], tether)))
    return splu(held, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
