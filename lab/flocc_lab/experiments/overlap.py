"""Whether robots' true ways come near each other at all: an experiment on robots that never do shows nothing."""

from collections.abc import Collection, Iterable, Mapping
from itertools import combinations
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flocc_lab.experiments.experiment import ExperimentError
from flocc_launch.simulation.virtual_playback import Playback
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]
T = TypeVar("T", str, LogId)


def require_overlap(playbacks: Mapping[str, Playback], near_m: float, what: str) -> None:
    """Check that the robots' ways form one group in which each comes near another one's.

    Args:
        playbacks: What each robot sees; robots without keyframes do not count.
        near_m: Ways that come this near overlap.
        what: What the robots belong to, for the sentence.

    Raises:
        ExperimentError: A robot has no ground truth, or nobody's way comes near.
    """
    seeing = {name: playback for name, playback in playbacks.items() if playback.captures}
    blind = [name for name, playback in seeing.items() if playback.truth is None]
    if blind:
        raise ExperimentError(f"{what}: robot {blind[0]} has no ground truth, so no error can be measured")
    ways_m = {name: p.truth.T_fixed_body[:, :3, 3] for name, p in seeing.items() if p.truth is not None}
    apart = sorted(set(ways_m) - joined(ways_m, _near(ways_m, near_m)))
    if apart:
        raise ExperimentError(
            f"{what}: the way of robot {apart[0]} stays more than {near_m:g} m from the others': no overlap, no map"
        )


def _near(ways_m: Mapping[str, Float], near_m: float) -> list[tuple[str, str]]:
    """Pairs of robots whose ways come near each other."""
    trees = {name: cKDTree(way) for name, way in ways_m.items()}
    return [(a, b) for a, b in combinations(sorted(trees), 2) if trees[a].count_neighbors(trees[b], near_m)]


def joined(names: Collection[T], pairs: Iterable[tuple[T, T]]) -> set[T]:
    """Those of the names that hang together with the first one, directly or through others."""
    both_ways = {ordered for a, b in pairs for ordered in ((a, b), (b, a))}
    group = set(sorted(names)[:1])
    while grown := {b for a, b in both_ways if a in group} - group:
        group |= grown
    return group
