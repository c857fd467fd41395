"""What closures around two keyframes foretell of a registration of the pair.

Directly: a closure between the same stretches of both ways, and odometry from its keyframes to the pair's. By a third
way: a closure from the one stretch to a third log, that one's odometry, and a closure from there to the other stretch;
in a large team each pair of robots has few closures, and many by way of others. A third log says it once, by the two
closures that odometry has least to add to, so that a robot which sees much tells no more than one witness does.
All of it follows from records, in whatever order they came.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.closure_rows import ClosureTable, End
from flocc_agent.core.spared import AGREE_LENGTHS, AGREE_RATIO, AGREE_STEPS, Foretold
from flocc_agent.geometry import inverse, poses_from_tq
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CandidatePair

Float = NDArray[np.float64]

CHAINS_MAX = 8
"""Of each kind, those that odometry has least to add to; of a pair that is told they are more than enough."""


class OdometryRows(Protocol):
    """Odometry of one log."""

    def __len__(self) -> int: ...

    def tq(self, indices: Sequence[int]) -> Float:
        """`T_odom_keyframe` of some keyframes as rows (K, 7): translation x y z, quaternion w x y z."""
        ...


class _Chain(NamedTuple):
    """One way from a pair's earlier keyframe to its later one; the shortest comes first.

    Attributes:
        steps: How many keyframes odometry goes along.
        low: The closure that leads from the earlier stretch.
        high: The one that leads from the later stretch to the third log; None: `low` leads there itself.
    """

    steps: int
    low: End
    high: End | None

    @property
    def order(self) -> tuple[int, int, KeyframeId, int, int]:
        """The same for whatever order closures became known in."""
        back = (0, 0) if self.high is None else (self.high.far.index, self.high.near)
        return self.steps, self.low.near, self.low.far, *back


class Foretelling:
    """What the closures that one robot knows foretell."""

    def __init__(
        self,
        closures: ClosureTable,
        track: Callable[[LogId], OdometryRows | None],
        known: Callable[[KeyframeId], bool],
    ) -> None:
        """Start with what is known.

        Args:
            closures: Those that count.
            track: Odometry of a log.
            known: Whether a keyframe is.
        """
        self._closures = closures
        self._track = track
        self._known = known

    def logs(self) -> int:
        """How many logs closures are of."""
        return self._closures.logs_count()

    def mark(self, keyframe: KeyframeId, reach: int) -> int:
        """A number of the closures of a stretch that is another one when these change."""
        return self._closures.mark(keyframe.log, max(keyframe.index - reach, 0), keyframe.index + reach + 1)

    def density(self, keyframe: KeyframeId, reach: int) -> float:
        """Ends of closures for each keyframe of a stretch, whatever log is at their other ends."""
        track = self._track(keyframe.log)
        if track is None or not self._known(keyframe):
            return 0.0
        first, end = max(keyframe.index - reach, 0), min(keyframe.index + reach + 1, len(track))
        return self._closures.ends(keyframe.log, first, end) / (end - first)

    def foretold(self, pair: CandidatePair, reach: int, least: int = 1) -> Foretold:
        """What closures whose keyframes are known say of a pair, at most so many keyframes from it at both ends.

        Nothing where there are fewer ways than the least that matters.
        """
        if not self._known(pair.low) or not self._known(pair.high):
            return Foretold.nothing(is_whole=False)
        around = self._stretch(pair.low, reach), self._stretch(pair.high, reach)
        both = zip((pair.low.log, pair.high.log), around, strict=True)
        low, high = ([end for end in ends if self._is_known(log, end)] for log, ends in both)
        is_whole = len(low) + len(high) == sum(map(len, around))
        chains = self._direct(pair, low, reach) + self._by_third(pair, low, high, reach)
        if len(chains) < max(least, 1):
            return Foretold.nothing(is_whole)
        return self._said(pair, chains, is_whole)

    def _stretch(self, keyframe: KeyframeId, reach: int) -> list[End]:
        log, index = keyframe
        return self._closures.near(log, max(index - reach, 0), index + reach + 1)

    def _is_known(self, log: LogId, end: End) -> bool:
        return self._known(KeyframeId(log, end.near)) and self._known(end.far)

    def _direct(self, pair: CandidatePair, low: list[End], reach: int) -> list[_Chain]:
        """Closures between both stretches, those beside the pair first."""
        log, at = pair.high
        found = [
            _Chain(abs(end.near - pair.low.index) + abs(end.far.index - at), end, None)
            for end in low
            if end.far.log == log and abs(end.far.index - at) <= reach
        ]
        return _shortest(found)

    def _by_third(self, pair: CandidatePair, low: list[End], high: list[End], reach: int) -> list[_Chain]:
        """The shortest chain of each third log."""
        own = {pair.low.log, pair.high.log}
        of_log: dict[LogId, list[End]] = {}
        for end in high:
            if end.far.log not in own:
                of_log.setdefault(end.far.log, []).append(end)
        best: dict[LogId, _Chain] = {}
        for end in low:
            for back in of_log.get(end.far.log, ()):
                apart = abs(end.far.index - back.far.index)
                if apart > 2 * reach:
                    continue
                steps = apart + abs(end.near - pair.low.index) + abs(back.near - pair.high.index)
                held, chain = best.get(end.far.log), _Chain(steps, end, back)
                if held is None or steps < held.steps or (steps == held.steps and chain.order < held.order):
                    best[end.far.log] = chain
        return _shortest(list(best.values()))

    def _said(self, pair: CandidatePair, chains: list[_Chain], is_whole: bool) -> Foretold:
        """The poses along chains, and how far off each may be."""
        backs = [chain.high for chain in chains if chain.high is not None]
        direct = len(chains) - len(backs)
        T_there = self._closures.seen(pair.low.log, [chain.low for chain in chains])
        T_third, T_back = _nothing(len(chains)), _nothing(len(chains))
        if backs:
            T_back[direct:] = inverse(self._closures.seen(pair.high.log, backs))
        lasts = [chain.low.far.index if chain.high is None else chain.high.near for chain in chains]
        thirds = [(c.low.far.log, [c.low.far.index, c.high.far.index]) for c in chains if c.high is not None]
        of_pair = [self._beside(pair.low, [chain.low.near for chain in chains]), self._beside(pair.high, lasts)]
        T = poses_from_tq(np.concatenate([self._tq(log, indices) for log, indices in (*of_pair, *thirds)]))
        (T_low, T_high), T_thirds = np.split(T[: 4 + 2 * len(chains)], 2), T[4 + 2 * len(chains) :]
        T_third[direct:] = inverse(T_thirds[::2]) @ T_thirds[1::2]
        T_low, T_high = inverse(T_low[:1]) @ T_low[1:], inverse(T_high[:1]) @ T_high[1:]
        moved_m = _lengths_m(T_low[1:]) + _lengths_m(T_third) + _lengths_m(T_high[1:])
        steps_m = float(_lengths_m(T_low[:1])[0] + _lengths_m(T_high[:1])[0]) / 2
        may_m = AGREE_LENGTHS * (_lengths_m(T_there) + _lengths_m(T_back)) + AGREE_RATIO * moved_m
        T_low_high = T_low[1:] @ T_there @ T_third @ T_back @ inverse(T_high[1:])
        return Foretold(T_low_high, may_m + AGREE_STEPS * steps_m, is_whole)

    def _beside(self, keyframe: KeyframeId, others: list[int]) -> tuple[LogId, list[int]]:
        """A keyframe, the one before it or after it, and others of its log."""
        (log, index), track = keyframe, self._track(keyframe.log)
        assert track is not None, "the keyframe is known"
        return log, [index, index - 1 if index else min(1, len(track) - 1), *others]

    def _tq(self, log: LogId, indices: list[int]) -> Float:
        track = self._track(log)
        assert track is not None, "its keyframes are known"
        return track.tq(indices)


def _shortest(chains: list[_Chain]) -> list[_Chain]:
    return sorted(chains, key=lambda chain: chain.order)[:CHAINS_MAX]


def _nothing(count: int) -> Float:
    return np.tile(np.eye(4), (count, 1, 1))


def _lengths_m(T: Float) -> Float:
    return np.asarray(np.linalg.norm(T[:, :3, 3], axis=1))
