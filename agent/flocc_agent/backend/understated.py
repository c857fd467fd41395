"""Covariances that are orders of magnitude too small: noticed before the solve, made larger, and said.

Where zeros were replaced by 1e-9, every closure contradicts every other and odometry, and a robust solver lets all of
them go: what is left is chance. So closures of two robots that are next to each other are compared, each with the
others around it; the one that agrees best is right where a fifth of the closures are, and even that differs by many
standard deviations where these are too small, in rotation, in translation or in both. Factors that alarms believe
anyway (`alarms.EXCESS_MAX`) are left to them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flocc_agent.backend.alarms import EXCESS_MAX, PARTNERS, PLANAR_RAD, compared, said_by
from flocc_agent.backend.pair_closures import PairClosures, Way, by_logs, measured
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

CLOSURES_MIN = 20
"""Fewer closures say nothing of their noise."""
BEST_QUANTILE = 0.2
EXPECTED_IN_SPACE, EXPECTED_IN_PLANE = 0.25, 0.02
"""Squared difference from the best of eight others, over its variance, at that quantile: where most are right."""
TURN_MAX_RAD, WAY_MAX_M = 0.1, 1.0
"""Noise that is larger than this is none: such closures are wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class Widened:
    """Measurements with covariances that explain how far closures are apart, and the sentence that says so."""

    trajectories: dict[LogId, Trajectory]
    closures: dict[int, LoopClosure]
    warnings: tuple[str, ...]


def widened(
    trajectories: Mapping[LogId, Trajectory], closures: Mapping[int, LoopClosure], config: BackendConfig
) -> Widened:
    """Make measured covariances larger where closures say that they are far too small; configured ones stay."""
    as_told = Widened(dict(trajectories), dict(closures), ())
    given = any(t.edge_covariances is not None for t in trajectories.values())
    if len(closures) < CLOSURES_MIN or not (given or any(c.covariance is not None for c in closures.values())):
        return as_told
    in_rotation, in_translation = _differences(as_told, config)
    turn, way = _factor(in_rotation, TURN_MAX_RAD), _factor(in_translation, WAY_MAX_M)
    if max(turn, way) == 1.0:
        return as_told
    if way > 1.0:
        way = max(way, turn)  # free lengths hide most of what translations are off by
    said = [f"{np.sqrt(f):.0f} times in {what}" for f, what in ((turn, "rotation"), (way, "translation")) if f > 1.0]
    sentence = (
        f"stated standard deviations are too small ({' and '.join(said)}) for how far neighbouring closures are apart; "
        "all measured covariances were made larger by as much"
    )
    return replace(_larger(as_told, turn, way), warnings=(sentence,))


def _larger(told: Widened, turn: float, way: float) -> Widened:
    """The same with variances of rotation and of translation multiplied."""
    D = np.repeat(np.sqrt([turn, way]), 3)
    larger = D * D[:, None]
    trajectories, closures = dict(told.trajectories), dict(told.closures)
    for log, t in trajectories.items():
        if t.edge_covariances is not None:
            trajectories[log] = replace(t, edge_covariances=np.asarray(t.edge_covariances) * larger)
    for k, c in closures.items():
        if c.covariance is not None:
            closures[k] = replace(c, covariance=np.asarray(c.covariance) * larger)
    return Widened(trajectories, closures, told.warnings)


@dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """How far closures (K,) are from the best of those around them: over its variance, and as it is; in a plane?"""

    squared: Float
    apart: Float
    is_planar: bool


def _differences(told: Widened, config: BackendConfig) -> tuple[Difference, Difference]:
    """Differences in rotation and in translation."""
    ways = {log: Way.of(trajectory, config, length_sigma=0.0) for log, trajectory in told.trajectories.items()}
    turns, moves, tilt = [], [], 0.0
    for (a, b), ids in by_logs(told.closures).items():
        if len(ids) > PARTNERS:
            c = measured(ids, told.closures, config)
            turn, move = _from_best(ways[a], ways[b], c)
            turns.append(turn)
            moves.append(move)
            tilt = max(tilt, float(np.abs(c.T[:, 2, :2]).max()))
    if not turns:
        return (Difference(np.zeros(0), np.zeros(0), False),) * 2
    planar = tilt < PLANAR_RAD
    rotation, translation = (np.concatenate(found, axis=1) for found in (turns, moves))
    return Difference(rotation[0], rotation[1], planar), Difference(translation[0], translation[1], planar)


def _from_best(a: Way, b: Way, c: PairClosures) -> tuple[Float, Float]:
    """Squared difference over its variance, and the difference, (2, K) of rotation and of translation."""
    at = np.stack([c.i, c.j], axis=1)
    partners = cKDTree(at).query(at, k=np.arange(2, PARTNERS + 2), p=1)[1]
    k = np.repeat(np.arange(len(at)), PARTNERS)
    by = compared(c, k, *said_by(a, b, c, k, partners.ravel())).shaped(partners.shape)
    turned, moved = (by.apart_rad / by.allowed_rad) ** 2, (by.apart_m / by.allowed_m) ** 2
    rows = np.arange(len(at))
    turn, move = turned.argmin(axis=1), moved.argmin(axis=1)
    return (
        np.stack([turned[rows, turn], by.apart_rad[rows, turn]]),
        np.stack([moved[rows, move], by.apart_m[rows, move]]),
    )


def _factor(found: Difference, apart_max: float) -> float:
    """What variances must be multiplied by; 1 where they are not far off, or closures have nothing in common."""
    if len(found.squared) < CLOSURES_MIN:
        return 1.0
    squared, apart = (float(np.quantile(values, BEST_QUANTILE)) for values in (found.squared, found.apart))
    if squared <= EXCESS_MAX or apart > apart_max:
        return 1.0
    return squared / (EXPECTED_IN_PLANE if found.is_planar else EXPECTED_IN_SPACE)
