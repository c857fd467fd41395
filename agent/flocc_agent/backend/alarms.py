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

from flocc_agent.backend.pair_closures import LENGTH_MIN_M, PairClosures, Way, by_logs, measured
from flocc_agent.backend.problem import without_unit
from flocc_agent.backend.relayed import relayed
from flocc_agent.backend.together import (
    AGREEING_MIN,
    Predictions,
    along,
    side_by_side,
    together,
    with_length,
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
HALVES_IN_SPACE, HALVES_IN_PLANE = (2.366, 2.366), (0.455, 1.386)
"""Half of a squared difference lies below these, of rotation and of translation: chi-square of 3 and 3, or 1 and 2."""
PLANAR_RAD = 1e-6
"""Robots none of whose closures tilts more have noise in the plane only."""
AGREEING_PARTNERS_MIN, NO_MISTAKE_RATIO = 2, 0.5
"""A closure with which so many others agree, and this part of those that speak against it, is not held for them."""
FIXED_M = 1e-6
LENGTH_ROUNDS = 3


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

    def turned_sigmas(self) -> Float:
        """The difference in rotation over its standard deviation."""
        return self.apart_rad / self.allowed_rad

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
        with_all: (K,) how they compare with what the others, odometry and ways by third robots say together.
        collapse: (K,) by how much that is worse because a length may not become shorter.
        counts: (K,) whether those agree among themselves.
    """

    closures: PairClosures
    partners: Int
    with_partners: Compared
    with_odometry: Compared | None
    with_all: Compared
    collapse: Float
    counts: Bool

    @property
    def size(self) -> int:
        """Number of the closures."""
        return len(self.closures.ids)


def held_closures(
    trajectories: Mapping[LogId, Trajectory], closures: Mapping[int, LoopClosure], config: BackendConfig
) -> dict[int, str]:
    """Reasons why closures are held, by number; none where measurements are to be taken as they are given.

    Only closures from images are: others are fixes, tags, or of an opened map.
    """
    if config.formulation is Formulation.BASE or config.solver not in (Solver.GNC_TLS, Solver.GNC_GM):
        return {}
    doubted = {k: f"closure {c.query} - {c.match}: {c.doubt}" for k, c in closures.items() if c.doubt}
    closures = {k: c for k, c in closures.items() if k not in doubted}
    ways = {log: Way.of(trajectory, config) for log, trajectory in trajectories.items()}
    of_pairs = measured_by_pair(ways, {k: c for k, c in closures.items() if c.from_images}, config)
    bound, bound_of_one = (float(chdtri(freedom, 1.0 - config.inlier_probability)) for freedom in (6.0, 1.0))
    judges = [judges_of(pair, ways, of_pairs, bound) for pair in of_pairs]
    excess, of_all = excess_of(judges), excess_with_all(judges)
    bounds_of_all = of_all * bound, of_all * bound_of_one
    held: dict[int, str] = {}
    for of_pair in judges:
        for n, reason in alarms(of_pair, excess * bound, bounds_of_all, excess).items():
            k = int(of_pair.closures.ids[n])
            named = f"closure {closures[k].query} - {closures[k].match}"
            held[k] = f"{named}: held until another one agrees with it, because {reason}"
    return held | doubted


def measured_by_pair(
    ways: Mapping[LogId, Way], closures: Mapping[int, LoopClosure], config: BackendConfig
) -> dict[tuple[LogId, LogId], PairClosures]:
    """Closures of each pair of robots, those without a unit as long as they fit their neighbours."""
    pairs = by_logs(closures)
    return {pair: with_fitted_lengths(pair, ways, measured(ids, closures, config)) for pair, ids in pairs.items()}


def fitted_lengths(
    trajectories: Mapping[LogId, Trajectory], closures: Mapping[int, LoopClosure], config: BackendConfig
) -> dict[int, float]:
    """How long the closures without a unit are, by number: for their neighbours, in the median of two robots."""
    unknown = without_unit(list(closures.values()), config).tolist()
    free = {k: closure for (k, closure), on in zip(closures.items(), unknown, strict=True) if on}
    ways = {log: Way.of(trajectory, config) for log, trajectory in trajectories.items()} if free else {}
    of_pairs = measured_by_pair(ways, free, config)
    return {k: float(np.median(c.length_m)) for c in of_pairs.values() for k in c.ids.tolist()}


def judges_of(
    pair: tuple[LogId, LogId],
    ways: Mapping[LogId, Way],
    of_pairs: Mapping[tuple[LogId, LogId], PairClosures],
    bound: float,
) -> Judges:
    """Compare each closure with its nearest others, and with odometry where both keyframes are one robot's."""
    a, b, closures = ways[pair[0]], ways[pair[1]], of_pairs[pair]
    count = len(closures.ids)
    partners, own = partners_of(closures), np.arange(count)[:, None]
    k, m = np.repeat(np.arange(count), partners.shape[1]), partners.ravel()
    said = said_by(a, b, closures, k, m)
    by_partners = compared(closures, k, *said).shaped(partners.shape)
    said_by_all = [predictions(*said, partners.shape, partners != own)]
    by_odometry = None
    if pair[0] == pair[1]:
        said = said_by_odometry(a, closures)
        by_odometry = compared(closures, own[:, 0], *said)
        said_by_all.append(predictions(*said, (count, 1), np.ones((count, 1), dtype=bool)))
    elif count <= AGREEING_MIN:
        said_by_all.append(relayed(pair, ways, of_pairs))
    return Judges(
        closures, partners, by_partners, by_odometry, *compared_with_all(closures, side_by_side(said_by_all), bound)
    )


def partners_of(c: PairClosures) -> Int:
    """Places (K, P) of the closures whose keyframes are nearest on both sides; its own where it is alone."""
    count = len(c.ids)
    if count < 2:
        return np.arange(count)[:, None]
    at = np.stack([c.i, c.j], axis=1)
    return np.asarray(cKDTree(at).query(at, k=np.arange(2, min(PARTNERS + 1, count) + 1), p=1)[1])


def with_fitted_lengths(pair: tuple[LogId, LogId], ways: Mapping[LogId, Way], c: PairClosures) -> PairClosures:
    """Closures of one pair, those without a unit as long as they fit their partners best, in the median."""
    if len(c.ids) < 2 or not np.any(c.by_length):
        return c
    partners = partners_of(c)
    k, m = np.repeat(np.arange(len(c.ids)), partners.shape[1]), partners.ravel()
    for _ in range(LENGTH_ROUNDS):
        T, _, translation, along = said_by(ways[pair[0]], ways[pair[1]], c, k, m)
        off = T[:, :3, 3] - c.T[k][:, :3, 3]
        own = Ray(-c.u[k], c.length_sigma_m[k], c.shorter_max_m[k])
        _, change = fitted(off, translation + c.translation[k], own, along)
        middle = np.median(change[:, 0].reshape(partners.shape), axis=1)
        c = c.with_lengths(np.maximum(c.length_m + middle, LENGTH_MIN_M))
    return c


def predictions(
    T: Float, rotation: Float, translation: Float, free: Ray, shape: tuple[int, ...], there: Bool
) -> Predictions:
    """What closures or odometry say, one after the other, as predictions (K, P)."""
    covariance = translation[:, None, None] * np.eye(3) + along(free.u, free.sigma_m)
    return Predictions(
        T[:, :3, :3].reshape(*shape, 3, 3),
        T[:, :3, 3].reshape(*shape, 3),
        rotation.reshape(shape),
        covariance.reshape(*shape, 3, 3),
        translation.reshape(shape),
        there,
    )


def compared_with_all(c: PairClosures, said: Predictions, bound: float) -> tuple[Compared, Float, Bool]:
    """Compare closures with what predictions say together; what it costs to hold lengths; whether those count."""
    all_ = together(said, bound)
    variance_rad = all_.rotation + c.rotation
    cosine = 0.5 * (np.einsum("kij,kij->k", c.T[:, :3, :3], all_.R) - 1.0)
    apart_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
    off = all_.t - c.T[:, :3, 3]
    covariance = all_.covariance + c.translation[:, None, None] * np.eye(3)
    squared, collapse, change = with_length(off, covariance, c.u, c.length_sigma_m, c.shorter_max_m)
    if np.any(c.by_length):
        covariance = all_.covariance + c.translation_at(change)[:, None, None] * np.eye(3)
        squared, collapse, change = with_length(off, covariance, c.u, c.length_sigma_m, c.shorter_max_m)
    left = off - change[:, None] * c.u
    by_all = Compared(
        squared=squared + apart_rad**2 / variance_rad,
        falls=collapse > 0.0,
        apart_m=np.linalg.norm(left, axis=1),
        apart_rad=apart_rad,
        allowed_m=np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0),
        allowed_rad=np.sqrt(variance_rad),
    )
    return by_all, collapse, all_.counts


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
    if np.any(c.by_length):
        variance_m = translation + c.translation_at(bounded[:, 0], k)
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


def excess_with_all(judges: list[Judges]) -> float:
    """The same of what closures say together: from the half that fits best, in rotation or in translation."""
    counted = [of_pair for of_pair in judges if np.any(of_pair.counts)]
    if not counted:
        return 1.0
    squared = np.concatenate([of_pair.with_all.squared[of_pair.counts] for of_pair in counted])
    turned = np.concatenate([(of_pair.with_all.turned_sigmas() ** 2)[of_pair.counts] for of_pair in counted])
    tilt = max(float(np.abs(of_pair.closures.T[:, 2, :2]).max()) for of_pair in counted)
    rotation, translation = HALVES_IN_PLANE if tilt < PLANAR_RAD else HALVES_IN_SPACE
    worse = max(float(np.median(turned)) / rotation, float(np.median(squared - turned)) / translation)
    return float(np.clip(worse, 1.0, EXCESS_MAX))


def alarms(judges: Judges, bound: float, bounds_of_all: tuple[float, float], excess: float) -> dict[int, str]:
    """Reasons for holding closures of one pair of robots, by place.

    Partners vote with their certainty; against a closure only those with more agreement of their own. Where half as
    many agree it is no single mistake: the solver decides, and says so. The bounds of what all say together are those
    of the whole difference, and of a length that would have to collapse; that begins with the surest, which may be
    wrong, so that it holds none with which several agree that together are surer than those that do not.
    """
    count, by = judges.size, judges.with_partners
    others = judges.partners != np.arange(count)[:, None]
    agree = others & (by.squared <= bound)
    agreement = np.minimum(agree.sum(axis=1) / np.maximum(others.sum(axis=1) - 1, 1), 1.0)
    against = others & ~agree & (agreement[judges.partners] > agreement[:, None])
    certainty = 1.0 / by.allowed_m**2
    outvoted = np.sum(certainty * against, axis=1) > np.sum(certainty * agree, axis=1)
    agreeing = agree.sum(axis=1)
    outvoted &= (agreeing < AGREEING_PARTNERS_MIN) | (agreeing < NO_MISTAKE_RATIO * against.sum(axis=1))
    reasons = {}
    for n in np.flatnonzero(outvoted).tolist():
        p = int(np.argmax(certainty[n] * against[n]))
        reasons[n] = _reason(by.at((n, p)), bool(by.falls[n, p]), excess, "closures around it")
    all_ = judges.with_all
    disagrees = (all_.squared > bounds_of_all[0]) | (judges.collapse > bounds_of_all[1])
    supported = np.sum(certainty * agree, axis=1) > np.sum(certainty * (others & ~agree), axis=1)
    supported &= agreeing >= AGREEING_MIN
    for n in np.flatnonzero(judges.counts & disagrees & ~supported).tolist():
        reasons.setdefault(n, _reason(all_.at(n), bool(all_.falls[n]), excess, "the closures around it"))
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
