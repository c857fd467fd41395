"""Clusters of closures whose scales are linked: same two robots, keyframes close on both sides (Sec. III-C)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure
from flocc_protocol.ids import LogId

Int = NDArray[np.int64]


def cluster_labels(closures: Sequence[LoopClosure], keyframes_max: int) -> Int:
    """Number the clusters: closures of one pair of logs, fewer than `keyframes_max` apart on both sides.

    Membership is transitive: a chain of close closures is one cluster. Closures are put on a grid of cells of
    `keyframes_max`, so that only neighbouring cells are compared: time grows linearly with closures.

    Returns:
        (L,) labels from 0 without gaps, in the order of the first closure of each cluster.
    """
    parent = np.arange(len(closures))
    for members in _by_pair(closures).values():
        _join(members, closures, keyframes_max, parent)
    roots = np.array([_root(parent, k) for k in range(len(closures))], dtype=np.int64)
    _, first, labels = np.unique(roots, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))
    return np.asarray(order[labels], dtype=np.int64)


def _by_pair(closures: Sequence[LoopClosure]) -> dict[tuple[LogId, LogId], list[int]]:
    pairs: dict[tuple[LogId, LogId], list[int]] = {}
    for k, closure in enumerate(closures):
        low, high = sorted((closure.query, closure.match))
        pairs.setdefault((low.log, high.log), []).append(k)
    return pairs


def _join(members: list[int], closures: Sequence[LoopClosure], keyframes_max: int, parent: Int) -> None:
    cells: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
    for k in members:
        low, high = sorted((closures[k].query, closures[k].match))
        a, b = low.index, high.index
        row, column = a // keyframes_max, b // keyframes_max
        for near_row in (row - 1, row, row + 1):
            for near_column in (column - 1, column, column + 1):
                for other, a_other, b_other in cells.get((near_row, near_column), ()):
                    if abs(a - a_other) < keyframes_max and abs(b - b_other) < keyframes_max:
                        _unite(parent, k, other)
        cells.setdefault((row, column), []).append((k, a, b))


def _root(parent: Int, k: int) -> int:
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = int(parent[k])
    return k


def _unite(parent: Int, a: int, b: int) -> None:
    low, high = sorted((_root(parent, a), _root(parent, b)))
    parent[high] = low
