"""One iteration of a robot's block in a distributed optimisation: extend, align, weigh, descend, extrapolate.

All robots may iterate at the same time: a step goes half of the way to the block's minimum, because the whole
quadratic form is at most twice the sum of the blocks' own ones (`|a - b|^2 <= 2 |a|^2 + 2 |b|^2` on every edge).
Nesterov's extrapolation makes up for it and starts anew where it points uphill. Closures' robust weights are decided
by graduated non-convexity (Yang 2020), each by the lower of its two robots. Scales are constants: those of Eq. (6).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from flocc_agent.backend.alignment import Rays, align_pair, travelled_m
from flocc_agent.backend.graduated import gnc_finished, gnc_weights, initial_control
from flocc_agent.backend.measured import measured_odometry
from flocc_agent.backend.problem import closure_covariances, diagonal_covariance, initial_scale
from flocc_agent.backend.screening import first_not_rigid
from flocc_agent.config import BackendConfig, Solver
from flocc_agent.core.pose_graph import LoopClosure, OptimisationFailed
from flocc_agent.core.registration import closure_probability
from flocc_agent.geometry import inverse
from flocc_lab.rbcd import block_descent
from flocc_lab.rbcd.block_descent import Block, Links
from flocc_lab.rbcd.blocks import BlockProblem, BlockState, BlockStep, decides
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

Float = NDArray[np.float64]
Int = NDArray[np.int64]

RANK = 5
"""Dimensions to which rotations are relaxed."""
STAGE_ITERATIONS = 5
"""Iterations between two decisions on robust weights."""
REST_ITERATIONS = 20
"""Iterations that final weights stand before a closure that does not agree makes all robots decide again."""
FIRST_STEPS = 30
STEPS = 2
INNER_STEPS = 20
TOGETHER_RATIO = 0.5
MOMENTUM_MAX = 0.995
TILT = 1e-3
CLOSURES_MAX = 32
"""Blocks whose closures are kept as arrays."""
LEAVE_RATIO = 1.2
"""A used closure is dropped only this far beyond its bound, so that weights come to rest."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredClosures:
    """Closures as arrays, all of them, usable now or not.

    Attributes:
        pairs: The pair of keyframes of each closure.
        i: (E,) index of its query in the block, -1 where it is another robot's.
        j: (E,) the same of its match.
        T: (E, 4, 4) metric measurement.
        kappa: (E,) rotation weight.
        tau: (E,) translation weight.
        fixed: (E, 4, r) the other robot's pose, zero where there is none.
        known: (E,) both ends have a pose in this frame, and the covariance is one.
        own: (E,) its robust weight is this robot's to decide.
    """

    pairs: tuple[CandidatePair, ...]
    i: Int
    j: Int
    T: Float
    kappa: Float
    tau: Float
    fixed: Float
    known: NDArray[np.bool_]
    own: NDArray[np.bool_]

    def residuals(self, X: Float) -> Float:
        """Squared residuals (E,) without robust weights."""
        X_i = np.where((self.i >= 0)[:, None, None], X[np.maximum(self.i, 0)], self.fixed)
        X_j = np.where((self.j >= 0)[:, None, None], X[np.maximum(self.j, 0)], self.fixed)
        return block_descent.squared_residuals(X_i, X_j, self.T, self.kappa, self.tau)


def iterate_block(config: BackendConfig, problem: BlockProblem) -> BlockStep | OptimisationFailed:
    """Do one iteration of a block.

    Args:
        config: Noise model, solver (lm or gnc-tls).
        problem: The block, and what others said.

    Returns:
        Where the block stands now, or why it could not be moved.
    """
    broken = first_not_rigid(np.asarray(problem.trajectory.T_odom_keyframe))
    if broken is not None:
        return OptimisationFailed(f"robot {problem.log}: odometry of keyframe {broken} is not rigid")
    try:
        return _iterated(config, problem)
    except (np.linalg.LinAlgError, RuntimeError, FloatingPointError) as error:
        return OptimisationFailed(str(error).strip().split("\n")[0])


def _iterated(config: BackendConfig, problem: BlockProblem) -> BlockStep:
    state = problem.state or _first_state(config, problem)
    state = _extended(state, problem.trajectory.T_odom_keyframe)
    aligned = False
    if problem.align_to:
        moved = _aligned(config, problem, state)
        if moved is not None:
            state, aligned = moved, True
            problem = replace(problem, others=problem.align_to, anchored=False, align_to={})
    measured = _measured(config, problem, state.X.shape[2])
    state = _weighed(config, problem, measured, state)
    weights = _weights_of(config, problem, measured, state)
    links = _links(config, problem, measured, weights)
    block = Block(len(state.X), links)
    descended = block_descent.descend(block, state.X, STEPS, INNER_STEPS, config.relative_tolerance * 1e-4)
    together = bool(np.any((weights > 0) & ((measured.i < 0) | (measured.j < 0))))
    X = descended.X
    if together:
        X = block_descent.retracted(state.X, TOGETHER_RATIO * (descended.X - state.X))
    moved_most = float(np.abs(X - state.X_before).max())
    decided = sum(weight == 0.0 for weight in state.weights.values())
    next_state = _extrapolated(state, X, together)
    finished = state.control is None and not state.has_unjudged
    origin = _origin(problem, next_state.X, aligned)
    T_map_keyframe = block_descent.rounded(X, _origin(problem, X, aligned))
    return BlockStep(next_state, T_map_keyframe, origin, moved_most, aligned, finished, decided)


def _origin(problem: BlockProblem, X: Float, aligned: bool) -> Float:
    """Where the map frame lies (4, r): at the anchor's first keyframe, less its odometry; else as heard."""
    if problem.origin is not None and (aligned or not problem.anchored):
        return problem.origin
    return block_descent.composed(X[0], inverse(np.asarray(problem.trajectory.T_odom_keyframe[0], dtype=float)))


def _first_state(config: BackendConfig, problem: BlockProblem) -> BlockState:
    """The robot alone: its odometry, and the closures within it, in its own frame."""
    X = _tilted(block_descent.lifted(np.asarray(problem.trajectory.T_odom_keyframe, dtype=float), RANK))
    own = tuple(c for c in problem.closures if c.query.log == c.match.log)
    state = BlockState(X, X)
    if not own:
        return state
    alone = replace(problem, closures=own, others={}, align_to={})
    measured = _measured(config, alone, RANK)
    weights = np.ones(len(own)) if config.solver is Solver.LM else np.zeros(len(own))
    block = Block(len(X), _links(config, alone, measured, weights))
    X = block_descent.descend(block, X, FIRST_STEPS, INNER_STEPS, config.relative_tolerance).X
    return BlockState(X, X)


def _tilted(X: Float) -> Float:
    """Tilt frames (n, 4, r) a little out of their three dimensions; otherwise no step would ever leave them."""
    out = X.copy()
    out[:, :3] += TILT * np.random.default_rng(0).normal(size=out[:, :3].shape)
    out[:, :3] = block_descent.orthonormal(out[:, :3])
    return out if X.shape[2] > 3 else X


def _extended(state: BlockState, T_odom: Float) -> BlockState:
    """Append keyframes that came since, by odometry from the last one."""
    n = len(state.X)
    if len(T_odom) <= n:
        return state
    T_last = inverse(T_odom[n - 1]) @ T_odom[n:]
    return replace(
        state,
        X=np.concatenate([state.X, np.swapaxes(T_last, 1, 2) @ state.X[n - 1]]),
        X_before=np.concatenate([state.X_before, np.swapaxes(T_last, 1, 2) @ state.X_before[n - 1]]),
    )


def _aligned(config: BackendConfig, problem: BlockProblem, state: BlockState) -> BlockState | None:
    """Move the whole block into the frame of others, by the pose that the most closures agree with; None if too few."""
    closures = [c for c in problem.closures if c.query in problem.align_to or c.match in problem.align_to]
    assert problem.origin is not None, "poses are aligned to a frame whose origin was heard"
    T_own = block_descent.rounded(state.X, state.X[0])
    pair = align_pair(_rays(config, problem, closures, T_own))
    if len(pair.agreeing) < config.closures_to_join_min:
        return None
    X = _tilted(block_descent.composed(problem.origin, pair.T_a_b @ T_own))
    kept = {p: w for p, w in state.weights.items() if p.low.log == p.high.log}
    return BlockState(X, X, weights=kept, epoch=state.epoch)


def _rays(config: BackendConfig, problem: BlockProblem, closures: Sequence[LoopClosure], T_own: Float) -> Rays:
    """Closures as rays from the others' frame (a) into the own one (b)."""
    path_m = travelled_m(problem.trajectory)
    far = [c.match if c.query.log == problem.log else c.query for c in closures]
    near = [c.query if c.query.log == problem.log else c.match for c in closures]
    assert problem.origin is not None
    T_far = block_descent.rounded(np.array([problem.align_to[keyframe] for keyframe in far]), problem.origin)
    T_hat = np.array([np.asarray(c.T_query_match_unscaled, dtype=float) for c in closures])
    flipped = np.array([c.query.log == problem.log for c in closures])
    T_hat[flipped] = inverse(T_hat[flipped])
    scale = np.array([initial_scale(c, config) for c in closures])
    norms = np.linalg.norm(T_hat[:, :3, 3], axis=1)
    u = np.einsum("kij,kj->ki", T_far[:, :3, :3], T_hat[:, :3, 3]) / np.maximum(norms, 1e-12)[:, None]
    weight = np.array([closure_probability(c.match_ratio, config.steepness) for c in closures])
    indices = np.array([keyframe.index for keyframe in near])
    return Rays(
        tuple(range(len(closures))), T_far, T_own[indices], T_hat[:, :3, :3], u, norms * scale,
        np.array([c.metric for c in closures]), weight, path_m[indices], path_m[indices],
    )  # fmt: skip


def _measured(config: BackendConfig, problem: BlockProblem, rank: int) -> MeasuredClosures:
    """The block's closures as arrays, with the poses of others as last heard."""
    closures, log = problem.closures, problem.log
    alone = _without_others(config, closures, log)
    fixed, known = np.zeros((len(closures), 4, rank)), alone.known.copy()
    for k, closure in enumerate(closures):
        for end in (closure.query, closure.match):
            if end.log != log:
                known[k] &= _usable(problem.others, end, rank)
                fixed[k] = problem.others[end] if known[k] else 0.0
    return replace(alone, fixed=fixed, known=known)


@lru_cache(maxsize=CLOSURES_MAX)
def _without_others(config: BackendConfig, closures: tuple[LoopClosure, ...], log: LogId) -> MeasuredClosures:
    """What does not change from one iteration to the next; `known` says only whether the covariance is one."""
    E = len(closures)
    scale = np.array([initial_scale(c, config) for c in closures])
    T = np.array([c.T_query_match_unscaled for c in closures], dtype=float).reshape(E, 4, 4)
    T[:, :3, 3] *= scale[:, None]
    kappa, tau = isotropic_weights(closure_covariances(closures, scale, config).reshape(E, 6, 6))
    known = np.isfinite(kappa) & np.isfinite(tau) & (kappa > 0) & (tau > 0)
    i = np.array([c.query.index if c.query.log == log else -1 for c in closures], dtype=np.int64)
    j = np.array([c.match.index if c.match.log == log else -1 for c in closures], dtype=np.int64)
    own = np.array([decides(c) == log for c in closures], dtype=bool)
    pairs = tuple(CandidatePair.of(c.query, c.match) for c in closures)
    return MeasuredClosures(pairs, i, j, T, kappa, tau, np.zeros((E, 4, RANK)), known, own)


def _usable(others: Mapping[KeyframeId, Float], keyframe: KeyframeId, rank: int) -> bool:
    """Whether another robot's pose is known, of the rank that this robot relaxes to."""
    return keyframe in others and others[keyframe].shape == (4, rank)


def isotropic_weights(covariances: Float) -> tuple[Float, Float]:
    """SE-Sync's weights of covariances (E, 6, 6), rotation first: `kappa = 3 / (2 tr)`, `tau = 3 / tr`.

    Traces are those of the inverse information blocks; of an isotropic covariance, twice the back end's cost is then
    `sum kappa |R_j - R_i R|^2 + tau |t_j - t_i - R_i t|^2`.
    """
    if len(covariances) == 0:
        return np.zeros(0), np.zeros(0)
    information = np.linalg.inv(covariances)
    rotation = np.linalg.inv(information[:, :3, :3])
    translation = np.linalg.inv(information[:, 3:, 3:])
    return 1.5 / np.trace(rotation, axis1=1, axis2=2), 3.0 / np.trace(translation, axis1=1, axis2=2)


def _weighed(config: BackendConfig, problem: BlockProblem, measured: MeasuredClosures, state: BlockState) -> BlockState:
    """Decide robust weights that are this robot's: at once for new closures, the others once per stage.

    A new closure that does not agree waits until the weights have been final for a while; then all robots of the
    frame graduate their weights again, from the most convex cost on.
    """
    if config.solver is Solver.LM:
        return state
    usable = np.flatnonzero(measured.own & measured.known)
    bound = np.full(len(usable), float(chdtri(6.0, 1.0 - config.inlier_probability)))
    squared = measured.residuals(state.X)[usable]
    pairs = [measured.pairs[k] for k in usable]
    state = _with_new(state, pairs, squared <= bound)
    waited = state.control is None and state.in_stage >= REST_ITERATIONS
    if problem.epoch > state.epoch or (state.has_unjudged and waited):
        epoch = max(problem.epoch, state.epoch + (not problem.epoch > state.epoch))
        if len(usable) == 0:
            return replace(state, epoch=epoch, has_unjudged=False)
        control = initial_control(Solver.GNC_TLS, squared, bound, config.gnc_start_ratio)
        begun = _decided(state, pairs, gnc_weights(Solver.GNC_TLS, squared, bound, control), control)
        return replace(begun, epoch=epoch, has_unjudged=False)
    if state.in_stage < STAGE_ITERATIONS or len(usable) == 0:
        return state
    if state.control is None:
        before = np.array([state.weights[pair] for pair in pairs])
        within = np.where(before > 0.5, squared <= LEAVE_RATIO * bound, squared <= bound)
        return state if np.array_equal(within, before > 0.5) else _decided(state, pairs, within.astype(float), None)
    control = state.control * config.gnc_step
    weights = gnc_weights(Solver.GNC_TLS, squared, bound, control)
    if gnc_finished(Solver.GNC_TLS, weights, control):
        return _decided(state, pairs, (squared <= bound).astype(float), None)
    return _decided(state, pairs, weights, control)


def _with_new(state: BlockState, pairs: Sequence[CandidatePair], agrees: NDArray[np.bool_]) -> BlockState:
    """Use new closures that agree; the others wait."""
    new = {pair: float(fits) for pair, fits in zip(pairs, agrees.tolist(), strict=True) if pair not in state.weights}
    if not new:
        return state
    unjudged = state.has_unjudged or not all(new.values())
    return replace(state, weights={**state.weights, **new}, has_unjudged=unjudged)


def _decided(state: BlockState, pairs: Sequence[CandidatePair], weights: Float, control: float | None) -> BlockState:
    """New weights: a new stage, and the extrapolation starts anew."""
    chosen = {**state.weights, **dict(zip(pairs, weights.tolist(), strict=True))}
    return replace(state, weights=chosen, control=control, in_stage=0, age=0)


def _weights_of(config: BackendConfig, problem: BlockProblem, measured: MeasuredClosures, state: BlockState) -> Float:
    """Robust weights (E,): decided here, or heard; a closure that nobody decided yet does not count, except in LM."""
    if config.solver is Solver.LM:
        return measured.known.astype(float)
    source = {True: state.weights, False: problem.heard}
    weights = [source[bool(own)].get(pair, 0.0) for pair, own in zip(measured.pairs, measured.own, strict=True)]
    return np.where(measured.known, weights, 0.0)


def _links(config: BackendConfig, problem: BlockProblem, measured: MeasuredClosures, weights: Float) -> Links:
    """Closures with weight, then odometry, then what holds the anchor's first keyframe."""
    T_odom = np.asarray(problem.trajectory.T_odom_keyframe, dtype=float)
    n, rank = len(T_odom), measured.fixed.shape[2]
    used = weights > 0
    covariances = measured_odometry(problem.trajectory, config).edge_covariances
    if covariances is None:
        one = diagonal_covariance(config.odometry_rotation_sigma_rad, config.odometry_translation_sigma_m)
        covariances = np.broadcast_to(one, (n - 1, 6, 6))
    kappa, tau = isotropic_weights(np.asarray(covariances, dtype=float))
    before = np.arange(n - 1)
    i, j, T = (
        [measured.i[used], before],
        [measured.j[used], before + 1],
        [measured.T[used], inverse(T_odom[:-1]) @ T_odom[1:]],
    )
    kappas, taus = [(weights * measured.kappa)[used], kappa], [(weights * measured.tau)[used], tau]
    fixed = [measured.fixed[used], np.zeros((n - 1, 4, rank))]
    return Links(*(np.concatenate(part) for part in (i, j, T, kappas, taus, fixed)))


def _extrapolated(state: BlockState, X: Float, together: bool) -> BlockState:
    """Nesterov's extrapolation; where it points back (O'Donoghue 2015), and alone, it starts anew."""
    step = X - state.X_before
    age = 0 if not together or np.sum((state.X - X) * step) > 0 else state.age
    momentum = min(age / (age + 3.0), MOMENTUM_MAX)
    return replace(
        state, X=block_descent.retracted(X, momentum * step), X_before=X, age=age + 1, in_stage=state.in_stage + 1
    )
