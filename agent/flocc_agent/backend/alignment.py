"""First alignment of the robots' odom frames from several closures that are right up to scale, some of them wrong.

For a pair of logs every closure k proposes the rotation `R_k = R_i R_hat R_j^T` of frame b in frame a, and, given a
rotation R, a ray on which the translation lies: `t = (p_i - R p_j) + s u_k`, s >= 0, `u_k = R_i t_hat / |t_hat|`.
A hypothesis is the rotation of one closure and the point of its ray nearest to another's. The hypothesis that the
most probability agrees with wins; all closures that agree with it are then averaged. Tolerances grow with the
distance that both robots travelled between two closures, because odometry drifts. The map grows by the pair of
greatest support, so that the first closure that happens to come decides nothing; a robot that is placed has all its
closures with the robots that are there already as judges, because a robot may be held by one closure with each of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_agent.core.registration import closure_probability
from flocc_agent.geometry import Float, inverse, nearest_rotation, pose
from flocc_protocol.ids import KeyframeId, LogId

Bool = NDArray[np.bool_]
Int = NDArray[np.int64]

HYPOTHESES_MAX = 32
PARTNERS_MAX = 32
SCORED_MAX = 200
ROTATION_TOLERANCE_RAD = 0.25
ROTATION_DRIFT_RAD_PER_M = 0.002
TRANSLATION_TOLERANCE_M = 1.5
TRANSLATION_DRIFT_RATIO = 0.02
SCALE_RANGE_RATIO = 4.0
AVERAGING_ROUNDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class PairAlignment:
    """Pose of log b's odom frame in log a's.

    Attributes:
        T_a_b: (4, 4) pose of odom frame b in odom frame a.
        support: Sum of the agreeing closures' probabilities.
        agreeing: Index in the graph of each closure that agrees.
    """

    T_a_b: Float
    support: float
    agreeing: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Closures of one pair of logs, both sides in their own odom frames.

    Attributes:
        ids: Index in the graph of each closure.
        T_i: (K, 4, 4) keyframes in odom frame a.
        T_j: (K, 4, 4) keyframes in odom frame b.
        R_hat: (K, 3, 3) measured rotation of keyframe j in keyframe i.
        u: (K, 3) unit direction from keyframe i to keyframe j, in frame a; zero for a zero translation.
        length_m: (K,) expected distance, NaN where no scale is known.
        exact: (K,) whether the distance is metric.
        weight: (K,) probability of Eq. (2).
        travelled_a_m: (K,) path length of robot a up to keyframe i.
        travelled_b_m: (K,) path length of robot b up to keyframe j.
    """

    ids: tuple[int, ...]
    T_i: Float
    T_j: Float
    R_hat: Float
    u: Float
    length_m: Float
    exact: Bool
    weight: Float
    travelled_a_m: Float
    travelled_b_m: Float

    def rotations_a_b(self) -> Float:
        """Rotation (K, 3, 3) of frame b in frame a that each closure proposes."""
        return self.T_i[:, :3, :3] @ self.R_hat @ np.swapaxes(self.T_j[:, :3, :3], 1, 2)

    def moved(self, by_a: Float, by_b: Float) -> "Rays":
        """The same with the keyframes of each side moved by (3,) in their odom frame."""
        T_i, T_j = self.T_i.copy(), self.T_j.copy()
        T_i[:, :3, 3] += by_a
        T_j[:, :3, 3] += by_b
        return replace(self, T_i=T_i, T_j=T_j)

    def origins(self, R_a_b: Float) -> Float:
        """Start (K, 3) of each ray, for a rotation of frame b in frame a."""
        return np.asarray(self.T_i[:, :3, 3] - self.T_j[:, :3, 3] @ R_a_b.T)

    def distances(self, t: Float, origins: Float, of: Int | slice = slice(None)) -> Float:
        """Distance (..., K) of translations (..., 3) from the allowed segment of each ray, or of some of them."""
        u, length_m = self.u[of], self.length_m[of]
        offset = t[..., None, :] - origins[of]
        along = np.einsum("...ki,ki->...k", offset, u)
        low = np.where(self.exact[of], length_m, np.nan_to_num(length_m / SCALE_RANGE_RATIO, nan=0.0))
        high = np.where(self.exact[of], length_m, np.nan_to_num(length_m * SCALE_RANGE_RATIO, nan=np.inf))
        nearest = np.clip(along, low, high)
        return np.asarray(np.linalg.norm(offset - nearest[..., None] * u, axis=-1))


def align(
    trajectories: Mapping[LogId, Trajectory], closures: Mapping[int, LoopClosure], steepness: float
) -> tuple[dict[LogId, Float], dict[tuple[LogId, LogId], PairAlignment]]:
    """Place the odom frames of connected logs in the odom frame of the lowest one.

    Args:
        trajectories: Odometry of the logs of one component.
        closures: Usable closures, by index in the graph.
        steepness: k of Eq. (2).

    Returns:
        `T_map_odom` (4, 4) of every log that closures connect to the lowest, and every pair's alignment.
    """
    path_m = {log: travelled_m(trajectory) for log, trajectory in trajectories.items()}
    pairs: dict[tuple[LogId, LogId], list[int]] = {}
    for k in sorted(closures):
        a, b = sorted((closures[k].query.log, closures[k].match.log))
        if a != b:
            pairs.setdefault((a, b), []).append(k)
    aligned = {
        (a, b): align_pair(rays_of(ids, closures, trajectories, path_m, steepness))
        for (a, b), ids in sorted(pairs.items())
    }
    return _grown(sorted(trajectories), aligned, trajectories, closures, path_m, steepness), aligned


def travelled_m(trajectory: Trajectory) -> Float:
    """Path length (N,) up to each keyframe."""
    steps = np.linalg.norm(np.diff(trajectory.T_odom_keyframe[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def rays_of(
    ids: Sequence[int],
    closures: Mapping[int, LoopClosure],
    trajectories: Mapping[LogId, Trajectory],
    path_m: Mapping[LogId, Float],
    steepness: float,
) -> Rays:
    """Bring closures of one pair of logs into the order (lower log, higher log), within a log (earlier, later)."""
    ends = {k: (min(c.query, c.match), max(c.query, c.match)) for k in ids for c in (closures[k],)}
    poses = {log: np.asarray(t.T_odom_keyframe, dtype=float) for log, t in trajectories.items()}
    return rays_from(ids, closures, ends, poses, path_m, steepness)


def rays_from(
    ids: Sequence[int],
    closures: Mapping[int, LoopClosure],
    ends: Mapping[int, tuple[KeyframeId, KeyframeId]],
    poses: Mapping[LogId, Float],
    path_m: Mapping[LogId, Float],
    steepness: float,
) -> Rays:
    """Closures from their ends on side a to those on side b, with poses (N, 4, 4) of each log in its side's frame."""
    T_i, T_j, T_hat, known, exact, weight, path = [], [], [], [], [], [], []
    for k in ids:
        c, (a, b) = closures[k], ends[k]
        T = np.asarray(c.T_query_match_unscaled, dtype=float)
        T_hat.append(T if a == c.query else inverse(T))
        T_i.append(poses[a.log][a.index])
        T_j.append(poses[b.log][b.index])
        known.append(1.0 if c.metric else (c.scale_initial or np.nan))
        exact.append(c.metric)
        weight.append(closure_probability(c.match_ratio, steepness))
        path.append((path_m[a.log][a.index], path_m[b.log][b.index]))
    T_hats, T_is = np.array(T_hat), np.array(T_i)
    norms = np.linalg.norm(T_hats[:, :3, 3], axis=1)
    u = np.einsum("kij,kj->ki", T_is[:, :3, :3], T_hats[:, :3, 3]) / np.maximum(norms, 1e-12)[:, None]
    travelled = np.array(path)
    return Rays(
        tuple(ids), T_is, np.array(T_j), T_hats[:, :3, :3], u, norms * np.array(known), np.array(exact, dtype=bool),
        np.array(weight), travelled[:, 0], travelled[:, 1],
    )  # fmt: skip


def align_pair(rays: Rays, hypotheses_max: int = HYPOTHESES_MAX) -> PairAlignment:
    """Find the pose of frame b in frame a with which the most closures agree, and average those.

    Frames turn about the middle of their keyframes: about an origin 5,000 km away (UTM) the least difference between
    two rotations would be kilometres.
    """
    middle_a, middle_b = rays.T_i[:, :3, 3].mean(axis=0), rays.T_j[:, :3, 3].mean(axis=0)
    found = _align_near(rays.moved(-middle_a, -middle_b), hypotheses_max)
    R, t = found.T_a_b[:3, :3], found.T_a_b[:3, 3]
    return replace(found, T_a_b=pose(R, middle_a + t - R @ middle_b))


def _align_near(rays: Rays, hypotheses_max: int) -> PairAlignment:
    """The same for frames whose origins are near."""
    R_all = rays.rotations_a_b()
    best_score, best_R, best_t, best_tolerance = -1.0, np.eye(3), np.zeros(3), np.ones(len(R_all))
    judges = evenly(np.arange(len(R_all)), SCORED_MAX)
    for k in _strongest(rays, R_all, hypotheses_max):
        apart_m = np.abs(rays.travelled_a_m - rays.travelled_a_m[k]) + np.abs(
            rays.travelled_b_m - rays.travelled_b_m[k]
        )
        turned = _angles(R_all, R_all[k]) < ROTATION_TOLERANCE_RAD + ROTATION_DRIFT_RAD_PER_M * apart_m
        tolerance_m = TRANSLATION_TOLERANCE_M + TRANSLATION_DRIFT_RATIO * apart_m
        origins = rays.origins(R_all[k])
        t = _translations(rays, origins, k, turned)
        agreement = np.maximum(1.0 - (rays.distances(t, origins, judges) / tolerance_m[judges]) ** 2, 0.0)
        scores = agreement @ (rays.weight * turned)[judges]
        top = int(np.argmax(scores))
        if scores[top] > best_score:
            best_score, best_R, best_t = float(scores[top]), R_all[k], t[top]
            best_tolerance = np.where(turned, tolerance_m, 0.0)
    return _averaged(rays, R_all, best_R, best_t, best_tolerance)


def _strongest(rays: Rays, R_all: Float, count_max: int) -> list[int]:
    """Closures that are tried as hypotheses: those whose rotation the most others share, then the first."""
    if len(R_all) <= count_max:
        return list(range(len(R_all)))
    voters = evenly(np.arange(len(R_all)), SCORED_MAX)
    votes = np.array([rays.weight[voters] @ (_angles(R_all[voters], R) < ROTATION_TOLERANCE_RAD) for R in R_all])
    ranked = np.lexsort((np.arange(len(votes)), -votes))
    spread = ranked[: max(len(ranked) // 2, count_max)]
    return [int(k) for k in evenly(spread, count_max)]


def evenly(indices: Int, count_max: int) -> Int:
    """At most so many of the indices, evenly spread over them."""
    if len(indices) <= count_max:
        return indices
    return np.asarray(indices[np.linspace(0, len(indices) - 1, count_max).astype(int)])


def _translations(rays: Rays, origins: Float, k: int, partners: Bool) -> Float:
    """Points (M, 3) of ray k nearest to the rays of its partners, and at its expected length."""
    others = evenly(np.flatnonzero(partners), PARTNERS_MAX)
    v = origins[others] - origins[k]
    cosine = rays.u[others] @ rays.u[k]
    sine2 = np.maximum(1.0 - cosine**2, 1e-3)
    s = (v @ rays.u[k] - cosine * np.einsum("ki,ki->k", v, rays.u[others])) / sine2
    expected = rays.length_m[k] if np.isfinite(rays.length_m[k]) else 0.0
    if rays.exact[k]:
        s = np.array([expected])
    elif expected > 0:
        s = np.clip(np.append(s, expected), expected / SCALE_RANGE_RATIO, expected * SCALE_RANGE_RATIO)
    else:
        s = np.append(np.maximum(s, 0.0), 0.0)
    return np.asarray(origins[k] + s[:, None] * rays.u[k])


def _averaged(rays: Rays, R_all: Float, R: Float, t: Float, tolerance_m: Float) -> PairAlignment:
    """Average the closures that agree: rotations by their chordal mean, rays by weighted least squares."""
    near = (rays.distances(t, rays.origins(R)) < tolerance_m) & (tolerance_m > 0)
    if not np.any(near):
        return PairAlignment(pose(R, t), 0.0, ())
    weight = rays.weight * near
    R_mean = nearest_rotation(np.einsum("k,kij->ij", weight, R_all))
    origins = rays.origins(R_mean)
    for _ in range(AVERAGING_ROUNDS):
        along = np.maximum(np.einsum("ki,ki->k", t - origins, rays.u), 0.0)
        along = np.where(rays.exact, rays.length_m, along)
        points = origins + along[:, None] * rays.u
        robust = weight / (1.0 + (np.linalg.norm(t - points, axis=1) / np.maximum(tolerance_m, 1e-9)) ** 2)
        t = robust @ points / robust.sum()
    agreeing = tuple(rays.ids[k] for k in np.flatnonzero(near))
    return PairAlignment(pose(R_mean, t), float(weight.sum()), agreeing)


def _angles(R_all: Float, R: Float) -> Float:
    """Angles (K,) between rotations (K, 3, 3) and one (3, 3)."""
    cosine = 0.5 * (np.einsum("kij,ij->k", R_all, R) - 1.0)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _grown(
    logs: Sequence[LogId],
    aligned: Mapping[tuple[LogId, LogId], PairAlignment],
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    path_m: Mapping[LogId, Float],
    steepness: float,
) -> dict[LogId, Float]:
    """Grow the map frame from the anchor along the pairs of greatest support."""
    T_map_odom: dict[LogId, Float] = {logs[0]: np.eye(4)}
    while True:
        reachable = [
            (-pair.support, a, b) for (a, b), pair in aligned.items() if (a in T_map_odom) != (b in T_map_odom)
        ]
        if not reachable:
            return T_map_odom
        _, a, b = min(reachable)
        there, new = (a, b) if a in T_map_odom else (b, a)
        of_pair = aligned[a, b]
        T_there_new = of_pair.T_a_b if there == a else inverse(of_pair.T_a_b)
        T_map = {log: T @ np.asarray(trajectories[log].T_odom_keyframe) for log, T in T_map_odom.items()}
        of_all = align_pair(rays_to(new, T_map, closures, trajectories, path_m, steepness))
        joint = of_all.support > of_pair.support and len(of_all.agreeing) > len(of_pair.agreeing)
        T_map_odom[new] = of_all.T_a_b if joint else T_map_odom[there] @ T_there_new


def rays_to(
    log: LogId,
    T_map_keyframe: Mapping[LogId, Float],
    closures: Mapping[int, LoopClosure],
    trajectories: Mapping[LogId, Trajectory],
    path_m: Mapping[LogId, Float],
    steepness: float,
) -> Rays:
    """Closures of one log with all logs that have poses (N, 4, 4) in the map: those are side a, the log is side b."""
    ids = [
        k
        for k, c in sorted(closures.items())
        if (c.query.log == log and c.match.log in T_map_keyframe)
        or (c.match.log == log and c.query.log in T_map_keyframe)
    ]
    ends = {k: (closures[k].match, closures[k].query) for k in ids}
    ends = {k: pair if pair[1].log == log else (pair[1], pair[0]) for k, pair in ends.items()}
    T_own = {log: np.asarray(trajectories[log].T_odom_keyframe, dtype=float)}
    return rays_from(ids, closures, ends, {**T_map_keyframe, **T_own}, path_m, steepness)
