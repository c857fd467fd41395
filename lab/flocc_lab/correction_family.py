"""A drawn family of corrections, honest and lying: `python -m flocc_lab.correction_family DRAWS [FIRST]`.

Each member is one robot's way of 20 to 2,000 m, which its odometry tells 0.7 to 1.4 times as long, with 5 % of drift
and without up to five rides of 2 to 50 m; closures with itself and up to three others that passed the same places, some
of them false, or fixes. Others may have missed a ride, too. An honest leader puts the robot where it was, as far as
anything was measured there; a lying one moves all of it, a part, its last poses, stretches or bends it, at once or by
little each round.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.closure_rows import Tie, length_m, tie_of
from flocc_agent.core.correction_evidence import TIES_MIN, Placed
from flocc_agent.core.knots import Track, knots_of
from flocc_agent.core.plausibility import contradiction
from flocc_agent.core.pose_graph import WORLD, MeasuredFactor, landmark
from flocc_agent.geometry import Float, pose
from flocc_protocol.ids import KeyframeId, LogId, Term
from flocc_protocol.messages import LogCorrection
from flocc_protocol.records import ClosureRecord

OWN = LogId("m")
LEADER = LogId("x")
SEEN_M = 4.0
FALSE_RATIO, FIXED_RATIO = 0.15, 0.3
DRIFT_RAD = 0.1
OTHERS_RIDE_RATIO = 0.3
LIE_M = (30.0, 1000.0)
ROUND_M = (0.5, 5.0)
"""By how much a slow lie grows in one round."""


@dataclass(eq=False)
class Planar:
    """A way on the plane: positions (N, 2) and headings (N,)."""

    at_m: Float
    heading_rad: Float

    def poses(self) -> Float:
        """(N, 4, 4)."""
        c, s = np.cos(self.heading_rad), np.sin(self.heading_rad)
        T = np.tile(np.eye(4), (len(self.at_m), 1, 1))
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
        T[:, :2, 3] = self.at_m
        return T

    def moved(self, first: int, last: int, by_m: Float) -> "Planar":
        """With the keyframes of a part elsewhere."""
        at_m = self.at_m.copy()
        at_m[first:last] += by_m
        return Planar(at_m, self.heading_rad)


def chained(start_m: Float, start_rad: float, steps_m: Float, turns_rad: Float) -> Planar:
    """The way that steps (N-1, 2), each in the frame of where it begins, and turns (N-1,) lead."""
    heading = start_rad + np.concatenate([[0.0], np.cumsum(turns_rad)])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    world = np.stack([c * steps_m[:, 0] - s * steps_m[:, 1], s * steps_m[:, 0] + c * steps_m[:, 1]], axis=1)
    return Planar(start_m + np.concatenate([np.zeros((1, 2)), np.cumsum(world, axis=0)]), heading)


@dataclass(eq=False)
class CorrectedRobot:
    """One robot, what it holds, and where an honest leader puts it.

    Attributes:
        others: Corrections of the other logs, as their owners have them.
        in_short: Of which of them the robot knows the newest pose only, until it asks for the rest.
    """

    rides: int
    step_m: float
    solution: Planar
    tied: NDArray[np.integer]
    anchor: LogId
    odometries: dict[LogId, Float]
    closures: list[ClosureRecord]
    fixes: list[MeasuredFactor]
    others: dict[LogId, LogCorrection]
    in_short: frozenset[LogId]

    def odometry(self, log: LogId) -> Float:
        """T_odom_camera (N, 4, 4)."""
        return self.odometries.get(log, np.empty((0, 4, 4)))

    def ties(self, log: LogId, ties_max: int) -> Sequence[Tie]:
        """The newest ones."""
        newest = [c for c in reversed(self.closures) if log in (c.query.log, c.match.log)][:ties_max]
        return [tie_of(log, c.query, c.match, length_m(c)) for c in newest]

    def measured(self, log: LogId) -> Sequence[MeasuredFactor]:
        """Fixes."""
        return self.fixes if log == OWN else ()

    def joined(self, log: LogId, other: LogId) -> bool:  # noqa: ARG002
        """They are."""
        return True

    def placed(self, solution: Planar, asked: bool = False) -> Placed:
        """The correction that says so, with what is known of the others, before or after they were asked."""
        short = frozenset() if asked else self.in_short
        known = {log: replace(c, knots=None) if log in short else c for log, c in self.others.items()}
        return Placed(told(OWN, self.anchor, self.odometries[OWN], solution.poses()), known)

    def contradicts(self, solution: Planar, before: Planar | None = None) -> str | None:
        """What speaks against a correction, also once the others' poses came, for which a robot then asks."""
        for asked in (False, True) if self.in_short else (False,):
            last = None if before is None else self.placed(before, asked)
            why = contradiction(self.placed(solution, asked), last, self)
            if why is None:
                return None
        return why


def told(log: LogId, anchor: LogId, T_odom: Float, T_map: Float) -> LogCorrection:
    """A correction as a leader tells it."""
    T_map_odom = T_map[-1] @ np.linalg.inv(T_odom[-1])
    as_told, knots = knots_of(Track(T_odom, T_map, T_map_odom, None))
    return LogCorrection(log, Term(1, LEADER), 1, anchor, as_told, knots)


def drawn(rng: np.random.Generator, rides: int) -> CorrectedRobot:
    """One member."""
    step_m = float(rng.uniform(0.4, 2.0))
    n = max(20, int(np.exp(rng.uniform(np.log(20.0), np.log(2000.0))) / step_m))
    steps = np.zeros((n - 1, 2))
    steps[:, 0] = step_m * rng.uniform(0.3, 1.2, n - 1)
    turns = rng.normal(0.0, 0.08, n - 1)
    at = np.sort(rng.choice(np.arange(2, n - 3), rides, replace=False))
    carried, turned = steps.copy(), turns.copy()
    towards = rng.uniform(0.0, 2 * np.pi, rides)
    carried[at] += (rng.uniform(2.0, 50.0, rides) * np.array([np.cos(towards), np.sin(towards)])).T
    turned[at] += rng.uniform(-np.pi, np.pi, rides)
    truth = chained(np.zeros(2), 0.0, carried, turned)
    odometry = chained(np.zeros(2), 0.0, *_drifted(rng, steps, turns, (0.7, 1.4))).poses()
    odometries, closures, others = {OWN: odometry}, list[ClosureRecord](), dict[LogId, LogCorrection]()
    in_short = set[LogId]()
    is_anchor = rng.random() < 0.3
    closures += _revisits(rng, truth)
    if not is_anchor or rng.random() < 0.7:
        for k in range(int(rng.integers(1, 4))):
            other = LogId("nop"[k] if is_anchor else "anz"[k])
            closures += _met(rng, truth, other, odometries, others)
            if rng.random() < 0.5:
                in_short.add(other)
    anchor = OWN if is_anchor else LogId("a")
    others = {log: LogCorrection(log, c.term, 1, anchor, c.T_map_odom, c.knots) for log, c in others.items()}
    near = [c.query.index for c in closures if c.query.log == OWN and c.match.log != OWN]
    tied = np.unique([*near, *([0] if is_anchor else []), *([] if near or is_anchor else [0])])
    fixes = _fixed(rng, truth, int(tied[0])) if rng.random() < FIXED_RATIO else []
    closures = _with_false(rng, closures, {log: len(o) for log, o in odometries.items()})
    solution, tied = _solved(rng, truth, steps, turns, at, tied, closures, fixes)
    noise = 0.2 * np.cumsum(rng.normal(size=(n, 2)), axis=0) / np.sqrt(n)
    return CorrectedRobot(
        rides,
        step_m,
        Planar(solution.at_m + noise - noise[0], solution.heading_rad),
        tied,
        anchor,
        odometries,
        closures,
        fixes,
        others,
        frozenset(in_short),
    )


def _drifted(rng: np.random.Generator, steps: Float, turns: Float, scales: tuple[float, float]) -> tuple[Float, Float]:
    n = len(turns)
    drift = rng.normal(0.0, DRIFT_RAD) / n + rng.normal(0.0, DRIFT_RAD, n) / np.sqrt(n)
    return steps * np.exp(rng.uniform(*np.log(scales))), turns + drift


def _closure(one: KeyframeId, other: KeyframeId, length_m: float) -> ClosureRecord:
    t = (max(length_m, 1e-3), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    return ClosureRecord(one, other, _pose7(t), 60, 100, 0.6, 1.0)


def _pose7(tq: tuple[float, ...]) -> tuple[float, float, float, float, float, float, float]:
    x, y, z, a, b, c, d = tq
    return (x, y, z, a, b, c, d)


def _revisits(rng: np.random.Generator, truth: Planar) -> list[ClosureRecord]:
    some = np.sort(rng.choice(len(truth.at_m), min(len(truth.at_m), 300), replace=False))
    apart_m = np.linalg.norm(truth.at_m[some, None] - truth.at_m[None, some], axis=2)
    i, j = np.nonzero((apart_m < SEEN_M) & (some[:, None] - some[None] > 30))
    chosen = rng.choice(len(i), min(len(i), int(rng.integers(0, 15))), replace=False)
    return [
        _closure(KeyframeId(OWN, int(some[i[k]])), KeyframeId(OWN, int(some[j[k]])), float(apart_m[i[k], j[k]]))
        for k in chosen
    ]


def _met(
    rng: np.random.Generator,
    truth: Planar,
    other: LogId,
    odometries: dict[LogId, Float],
    others: dict[LogId, LogCorrection],
) -> list[ClosureRecord]:
    """Another robot passes some of the places, in their order or backwards."""
    n = len(truth.at_m)
    meetings = int(rng.integers(1, max(2, min(40, n // 3))))
    first, last = np.sort(rng.integers(0, n, 2)) if rng.random() < 0.3 else (0, n - 1)
    near = np.unique(rng.integers(first, last + 1, meetings))[:: -1 if rng.random() < 0.4 else 1]
    places = truth.at_m[near] + rng.uniform(-1.0, 1.0, (len(near), 2)) * SEEN_M / 2
    way = [np.asarray(places[0] + rng.uniform(-10.0, 10.0, 2))]
    ends = []
    for place in places:
        gap = place - way[-1]
        count = max(1, int(np.linalg.norm(gap) / 1.0))
        way += list(way[-1] + gap * np.arange(1, count + 1)[:, None] / count)
        ends.append(len(way) - 1)
    at = np.array(way)
    moves = np.diff(at, axis=0)
    heading = np.arctan2(moves[:, 1], moves[:, 0])
    heading = np.concatenate([heading, heading[-1:]])
    lengths = np.linalg.norm(moves, axis=1)
    true = Planar(at, heading)
    steps, turns = np.stack([lengths, np.zeros(len(lengths))], axis=1), np.diff(heading)
    if rng.random() < OTHERS_RIDE_RATIO and len(steps) > 1:
        k = int(rng.integers(len(steps)))
        steps[k : k + int(rng.uniform(2.0, 50.0))] = 0.0
    steps, turns = _drifted(rng, steps, turns, (0.85, 1.2))
    odometries[other] = chained(at[0], float(heading[0]), steps, turns).poses()
    others[other] = told(other, other, odometries[other], true.poses())
    apart = np.linalg.norm(at[ends] - truth.at_m[near], axis=1)
    pairs = zip(near.tolist(), ends, apart.tolist(), strict=True)
    return [_closure(KeyframeId(OWN, i), KeyframeId(other, j), m) for i, j, m in pairs]


def _fixed(rng: np.random.Generator, truth: Planar, first: int) -> list[MeasuredFactor]:
    turn = rng.uniform(0, 2 * np.pi)
    some = np.unique([first, *rng.integers(0, len(truth.at_m), int(rng.integers(2, 40)))])
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    factors = []
    for k in some.tolist():
        at = np.array([*(R @ truth.at_m[k] + rng.normal(0.0, 1.0, 2)), 0.0])
        own = KeyframeId(OWN, k)
        factors.append(MeasuredFactor("fix", own, landmark(WORLD), own, pose(np.eye(3), at), np.eye(3)))
    return factors


def _with_false(
    rng: np.random.Generator, closures: list[ClosureRecord], lengths: dict[LogId, int]
) -> list[ClosureRecord]:
    found = list(closures)
    for each in closures:
        if rng.random() < FALSE_RATIO:
            one = KeyframeId(OWN, int(rng.integers(lengths[OWN])))
            two = KeyframeId(each.match.log, int(rng.integers(lengths[each.match.log])))
            if one != two:
                found.append(_closure(one, two, 1.0))
    return [found[k] for k in rng.permutation(len(found))]


def _solved(
    rng: np.random.Generator,
    truth: Planar,
    steps: Float,
    turns: Float,
    rides: NDArray[np.integer],
    tied: NDArray[np.integer],
    closures: list[ClosureRecord],
    fixes: list[MeasuredFactor],
) -> tuple[Planar, NDArray[np.integer]]:
    """Where something says so the truth, elsewhere what odometry tells from there; a ride may be spread over its gap.

    A closure of the robot with itself ties both of its ends where one of them is tied; others are taken out.
    """
    edges = np.concatenate([[0], rides + 1, [len(truth.at_m)]])
    part = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
    known = {int(part[k]) for k in tied}
    links = [
        (int(part[c.query.index]), int(part[c.match.index]))
        for c in closures
        if c.query.log == c.match.log == OWN
        and np.linalg.norm(truth.at_m[c.query.index] - truth.at_m[c.match.index]) < 2 * SEEN_M
    ]
    if len(fixes) > 1:
        fixed = [int(part[f.at.index]) for f in fixes]
        links += list(pairwise(fixed))
    for _ in range(len(edges)):
        known |= {b for a, b in links if a in known} | {a for a, b in links if b in known}
    within = [c for c in closures if c.query.log == c.match.log == OWN]
    lone = {id(c) for c in within if known.isdisjoint((int(part[c.query.index]), int(part[c.match.index])))}
    closures[:] = [c for c in closures if id(c) not in lone]
    ends = [c.query.index for c in closures if c.query.log == OWN] + [
        c.match.index for c in closures if c.match.log == OWN
    ]
    pinned = np.unique([*tied, *ends, *(f.at.index for f in fixes)]).astype(int)
    pinned = np.array([k for k in pinned if int(part[k]) in known])
    at, heading = truth.at_m.copy(), truth.heading_rad.copy()
    for k in range(min(known) + 1, len(edges) - 1):
        if k not in known:  # on from where it was
            first, last = edges[k] - 1, edges[k + 1]
            way = chained(at[first], heading[first], steps[first : last - 1], turns[first : last - 1])
            at[first:last], heading[first:last] = way.at_m, way.heading_rad
    for k in range(min(known) - 1, -1, -1):  # back from there
        last = edges[k + 1]
        way = chained(np.zeros(2), 0.0, steps[edges[k] : last], turns[edges[k] : last])
        turn = heading[last] - way.heading_rad[-1]
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        at[edges[k] : last + 1] = (way.at_m - way.at_m[-1]) @ R.T + at[last]
        heading[edges[k] : last + 1] = way.heading_rad + turn
    found = Planar(at, heading)
    if rng.random() < 0.5:
        found = _spread(found, steps, turns, pinned)
    return found, pinned


def _spread(found: Planar, steps: Float, turns: Float, pinned: NDArray[np.integer]) -> Planar:
    """As a solver without robust odometry does: what is too much between two tied keyframes is shared by all steps."""
    at, heading = found.at_m.copy(), found.heading_rad.copy()
    for a, b in pairwise(pinned):
        way = chained(at[a], heading[a], steps[a:b], turns[a:b])
        share = np.linspace(0.0, 1.0, b - a + 1)
        at[a : b + 1] = way.at_m + share[:, None] * (found.at_m[b] - way.at_m[-1])
        heading[a : b + 1] = way.heading_rad + share * (found.heading_rad[b] - way.heading_rad[-1])
    return Planar(at, heading)


Lying = Callable[[np.random.Generator, CorrectedRobot, float], Planar]


def _towards(rng: np.random.Generator, by_m: float) -> Float:
    angle = rng.uniform(0.0, 2 * np.pi)
    return by_m * np.array([np.cos(angle), np.sin(angle)])


def shifted(rng: np.random.Generator, member: CorrectedRobot, by_m: float) -> Planar:
    """All of it."""
    return member.solution.moved(0, len(member.solution.at_m), _towards(rng, by_m))


def part_moved(rng: np.random.Generator, member: CorrectedRobot, by_m: float) -> Planar:
    """A part."""
    first, last = np.sort(rng.choice(np.arange(1, len(member.solution.at_m)), 2, replace=False))
    return member.solution.moved(int(first), int(last), _towards(rng, by_m))


def end_moved(rng: np.random.Generator, member: CorrectedRobot, by_m: float) -> Planar:
    """The last poses."""
    n = len(member.solution.at_m)
    return member.solution.moved(n - int(rng.integers(1, max(2, n // 3))), n, _towards(rng, by_m))


def stretched(rng: np.random.Generator, member: CorrectedRobot, by_m: float) -> Planar:  # noqa: ARG001
    """Longer, from its beginning on, so that the farthest place is moved by so much."""
    at = member.solution.at_m
    far_m = np.linalg.norm(at - at[0], axis=1).max()
    return Planar(at[0] + (1.0 + by_m / far_m) * (at - at[0]), member.solution.heading_rad)


def bent(rng: np.random.Generator, member: CorrectedRobot, by_m: float) -> Planar:
    """More and more to one side, from somewhere on."""
    at, n = member.solution.at_m, len(member.solution.at_m)
    first = int(rng.integers(0, 2 * n // 3))
    share = np.clip((np.arange(n) - first) / (n - 1 - first), 0.0, 1.0) ** 2
    return Planar(at + share[:, None] * _towards(rng, by_m), member.solution.heading_rad)


LIES: dict[str, Lying] = {
    "moved": shifted,
    "a part moved": part_moved,
    "its end moved": end_moved,
    "stretched": stretched,
    "bent": bent,
}


def unexplained_m(member: CorrectedRobot, lie: Planar) -> float:
    """How much farther a lie moves the worst keyframe than what it holds leaves open.

    That is a view of each closure, and of the way from the nearest tied keyframe three quarters; the third
    nearest, since a single closure may be wrong.
    """
    moved_m = np.linalg.norm(lie.at_m - member.solution.at_m, axis=1)
    odometry = member.odometries[OWN][:, :3, 3]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(odometry, axis=0), axis=1))])
    if len(member.tied) < TIES_MIN:
        return 0.0
    to_tie = np.sort(np.abs(way[:, None] - way[member.tied][None]), axis=1)[:, TIES_MIN - 1]
    return float((moved_m - 2.0 * (10.0 + 10.0 * member.step_m) - 0.75 * to_tie).max())


def is_held(member: CorrectedRobot, lie: Planar) -> bool:
    """Whether a lie that comes after an honest correction is not believed."""
    return member.contradicts(lie, member.solution) is not None


def slow_reach_m(rng: np.random.Generator, member: CorrectedRobot, lie: Lying, by_m: float) -> tuple[Planar, bool]:
    """The last that was believed of a lie that grows by little each round, and whether it was stopped."""
    seed, step_m = int(rng.integers(2**32)), float(rng.uniform(*ROUND_M))
    last = member.solution
    for k in range(1, int(by_m / step_m) + 1):
        now = lie(np.random.default_rng(seed), member, k * step_m)
        if member.contradicts(now, last) is not None:
            return last, True
        last = now
    return last, False


@dataclass
class ErrorRates:
    """How many of each kind were refused.

    Attributes:
        honest: Number of rides -> (draws, refused).
        reasons: Of those.
        lies: Kind -> (told ones that move a robot by more than what it holds leaves open, held).
        slow: The same of lies that grow; one is held if what was believed in the end is not too far.
    """

    honest: dict[int, list[int]] = field(default_factory=dict)
    reasons: Counter[str] = field(default_factory=Counter)
    lies: dict[str, list[int]] = field(default_factory=dict)
    slow: dict[str, list[int]] = field(default_factory=dict)

    def lines(self) -> Iterator[str]:
        """For people."""
        for rides, (n, bad) in sorted(self.honest.items()):
            yield f"honest, {rides} rides: {bad} of {n} refused"
        yield from (f"  {n} times: {why}" for why, n in self.reasons.most_common())
        for kind, (n, held) in self.lies.items():
            yield f"lie, {kind}: {held} of {n} held"
        for kind, (n, held) in self.slow.items():
            yield f"slow lie, {kind}: {held} of {n} held"


def judged(draws: int, first: int = 0, slow: int = 0) -> ErrorRates:
    """So many draws of each number of rides, with one lie of each kind; slow lies for the first few only."""
    table = ErrorRates()
    for rides in range(6):
        for k in range(draws):
            rng = np.random.default_rng((first, rides, k))
            member = drawn(rng, rides)
            why = member.contradicts(member.solution)
            count = table.honest.setdefault(rides, [0, 0])
            count[0] += 1
            count[1] += why is not None
            table.reasons.update([] if why is None else [why])
            if why is not None:
                continue
            for kind, lie in LIES.items():
                by_m = float(np.exp(rng.uniform(*np.log(LIE_M))))
                told_lie = lie(rng, member, by_m)
                if unexplained_m(member, told_lie) > 0.0:
                    held = table.lies.setdefault(kind, [0, 0])
                    held[0] += 1
                    held[1] += is_held(member, told_lie)
                    if k < slow:
                        believed, _ = slow_reach_m(rng, member, lie, by_m)
                        held = table.slow.setdefault(kind, [0, 0])
                        held[0] += 1
                        held[1] += unexplained_m(member, believed) <= 0.0
    return table


def main() -> None:
    """Print both error rates."""
    draws, first = (int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    for line in judged(draws, first, draws // 10).lines():
        sys.stdout.write(line + "\n")


if __name__ == "__main__":
    main()
