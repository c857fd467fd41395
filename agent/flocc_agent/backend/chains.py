"""Chains: keyframes that nothing but odometry holds are eliminated before the solve, and come back after it.

Between two keyframes that closures hold there is nothing but odometry. Its edges, put one after the other, are one edge
with one covariance; where the two ends end up says by how much each keyframe between them moves: in proportion to the
covariance that has come together up to there. This is the exact elimination of what lies between, linearised at
odometry's own shape, and a solve costs what closures cost instead of what the mission's length does. A chain that is
bent so far that this is no longer exact is noticed by its cost, and the component is then solved with all of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.descent import Solved
from flocc_agent.backend.edges import residuals, state_of
from flocc_agent.backend.problem import Problem, diagonal_covariance, odometry_edges
from flocc_agent.config import BackendConfig, Formulation
from flocc_agent.core.pose_graph import Component, LoopClosure, Trajectory, stretched
from flocc_agent.geometry import adjoints, inverse, poses_of_twists, twists_of_poses
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]

CHAINED_POSES_MIN = 300
"""Smaller components are solved as they are: they take no time."""
KEPT_RATIO_MAX = 0.7
"""Where more of the keyframes than this would stay, nothing is gained."""
CHAIN_EDGES_MAX = 50
"""Longer chains are cut: the shorter, the less it matters that they are linearised as measured."""
STRAIN_RATIO_MAX = 1e-3
"""What odometry costs with all keyframes may differ from what its chains cost by this part of the whole cost."""


@dataclass(frozen=True, slots=True, eq=False)
class Chains:
    """A component whose odometry is chains.

    Attributes:
        numbers: Keyframes of each log that stay, in order; its first and its last among them.
        trajectories: Of those alone.
        closures: Between them, by their number in the graph; keyframes are named by their place in `numbers`.
        whole: Odometry of all keyframes.
        recorded: The closures as they were.
        shares: (N, 6, 6) of each log: what part of its chain's twist a keyframe takes, in the tangent at the end.
        config: The noise model.
    """

    numbers: Mapping[LogId, Int]
    trajectories: Mapping[LogId, Trajectory]
    closures: Mapping[int, LoopClosure]
    whole: Mapping[LogId, Trajectory]
    recorded: Mapping[int, LoopClosure]
    shares: Mapping[LogId, Float]
    config: BackendConfig

    def shortened(self, T_map_keyframe: Mapping[LogId, Float]) -> dict[LogId, Float]:
        """Poses of the keyframes that stay."""
        return {log: np.asarray(T_map_keyframe[log])[numbers] for log, numbers in self.numbers.items()}

    def place(self, keyframe: KeyframeId) -> KeyframeId:
        """A keyframe that stays, by its place."""
        return KeyframeId(keyframe.log, int(np.searchsorted(self.numbers[keyframe.log], keyframe.index)))

    def keyframe(self, place: KeyframeId) -> KeyframeId:
        """The keyframe at a place."""
        return KeyframeId(place.log, int(self.numbers[place.log][place.index]))

    def lengthened(self, T_map_kept: Mapping[LogId, Float], scales: Mapping[LogId, float]) -> dict[LogId, Float]:
        """Poses of all keyframes, (N, 4, 4) of each log, for poses of those that stay and scales of odometry."""
        return {log: self._of_log(log, np.asarray(T), scales.get(log, 1.0)) for log, T in T_map_kept.items()}

    def whole_component(self, component: Component, scales: Mapping[LogId, float]) -> Component:
        """A solved component with all its keyframes."""
        return replace(
            component,
            T_map_keyframe=self.lengthened(component.T_map_keyframe, scales),
            covariance_keyframe={self.keyframe(place): S for place, S in component.covariance_keyframe.items()},
        )

    def strain(self, T_map_kept: Mapping[LogId, Float], scales: Mapping[LogId, float]) -> float:
        """How much more odometry costs keyframe by keyframe than chain by chain."""
        long = self.lengthened(T_map_kept, scales)
        return self._cost(self.whole, long, scales) - self._cost(self.trajectories, T_map_kept, scales)

    def _cost(
        self, trajectories: Mapping[LogId, Trajectory], T_map: Mapping[LogId, Float], scales: Mapping[LogId, float]
    ) -> float:
        cost = 0.0
        for log, T in T_map.items():
            edges = odometry_edges(stretched(trajectories[log], scales.get(log, 1.0)), 0, self.config)
            cost += 0.5 * float(residuals(edges, state_of(np.asarray(T))).squared().sum())
        return cost

    def _of_log(self, log: LogId, T_map_kept: Float, scale: float) -> Float:
        numbers, T_odom = self.numbers[log], np.asarray(self.whole[log].T_odom_keyframe, dtype=float)
        if len(numbers) == len(T_odom):
            return T_map_kept
        if scale != 1.0:
            T_odom = np.asarray(stretched(self.whole[log], scale).T_odom_keyframe)
        chain = chain_of(numbers, len(T_odom))
        T_a, T_b = T_odom[numbers[:-1]], T_odom[numbers[1:]]
        T_map_a_b = T_map_kept[:-1] @ inverse(T_a) @ T_b
        twists = twists_of_poses(inverse(T_map_a_b) @ T_map_kept[1:])
        moved = poses_of_twists(np.einsum("nij,nj->ni", self.shares[log], twists[chain]))
        T = T_map_a_b[chain] @ moved @ (inverse(T_b)[chain] @ T_odom)
        T[numbers] = T_map_kept
        return np.asarray(T)


def chains_of(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    wanted: Sequence[KeyframeId],
    config: BackendConfig,
) -> Chains | None:
    """Shorten a component; None where it is small, where little would go, or where it is to be taken as it is given.

    Args:
        trajectories: Usable odometry.
        closures: Usable closures between them, by their number in the graph.
        wanted: Other keyframes that stay.
        config: The formulation and odometry's noise model.
    """
    poses = sum(len(trajectory) for trajectory in trajectories.values())
    if poses < CHAINED_POSES_MIN or config.formulation is Formulation.BASE:
        return None
    ends = [end for closure in closures.values() for end in (closure.query, closure.match)]
    held: dict[LogId, list[int]] = {log: [] for log in trajectories}
    for end in (*ends, *wanted):
        held[end.log].append(end.index)
    numbers = {log: kept_numbers(held[log], len(trajectory)) for log, trajectory in trajectories.items()}
    if sum(map(len, numbers.values())) > KEPT_RATIO_MAX * poses:
        return None
    short, shares = {}, {}
    for log, trajectory in trajectories.items():
        short[log], shares[log] = _chained(trajectory, numbers[log], config)
    lookup = {log: {int(number): place for place, number in enumerate(kept)} for log, kept in numbers.items()}

    def named(end: KeyframeId) -> KeyframeId:
        return KeyframeId(end.log, lookup[end.log][end.index])

    renamed = {k: replace(c, query=named(c.query), match=named(c.match)) for k, c in closures.items()}
    return Chains(numbers, short, renamed, trajectories, closures, shares, config)


def is_explained(chains: Chains, problem: Problem, solved: Solved) -> bool:
    """Whether chains say what odometry of all their keyframes would say."""
    strain = chains.strain(problem.by_log(solved.state.poses()), problem.scales_applied(solved.state))
    return bool(np.isfinite(strain)) and abs(strain) <= STRAIN_RATIO_MAX * max(solved.cost, 1.0)


def kept_numbers(held: Sequence[int], keyframes: int) -> Int:
    """Keyframes of one log that stay: held ones, the first, the last, and some in chains that are too long."""
    numbers = np.unique(np.array([0, *(n for n in held if n < keyframes), keyframes - 1], dtype=np.int64))
    gaps = np.diff(numbers)
    parts = -(-gaps // CHAIN_EDGES_MAX)
    cuts = [numbers[k] + (gaps[k] * np.arange(1, parts[k])) // parts[k] for k in np.flatnonzero(parts > 1).tolist()]
    return np.unique(np.concatenate([numbers, *cuts])) if cuts else numbers


def chain_of(numbers: Int, keyframes: int) -> Int:
    """Chain (N,) of each keyframe: the place of the kept one before it; of a kept one, of the one before that."""
    return np.maximum(np.searchsorted(numbers, np.arange(keyframes), side="left") - 1, 0)


def _chained(trajectory: Trajectory, numbers: Int, config: BackendConfig) -> tuple[Trajectory, Float]:
    """A log's kept keyframes with the covariances of its chains, and each keyframe's share of its chain."""
    T = np.asarray(trajectory.T_odom_keyframe, dtype=float)
    covariances = trajectory.edge_covariances
    if covariances is None:
        one = diagonal_covariance(config.odometry_rotation_sigma_rad, config.odometry_translation_sigma_m)
        covariances = np.broadcast_to(one, (len(T) - 1, 6, 6))
    if len(numbers) == len(T):
        return Trajectory(T, np.asarray(covariances)), np.empty((0, 6, 6))
    chain = chain_of(numbers, len(T))
    A = adjoints(inverse(T[numbers[1:]])[chain[1:]] @ T[1:])
    summed = np.cumsum(A @ covariances @ np.swapaxes(A, 1, 2), axis=0)
    summed = np.concatenate([np.zeros((1, 6, 6)), summed])
    within = summed - summed[numbers[:-1]][chain]
    of_chains = within[numbers[1:]]
    of_chains = 0.5 * (of_chains + np.swapaxes(of_chains, 1, 2))
    shares = within @ np.linalg.inv(of_chains)[chain]
    return Trajectory(T[numbers], of_chains), np.asarray(shares)
