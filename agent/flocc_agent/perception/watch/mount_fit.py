"""Turns and directions of motion, in pictures and by odometry: how well they agree, and up to which constant turn.

With the right camera the picture's turn `w` and direction `d` of every pair are odometry's, both turned by the error of
the mounting: `w_seen = X^T w_odom`, `d_seen = X^T d_odom`. Disagreement is a robust cost: what one blurred picture or
one slip of a wheel says counts little.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import nearest_rotation, so3_log
from flocc_agent.perception.watch.seen_motion import SeenMotion

Float = NDArray[np.float64]

TURN_SIGMA_RAD = float(np.radians(0.4))
TURN_SIGMA_RATIO = 0.03
"""Odometry's and the picture's own errors of a turn: a floor, and a share of the turn."""
DIRECTION_SIGMA_RAD = float(np.radians(1.5))
POSITION_SIGMA_M = 0.015
"""What odometry's positions, and the camera's place on the body, are wrong by from one keyframe to the next."""
MOVED_MIN_M = 0.02
"""A shorter motion has no direction that odometry knows."""
ROUNDS = 10
PARTS = 4
"""Quarters of the pairs that each give a turn to start from: not all hold the pairs that are wrong."""
COST_UNSEEN = 30.0
"""Of a pair without a motion: as bad as a wrong one."""
COUNTED_SHARE = 0.8
"""Of the pairs those that agree best; the others may be wrong for any reason."""


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """All pairs' vectors, one row each.

    Attributes:
        is_seen: (N,) whether pictures gave a motion; elsewhere what was seen is zero.
        turn_seen: (N, 3) rotation vectors, rad.
        turn_odom: (N, 3) of odometry.
        direction_seen: (N, 3) of length one; zero where not known.
        direction_odom: (N, 3) of length one; zero where not known.
        direction_sigma_rad: (N,) how well both can be known to agree.
    """

    is_seen: NDArray[np.bool_]
    turn_seen: Float
    turn_odom: Float
    direction_seen: Float
    direction_odom: Float
    direction_sigma_rad: Float

    @property
    def has_direction(self) -> NDArray[np.bool_]:
        """(N,) whether both directions of a pair are known."""
        return np.asarray(np.any(self.direction_seen != 0, axis=1) & np.any(self.direction_odom != 0, axis=1))


def motions_of(seen: Sequence[SeenMotion | None], T_before_now: Sequence[Float]) -> Motions:
    """Seen motions with odometry's: `T_before_now` are (4, 4), metres."""
    zero = np.zeros(3)
    moved = np.array([T[:3, 3] for T in T_before_now]).reshape(-1, 3)
    lengths_m = np.linalg.norm(moved, axis=1)
    known = np.where(lengths_m > MOVED_MIN_M, 1.0, 0.0) / np.maximum(lengths_m, MOVED_MIN_M)
    directions = [zero if motion is None or motion.direction is None else motion.direction for motion in seen]
    return Motions(
        np.array([motion is not None for motion in seen], np.bool_),
        np.array([zero if motion is None else motion.turn_rad for motion in seen]).reshape(-1, 3),
        np.array([so3_log(T[:3, :3]) for T in T_before_now]).reshape(-1, 3),
        np.array(directions).reshape(-1, 3),
        moved * known[:, None],
        np.hypot(DIRECTION_SIGMA_RAD, POSITION_SIGMA_M / np.maximum(lengths_m, MOVED_MIN_M)),
    )


def disagreement(motions: Motions, X: Float) -> float:
    """How much pictures and odometry disagree under a mounting error X (3, 3): below one where all is right."""
    return trimmed(costs(motions, X))


def trimmed(values: Float) -> float:
    """The mean of the lower ones."""
    count = max(int(np.ceil(COUNTED_SHARE * len(values))), 1)
    return float(np.mean(np.sort(values)[:count])) if len(values) else float("inf")


def costs(motions: Motions, X: Float) -> Float:
    """(N,) robust disagreement of each pair under a mounting error."""
    return turn_costs(motions, X) + direction_costs(motions, X)


def turn_costs(motions: Motions, X: Float) -> Float:
    """(N,) that of the turns alone."""
    error = np.linalg.norm(motions.turn_seen - motions.turn_odom @ X, axis=1) / _turn_sigma_rad(motions)
    return np.where(motions.is_seen, _robust(error), COST_UNSEEN)


def direction_costs(motions: Motions, X: Float) -> Float:
    """(N,) that of the directions alone; 0 where one is not known."""
    error = direction_angles_rad(motions, X) / motions.direction_sigma_rad
    return _robust(np.where(motions.has_direction, error, 0.0))


def direction_angles_rad(motions: Motions, X: Float) -> Float:
    """(N,) between the directions of motion under a mounting error; meaningless where one is not known."""
    cosine = (motions.direction_seen * (motions.direction_odom @ X)).sum(axis=1)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def constant_turn(motions: Motions) -> Float:
    """The turn X (3, 3) under which pictures and odometry disagree least."""
    refined = [_refined(motions, X) for X in (np.eye(3), *_starts(motions))]
    return min(refined, key=lambda X: disagreement(motions, X))


def _robust(error: Float) -> Float:
    return np.asarray(4.0 * np.log1p((error / 2.0) ** 2))


def _turn_sigma_rad(motions: Motions) -> Float:
    return np.asarray(np.hypot(TURN_SIGMA_RAD, TURN_SIGMA_RATIO * np.linalg.norm(motions.turn_odom, axis=1)))


def _starts(motions: Motions) -> list[Float]:
    """Turns that all vectors, or those of a part of the pairs, ask for."""
    parts = [np.arange(len(motions.turn_seen)) % PARTS == k for k in range(PARTS)]
    return [_wahba(motions, np.asarray(part, np.float64)) for part in (np.ones(len(motions.turn_seen)), *parts)]


def _refined(motions: Motions, X: Float) -> Float:
    for _ in range(ROUNDS):
        X = _wahba(motions, 1.0 / (1.0 + (costs(motions, X) / 4.0) ** 2))
    return X


def _wahba(motions: Motions, weights: Float) -> Float:
    """The rotation that turns seen vectors into odometry's best, each by its certainty."""
    weights = weights * motions.is_seen
    by_turn = weights / _turn_sigma_rad(motions) ** 2
    by_direction = weights * motions.has_direction / motions.direction_sigma_rad**2
    M = (motions.turn_odom * by_turn[:, None]).T @ motions.turn_seen
    M += (motions.direction_odom * by_direction[:, None]).T @ motions.direction_seen
    return nearest_rotation(M)
