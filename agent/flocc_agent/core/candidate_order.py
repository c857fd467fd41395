"""The order of candidates under a budget: which closure would strengthen the pose graph most.

Each candidate costs latents, and where these are dear the first few closures decide. The criterion is that of
Swarm-SLAM (Lajoie and Beltrame 2024), the spectrum of the pose graph's Laplacian: the algebraic connectivity, its
second smallest eigenvalue, bounds the error of the worst determined part, and the expected squared error of all
keyframes is the sum of 1 / lambda, which it dominates. Candidates are taken greedily, as there and by Doherty et al.
(2022), but by what they take off the whole sum: the gain of the connectivity alone is zero for all candidates where the
weakest mode is one that none of them touches.

Odometry chains are contracted to the keyframes that have closures or candidates (a chain of n edges is one edge of
weight 1 / n), each with the mass of the keyframes around it, and neighbours are merged until `NODES_MAX` remain. Parts
of the graph that nothing connects yet are connected first, by the most similar candidates.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

Float = NDArray[np.float64]
Indices = NDArray[np.int_]

NODES_MAX = 128
PICKS = 2
"""Candidates that are chosen ahead; a chosen one stays in front, so that no half fetched latent is left behind."""
POOL_MAX = 512
"""Candidates that are compared, the most similar ones."""
CLOSURE_WEIGHT = 0.1
"""Of a closure against one odometry edge; the back end's default sigmas, 0.05 m and 0.2 m, would give 1 / 16."""
GAIN_DIGITS = 6
"""Gains that agree to so many digits are equal, so that rounding of one machine or another decides nothing."""


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges between nodes: `(N,)` ends and weights."""

    a: Indices
    b: Indices
    weights: Float


class SpectralOrder:
    """What one robot knows of the pose graph, and the candidates it chose."""

    def __init__(self) -> None:
        self._lengths: dict[LogId, int] = {}
        self._closures: dict[CandidatePair, None] = {}
        self._chosen: list[CandidatePair] = []

    def on_keyframe(self, log: LogId) -> None:
        """A log has one more keyframe."""
        self._lengths[log] = self._lengths.get(log, 0) + 1

    def on_closure(self, pair: CandidatePair) -> None:
        """A pair became a closure."""
        self._closures[pair] = None

    def chosen(
        self, candidates: Mapping[CandidatePair, float], able: Callable[[CandidatePair], bool]
    ) -> list[CandidatePair]:
        """The few candidates to register first, in order.

        Args:
            candidates: Similarity of each, the most similar first.
            able: Whether a candidate can be registered now.
        """
        self._chosen = [pair for pair in self._chosen if pair in candidates and able(pair)]
        if len(self._chosen) < PICKS:
            free = (item for item in candidates.items() if item[0] not in self._chosen and able(item[0]))
            self._chosen += self._choose(list(islice(free, POOL_MAX)), PICKS - len(self._chosen))
        return self._chosen

    def _choose(self, pool: Sequence[tuple[CandidatePair, float]], count: int) -> list[CandidatePair]:
        """The next `count` of a pool, greedily."""
        known = [*self._closures, *self._chosen]
        graph = Reduced([*known, *(pair for pair, _ in pool)], self._lengths)
        for pair in known:
            graph.add(pair)
        chosen: list[CandidatePair] = []
        left = list(pool)
        while left and len(chosen) < count:
            gains = graph.gains([pair for pair, _ in left])
            best = min(range(len(left)), key=lambda k: (-gains[k] * left[k][1], -left[k][1], left[k][0]))
            pair, _ = left.pop(best)
            graph.add(pair)
            chosen.append(pair)
        return chosen


class Reduced:
    """A pose graph contracted to the keyframes at the ends of some pairs."""

    def __init__(self, pairs: Iterable[CandidatePair], lengths: Mapping[LogId, int]) -> None:
        """Contract.

        Args:
            pairs: Closures and candidates; each of their keyframes has a node.
            lengths: Number of keyframes of each log; those not heard of yet count as far as the pairs show.
        """
        ends: dict[LogId, set[int]] = {}
        for pair in pairs:
            for keyframe in (pair.low, pair.high):
                ends.setdefault(keyframe.log, set()).add(keyframe.index)
        self._step = step_for(ends.values())
        self._nodes: dict[tuple[LogId, int], int] = {}
        chains = [self._add_chain(log, sorted(ends[log]), lengths.get(log, 0)) for log in sorted(ends)]
        self._masses = np.concatenate([masses for masses, _ in chains]) if chains else np.empty(0)
        self._laplacian = np.zeros((len(self._masses), len(self._masses)))
        for _, edges in chains:
            self._add_edges(edges)

    def add(self, pair: CandidatePair) -> None:
        """Take a pair in as an edge."""
        a, b = self._node(pair.low), self._node(pair.high)
        self._add_edges(Edges(np.array([a]), np.array([b]), np.array([CLOSURE_WEIGHT])))

    def gains(self, pairs: Sequence[CandidatePair]) -> list[float]:
        """What each pair would add: infinite where it joins two parts, else the fall of its part's uncertainty."""
        a = np.array([self._node(pair.low) for pair in pairs])
        b = np.array([self._node(pair.high) for pair in pairs])
        parts = self._parts()
        gains = np.where(parts[a] != parts[b], np.inf, 0.0)
        if np.isinf(gains).any():
            return [float(gain) for gain in gains]
        for part in np.unique(parts[a]):
            nodes = np.flatnonzero(parts == part)
            values, modes = spectrum(self._laplacian[np.ix_(nodes, nodes)], self._masses[nodes])
            places = np.zeros(len(parts), dtype=int)
            places[nodes] = np.arange(len(nodes))
            inside = parts[a] == part
            stretch = modes[places[a[inside]]] - modes[places[b[inside]]]
            gains[inside] = uncertainty_removed(stretch, values, CLOSURE_WEIGHT)
        return [float(f"{gain:.{GAIN_DIGITS}g}") for gain in gains]

    def _add_chain(self, log: LogId, ends: list[int], length: int) -> tuple[Float, Edges]:
        """The nodes of one log, each with its share of the keyframes, and the edges between them."""
        places = np.array(sorted({index // self._step for index in ends})) * self._step
        first = len(self._nodes)
        for k, place in enumerate(places):
            self._nodes[log, int(place)] = first + k
        last = max(length, ends[-1] + 1) - 0.5
        borders = np.concatenate([[-0.5], (places[1:] + places[:-1]) / 2, [last]])
        numbers = first + np.arange(len(places))
        return np.maximum(np.diff(borders), 0.5), Edges(numbers[:-1], numbers[1:], 1.0 / np.diff(places))

    def _node(self, keyframe: KeyframeId) -> int:
        return self._nodes[keyframe.log, keyframe.index // self._step * self._step]

    def _add_edges(self, edges: Edges) -> None:
        for a, b, weight in zip(edges.a, edges.b, edges.weights, strict=True):
            if a != b:
                self._laplacian[[a, b], [a, b]] += weight
                self._laplacian[[a, b], [b, a]] -= weight

    def _parts(self) -> Indices:
        """Number of the connected part that each node is in, (N,)."""
        parts = np.arange(len(self._masses))
        rows, columns = np.nonzero(np.triu(self._laplacian, 1))
        while True:
            lowest = parts.copy()
            np.minimum.at(lowest, rows, parts[columns])
            np.minimum.at(lowest, columns, parts[rows])
            lowest = lowest[lowest]
            if np.array_equal(lowest, parts):
                return parts
            parts = lowest


def step_for(ends: Iterable[set[int]]) -> int:
    """The smallest power of two that leaves at most `NODES_MAX` nodes when it divides the numbers of keyframes."""
    logs, step = list(ends), 1
    while sum(len({index // step for index in log}) for log in logs) > max(NODES_MAX, len(logs)):
        step *= 2
    return step


def spectrum(laplacian: Float, masses: Float) -> tuple[Float, Float]:
    """Eigenvalues and modes of a connected graph whose nodes have masses, `L v = lambda M v`, but for the constant one.

    Args:
        laplacian: (N, N).
        masses: (N,), positive.

    Returns:
        (N-1,) ascending, the algebraic connectivity first, and the modes (N, N-1), of unit length in M, the Fiedler
        vector first.
    """
    roots = 1.0 / np.sqrt(masses)
    values, vectors = np.linalg.eigh(laplacian * roots[:, None] * roots[None, :])
    return np.asarray(values[1:]), np.asarray(vectors[:, 1:] * roots[:, None])


def uncertainty_removed(stretch: Float, values: Float, weight: float) -> Float:
    """How much one more edge lowers the sum of all 1 / lambda (Sherman and Morrison).

    Args:
        stretch: (K, N-1) difference of each mode between the two ends of each edge.
        values: (N-1,) eigenvalues.
        weight: Of an edge.
    """
    resistance = (stretch**2 / values).sum(axis=1)
    return np.asarray(weight * (stretch**2 / values**2).sum(axis=1) / (1.0 + weight * resistance))
