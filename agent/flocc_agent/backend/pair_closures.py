"""Closures of one pair of robots side by side, and the ways of both: what alarms compare."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.problem import (
    closure_covariances,
    diagonal_covariance,
    initial_scale,
    prior_sigmas,
    without_unit,
)
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_agent.geometry import inverse
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

COLLAPSED_RATIO = 0.1
"""A guessed length that becomes shorter than this part of the guess has collapsed; one without a guess, below zero."""
LENGTH_MIN_M = 0.1
"""No length without a unit is taken as shorter."""
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
        length_sigma: What lengths may be off by, beside noise.
    """

    T: Float
    rotation: Float
    levered: Float
    squared: Float
    translation: Float
    length_sigma: float = ODOMETRY_LENGTH_SIGMA

    @classmethod
    def of(cls, trajectory: Trajectory, config: BackendConfig, length_sigma: float = ODOMETRY_LENGTH_SIGMA) -> "Way":
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
        return cls(T, _summed(turning), _summed(levered), _summed(squared), _summed(moving), length_sigma)

    def variances(self, i: Int, j: Int, x: Float) -> tuple[Float, Float]:
        """Variances (K,) between keyframes i and j (K,): of rotation, and of a point x (K, 3) that is held by j."""
        low, high = np.minimum(i, j), np.maximum(i, j)
        rotation = self.rotation[high] - self.rotation[low]
        lever = self.levered[high] - self.levered[low]
        squared = self.squared[high] - self.squared[low]
        swung = squared - 2.0 * np.einsum("ki,ki->k", x, lever) + rotation * np.einsum("ki,ki->k", x, x)
        stretch = self.length_sigma**2 * np.sum((self.T[i, :3, 3] - self.T[j, :3, 3]) ** 2, axis=1)
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
        by_length: (K,) whether nothing is known of the unit, so that this is a direction's: it grows with the length.
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
    by_length: Bool

    def translation_at(self, change_m: Float, of: Int | slice = slice(None)) -> Float:
        """Variances (M,) of translations whose lengths are changed by (M,)."""
        length_m = self.length_m[of]
        ratio = np.maximum(length_m + change_m, LENGTH_MIN_M) / np.maximum(length_m, 1e-12)
        return np.asarray(self.translation[of] * np.where(self.by_length[of], ratio, 1.0) ** 2)

    def with_lengths(self, length_m: Float) -> "PairClosures":
        """The same in which closures without a unit begin with other lengths (K,)."""
        ratio = np.where(self.by_length, length_m / np.maximum(self.length_m, 1e-12), 1.0)
        T = self.T.copy()
        T[:, :3, 3] *= ratio[:, None]
        return replace(
            self,
            T=T,
            length_m=self.length_m * ratio,
            length_sigma_m=self.length_sigma_m * ratio,
            shorter_max_m=self.shorter_max_m * ratio,
            translation=self.translation * ratio**2,
        )


def by_logs(closures: Mapping[int, LoopClosure]) -> dict[tuple[LogId, LogId], list[int]]:
    """Numbers of closures, rising, of each two logs, the lower log first."""
    found: dict[tuple[LogId, LogId], list[int]] = {}
    for k in sorted(closures):
        low, high = sorted((closures[k].query.log, closures[k].match.log))
        found.setdefault((low, high), []).append(k)
    return found


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
        by_length=without_unit(chosen, config),
    )
