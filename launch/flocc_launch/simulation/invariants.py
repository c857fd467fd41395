"""Invariants under watch: what must never happen, and what must come true once faults have stopped.

An invariant's `step` looks at what a robot was told and what it then wants (safety, whatever the faults). Its
`lacking` is asked when faults have stopped for a while (liveness).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from flocc_agent.core.effects import Effect
from flocc_agent.core.events import Event
from flocc_agent.core.robot import Robot
from flocc_launch.simulation.swarm import Swarm
from flocc_launch.simulation.virtual_robot import Station


@dataclass(frozen=True, slots=True)
class Step:
    """One step of one robot.

    Attributes:
        at_s: True time.
        station: The robot, after the step.
        event: What happened, None where a deadline was due.
        effects: What the robot then wants.
    """

    at_s: float
    station: Station
    event: Event | None
    effects: list[Effect]


Check = Callable[[Step], Iterable[str]]
"""What is wrong with a step, a sentence each."""


@dataclass(frozen=True, slots=True)
class Invariant:
    """One of DESIGN.md, section 5.

    Attributes:
        name: Its name in reports.
        step: What is wrong with a step, a sentence each.
        lacking: What is not yet as it must be, a sentence each.
        wants: Types of the events and effects that `step` looks at; None: it looks at every step.
    """

    name: str
    step: Check | None = None
    lacking: Callable[[Swarm], Iterable[str]] | None = None
    wants: frozenset[type] | None = None


@dataclass(frozen=True, slots=True)
class Violation:
    """An invariant that did not hold.

    Attributes:
        invariant: Its name.
        at_s: When it was noticed.
        detail: One sentence.
    """

    invariant: str
    at_s: float
    detail: str


class InvariantWatch:
    """Holds invariants against a swarm.

    Attributes:
        violations: Found in steps so far; of each invariant the first.
    """

    def __init__(self, swarm: Swarm, invariants: Iterable[Invariant]) -> None:
        self.violations: list[Violation] = []
        self._swarm = swarm
        self._steps = [(i.name, i.step, i.wants) for i in invariants if i.step is not None]
        self._asked: dict[frozenset[type], list[tuple[str, Check]]] = {}
        """Which of them look at a step with these types of events and effects."""
        self._goals = [(i.name, i.lacking) for i in invariants if i.lacking is not None]
        swarm.observers.append(self._step)

    def is_settled(self) -> bool:
        """Whether everything is as it must be."""
        return not any(True for _, lacking in self._goals for _ in lacking(self._swarm))

    def lacking(self) -> list[Violation]:
        """What is not yet as it must be."""
        now_s = self._swarm.agenda.now_s
        return [Violation(name, now_s, detail) for name, lacking in self._goals for detail in lacking(self._swarm)]

    def _step(self, station: Station, event: Event | None, effects: list[Effect]) -> None:
        step = Step(self._swarm.agenda.now_s, station, event, effects)
        kinds = frozenset(map(type, (event, *effects)))
        asked = self._asked.get(kinds)
        if asked is None:
            wanted = [(name, check) for name, check, wants in self._steps if wants is None or wants & kinds]
            asked = self._asked[kinds] = wanted
        for name, check in asked:
            for detail in check(step):
                if all(violation.invariant != name for violation in self.violations):
                    self.violations.append(Violation(name, step.at_s, detail))


def core(station: Station) -> Robot:
    """The core of a running station."""
    assert station.core is not None, f"{station.name} is switched off"
    return station.core


def groups(swarm: Swarm) -> list[list[Station]]:
    """Running robots that hear each other, directly or over others; each group sorted by name."""
    left = {station.name: station for station in swarm.running()}
    found: list[list[Station]] = []
    while left:
        group = [left.pop(min(left))]
        for member in group:
            near = [name for name in sorted(left) if hear_each_other(swarm, member, left[name])]
            group += [left.pop(name) for name in near]
        found.append(sorted(group, key=lambda station: station.name))
    return found


def names(group: Iterable[Station]) -> str:
    """Names of some stations."""
    return " ".join(station.name for station in group)


def hear_each_other(swarm: Swarm, one: Station, other: Station) -> bool:
    """Whether two stations are in direct range of each other."""
    now_s = swarm.agenda.now_s
    connects = swarm.radio.connects
    return connects(one.name, other.name, now_s) and connects(other.name, one.name, now_s)
