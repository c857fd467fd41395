"""Safety: what must never happen, whatever the faults. Each class watches the steps of all robots for one thing."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field

from flocc_agent.core.corrections import UNTRUE
from flocc_agent.core.effects import (
    Broadcast,
    Deliver,
    FetchLatent,
    Optimise,
    PersistRecord,
    Register,
    Report,
    Unicast,
)
from flocc_agent.core.events import (
    GraphOptimised,
    KeyframeCaptured,
    KeyframeEncoded,
    LatentFetched,
    LatentFetchFailed,
    MessageReceived,
    PairRegistered,
)
from flocc_agent.core.log_copy import decoded
from flocc_agent.core.loop_closing import registrar_of
from flocc_agent.core.offers import FAR_TAKEOVERS, TAKEOVER_S
from flocc_agent.core.plausibility import UNTIED
from flocc_agent.core.pose_graph import map_frame
from flocc_agent.core.prospects import UNLIKELY
from flocc_agent.core.reports import LogForked, NeighbourDown, NeighbourUp, PeerRefused
from flocc_launch.simulation import agreed, liveness
from flocc_launch.simulation.completeness import Complete
from flocc_launch.simulation.costs import Balanced, Cheap
from flocc_launch.simulation.invariants import Invariant, Step, core
from flocc_launch.simulation.leadership import Doubles, Led, badly_led
from flocc_launch.simulation.rightness import Right, unlike_the_solution, untrue
from flocc_launch.simulation.virtual_robot import Station
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import CandidatePair, Coordinator, CorrectionBatch, LogCorrection, Records
from flocc_protocol.records import ClosureRecord, RejectionRecord

SIZES_EVERY = 25
TICKS_PER_S_MAX = 200
STEPS_PER_S_MAX = 20_000
"""Of a whole swarm; more than that is an answer to an answer without end."""
APART_S = FAR_TAKEOVERS * TAKEOVER_S + 10.0
"""So long after two robots lost or found each other a pair may be taken over, and its latents be fetched."""


def all_invariants(
    separated: bool, noiseless: bool, classes: dict[str, int], honest: bool = True, distributed: bool = False
) -> list[Invariant]:
    """DESIGN.md, section 5, that memory is bounded, and that what comes out is right, complete and cheap.

    Args:
        separated: At times robots cannot hear each other; then, and only then, may two of them take one pair.
        noiseless: Odometry and registrations are without noise, so that the truth can be asked for.
        classes: Compute class by robot name.
        honest: Nobody lies on purpose.
        distributed: Nobody solves for the others.
    """
    complete = Complete()
    sent = frozenset({Broadcast, Unicast})
    told = frozenset({Report, Register, FetchLatent, MessageReceived})
    return [
        Invariant("agreement", lacking=liveness.without_one_leader),
        Invariant("led", step=Led().step, lacking=badly_led),
        Invariant("fencing", step=Fencing().step, wants=frozenset({Deliver})),
        Invariant("one claim", step=OneClaim(distributed).step, wants=sent | {Optimise}),
        Invariant("no starvation", lacking=agreed.uncorrected if distributed else liveness.uncorrected),
        Invariant(
            "registered once",
            step=Once(separated).step,
            lacking=liveness.unregistered,
            wants=frozenset({PersistRecord, Report, Register}),
        ),
        Invariant("one frame", lacking=agreed.in_other_frames if distributed else liveness.in_other_frames),
        Invariant("nothing lost", step=Published().step, lacking=liveness.not_everywhere),
        Invariant("believed", step=doubted_in_error if honest else None, wants=frozenset({Report, Optimise})),
        Invariant("bounded", step=Bounded().step),
        Invariant("reported", step=Doubles().step, wants=sent | told),
        Invariant("cheap", step=Cheap().step, wants=sent | told | {LatentFetched, LatentFetchFailed}),
        Invariant("balanced", step=Balanced(classes).step, wants=told | {Broadcast}),
        Invariant(
            "complete",
            step=complete.step,
            lacking=complete.lacking,
            wants=frozenset({KeyframeCaptured, KeyframeEncoded, PersistRecord, Report}),
        ),
        Invariant(
            "right",
            step=Right().step,
            lacking=untrue if noiseless else agreed.apart if distributed else unlike_the_solution,
            wants=frozenset({GraphOptimised, PairRegistered, Register, Deliver}),
        ),
    ]


def doubted_in_error(step: Step) -> Iterator[str]:
    """An honest leader whose correction is called a lie, or believed after an own solution only.

    One that is waited for is none.
    """
    for effect in step.effects:
        if isinstance(effect, Optimise) and effect.term.counter == 0:
            yield f"{step.station.name} believes its own solution only"
        if isinstance(effect, Report) and isinstance(effect.fact, PeerRefused):
            reason = effect.fact.reason
            if reason.startswith(UNTRUE) and not reason.endswith(UNTIED):
                yield f"{step.station.name} calls it a lie what {effect.fact.peer} says: {reason}"


@dataclass(slots=True)
class Fencing:
    """No robot applies a correction older than one it applied, and a consumer is told when the frame changes."""

    _last: dict[LogId, tuple[LogCorrection, int]] = field(default_factory=dict)

    def step(self, step: Step) -> Iterator[str]:
        """Deliveries whose (term, round) does not grow, or whose jump is not told."""
        for effect in step.effects:
            if isinstance(effect, Deliver):
                yield from self._delivered(step.station, effect.correction, effect.frame_changed)

    def _delivered(self, station: Station, correction: LogCorrection, told: bool) -> Iterator[str]:
        """A robot that died in the middle of a jump may tell of it once more when it is back.

        One whose disk went back in time knows nothing of what it applied, nor do its consumers, who started with it.
        """
        last, life = self._last.get(station.log, (None, 0))
        if station.disk.went_back and station.life != life:
            last = None
        self._last[station.log] = (correction, station.life)
        if last is None:
            return
        name = station.log
        if (correction.term, correction.round) <= (last.term, last.round):
            yield f"{name} applied {correction.term}/{correction.round} after {last.term}/{last.round}"
        jumps = correction.anchor != last.anchor
        if told != jumps and not (told and station.life != life):
            yield f"{name} went from {map_frame(last.anchor)} to {map_frame(correction.anchor)}, told {told}"


@dataclass(slots=True)
class OneClaim:
    """A term is claimed by the leader that it names, once, and nobody else speaks with it.

    In distributed mode a robot corrects its own log, and claims nothing for that.
    """

    distributed: bool = False
    _claims: dict[Term, tuple[str, int]] = field(default_factory=dict)

    def step(self, step: Step) -> Iterator[str]:
        """Claims of another's term, claims repeated in another life, rounds of a term that is not one's own."""
        station = step.station
        for effect in step.effects:
            match effect:
                case Broadcast(Coordinator(advert)) if not station.disk.went_back:
                    claimer = (station.name, station.life)
                    if advert.term.leader != station.log or self._claims.setdefault(advert.term, claimer) != claimer:
                        yield f"{station.name} claims {advert.term}, which is another's"
                case Broadcast(Coordinator(advert)):
                    self._claims[advert.term] = station.name, station.life
                case Optimise(term=term) if term.leader != station.log:
                    yield f"{station.name} optimises in {term}"
                case Broadcast(CorrectionBatch(corrections)):
                    own = {c.term for c in corrections if self.distributed and c.log == c.term.leader == station.log}
                    for term in {correction.term for correction in corrections} - self._claims.keys() - own:
                        yield f"{station.name} corrects in {term}, which nobody claimed"


@dataclass(frozen=True, slots=True)
class _Registered:
    """A registration that began."""

    by: Station
    life: int


@dataclass(slots=True)
class Once:
    """Each pair is registered by one robot, and again only where that could not be known.

    A second registration is excused where the first robot died, or where robots were apart: the one that registers
    took the pair over while the owner in charge, or the first robot, was out of its or an owner's hearing; and two
    robots of one name get what one of them is offered. It never is where the robot holds a record of the pair already,
    unless that refused it unseen, or keyframes were withdrawn since; then the pair is registered anew.

    Attributes:
        separated: At times robots cannot hear each other.
        pairs: Pairs that were registered.
        again: Registrations of a pair that a robot still alive had begun with.
    """

    separated: bool = False
    pairs: int = 0
    again: int = 0
    _begun: dict[CandidatePair, list[_Registered]] = field(default_factory=lambda: defaultdict(list))
    _records: dict[CandidatePair, set[tuple[LogId, int, bytes]]] = field(default_factory=lambda: defaultdict(set))
    _heard: dict[tuple[str, str], tuple[bool, float]] = field(default_factory=dict)
    _forked: set[LogId] = field(default_factory=set)

    def step(self, step: Step) -> Iterator[str]:
        """A second registration of a pair without an excuse."""
        for effect in step.effects:
            match effect:
                case PersistRecord(log, number, data):
                    self._note_record(log, number, data)
                case Report(NeighbourUp() | NeighbourDown() as changed):
                    self._heard[step.station.name, changed.peer] = isinstance(changed, NeighbourUp), step.at_s
                case Report(LogForked(log=log)):
                    self._forked.add(log)
                case Register(pair):
                    yield from self._registers(step, pair)

    def _note_record(self, log: LogId, number: int, data: bytes) -> None:
        record = decoded(data)
        unseen = isinstance(record, RejectionRecord) and record.reason == UNLIKELY
        if isinstance(record, ClosureRecord | RejectionRecord) and not unseen:
            self._records[CandidatePair.of(record.query, record.match)].add((log, number, data))

    def _registers(self, step: Step, pair: CandidatePair) -> Iterator[str]:
        station, logs = step.station, core(step.station).gossip.logs
        withdrawals = core(station).assembly.withdrawals
        name = f"{station.name} registers {pair.low} {pair.high}"
        if any(
            log in logs and logs[log].encoded[number : number + 1] == [data] and withdrawals.counts(log, number, pair)
            for log, number, data in self._records[pair]
            if log not in self._forked
        ):
            yield f"{name}, of which it holds a record"
        earlier = self._begun[pair]
        self.pairs += not earlier
        self.again += any(registered.by.life == registered.life for registered in earlier)
        for registered in () if withdrawals.asks_again(pair) else earlier:
            if not self._excused(registered, step, pair):
                yield f"{name} after {registered.by.name}"
        earlier.append(_Registered(station, station.life))

    def _excused(self, earlier: _Registered, again: Step, pair: CandidatePair) -> bool:
        if earlier.by.life != earlier.life:
            return True
        if not self.separated or earlier.by is again.station:
            return False
        if earlier.by.log.robot == again.station.log.robot:
            return True
        owners = {pair.low.log.robot, pair.high.log.robot}
        takers, charged = owners | {again.station.log.robot}, {registrar_of(pair).robot, earlier.by.log.robot}
        if any(self._hears(one, other) is False for one in takers for other in charged - {one}):
            return True
        involved = takers | charged
        return any(self._changed_lately(one, other, again) for one in involved for other in involved - {one})

    def _hears(self, one: str, other: str) -> bool | None:
        """Whether a robot hears another one; None: it never did."""
        return self._heard.get((one, other), (None, 0.0))[0]

    def _changed_lately(self, one: str, other: str, step: Step) -> bool:
        """Whether a robot never heard another one, or lost or found it so lately that pairs are taken over for it."""
        heard = self._heard.get((one, other))
        return heard is None or step.at_s - heard[1] <= APART_S


@dataclass(slots=True)
class Published:
    """What a robot published is never lost by it."""

    _published: dict[LogId, int] = field(default_factory=dict)

    def step(self, step: Step) -> Iterator[str]:
        """A robot whose own log is shorter than what it once sent; one whose disk went back must first be told.

        What a robot on a slow disk wants to send may never leave it, so that does not count.
        """
        log = step.station.log
        for effect in step.effects if step.station.disk.slow_s == 0.0 else ():
            match effect:
                case Broadcast(Records(batches)) | Unicast(_, Records(batches)):
                    ends = [batch.first + len(batch.records) for batch in batches if batch.log == log]
                    self._published[log] = max([*ends, self._published.get(log, 0)])
        held = len(core(step.station).gossip.logs[log])
        if step.station.disk.went_back:
            self._published[log] = held
        if held < self._published.get(log, 0):
            yield f"{log} holds {held} of its {self._published[log]} published records"


@dataclass(slots=True)
class Bounded:
    """Every queue, table and cache stays within its stated maximum, and no robot spins."""

    _steps: int = 0
    _second: tuple[int, int] = (0, 0)
    _ticks: dict[str, tuple[int, int]] = field(default_factory=dict)

    def step(self, step: Step) -> Iterator[str]:
        """Sizes beyond their maximum; more ticks in one second than any timer explains."""
        self._steps += 1
        second, first = self._second
        if second != int(step.at_s):
            self._second = (int(step.at_s), self._steps)
        assert self._steps - first < STEPS_PER_S_MAX, f"{STEPS_PER_S_MAX} steps in second {second}"
        if self._steps % SIZES_EVERY == 0:
            for name, (size, size_max) in core(step.station).sizes().items():
                if size > size_max:
                    yield f"{step.station.name}: {name} is {size}, at most {size_max}"
        if step.event is None:
            yield from self._ticked(step.station.name, int(step.at_s))

    def _ticked(self, name: str, second: int) -> Iterator[str]:
        then, count = self._ticks.get(name, (second, 0))
        count = count + 1 if then == second else 1
        self._ticks[name] = (second, count)
        if count == TICKS_PER_S_MAX:
            yield f"{name} ticked {count} times in second {second}"
