"""One component of the pose graph as arrays: odometry edges, closure edges with scale model."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.clusters import cluster_labels
from flocc_agent.backend.edges import NEAR_M, NO_CLUSTER, Edges, State, directions, taken
from flocc_agent.config import BackendConfig, Formulation, ScaleInitial
from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_agent.core.registration import closure_probability
from flocc_agent.geometry import inverse, quaternions
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]

FITTED_SIGMA_RATIO = 5.0
"""Relative standard deviation of the prior on a length that is fitted to neighbours, at least."""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """A component, ready to be solved.

    Attributes:
        logs: Its logs, sorted; the first is the anchor, whose first keyframe is pose 0 and does not move.
        offsets: Index of each log's first keyframe.
        poses: Number of keyframes.
        edges: Odometry first, then closures.
        closure_rows: Slice of the closures in `edges`.
        closure_ids: Index in the graph of each closure edge.
        clusters: Number of cluster scales.
        scaled: Logs whose odometry has a scale; in a state they come after the clusters.
        scale_initial: (L,) metres per network unit at gamma = 1, per closure edge.
    """

    logs: tuple[LogId, ...]
    offsets: Mapping[LogId, int]
    poses: int
    edges: Edges
    closure_rows: slice
    closure_ids: tuple[int, ...]
    clusters: int
    scale_initial: Float
    scaled: tuple[LogId, ...] = ()

    @property
    def scales(self) -> int:
        """Number of scales in a state."""
        return self.clusters + len(self.scaled)

    def index(self, keyframe: KeyframeId) -> int:
        """Index of a keyframe's pose."""
        return self.offsets[keyframe.log] + keyframe.index

    def by_log(self, values: Float) -> dict[LogId, Float]:
        """What there is one of for each pose (N, ...), apart for each log."""
        ends = [*list(self.offsets.values())[1:], self.poses]
        return {log: values[begin:end] for (log, begin), end in zip(self.offsets.items(), ends, strict=True)}

    def scales_applied(self, state: State) -> dict[LogId, float]:
        """Scales of odometry at a state."""
        return dict(zip(self.scaled, state.scale[self.clusters :].tolist(), strict=True))

    def with_lengths(self, lengths_m: Mapping[int, float]) -> "Problem":
        """The same in which directions are as long as told by number, but at least `NEAR_M`."""
        rows = np.flatnonzero(directions(self.edges))
        if not len(rows):
            return self
        ids = [self.closure_ids[row - self.closure_rows.start] for row in rows.tolist()]
        ratio = np.array([max(lengths_m.get(k, NEAR_M), NEAR_M) for k in ids])
        part, scale_initial = taken(self.edges, rows), self.scale_initial.copy()
        d, L = part.d * ratio[:, None], part.sqrt_information.copy()
        sigma = np.maximum(part.sigma / ratio, FITTED_SIGMA_RATIO)
        L[:, :, 3:] /= ratio[:, None, None]
        covariances = np.asarray(np.linalg.inv(np.swapaxes(L, 1, 2) @ L), dtype=np.float64)
        longer = {
            "d": d,
            "sqrt_information": L,
            "sqrt_information_wide": widened(covariances, d, sigma),
            "sigma": sigma,
        }
        whole = {name: getattr(self.edges, name).copy() for name in longer}
        for name, values in longer.items():
            whole[name][rows] = values
        scale_initial[rows - self.closure_rows.start] *= ratio
        return replace(self, edges=replace(self.edges, **whole), scale_initial=scale_initial)

    def with_scaled(self, logs: Collection[LogId], divides: bool = False) -> "Problem":
        """The same with a scale (true over measured length) for the odometry of these logs and no others.

        It multiplies what was measured, or divides the poses.
        """
        scaled = tuple(log for log in self.logs if log in logs)
        of_log = np.array([self.clusters + scaled.index(log) if log in scaled else NO_CLUSTER for log in self.logs])
        cluster, starts = self.edges.cluster.copy(), np.array([self.offsets[log] for log in self.logs])
        of_poses = self.edges.divides.copy()
        of_odometry = slice(0, self.closure_rows.start)
        cluster[of_odometry] = of_log[np.searchsorted(starts, self.edges.i[of_odometry], side="right") - 1]
        of_poses[of_odometry] = divides & (cluster[of_odometry] >= 0)
        return replace(self, edges=replace(self.edges, cluster=cluster, divides=of_poses), scaled=scaled)


def build(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    config: BackendConfig,
    recorded: Mapping[int, LoopClosure] | None = None,
) -> Problem:
    """Turn a component into arrays.

    Args:
        trajectories: Usable odometry of the component's logs.
        closures: Usable closures between them, by their index in the graph.
        config: The formulation, the noise model and the scale priors.
        recorded: The same closures under their keyframes' own numbers, where those above are places in chains: what is
            near to what is asked of these.
    """
    logs = tuple(sorted(trajectories))
    lengths = [len(trajectories[log]) for log in logs]
    starts = np.concatenate([[0], np.cumsum(lengths)])
    offsets = {log: int(start) for log, start in zip(logs, starts[:-1], strict=True)}
    ids = tuple(sorted(closures))
    used = [closures[k] for k in ids]
    scale_initial = np.array([initial_scale(closures[k], config) for k in ids])
    odometry = [odometry_edges(trajectories[log], offsets[log], config) for log in logs]
    near = used if recorded is None else [recorded[k] for k in ids]
    closure_part, clusters = closure_edges(used, offsets, scale_initial, config, near)
    parts = [*odometry, closure_part]
    first = sum(len(part) for part in odometry)
    rows = slice(first, first + len(used))
    return Problem(logs, offsets, int(starts[-1]), concatenate(parts), rows, ids, clusters, scale_initial)


def concatenate(parts: Sequence[Edges]) -> Edges:
    """Put edges one after the other."""
    names = ("i", "j", "q_hat", "d", "sqrt_information", "sqrt_information_wide", "sigma", "cluster", "divides")
    return Edges(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def plain_edges(i: Int, j: Int, T_hat: Float, L: Float) -> Edges:
    """Edges with a metric measurement (E, 4, 4) and square-root information (E, 6, 6)."""
    d = np.zeros((len(i), 6))
    d[:, 3:] = np.einsum("eji,ej->ei", T_hat[:, :3, :3], T_hat[:, :3, 3])
    n = len(i)
    none = np.zeros(n, dtype=bool)
    return Edges(i, j, quaternions(T_hat[:, :3, :3]), d, L, L, np.zeros(n), np.full(n, NO_CLUSTER), none)


def sqrt_informations(covariances: Float) -> Float:
    """Lower factors L (E, 6, 6) with `L^T L` the inverse of each covariance."""
    if len(covariances) == 0:
        return np.zeros((0, 6, 6))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))


def diagonal_covariance(rotation_sigma_rad: float, translation_sigma: float) -> Float:
    """Covariance (6, 6) of isotropic rotation and translation noise."""
    return np.diag([rotation_sigma_rad**2] * 3 + [translation_sigma**2] * 3)


def odometry_edges(trajectory: Trajectory, offset: int, config: BackendConfig) -> Edges:
    """Edges between consecutive keyframes of one log."""
    T = np.asarray(trajectory.T_odom_keyframe, dtype=float)
    i = np.arange(len(T) - 1) + offset
    T_hat = inverse(T[:-1]) @ T[1:]
    if trajectory.edge_covariances is not None:
        L = sqrt_informations(np.asarray(trajectory.edge_covariances, dtype=float))
    else:
        S = diagonal_covariance(config.odometry_rotation_sigma_rad, config.odometry_translation_sigma_m)
        L = np.broadcast_to(sqrt_informations(S[None])[0], (len(i), 6, 6)).copy()
    return plain_edges(i, i + 1, T_hat, L)


def initial_scale(closure: LoopClosure, config: BackendConfig) -> float:
    """Metres per network unit at which a closure starts."""
    if closure.metric or config.scale_initial is ScaleInitial.RAW:
        return 1.0
    return closure.scale_initial or 1.0


def closure_edges(
    closures: Sequence[LoopClosure],
    offsets: Mapping[LogId, int],
    scale_initial: Float,
    config: BackendConfig,
    recorded: Sequence[LoopClosure] | None = None,
) -> tuple[Edges, int]:
    """Edges of loop closures with their scale model, and the number of cluster scales."""
    if not closures:
        return plain_edges(
            np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 4, 4)), np.zeros((0, 6, 6))
        ), 0
    i = np.array([offsets[c.query.log] + c.query.index for c in closures])
    j = np.array([offsets[c.match.log] + c.match.index for c in closures])
    T_hat = np.array([c.T_query_match_unscaled for c in closures], dtype=float)
    T_hat[:, :3, 3] *= scale_initial[:, None]
    metric = plain_edges(i, j, T_hat, np.zeros((len(i), 6, 6)))
    covariances = closure_covariances(closures, scale_initial, config)
    labels, sigma, clusters = scale_model(recorded or closures, config)
    told = without_unit(closures, config)
    for k in np.flatnonzero(told).tolist():
        covariances[k] = sideways(covariances[k], metric.d[k])
    L = sqrt_informations(covariances)
    return Edges(i, j, metric.q_hat, metric.d, L, widened(covariances, metric.d, sigma), sigma, labels, told), clusters


def closure_covariances(closures: Sequence[LoopClosure], scale_initial: Float, config: BackendConfig) -> Float:
    """Covariances (L, 6, 6) in metres, divided by the probability of Eq. (2) and by the closure's weight."""
    default = diagonal_covariance(config.closure_rotation_sigma_rad, config.closure_translation_sigma_m)
    units = np.ones((len(closures), 6))
    units[:, 3:] = scale_initial[:, None]
    out = np.empty((len(closures), 6, 6))
    for k, closure in enumerate(closures):
        own = closure.covariance
        out[k] = default if own is None else own * units[k] * units[k][:, None]
        if config.weight_by_probability:
            out[k] /= closure_probability(closure.match_ratio, config.steepness)
        out[k] /= closure.weight
    return out


def widened(covariances: Float, d: Float, sigma: Float) -> Float:
    """Square-root informations (E, 6, 6) of measurements whose own scales are eliminated."""
    return sqrt_informations(covariances + sigma[:, None, None] ** 2 * d[:, :, None] * d[:, None, :])


def sideways(covariance: Float, d: Float) -> Float:
    """A covariance (6, 6) in which the length of a translation is as uncertain as its direction, and apart from it."""
    along = d / np.linalg.norm(d)
    across = np.eye(6) - np.outer(along, along)
    left = across @ covariance @ across
    return np.asarray(left + 0.5 * np.trace(left[3:, 3:]) * np.outer(along, along))


def scale_model(closures: Sequence[LoopClosure], config: BackendConfig) -> tuple[Int, Float, int]:
    """Cluster index, own standard deviation and number of clusters for a formulation.

    The prior on a scale is `gamma ~ N(1, sigma^2)` with the sigma of `prior_sigmas`. A cluster of one
    closure needs no variable: prior and link widen the edge together.
    """
    n = len(closures)
    free = np.array([not c.metric for c in closures], dtype=bool)
    labels, sigma = np.full(n, NO_CLUSTER), np.zeros(n)
    if config.formulation is Formulation.BASE or not np.any(free):
        return labels, sigma, 0
    if config.formulation is Formulation.SHARED:
        labels[free] = 0
        return labels, sigma, 1
    prior = prior_sigmas(closures, config)
    if config.formulation is Formulation.INDEPENDENT:
        sigma[free] = prior[free]
        return labels, sigma, 0
    raw = cluster_labels(closures, config.cluster_keyframes_max)
    raw[~free | without_unit(closures, config)] = NO_CLUSTER
    sizes = np.bincount(raw[raw >= 0], minlength=1)
    renumbered = np.cumsum(sizes > 1) - 1
    together = (raw >= 0) & (sizes[np.maximum(raw, 0)] > 1)
    labels[together] = renumbered[raw[together]]
    link = np.where(comparable(closures, config), config.scale_link_sigma_ratio, config.scale_link_unknown_sigma_ratio)
    sigma[free] = np.where(together, link, np.hypot(prior, link))[free]
    return labels, sigma, int(np.sum(sizes > 1))


def prior_sigmas(closures: Sequence[LoopClosure], config: BackendConfig) -> Float:
    """Relative standard deviation (L,) of the prior on each closure's scale."""
    known = np.array([c.scale_initial is not None for c in closures], dtype=bool)
    known &= config.scale_initial is not ScaleInitial.RAW
    return np.where(known, config.scale_prior_sigma_ratio, config.scale_prior_unknown_sigma_ratio)


def without_unit(closures: Sequence[LoopClosure], config: BackendConfig) -> NDArray[np.bool_]:
    """Whether nothing is known of each closure's unit (L,), in which its covariance is told."""
    own = config.formulation in (Formulation.INDEPENDENT, Formulation.SMOOTHED)
    free = own and config.scale_initial is not ScaleInitial.RAW
    return np.array(
        [free and not c.metric and c.scale_initial is None and c.covariance is not None for c in closures], dtype=bool
    )


def comparable(closures: Sequence[LoopClosure], config: BackendConfig) -> NDArray[np.bool_]:
    """Whether each closure's network unit compares with others': by Eq. (6), or because units are taken as metres."""
    raw = config.scale_initial is ScaleInitial.RAW
    return np.array([raw or c.scale_initial is not None for c in closures], dtype=bool)
