"""Closures that are held before the solve, because alone they would do damage: until a second one agrees.

Each closure is compared with the nearest others of its two robots: both say where one keyframe is from the other, one
directly, the other by a piece of odometry on both sides. They agree where the difference is within what odometry and
both closures allow; a free scale is one of the things that allow. A closure with which none agrees is held where one
that others agree with contradicts it, where its own robot's odometry does, or where with it a scale would collapse. A
function of the graph alone: every leader holds the same ones, and the records stay. How far uncertainties are widened
is taken from the closures themselves: most of them are right where this is to help.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import chdtri

from flocc_agent.backend.problem import (
    closure_covariances,
    diagonal_covariance,
    initial_scale,
    prior_sigmas,
)
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_agent.geometry import inverse
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

PARTNERS = 8
"""How many other closures each one is compared with: those that are nearest on both sides."""
EXCESS_MAX = 16.0
"""Squared differences are divided by at most so much; where they are larger, closures are wrong, not uncertainties."""
QUARTER_OF_SIX = 3.455
"""Chi-square of six degrees of freedom: a quarter lies below."""
COLLAPSED_RATIO = 0.1
"""A guessed length that becomes shorter than this part of the guess has collapsed; one without a guess, below zero."""
FIXED_M = 1e-6
ODOMETRY_LENGTH_SIGMA = 0.05
"""What odometry's lengths may be off by, beside its noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """One robot's odometry, with sums from which the uncertainty of any piece follows.

    Attributes:
        T: (N, 4, 4) poses.
        rotation: (N,) variance of rotation up to each keyframe, rad^2.
        levered: (N, 3) the same of each edge times where it lies, summed up.
        squared: (N,) the same times the square of where it lies.
        translation: (N,) variance of translation, m^2.
    """

    T: Float
    rotation: Float
    levered: Float
    squared: Float
    translation: Float

    @classmethod
    def of(cls, trajectory: Trajectory, config: BackendConfig) -> "Way":
        """Sum up a trajectory's covariances, each taken as isotropic: the largest of its three variances."""
        T = np.asarray(trajectory.T_odom_keyframe, dtype=float)
        S = trajectory.edge_covariances
        if S is None:
            one = diagonal_covariance(config.odometry_rotation_sigma_rad, config.odometry_translation_sigma_m)
            S = np.broadcast_to(one, (len(T) - 1, 6, 6))
        variances = np.diagonal(S, axis1=1, axis2=2)
        turning, moving = variances[:, :3].max(axis=1), variances[:, 3:].max(axis=1)
        at = T[1:, :3, 3]
        levered, squared = turning[:, None] * at, turning * np.einsum("ni,ni->n", at, at)
        return cls(T, _summed(turning), _summed(levered), _summed(squared), _summed(moving))

    def variances(self, i: Int, j: Int, x: Float) -> tuple[Float, Float]:
        """Variances (K,) between keyframes i and j (K,): of rotation, and of a point x (K, 3) that is held by j."""
        low, high = np.minimum(i, j), np.maximum(i, j)
        rotation = self.rotation[high] - self.rotation[low]
        lever = self.levered[high] - self.levered[low]
        squared = self.squared[high] - self.squared[low]
        swung = squared - 2.0 * np.einsum("ki,ki->k", x, lever) + rotation * np.einsum("ki,ki->k", x, x)
        stretch = ODOMETRY_LENGTH_SIGMA**2 * np.sum((self.T[i, :3, 3] - self.T[j, :3, 3]) ** 2, axis=1)
        return rotation, np.maximum(swung, 0.0) + self.translation[high] - self.translation[low] + stretch


def _summed(values: Float) -> Float:
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])


@dataclass(frozen=True, slots=True, eq=False)
class PairClosures:
    """Closures of one pair of robots, from the lower keyframe to the higher one.

    Attributes:
        ids: (K,) numbers in the graph.
        i: (K,) keyframe of the lower log.
        j: (K,) keyframe of the higher log.
        T: (K, 4, 4) pose of j in i, in metres at the initial scale.
        u: (K, 3) direction of its translation.
        length_m: (K,) of its translation.
        length_sigma_m: (K,) standard deviation of that by a free scale.
        shorter_max_m: (K,) by how much the length may become shorter before its scale has collapsed.
        rotation: (K,) variance, rad^2.
        translation: (K,) variance, m^2.
    """

    ids: Int
    i: Int
    j: Int
    T: Float
    u: Float
    length_m: Float
    length_sigma_m: Float
    shorter_max_m: Float
    rotation: Float
    translation: Float


@dataclass(frozen=True, slots=True, eq=False)
class Ray:
    """A length that is free: its direction (K, 3), standard deviation (K,), and how much shorter (K,) it may become."""

    u: Float
    sigma_m: Float
    shorter_max_m: Float


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """How each closure compares with what something else says of its keyframes, (K,) or (K, P).

    Attributes:
        squared: Squared difference over its variance; its expectation is 6 where both are right.
        falls: Whether free lengths would have to collapse for a better fit.
        apart_m: The difference in metres, at the lengths that fit best.
        apart_rad: The difference in rotation.
        allowed_m: Standard deviation of the former.
        allowed_rad: Standard deviation of the latter.
    """

    squared: Float
    falls: Bool
    apart_m: Float
    apart_rad: Float
    allowed_m: Float
    allowed_rad: Float

    def shaped(self, shape: tuple[int, ...]) -> "Compared":
        """The same in another shape."""
        return Compared(*(getattr(self, f.name).reshape(shape) for f in fields(self)))

    def at(self, place: int | tuple[int, int]) -> "Compared":
        """One of the comparisons."""
        return Compared(*(np.asarray(getattr(self, f.name)[place]) for f in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class Judges:
    """What the closures of one pair of robots are compared with.

    Attributes:
        closures: They.
        partners: (K, P) places of the nearest others; itself where there are fewer.
        with_partners: (K, P) how they compare.
        with_odometry: (K,) of closures within a robot; None of others.
    """

    closures: PairClosures
    partners: Int
    with_partners: Compared
    with_odometry: Compared | None

    @property
    def size(self) -> int:
        """Number of the closures."""
        return len(self.closures.ids)


def held_closures(
    trajectories: Mapping[LogId, Trajectory], closures: Mapping[int, LoopClosure], config: BackendConfig
) -> dict[int, str]:
    """Reasons why closures are held, by number; none where measurements are to be taken as they are given.

    Only closures from images are: others (support is not 1) are fixes, tags, or of an opened map.
    """
    if config.formulation is Formulation.BASE or config.solver not in (Solver.GNC_TLS, Solver.GNC_GM):
        return {}
    ways = {log: Way.of(trajectory, config) for log, trajectory in trajectories.items()}
    pairs: dict[tuple[LogId, LogId], list[int]] = {}
    for k, closure in sorted(closures.items()):
        if closure.support != 1:
            continue
        low, high = sorted((closure.query, closure.match))
        pairs.setdefault((low.log, high.log), []).append(k)
    judges = [judges_of(ways[a], ways[b], measured(ids, closures, config), a == b) for (a, b), ids in pairs.items()]
    excess = excess_of(judges)
    bound = excess * float(chdtri(6.0, 1.0 - config.inlier_probability))
    held: dict[int, str] = {}
    for of_pair in judges:
        for n, reason in alarms(of_pair, bound, excess).items():
            k = int(of_pair.closures.ids[n])
            named = f"closure {closures[k].query} - {closures[k].match}"
            held[k] = f"{named}: held until another one agrees with it, because {reason}"
    return held


def measured(ids: list[int], closures: Mapping[int, LoopClosure], config: BackendConfig) -> PairClosures:
    """Closures of one pair of robots, turned so that the lower keyframe comes first."""
    chosen = [closures[k] for k in ids]
    scale = np.array([initial_scale(c, config) for c in chosen])
    T = np.array([c.T_query_match_unscaled for c in chosen], dtype=float)
    T[:, :3, 3] *= scale[:, None]
    turned = np.array([c.match < c.query for c in chosen], dtype=bool)
    T[turned] = inverse(T[turned])
    ends = [sorted((c.query, c.match)) for c in chosen]
    variances = np.diagonal(closure_covariances(chosen, scale, config), axis1=1, axis2=2)
    free = np.array([not c.metric for c in chosen], dtype=bool)
    sigmas = prior_sigmas(chosen, config)
    length_m = np.linalg.norm(T[:, :3, 3], axis=1)
    return PairClosures(
        ids=np.array(ids),
        i=np.array([low.index for low, _ in ends]),
        j=np.array([high.index for _, high in ends]),
        T=T,
        u=T[:, :3, 3] / np.maximum(length_m, 1e-12)[:, None],
        length_m=length_m,
        length_sigma_m=np.where(free, sigmas * length_m, 0.0),
        shorter_max_m=np.where(sigmas < 1.0, 1.0 - COLLAPSED_RATIO, 1.0) * length_m,
        rotation=variances[:, :3].max(axis=1),
        translation=variances[:, 3:].max(axis=1),
    )


def judges_of(a: Way, b: Way, closures: PairClosures, is_own: bool) -> Judges:
    """Compare each closure with its nearest others, and with odometry where both keyframes are one robot's."""
    count = len(closures.ids)
    at = np.stack([closures.i, closures.j], axis=1)
    partners = own = np.arange(count)[:, None]
    if count > 1:
        partners = cKDTree(at).query(at, k=np.arange(2, min(PARTNERS + 1, count) + 1), p=1)[1]
    k, m = np.repeat(np.arange(count), partners.shape[1]), partners.ravel()
    by_partners = compared(closures, k, *said_by(a, b, closures, k, m))
    by_odometry = compared(closures, own[:, 0], *said_by_odometry(a, closures)) if is_own else None
    return Judges(closures, partners, by_partners.shaped(partners.shape), by_odometry)


def said_by(a: Way, b: Way, c: PairClosures, k: Int, m: Int) -> tuple[Float, Float, Float, Ray]:
    """What closures m say of the keyframes of closures k: pose, both variances, and m's free length."""
    T_a_match = a.T[c.i[m]] @ c.T[m]
    T_a_j = T_a_match @ inverse(b.T[c.j[m]]) @ b.T[c.j[k]]
    x = T_a_j[:, :3, 3]
    of_a, swung_a = a.variances(c.i[k], c.i[m], x)
    of_b, moved_b = b.variances(c.j[m], c.j[k], b.T[c.j[k], :3, 3])
    swung_m = c.rotation[m] * np.sum((x - T_a_match[:, :3, 3]) ** 2, axis=1)
    T_k_a = inverse(a.T[c.i[k]])
    u = np.einsum("kij,kj->ki", (T_k_a @ a.T[c.i[m]])[:, :3, :3], c.u[m])
    along = Ray(u, c.length_sigma_m[m], c.shorter_max_m[m])
    return T_k_a @ T_a_j, of_a + of_b + c.rotation[m], swung_a + moved_b + swung_m + c.translation[m], along


def said_by_odometry(a: Way, c: PairClosures) -> tuple[Float, Float, Float, Ray]:
    """The same of a robot's own odometry."""
    rotation, translation = a.variances(c.i, c.j, a.T[c.j, :3, 3])
    return (
        inverse(a.T[c.i]) @ a.T[c.j],
        rotation,
        translation,
        Ray(np.zeros((len(c.i), 3)), np.zeros(len(c.i)), np.zeros(len(c.i))),
    )


def compared(c: PairClosures, k: Int, T: Float, rotation: Float, translation: Float, along: Ray) -> Compared:
    """Compare closures k with poses (K, 4, 4) that something else gives their keyframes.

    Free scales of both take the values that fit best, above their least ones.
    """
    variance_rad, variance_m = rotation + c.rotation[k], translation + c.translation[k]
    cosine = 0.5 * (np.einsum("kij,kij->k", c.T[k][:, :3, :3], T[:, :3, :3]) - 1.0)
    apart_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
    off = T[:, :3, 3] - c.T[k][:, :3, 3]
    own = Ray(-c.u[k], c.length_sigma_m[k], c.shorter_max_m[k])
    free, bounded = fitted(off, variance_m, own, along)
    off = off + bounded[:, :1] * own.u + bounded[:, 1:] * along.u
    turned = apart_rad**2 / variance_rad
    return Compared(
        squared=squared_at(bounded, T[:, :3, 3] - c.T[k][:, :3, 3], variance_m, own, along) + turned,
        falls=np.any(free < bounded, axis=1),
        apart_m=np.linalg.norm(off, axis=1),
        apart_rad=apart_rad,
        allowed_m=np.sqrt(variance_m),
        allowed_rad=np.sqrt(variance_rad),
    )


def squared_at(x: Float, off: Float, variance_m: Float, a: Ray, b: Ray) -> Float:
    """Squared difference (K,) of translations, for lengths that differ by x (K, 2) from the measured ones."""
    left = off + x[:, :1] * a.u + x[:, 1:] * b.u
    priors = (x[:, 0] / np.maximum(a.sigma_m, FIXED_M)) ** 2 + (x[:, 1] / np.maximum(b.sigma_m, FIXED_M)) ** 2
    return np.asarray(np.einsum("ki,ki->k", left, left) / variance_m + priors)


def fitted(off: Float, variance_m: Float, a: Ray, b: Ray) -> tuple[Float, Float]:
    """Changes of two lengths (K, 2) that bring translations together best: any, and those that leave them positive."""
    weights = 1.0 / variance_m
    A = np.empty((len(off), 2, 2))
    A[:, 0, 0] = weights * np.einsum("ki,ki->k", a.u, a.u) + 1.0 / np.maximum(a.sigma_m, FIXED_M) ** 2
    A[:, 1, 1] = weights * np.einsum("ki,ki->k", b.u, b.u) + 1.0 / np.maximum(b.sigma_m, FIXED_M) ** 2
    A[:, 0, 1] = A[:, 1, 0] = weights * np.einsum("ki,ki->k", a.u, b.u)
    g = -weights[:, None] * np.stack([np.einsum("ki,ki->k", ray.u, off) for ray in (a, b)], axis=1)
    free = np.linalg.solve(A, g[:, :, None])[:, :, 0]
    least = -np.stack([a.shorter_max_m, b.shorter_max_m], axis=1)
    a_least = np.stack([least[:, 0], (g[:, 1] - A[:, 1, 0] * least[:, 0]) / A[:, 1, 1]], axis=1)
    b_least = np.stack([(g[:, 0] - A[:, 0, 1] * least[:, 1]) / A[:, 0, 0], least[:, 1]], axis=1)
    tried = np.stack([np.maximum(x, least) for x in (a_least, b_least)])
    costs = np.stack([squared_at(x, off, variance_m, a, b) for x in tried])
    held = np.take_along_axis(tried, np.argmin(costs, axis=0)[None, :, None], axis=0)[0]
    return free, np.where(np.all(free >= least, axis=1)[:, None], free, held)


def excess_of(judges: list[Judges]) -> float:
    """How many times larger squared differences are than stated uncertainties explain; at least 1.

    From the quarter of each closure's partners that it agrees with best: of a right closure those are right, too.
    """
    quarter = [np.quantile(of_pair.with_partners.squared, 0.25, axis=1) for of_pair in judges if of_pair.size > 1]
    if not quarter:
        return 1.0
    return float(np.clip(np.median(np.concatenate(quarter)) / QUARTER_OF_SIX, 1.0, EXCESS_MAX))


def alarms(judges: Judges, bound: float, excess: float) -> dict[int, str]:
    """Reasons for holding closures of one pair of robots, by place.

    Partners vote with their certainty; against a closure only those with more agreement of their own.
    """
    count, by = judges.size, judges.with_partners
    others = judges.partners != np.arange(count)[:, None]
    agree = others & (by.squared <= bound)
    agreement = np.minimum(agree.sum(axis=1) / np.maximum(others.sum(axis=1) - 1, 1), 1.0)
    against = others & ~agree & (agreement[judges.partners] > agreement[:, None])
    certainty = 1.0 / by.allowed_m**2
    outvoted = np.sum(certainty * against, axis=1) > np.sum(certainty * agree, axis=1)
    reasons = {}
    for n in np.flatnonzero(outvoted).tolist():
        p = int(np.argmax(certainty[n] * against[n]))
        reasons[n] = _reason(by.at((n, p)), bool(by.falls[n, p]), excess, "closures around it")
    if judges.with_odometry is not None:
        own, alone = judges.with_odometry, ~np.any(agree, axis=1)
        for n in np.flatnonzero(alone & (own.squared > bound)).tolist():
            reasons[n] = _reason(own.at(n), bool(own.falls[n]), excess, "odometry's uncertainties")
    return reasons


def _reason(by: Compared, falls: bool, excess: float, what: str) -> str:
    """One of: the scale, the turn, the way."""
    widened = 3.0 * float(np.sqrt(excess))
    turn, way = float(by.apart_rad), float(by.apart_m)
    turn_allowed, way_allowed = widened * float(by.allowed_rad), widened * float(by.allowed_m)
    if falls and turn <= turn_allowed:
        return f"with {what} its scale would collapse"
    if turn / turn_allowed > way / way_allowed:
        allowed_deg = float(np.degrees(turn_allowed))
        return f"it would turn the robots by {np.degrees(turn):.0f} degrees where {what} allow {allowed_deg:.0f}"
    return f"it would move the robots by {way:.1f} m where {what} allow {way_allowed:.1f} m"
