"""Robots that ended in the wrong place, and where their rejected closures would put them.

A robot that few closures hold may be placed by a wrong one that came first, or be left alone: its shape is right, its
place is not. So every body (a robot, or robots that used closures join) is asked: is there a rigid motion with which
more of its closures agree than are used now? Where there is one, the solver starts again from there.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.alignment import (
    ROTATION_TOLERANCE_RAD,
    TRANSLATION_TOLERANCE_M,
    PairAlignment,
    align_pair,
    rays_from,
    travelled_m,
)
from flocc_agent.backend.edges import State
from flocc_agent.backend.problem import Problem
from flocc_agent.core.pose_graph import LoopClosure, Trajectory, components_of
from flocc_agent.geometry import angle_rad, quaternions
from flocc_protocol.ids import LogId

Bool = NDArray[np.bool_]
Float = NDArray[np.float64]
Int = NDArray[np.int64]

AGREEING_MIN = 2
HYPOTHESES_MAX = 200
KEPT_RATIO_MAX = 0.5
"""A place with which more of the used closures agree is the one where the body is, told less exactly,"""
MORE_RATIO = 1.5
"""unless so many more closures agree with it that the used ones may have bent the body."""
NEARLY_RATIO = 0.5
"""So many of the votes that hold a body are enough of unused closures to try the place that they agree on."""
UNUSED_RATIO_MIN = min(1.0 - KEPT_RATIO_MAX, MORE_RATIO - 1.0, NEARLY_RATIO)
"""Where unused closures have fewer of those votes, no place can be proposed by any of these rules."""


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """A body moved: the state, and the closures (L,) that would be used there."""

    body: frozenset[LogId]
    state: State
    chosen: Bool


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Proposes placements for one component.

    Attributes:
        problem: Poses, scales and edges as arrays.
        trajectories: Of its logs.
        closures: By their numbers.
        votes: (L,) of each closure.
        groups: (L,) number of its group, which shares votes.
        steepness: Of Eq. (2).
    """

    problem: Problem
    trajectories: Mapping[LogId, Trajectory]
    closures: Mapping[int, LoopClosure]
    votes: Float
    groups: Int
    steepness: float

    def proposals(self, state: State, chosen: Bool) -> Iterator[Placement]:
        """Placements with which more closures agree than are used, for closures (L,) that are chosen at a state.

        First where most of all closures would put a body, then where most of those would that are not used: a robot
        that a repeated facade holds is bent by the few right ones, and the cost says which of the two it is.
        """
        T = self._poses(state)
        path_m = {log: travelled_m(trajectory) for log, trajectory in self.trajectories.items()}
        for body in self._bodies(chosen):
            crossing = self._crossing(body)
            here = chosen & crossing
            if self.votes[crossing & ~chosen].sum() < UNUSED_RATIO_MIN * self.votes[here].sum():
                continue
            for asked, least_ratio in ((crossing, 1.0), (crossing & ~chosen, NEARLY_RATIO)):
                found = self._aligned(body, asked, T, path_m)
                if found is None or (least_ratio < 1.0 and not self._is_apart(body, T, found.T_a_b)):
                    continue
                agreeing = np.isin(self.problem.closure_ids, found.agreeing)
                there, now = self.votes[agreeing].sum(), self.votes[here].sum()
                elsewhere = self.votes[here & agreeing].sum() <= KEPT_RATIO_MAX * now
                if there > least_ratio * now and (elsewhere or there >= MORE_RATIO * now):
                    yield Placement(body, self._moved(state, body, found.T_a_b), (chosen & ~crossing) | agreeing)

    def _poses(self, state: State) -> dict[LogId, Float]:
        T, offsets = state.poses(), self.problem.offsets
        return {log: T[offsets[log] : offsets[log] + len(self.trajectories[log])] for log in self.problem.logs}

    def _bodies(self, chosen: Bool) -> list[frozenset[LogId]]:
        """Parts that chosen closures join more firmly than the rest, the loosest first, then robots alone.

        Pairs of robots fall away in the order of their votes: two robots that many closures join move together, where
        few hold both of them to the others. Last comes what a single pair of robots holds to the rest, however firmly:
        what hangs on a robot moves with it. The part with the anchor stays.
        """
        bodies: list[frozenset[LogId]] = []
        joining = self._joining(chosen)
        for firmness in (0.0, *sorted({votes for votes, _ in joining.values()})):
            firm = [closure for votes, closure in joining.values() if votes > firmness]
            bodies += [frozenset(group) for group in components_of(self.problem.logs, firm)[1:]]
        bodies += [frozenset((log,)) for log in self.problem.logs]
        bodies += self._hanging({pair: closure for pair, (_, closure) in joining.items()})
        return list(dict.fromkeys(bodies))

    def _hanging(self, joining: Mapping[frozenset[LogId], LoopClosure]) -> list[frozenset[LogId]]:
        """Parts that fall off where one pair of robots falls away."""
        before, found = set(components_of(self.problem.logs, list(joining.values()))), []
        for pair in spanning(joining):
            others = [closure for other, closure in joining.items() if other != pair]
            after = components_of(self.problem.logs, others)
            found += [frozenset(group) for group in after[1:] if group not in before]
        return found

    def _joining(self, chosen: Bool) -> dict[frozenset[LogId], tuple[float, LoopClosure]]:
        """Votes of the chosen closures of each two robots, and one of them."""
        joining: dict[frozenset[LogId], tuple[float, LoopClosure]] = {}
        for n in np.flatnonzero(chosen).tolist():
            closure = self.closures[self.problem.closure_ids[n]]
            pair = frozenset((closure.query.log, closure.match.log))
            before, _ = joining.get(pair, (0.0, closure))
            joining[pair] = before + float(self.votes[n]), closure
        return {pair: found for pair, found in joining.items() if len(pair) > 1}

    def _crossing(self, body: frozenset[LogId]) -> Bool:
        """Closures (L,) between a body and the rest."""
        ends = [self.closures[k] for k in self.problem.closure_ids]
        return np.array([(c.query.log in body) != (c.match.log in body) for c in ends], dtype=bool)

    def _aligned(
        self, body: frozenset[LogId], asked: Bool, T: Mapping[LogId, Float], path_m: Mapping[LogId, Float]
    ) -> PairAlignment | None:
        ids = [k for k, on in zip(self.problem.closure_ids, asked, strict=True) if on]
        if len(ids) < AGREEING_MIN:
            return None
        ends = {}
        for k in ids:
            query, match = self.closures[k].query, self.closures[k].match
            ends[k] = (match, query) if query.log in body else (query, match)
        rays = rays_from(ids, self.closures, ends, T, path_m, self.steepness)
        votes = self.votes[np.isin(self.problem.closure_ids, ids)]
        judges = replace(rays, weight=rays.weight * votes, travelled_a_m=np.zeros(len(ids)))
        found = align_pair(judges, HYPOTHESES_MAX)
        return found if len(found.agreeing) >= AGREEING_MIN else None

    def _is_apart(self, body: frozenset[LogId], T: Mapping[LogId, Float], T_move: Float) -> bool:
        """Whether a motion leads to another place, beyond what two alignments of one place may differ by."""
        t = np.concatenate([T[log][:, :3, 3] for log in sorted(body)])
        moved_m = float(np.median(np.linalg.norm(t @ T_move[:3, :3].T + T_move[:3, 3] - t, axis=1)))
        turned_rad = angle_rad(T_move[:3, :3])
        return moved_m > 2.0 * TRANSLATION_TOLERANCE_M or turned_rad > 2.0 * ROTATION_TOLERANCE_RAD

    def _moved(self, state: State, body: frozenset[LogId], T_move: Float) -> State:
        T = state.poses()
        for log in body:
            rows = slice(self.problem.offsets[log], self.problem.offsets[log] + len(self.trajectories[log]))
            T[rows] = T_move @ T[rows]
        return State(quaternions(T[:, :3, :3]), T[:, :3, 3].copy(), state.scale)


def spanning(pairs: Iterable[frozenset[LogId]]) -> list[frozenset[LogId]]:
    """Those of the pairs that join what the ones before them did not."""
    group: dict[LogId, LogId] = {}
    found = []
    for pair in pairs:
        low, high = sorted(group.setdefault(log, log) for log in pair)
        if low != high:
            found.append(pair)
            group = {log: low if now == high else now for log, now in group.items()}
    return found
