"""Clusters of closures whose scales are linked: same two robots, keyframes close on both sides (Sec. III-C)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from flocc_agent.core.pose_graph import LoopClosure
from flocc_protocol.ids import LogId

Int = NDArray[np.int64]


def cluster_labels(closures: Sequence[LoopClosure], keyframes_max: int) -> Int:
    """Number the clusters: closures of one pair of logs, fewer than `keyframes_max` apart on both sides.

    Membership is transitive: a chain of close closures is one cluster.

    Returns:
        (L,) labels from 0 without gaps, in the order of the first closure of each cluster.
    """
    count = len(closures)
    near = [_near(members, indices, keyframes_max) for members, indices in _by_pair(closures)]
    a, b = np.concatenate([np.zeros((0, 2), dtype=np.int64), *near]).T
    joined = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(count, count))
    _, first, labels = np.unique(connected_components(joined)[1], return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))
    return np.asarray(order[labels], dtype=np.int64)


def _by_pair(closures: Sequence[LoopClosure]) -> list[tuple[Int, Int]]:
    """Of each pair of logs: its closures' numbers (M,), and the indices (M, 2) of their keyframes, lower log first."""
    pairs: dict[tuple[LogId, LogId], list[tuple[int, int, int]]] = {}
    for k, closure in enumerate(closures):
        low, high = sorted((closure.query, closure.match))
        pairs.setdefault((low.log, high.log), []).append((k, low.index, high.index))
    rows = [np.array(found, dtype=np.int64) for found in pairs.values()]
    return [(row[:, 0], row[:, 1:]) for row in rows]


def _near(members: Int, indices: Int, keyframes_max: int) -> Int:
    """Pairs (P, 2) of closures whose keyframes are fewer than `keyframes_max` apart on both sides."""
    pairs = cKDTree(indices).query_pairs(keyframes_max - 0.5, p=np.inf, output_type="ndarray")
    return np.asarray(members[pairs], dtype=np.int64)
