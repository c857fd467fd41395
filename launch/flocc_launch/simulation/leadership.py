"""Led: the best-ranked robot leads, what a leader says is on its disk first, and who leaves hands over."""

from collections.abc import Iterator

from flocc_agent.core.effects import Broadcast, Deliver, PersistCorrection, PersistTerm, Report
from flocc_agent.core.election import rank
from flocc_agent.core.events import Leaving, MessageReceived
from flocc_agent.core.reports import LogForked, NameTaken
from flocc_launch.simulation.invariants import Step, core, groups, names
from flocc_launch.simulation.swarm import Swarm
from flocc_launch.simulation.virtual_robot import Station
from flocc_protocol.ids import LogId
from flocc_protocol.messages import Coordinator, Envelope, Handover, Heartbeat, LogCorrection, RecordBatch, Records


def badly_led(swarm: Swarm) -> Iterator[str]:
    """Groups whose leader is not the best-ranked robot, and robots that count others as near that are not."""
    for group in groups(swarm):
        best = min(group, key=lambda station: rank(station.compute_class, station.log))
        for station in group:
            if core(station).election.leading and station is not best:
                yield f"{names(group)}: {station.name} leads, {best.name} outranks it"
            yield from _misheard(swarm, station)


def _misheard(swarm: Swarm, station: Station) -> Iterator[str]:
    now_s = swarm.agenda.now_s
    others = (other for other in swarm.running() if other.log.robot != station.log.robot)
    near = {other.log.robot for other in others if swarm.radio.connects(other.name, station.name, now_s)}
    heard = set(core(station).neighbours.names())
    if near != heard:
        yield f"{station.name} counts {sorted(heard)} as near, {sorted(near)} are"


class Led:
    """What a leader does in a step, and what others make of it; whether a robot led before the step is remembered."""

    def __init__(self) -> None:
        self._led: dict[str, bool] = {}
        self._applied: dict[tuple[str, int], LogCorrection | None] = {}

    def step(self, step: Step) -> Iterator[str]:
        """Claims and corrections that are not on the disk first, and hand-overs that were not made or not heeded."""
        name, election = step.station.name, core(step.station).election
        yield from _unwritten(step)
        said = (isinstance(e, Broadcast) and isinstance(e.message, Handover) for e in step.effects)
        if isinstance(step.event, Leaving) and self._led.get(name) and not any(said):
            yield f"{name} left without handing over"
        if isinstance(step.event, MessageReceived) and isinstance(step.event.envelope.message, Handover):
            handed = step.event.envelope.message.term
            of_another = handed.leader.robot != step.station.log.robot  # what a namesake says is not taken
            if of_another and election.term == handed and handed.leader == step.event.envelope.sender:
                yield f"{name} follows {handed}, which was handed over"
        self._led[name] = election.leading
        yield from self._undelivered(step)

    def _undelivered(self, step: Step) -> Iterator[str]:
        """A correction that a robot applies without telling its consumers; its power may have gone in between."""
        life = step.station.name, step.station.life
        applied = core(step.station).corrections.applied
        is_new = applied is not self._applied.setdefault(life, applied) and step.station.dies_after is None
        if is_new and not any(isinstance(effect, Deliver) for effect in step.effects):
            yield f"{step.station.name} tells nobody of the correction that it applies"
        self._applied[life] = applied


def _unwritten(step: Step) -> Iterator[str]:
    counter = step.station.disk.term_counter
    kept = None
    for effect in step.effects:
        match effect:
            case PersistTerm(written):
                counter = max(counter, written)
            case PersistCorrection(correction):
                kept = correction
            case Broadcast(Coordinator(advert)) if advert.term.counter > counter:
                yield f"{step.station.name} claims {advert.term}, its disk knows of {counter}"
            case Deliver(correction) if correction is not kept:
                yield f"{step.station.name} applies {correction.term}/{correction.round}, which is not on its disk"


class Doubles:
    """Two robots of one name, and two writers of one log, are reported."""

    def __init__(self) -> None:
        self._boots: dict[str, int] = {}
        self._named: set[tuple[str, int]] = set()
        self._forked: set[tuple[str, int, str, LogId]] = set()

    def step(self, step: Step) -> Iterator[str]:
        """A heartbeat of another start under one's own name, or another record in a log, of which nobody is told."""
        name, life = step.station.name, step.station.life
        for effect in step.effects:
            match effect:
                case Broadcast(Heartbeat() as heartbeat):
                    self._boots[name] = heartbeat.boot
                case Report(NameTaken(peer=peer)) if peer == step.station.log.robot:
                    self._named.add((name, life))
                case Report(LogForked(peer=peer, log=log)):
                    self._forked.add((name, life, peer, log))
        match step.event:
            case MessageReceived(Envelope(sender, Heartbeat(boot=boot))) if sender.robot == step.station.log.robot:
                if boot != self._boots.get(name, boot) and (name, life) not in self._named:
                    yield f"{name} does not report {sender}, which has its name"
            case MessageReceived(Envelope(sender, Records(batches))) if sender.robot != step.station.log.robot:
                for batch in batches:
                    if _contradicts(step.station, batch) and (name, life, sender.robot, batch.log) not in self._forked:
                        yield f"{name} does not report that {sender} has another {batch.log}"


def _contradicts(station: Station, batch: RecordBatch) -> bool:
    """Whether a batch has other records than are held."""
    copy = core(station).gossip.logs.get(batch.log)
    held = [] if copy is None else copy.encoded[batch.first : batch.first + len(batch.records)]
    return any(one != other for one, other in zip(held, batch.records, strict=False))
