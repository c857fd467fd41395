"""Joins of two logs that rest on one place: what odometry foretells of their surroundings, and what was found there.

Houses repeat. Closures of two places that look alike agree with each other as right ones do, and no solver tells them
from right ones where nothing else joins the two ways. What tells is beside them. A right join foretells where else the
two ways run side by side with cameras that look the same way, and there pictures match; beside a twin they do not. And
a keyframe that was registered with two of one robot which odometry puts far apart shows that its place is not the only
one of its kind.

So as long as no closures of two places agree, two logs are joined *tentatively*. Their owners ask for pairs beside the
closures, a few at a time and the nearest first, and the join is doubted where most of what is beside it was registered
and refused, or where another closure puts one end of it elsewhere. All of it follows from logs alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.spared import AGREE_LENGTHS, AGREE_RAD, AGREE_RATIO, AGREE_STEPS, STRETCH
from flocc_agent.geometry import inverse

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

PLACE_KEYFRAMES = 2 * STRETCH
"""Keyframes of a log from the first to the last of one place."""
BESIDE_STEPS = 1.5
"""Two keyframes are side by side that are at most so many steps of the robots apart."""
BESIDE_RAD = float(np.radians(20.0))
"""And look the same way within this."""
REACH = 12
"""Keyframes before and after a place in which what is beside it is looked for; farther off odometry drifts."""
NEIGHBOURS = 1
"""A closure so many keyframes before or after, at both ends, counts for a pair."""
SPACING = 2
"""Keyframes between two pairs that say something each."""
REFUSED_MIN = 3
"""Fewer refused pairs beside a join say nothing."""
SEEN_TWICE = 2.0
"""Times as far apart as both closures reach; scales by Eq. (6) are off by a tenth or two, odometry by less."""
DRIFT_RATIO = 0.1
"""Of the way between two keyframes, by which odometry may be off besides."""
ACCIDENT_RATIO = 0.1
"""More closures that contradict a join than this part of its own are no accident: one in a hundred is wrong."""
AGREE_TIMES_MAX = 3.0
"""Rotations may differ by so many times more at most where odometry carries them far."""
FIRM_MIN = 3
"""Closures that agree of more than one place."""
CLOSURES_MAX = 128
"""Between two logs; more are of more than one place."""


@dataclass(frozen=True, slots=True, eq=False)
class Between:
    """Closures between two logs, the lower one's keyframes first.

    Attributes:
        ends: (K, 2) indices of their keyframes.
        T_low: (K, 4, 4) T_odom_camera of the lower log's.
        T_high: (K, 4, 4) of the higher log's.
        T_low_high: (K, 4, 4) what they say, metric; as long as a step where they have no length.
        has_length: (K,) whether they have one.
        steps_m: (K,) how far apart keyframes of both logs are around each, in the mean.
    """

    ends: Int
    T_low: Float
    T_high: Float
    T_low_high: Float
    has_length: Bool
    steps_m: Float

    @property
    def lengths_m(self) -> Float:
        """How far apart the cameras of each are (K,)."""
        return np.asarray(np.linalg.norm(self.T_low_high[:, :3, 3], axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Keyframes of a log: the first one's number, and T_odom_camera (N, 4, 4)."""

    first: int
    T: Float


@dataclass(frozen=True, slots=True)
class Join:
    """Closures that agree: their rows, and the one with which all agree."""

    rows: tuple[int, ...]
    middle: int


@dataclass(frozen=True, slots=True)
class FoundBeside:
    """What is beside a join, each pair some keyframes from the next.

    Attributes:
        closed: How many have a closure.
        refused: How many were registered and have none.
        open: The others, the nearest first.
    """

    closed: int
    refused: int
    open: tuple[tuple[int, int], ...]

    @property
    def is_against(self) -> bool:
        """Whether what was found there says that the two ways do not run side by side."""
        return self.refused >= REFUSED_MIN and self.refused > self.closed


def joins_of(between: Between, agree: Bool) -> list[Join]:
    """Closures by groups that agree with one of theirs, the largest first."""
    left = np.ones(len(between.ends), dtype=bool)
    joins: list[Join] = []
    while np.any(left):
        middle = int(((agree & left[None, :]).sum(axis=1) * left).argmax())
        rows = np.flatnonzero(agree[middle] & left)
        joins.append(Join(tuple(rows.tolist()), middle))
        left[rows] = False
    return joins


def agreement(between: Between) -> Bool:
    """Which closures (K, K) say the same of each other's keyframes, as far as odometry between them tells."""
    T_low, T_high, T = between.T_low, between.T_high, between.T_low_high
    T_odoms = T_low @ T @ inverse(T_high)
    foretold = inverse(T_low)[None, :] @ T_odoms[:, None] @ T_high[None, :]
    cosines = (np.einsum("klij,lij->kl", foretold[..., :3, :3], T[:, :3, :3]) - 1.0) / 2.0
    apart_m = np.linalg.norm(foretold[..., :3, 3] - T[None, :, :3, 3], axis=2)
    lengths_m, carried_m = between.lengths_m, _chords_m(T_low) + _chords_m(T_high)
    each_m = np.where(between.has_length, AGREE_LENGTHS, 1.0) * lengths_m + AGREE_STEPS * between.steps_m
    may_m = each_m[:, None] + each_m[None, :] + AGREE_RATIO * carried_m
    may_rad = AGREE_RAD * np.minimum(1.0 + AGREE_RATIO * carried_m, AGREE_TIMES_MAX)
    return np.asarray((cosines >= np.cos(may_rad)) & (apart_m <= may_m)) | np.eye(len(T), dtype=bool)


def is_firm(between: Between, agree: Bool) -> bool:
    """Whether closures that agree with one of them are of more than one place, of both logs.

    More closures leave that true, so that it does not depend on their order.
    """
    first = np.where(agree[..., None], between.ends[None], np.iinfo(np.int64).max).min(axis=1)
    last = np.where(agree[..., None], between.ends[None], -1).max(axis=1)
    places = (last - first).min(axis=1) > PLACE_KEYFRAMES
    return bool(np.any(places & (agree.sum(axis=1) >= FIRM_MIN)))


def may_contradict(ends: Int) -> bool:
    """Whether any of closures with such ends (K, 2) could see the place of another at one end and not at the other."""
    near = np.abs(ends[:, None] - ends[None]) <= STRETCH
    return bool(np.any(near[..., 0] != near[..., 1]))


def contradicting(between: Between, join: Join) -> list[tuple[int, int, int]]:
    """Closures that see the place of a join at one end and, by odometry, another place at the other end.

    Returns:
        Of each: its row, a row of the join that it contradicts, and of which log the place is, 0 of the lower one.
    """
    lengths_m, own = between.lengths_m, list(join.rows)
    found: list[tuple[int, int, int]] = []
    for other in sorted(set(range(len(between.ends))) - set(own)):
        keyframes = np.abs(between.ends[own] - between.ends[other])
        apart_m = np.stack([_from_m(T, own, other) for T in (between.T_low, between.T_high)], axis=1)
        near_m, far_m, far = apart_m, apart_m[:, ::-1], keyframes[:, ::-1]
        reach_m = (lengths_m[own] + lengths_m[other])[:, None] + near_m
        steps_m = np.maximum(between.steps_m[own], between.steps_m[other])[:, None]
        elsewhere = far_m > SEEN_TWICE * reach_m + DRIFT_RATIO * steps_m * far
        rows, ends = np.nonzero((keyframes <= STRETCH) & (far > STRETCH) & elsewhere)
        if len(rows):
            found.append((other, own[int(rows[0])], int(ends[0])))
    return found


def stretch_of(between: Between, join: Join, log: int, count: int) -> range:
    """Keyframes of a log, the lower one or the higher one, in which what is beside a join is looked for."""
    ends = between.ends[list(join.rows), log]
    return range(max(int(ends.min()) - REACH, 0), min(int(ends.max()) + REACH + 1, count))


def beside(between: Between, join: Join, around: tuple[Stretch, Stretch], refused: Int) -> FoundBeside:
    """What a join foretells, and what was found there.

    Args:
        between: All closures.
        join: Some that agree.
        around: The lower log and the higher one around it.
        refused: (R, 2) keyframes of pairs that were registered and are no closures.
    """
    k, (low, high) = join.middle, around
    T_there = between.T_low[k] @ between.T_low_high[k] @ inverse(between.T_high[k]) @ high.T
    apart_m = np.linalg.norm(low.T[:, None, :3, 3] - T_there[None, :, :3, 3], axis=2)
    cosines = low.T[:, :3, 2] @ T_there[:, :3, 2].T
    i, j = np.nonzero((apart_m <= BESIDE_STEPS * between.steps_m[k]) & (cosines >= np.cos(BESIDE_RAD)))
    pairs = np.stack([i + low.first, j + high.first], axis=1)
    from_middle = np.abs(pairs - between.ends[k]).max(axis=1)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], np.round(apart_m[i, j], 3), from_middle))
    return _told(pairs[order], between.ends[list(join.rows)], refused)


def _told(pairs: Int, closed: Int, refused: Int) -> FoundBeside:
    """Of pairs in their order, those that say something each."""
    taken: list[Int] = []
    wanted: list[tuple[int, int]] = []
    closed_pairs = refused_pairs = 0
    for pair in pairs:
        if taken and np.abs(np.array(taken) - pair).min() < SPACING:
            continue
        taken.append(pair)
        near = pairs[np.abs(pairs - pair).max(axis=1) < SPACING]
        if np.any(np.abs(closed - pair).max(axis=1) <= NEIGHBOURS):
            closed_pairs += 1
        elif np.any(of_pair := (near[:, None] == refused[None]).all(axis=2).any(axis=0)):
            refused_pairs += 1
            refused = refused[~of_pair]
        else:
            wanted.append((int(pair[0]), int(pair[1])))
    return FoundBeside(closed_pairs, refused_pairs, tuple(wanted))


def _chords_m(T: Float) -> Float:
    """How far apart (K, K) poses are."""
    return np.asarray(np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=2))


def _from_m(T: Float, rows: list[int], other: int) -> Float:
    return np.asarray(np.linalg.norm(T[rows, :3, 3] - T[other, :3, 3], axis=1))
