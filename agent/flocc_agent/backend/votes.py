"""How much each closure says on its own: closures of one place that agree with each other may be wrong together.

A repeated facade gives ten closures in a row that agree with each other: it is one mistake, not ten. Closures that are
near each other and do not agree are no such group: right ones lose nothing by wrong ones that lie beside them.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import chdtri

from flocc_agent.backend.alarms import EXCESS_MAX, compared, said_by
from flocc_agent.backend.pair_closures import Way, by_logs, measured
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]

VOTES_POWER = 1.0 / 3.0
PARTNERS_MAX = 16
"""How many others, the nearest ones, each closure is compared with; groups are transitive."""


def votes_of(groups: Int) -> Float:
    """Votes (L,) of closures whose groups (L,) are given: n of a group count as the cube root of n."""
    return np.asarray(np.bincount(groups)[groups] ** (VOTES_POWER - 1.0)) if len(groups) else np.zeros(0)


def grouped(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    recorded: Mapping[int, LoopClosure],
    config: BackendConfig,
) -> Int:
    """The number of its group (L,) of each closure, in the order of their own numbers.

    A group is closures of two robots that are fewer than `cluster_keyframes_max` keyframes apart on both sides and
    agree with each other, within what uncertainties that are understated as far as alarms believe allow.

    Args:
        trajectories: Odometry between the closures' keyframes.
        closures: Of the component, by their number in the graph.
        recorded: The same under their keyframes' own numbers, which say what is near.
        config: The noise model.
    """
    place = {k: n for n, k in enumerate(sorted(closures))}
    if not place:
        return np.zeros(0, dtype=np.int64)
    ways = {log: Way.of(trajectory, config) for log, trajectory in trajectories.items()}
    joined = [np.zeros((0, 2), dtype=np.int64)]
    for (a, b), ids in by_logs(closures).items():
        near = _near(ids, recorded, config.cluster_keyframes_max)
        if len(near):
            c = measured(ids, closures, config)
            said = said_by(ways[a], ways[b], c, *near.T)
            bound = EXCESS_MAX * float(chdtri(6.0, 1.0 - config.inlier_probability))
            agree = compared(c, near[:, 0], *said).squared <= bound
            joined.append(np.array([place[k] for k in ids])[near[agree]])
    i, j = np.concatenate(joined).T
    graph = coo_array((np.ones(len(i), dtype=np.int8), (i, j)), shape=(len(place), len(place)))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _near(ids: list[int], recorded: Mapping[int, LoopClosure], keyframes_max: int) -> Int:
    """Pairs (P, 2) of closures of two robots whose keyframes are fewer than `keyframes_max` apart on both sides."""
    ends = [sorted((recorded[k].query, recorded[k].match)) for k in ids]
    at = np.array([[low.index, high.index] for low, high in ends])
    count = min(PARTNERS_MAX + 1, len(ids))
    apart, found = cKDTree(at).query(at, k=np.arange(1, count + 1), p=np.inf, distance_upper_bound=keyframes_max - 0.5)
    rows, columns = np.nonzero(np.isfinite(apart))
    near = np.unique(np.sort(np.stack([rows, found[rows, columns]], axis=1), axis=1), axis=0)
    return np.asarray(near[near[:, 0] < near[:, 1]], dtype=np.int64)
