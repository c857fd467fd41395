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


def merged_after_s(events: Events, robots: Iterable[str]) -> float | None:
    """When all living robots first were in one map frame, two robots at least; None if never.

    A robot counts from the start of the run, also before its first keyframe, until it dies; it comes back with
    its next keyframe.
    """
    alive = set(robots)
    frames: dict[str, str] = {}
    for event in events:
        if isinstance(event.fact, CorrectionApplied):
            frames[event.robot] = event.fact.map_frame
        elif isinstance(event.fact, AgentDied):
            alive.discard(event.robot)
        elif isinstance(event.fact, KeyframeTaken):
            alive.add(event.robot)
        if len(alive) > 1 and len({frames.get(robot) for robot in alive}) == 1 and alive <= frames.keys():
            return event.t
    return None


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
