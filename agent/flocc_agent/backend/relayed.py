"""Two robots that few closures join, seen from third ones: from one robot to a third, along its way, to the other."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.pair_closures import PairClosures, Way
from flocc_agent.backend.together import Predictions, along
from flocc_agent.geometry import inverse
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Pair = tuple[LogId, LogId]

NEAREST = 3
"""How many closures of a robot with a third one are tried for each closure: those whose keyframes are nearest."""
RELAYS = 8
"""How many ways round are compared with each closure: those along the shortest pieces of odometry."""


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """Closures from one robot to another: keyframes i and j (M,), pose T (M, 4, 4) of j in i, and how sure they are."""

    i: Int
    j: Int
    T: Float
    length_sigma_m: Float
    rotation: Float
    translation: Float

    @classmethod
    def of(cls, of_pairs: Mapping[Pair, PairClosures], start: LogId, end: LogId) -> "Leg | None":
        """Closures from the one log to the other, turned where they are kept the other way round."""
        c = of_pairs.get((min(start, end), max(start, end)))
        if c is None:
            return None
        if start < end:
            return cls(c.i, c.j, c.T, c.length_sigma_m, c.rotation, c.translation)
        return cls(c.j, c.i, inverse(c.T), c.length_sigma_m, c.rotation, c.translation)

    def at(self, rows: Int) -> "Leg":
        """Some of the closures."""
        return Leg(
            self.i[rows],
            self.j[rows],
            self.T[rows],
            self.length_sigma_m[rows],
            self.rotation[rows],
            self.translation[rows],
        )

    @property
    def u(self) -> Float:
        """Directions (M, 3) of the translations."""
        length_m = np.linalg.norm(self.T[:, :3, 3], axis=1, keepdims=True)
        return np.asarray(self.T[:, :3, 3] / np.maximum(length_m, 1e-12))


def relayed(pair: Pair, ways: Mapping[LogId, Way], of_pairs: Mapping[Pair, PairClosures]) -> Predictions:
    """Predictions (K, RELAYS) for the closures of a pair, by their robots' closures with third ones."""
    closures = of_pairs[pair]
    count = len(closures.ids)
    out = Predictions.none(count, RELAYS)
    legs = [(third, *both) for third in ways if third not in pair and (both := _legs(of_pairs, pair, third))]
    for k in range(count):
        i, j = int(closures.i[k]), int(closures.j[k])
        found = [ways_round(i, j, to, fro) for _, to, fro in legs]
        of = np.repeat(np.arange(len(legs)), [len(steps) for steps, _, _ in found])
        steps = np.concatenate([steps for steps, _, _ in found]) if found else np.zeros(0)
        shortest = np.argsort(steps, kind="stable")[:RELAYS]
        for n, (third, to, fro) in enumerate(legs):
            chosen = shortest[of[shortest] == n] - int(np.sum(of < n))
            if len(chosen):
                _, m, f = found[n]
                places = np.flatnonzero(of[shortest] == n)
                of_three = (ways[pair[0]], ways[third], ways[pair[1]])
                _say(out, k, places, of_three, i, j, to.at(m[chosen]), fro.at(f[chosen]))
    return out


def _legs(of_pairs: Mapping[Pair, PairClosures], pair: Pair, third: LogId) -> tuple[Leg, Leg] | None:
    to, fro = Leg.of(of_pairs, pair[0], third), Leg.of(of_pairs, third, pair[1])
    return None if to is None or fro is None else (to, fro)


def ways_round(i: int, j: int, to: Leg, fro: Leg) -> tuple[Float, Int, Int]:
    """Keyframes passed (Q,), and which closures of both legs are taken, for those nearest to keyframes i and j."""
    m = np.argsort(np.abs(to.i - i), kind="stable")[:NEAREST]
    n = np.argsort(np.abs(fro.j - j), kind="stable")[:NEAREST]
    m, n = (grid.ravel() for grid in np.meshgrid(m, n, indexing="ij"))
    steps = np.abs(to.i[m] - i) + np.abs(to.j[m] - fro.i[n]) + np.abs(fro.j[n] - j)
    return steps.astype(float), m, n


def _say(out: Predictions, k: int, places: Int, ways: tuple[Way, Way, Way], i: int, j: int, to: Leg, fro: Leg) -> None:
    """Write what ways round say of keyframes i and j into row k."""
    a, c, b = ways
    i_k, j_k = np.full(len(places), i), np.full(len(places), j)
    T_k_to = inverse(a.T[i_k]) @ a.T[to.i]
    T_k_third = T_k_to @ to.T
    T_k_fro = T_k_third @ inverse(c.T[to.j]) @ c.T[fro.i]
    T_k_b = T_k_fro @ fro.T
    T = T_k_b @ inverse(b.T[fro.j]) @ b.T[j_k]
    x = T[:, :3, 3]
    pieces = (
        a.variances(i_k, to.i, _moved(a.T[i_k], x)),
        c.variances(to.j, fro.i, _moved(c.T[to.j] @ inverse(T_k_third), x)),
        b.variances(fro.j, j_k, b.T[j_k][:, :3, 3]),
        _closure(to, x - T_k_third[:, :3, 3]),
        _closure(fro, x - T_k_b[:, :3, 3]),
    )
    rotation, translation = (np.sum([piece[n] for piece in pieces], axis=0) for n in (0, 1))
    out.R[k, places], out.t[k, places] = T[:, :3, :3], x
    out.rotation[k, places], out.least[k, places] = rotation, translation
    out.covariance[k, places] = (
        translation[:, None, None] * np.eye(3)
        + along(np.einsum("kij,kj->ki", T_k_to[:, :3, :3], to.u), to.length_sigma_m)
        + along(np.einsum("kij,kj->ki", T_k_fro[:, :3, :3], fro.u), fro.length_sigma_m)
    )
    out.there[k, places] = True


def _moved(T: Float, x: Float) -> Float:
    return np.asarray(np.einsum("kij,kj->ki", T[:, :3, :3], x) + T[:, :3, 3])


def _closure(leg: Leg, lever: Float) -> tuple[Float, Float]:
    """Variances of a closure's rotation, and of a point at the end of a lever (M, 3)."""
    return leg.rotation, leg.rotation * np.einsum("ki,ki->k", lever, lever) + leg.translation
