"""Which closures are enough to join maps.

A single closure between two maps contradicts nothing, so no robust solver can tell that it is wrong; it alone must not
join them. Maps are joined where, however they are divided into two sides, at least `closures_to_join_min` closures that
agree with each other connect the sides: several between two robots, or one on each side of a ring of robots.

A single sighting of a tag or of a robot, or a single pose in the world, contradicts nothing either. It counts as many
closures, since whoever measures it knows more than two pictures that look alike do; what rests on one of them is told.
A landmark is no map: it goes with who saw it most often, whatever that is.
"""

from collections.abc import Mapping, Sequence

from flocc_agent.core.pose_graph import LoopClosure, components_of, is_landmark
from flocc_protocol.ids import LogId

Pair = tuple[LogId, LogId]
Supports = Mapping[LogId, Mapping[LogId, int]]


def too_few(logs: Sequence[LogId], closures: Mapping[int, LoopClosure], closures_min: int) -> list[int]:
    """Indices of the closures that connect groups of logs with fewer than `closures_min` closures between them."""
    left = dict(closures)
    while cut := _weak(logs, left, closures_min):
        left = {k: closure for k, closure in left.items() if k not in cut}
    return sorted(closures.keys() - left.keys())


def _weak(logs: Sequence[LogId], closures: Mapping[int, LoopClosure], closures_min: int) -> set[int]:
    """Closures across a division with too few of them, in each connected part; none where there is no such division."""
    group = {log: log for log in logs} | _observers(closures)
    while (pair := _joined(_between(group, closures), closures_min)) is not None:
        low, high = pair
        group = {log: low if found == high else found for log, found in group.items()}
    between = _between(group, closures)
    supports: dict[LogId, dict[LogId, int]] = {found: {} for found in group.values()}
    for (a, b), ids in between.items():
        supports[a][b] = supports[b][a] = sum(ids.values())
    loose = {found for found, others in supports.items() if sum(others.values()) < closures_min}
    cut = {k for (a, b), ids in between.items() if a in loose or b in loose for k in ids}
    if cut:
        return cut
    for part in components_of(logs, [*closures.values()]):
        groups = sorted({group[log] for log in part})
        side, support = _least_division(groups, supports)
        if side and support < closures_min:
            cut |= {k for (a, b), ids in between.items() if (a in side) != (b in side) for k in ids}
    return cut


def _observers(closures: Mapping[int, LoopClosure]) -> dict[LogId, LogId]:
    """Of each landmark the log that saw it most often, the lowest of those."""
    seen: dict[LogId, dict[LogId, int]] = {}
    for closure in closures.values():
        for end, by in ((closure.match.log, closure.query.log), (closure.query.log, closure.match.log)):
            if is_landmark(end):
                times = seen.setdefault(end, {})
                times[by] = times.get(by, 0) + closure.support
    return {end: min(times, key=lambda by: (-times[by], by)) for end, times in seen.items()}


def _least_division(groups: Sequence[LogId], supports: Supports) -> tuple[frozenset[LogId], int]:
    """One side of the division that the fewest closures cross, and how many do (Stoer and Wagner 1997)."""
    merged = {group: frozenset((group,)) for group in groups}
    towards = {a: {b: n for b, n in supports[a].items() if b in merged} for a in groups}
    best: tuple[frozenset[LogId], int] = (frozenset(), 0)
    while len(towards) > 1:
        order = [min(towards)]
        pull = dict(towards[order[0]])
        while len(order) < len(towards):
            order.append(min((g for g in towards if g not in order), key=lambda g: (-pull.get(g, 0), g)))
            for g, n in towards[order[-1]].items():
                pull[g] = pull.get(g, 0) + n
        last, before = order[-1], order[-2]
        crossing = sum(towards[last].values())
        if not best[0] or crossing < best[1]:
            best = merged[last], crossing
        merged[before] |= merged[last]
        for g, n in towards.pop(last).items():
            del towards[g][last]
            if g != before:
                towards[before][g] = towards[g][before] = towards[before].get(g, 0) + n
    return best


def _between(group: Mapping[LogId, LogId], closures: Mapping[int, LoopClosure]) -> dict[Pair, dict[int, int]]:
    """Closures between each two groups, with their support."""
    found: dict[Pair, dict[int, int]] = {}
    for k, closure in closures.items():
        low, high = sorted((group[closure.query.log], group[closure.match.log]))
        if low != high:
            found.setdefault((low, high), {})[k] = closure.support
    return found


def _joined(between: Mapping[Pair, Mapping[int, int]], closures_min: int) -> Pair | None:
    return min((pair for pair, ids in between.items() if sum(ids.values()) >= closures_min), default=None)
