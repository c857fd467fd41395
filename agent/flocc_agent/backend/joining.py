"""Which closures are enough to join maps.

A single closure between two maps contradicts nothing, so no robust solver can tell that it is wrong; it alone must not
join them. Maps are joined when at least `closures_to_join_min` closures that agree with each other connect them.
"""

from collections.abc import Mapping, Sequence

from flocc_agent.core.pose_graph import LoopClosure
from flocc_protocol.ids import LogId

Pair = tuple[LogId, LogId]


def too_few(logs: Sequence[LogId], closures: Mapping[int, LoopClosure], closures_min: int) -> list[int]:
    """Indices of the closures that connect groups of logs with fewer than `closures_min` closures between them."""
    group = {log: log for log in logs}
    while (pair := _joined(_between(group, closures), closures_min)) is not None:
        low, high = pair
        group = {log: low if found == high else found for log, found in group.items()}
    return sorted(k for ids in _between(group, closures).values() for k in ids)


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
