"""Condensed odometry: what a robot says of its block, and how a neighbour's block hangs together on its separators.

With other robots' separators held fixed, two robots that share many closures follow each other in small steps, each
held by where the other was: what bends both at once takes thousands of iterations. So a robot says, between each two
separators that follow each other in its log, the transform and the stiffness to which its odometry in between comes
(condensed measurements, Grisetti 2012). The transforms are such that they pull every separator as all of the robot's
own measurements do where it stands; hence wherever nothing moves any more, it is at a stationary point of the whole.
A neighbour lets these separators move with its own block, held where they were heard only as strongly as it chooses.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend import rbcd
from flocc_agent.backend.rbcd import Links
from flocc_agent.core.blocks import CondensedOdometry
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]

BEND_MAX = 0.5
"""Entries of a rotation by which a force may bend condensed odometry; it is said to be stiffer where it would more."""
STRETCH_MAX_M = 1e5


def condensed(
    log: LogId, separators: Sequence[int], odometry: Links, own: Links, X: Float
) -> tuple[CondensedOdometry, ...]:
    """What holds each separator but the first to the one before it.

    Args:
        log: Whose block.
        separators: Indices in it, rising.
        odometry: Its odometry, one edge per keyframe but the first.
        own: All measurements within the block, odometry included.
        X: (n, 4, r) where it stands.
    """
    forces = _forces(np.array(separators, dtype=np.int64), own, X)
    found = []
    pull = np.zeros(X.shape[1:])
    for k in range(len(separators) - 1, 0, -1):
        before, at = separators[k - 1], separators[k]
        stiffness = _stiffness(odometry, before, at)
        force = rbcd.projected(X[at][None], (forces[k] + pull)[None])[0]
        bend = np.linalg.solve(stiffness, force)
        excess = max(1.0, float(np.abs(bend[:3]).max()) / BEND_MAX, float(np.abs(bend[3]).max()) / STRETCH_MAX_M)
        stiffness = excess * stiffness
        transform = _carrying(X[before], X[at] - bend / excess)
        pull = transform.T @ stiffness @ (X[at] - transform @ X[before])
        found.append(CondensedOdometry(KeyframeId(log, before), transform, stiffness))
    return tuple(reversed(found))


def _forces(separators: Int, own: Links, X: Float) -> Float:
    """Gradient (m, 4, r) of a block's own measurements on its separators; the rest moves with the nearest of them."""
    if len(separators) == 0:
        return np.zeros((0, *X.shape[1:]))
    gradient = (rbcd.quadratic(len(X), own) @ X.reshape(-1, X.shape[2])).reshape(X.shape)
    gradient = rbcd.projected(X, gradient)
    indices = np.arange(len(X))
    after = np.clip(np.searchsorted(separators, indices), 0, len(separators) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(indices - separators[before] <= separators[after] - indices, before, after)
    forces = np.zeros((len(separators), *X.shape[1:]))
    np.add.at(forces, nearest, np.swapaxes(_relative(X[separators[nearest]], X), 1, 2) @ gradient)
    return np.asarray(rbcd.projected(X[separators], forces))


def _relative(X_a: Float, X_b: Float) -> Float:
    """Transforms (n, 4, 4) that carry lifted poses a (n, 4, r) to b, as far as they lie in the space of a's frame."""
    A = np.zeros((len(X_a), 4, 4))
    frames = np.swapaxes(X_a[:, :3], 1, 2)
    A[:, :3, :3] = X_b[:, :3] @ frames
    A[:, 3, :3] = ((X_b[:, 3] - X_a[:, 3])[:, None] @ frames)[:, 0]
    A[:, 3, 3] = 1.0
    return A


def _carrying(X_before: Float, X_at: Float) -> Float:
    """The transform (4, 4) that carries one lifted pose to another."""
    return np.asarray(_relative(X_before[None], X_at[None])[0])


def _stiffness(odometry: Links, before: int, at: int) -> Float:
    """Stiffness (4, 4) of the odometry between two keyframes; the bends of edges add up with their lever arms."""
    covariance = np.zeros((4, 4))
    for T, weight in zip(odometry.T[before:at], odometry.weight[before:at], strict=True):
        covariance = T.T @ covariance @ T + np.diag(1.0 / np.diag(weight))
    stiffness = np.linalg.inv(covariance)
    return np.asarray(0.5 * (stiffness + stiffness.T))


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Other robots' separators that move with a block.

    Attributes:
        index: Their indices, after those of the block.
        X: (m, 4, r) where they were heard.
        links: What holds them to each other.
    """

    index: Mapping[KeyframeId, int]
    X: Float
    links: Links


def surroundings(
    poses: int, heard: Mapping[KeyframeId, Float], condensed_odometry: Mapping[KeyframeId, CondensedOdometry], rank: int
) -> Surroundings:
    """Separators of robots that said everything that holds these together; others' stay where they were heard."""
    free = [keyframe for chain in _chains(heard).values() if _is_whole(chain, condensed_odometry) for keyframe in chain]
    index = {keyframe: poses + k for k, keyframe in enumerate(free)}
    held = [(keyframe, condensed_odometry[keyframe]) for keyframe in free if keyframe in condensed_odometry]
    held = [(keyframe, link) for keyframe, link in held if link.before in index]
    links = Links(
        np.array([index[link.before] for _, link in held], dtype=np.int64),
        np.array([index[keyframe] for keyframe, _ in held], dtype=np.int64),
        np.array([link.transform.T for _, link in held]).reshape(-1, 4, 4),
        np.array([link.stiffness for _, link in held]).reshape(-1, 4, 4),
        np.zeros((len(held), 4, rank)),
    )
    return Surroundings(index, np.array([heard[keyframe] for keyframe in free]).reshape(-1, 4, rank), links)


def _chains(heard: Mapping[KeyframeId, Float]) -> dict[LogId, list[KeyframeId]]:
    """Keyframes by robot, in order."""
    chains: dict[LogId, list[KeyframeId]] = {}
    for keyframe in sorted(heard):
        chains.setdefault(keyframe.log, []).append(keyframe)
    return chains


def _is_whole(chain: Sequence[KeyframeId], links: Mapping[KeyframeId, CondensedOdometry]) -> bool:
    """Whether what holds every separator to the one before it was heard."""
    return all(at in links and links[at].before == before for before, at in pairwise(chain))


def holds(indices: Int, X: Float, weight: Float) -> Links:
    """Measurements that hold poses of a block, with a weight (4, 4), where they are."""
    eyes, weights = np.broadcast_to(np.eye(4), (len(indices), 4, 4)), np.broadcast_to(weight, (len(indices), 4, 4))
    return Links(indices, np.full(len(indices), -1), np.asarray(eyes), np.asarray(weights), X[indices])
