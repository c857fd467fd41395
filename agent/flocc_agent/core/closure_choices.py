"""Which closures are right, in distributed mode: decided before robots agree on anything, from logs alone.

Each robot has its own log solved, and as the lower robot of a pair both logs together, with the whole back end; one
choice is under way at a time. A choice is made anew when the logs show other closures than it was made of: more, or
fewer where keyframes were taken back, or some that are doubted now.
"""

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.effects import ChooseClosures, Effect
from flocc_agent.core.own_part import OwnedClosure
from flocc_agent.core.parameters import DistributedParameters
from flocc_agent.core.pose_graph import ClosureState, GraphSolution, LoopClosure, PoseGraph
from flocc_agent.geometry import inverse
from flocc_protocol.ids import LogId
from flocc_protocol.messages import SHARED_MAX

Float = NDArray[np.float64]
Shown = tuple[int, int, int]
"""What closures between two robots say, within the lower and within the higher one: of which a choice was made."""
NONE_SHOWN = 0

FAILURES_MAX = 6


@dataclass(slots=True)
class _Choice:
    """What was chosen of one log or two, and of what; `shown` is None before the first time."""

    shown: Shown | None = None
    not_before_s: float = float("-inf")
    failures: int = 0


@dataclass(frozen=True, slots=True)
class Choosing:
    """A choice that is being made.

    Attributes:
        number: Of all choices of this robot.
        other: The other robot's log, or the own one where that alone is solved.
        shown: Of what it is made.
        until_s: When it is given up.
        graph: What is solved.
    """

    number: int
    other: LogId
    shown: Shown
    until_s: float
    graph: PoseGraph = field(repr=False)


class ClosureChoices:
    """A robot's choices: of which logs, of what, and which is due next."""

    def __init__(self, own: LogId, parameters: DistributedParameters) -> None:
        """Start with none.

        Args:
            own: The log that this robot writes.
            parameters: Pauses and timeouts.
        """
        self._own = own
        self._parameters = parameters
        self._shown: dict[LogId, Shown] = {}
        self._choices: dict[LogId, _Choice] = {}
        self._running: Choosing | None = None
        self._made = 0
        self._not_before_s = float("-inf")

    def look(self, graph: PoseGraph) -> None:
        """Take in what the logs show now: by the other robot, and the own log by its own name."""
        said: dict[tuple[LogId, LogId], int] = {}
        for c in graph.closures:
            low, high = sorted((c.query.log, c.match.log))
            said[low, high] = _sum_of(c, said.get((low, high), NONE_SHOWN))
        chosen = {other for other, choice in self._choices.items() if choice.shown is not None}
        others = {high for low, high in said if low == self._own} | chosen
        own = said.get((self._own, self._own), NONE_SHOWN)
        shown = {
            high: (said.get((self._own, high), NONE_SHOWN), own, said.get((high, high), NONE_SHOWN))
            for high in sorted(others - {self._own})
        }
        self._shown = {**shown, self._own: (NONE_SHOWN, own, NONE_SHOWN)} if self._own in others else shown

    def deadline(self) -> float:
        """When the next choice begins, or the one under way is given up; never where all that is shown was chosen."""
        return self._due_s() if self._running is None else self._running.until_s

    def overdue(self, now: float) -> int | None:
        """Number of the choice that took too long."""
        running = self._running
        return running.number if running is not None and running.until_s <= now else None

    def begin(self, graph: PoseGraph, now: float) -> list[Effect]:
        """Have the next log or pair solved for itself, where one is due and none is under way."""
        if self._running is not None or self._due_s() > now:
            return []
        due = [(choice.not_before_s, other) for other, choice in self._open() if choice.not_before_s <= now]
        if not due:
            return []
        _, other = min(due)
        logs = {self._own, other}
        part = PoseGraph(
            {log: graph.trajectories[log] for log in sorted(logs) if log in graph.trajectories},
            tuple(c for c in graph.closures if {c.query.log, c.match.log} <= logs),
        )
        self._made += 1
        self._not_before_s = now + self._parameters.period_s
        until_s = now + self._parameters.timeout_s
        self._running = Choosing(self._made, other, self._shown[other], until_s, part)
        return [ChooseClosures(self._made, part)]

    def end(self, number: int, now: float) -> Choosing | None:
        """A choice was made; None for one that was given up."""
        running = self._taken(number)
        if running is not None:
            self._choices[running.other] = _Choice(running.shown, now + self._parameters.choose_s)
        return running

    def fail(self, number: int, now: float) -> bool:
        """A choice could not be made, and is tried again after a growing pause; False for one that was given up."""
        running = self._taken(number)
        if running is None:
            return False
        held = self._choices.setdefault(running.other, _Choice())
        held.failures = min(held.failures + 1, FAILURES_MAX)
        held.not_before_s = now + self._parameters.choose_s * 2**held.failures
        return True

    def _taken(self, number: int) -> Choosing | None:
        running = self._running
        if running is None or running.number != number:
            return None
        self._running = None
        return running

    def _open(self) -> list[tuple[LogId, _Choice]]:
        """Logs that show more than was chosen of, and their last choice."""
        held = ((other, shown, self._choices.get(other, _Choice())) for other, shown in self._shown.items())
        return [(other, choice) for other, shown, choice in held if choice.shown != shown]

    def _due_s(self) -> float:
        due = (max(self._not_before_s, choice.not_before_s) for _, choice in self._open())
        return min(due, default=float("inf"))


def _sum_of(closure: LoopClosure, before: int) -> int:
    """A checksum of what closures say, one after the other."""
    said = f"{closure.query} {closure.match} {closure.doubt}".encode()
    return zlib.crc32(said + closure.T_query_match_unscaled.tobytes(), before)


def used_closures(
    closures: Iterable[LoopClosure],
    solution: GraphSolution,
    T: Mapping[LogId, Float],
    of: Iterable[LoopClosure] | None = None,
) -> tuple[OwnedClosure, ...]:
    """Closures that a solution uses, of some or all, between the logs that it placed."""
    wanted = None if of is None else {id(closure) for closure in of}
    found = []
    for closure, result in zip(closures, solution.closures, strict=True):
        ends = sorted((closure.query, closure.match))
        placed = all(end.log in T and end.index < len(T[end.log]) for end in ends)
        if result.state is not ClosureState.USED or result.weight <= 0.0 or not placed:
            continue
        if wanted is None or id(closure) in wanted:
            low, high = ends
            T_low_high = inverse(T[low.log][low.index]) @ T[high.log][high.index]
            knows = closure.metric or closure.scale_initial is not None
            found.append(OwnedClosure(closure, result.weight, None if knows else result.scale, T_low_high))
    return tuple(found)


def shared_of(used: tuple[OwnedClosure, ...]) -> tuple[tuple[int, ...], tuple[OwnedClosure, ...]]:
    """Keyframes of the higher robot at a pair's closures, evenly fewer where they are too many; and the closures there.

    A robot says at most `SHARED_MAX` poses at once.
    """
    shared = sorted({max(each.closure.query, each.closure.match).index for each in used})
    if len(shared) <= SHARED_MAX:
        return tuple(shared), used
    evenly = np.round(np.linspace(0, len(shared) - 1, SHARED_MAX)).astype(int)
    kept = {shared[k] for k in evenly.tolist()}
    return tuple(sorted(kept)), tuple(c for c in used if max(c.closure.query, c.closure.match).index in kept)
