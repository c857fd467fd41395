"""Condensed odometry: it pulls separators as the block's own measurements do, and only where all of it was heard."""

import numpy as np

from flocc_agent.backend import rbcd
from flocc_agent.backend.condensed import condensed, surroundings
from flocc_agent.backend.rbcd import Block, Links
from flocc_agent.geometry import pose, so3_exp
from flocc_protocol.ids import KeyframeId, LogId

A, SEPARATORS = LogId("a"), (1, 4, 5)


def chain(rng: np.random.Generator, poses: int = 7) -> Links:
    T = np.array([pose(so3_exp(0.3 * rng.normal(size=3)), rng.normal(size=3)) for _ in range(poses - 1)])
    before = np.arange(poses - 1)
    weight = rbcd.diagonal_weights(rng.uniform(1.0, 4.0, poses - 1), rng.uniform(1.0, 4.0, poses - 1))
    return Links(before, before + 1, T, weight, np.zeros((poses - 1, 4, 3)))


def test_it_pulls_every_separator_as_all_own_measurements_do() -> None:
    rng = np.random.default_rng(1)
    odometry = chain(rng)
    X = rng.normal(size=(7, 4, 3))
    X[:, :3] = rbcd.orthonormal(X[:, :3])
    said = condensed(A, range(7), odometry, odometry, X)
    keyframes = [KeyframeId(A, index) for index in range(7)]
    heard = dict(zip(keyframes, X, strict=True))
    near = surroundings(0, heard, dict(zip(keyframes[1:], said, strict=True)), 3)
    assert np.allclose(Block(7, near.links).gradient(near.X), Block(7, odometry).gradient(X))


def test_separators_whose_condensed_odometry_was_lost_do_not_move() -> None:
    odometry = chain(np.random.default_rng(2))
    X = np.repeat(np.eye(4, 3)[None], 7, axis=0)
    said = condensed(A, SEPARATORS, odometry, odometry, X)
    heard = {KeyframeId(A, index): X[index] for index in SEPARATORS}
    assert surroundings(9, heard, {KeyframeId(A, 5): said[1]}, 3).index == {}
    whole = surroundings(9, heard, {KeyframeId(A, 4): said[0], KeyframeId(A, 5): said[1]}, 3)
    assert whole.index == {KeyframeId(A, 1): 9, KeyframeId(A, 4): 10, KeyframeId(A, 5): 11}
