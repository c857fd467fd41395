"""The order of candidates under a budget: which closure would strengthen the pose graph most.

Each candidate costs latents, and where these are dear the first few closures decide. The criterion is that of
Swarm-SLAM (Lajoie and Beltrame 2024), the spectrum of the pose graph's Laplacian: the algebraic connectivity, its
second smallest eigenvalue, bounds the error of the worst determined part, and the expected squared error of all
keyframes is the sum of 1 / lambda, which it dominates. Candidates are taken greedily, as there and by Doherty et al.
(2022), but by what they take off the whole sum: the gain of the connectivity alone is zero for all candidates where the
weakest mode is one that none of them touches. A weak prior on every place makes the sum finite before all maps are
joined, so that a pair that joins two of them simply gains most.

Odometry chains are contracted to the keyframes that have closures or candidates (a chain of n edges is one edge of
weight 1 / n), each with the mass of the keyframes around it, and neighbours are merged until `NODES_MAX` remain.

Only what is chosen is fetched and registered, also where latents are at hand: a pair that adds little costs the solver
as much as one that adds much. All others have their turn when nothing better is left. Robots choose without talking:
both owners of a pair know it, so each counts on the other to register what comes first and is the other's, and chooses
its own beside that.
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
POOL_MAX = 256
"""Own candidates that are compared, and as many of others; the most similar ones."""
STEPS_MAX = 12
"""Pairs that one choice goes through, those that others are to register among them."""
CLOSURE_WEIGHT = 0.1
"""Of a closure against one odometry edge; the back end's default sigmas, 0.05 m and 0.2 m, would give 1 / 16."""
PLACE_WEIGHT = 1e-5
"""Of the prior on a keyframe's place against one odometry edge: 16 m at a sigma of 0.05 m."""
SIMILARITY_MIN = 0.1
"""Of a pair that only another robot compared."""
GAIN_DIGITS = 6
"""Gains that agree to so many digits are equal, so that rounding of one machine or another decides nothing."""


@dataclass(frozen=True, slots=True)
class NodeEdges:
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
        self,
        candidates: Mapping[CandidatePair, float],
        able: Callable[[CandidatePair], bool],
        elsewhere: Callable[[], Mapping[CandidatePair, float]] = dict,
    ) -> list[CandidatePair]:
        """The few candidates to register first, in order.

        Args:
            candidates: Similarity of each, the most similar first.
            able: Whether a candidate can be registered now.
            elsewhere: Gives those that robots in range are to register.
        """
        self._chosen = [pair for pair in self._chosen if pair in candidates and able(pair)]
        wanted = PICKS - len(self._chosen)
        if wanted > 0:
            free = (pair for pair in candidates if pair not in self._chosen and able(pair))
            own = {pair: candidates[pair] for pair in islice(free, POOL_MAX)}
            self._chosen += list(own) if len(own) <= wanted else self._choose(own, elsewhere(), wanted)
        return self._chosen

    def _choose(
        self, own: Mapping[CandidatePair, float], others: Mapping[CandidatePair, float], wanted: int
    ) -> list[CandidatePair]:
        """The next few of this robot's candidates, greedily, beside those that others will take."""
        best_of_others = sorted(others.items(), key=lambda item: (-item[1], item[0]))[:POOL_MAX]
        left = {**dict(best_of_others), **own}
        known = [*self._closures, *self._chosen]
        graph = Reduced([*known, *left], self._lengths)
        for pair in known:
            graph.add(pair)
        chosen: list[CandidatePair] = []
        for _ in range(STEPS_MAX):
            pair = graph.best(left)
            graph.add(pair)
            del left[pair]
            if pair in own:
                chosen.append(pair)
            if len(chosen) == wanted or not left:
                break
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
        self._add_edges(NodeEdges(np.array([a]), np.array([b]), np.array([CLOSURE_WEIGHT])))

    def best(self, similarities: Mapping[CandidatePair, float]) -> CandidatePair:
        """The pair of the largest gain, weighed by how likely its similarity makes it."""
        pairs = list(similarities)
        sure = np.maximum(list(similarities.values()), SIMILARITY_MIN)
        worth = [float(f"{value:.{GAIN_DIGITS}g}") for value in self.gains(pairs) * sure]
        return min(zip(pairs, worth, strict=True), key=lambda item: (-item[1], -similarities[item[0]], item[0]))[0]

    def gains(self, pairs: Sequence[CandidatePair]) -> Float:
        """What each pair as an edge would take off the sum of 1 / lambda, (N,)."""
        a = [self._node(pair.low) for pair in pairs]
        b = [self._node(pair.high) for pair in pairs]
        values, modes = spectrum(self._laplacian, self._masses)
        return uncertainty_removed(modes[a] - modes[b], np.maximum(values, 0.0) + PLACE_WEIGHT, CLOSURE_WEIGHT)

    def _add_chain(self, log: LogId, ends: list[int], length: int) -> tuple[Float, NodeEdges]:
        """The nodes of one log, each with its share of the keyframes, and the edges between them."""
        places = np.array(sorted({index // self._step for index in ends})) * self._step
        first = len(self._nodes)
        for k, place in enumerate(places):
            self._nodes[log, int(place)] = first + k
        last = max(length, ends[-1] + 1) - 0.5
        borders = np.concatenate([[-0.5], (places[1:] + places[:-1]) / 2, [last]])
        numbers = first + np.arange(len(places))
        return np.maximum(np.diff(borders), 0.5), NodeEdges(numbers[:-1], numbers[1:], 1.0 / np.diff(places))

    def _node(self, keyframe: KeyframeId) -> int:
        return self._nodes[keyframe.log, keyframe.index // self._step * self._step]

    def _add_edges(self, edges: NodeEdges) -> None:
        for a, b, weight in zip(edges.a, edges.b, edges.weights, strict=True):
            if a != b:
                self._laplacian[[a, b], [a, b]] += weight
                self._laplacian[[a, b], [b, a]] -= weight


def step_for(ends: Iterable[set[int]]) -> int:
    """The smallest power of two that leaves at most `NODES_MAX` nodes when it divides the numbers of keyframes."""
    logs, step = list(ends), 1
    while sum(len({index // step for index in log}) for log in logs) > max(NODES_MAX, len(logs)):
        step *= 2
    return step


def spectrum(laplacian: Float, masses: Float) -> tuple[Float, Float]:
    """Eigenvalues and modes of a graph whose nodes have masses, `L v = lambda M v`.

    Args:
        laplacian: (N, N).
        masses: (N,), positive.

    Returns:
        (N,) ascending, a zero for each connected part first, then the algebraic connectivity; and the modes (N, N) as
        columns, of unit length in M; the Fiedler vector is that of the algebraic connectivity.
    """
    roots = 1.0 / np.sqrt(masses)
    values, vectors = np.linalg.eigh(laplacian * roots[:, None] * roots[None, :])
    return np.asarray(values), np.asarray(vectors * roots[:, None])


def uncertainty_removed(stretch: Float, values: Float, weight: float) -> Float:
    """How much one more edge lowers the sum of all 1 / lambda (Sherman and Morrison).

    Args:
        stretch: (K, N) difference of each mode between the two ends of each edge.
        values: (N,) eigenvalues, positive.
        weight: Of an edge.
    """
    resistance = (stretch**2 / values).sum(axis=1)
    return np.asarray(weight * (stretch**2 / values**2).sum(axis=1) / (1.0 + weight * resistance))
