"""Pairwise consistency maximisation (Mangelson 2018) for closures whose scale may be unknown.

Two closures k, l of one pair of robots, or within one robot, and the odometry between them form a loop:
`T_k B = A T_l`, with A and B the odometry of both ends from k to l. The rotations must agree. Translations must agree
for some positive lengths s_k, s_l of the two measured directions: `s_k t_k + R_k t_B - t_A - s_l R_A t_l = 0`, of which
the part across both directions is left as a test. Variances grow along the odometry. The greatest set of closures that
agree two by two is kept; it is found greedily from the best connected closures on.

What it needs is an odometry whose covariances tell the truth: with optimistic ones, right closures far apart in time
disagree and are lost. Hence it is off by default; GNC needs it less.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from flocc_agent.backend.alignment import Rays, rays_of, travelled_m
from flocc_agent.backend.pair_closures import by_logs
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

CLOSURES_MAX = 1500
SEEDS_MAX = 50
FREEDOM = 4
PARALLEL_MIN = 1e-9
REASON = "is not consistent with most closures of this pair of robots, or within this robot"


def inconsistent(
    trajectories: Mapping[LogId, Trajectory], closures: Mapping[int, LoopClosure], config: BackendConfig
) -> dict[int, str]:
    """Closures to turn away, by index, with the reason; pairs with more than `CLOSURES_MAX` are left alone."""
    pairs = by_logs(closures)
    path_m = {log: travelled_m(trajectory) for log, trajectory in trajectories.items()}
    dropped: dict[int, str] = {}
    for ids in (ids for ids in pairs.values() if 2 < len(ids) <= CLOSURES_MAX):
        rays = rays_of(ids, closures, trajectories, path_m, config.steepness)
        keep = greatest_clique(agreement(rays, _step_variances(trajectories, config), config))
        if len(keep) > 1:
            dropped |= {ids[n]: REASON for n in range(len(ids)) if n not in keep}
    return dropped


def _step_variances(trajectories: Mapping[LogId, Trajectory], config: BackendConfig) -> tuple[float, float]:
    """Variance per metre travelled of rotation (rad^2) and translation (m^2), the greatest of the robots involved."""
    rotation, translation = 0.0, 0.0
    for trajectory in trajectories.values():
        steps, length_m = len(trajectory) - 1, float(travelled_m(trajectory)[-1])
        if steps < 1 or length_m <= 0.0:
            continue
        of_step = (config.odometry_rotation_sigma_rad**2, config.odometry_translation_sigma_m**2)
        if trajectory.edge_covariances is not None:
            diagonals = np.diagonal(np.asarray(trajectory.edge_covariances), axis1=1, axis2=2).mean(axis=0)
            of_step = (float(diagonals[:3].mean()), float(diagonals[3:].mean()))
        rotation = max(rotation, of_step[0] * steps / length_m)
        translation = max(translation, of_step[1] * steps / length_m)
    return rotation, translation


def agreement(rays: Rays, variance_per_m: tuple[float, float], config: BackendConfig) -> Bool:
    """Whether closures agree, two by two: (K, K), symmetric, true on the diagonal."""
    apart_m = np.abs(rays.travelled_a_m[:, None] - rays.travelled_a_m)
    apart_m = apart_m + np.abs(rays.travelled_b_m[:, None] - rays.travelled_b_m)
    R_a_b = rays.rotations_a_b()
    cosine = 0.5 * (np.einsum("kij,lij->kl", R_a_b, R_a_b) - 1.0)
    turned_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
    rotation_variance = 2.0 * config.closure_rotation_sigma_rad**2 + variance_per_m[0] * apart_m
    missed_m, lever_m = _missed(rays, R_a_b)
    translation_variance = 2.0 * config.closure_translation_sigma_m**2 + variance_per_m[1] * apart_m
    translation_variance = translation_variance + rotation_variance * lever_m**2
    squared = turned_rad**2 / rotation_variance + missed_m**2 / translation_variance
    agrees = squared <= chdtri(FREEDOM, 1.0 - config.inlier_probability)
    both: Bool = np.asarray(agrees & agrees.T)
    np.fill_diagonal(both, True)
    return both


def _missed(rays: Rays, R_a_b: Float) -> tuple[Float, Float]:
    """How far (K, K) two closures' rays miss each other under the first one's rotation, and the lever of rotations."""
    p_i, p_j = rays.T_i[:, :3, 3], rays.T_j[:, :3, 3]
    across_b = np.einsum("kij,klj->kli", R_a_b, p_j[None, :] - p_j[:, None])
    v = across_b - (p_i[None, :] - p_i[:, None])
    u_k, u_l = np.broadcast_to(rays.u[:, None], v.shape), np.broadcast_to(rays.u[None, :], v.shape)
    known = np.where(rays.exact, rays.length_m, np.nan)
    s_k, s_l = np.broadcast_to(known[:, None], v.shape[:2]), np.broadcast_to(known[None, :], v.shape[:2])
    missed = _least(v, u_k, u_l, s_k, s_l)
    return missed, np.asarray(np.linalg.norm(across_b, axis=2))


def _least(v: Float, u_k: Float, u_l: Float, known_k: Float, known_l: Float) -> Float:
    """Least length of `v + s_k u_k - s_l u_l` over lengths that are not negative, or known."""

    def along(u: Float, w: Float, known: Float) -> Float:
        return np.where(np.isnan(known), np.maximum(-np.einsum("kli,kli->kl", u, w), 0.0), np.nan_to_num(known))

    def length(s_k: Float, s_l: Float) -> Float:
        return np.asarray(np.linalg.norm(v + s_k[..., None] * u_k - s_l[..., None] * u_l, axis=2))

    cosine = np.einsum("kli,kli->kl", u_k, u_l)
    a, b = np.einsum("kli,kli->kl", u_k, v), np.einsum("kli,kli->kl", u_l, v)
    sine2 = np.maximum(1.0 - cosine**2, PARALLEL_MIN)
    inner_k = np.where(np.isnan(known_k), np.maximum((cosine * b - a) / sine2, 0.0), np.nan_to_num(known_k))
    best_l = along(-u_l, v + inner_k[..., None] * u_k, known_l)
    none_k = np.where(np.isnan(known_k), 0.0, np.nan_to_num(known_k))
    only_l = along(-u_l, v + none_k[..., None] * u_k, known_l)
    none_l = np.where(np.isnan(known_l), 0.0, np.nan_to_num(known_l))
    only_k = along(u_k, v - none_l[..., None] * u_l, known_k)
    return np.minimum(np.minimum(length(inner_k, best_l), length(none_k, only_l)), length(only_k, none_l))


def greatest_clique(agrees: Bool) -> set[int]:
    """A large set of closures that all agree, greedily: from each of the best connected ones on, the best next."""
    degree = agrees.sum(axis=1)
    best: list[int] = []
    for seed in np.lexsort((np.arange(len(degree)), -degree))[:SEEDS_MAX]:
        if degree[seed] <= len(best):
            break
        clique, candidates = [int(seed)], agrees[seed].copy()
        candidates[seed] = False
        while np.any(candidates):
            inside = np.where(candidates, agrees[:, candidates].sum(axis=1), -1)
            chosen = int(np.argmax(inside))
            clique.append(chosen)
            candidates &= agrees[chosen]
            candidates[chosen] = False
        best = clique if len(clique) > len(best) else best
    return set(best)
