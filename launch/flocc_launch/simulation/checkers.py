"""What must hold (DESIGN.md, section 5), one checker per invariant, on every step of every robot.

A checker's `step` looks at what a robot was told and what it then wants (safety: never wrong, whatever the faults).
Its `lacking` is asked when faults have stopped for a while (liveness: in the end it comes true).
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Protocol

from flocc_agent.core.effects import Broadcast, Correction, Deliver, Effect, Optimise, Register, Unicast
from flocc_agent.core.events import Event
from flocc_agent.core.pose_graph import components_of, map_frame
from flocc_agent.core.robot import Robot
from flocc_launch.simulation.robot import Station
from flocc_launch.simulation.swarm import Swarm
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import CandidatePair, Coordinator, CorrectionMessage, RecordBatch
from flocc_protocol.records import ClosureRecord

SIZES_EVERY = 25
TICKS_PER_S_MAX = 200


@dataclass(frozen=True, slots=True)
class Violation:
    """An invariant that did not hold.

    Attributes:
        invariant: Name of the checker.
        at_s: When it was noticed.
        detail: One sentence.
    """

    invariant: str
    at_s: float
    detail: str


class Checker(Protocol):
    """One invariant."""

    @property
    def invariant(self) -> str:
        """Name of the invariant."""
        ...

    def step(self, swarm: Swarm, station: Station, event: Event | None, effects: list[Effect]) -> Iterable[str]:
        """What is wrong with this step, a sentence each."""
        ...

    def lacking(self, swarm: Swarm) -> Iterable[str]:
        """What is not yet as it must be once faults have stopped, a sentence each."""
        ...


class Agreement:
    """In a connected component that stays still, exactly one robot leads, and all follow its term."""

    invariant = "agreement"

    def step(self, swarm: Swarm, station: Station, event: Event | None, effects: list[Effect]) -> Iterator[str]:
        """Nothing: while the world moves, two may lead."""
        yield from ()

    def lacking(self, swarm: Swarm) -> Iterator[str]:
        """Components without a leader, or with two."""
        for group in groups(swarm):
            leading = [station.name for station in group if core(station).election.leading]
            terms = {core(station).election.term for station in group}
            if len(leading) != 1 or len(terms) != 1:
                yield f"{names(group)}: {leading} lead, terms {sorted(map(str, terms))}"


@dataclass(slots=True)
class Fencing:
    """No robot applies a correction older than one it applied, and a consumer is told when the frame changes."""

    invariant = "fencing"
    _last: dict[LogId, Correction] = field(default_factory=dict)

    def step(self, swarm: Swarm, station: Station, event: Event | None, effects: list[Effect]) -> Iterator[str]:
        """Deliveries whose (term, round) does not grow, or whose jump is not told."""
        for effect in effects:
            if isinstance(effect, Deliver):
                yield from self._delivered(station.log, effect.correction)

    def lacking(self, swarm: Swarm) -> Iterator[str]:
        """Nothing."""
        yield from ()

    def _delivered(self, log: LogId, correction: Correction) -> Iterator[str]:
        last = self._last.get(log)
        self._last[log] = correction
        if last is None:
            return
        if (correction.term, correction.round) <= (last.term, last.round):
            yield f"{log} applied {correction.term}/{correction.round} after {last.term}/{last.round}"
        if correction.frame_changed != (correction.map_frame != last.map_frame):
            yield f"{log} went from {last.map_frame} to {correction.map_frame}, told {correction.frame_changed}"


@dataclass(slots=True)
class OneClaim:
    """A term is claimed by the leader that it names, once, and nobody else speaks with it."""

    invariant = "one claim"
    _claims: dict[Term, tuple[str, int]] = field(default_factory=dict)

    def step(self, swarm: Swarm, station: Station, event: Event | None, effects: list[Effect]) -> Iterator[str]:
        """Claims of another's term, claims repeated in another life, rounds of a term that is not one's own."""
        for effect in effects:
            match effect:
                case Broadcast(Coordinator(advert)):
                    claimer = (station.name, station.life)
                    if advert.term.leader != station.log or self._claims.setdefault(advert.term, claimer) != claimer:
                        yield f"{station.name} claims {advert.term}, which is another's"
                case Optimise(term=term) if term.leader != station.log:
                    yield f"{station.name} optimises in {term}"
                case Broadcast(CorrectionMessage(term=term)) if term not in self._claims:
                    yield f"{station.name} corrects in {term}, which nobody claimed"

    def lacking(self, swarm: Swarm) -> Iterator[str]:
        """Nothing."""
        yield from ()


@dataclass(slots=True)
class NoStarvation:
    """Everything in reach of a leader is optimised, also a robot without closures."""

    invariant = "no starvation"

    def step(self, swarm: Swarm, station: Station, event: Event | None, effects: list[Effect]) -> Iterator[str]:
        """Nothing."""
        yield from ()

    def lacking(self, swarm: Swarm) -> Iterator[str]:
        """Robots with keyframes that the present leader has not corrected."""
        for group in groups(swarm):
            terms = {core(station).election.term for station in group if core(station).election.leading}
            for station in group:
                applied = core(station).corrections.applied
                has_keyframes = core(station).gossip.logs[station.log].keyframes > 0
                if has_keyframes and (applied is None or applied.term not in terms):
                    got = "nothing" if applied is None else f"{applied.term}"
                    yield f"{station.name} has {got} of {sorted(map(str, terms))}"


@dataclass(frozen=True, slots=True)
class _Registered:
    """A registration that began."""

    by: str
    life: int
    at_s: float


@dataclass(slots=True)
class Once:
    """Each pair is registered by one robot, and again only where that robot died or was out of reach.

    Attributes:
        separated: The run has times when robots cannot hear each other for long; then two may take one pair.
    """

    invariant = "registered once"
    separated: bool = False
    _begun: dict[CandidatePair, list[_Registered]] = field(default_factory=lambda: defaultdict(list))

    def step(self, swarm: Swarm, station: Station, event: Event | None, effects: list[Effect]) -> Iterator[str]:
        """A second registration of a pair without an excuse."""
        for effect in effects:
            if isinstance(effect, Register):
                earlier = self._begun[effect.pair]
                unexcused = [r for r in earlier if not self._excused(swarm, r, station)]
                if unexcused:
                    yield f"{station.name} registers {effect.pair.low} {effect.pair.high} after {unexcused[0].by}"
                earlier.append(_Registered(station.name, station.life, swarm.agenda.now_s))

    def lacking(self, swarm: Swarm) -> Iterator[str]:
        """Pairs that nobody registered though both owners are here."""
        for group in groups(swarm):
            here = {station.log for station in group}
            for station in group:
                for pair in core(station).closing.open_pairs():
                    if {pair.low.log, pair.high.log} <= here:
                        yield f"{station.name} still has {pair.low} {pair.high}"

    def _excused(self, swarm: Swarm, earlier: _Registered, again: Station) -> bool:
        first = swarm.stations[earlier.by]
        died = first.life != earlier.life or (first is again and again.life != earlier.life)
        return died or (self.separated and first is not again)


@dataclass(slots=True)
class OneFrame:
    """Robots that closures connect share one map frame, named after the lowest log."""

    invariant = "one frame"

    def step(self, swarm: Swarm, station: Station, event: Event | None, effects: list[Effect]) -> Iterator[str]:
        """Nothing: until the news is round, frames may differ."""
        yield from ()

    def lacking(self, swarm: Swarm) -> Iterator[str]:
        """Robots whose map frame is not that of their part of the pose graph."""
        for group in groups(swarm):
            graph = core(group[0]).assembly.graph()
            frames = {
                log: map_frame(logs[0]) for logs in components_of(list(graph.trajectories), graph.closures) for log in logs
            }
            for station in group:
                applied = core(station).corrections.applied
                if applied is not None and map_frame(applied.anchor) != frames.get(station.log):
                    yield f"{station.name} is in {map_frame(applied.anchor)}, not in {frames.get(station.log)}"


@dataclass(slots=True)
class NothingLost:
    """What a robot published is never lost by it; in the end all logs are equal and every closure is used."""

    invariant = "nothing lost"
    _published: dict[LogId, int] = field(default_factory=dict)

    def step(self, swarm: Swarm, station: Station, event: Event | None, effects: list[Effect]) -> Iterator[str]:
        """A robot whose own log is shorter than what it once sent."""
        for effect in effects:
            match effect:
                case Broadcast(RecordBatch() as batch) | Unicast(_, RecordBatch() as batch) if batch.log == station.log:
                    end = batch.first + len(batch.records)
                    self._published[station.log] = max(end, self._published.get(station.log, 0))
        held = core(station).gossip.logs[station.log]
        if len(held) < self._published.get(station.log, 0):
            yield f"{station.log} holds {len(held)} of its {self._published[station.log]} published records"

    def lacking(self, swarm: Swarm) -> Iterator[str]:
        """Copies that differ, and closures that the leader's graph lacks."""
        for group in groups(swarm):
            digests = {station.name: core(station).gossip.digests() for station in group}
            if len(set(digests.values())) > 1:
                counts = {name: [f"{d.log}:{d.count}" for d in held] for name, held in digests.items()}
                yield f"logs differ: {counts}"
            for station in group:
                if core(station).election.leading:
                    yield from _unused_closures(station)


def _unused_closures(leader: Station) -> Iterator[str]:
    """Closures in the logs that the last solution of a leader does not know."""
    known = set() if leader.solution is None else {CandidatePair.of(c.query, c.match) for c in leader.solution.closures}
    for copy in core(leader).gossip.logs.values():
        for record in copy.records:
            if isinstance(record, ClosureRecord) and CandidatePair.of(record.query, record.match) not in known:
                yield f"closure {record.query} {record.match} is not in the graph of {leader.name}"


@dataclass(slots=True)
class Bounded:
    """Every queue, table and cache stays within its stated maximum, and no robot spins."""

    invariant = "bounded"
    _steps: int = 0
    _ticks: dict[str, tuple[int, int]] = field(default_factory=dict)

    def step(self, swarm: Swarm, station: Station, event: Event | None, effects: list[Effect]) -> Iterator[str]:
        """Sizes beyond their maximum; more ticks in one second than any timer explains."""
        self._steps += 1
        if self._steps % SIZES_EVERY == 0:
            for name, (size, size_max) in core(station).sizes().items():
                if size > size_max:
                    yield f"{station.name}: {name} is {size}, at most {size_max}"
        if event is None:
            yield from self._ticked(station.name, int(swarm.agenda.now_s))

    def lacking(self, swarm: Swarm) -> Iterator[str]:
        """Nothing."""
        yield from ()

    def _ticked(self, name: str, second: int) -> Iterator[str]:
        then, count = self._ticks.get(name, (second, 0))
        count = count + 1 if then == second else 1
        self._ticks[name] = (second, count)
        if count == TICKS_PER_S_MAX:
            yield f"{name} ticked {count} times in second {second}"


class Watch:
    """Runs checkers on a swarm.

    Attributes:
        violations: Found so far; of each invariant the first.
    """

    def __init__(self, swarm: Swarm, checkers: Iterable[Checker]) -> None:
        self.violations: list[Violation] = []
        self._swarm = swarm
        self._checkers = list(checkers)
        swarm.observers.append(self._step)

    def lacking(self) -> list[Violation]:
        """What is not yet as it must be."""
        return [
            Violation(checker.invariant, self._swarm.agenda.now_s, detail)
            for checker in self._checkers
            for detail in checker.lacking(self._swarm)
        ]

    def _step(self, station: Station, event: Event | None, effects: list[Effect]) -> None:
        for checker in self._checkers:
            for detail in checker.step(self._swarm, station, event, effects):
                if all(violation.invariant != checker.invariant for violation in self.violations):
                    self.violations.append(Violation(checker.invariant, self._swarm.agenda.now_s, detail))


def all_checkers(separated: bool) -> list[Checker]:
    """One checker per invariant."""
    return [Agreement(), Fencing(), OneClaim(), NoStarvation(), Once(separated), OneFrame(), NothingLost(), Bounded()]


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
            near = [name for name in sorted(left) if _hear_each_other(swarm, member.name, name)]
            group += [left.pop(name) for name in near]
        found.append(sorted(group, key=lambda station: station.name))
    return found


def names(group: Iterable[Station]) -> str:
    """Names of some stations."""
    return " ".join(station.name for station in group)


def _hear_each_other(swarm: Swarm, one: str, other: str) -> bool:
    now_s = swarm.agenda.now_s
    return swarm.radio.connects(one, other, now_s) and swarm.radio.connects(other, one, now_s)
