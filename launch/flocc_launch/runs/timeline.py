"""What the events of a run say over time: leaders, neighbours, map frames, ends."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median_high

from flocc_agent.core.reports import (
    CorrectionApplied,
    Fact,
    KeyframeTaken,
    LeaderFollowed,
    LeaderLost,
    NeighbourDown,
    NeighbourUp,
)
from flocc_agent.runtime.event_lines import Reported, is_of, of_kind
from flocc_agent.runtime.facts import AgentDied, AgentStopped, KilledByOrder

Events = Iterable[Reported[Fact]]
End = Reported[AgentDied] | Reported[AgentStopped]


@dataclass(frozen=True, slots=True)
class Following:
    """One robot follows one leader from one time to another."""

    robot: str
    term: int
    leader: str
    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True)
class Link:
    """One robot hears another from one time to another."""

    robot: str
    peer: str
    from_s: float
    to_s: float


def end_s(events: Sequence[Reported[Fact]], duration_s: float | None) -> float:
    """When the run ended: as measured, or at its last event."""
    return max([event.t for event in events] + [duration_s or 0.0])


def followings(events: Events, until_s: float) -> list[Following]:
    """Who followed whom, per robot in order of time; an agent's end ends it."""
    open_spans: dict[str, Reported[LeaderFollowed]] = {}
    spans: list[Following] = []

    def close(robot: str, t: float) -> None:
        opened = open_spans.pop(robot, None)
        if opened is not None:
            spans.append(Following(robot, opened.fact.term, opened.fact.leader, opened.t, t))

    for event in events:
        if is_of(event, LeaderFollowed):
            close(event.robot, event.t)
            open_spans[event.robot] = event
        elif isinstance(event.fact, AgentDied | AgentStopped | LeaderLost):
            close(event.robot, event.t)
    for robot in sorted(open_spans):
        close(robot, until_s)
    return sorted(spans, key=lambda span: (span.robot, span.from_s))


def terms_led(spans: Iterable[Following]) -> list[Following]:
    """One span per term and leader, over all robots that followed; in order of time."""
    led: dict[tuple[int, str], Following] = {}
    for span in spans:
        key = (span.term, span.leader)
        seen = led.get(key, span)
        from_s, to_s = min(seen.from_s, span.from_s), max(seen.to_s, span.to_s)
        led[key] = Following(span.leader, span.term, span.leader, from_s, to_s)
    return sorted(led.values(), key=lambda span: (span.from_s, span.to_s, str(span.term), span.leader))


def leader_changes(spans: Iterable[Following]) -> int:
    """How often the robots went from one leader to another, the upper median over the robots."""
    changes: dict[str, int] = {}
    last: dict[str, str] = {}
    for span in spans:
        changed = span.robot in last and last[span.robot] != span.leader
        changes[span.robot] = changes.get(span.robot, 0) + int(changed)
        last[span.robot] = span.leader
    return median_high(changes.values()) if changes else 0


def links(events: Events, until_s: float) -> list[Link]:
    """Who heard whom, in order of robot, peer and time; an agent's end ends its own side."""
    up: dict[tuple[str, str], float] = {}
    found: list[Link] = []

    def close(robot: str, peer: str, t: float) -> None:
        from_s = up.pop((robot, peer), None)
        if from_s is not None:
            found.append(Link(robot, peer, from_s, t))

    for event in events:
        if isinstance(event.fact, NeighbourUp):
            up.setdefault((event.robot, event.fact.peer), event.t)
        elif isinstance(event.fact, NeighbourDown):
            close(event.robot, event.fact.peer, event.t)
        elif isinstance(event.fact, AgentDied | AgentStopped):
            for robot, peer in sorted(up):
                if robot == event.robot:
                    close(robot, peer, event.t)
    for robot, peer in sorted(up):
        close(robot, peer, until_s)
    return sorted(found, key=lambda link: (link.robot, link.peer, link.from_s))


@dataclass(frozen=True, slots=True)
class Merges:
    """When all living robots were in one map frame, two robots at least.

    Attributes:
        after_s: From when on, until the end; None where they are not in one at the end.
        taken_back: From when to when they were, each time that a robot left the frame again.
    """

    after_s: float | None
    taken_back: tuple[tuple[float, float], ...] = ()


def merges_of(events: Events, robots: Iterable[str]) -> Merges:
    """When the robots of a run merged, and which merges did not last.

    A robot counts from the start of the run, also before its first keyframe, until it dies; it comes back with
    its next keyframe, and what it does until it is in the others' frame again takes no merge back. Nor does it when all
    go over into another frame, as they do when their map finds an older one.
    """
    merging = _Merging(set(robots))
    for event in events:
        merging.on_event(event)
    return merging.found()


class _Merging:
    """Robots and their map frames, event by event."""

    def __init__(self, robots: set[str]) -> None:
        self._alive = robots
        self._returning: set[str] = set()
        self._frames: dict[str, str] = {}
        self._frame = ""
        self._from_s: float | None = None
        self._left_s: float | None = None
        self._meanwhile: set[str] = set()
        self._taken_back: list[tuple[float, float]] = []

    def on_event(self, event: Reported[Fact]) -> None:
        if isinstance(event.fact, CorrectionApplied):
            self._frames[event.robot] = event.fact.map_frame
            self._meanwhile.add(event.fact.map_frame)
        elif isinstance(event.fact, AgentDied):
            self._alive.discard(event.robot)
            self._frames.pop(event.robot, None)
        elif isinstance(event.fact, KeyframeTaken) and event.robot not in self._alive:
            self._alive.add(event.robot)
            self._returning |= {event.robot} if self._from_s is not None else set()
        else:
            return
        self._returning = {robot for robot in self._returning if self._frames.get(robot) != self._frame}
        frames = {self._frames.get(robot) for robot in self._alive - self._returning}
        if self._from_s is None or self._left_s is not None:
            (frame,) = frames if len(frames) == 1 else (None,)
            if frame is not None and len(self._alive) > 1:
                self._on_one(frame, event.t)
        elif frames - {self._frame}:
            self._left_s, self._meanwhile = event.t, {frame for frame in frames if frame is not None}

    def _on_one(self, frame: str, t: float) -> None:
        """All are in one frame, and were not before."""
        went_over = frame != self._frame and self._meanwhile <= {self._frame, frame}
        if self._from_s is not None and self._left_s is not None and not went_over:
            self._taken_back.append((self._from_s, self._left_s))
            self._from_s = None
        self._from_s = t if self._from_s is None else self._from_s
        self._frame, self._left_s = frame, None

    def found(self) -> Merges:
        if self._from_s is None or self._left_s is None:
            return Merges(self._from_s, tuple(self._taken_back))
        return Merges(None, (*self._taken_back, (self._from_s, self._left_s)))


def ends(events: Events) -> Mapping[str, End]:
    """The last end of each agent that was seen to end and took no keyframe afterwards."""
    last: dict[str, End] = {}
    for event in events:
        if is_of(event, AgentDied) or is_of(event, AgentStopped):
            last[event.robot] = event
        elif isinstance(event.fact, KeyframeTaken):
            last.pop(event.robot, None)
    return last


def corrections_of(events: Events, robot: str) -> list[Reported[CorrectionApplied]]:
    """The corrections that one robot applied, in order."""
    return [event for event in of_kind(events, CorrectionApplied) if event.robot == robot]


def how_it_died(event: Reported[AgentDied]) -> str:
    """The signal or exit code of an agent's death, and where it says more."""
    if event.fact.signal is not None:
        return f"signal {event.fact.signal}"
    if event.fact.exit_code is None:
        return "no reason known"
    return f"exit code {event.fact.exit_code}; robots/{event.robot}/agent.log says why"


def deaths_unasked(events: Events) -> list[str]:
    """Robots that died without a fault of the scenario or an operator's order, once for each death, in order.

    An order explains one death, the next one of its robot.
    """
    ordered: set[str] = set()
    unasked: list[str] = []
    for event in events:
        if is_of(event, KilledByOrder):
            ordered.add(event.robot)
        elif is_of(event, AgentDied) and event.robot in ordered:
            ordered.discard(event.robot)
        elif is_of(event, AgentDied) and not event.fact.scripted:
            unasked.append(event.robot)
    return unasked
