"""Relative pose of two images whose cameras know which way is up: four unknowns, so three correspondences are enough.

With the rays turned until up is the z axis in both images, the other camera sees the query turned about z only:
`R_other_query = A_other^T R_z(angle) A_query`. Three correspondences vanish in the epipolar constraint where the
determinant of three rows does, a trigonometric polynomial of degree three in the angle (Fraundorfer, Tanskanen and
Pollefeys 2010). Of the same share of right matches, three are far more often all right than five are.

The attitude is odometry's, and uncertain: what is found here is refined in all degrees of freedom, and verified like
any other pose.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import pose

Float = NDArray[np.float64]

SAMPLES = 300
"""Triples that are tried: one of right matches only among 20 % right ones with 91 %, among 30 % with more than 99 %."""
GRID = 72
"""Steps of the angle at which signs change; two solutions within 5 degrees are one."""
HARMONICS = 3
NEWTON_STEPS = 3
HYPOTHESES_MAX = 1000
SCORED_MAX = 400
"""Correspondences that hypotheses are scored with; more are some of them."""
GENERATOR_STATE = 20_260_102
DISTINCT_RAD = 0.05
FLAT_MIN = 1e-9


def upright_poses(points: Float, observed: Float, ups: tuple[Float, Float], width: float, most: int) -> list[Float]:
    """The poses that most correspondences agree with, best first, different from each other.

    Args:
        points: (N, 2) x/z and y/z in the query.
        observed: (N, 2) the same points in the other image.
        ups: (3,) directions against gravity in the query's camera and in the other's.
        width: Distance from the epipolar line at which a correspondence has half its weight, in x/z.
        most: Poses at most.

    Returns:
        `T_other_query`, each with a translation of length one; none of fewer than three correspondences.
    """
    if len(points) < 3:
        return []
    A_query, A_other = levelled(ups[0]), levelled(ups[1])
    query, other = _rays(points) @ A_query.T, _rays(observed) @ A_other.T
    angles, directions = _hypotheses(query, other)
    if len(angles) == 0:
        return []
    chosen = np.linspace(0, len(points) - 1, min(len(points), SCORED_MAX)).astype(np.intp)
    query, other = query[chosen], other[chosen]
    weights = _weights(query, other, angles, directions, width)
    best = _distinct(np.argsort(-weights.sum(axis=1)), angles, directions, most)
    poses = []
    for k in best:
        R = _about_z(angles[k])
        t = _facing(query, other, R, directions[k], weights[k])
        poses.append(pose(A_other.T @ R @ A_query, A_other.T @ t))
    return poses


def levelled(up: Float) -> Float:
    """A rotation (3, 3) that turns a direction of length one into the z axis, by the shortest way."""
    x, y, z = up
    if z < -1.0 + FLAT_MIN:
        return np.diag([1.0, -1.0, -1.0])
    k = 1.0 / (1.0 + z)
    return np.array([[1.0 - k * x * x, -k * x * y, -x], [-k * x * y, 1.0 - k * y * y, -y], [x, y, z]])


def _hypotheses(query: Float, other: Float) -> tuple[Float, Float]:
    """Angles (H,) about up and directions (H, 3) of translation of drawn triples, in levelled frames."""
    rng = np.random.default_rng(GENERATOR_STATE)
    triples = rng.integers(0, len(query), (SAMPLES, 3))
    rows = _constant_cosine_sine(query[triples], other[triples])
    at_rad = 2.0 * np.pi * np.arange(2 * HARMONICS + 1) / (2 * HARMONICS + 1)
    determinants = np.linalg.det(_at(rows[:, None], at_rad[None]))
    which, angles = _roots(np.fft.rfft(determinants, axis=1) / len(at_rad))
    which, angles = which[:HYPOTHESES_MAX], angles[:HYPOTHESES_MAX]
    M = _at(rows[which], angles)
    crosses = np.stack([np.cross(M[:, 0], M[:, 1]), np.cross(M[:, 1], M[:, 2]), np.cross(M[:, 2], M[:, 0])], axis=1)
    lengths = np.linalg.norm(crosses, axis=2)
    longest = lengths.argmax(axis=1)
    each = np.arange(len(which))
    usable = lengths[each, longest] > FLAT_MIN
    directions = crosses[each, longest] / np.maximum(lengths[each, longest], FLAT_MIN)[:, None]
    return angles[usable], directions[usable]


def _constant_cosine_sine(query: Float, other: Float) -> Float:
    """Parts (..., 3, N, 3) of `R_z(angle) q x m`: without the angle, with its cosine, with its sine."""
    q_z = query * [0.0, 0.0, 1.0]
    q_cos = query * [1.0, 1.0, 0.0]
    q_sin = np.stack([-query[..., 1], query[..., 0], np.zeros(query.shape[:-1])], axis=-1)
    return np.stack([np.cross(part, other) for part in (q_z, q_cos, q_sin)], axis=-3)


def _at(rows: Float, angles: Float) -> Float:
    """Rows (..., N, 3) at angles (...)."""
    c, s = np.cos(angles)[..., None, None], np.sin(angles)[..., None, None]
    return np.asarray(rows[..., 0, :, :] + c * rows[..., 1, :, :] + s * rows[..., 2, :, :])


def _roots(coefficients: NDArray[np.complex128]) -> tuple[NDArray[np.intp], Float]:
    """Zeros of trigonometric polynomials (M, 4): which polynomial (H,), and the angle (H,)."""
    grid_rad = 2.0 * np.pi * np.arange(GRID) / GRID
    orders = np.arange(HARMONICS + 1)
    weights = np.where(orders == 0, 1.0, 2.0)
    values = ((coefficients * weights) @ np.exp(1j * np.outer(orders, grid_rad))).real
    which, steps = np.nonzero(np.sign(values) != np.sign(np.roll(values, -1, axis=1)))
    before, after = values[which, steps], values[which, (steps + 1) % GRID]
    share = np.clip(before / np.where(before == after, 1.0, before - after), 0.0, 1.0)
    angles = grid_rad[steps] + share * (2.0 * np.pi / GRID)
    chosen = coefficients[which] * weights
    for _ in range(NEWTON_STEPS):
        phases = np.exp(1j * np.outer(angles, orders))
        value, slope = (chosen * phases).real.sum(axis=1), (chosen * phases * 1j * orders).real.sum(axis=1)
        step = value / np.where(np.abs(slope) < FLAT_MIN, np.inf, slope)
        angles = angles - np.clip(step, -np.pi / GRID, np.pi / GRID)
    return which, angles


def _weights(query: Float, other: Float, angles: Float, directions: Float, width: float) -> Float:
    """How well each hypothesis explains each correspondence (H, N), 1 to 0: by its distance from the epipolar plane."""
    E = np.cross(directions[:, :, None], _about_z(angles), axis=1)
    planes = (E.reshape(-1, 3) @ query.T).reshape(-1, 3, len(query))
    back = (np.swapaxes(E, 1, 2).reshape(-1, 3) @ other.T).reshape(-1, 3, len(other))
    products = (planes * other.T).sum(axis=1) ** 2
    spread = (planes * planes).sum(axis=1) - products / (other * other).sum(axis=1)
    spread += (back * back).sum(axis=1) - products / (query * query).sum(axis=1)
    errors = products / np.maximum(spread, 1e-18) / width**2
    return np.asarray(1.0 / (1.0 + errors * errors))


def _distinct(order: Sequence[int] | NDArray[np.intp], angles: Float, directions: Float, most: int) -> list[int]:
    """The first hypotheses of an order that differ from those before."""
    found: list[int] = []
    for k in order:
        turns = np.abs((angles[found] - angles[k] + np.pi) % (2.0 * np.pi) - np.pi)
        apart = np.arccos(np.clip(np.abs(directions[found] @ directions[k]), 0.0, 1.0))
        if not np.any((turns < DISTINCT_RAD) & (apart < DISTINCT_RAD)):
            found.append(int(k))
        if len(found) == most:
            break
    return found


def _facing(query: Float, other: Float, R: Float, direction: Float, weights: Float) -> Float:
    """The direction of translation with the sign that puts more of the explained points in front of both cameras."""
    turned = query @ R.T
    depths_other = (np.cross(direction, turned) * np.cross(other, turned)).sum(axis=1)
    depths_query = (np.cross(direction, other) * np.cross(other, turned)).sum(axis=1)
    votes = (np.sign(depths_other) + np.sign(depths_query)) @ weights
    return direction if votes >= 0.0 else -direction


def _about_z(angles_rad: Float) -> Float:
    """Rotations (..., 3, 3) about the z axis."""
    c, s = np.cos(angles_rad), np.sin(angles_rad)
    zero, one = np.zeros_like(c), np.ones_like(c)
    return np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(*np.shape(angles_rad), 3, 3)


def _rays(points: Float) -> Float:
    return np.column_stack([points, np.ones(len(points))])
